"""Recordings as pieces: a stretch of samples that a model can predict from the input alone."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from samii_rig.errors import EstimateError
from samii_rig.likelihood import inputs, spikes
from samii_rig.likelihood.bridged import MOST_GAPS, Bridged, bridge
from samii_rig.likelihood.outside import followed, outside
from samii_rig.rig.schema import Rig
from samii_rig.signal.columns import is_open, of_input, proportional
from samii_rig.signal.groups import segments_of
from samii_rig.signal.several.undriven import driven_of
from samii_rig.types import Float, Int, Quality, Recording, Segment

SPOILT = Quality.MISSING | Quality.CLIPPED | Quality.STALE
LEAST_SAMPLES = 256  # fewer say nothing of a structure
# Samples of a piece: a longer stretch is several, so that work grows as its length does. A minute
# at 1 kHz, in which all that rings comes to rest or is well determined.
LONGEST = 2**16
SHORT_DFT = 4096  # samples of a piece whose DFT takes a millisecond at most
# Samples: across a longer gap whose input is a guess there are more nuisances than where a piece
# begins, and no more is known of the motion behind it.
GUESSED = 64
KNOWN = 1e-3  # of an input's rms, how far off lost samples of it may be that count as known


Loops = tuple[tuple[float, int, int], ...]
"""Of each loop that runs kp, the sensor that it reads, the input that it drives."""


@dataclass(frozen=True, slots=True)
class Samples:
    """r (history + n,) input or (history + n, m) of m inputs, z (n, q) sensors, mended where some
    samples were taken for spikes."""

    r: Float
    z: Float
    struck: tuple[spikes.Spike, ...] = ()


@dataclass(frozen=True, slots=True)
class Command:
    """What one of the records behind a piece told the rig, and its part in the piece.

    v : as recorded, of the shape of r. part : the piece's r and z have so many times this record's.
    meter : of each input, what is left is in v and r. follows : Hz up to which it follows what
    moves it from outside, not what a loop makes of noise.
    """

    v: Float
    part: float
    meter: tuple[inputs.MeterNoise, ...]
    follows: float = np.inf


@dataclass(frozen=True, slots=True)
class Piece:
    """One stretch of samples; of several with proportional inputs, what determines the response.

    Proportional inputs c_i r and their sensors z_i are turned by an orthonormal matrix whose first
    row is c/|c|: the first sum has all of the input and the noise of one record, the others have
    next to no input and show noise (`repeats`) or what changes with the level (`contrasts`).

    r : (history + n,) input of the loop, or of the rig where none is closed; (history + n, m) of a
        rig of m inputs. The rig is at rest before it, unless `moving`.
    z : (n, q) sensors. history : samples of input before them.
    levels : as the segments state them, with their unit.
    commands : of all records that the piece is a sum of. struck : as of `Samples`, in it.
    edges : (sample of r, input) at which that input jumps or turns at an instant that nobody
        knows, within the sample or, of two that follow one another, between them.
    lost : (first, behind the last) samples of z that were not recorded, nor their input, which
        stands in r as it most likely was. unknown : those of them whose input does not follow from
        that before and after.
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
    struck: tuple[spikes.Spike, ...] = ()
    edges: tuple[tuple[int, int], ...] = ()
    lost: tuple[tuple[int, int], ...] = ()
    unknown: tuple[tuple[int, int], ...] = ()

    @property
    def follows(self) -> float:
        """As of `Command`, of the one that follows furthest."""
        return max(told.follows for told in self.commands)

    @property
    def inputs(self) -> int:
        """How many inputs the rig has."""
        return 1 if self.r.ndim == 1 else self.r.shape[1]


@dataclass(frozen=True, slots=True)
class Input:
    """An input of the rig and the loop around it: v = r - kp theta, if kp is not 0.

    command : its column. centring : the column of theta. driven : whether any reference moves it;
    of what its loop alone does, rounded by its converter, the sensors' noise is a part.
    """

    command: str
    centring: str = ""
    kp: float = 0.0
    driven: bool = True


@dataclass(frozen=True, slots=True)
class Wiring:
    """Which columns are read. inputs : in the rig file's order."""

    inputs: tuple[Input, ...]
    sensors: tuple[str, ...]

    @property
    def only(self) -> Input:
        """The input of a rig that has one."""
        (one,) = self.inputs
        return one

    def column(self, command: str) -> int:
        """Which of the inputs a command is."""
        return [x.command for x in self.inputs].index(command)

    @property
    def loops(self) -> Loops:
        """Those that run."""
        each = enumerate(self.inputs)
        return tuple((x.kp, self.sensors.index(x.centring), j) for j, x in each if x.kp)


