"""Recordings as pieces: a stretch of samples that a model can predict from the input alone."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from samii_rig.errors import EstimateError
from samii_rig.likelihood import inputs, spikes
from samii_rig.rig.schema import Rig
from samii_rig.signal.columns import is_open, proportional
from samii_rig.signal.groups import segments_of
from samii_rig.types import Float, Quality, Recording, Segment

SPOILT = Quality.MISSING | Quality.CLIPPED | Quality.STALE
LEAST_SAMPLES = 256  # fewer say nothing of a structure


@dataclass(frozen=True, slots=True)
class Samples:
    """r (history + n,) input, z (n, q) sensors."""

    r: Float
    z: Float


@dataclass(frozen=True, slots=True)
class Command:
    """What one of the records behind a piece told the rig, and its part in the piece.

    v : (history + n,) as recorded. part : the piece's r and z have so many times this record's.
    """

    v: Float
    part: float


@dataclass(frozen=True, slots=True)
class Piece:
    """One stretch of samples; of several whose inputs are proportional, what tells the response.

    Proportional inputs c_i r and their sensors z_i are turned by an orthonormal matrix whose first
    row is c/|c|: the first sum has all of the input and the noise of one record, the others have
    next to no input and tell noise (`repeats`) or what changes with the level (`contrasts`).

    r : (history + n,) input of the loop, or of the rig where none is closed; the rig is at rest
        before it, unless `moving`. z : (n, q) sensors. history : samples of input before them.
    levels : as the segments state them, with their unit.
    commands : of all records that the piece is a sum of. struck : spikes of each sensor in them.
    edges : samples of r at which the input jumps at an instant within them that nobody knows.
    """

    name: str
    r: Float
    z: Float
    history: int
    levels: tuple[tuple[float, str], ...]
    moving: bool = False
    repeats: tuple[Samples, ...] = ()
    contrasts: tuple[Samples, ...] = ()
    commands: tuple[Command, ...] = ()
    struck: tuple[int, ...] = ()
    edges: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Wiring:
    """Which columns are read, and how the loop runs: v = r - kp theta, if kp is not 0."""

    command: str
    sensors: tuple[str, ...]
    centring: str
    kp: float


def wiring(
    recordings: Sequence[Recording], rig: Rig, sensors: Collection[str] | None = None
) -> Wiring:
    """The columns of all recordings that the rig file knows, of `sensors` alone if given.

    Raises EstimateError where they have no sensor or no command in common, where they have several
    commands, or where the loop is closed around a sensor that is left out.
    """
    known = [s.name for s in rig.sensor]
    common = set.intersection(*({c.name for c in r.channels} for r in recordings))
    asked = common if sensors is None else common & set(sensors)
    found = tuple(n for n in known if n in asked)
    commands = [a.name for a in rig.actuator if a.name in common]
    if not found or not commands:
        raise EstimateError("the recordings have no command and no sensor of the rig in common")
    if len(commands) > 1:
        raise EstimateError(
            f"the recordings have {len(commands)} commands, {', '.join(commands)}; expected one, "
            "as whole records are predicted from a single input"
        )
    (command,) = commands
    centring = rig.centring
    if centring is None or centring.sensor not in common or rig.feedback:
        return Wiring(command, found, "", 0.0)
    if centring.sensor not in found:
        raise EstimateError(f"the loop is closed around {centring.sensor}, which is left out")
    sensor, kp = centring.sensor, centring.kp
    if all(is_open(recording, command, sensor, kp) for recording in recordings):
        return Wiring(command, found, "", 0.0)
    return Wiring(command, found, sensor, kp)


def pieces_of(
    recordings: Sequence[Recording],
    rig: Rig,
    wired: Wiring,
    without: Collection[str] = (),
    *,
    apart: bool = False,
) -> list[Piece]:
    """Every segment as a piece, those with proportional inputs as one. without : places of
    segments to leave out, as `Recording.place` gives them. apart : of one level only, for what
    depends on the level.

    The input of the loop is v + kp theta as they were recorded: it holds the reference, the
    rounding and the clipping of the command, and nothing of the sensors' noise.
    """
    steps = {s.name: s.resolution for s in rig.sensor}
    step = np.array([steps[n] for n in wired.sensors])
    found: list[Piece] = []
    for recording in recordings:
        columns = [recording.column(n) for n in (wired.command, *wired.sensors)]
        values = recording.values[:, columns]
        bad = (recording.quality[:, columns] & SPOILT) != 0
        bad[:, 0] = False  # what went out is known, limited or not
        whole = np.all(np.isfinite(values) & ~bad, axis=1)
        theta = values[:, 1 + wired.sensors.index(wired.centring)] if wired.kp else None
        values[:, 0], edges = inputs.sent(recording, columns[0], wired.kp, theta)
        if round(rig.rate_hz / recording.rate_hz) > 1:
            edges = edges | inputs.jumps(recording, columns[0], wired.kp, theta)
        r = values[:, 0].copy()
        if theta is not None:
            r += wired.kp * theta
        if not recording.names("reference"):
            r = inputs.calibrated(r, recording.channels[columns[0]].resolution)
        for segment in segments_of(recording):
            if recording.place(segment) in without:
                continue
            found += _cut(recording, segment, r, values, whole, edges, step)
    repeats = _joined(found, levels=False)
    return repeats if apart else joined(repeats)


def joined(pieces: list[Piece]) -> list[Piece]:
    """Pieces of different levels with proportional inputs as one."""
    return _joined(pieces, levels=True)


def _cut(
    recording: Recording,
    segment: Segment,
    r: Float,
    values: Float,
    whole: NDArray[np.bool_],
    edges: NDArray[np.bool_],
    step: Float,
) -> list[Piece]:
    """The stretches of a segment between gaps, each with the input before it. values : of the
    command, then of the sensors. step : of the sensors' converters."""
    a, b = np.searchsorted(recording.sequence, [segment.start, segment.stop])
    jumps = np.flatnonzero(np.diff(recording.sequence) != 1) + 1
    ends = np.unique(np.concatenate([jumps, np.flatnonzero(np.diff(whole.astype(np.int8))) + 1]))
    out = []
    for start, stop in pairwise([0, *ends.tolist(), len(r)]):
        low, high = max(start, int(a)), min(stop, int(b))
        if high - low < LEAST_SAMPLES or not whole[low]:
            continue
        history = min(low - start, high - low)
        # Whatever came before the history may still ring.
        moving = low > history
        name = recording.place(segment)
        part = r[low - history : high]
        level = (segment.level, segment.unit)
        told = Command(values[low - history : high, 0].copy(), 1.0)
        z, struck = spikes.mended(values[low:high, 1:], step)
        piece = Piece(name, part, z, history, (level,), moving, commands=(told,))
        at = tuple(np.flatnonzero(edges[low - history : high]).tolist())
        out.append(replace(piece, struck=tuple(struck.tolist()), edges=at))
    return out


