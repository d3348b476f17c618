"""Columns that a logger shifted by whole samples against each other.

Where the loop's law v[k] = u[k] + kp (theta_ref[k] - theta[k]) is known, u, v and theta of one
sample fulfil it to the rounding. If they do so only with theta[k + m], what was measured stands m
rows behind what was sent: each row is read at another time than the one before.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from samii_rig.errors import InputError
from samii_rig.rig.load import tables
from samii_rig.signal.shifts import FARTHEST, compared, driving
from samii_rig.signal.steps import LEAST_STEPS, steps_moved
from samii_rig.types import Channel, Finding, Float, Int, Recording

LEFT = 0.2  # part of what is fed back, or of a command's size, by which a law that holds is off
# Of a law that holds, log likelihood by which a shift is seen: 1e-5 by chance among eleven.
SEEN = 14.0
# Part of a command's step that rounding leaves, and medians from which a residual is a spike.
ROUNDED, SPIKE = 0.3, 8.0
# Rows to each side of which what a voltmeter shows of a command is made: of random to two fifths of
# half the rate three left 1.5 % of it, as much as another shift explains.
TAPS = 2
# Rows of that filter's delay: a voltmeter between two commands has half a row, another shift one.
CENTRED = 0.75
ALIKE = 0.02  # part of an input that is not proportional to another, below which it is the same
# Of the largest command, up to where no limit has clipped it, and log likelihood by which a shift
# is seen there too: beside a meter's noise another shift explains some of a clipped top, up to 250.
UNCLIPPED, CONFIRMED = 0.7, 5.0
LOOKED_AT = 1 << 14  # samples about the largest reference: thousands show a shift, millions cost
QUIETER = 0.5  # of a command's fourth differences, those without what a loop would have added
SENT = ("reference", "command")  # roles of columns that are sent, not measured


def centring_of(recording: Recording) -> tuple[str, float] | None:
    """Sensor and kp of the centring in the rig file that a recording carries, None without one."""
    try:
        centring: Any = tables(recording.rig_toml, "rig file")["centring"]
        sensor, kp = centring["sensor"], centring["kp"]
    except (InputError, KeyError, TypeError):
        return None
    return (str(sensor), float(kp)) if isinstance(kp, int | float) and kp > 0 else None


def is_open(recording: Recording, command: str, sensor: str, kp: float) -> bool:
    """Whether the command does not follow the sensor though the rig file closes a loop around it.

    By the reference; without one, by the sensor's noise, which a loop has in its command.
    """
    v = recording.values_of(command)
    back = kp * recording.values_of(sensor)

    def size(x: Float) -> float:
        known = x[np.isfinite(x)]
        return float(np.median(np.abs(known))) if known.size else 0.0

    if recording.names("reference"):
        rest = v - asked(recording, command, kp)
        return size(rest) < LEFT * size(rest + back)
    return size(np.diff(v, 4)) < QUIETER * size(np.diff(v + back, 4))


def shift_of(recording: Recording) -> int:
    """Samples by which what was measured stands behind what was sent; 0 where the law of the loop
    does not show it."""
    laws, rounded = _laws(recording)
    best = _best(laws)
    if best is None or not _is_seen(recording, laws, best, rounded):
        return 0
    return best - FARTHEST


def is_aligned(recordings: Iterable[Recording]) -> bool:
    """Whether the law of the loop tells of any of them, of which one logger made all, by how many
    samples what was measured stands behind what was sent, none included."""
    for recording in recordings:
        laws, rounded = _laws(recording)
        best = _best(laws)
        others = (law for k, law in enumerate(laws) if k != best)
        if best is None or any(law.apart(laws[best], rounded) <= SEEN for law in others):
            continue
        if best == FARTHEST or _is_seen(recording, laws, best, rounded):
            return True
    return False


def _is_seen(recording: Recording, laws: Sequence[_Law], best: int, rounded: float) -> bool:
    """Whether the law of one shift, the best, is likelier than that of none: beside a meter's noise
    also by rows that show one there. rounded : as of `_laws`."""
    if laws[FARTHEST].apart(laws[best], rounded) <= SEEN:
        return False
    if laws[best].left <= rounded:
        return True
    some, _ = _laws(recording, noisy=True)
    return bool(some) and some[FARTHEST].apart(some[best], rounded) > CONFIRMED


def _best(laws: Sequence[_Law]) -> int | None:
    """Which of the laws holds; None where none does."""
    left = [law.left if law.centred else math.inf for law in laws]
    best = int(np.argmin(left)) if left else 0
    return best if left and laws[best].holds else None


def _laws(recording: Recording, *, noisy: bool = False) -> tuple[list[_Law], float]:
    """That of the loop of every shift, none where they are not known, and the square of what the
    command's rounding leaves. noisy : of what shows a shift beside a meter's noise alone. Those are
    rows whose command no limit has clipped; none of a sensor whose rounding hides its motion, as it
    steps in few rows, and these alone would tell."""
    centring = centring_of(recording)
    first = next(iter(recording.names("command")), "")
    recording = of_input(recording, first)
    names = {c.name: c for c in recording.channels}
    command, references = recording.names("command"), recording.names("reference")
    if centring is None or centring[0] not in names or len(command) != 1 or not references:
        return [], 0.0
    sensor, kp = centring
    if noisy and _hidden(names[sensor], recording.values_of(sensor)):
        return [], 0.0
    around = _about_the_largest(recording, references)
    if around.stop - around.start <= 2 * FARTHEST:
        return [], 0.0

    theta, v = (recording.values_of(name)[around] for name in (sensor, command[0]))
    sent = _beside(asked(recording, command[0], kp, around))
    v = v[FARTHEST + TAPS : v.size - FARTHEST - TAPS]
    on = _unclipped(v) if noisy else slice(None)
    shifts = range(-FARTHEST, FARTHEST + 1)
    laws = [_Law.of(v[on], sent[:, on], _beside(-kp * np.roll(theta, -m))[:, on]) for m in shifts]
    rounded = (ROUNDED * names[command[0]].resolution) ** 2
    return (laws, rounded) if all(law.known for law in laws) else ([], 0.0)


@dataclass(frozen=True)
class _Law:
    """v = F (sent + fed back), F a short filter: a voltmeter shows what is between two commands.

    rows : n. left : variance of the rest, without spikes; part : the same of what is fed back.
    alike : correlation of the rest with the sample before. fed, gain : what v holds of `fed back`,
    and the filter's gain; both 1 where the law holds. late : rows of the filter's delay.
    """

    rows: int
    left: float
    part: float
    alike: float
    fed: float
    gain: float
    late: float

    @classmethod
    def of(cls, v: Float, sent: Float, back: Float) -> _Law:
        """v (n,) of rows; sent and fed back (2 `TAPS` + 1, n) as `_beside` has them."""
        known = np.isfinite(v + sent.sum(axis=0) + back.sum(axis=0))
        if not known.all():
            v, sent, back = v[known], sent[:, known], back[:, known]
        if v.size <= 2 * FARTHEST:
            return cls(0, *[np.nan] * 6)
        v = v - v.mean()
        sent, back = (x - x.mean(axis=1, keepdims=True) for x in (sent, back))
        law, kept = (sent + back).T, np.ones(v.size, bool)
        for _ in range(2):  # again without spikes
            taps = np.linalg.lstsq(law[kept], v[kept], rcond=None)[0]
            rest = v - law @ taps
            kept = np.abs(rest) <= SPIKE * np.median(np.abs(rest))
        b = (taps @ back)[kept]
        own = float((v - taps @ sent)[kept] @ b) / max(float(b @ b), np.finfo(float).tiny)
        left = float(np.mean(rest[kept] ** 2))
        rest = np.where(kept, rest, 0.0)
        alike = float(rest[1:] @ rest[:-1]) / max(float(rest @ rest), np.finfo(float).tiny)
        gain, late = float(taps.sum()), float(taps @ np.arange(-TAPS, TAPS + 1))
        part = left / max(float(np.mean(b**2)), 1e-300)
        return cls(v.size, left, part, alike, own, gain, late)

    @property
    def known(self) -> bool:
        return math.isfinite(self.left)

    def apart(self, law: _Law, rounded: float) -> float:
        """Log likelihood of another law over this one, as far as rounding shows them apart; of any
        over one that the filter delays."""
        if not self.centred:
            return math.inf
        return 0.5 * self.rows * math.log(max(self.left, rounded) / max(law.left, rounded))

    @property
    def centred(self) -> bool:
        """No law of another shift, that the filter delays."""
        return abs(self.late) < CENTRED

    @property
    def holds(self) -> bool:
        """What it leaves is little, or a meter's noise; another loop leaves what moves slowly."""
        rest = self.part < LEFT**2 or abs(self.alike) < LEFT
        return rest and self.centred and abs(self.fed - 1) < LEFT and abs(self.gain - 1) < LEFT