def wiring(
    recordings: Sequence[Recording],
    rig: Rig,
    sensors: Collection[str] | None = None,
    hidden: Collection[str] = (),
) -> Wiring:
    """The columns of all recordings that the rig file knows, of `sensors` alone if given.

    hidden : sensors that show next to nothing but their converter's steps. A loop around one of
    them does nothing that its command does not show: that is an input as of an open loop, and the
    rest of the noise has not gone round.
    An input is a command that any of them has. Where one has no column of it, it rested there.

    Raises EstimateError where they have no sensor in common or no command, where a loop is closed
    around a sensor that is left out, or around an input that one of them has no column of.
    """
    known = [s.name for s in rig.sensor]
    common = set.intersection(*({c.name for c in r.channels} for r in recordings)) - set(hidden)
    asked = common if sensors is None else common & set(sensors)
    found = tuple(n for n in known if n in asked)
    having = [a.name for a in rig.actuator if any(_has(r, a.name) for r in recordings)]
    # A command that never leaves zero drives nothing.
    commands = [n for n in having if any(_moves(r, n) for r in recordings)] or having[:1]
    if not found or not commands:
        raise EstimateError("the recordings have no command and no sensor of the rig in common")
    _, undriven = driven_of([r for r in recordings if all(_has(r, n) for n in commands)], commands)
    each = [_input(recordings, rig, n, common, found) for n in commands]
    return Wiring(tuple(replace(x, driven=x.command not in undriven) for x in each), found)


def _input(
    recordings: Sequence[Recording],
    rig: Rig,
    command: str,
    common: Collection[str],
    found: Collection[str],
) -> Input:
    """An input and the loop that runs around it. common : columns of all recordings, but for
    hidden ones. found : the sensors that are read."""
    centring = rig.centring_of(command)
    if centring is None or centring.sensor not in common or rig.feedback:
        return Input(command)
    if centring.sensor not in found:
        raise EstimateError(f"the loop is closed around {centring.sensor}, which is left out")
    sensor, kp = centring.sensor, centring.kp
    for recording in recordings:
        if not _has(recording, command):
            raise EstimateError(
                f"{recording.source or 'a recording'} has no column {command}; expected one, as "
                f"the rig file closes a loop from {sensor} to it"
            )
    closed = Input(command, sensor, kp)
    return Input(command) if all(_is_open(r, closed) for r in recordings) else closed


def _is_open(recording: Recording, x: Input) -> bool:
    """Whether no loop ran, also where a meter recorded the command: late, and with noise."""
    if is_open(of_input(recording, x.command), x.command, x.centring, x.kp):
        return True
    meter = _meter(recording, x)
    return meter is not None and meter.kp == 0


def _meter(recording: Recording, x: Input) -> inputs.Meter | None:
    """What a meter showed of an input, as of `inputs.Meter.of`."""
    theta = recording.values_of(x.centring) if x.kp else None
    own = of_input(recording, x.command)
    return inputs.Meter.of(own, own.column(x.command), x.kp, theta)


def _has(recording: Recording, name: str) -> bool:
    return any(c.name == name for c in recording.channels)


def _moves(recording: Recording, command: str) -> bool:
    return _has(recording, command) and recording.largest(command) > 0


def pieces_of(
    recordings: Sequence[Recording],
    rig: Rig,
    wired: Wiring,
    without: Collection[str] = (),
    *,
    by_level: bool = False,
    times: int = 0,
) -> list[Piece]:
    """Every segment as a piece, those with proportional inputs as one. without : places of
    segments to leave out, as `Recording.place` gives them. by_level : of one level only, for what
    depends on the level. times : as of `faster`.

    The input of the loop is v + kp theta as they were recorded: it holds the reference, the
    rounding and the clipping of the command, and nothing of the sensors' noise.
    """
    steps = {s.name: s.resolution for s in rig.sensor}
    step = np.array([steps[n] for n in wired.sensors])
    found: list[Piece] = []
    for recording in recordings:
        known = _known(recording, wired)
        if not known.any():
            continue
        whole = Bridged.of(recording, known, _driving_columns(recording, wired))
        # By the rig file, or as a meter shows, though not always by how much.
        slower = round(rig.rate_hz / recording.rate_hz) > 1 or _ran_faster(recording, wired)
        samples = _Samples.of(whole, rig, wired, slower=slower, times=times)
        for segment in segments_of(recording):
            if recording.place(segment) in without:
                continue
            found += _cut(recording, segment, samples, step)
    repeats = _joined(found, levels=False)
    return repeats if by_level else joined(repeats)