def _joined(pieces: list[Piece], *, levels: bool) -> list[Piece]:
    """Pieces with proportional inputs, of one level or of any, as one."""
    groups: list[list[Piece]] = []
    for piece in pieces:
        for group in groups:
            if _proportional(group[0], piece, levels=levels):
                group.append(piece)
                break
        else:
            groups.append([piece])
    return [_turned(group, levels=levels) if len(group) > 1 else group[0] for group in groups]


def _proportional(one: Piece, other: Piece, *, levels: bool) -> bool:
    alike = (one.r.size, one.history, one.moving) == (other.r.size, other.history, other.moving)
    if not alike:
        return False
    if not levels and one.levels != other.levels:
        return False
    return proportional(one.r, other.r)


def _turned(group: list[Piece], *, levels: bool) -> Piece:
    first = group[0]
    c = np.array([p.r @ first.r for p in group])
    # The first row of U^T of a Householder reflection that sends c to its own axis.
    U = np.linalg.qr(np.column_stack([c, np.eye(c.size)[:, 1:]]))[0].T
    U[0] *= np.sign(U[0] @ c)
    r = U @ np.stack([p.r for p in group])
    z = np.tensordot(U, np.stack([p.z for p in group]), axes=1)
    others = tuple(Samples(r[i], z[i]) for i in range(1, len(group)))
    return Piece(
        first.name,
        r[0],
        z[0],
        first.history,
        tuple(dict.fromkeys(level for p in group for level in p.levels)),
        first.moving,
        tuple(s for p in group for s in p.repeats) + (() if levels else others),
        tuple(s for p in group for s in p.contrasts) + (others if levels else ()),
        tuple(
            Command(told.v, float(part) * told.part)
            for part, p in zip(U[0], group, strict=True)
            for told in p.commands
        ),
        tuple(np.sum([p.struck for p in group], axis=0).tolist()),
        tuple(sorted({edge for p in group for edge in p.edges})),
    )
