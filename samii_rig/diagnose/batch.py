"""Many recordings, each diagnosed by itself: here on all cores, or on a cluster.

with workers(scheduler="tcp://host:8786") as executor:
    for log, said in each(logs, executor):
        print(log, said.get("verdict") or said["error"])
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from samii_rig.diagnose.posed import InPose, in_poses, of_any_kind, sorted_by_pose
from samii_rig.diagnose.result import Diagnosis
from samii_rig.errors import InputError, SamiiRigError
from samii_rig.identify.poses import poses_of
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.signal.gather import Gaps
from samii_rig.types import FrequencyResponse, Recording


@dataclass(frozen=True, slots=True)
class How:
    """What is the same for all. rig_toml : text of the rig file, "" for the one that a recording
    carries. outputs, gaps, band : as `signal.estimate.estimate` has them."""

    rig_toml: str = ""
    outputs: tuple[str, ...] | None = None
    gaps: Gaps = "auto"
    band: tuple[float, float] | None = None


def together(logs: Sequence[Path], how: How) -> Diagnosis:
    """The diagnosis of recordings of one rig, each in the pose of the rig file that it carries.

    Raises InputError where there is no rig file, RecordingError, EstimateError.
    """
    recordings = [read_recording(log) for log in logs]
    text = how.rig_toml or next((r.rig_toml for r in recordings if r.rig_toml), "")
    if not text:
        raise InputError("--rig", "", None, "a rig: these recordings carry none")
    rig = parse(Rig, text, "the rig file")
    return in_poses(responses_by_pose(recordings, rig, how), rig, band=how.band)


def responses_by_pose(recordings: Sequence[Recording], rig: Rig, how: How) -> list[InPose]:
    """The recordings of each pose with their responses, for `in_poses`.

    Raises InputError, EstimateError.
    """

    def estimated(runs: Sequence[Recording]) -> Sequence[FrequencyResponse]:
        return estimate(of_any_kind(runs), outputs=how.outputs, gaps=how.gaps, band=how.band)

    return sorted_by_pose(recordings, poses_of(recordings, rig, ()), estimated)


def each(
    logs: Sequence[Path], executor: Executor, how: How | None = None
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Every recording by itself, in order: `Diagnosis.plain` and `lines`, or {"error": why}."""
    how = how or How()
    waiting = [executor.submit(_one, log.resolve(), how) for log in logs]
    for log, future in zip(logs, waiting, strict=True):
        yield log, future.result()


def _one(log: Path, how: How) -> dict[str, Any]:
    try:
        found = together([log], how)
    except SamiiRigError as error:
        return {"error": str(error)}
    return {**found.plain(), "lines": list(found.lines())}