def _hidden(channel: Channel, x: Float) -> bool:
    """Whether a channel with values x (n,) moves by less than its step."""
    return steps_moved(channel, x[np.isfinite(x)]) < LEAST_STEPS


def _unclipped(v: Float) -> NDArray[np.bool_]:
    """(n,) whether a command v (n,), and those that a voltmeter shows with it, are below a limit
    wherever that is."""
    size = np.abs(np.nan_to_num(v))
    high = size > UNCLIPPED * np.max(size, initial=0.0)
    return np.asarray(~ndimage.binary_dilation(high, iterations=TAPS + 1))


def _beside(x: Float) -> Float:
    """(2 `TAPS` + 1, n) of x its rows to each side, where every shift has some."""
    inside = slice(FARTHEST + TAPS, x.size - FARTHEST - TAPS)
    return np.stack([np.roll(x, j)[inside] for j in range(-TAPS, TAPS + 1)])


def asked(recording: Recording, command: str, kp: float, rows: slice = slice(None)) -> Float:
    """(n,) u + kp theta_ref in the unit of the command, in these rows: all references, each of a
    command or of an angle."""
    unit = recording.channels[recording.column(command)].unit
    out = np.zeros(recording.sequence[rows].size)
    for name in recording.names("reference"):
        column = recording.column(name)
        alike = recording.channels[column].unit == unit
        out += (1.0 if alike else kp) * recording.values[rows, column]
    return out


