"""Take the usable segments out of recordings and sort them into groups of repeats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from samii_rig.errors import EstimateError
from samii_rig.signal import checks
from samii_rig.signal.groups import (
    Group,
    Piece,
    Selection,
    Waveform,
    reference_of,
    segments_of,
    select,
)
from samii_rig.signal.quantisation import coarse
from samii_rig.signal.rows import whole_rows
from samii_rig.types import Finding, Recording, Segment

Gaps = Literal["auto", "refuse", "exclude", "model"]
LEAST_SAMPLES = 256  # fewer are mostly transient


def gather(
    recordings: Sequence[Recording],
    *,
    input: str | None,
    outputs: Sequence[str] | None,
    reference: str | None,
    gaps: Gaps,
) -> list[Group]:
    """Groups of pieces with one reference, level and kind, in order of first appearance.

    Raises EstimateError where `gaps="refuse"` meets a gap, or where nothing is left.
    """
    if not recordings:
        raise EstimateError("no recording was given; nothing to estimate")
    groups: list[tuple[Group, Waveform]] = []
    lost: list[Finding] = []
    looked = _look(recordings, input, outputs, reference, gaps, lost)
    if outputs is None:
        looked = _spared(looked, reference, gaps)
    ends: dict[tuple[int, int], int] = {}  # of the last piece of each group in each recording
    for seen in looked:
        recording, segment, cut, own = seen.recording, seen.segment, seen.cut, seen.selection
        if not seen.usable:
            lost += seen.found
            continue
        r, through, remark = reference_of(cut, own, reference)
        group = _group_for(groups, segment, cut, own, Waveform.of(cut, segment, r))
        group.through = through
        if remark and remark not in group.findings:
            group.findings.append(remark)
        group.findings += seen.found
        name = recording.place(segment)
        kept, breaks = whole_rows(cut, seen.names)
        z = cut.columns(own.names)
        if not kept.all():
            r, z = r[kept], z[kept]
        measured = np.ptp(z[:, 1:]) > 0
        if measured and any(np.array_equal(p.z, z) for p in group.pieces):
            raise EstimateError(
                f"{name} holds the very samples of another repeat: the same file twice, or a "
                "simulation with the same seed; leave one out"
            )
        place = id(group), id(recording)
        follows = ends.get(place) == segment.start and not breaks
        ends[place] = segment.stop
        group.pieces.append(Piece(name, r, z, breaks, follows))
        if recording.source and recording.source not in group.sources:
            group.sources.append(recording.source)
    if not groups and not lost:
        raise EstimateError("steps and other transients only: no response can be estimated")
    if not groups:
        reasons = "; ".join(f.message for f in lost[:3])
        raise EstimateError(f"no segment is usable: {reasons}")
    for finding in lost:
        groups[0][0].findings.append(finding)
    return [group for group, _ in groups]


@dataclass(frozen=True, slots=True)
class _Looked:
    """A segment, what was found in it and whether it is used. names : columns that it needs.
    spoilt : outputs that alone are why it is not used."""

    recording: Recording
    segment: Segment
    cut: Recording
    selection: Selection
    names: list[str]
    found: list[Finding]
    usable: bool
    spoilt: frozenset[str]


def _look(
    recordings: Sequence[Recording],
    input: str | None,
    outputs: Sequence[str] | None,
    reference: str | None,
    gaps: Gaps,
    lost: list[Finding],
) -> list[_Looked]:
    """All segments of recordings whose input moves; `lost` is called for the others."""
    out: list[_Looked] = []
    selection: Selection | None = None
    still: list[EstimateError] = []
    for recording in recordings:
        try:
            own = select(recording, input, outputs)
        except EstimateError as error:
            still.append(error)
            continue
        if selection is None:
            selection = own
        elif selection.names != own.names:
            raise EstimateError(
                f"{recording.source or 'recording'} has the channels {', '.join(own.names)}, the "
                f"first one {', '.join(selection.names)}; name input and outputs, or estimate apart"
            )
        for segment in segments_of(recording):
            if segment.kind != "transient":
                cut = recording.cut(segment)
                out.append(_examine(recording, segment, cut, own, reference, gaps))
    if selection is None:
        raise still[0]
    lost += [Finding("stuck", "error", f"{error}; left out") for error in still]
    return out


def _spared(looked: list[_Looked], reference: str | None, gaps: Gaps) -> list[_Looked]:
    """The same, but where no segment of a level can be used for the sake of some outputs, these
    are left out and not the level."""
    levels: dict[tuple[str, str, str], list[_Looked]] = {}
    for seen in looked:
        s = seen.segment
        levels.setdefault((s.kind, f"{s.level:g}", s.unit), []).append(seen)
    out: dict[int, _Looked] = {}
    for members in levels.values():
        bad = frozenset().union(*(m.spoilt for m in members))
        keep = tuple(c for c in members[0].selection.outputs if c.name not in bad)
        if any(m.usable or not m.spoilt for m in members) or not keep:
            continue
        for m in members:
            fewer = Selection(m.selection.input, keep)
            again = _examine(m.recording, m.segment, m.cut, fewer, reference, gaps)
            why = [f for f in m.found if f.channel in bad]
            out[id(m)] = replace(again, found=[*why, *again.found])
        segment, names = members[0].segment, ", ".join(sorted(bad))
        level = f"at {segment.level:g} {segment.unit}" if np.isfinite(segment.level) else "here"
        first = out[id(members[0])]
        kind = first.found[0].kind
        text = f"{names} left out {level}: no run there in which it is sound"
        first.found.insert(0, Finding(kind, "error", text, channel=names))
    return [out.get(id(m), m) for m in looked]


def _examine(
    recording: Recording,
    segment: Segment,
    cut: Recording,
    selection: Selection,
    reference: str | None,
    gaps: Gaps,
) -> _Looked:
    """What is wrong with a segment, and whether it is used."""
    names = list(dict.fromkeys([*selection.names, *cut.names("reference")]))
    if reference is not None and reference in {c.name for c in cut.channels}:
        names = list(dict.fromkeys([*selection.names, reference]))
    breaks = checks.breaks(cut, segment, names)
    found = checks.timing(cut, segment)
    broken = [f for f in found if f.severity == "error"]
    if gap := checks.gap_finding(cut, segment, breaks):
        broken.append(gap)
        found.append(gap)
    if broken and gaps == "refuse":
        raise EstimateError(
            f"{broken[0].message}; gaps='exclude' leaves the segment out, "
            "gaps='model' treats what follows a gap as a new transient"
        )
    outputs = {c.name for c in selection.outputs}

    def looked(usable: bool, spoilt: set[str]) -> _Looked:
        alone = frozenset(spoilt) if spoilt <= outputs else frozenset()
        return _Looked(recording, segment, cut, selection, names, found, usable, alone)

    kept, _ = whole_rows(cut, names)
    short = np.count_nonzero(kept) < LEAST_SAMPLES
    if broken and (gaps == "exclude" or broken[0].kind == "timing" or short):
        timed = any(f.kind == "timing" for f in broken)
        return looked(False, set() if timed else {channel for _, _, channel in breaks})
    stand = checks.stuck(cut, segment, selection)
    frozen = [f for f in stand if f.severity == "error" and "never changes" not in f.message]
    clipped = checks.clipping(cut, segment, selection)
    found += stand + clipped + coarse(cut, segment, selection)
    spoilt = {f.channel for f in (*frozen, *clipped) if f.severity == "error"}
    return looked(not spoilt, spoilt)


def _group_for(
    groups: list[tuple[Group, Waveform]],
    segment: Segment,
    cut: Recording,
    selection: Selection,
    shape: Waveform,
) -> Group:
    for group, known in groups:
        same = (group.kind, group.unit, group.rate_hz, group.selection.names) == (
            segment.kind,
            segment.unit,
            cut.rate_hz,
            selection.names,
        )
        level = bool(np.isclose(group.level, segment.level, rtol=1e-6, equal_nan=True))
        if same and level and known.same(shape):
            return group
    group = Group(selection, segment.kind, segment.level, segment.unit, cut.rate_hz)
    groups.append((group, shape))
    return group
