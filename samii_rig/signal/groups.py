"""From recordings to groups of repeats: what one estimate is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from samii_rig.errors import EstimateError, InputError, one_of
from samii_rig.signal.columns import centring_of
from samii_rig.types import Channel, Finding, Float, Recording, Segment

# Correlation of two references above which they are the same experiment repeated; a lost
# sample costs about its share of the length.
SAME_REFERENCE = 0.98
LENGTH_DIFFERS = 0.05  # relative difference in length that lost samples can explain


@dataclass(frozen=True, slots=True)
class Piece:
    """The samples that are there: r (n,) reference, z (n, 1 + p) input and outputs.

    breaks : indices before which samples are missing; what came before them does not
        explain what follows.
    follows : whether the piece before it in the group ended where this one starts.
    realisation : of a multisine; pieces of another one have other phases.
    """

    name: str
    r: Float
    z: Float
    breaks: tuple[int, ...] = ()
    follows: bool = False
    realisation: int = 0

    def __len__(self) -> int:
        return int(self.r.shape[0])


@dataclass(frozen=True, slots=True)
class Selection:
    """Which columns of a recording an estimate reads, by name."""

    input: Channel
    outputs: tuple[Channel, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Input first, then the outputs: the columns of `Piece.z`."""
        return (self.input.name, *(c.name for c in self.outputs))


@dataclass(slots=True)
class Group:
    """Repeats of one experiment at one level.

    unsettled : of bursts that run into each other, how many come before the motion has settled.
    """

    selection: Selection
    kind: str
    level: float
    unit: str
    rate_hz: float
    pieces: list[Piece] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    through: str = ""
    unsettled: int = 0

    @property
    def equal_length(self) -> bool:
        """Whether all pieces have the same number of samples and none is missing."""
        return len({len(p) for p in self.pieces}) == 1 and not any(p.breaks for p in self.pieces)


def select(recording: Recording, input: str | None, outputs: Sequence[str] | None) -> Selection:
    """The input channel and the outputs; InputError when they are not there or not clear,
    EstimateError when no input moves."""
    where = recording.source or "recording"
    by_name = {c.name: c for c in recording.channels}
    if input is None:
        commands = recording.names("command")
        if not commands:
            expected = (
                'one of role "command": what went out to the actuator; a map file says the role'
            )
            raise InputError(where, "channels", list(by_name), expected)
        moving = [n for n in commands if recording.largest(n) > 0.0]
        if not moving:
            raise EstimateError(f"{where}: the input {', '.join(commands)} never moves")
        if len(moving) != 1:
            raise InputError(where, "input", moving, "the name of the one input to estimate from")
        input = moving[0]
    if outputs is None:
        outputs = [n for n in recording.names("sensor") if n != input]
    for name, option in [(input, "input"), *((n, "outputs") for n in outputs)]:
        if name not in by_name:
            raise InputError(where, option, name, one_of(name, by_name))
    if not outputs:
        raise InputError(where, "outputs", [], "at least one sensor")
    return Selection(by_name[input], tuple(by_name[n] for n in outputs))


def segments_of(recording: Recording) -> tuple[Segment, ...]:
    """The recording's segments, or the whole of it as one `single` segment.

    Raises EstimateError if it holds no sample, or ended before its first segment did.
    """
    if recording.segments:
        return recording.segments
    if len(recording) == 0:
        raise EstimateError(f"{recording.source or 'recording'}: it holds no sample")
    if recording.experiment_toml:
        raise EstimateError(
            f"{recording.source or 'recording'}: the run ended before its first segment did; "
            "nothing to estimate"
        )
    references = [c for c in recording.channels if c.role == "reference"]
    driven = references or [c for c in recording.channels if c.role == "command"]
    peaks = {c: recording.largest(c.name) for c in driven}
    loudest = max(peaks, key=lambda c: peaks[c]) if peaks else None
    return (
        Segment(
            name="whole",
            kind="single",
            start=int(recording.sequence[0]),
            stop=int(recording.sequence[-1]) + 1,
            level=peaks[loudest] if loudest else float("nan"),
            unit=loudest.unit if loudest else "",
        ),
    )


def reference_of(
    cut: Recording, selection: Selection, reference: str | None
) -> tuple[Float, str, Finding | None]:
    """The reference (n,) of a cut, what it is in words, and a finding when it is the input itself.

    With both u and theta_ref in use the loop v = u + kp (theta_ref - theta) has the
    exogenous input r = u + kp theta_ref; kp comes from the rig file in the recording.

    Raises InputError for a reference that is no column, or for several that may be it.
    """
    where = cut.source or "recording"
    if reference is not None:
        if reference not in {c.name for c in cut.channels}:
            names = ", ".join(c.name for c in cut.channels)
            raise InputError(where, "reference", reference, one_of(reference, names))
        return cut.values_of(reference), reference, None
    used = [n for n in cut.names("reference") if cut.largest(n) > 0]
    if not used:
        finding = Finding(
            "closed_loop",
            "warning",
            f"no reference was recorded, {selection.input.name} takes its place: if a loop acts "
            "on it, noise that came through the loop biases the estimate",
            channel=selection.input.name,
        )
        return cut.values_of(selection.input.name), selection.input.name, finding
    if len(used) == 1:
        return cut.values_of(used[0]), used[0], None
    units = {n: cut.channels[cut.column(n)].unit for n in used}
    direct = [n for n in used if units[n] == selection.input.unit]
    angle = [n for n in used if units[n] != selection.input.unit]
    centring = centring_of(cut)
    if len(direct) == 1 and len(angle) == 1 and centring is not None:
        _, kp = centring
        r = cut.values_of(direct[0]) + kp * cut.values_of(angle[0])
        return r, f"{direct[0]} + {kp:g} {angle[0]}", None
    raise InputError(where, "reference", used, "one reference column that is in use, by name")


@dataclass(frozen=True, slots=True)
class Waveform:
    """A reference for comparing: in the order recorded, and on the segment's own count
    (0 where a sample is missing).

    Where a loop lost ticks, some devices go on with the next sample of the reference, others
    skip it; both are the same experiment.
    """

    recorded: Float
    counted: Float

    @classmethod
    def of(cls, cut: Recording, segment: Segment, r: Float) -> Waveform:
        """The reference `r` of a cut."""
        counted = np.zeros(max(segment.stop - segment.start, 1))
        place = cut.sequence - segment.start
        inside = (place >= 0) & (place < counted.size)
        counted[place[inside]] = np.nan_to_num(r[inside])
        return cls(np.nan_to_num(r), counted)

    def same(self, other: Waveform) -> bool:
        """Whether both are one waveform, but for some lost samples."""
        return _alike(self.recorded, other.recorded) or _alike(self.counted, other.counted)


def _alike(a: Float, b: Float) -> bool:
    n = min(a.size, b.size)
    if abs(a.size - b.size) > LENGTH_DIFFERS * n:
        return False
    norms = float(np.linalg.norm(a[:n])), float(np.linalg.norm(b[:n]))
    if min(norms) < SAME_REFERENCE * max(norms):
        return False  # another amplitude, whatever the level is said to be
    size = norms[0] * norms[1]
    return size > 0 and float(a[:n] @ b[:n]) / size > SAME_REFERENCE
