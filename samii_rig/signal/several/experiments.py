"""From recordings to experiments: repeats of one excitation of several inputs.

An experiment is what one reference, a vector over the inputs, does once or several times. Inputs
in turn make one experiment an input; orthogonal multisines make one a block and realisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import EstimateError, InputError, one_of
from samii_rig.signal import checks
from samii_rig.signal.choose import drop_foreign
from samii_rig.signal.gather import LEAST_SAMPLES
from samii_rig.signal.groups import Group, Piece, Selection, Waveform, segments_of
from samii_rig.signal.quantisation import coarse
from samii_rig.signal.rows import whole_rows
from samii_rig.types import Channel, Finding, Float, Recording, Segment

_TINY = 1e-300


@dataclass(frozen=True, slots=True)
class Columns:
    """Which channels an estimate reads. A piece's z holds them in this order, side by side."""

    references: tuple[Channel, ...]
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]

    @property
    def all(self) -> tuple[Channel, ...]:
        """References, inputs, outputs."""
        return (*self.references, *self.inputs, *self.outputs)

    @property
    def names(self) -> list[str]:
        """Of all; an input that is its own reference stands twice."""
        return [c.name for c in self.all]

    def part(self, role: str) -> slice:
        """The columns of z of `references`, `inputs` or `outputs`."""
        a, b = len(self.references), len(self.references) + len(self.inputs)
        return {"references": slice(0, a), "inputs": slice(a, b), "outputs": slice(b, None)}[role]


@dataclass(slots=True)
class Experiment:
    """Repeats of one excitation; `group` holds them, with z of `Columns` and r the sum of the
    references. used : the references that are not zero in it."""

    group: Group
    used: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Gathered:
    """All experiments, and what was noticed on the way."""

    columns: Columns
    experiments: list[Experiment]
    findings: list[Finding]


def columns_of(
    recording: Recording,
    inputs: Sequence[str],
    outputs: Sequence[str] | None,
    references: Sequence[str] | None,
    in_use: Sequence[str],
) -> Columns:
    """The channels by name; without `references` those `in_use`, and the inputs where none is."""
    where = recording.source or "recording"
    by_name = {c.name: c for c in recording.channels}
    if outputs is None:
        outputs = [n for n in recording.names("sensor") if n not in inputs]
    chosen = references if references is not None else (in_use or inputs)
    for option, names in (("input", inputs), ("outputs", outputs), ("reference", chosen)):
        for name in names:
            if name not in by_name:
                raise InputError(where, option, name, one_of(name, by_name))
    if not outputs:
        raise InputError(where, "outputs", [], "at least one sensor")
    if both := set(inputs) & set(outputs):
        raise InputError(where, "outputs", min(both), "an output that is no input")
    return Columns(*(tuple(by_name[n] for n in x) for x in (chosen, inputs, outputs)))


def gather(
    recordings: Sequence[Recording],
    inputs: Sequence[str],
    outputs: Sequence[str] | None,
    references: Sequence[str] | None,
    gaps: str,
) -> Gathered:
    """Experiments of all recordings, in order of appearance.

    Raises EstimateError where `gaps="refuse"` meets a gap, or where nothing is left.
    """
    if gaps == "model":
        raise InputError("estimate", "gaps", gaps, "refuse or exclude with several inputs")
    in_use = list(dict.fromkeys(n for r in recordings for n in references_in_use(r)))
    columns = columns_of(recordings[0], inputs, outputs, references, in_use)
    scale = _scale(recordings, columns)
    known: list[tuple[Experiment, Waveform]] = []
    findings: list[Finding] = []
    ends: dict[tuple[int, int], int] = {}  # of the last piece of each group in each recording
    for recording in recordings:
        missing = [n for n in columns.names if n not in {c.name for c in recording.channels}]
        if missing:
            raise InputError(recording.source or "recording", "channel", missing[0], "recorded")
        for segment in segments_of(recording):
            if segment.kind == "transient":
                continue
            piece, found = _piece(recording, segment, columns, scale, gaps)
            findings += found
            if piece is not None:
                group = _sort_in(known, recording, segment, columns, scale, piece)
                place = id(group), id(recording)
                follows = ends.get(place) == segment.start
                ends[place] = segment.stop
                group.pieces[-1] = replace(piece, follows=follows)
    if not known:
        reasons = "; ".join(f.message for f in findings if f.severity == "error")
        raise EstimateError(f"no segment is usable: {reasons or 'there are transients only'}")
    experiments = [e for e, _ in known]
    for e in experiments:
        _without_foreign(e, columns)
        findings += e.group.findings
        e.group.findings = []
    return Gathered(columns, experiments, list(dict.fromkeys(findings)))


def references_in_use(recording: Recording) -> list[str]:
    """Reference columns that are not zero throughout."""
    return [n for n in recording.names("reference") if recording.largest(n) > 0]


def outputs_of(group: Group, columns: Columns) -> Group:
    """The same repeats as the tests of a single input see them: z the input that follows the
    references most, and the outputs; other inputs are no outputs, since in a loop they follow
    from these."""
    inputs = columns.part("inputs")
    first = inputs.start + _driven_most(group.pieces[0], inputs)
    keep = [first, *range(inputs.stop, len(columns.all))]
    pieces = [replace(p, z=p.z[:, keep], realisation=i) for i, p in enumerate(group.pieces)]
    selection = Selection(columns.all[first], columns.outputs)
    return replace(group, selection=selection, pieces=pieces, findings=list(group.findings))


