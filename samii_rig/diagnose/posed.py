"""`in_poses`: one rig, recorded in several poses, and one set of parameters for all of them.

poses = poses_of(recordings, rig, ["0 deg", "75 deg"])
found = in_poses(sorted_by_pose(recordings, poses, estimate), rig)
found.verdict, found.causes, found.lines()
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from samii_rig.diagnose.data.findings import Checked
from samii_rig.diagnose.diagnose import case_of, diagnose, table
from samii_rig.diagnose.fit.agreeing import Given
from samii_rig.diagnose.fit.poses import InPoses, PosesSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.usual import POSES_TAKE, takes
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.verdict.by_record import by_samples
from samii_rig.diagnose.verdict.stages import Case
from samii_rig.errors import EstimateError, InputError, RepeatsDifferError
from samii_rig.identify.poses import at_pose, by_pose
from samii_rig.progress import Begun, Progress
from samii_rig.rig.load import parse
from samii_rig.rig.pose import in_words, pose_of
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.pose import Angle
from samii_rig.types import Finding, FrequencyResponse, Recording, Segment

Band = tuple[float, float]
FORCES = (
    "friction, play, hardening and the like were not looked for, as the recordings are in several "
    "poses; those of one pose alone would show these"
)


@dataclass(frozen=True, slots=True)
class InPose:
    """The recordings in one pose and their responses, by `samii_rig.signal.estimate`."""

    pose: Angle
    responses: Sequence[FrequencyResponse]
    runs: Sequence[Recording]

    @property
    def in_words(self) -> str:
        """The pose in words."""
        return in_words(self.pose)


def sorted_by_pose(
    recordings: Sequence[Recording],
    poses: Sequence[Angle],
    estimated: Callable[[Sequence[Recording]], Sequence[FrequencyResponse]],
) -> list[InPose]:
    """The recordings of each pose, in order of appearance. poses : of each recording; estimated :
    responses of those of one pose."""
    each = by_pose(recordings, poses)
    return [InPose(pose, _responses(own, estimated), own) for pose, own in each]


def _responses(
    runs: Sequence[Recording],
    estimated: Callable[[Sequence[Recording]], Sequence[FrequencyResponse]],
) -> Sequence[FrequencyResponse]:
    """Of all runs; where these do not repeat each other, of each by itself, or of each record of a
    run: what differs is to be explained, too."""
    try:
        return estimated(runs)
    except RepeatsDifferError as error:
        each = runs if len(runs) > 1 else _by_segment(runs[0])
        if len(each) < 2:
            raise
        try:
            first, *others = [r for run in each for r in _responses([run], estimated)]
        except EstimateError:  # of one alone nothing can be said
            raise error from None
        told = Finding("repeat", "warning", f"{error}; each was estimated by itself")
        return [replace(first, findings=(*first.findings, told)), *others]


def _by_segment(run: Recording) -> list[Recording]:
    """The recording once for each of its segments, with that alone."""
    return [replace(run, segments=(segment,)) for segment in run.segments]


def of_any_kind(runs: Sequence[Recording]) -> list[Recording]:
    """The same, to be estimated: whole records take steps and decays, which are for the eye else,
    and begin at responses."""
    return [
        replace(run, segments=tuple(_of_any_kind(segment) for segment in run.segments))
        for run in runs
    ]


def _of_any_kind(segment: Segment) -> Segment:
    return replace(segment, kind="single") if segment.kind == "transient" else segment


def one_pose(poses: Sequence[Angle], option: str, expected: str) -> Angle:
    """The pose of recordings that have one; InputError of an option where they have several."""
    first, *others = dict.fromkeys(poses)
    if others:
        raise InputError(option, "pose", ", ".join(in_words(p) for p in (first, *others)), expected)
    return first


def same_rig(toml: str, rig: Rig) -> bool:
    """Whether a rig file is that of a rig but for the pose."""
    try:
        other = parse(Rig, toml, "the rig file of a recording")
    except InputError:
        return False
    if not (rig.gravity or rig.bent):
        return False
    try:
        return at_pose(other, pose_of(rig)) == at_pose(rig, pose_of(rig))
    except InputError:
        return False


def in_poses(
    each: Sequence[InPose],
    rig: Rig,
    *,
    band: Band | None = None,
    effects: Sequence[Effect] | None = None,
    progress: Progress = lambda _stage: None,
) -> Diagnosis:
    """What `rig` leaves out, as far as the recordings of all poses tell together.

    Parameters
    ----------
    each : the recordings of each pose; those of one pose alone are for `diagnose`.
    band, effects, progress : as of `diagnose`.

    Raises InputError and EstimateError as `diagnose` does; EstimateError where the recordings of a
    pose cannot be used whole, or not together.
    """
    rigs = [at_pose(rig, one.pose) for one in each]
    if len(each) == 1:
        (one,) = each
        return diagnose(
            one.responses, rigs[0], band=band, effects=effects, progress=progress, runs=one.runs
        )
    n = sum(len(run) for one in each for run in one.runs)
    progress(Begun("nominal model", takes=takes(POSES_TAKE, n)))
    if effects is None:
        rate = each[0].responses[0].rate_hz
        effects = table(rigs[0], *_measured(each, band), poses=rigs, recorded_hz=rate)
    cases = [
        case_of(one.responses, own, band, effects, one.runs, progress=progress)
        for one, own in zip(each, rigs, strict=True)
    ]
    rigs = [case.search.rig for case in cases]
    records = _together(each, cases, rigs, band)
    first = cases[0]
    for case in cases[1:]:
        effects = case.clean.competing(effects)
    first.search.use(first.clean.competing(effects))
    search = PosesSearch(records, first.search, rigs)
    nominal = search.nominal.fitted
    at_first, bands = search.ratio(nominal), search.bands(nominal)
    search.begin("what is missing")
    search.run()
    whole = replace(first, clean=_of_all([case.clean for case in cases]))
    given = [
        Given(case.runs, *of, case.clean.samples, f" in pose {one.in_words}")
        for one, case, of in zip(each, cases, search.by_pose(), strict=True)
    ]
    found = by_samples(whole, search, at_first, bands, given)
    poses = ", ".join(one.in_words for one in each)
    remark = f"one set of parameters in {len(each)} poses ({poses})"
    if found.rig is not None or found.traces:
        remark += "; the curves and the new rig file are of the first"
    words = (*found.not_physics, remark) if found.states else (remark, *found.not_physics)
    return replace(found, not_physics=(*words, FORCES))


def _measured(each: Sequence[InPose], band: Band | None) -> Band:
    """Hz, of the lines that take part."""
    low, high = band or (0.0, math.inf)
    f = [float(x) for one in each for r in one.responses for x in r.frequency if low <= x <= high]
    f = [x for x in f if x > 0]
    if not f:  # is told by `case_of` as of any band
        return 1.0, 10.0
    return min(f), max(f)


def _together(
    each: Sequence[InPose], cases: Sequence[Case], rigs: Sequence[Rig], band: Band | None
) -> InPoses:
    """The records of all poses.

    Raises EstimateError where those of one cannot be used whole, or have other channels.
    """
    common = [name for name in cases[0].sensors if all(name in c.sensors for c in cases)]
    hidden = frozenset[str]().union(*(c.clean.hidden for c in cases))
    wholes = []
    for one, case, rig in zip(each, cases, rigs, strict=True):
        where = f"the recordings in pose {one.in_words}"
        if why := case.not_whole():
            raise EstimateError(f"{where} cannot be fitted with the others: {why}")
        try:
            samples = case.clean.samples
            wholes.append(Whole.of(case.runs, rig, band, common, samples, hidden=hidden))
        except EstimateError as error:
            raise EstimateError(f"{where} cannot be fitted with the others: {error}") from error
        if wholes[-1].wired != wholes[0].wired:
            raise EstimateError(f"{where} have other commands, loops or sensors than the first")
    return InPoses(tuple(wholes))


def _of_all(each: Sequence[Checked]) -> Checked:
    """What was found in the recordings of all poses."""
    return replace(
        each[0],
        remarks=tuple(dict.fromkeys(words for one in each for words in one.remarks)),
        lacks=tuple(dict.fromkeys(words for one in each for words in one.lacks)),
        of_lines=frozenset().union(*(one.of_lines for one in each)),
    )