def faster(recordings: Sequence[Recording], wired: Wiring) -> int:
    """How often the rig's loop ran for each sample that was recorded, by what a meter shows of its
    commands; 0 where these were recorded as they were sent, or do not show it."""
    return inputs.times_of([meter for r in recordings for meter in _meters(r, wired)])


def _ran_faster(recording: Recording, wired: Wiring) -> bool:
    """Whether a meter shows that the loop of an input ran faster than it was recorded."""
    return any(meter is not None and meter.faster for meter in _meters(recording, wired))


def _meters(recording: Recording, wired: Wiring) -> Iterator[inputs.Meter | None]:
    """What a meter showed of each input that was recorded."""
    return (_meter(recording, x) for x in wired.inputs if _has(recording, x.command))


def _known(recording: Recording, wired: Wiring) -> NDArray[np.bool_]:
    """(rows,) whether all sensors are as they were, and the commands."""
    columns = [recording.column(n) for n in wired.sensors]
    bad = (recording.quality[:, columns] & SPOILT) != 0
    known = np.all(np.isfinite(recording.columns(wired.sensors)) & ~bad, axis=1)
    for x in wired.inputs:  # what went out is known, limited or not
        if _has(recording, x.command):
            known &= np.isfinite(recording.values_of(x.command))
    return np.asarray(known)


def _driving_columns(recording: Recording, wired: Wiring) -> set[str]:
    """The columns that inputs are made of."""
    made = {c.name for c in recording.channels if c.role in ("command", "reference")}
    return made | {name for x in wired.inputs for name in (x.command, x.centring)}


def _driving(
    whole: Bridged,
    x: Input,
    values: Float,
    sensors: Sequence[str],
    *,
    as_sent: bool,
    slower: bool,
    times: int,
) -> tuple[Float, Float, NDArray[np.bool_], inputs.MeterNoise]:
    """(n,) of an input: the command, what drives its loop, and where it has edges; and a meter's
    noise, as of `Command`.

    values : (n, q) of the sensors. as_sent : whether the command follows from what was read, so
    that no meter recorded it. slower : whether not every sample of the rig was recorded. times : as
    of `faster`.
    """
    recording = whole.recording
    if not _has(recording, x.command):
        still = np.zeros(len(values))
        return still, still, np.zeros(len(values), np.bool_), inputs.MeterNoise()
    recording = of_input(recording, x.command)
    column = recording.column(x.command)
    theta = values[:, sensors.index(x.centring)] if x.kp else None
    v, r, edges = inputs.sent(recording, column, x.kp, theta, times, whole.gaps)
    if slower:
        edges = edges | inputs.jumps(recording, column, x.kp, theta)
    meter = inputs.MeterNoise()
    if not as_sent and not recording.names("reference"):
        noisy = r
        r, meter = inputs.calibrated(noisy, recording.channels[column].resolution)
        v = v + (r - noisy)
        edges = edges | inputs.stepped(noisy, meter)
    return v, r, edges, meter