def of_input(recording: Recording, command: str) -> Recording:
    """The same recording, of one input alone: other commands, and references of these, are read
    beside it. A reference is that of the command that its name ends with."""
    others = [n for n in recording.names("command") if n != command]
    if not others:
        return recording
    mine = f"_{command}"
    channels = tuple(
        c
        if c.role not in SENT or c.name == command or c.name.endswith(mine)
        else replace(c, role="monitor")
        for c in recording.channels
    )
    return replace(recording, channels=channels)


def proportional(v: Float, w: Float) -> bool:
    """Whether two inputs (n,) are one, but for a positive factor."""
    across, powers = float(v @ w), float(v @ v) * float(w @ w)
    return across > 0 and across**2 > (1 - ALIKE**2) * powers


def aligned(recordings: Sequence[Recording]) -> list[tuple[Recording, Finding | None]]:
    """Recordings whose rows hold what was sent and measured at one time, and what was done: by the
    law of the loop; where that shows nothing, so that all answer alike."""
    law = "by the loop's own law what was measured stands"
    out = [_moved(r, shift_of(r), law) for r in recordings]
    alike: dict[object, list[int]] = {}
    for i, (r, _) in enumerate(out):
        alike.setdefault((driving(r), r.rate_hz), []).append(i)
    for those in alike.values():
        _set_beside(out, those)
    return out


def _set_beside(out: list[tuple[Recording, Finding | None]], those: Sequence[int]) -> None:
    """Of recordings that compare, those that no law moved stand as those that one did; else as
    most of them do."""
    ruled = [i for i in those if out[i][1]]
    those = [*ruled[:1], *(i for i in those if i not in ruled)]
    if len(those) == 1:
        return
    by = compared([out[i][0] for i in those])
    most = by[0] if ruled else Counter(by).most_common(1)[0][0]
    beside = out[those[by.index(most)]][0].source or "another recording"
    for i, m in zip(those, by, strict=True):
        if i not in ruled:
            out[i] = _moved(out[i][0], m - most, f"beside {beside} what was measured stands")


def _moved(recording: Recording, m: int, law: str) -> tuple[Recording, Finding | None]:
    if m == 0:
        return recording, None
    sequence = recording.sequence
    there = np.searchsorted(sequence, sequence + m)
    kept = np.flatnonzero(there < sequence.size)
    kept = kept[sequence[there[kept]] == sequence[kept] + m]
    measured = [i for i, c in enumerate(recording.channels) if c.role not in SENT]
    values, quality = recording.values[kept].copy(), recording.quality[kept].copy()
    values[:, measured] = recording.values[np.ix_(there[kept], measured)]
    quality[:, measured] = recording.quality[np.ix_(there[kept], measured)]
    moved = replace(
        recording,
        time=recording.time[kept],
        sequence=sequence[kept],
        values=values,
        quality=quality,
        segments=tuple(_within(recording, sequence[kept])),
    )
    late = f"{abs(m)} sample{'s' * (abs(m) > 1)} {'later' if m > 0 else 'earlier'}"
    text = f"{recording.source or 'recording'}: {law} {late} than what was sent; set right"
    return moved, Finding("timing", "warning", text)


def _about_the_largest(recording: Recording, references: tuple[str, ...]) -> slice:
    size = np.max(np.abs(np.nan_to_num(recording.columns(references))), axis=1, initial=0.0)
    middle = int(np.argmax(size)) if size.size and size.max() > 0 else 0
    first = max(0, min(middle - LOOKED_AT // 2, size.size - LOOKED_AT))
    return slice(first, min(first + LOOKED_AT, size.size) if size.size and size.max() > 0 else 0)


def _within(recording: Recording, sequence: Int) -> list[Any]:
    """The segments, without samples at the ends that no row holds any more."""
    if not sequence.size:
        return []
    low, high = int(sequence[0]), int(sequence[-1]) + 1
    return [replace(s, start=max(s.start, low), stop=min(s.stop, high)) for s in recording.segments]
