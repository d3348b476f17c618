"""Columns that a logger shifted by whole samples against each other.

Where the loop's law v[k] = u[k] + kp (theta_ref[k] - theta[k]) is known, u, v and theta of one
sample fulfil it to the rounding. If they do so only with theta[k + m], what was measured stands m
rows behind what was sent: each row is read at another time than the one before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.load import tables
from samii_rig.types import Finding, Float, Int, Recording

FARTHEST = 5  # samples; a logger that is later has another fault
# Of what no shift leaves of the law, what the right one leaves at most: a command that is measured
# keeps a few per cent. One that is rounded keeps a quarter of its step in the median, and a shift
# that is seen above that leaves a fifth more.
LEFT, ROUNDED, SEEN = 0.2, 0.3, 1.2
ALIKE = 0.02  # part of an input that is not proportional to another, below which it is the same
LOOKED_AT = 1 << 14  # samples about the largest reference: thousands tell a shift, millions cost
SENT = ("reference", "command")  # roles of columns that are sent, not measured


def centring_of(recording: Recording) -> tuple[str, float] | None:
    """Sensor and kp of the centring in the rig file that a recording carries, None without one."""
    try:
        centring: Any = tables(recording.rig_toml, "rig file")["centring"]
        sensor, kp = centring["sensor"], centring["kp"]
    except (InputError, KeyError, TypeError):
        return None
    return (str(sensor), float(kp)) if isinstance(kp, int | float) and kp > 0 else None


def shift_of(recording: Recording) -> int:
    """Samples by which what was measured stands behind what was sent; 0 where the law of the loop
    does not tell."""
    centring = centring_of(recording)
    names = {c.name: c for c in recording.channels}
    command, references = recording.names("command"), recording.names("reference")
    if centring is None or centring[0] not in names or len(command) != 1 or not references:
        return 0
    sensor, kp = centring
    around = _about_the_largest(recording, references)
    if around.stop - around.start <= 2 * FARTHEST:
        return 0

    def column(name: str) -> Float:
        return np.asarray(recording.values[around, recording.column(name)], np.float64)

    scale = {n: 1.0 if names[n].unit == names[command[0]].unit else kp for n in references}
    r = sum((scale[n] * column(n) for n in references), np.zeros(around.stop - around.start))
    theta, rest = column(sensor), column(command[0]) - r
    inside = slice(FARTHEST, theta.size - FARTHEST)
    shifts = range(-FARTHEST, FARTHEST + 1)
    off = [float(np.nanmedian(np.abs(rest + kp * np.roll(theta, -m))[inside])) for m in shifts]
    if not np.isfinite(off).all():
        return 0
    best, none = int(np.argmin(off)), off[FARTHEST]
    exact = off[best] <= ROUNDED * names[command[0]].resolution and none > SEEN * off[best]
    return shifts[best] if exact or off[best] < LEFT * none else 0


def aligned(recordings: Sequence[Recording]) -> list[tuple[Recording, Finding | None]]:
    """Recordings whose rows hold what was sent and measured at one time, and what was done: by the
    law of the loop; where that tells nothing, so that all answer the same input alike."""
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
    a, b = _command(one), _command(other)
    n = min(a.size, b.size)
    if one.names("command") != other.names("command") or n < max(a.size, b.size) - 2 * FARTHEST:
        return False
    a, b = a[:n], b[:n]
    across, powers = float(a @ b), float(a @ a) * float(b @ b)
    return across > 0 and across**2 > (1 - ALIKE**2) * powers


def _command(recording: Recording) -> Float:
    """(n,) of the first segment; nothing where that has gaps."""
    name = next(iter(recording.names("command")), "")
    span = _first(recording)
    if not name or span is None:
        return np.zeros(0)
    v = recording.values[span, recording.column(name)]
    return np.asarray(v, np.float64) if np.all(np.isfinite(v)) else np.zeros(0)


def _first(recording: Recording) -> slice | None:
    """The rows of the first segment, and of all where none is told."""
    if not recording.segments:
        return slice(0, recording.sequence.size)
    first = recording.segments[0]
    a, b = np.searchsorted(recording.sequence, [first.start, first.stop])
    span = slice(int(a), int(b))
    whole = b > a and recording.sequence[b - 1] - recording.sequence[a] == b - 1 - a
    return span if whole else None


def _against(first: Recording, recording: Recording) -> int:
    """Samples by which the sensors of a recording stand behind those of another of the same input;
    0 where no shift makes them clearly more alike."""
    a, b = _first(first), _first(recording)
    assert a is not None
    assert b is not None
    names = [n for n in first.names("sensor") if n in recording.names("sensor")]
    v, w = _command(first), _command(recording)
    n = min(v.size, w.size)
    size = float(v[:n] @ w[:n]) / float(v[:n] @ v[:n])
    inside = slice(FARTHEST, n - FARTHEST)
    off = np.zeros((len(names), 2 * FARTHEST + 1))
    for row, name in zip(off, names, strict=True):
        x, y = (
            size * first.values[a, first.column(name)],
            recording.values[b, recording.column(name)],
        )
        x, y = (np.nan_to_num(z[:n] - np.nanmean(z)) for z in (x, y))
        for i, m in enumerate(range(-FARTHEST, FARTHEST + 1)):
            row[i] = np.mean((np.roll(y, -m) - x)[inside] ** 2)
    off = off[np.all(off > 0, axis=1)]
    if not len(off):
        return 0
    # A sensor that shows next to nothing but noise has no say.
    best = int(np.argmin(np.sum(np.log(off), axis=0)))
    return best - FARTHEST if np.min(off[:, best] / off[:, FARTHEST]) < LEFT else 0


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
    columns = [recording.column(n) for n in references]
    size = np.max(np.abs(np.nan_to_num(recording.values[:, columns])), axis=1, initial=0.0)
    middle = int(np.argmax(size)) if size.size and size.max() > 0 else 0
    first = max(0, min(middle - LOOKED_AT // 2, size.size - LOOKED_AT))
    return slice(first, min(first + LOOKED_AT, size.size) if size.size and size.max() > 0 else 0)


def _within(recording: Recording, sequence: Int) -> list[Any]:
    """The segments, without samples at the ends that no row holds any more."""
    if not sequence.size:
        return []
    low, high = int(sequence[0]), int(sequence[-1]) + 1
    return [replace(s, start=max(s.start, low), stop=min(s.stop, high)) for s in recording.segments]
