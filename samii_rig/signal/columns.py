"""Columns that a logger shifted by whole samples against each other.

Where the loop's law v[k] = u[k] + kp (theta_ref[k] - theta[k]) is known, u, v and theta of one
sample fulfil it to the rounding. If they do so only with theta[k + m], what was measured stands m
rows behind what was sent: each row is read at another time than the one before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.load import tables
from samii_rig.types import Finding, Float, Int, Recording

FARTHEST = 5  # samples; a logger that is later has another fault
LEFT = 0.2  # part of what is fed back, or of a command's size, by which a law that holds is off
# Of the power by which two runs differ, what a shift leaves at most, and samples by which it may
# look as if it were not whole: where noise has a tenth of that power, by 0.05.
HALF, WHOLE = 0.5, 0.15
# Of a law that holds, log likelihood by which a shift is seen: 1e-5 by chance among eleven.
SEEN = 14.0
# Part of a command's step that rounding leaves, and medians from which a residual is a spike.
ROUNDED, SPIKE = 0.3, 8.0
TAPS = 1  # rows to each side of which what a voltmeter shows of a command is made
# Rows of that filter's delay: a voltmeter between two commands has half a row, another shift one.
CENTRED = 0.75
ALIKE = 0.02  # part of an input that is not proportional to another, below which it is the same
KNOWN = 0.5  # part of the rows of two recordings, below which too little is known of either
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
    centring = centring_of(recording)
    first = next(iter(recording.names("command")), "")
    recording = of_input(recording, first)
    names = {c.name: c for c in recording.channels}
    command, references = recording.names("command"), recording.names("reference")
    if centring is None or centring[0] not in names or len(command) != 1 or not references:
        return 0
    sensor, kp = centring
    around = _about_the_largest(recording, references)
    if around.stop - around.start <= 2 * FARTHEST:
        return 0

    theta, v = (recording.values_of(name)[around] for name in (sensor, command[0]))
    sent = _beside(asked(recording, command[0], kp, around))
    v = v[FARTHEST + TAPS : v.size - FARTHEST - TAPS]
    shifts = range(-FARTHEST, FARTHEST + 1)
    laws = [_Law.of(v, sent, _beside(-kp * np.roll(theta, -m))) for m in shifts]
    if not all(law.known for law in laws):
        return 0
    left = [law.left if law.centred else math.inf for law in laws]
    best = int(np.argmin(left))
    if not laws[best].holds:
        return 0
    rounded = (ROUNDED * names[command[0]].resolution) ** 2
    gain = 0.5 * theta.size * np.log(max(left[FARTHEST], rounded) / max(left[best], rounded))
    return shifts[best] if gain > SEEN else 0


@dataclass(frozen=True)
class _Law:
    """v = F (sent + fed back), F a short filter: a voltmeter shows what is between two commands.

    left : variance of the rest, without spikes; part : the same of what is fed back. alike :
    correlation of the rest with the sample before. fed, gain : what v holds of `fed back`, and the
    filter's gain; both 1 where the law holds. late : rows of the filter's delay.
    """

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
            return cls(*[np.nan] * 6)
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
        return cls(left, part, alike, own, gain, late)

    @property
    def known(self) -> bool:
        return math.isfinite(self.left)

    @property
    def centred(self) -> bool:
        """No law of another shift, that the filter delays."""
        return abs(self.late) < CENTRED

    @property
    def holds(self) -> bool:
        """What it leaves is little, or a meter's noise; another loop leaves what moves slowly."""
        rest = self.part < LEFT**2 or abs(self.alike) < LEFT
        return rest and self.centred and abs(self.fed - 1) < LEFT and abs(self.gain - 1) < LEFT


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
    law of the loop; where that shows nothing, so that all answer the same input alike."""
    law = "by the loop's own law what was measured stands"
    own = [_moved(r, shift_of(r), law) for r in recordings]
    out: list[tuple[Recording, Finding | None]] = []
    for recording, said in own:
        first = next((r for r, _ in out if _alike(r, recording)), None)
        if said is None and first is not None:
            m = _against(first, recording)
            said_of = f"beside {first.source or 'another recording'} what was measured stands"
            recording, said = _moved(recording, m, said_of)
        out.append((recording, said))
    return out


def _alike(one: Recording, other: Recording) -> bool:
    """Whether two recordings are of one input, but for its size."""
    names = _driving(one)
    if names != _driving(other) or not names:
        return False
    v, w = _overlap(one, other, names)
    known = np.isfinite(v).all(axis=1) & np.isfinite(w).all(axis=1)
    v, w = v[known], w[known]
    if len(v) <= max(2 * FARTHEST, KNOWN * known.size):
        return False
    if len(names) > 1:  # each in units of its largest, by which they compare
        size = np.max(np.abs(np.concatenate([v, w])), axis=0)
        v, w = (x / np.where(size > 0, size, 1.0) for x in (v, w))
    return proportional(v.ravel(), w.ravel())


def _driving(recording: Recording) -> list[str]:
    """Columns that drive a run: references that move, in which no loop is, or the commands."""
    references = [n for n in recording.names("reference") if np.ptp(recording.values_of(n)) > 0]
    return references or list(recording.names("command"))


def _overlap(one: Recording, other: Recording, names: Sequence[str]) -> tuple[Float, Float]:
    """(n, p) these columns in the first segments of both, row by row from their starts; no row
    where these are not as long, but for the ends that a shift takes."""
    a, b = _first(one, names), _first(other, names)
    n = min(len(a), len(b)) if abs(len(a) - len(b)) <= 2 * FARTHEST else 0
    return a[:n], b[:n]


def _first(recording: Recording, names: Sequence[str]) -> Float:
    """(n, p) these columns in the first segment, in the whole where none is known; NaN in rows that
    are missing."""
    sequence = recording.sequence
    if not sequence.size:
        return np.zeros((0, len(names)))
    start, stop = int(sequence[0]), int(sequence[-1]) + 1
    if recording.segments:
        start, stop = recording.segments[0].start, recording.segments[0].stop
    a, b = (int(x) for x in np.searchsorted(sequence, [start, stop]))
    out = np.full((stop - start, len(names)), np.nan)
    out[sequence[a:b] - start] = recording.columns(names)[a:b]
    return out


def _against(first: Recording, recording: Recording) -> int:
    """Samples by which the sensors of a recording stand behind those of another of the same input;
    0 where no shift makes them clearly more alike."""
    driving = _driving(first)[0]
    names = [n for n in first.names("sensor") if n in recording.names("sensor")]
    x, y = _overlap(first, recording, [driving, *names])
    known = np.isfinite(x[:, 0]) & np.isfinite(y[:, 0])
    size = float(x[known, 0] @ y[known, 0]) / float(x[known, 0] @ x[known, 0])
    x, y = size * x[:, 1:], y[:, 1:]
    x, y = (z - np.nanmean(z, axis=0) for z in (x, y))
    inside = slice(FARTHEST, len(x) - FARTHEST)
    off = np.array(
        [
            np.nanmean((np.roll(y, -m, axis=0) - x)[inside] ** 2, axis=0)
            for m in range(-FARTHEST, FARTHEST + 1)
        ]
    ).T
    off = off[np.all(off > 0, axis=1)]
    if not len(off):
        return 0
    # A sensor that shows next to nothing but noise has no say.
    best = int(np.argmin(np.sum(np.log(off), axis=0)))
    clear = np.min(off[:, best] / off[:, FARTHEST]) < LEFT or _is_whole(off, best)
    return best - FARTHEST if clear else 0


def _is_whole(off: Float, best: int) -> bool:
    """Whether sensors have their least at a shift itself, not between two: what else lets them
    answer later does not do so by whole samples. off : (q, shifts) what each leaves of them."""
    if best in (0, off.shape[1] - 1):
        return False
    before, least, behind = off[:, best - 1 : best + 2].T
    seen = least < HALF * off[:, FARTHEST]
    # Of a parabola through three shifts the least is at (before - behind)/2 over its bend.
    whole = np.abs(before - behind) < 2 * WHOLE * (before - 2 * least + behind)
    return bool(seen.any() and np.all(whole[seen]))


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