def _beside(each: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """(n,) of one input, (n, m) of several."""
    return each[0] if len(each) == 1 else np.stack(each, axis=1)


def joined(pieces: list[Piece]) -> list[Piece]:
    """Pieces of different levels with proportional inputs as one."""
    return _joined(pieces, levels=True)


@dataclass(frozen=True, slots=True)
class _Samples:
    """All samples of a recording in turn, those that short gaps have lost included.

    v, r : (n,) or (n, m) of the inputs, edges : of their jumps. values : (n, q) of the sensors.
    meter : of each input, as of `Command`.
    unknown : (gaps,) whether the input there is a guess. slower : as of `_driving`.
    outside : of each input, what moves it from outside a loop that is not closed; None where no
    such loop is known of.
    """

    whole: Bridged
    v: Float
    r: Float
    edges: NDArray[np.bool_]
    values: Float
    meter: tuple[inputs.MeterNoise, ...]
    unknown: NDArray[np.bool_]
    slower: bool
    outside: tuple[Float | None, ...]

    @classmethod
    def of(cls, whole: Bridged, rig: Rig, wired: Wiring, *, slower: bool, times: int) -> _Samples:
        """Of a recording, as `whole`. times : as of `faster`."""
        values = whole.recording.columns(wired.sensors)
        read = wired.sensors
        own = tuple(None if x.kp else outside(whole, rig, x.command, read) for x in wired.inputs)
        each = [
            _driving(
                whole, x, values, read,
                as_sent=out is not None, slower=slower, times=times,
            )
            for x, out in zip(wired.inputs, own, strict=True)
        ]  # fmt: skip
        unknown = np.zeros(len(whole.lost), np.bool_)
        v, r, edges, meter = zip(*each, strict=True)
        for one in r:
            unknown |= bridge(one, whole.lost) > KNOWN * np.sqrt(np.mean(one**2))
        return cls(
            whole, _beside(v), _beside(r), _beside(edges), values, meter, unknown, slower, own
        )  # fmt: skip

    def follows(self, first: int, behind: int) -> float:
        """As of `Command`, of samples from `first` to before `behind`."""
        rate = self.whole.recording.rate_hz
        each = zip(self.v.reshape(len(self.v), -1)[first:behind].T, self.outside, strict=True)
        moving = [(v, x) for v, x in each if np.ptp(v)]
        return min(
            (np.inf if x is None else followed(v, x[first:behind], rate) for v, x in moving),
            default=np.inf,
        )


def _cut(recording: Recording, segment: Segment, samples: _Samples, step: Float) -> list[Piece]:
    """The stretches of a segment between gaps, each with the input before it. step : of the
    sensors' converters."""
    name, level = recording.place(segment), (segment.level, segment.unit)
    out = []
    for start, low, high in _stretches(recording, segment, samples):
        high = _soon_transformed(low, high, samples.whole.lost)
        history = min(low - start, high - low)
        first = low - history
        # Whatever came before the history may still ring.
        moving = low > history
        follows = samples.follows(low, high)
        told = Command(samples.v[first:high], 1.0, samples.meter, follows)
        z, struck = spikes.mended(samples.values[low:high], step)
        piece = Piece(name, samples.r[first:high], z, history, (level,), moving, commands=(told,))
        own = samples.edges[first:high].reshape(high - first, -1)
        at = [(int(i), int(j)) for i, j in np.argwhere(own)]
        if samples.slower:
            at += _cut_off(piece.r)
        gaps = (samples.whole.lost[:, 0] >= low) & (samples.whole.lost[:, 0] < high)
        lost, unknown = (
            tuple((int(a) - low, int(b) - low) for a, b in samples.whole.lost[some])
            for some in (gaps, gaps & samples.unknown)
        )
        out.append(replace(piece, struck=struck, edges=tuple(at), lost=lost, unknown=unknown))
    return out


def _soon_transformed(low: int, high: int, lost: Int) -> int:
    """Where a stretch ends whose DFT takes no longer than it has to, at most 2 % earlier: that of
    a length with a large prime factor takes twelve times as long. Not within a gap (gaps, 2)."""
    if high - low < SHORT_DFT:
        return high
    end = low + int(fft.prev_fast_len(high - low, real=False))
    within = np.any((lost[:, 0] <= end) & (end <= lost[:, 1]))
    return high if within else end


def _cut_off(r: Float) -> list[tuple[int, int]]:
    """The edges of inputs r (n,) or (n, m) that go on behind their last sample: what they are
    between the last ones depends on those that nobody knows."""
    last, largest = np.abs(np.atleast_1d(r[-1])), np.max(np.abs(r), axis=0)
    on = np.flatnonzero(last > inputs.JUMP * np.atleast_1d(largest))
    return [(len(r) - 1 + i, int(j)) for j in on for i in (0, 1)]


def _stretches(
    recording: Recording, segment: Segment, samples: _Samples
) -> Iterator[tuple[int, int, int]]:
    """Stretches of a segment without a long gap, or without any where there are many, `LONGEST` at
    most: from which sample on all input before is known, the first, and the one behind the last."""
    whole = samples.whole
    a, b = whole.between(_begun(recording, segment), segment.stop)
    within = (whole.lost[:, 0] > a) & (whole.lost[:, 0] < b)
    begins = samples.unknown & (np.diff(whole.lost)[:, 0] > GUESSED)
    begins |= np.count_nonzero(within & ~begins) > MOST_GAPS
    many, own = whole.lost[within & begins], whole.lost[within & ~begins]
    ends = np.concatenate([[a, b], whole.breaks, many.ravel()])
    ends = np.unique(ends[(ends >= a) & (ends <= b)])
    known = np.concatenate([whole.breaks, whole.lost[:, 1]])
    for first, last in pairwise(ends.tolist()):
        if last - first < LEAST_SAMPLES or first in many[:, 0]:
            continue
        parts = -(-(last - first) // LONGEST)
        cuts = np.linspace(first, last, parts + 1).astype(np.int64)
        for low, high in pairwise(_aside(cuts, own).tolist()):
            yield int(known[known <= low].max()), low, high


def _aside(cuts: Int, lost: Int) -> Int:
    """Where to cut instead: not within samples that are lost (gaps, 2)."""
    within = (cuts[:, None] > lost[:, 0]) & (cuts[:, None] < lost[:, 1])
    behind = np.max(np.where(within, lost[:, 1], 0), axis=1, initial=0)
    return np.asarray(np.maximum(cuts, behind))


def across(x: Float, lost: Sequence[tuple[int, int]]) -> Float:
    """x (n, q) with straight lines across samples that are lost."""
    if not lost:
        return x
    lines = x.copy()
    for first, behind in lost:
        ends = [max(first - 1, 0), min(behind, len(x) - 1)]
        for column, own in zip(lines.T, x.T, strict=True):
            column[first:behind] = np.interp(np.arange(first, behind), ends, own[ends])
    return lines


def _begun(recording: Recording, segment: Segment) -> int:
    """The sample from which on a segment's excitation acts: a periodic one settles before it, and a
    whole record holds that too, of at most as many samples as the segment has."""
    if segment.kind != "periodic":
        return segment.start
    ends = [s.stop for s in recording.segments if s.stop <= segment.start]
    return max(2 * segment.start - segment.stop, 0, *ends)


def _joined(pieces: list[Piece], *, levels: bool) -> list[Piece]:
    """Pieces with proportional inputs, of one level or of any, as one."""
    scale = _scale(pieces)
    groups: list[list[Piece]] = []
    for piece in pieces:
        for group in groups:
            if _proportional(group[0], piece, scale, levels=levels):
                group.append(piece)
                break
        else:
            groups.append([piece])
    return [
        _turned(group, scale, levels=levels) if len(group) > 1 else group[0] for group in groups
    ]


def _scale(pieces: Sequence[Piece]) -> Float | None:
    """(m,) largest rms of each of several inputs, by which their units compare; None of one."""
    if not pieces or pieces[0].r.ndim == 1:
        return None
    size = np.max([np.sqrt(np.mean(p.r**2, axis=0)) for p in pieces], axis=0)
    return np.where(size > 0, size, 1.0)


def _flat(r: Float, scale: Float | None) -> Float:
    return r if scale is None else (r / scale).ravel()


def _proportional(one: Piece, other: Piece, scale: Float | None, *, levels: bool) -> bool:
    alike = (one.r.size, one.history, one.moving) == (other.r.size, other.history, other.moving)
    if not alike or one.lost or other.lost:
        return False
    if not levels and one.levels != other.levels:
        return False
    return proportional(_flat(one.r, scale), _flat(other.r, scale))


def turn_to(c: Float) -> Float:
    """(n, n) orthonormal rows, the first along c (n,), by which records c_i r are turned."""
    # The first row of U^T of a Householder reflection that sends c to its own axis.
    U = np.linalg.qr(np.column_stack([c, np.eye(c.size)[:, 1:]]))[0].T
    U[0] *= np.sign(U[0] @ c)
    return np.asarray(U)


def _turned(group: list[Piece], scale: Float | None, *, levels: bool) -> Piece:
    first = group[0]
    c = np.array([_flat(p.r, scale) @ _flat(first.r, scale) for p in group])
    U = turn_to(c)
    r = (U @ np.stack([p.r.ravel() for p in group])).reshape(len(group), *first.r.shape)
    z = np.tensordot(U, np.stack([p.z for p in group]), axes=1)
    struck = [_struck(group, parts) for parts in U]
    others = tuple(Samples(r[i], z[i], struck[i]) for i in range(1, len(group)))
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
            replace(told, part=float(part) * told.part)
            for part, p in zip(U[0], group, strict=True)
            for told in p.commands
        ),
        struck[0],
        tuple(sorted({edge for p in group for edge in p.edges})),
    )


def _struck(group: Sequence[Piece], parts: Float) -> tuple[spikes.Spike, ...]:
    """The spikes of a sum of pieces, of each so many times."""
    more: dict[tuple[int, int], float] = {}
    for p, part in zip(group, parts, strict=True):
        for at, sensor, own in p.struck:
            more[at, sensor] = more.get((at, sensor), 0.0) + float(part) * own
    return tuple((at, sensor, own) for (at, sensor), own in more.items())