def _driven_most(piece: Piece, inputs: slice) -> int:
    """Which input is most alike the sum of the references."""
    v, r = piece.z[:, inputs] - piece.z[:, inputs].mean(axis=0), piece.r - piece.r.mean()
    size = np.linalg.norm(v, axis=0)
    return int(np.argmax(np.abs(r @ v) / np.where(size > 0, size, np.inf)))


def _without_foreign(e: Experiment, columns: Columns) -> None:
    seen = outputs_of(e.group, columns)
    drop_foreign(seen)
    # What was left out breaks the row that `follows` stands for.
    e.group.pieces = [
        replace(e.group.pieces[p.realisation], follows=p.follows, realisation=0)
        for p in seen.pieces
    ]
    e.group.findings = seen.findings


def _scale(recordings: Sequence[Recording], columns: Columns) -> Float:
    """(n_ref,) largest value of each reference anywhere, by which volts and radians compare."""
    peaks = [[r.largest(c.name) for c in columns.references] for r in recordings]
    top = np.max(peaks, axis=0)
    return np.where(top > 0, top, 1.0)


def _piece(
    recording: Recording, segment: Segment, columns: Columns, scale: Float, gaps: str
) -> tuple[Piece | None, list[Finding]]:
    """The samples of a segment, None where something in it forbids their use, and why."""
    cut = recording.cut(segment)
    names = list(dict.fromkeys(columns.names))
    found = checks.timing(cut, segment)
    if gap := checks.gap_finding(cut, segment, checks.breaks(cut, segment, names)):
        found.append(gap)
    broken = [f for f in found if f.severity == "error"]
    if broken and gaps == "refuse":
        raise EstimateError(f"{broken[0].message}; gaps='exclude' leaves the segment out")
    kept, _ = whole_rows(cut, names)
    if broken or np.count_nonzero(kept) < LEAST_SAMPLES:
        return None, found
    z = cut.columns(columns.names)
    moves = np.count_nonzero(np.diff(z[:, columns.part("inputs")], axis=0), axis=0)
    driven = Selection(columns.inputs[int(np.argmax(moves))], columns.outputs)
    rest = Selection(columns.inputs[0], (*columns.inputs[1:], *columns.outputs))
    stand, clipped = checks.stuck(cut, segment, driven), checks.clipping(cut, segment, rest)
    stand = [f for f in stand if "never changes" not in f.message]  # is said of the whole
    found += [*stand, *clipped, *coarse(cut, segment, driven)]
    if any(f.severity == "error" for f in (*stand, *clipped)):
        return None, found
    # Weights that differ keep two references from cancelling each other in their sum.
    weights = (1 + np.arange(len(scale)) / max(len(scale), 1)) / scale
    return Piece(recording.place(segment), z[:, : len(scale)] @ weights, z), found


def _sort_in(
    known: list[tuple[Experiment, Waveform]],
    recording: Recording,
    segment: Segment,
    columns: Columns,
    scale: Float,
    piece: Piece,
) -> Group:
    """Put a piece to the repeats of its own excitation, or to a new experiment."""
    shape = _waveform(recording.cut(segment), segment, columns, scale)
    key = (segment.kind, segment.unit, recording.rate_hz, len(piece))
    for experiment, other in known:
        group = experiment.group
        same = key == (group.kind, group.unit, group.rate_hz, len(group.pieces[0]))
        level = bool(np.isclose(group.level, segment.level, rtol=1e-6, equal_nan=True))
        if same and level and other.same(shape):
            break
    else:
        size = np.abs(piece.z[:, : len(scale)]).max(axis=0)
        used = tuple(c.name for c, x in zip(columns.references, size, strict=True) if x > 0)
        selection = Selection(columns.inputs[0], columns.outputs)
        group = Group(selection, segment.kind, segment.level, segment.unit, recording.rate_hz)
        known.append((Experiment(group, used), shape))
    if any(np.array_equal(p.z, piece.z) for p in group.pieces):
        raise EstimateError(
            f"{piece.name} holds the very samples of another repeat: the same file twice, or a "
            "simulation with the same seed; leave one out"
        )
    group.pieces.append(piece)
    if recording.source and recording.source not in group.sources:
        group.sources.append(recording.source)
    return group


def _waveform(cut: Recording, segment: Segment, columns: Columns, scale: Float) -> Waveform:
    """All references, each in units of its largest value, one after the other; with fewer of
    them than inputs also the inputs, which show what a reference drives."""
    shown = columns.references
    if len(shown) < len(columns.inputs):
        peaks = [np.abs(cut.values_of(c.name)).max() for c in columns.inputs]
        scale = np.append(scale, np.full(len(peaks), max(*peaks, _TINY)))
        shown = (*shown, *columns.inputs)
    parts = [
        Waveform.of(cut, segment, cut.values_of(c.name) / x)
        for c, x in zip(shown, scale, strict=True)
    ]
    return Waveform(
        np.concatenate([p.recorded for p in parts]), np.concatenate([p.counted for p in parts])
    )
