"""Take the usable segments out of recordings and sort them into groups of repeats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

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
from samii_rig.types import Finding, Quality, Recording, Segment

Gaps = Literal["refuse", "exclude", "model"]
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
    selection: Selection | None = None
    for recording in recordings:
        ends: dict[int, int] = {}  # of the last piece of each group, in this recording
        own = select(recording, input, outputs)
        if selection is None:
            selection = own
        elif selection.names != own.names:
            raise EstimateError(
                f"{recording.source or 'recording'} has the channels {', '.join(own.names)}, the "
                f"first one {', '.join(selection.names)}; name input and outputs, or estimate apart"
            )
        for segment in segments_of(recording):
            if segment.kind == "transient":
                continue
            cut = recording.cut(segment)
            found, usable, names = _examine(cut, segment, own, reference, gaps)
            if not usable:
                lost += found
                continue
            r, through, remark = reference_of(cut, own, reference)
            group = _group_for(groups, segment, cut, own, Waveform.of(cut, segment, r))
            group.through = through
            if remark and remark not in group.findings:
                group.findings.append(remark)
            group.findings += found
            name = f"{recording.source}, {segment.name}" if recording.source else segment.name
            z = cut.values[:, [cut.column(n) for n in own.names]]
            kept, breaks = _whole_rows(cut, names)
            measured = np.ptp(z[kept][:, 1:]) > 0
            if measured and any(np.array_equal(p.z, z[kept]) for p in group.pieces):
                raise EstimateError(
                    f"{name} holds the very samples of another repeat: the same file twice, or a "
                    "simulation with the same seed; leave one out"
                )
            follows = ends.get(id(group)) == segment.start and not breaks
            ends[id(group)] = segment.stop
            group.pieces.append(Piece(name, r[kept], z[kept], breaks, follows))
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


def _examine(
    cut: Recording, segment: Segment, selection: Selection, reference: str | None, gaps: Gaps
) -> tuple[list[Finding], bool, list[str]]:
    """Findings about a segment, whether it is used, and the channels that it needs."""
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
    kept, _ = _whole_rows(cut, names)
    short = np.count_nonzero(kept) < LEAST_SAMPLES
    if broken and (gaps == "exclude" or broken[0].kind == "timing" or short):
        return found, False, names
    stand = checks.stuck(cut, segment, selection)
    frozen = [f for f in stand if f.severity == "error" and "never changes" not in f.message]
    clipped = checks.clipping(cut, segment, selection)
    found += stand + clipped
    spoilt = bool(frozen) or any(f.kind == "clipping" for f in clipped)
    return found, not spoilt, names


def _whole_rows(cut: Recording, names: Sequence[str]) -> tuple[NDArray[np.bool_], tuple[int, ...]]:
    """Rows in which no needed channel is missing, and the breaks among them."""
    columns = [cut.column(n) for n in names]
    missing = (cut.quality[:, columns] & Quality.MISSING).astype(bool)
    kept: NDArray[np.bool_] = np.all(~missing & np.isfinite(cut.values[:, columns]), axis=1)
    jumps = np.flatnonzero(np.diff(cut.sequence[kept]) > 1) + 1
    return kept, tuple(int(j) for j in jumps)


def _group_for(
    groups: list[tuple[Group, Waveform]],
    segment: Segment,
    cut: Recording,
    selection: Selection,
    shape: Waveform,
) -> Group:
    for group, known in groups:
        same = (group.kind, group.unit, group.rate_hz) == (segment.kind, segment.unit, cut.rate_hz)
        level = bool(np.isclose(group.level, segment.level, rtol=1e-6, equal_nan=True))
        if same and level and known.same(shape):
            return group
    group = Group(selection, segment.kind, segment.level, segment.unit, cut.rate_hz)
    groups.append((group, shape))
    return group
