"""What can be wrong with data before physics is asked: gaps, clocks, clipping, stuck
sensors, repeats that do not repeat. (`rest` looks at how bursts end.)

Each check names the channel, the place and the count in plain words and decides nothing;
`samii_rig.signal.estimate` excludes or refuses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from samii_rig.signal.groups import Selection
from samii_rig.types import Finding, Float, Quality, Recording, Segment

# Root mean square of the time stamps about a uniform clock, in samples, that is worth a
# word: 5 % of a sample is 1 degree of phase at 1/18 of the sample rate.
JITTER = 0.05
RATE_ERROR = 1e-3  # relative; the frequency axis is off by as much
# A repeat is foreign when its distance to its nearest fellow is this many times (in power)
# the distance of the two that agree best: three times in amplitude.
FOREIGN = 10.0
# Of two repeats neither is known to be the right one; they are refused when the difference is this
# part of the signal (power: 10 % in amplitude) and has structure along frequency.
TWO_DIFFER = 0.01
STRUCTURE = 0.7  # lag-one coherence; noise alone has about 1/sqrt(lines)
# A moment in which one repeat is this many times as far from the others as usual. Sound repeats
# reach 2.4 on the simulated rig, 5.7 where dry friction holds a real one (SFLR, lowest level).
KNOCK, KNOCK_SECONDS = 6.0, 0.5
STUCK_PART = 0.2  # of the samples in which the input moves
LIVELY = 0.1  # of the samples, at which one that moves may read the same as before
AROUND = 3  # times as long as a sensor stands still, on either side
STUCK_SAMPLES = 20
# Changes of one step each in a row, with which a sensor that rested moves again; one that was
# frozen comes back where the rig is by then.
GENTLE = 3
FLAT_RUN, FLAT_RUNS = 3, 3  # as many equal samples at the extreme, as many times
COARSE = 1000  # distinct values below which equal neighbours mean nothing


def breaks(cut: Recording, segment: Segment, names: Sequence[str]) -> list[tuple[int, int, str]]:
    """Where samples are missing: (index of the first sample after, samples lost, channel).

    A jump in the sequence has channel ""; a NaN names its channel and counts from its own
    first sample. Sorted by place.
    """
    found: list[tuple[int, int, str]] = []
    jump = np.diff(cut.sequence)
    found += [(int(i) + 1, int(jump[i]) - 1, "") for i in np.flatnonzero(jump > 1)]
    if len(cut):
        if lost := int(cut.sequence[0]) - segment.start:
            found.append((0, lost, ""))
        if lost := segment.stop - int(cut.sequence[-1]) - 1:
            found.append((len(cut), lost, ""))
    else:
        found.append((0, segment.stop - segment.start, ""))
    for name in names:
        i = cut.column(name)
        missing = (cut.quality[:, i] & Quality.MISSING).astype(bool)
        for start, stop in runs(missing | ~np.isfinite(cut.values[:, i])):
            found.append((start, stop - start, name))
    return sorted(found)


def gap_finding(
    cut: Recording, segment: Segment, found: Sequence[tuple[int, int, str]]
) -> Finding | None:
    """One finding for all breaks of a segment, None without any."""
    if not found:
        return None
    first, lost, channel = found[0]
    what = f" of {channel}" if channel else ""
    total = sum(n for _, n, _ in found)
    where = f"at sample {segment.start + first}"
    more = f"; {total} in {len(found)} places in all" if len(found) > 1 else ""
    message = f"{cut.place(segment)}: {lost} samples{what} missing {where}{more}"
    return Finding("gap", "error", message, channel=channel, segment=segment.name)


def timing(cut: Recording, segment: Segment) -> list[Finding]:
    """Time that stands still or runs backwards (error), jitter or a wrong rate (warning)."""
    if len(cut) < 3:
        return []
    place = cut.place(segment)
    step = np.diff(cut.time)
    if np.any(bad := (step <= 0) | (np.diff(cut.sequence) <= 0)):
        i = int(np.flatnonzero(bad)[0])
        message = f"{place}: time or count does not advance after sample {int(cut.sequence[i])}"
        return [Finding("timing", "error", message, segment=segment.name)]
    count = (cut.sequence - cut.sequence[0]).astype(float)
    seconds = (cut.time - cut.time[0]) * 1e-9
    slope = float(seconds @ count / (count @ count))
    out = []
    if abs(slope * cut.rate_hz - 1) > RATE_ERROR:
        message = f"{place}: the clock says {1 / slope:.6g} Hz, the recording {cut.rate_hz:g} Hz"
        out.append(Finding("clock", "warning", message, segment=segment.name))
    jitter = float(np.std(seconds - slope * count)) / slope
    if jitter > JITTER:
        message = f"{place}: samples lie {jitter:.2g} of a sample (rms) off a uniform clock"
        out.append(Finding("timing", "warning", message, segment=segment.name))
    return out


def clipping(cut: Recording, segment: Segment, selection: Selection) -> list[Finding]:
    """Samples at the end of a converter's range: flagged, at low or high, or flat tops.

    A clipped sensor is an error, a saturated command a warning: what went out is known. What
    reads more than its converter can is no clipping but a wrong unit or channel: a warning.
    """
    out = []
    for channel in (selection.input, *selection.outputs):
        i = cut.column(channel.name)
        x, flags = cut.values[:, i], cut.quality[:, i]
        flagged = (flags & (Quality.CLIPPED | Quality.LIMITED)).astype(bool)
        if not flagged.any() and (most := channel.beyond(x)):
            message = (
                f"{cut.place(segment)}: {channel.name} reads {most:.4g} {channel.unit}, which "
                f"is outside its range of {channel.low:g} to {channel.high:g}: another unit, or "
                "another channel"
            )
            out.append(Finding("range", "warning", message, channel.name, segment.name))
            continue
        at_end = flagged | (x <= channel.low) | (x >= channel.high)
        how = "at the end of its range"
        if not at_end.any() and channel.role == "sensor":
            at_end, how = _flat_tops(x), "flat at its extreme"
        if n := int(np.count_nonzero(at_end)):
            first = int(cut.sequence[int(np.flatnonzero(at_end)[0])])
            sensor = channel.role == "sensor"
            message = (
                f"{cut.place(segment)}: {channel.name} is {how} in {n} samples, first at {first}"
            )
            out.append(
                Finding(
                    "clipping" if sensor else "saturation",
                    "error" if sensor else "warning",
                    message,
                    channel=channel.name,
                    segment=segment.name,
                )
            )
    return out


def stuck(cut: Recording, segment: Segment, selection: Selection) -> list[Finding]:
    """Outputs that stand still while the input moves.

    One that never changes is an error, and so is one that freezes although its noise moves
    it at nearly every other sample, before and after it too, and comes back with a jump. A coarse
    sensor that rests for long is a warning: dry friction looks the same.
    """
    out = []
    v = cut.values[:, cut.column(selection.input.name)]
    moving = np.diff(v) != 0
    if np.count_nonzero(moving) < STUCK_SAMPLES:
        return []
    for channel in selection.outputs:
        x = cut.values[:, cut.column(channel.name)]
        change = np.diff(x)
        still = change == 0
        place = f"{cut.place(segment)}: {channel.name}"
        if still.all():
            message = f"{place} never changes while {selection.input.name} moves"
            out.append(Finding("stuck", "error", message, channel.name, segment.name))
            continue
        longest = max(runs(still), key=lambda run: run[1] - run[0], default=(0, 0))
        length = longest[1] - longest[0]
        inside = int(np.count_nonzero(moving[longest[0] : longest[1]]))
        if inside < STUCK_SAMPLES:
            continue
        beside = AROUND * length  # where it has stood still so often before and after, it rests
        near = still[max(longest[0] - beside, 0) : longest[1] + beside]
        lively = not _goes_on(change, *longest, channel.resolution) and all(
            np.count_nonzero(some) - length < LIVELY * (some.size - length)
            for some in (still, near)
        )
        if lively or inside > STUCK_PART * np.count_nonzero(moving):
            message = (
                f"{place} stands still for {length + 1} samples from "
                f"{int(cut.sequence[longest[0]])} while {selection.input.name} moves"
            )
            severity: Literal["error", "warning"] = "error" if lively else "warning"
            out.append(Finding("stuck", severity, message, channel.name, segment.name))
    return out


def _goes_on(change: Float, first: int, last: int, step: float) -> bool:
    """Whether a sensor moves on by single steps of its converter: it had come to rest and was not
    frozen. change : (n,) from each sample to the next, none from `first` to `last`."""
    beside = [side[side != 0][:GENTLE] for side in (change[:first][::-1], change[last:])]
    rested = np.abs(np.concatenate(beside)) < 1.5 * step
    return beside[1].size == GENTLE and bool(rested.all())


def foreign_repeats(
    spectra: NDArray[np.complex128], names: Sequence[str], channels: Sequence[str]
) -> dict[int, Finding]:
    """Repeats that do not repeat, by index: spectra (n, n_freq, n_channels) of one reference.

    Three or more: the one that is far from all while others agree; the rest are looked at
    again without it. Two: no one can say which is wrong, so both are named when their
    difference is large and has structure along frequency (a changed gain, a knock).
    """
    out: dict[int, Finding] = {}
    kept = list(range(len(spectra)))
    while len(kept) >= 3:
        worst = _most_foreign(spectra[kept])
        if worst is None:
            break
        index, channel, ratio = kept[worst[0]], worst[1], worst[2]
        message = (
            f"{names[index]} does not repeat the others: {channels[channel]} is "
            f"{np.sqrt(ratio):.1f} times as far from them as they are from each other"
        )
        out[index] = Finding("repeat", "error", message, channels[channel], names[index])
        kept.remove(index)
    if len(spectra) == 2:
        signal = np.mean(np.abs(spectra) ** 2, axis=(0, 1))
        for i, name in enumerate(channels):
            change = spectra[0, :, i] - spectra[1, :, i]
            power = float(np.mean(np.abs(change) ** 2)) / 2
            relative = change / np.where(spectra[0, :, 0] == 0, 1, spectra[0, :, 0])
            structured = max(_lag_one(change), _lag_one(relative)) > STRUCTURE
            if signal[i] > 0 and power > TWO_DIFFER * signal[i] and structured:
                message = (
                    f"{names[0]} and {names[1]} differ in {name} by "
                    f"{np.sqrt(power / signal[i]):.0%}, and not by noise"
                )
                out[0] = Finding("repeat", "error", message, name, names[0])
                break
    return out


def knocks(
    records: Sequence[Float], names: Sequence[str], channels: Sequence[str], rate_hz: float
) -> dict[int, Finding]:
    """Repeats that something disturbed for a moment, by index: records (n_samples, n_channels)
    of one reference, three or more.

    Over all frequencies a knock is little; in its half second it stands out of the noise.
    """
    width = max(int(KNOCK_SECONDS * rate_hz), 2)
    n, count = len(records), len(records[0]) // width if records else 0
    if n < 3 or count < 2:
        return {}
    mean = np.asarray(sum(records) / n)

    def apart(z: Float) -> Float:
        parts = (z - mean)[: count * width] * (n / (n - 1))
        return np.asarray(parts.reshape(count, width, -1).std(axis=1))

    rms = np.stack([apart(z) for z in records])
    usual = np.median(rms, axis=(0, 1))
    over = rms / np.where(usual > 0, usual, np.inf)
    out: dict[int, Finding] = {}
    worst = np.argmax(rms, axis=0)
    for i in range(n):
        loud = np.where(worst == i, over[i], 0.0)
        window, c = divmod(int(np.argmax(loud)), loud.shape[1])
        if loud[window, c] > KNOCK:
            message = (
                f"{names[i]} was disturbed at {window * width / rate_hz:.3g} s: {channels[c]} is "
                f"{loud[window, c]:.1f} times as far from the other repeats there as usual"
            )
            out[i] = Finding("repeat", "error", message, channels[c], names[i])
    return out if len(out) < n - 1 else {}


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Half-open ranges of indices in which `flags` (n,) is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _flat_tops(x: Float) -> NDArray[np.bool_]:
    flat = np.zeros(x.shape, bool)
    finite = x[np.isfinite(x)]
    if finite.size == 0 or np.unique(finite).size < COARSE:
        return flat
    for extreme in (finite.min(), finite.max()):
        if extreme == finite[0]:  # it began there: at rest, as one that turns one way only
            continue
        tops = [run for run in runs(x == extreme) if run[1] - run[0] >= FLAT_RUN]
        if len(tops) >= FLAT_RUNS:
            for start, stop in tops:
                flat[start:stop] = True
    return flat


def _most_foreign(spectra: NDArray[np.complex128]) -> tuple[int, int, float] | None:
    n, _, n_channels = spectra.shape
    worst: tuple[int, int, float] | None = None
    for c in range(n_channels):
        x = spectra[:, :, c]
        distance = np.full((n, n), np.inf)
        for a in range(n):
            for b in range(a):
                distance[a, b] = distance[b, a] = float(np.mean(np.abs(x[a] - x[b]) ** 2))
        # Rounding alone is no distance.
        best = max(float(distance.min()), 1e-20 * float(np.mean(np.abs(x) ** 2)))
        if best == 0:
            continue
        nearest = distance.min(axis=1)
        index = int(np.argmax(nearest))
        ratio = float(nearest[index]) / best
        if ratio > FOREIGN and (worst is None or ratio > worst[2]):
            worst = (index, c, ratio)
    return worst


def _lag_one(x: NDArray[np.complex128]) -> float:
    power = float(np.vdot(x, x).real)
    return abs(complex(np.vdot(x[:-1], x[1:]))) / power if power > 0 else 0.0
