"""Several recordings of one rig, each in a pose of its own."""

from __future__ import annotations

from collections.abc import Sequence

from samii_rig.errors import InputError
from samii_rig.rig.load import parse
from samii_rig.rig.pose import HANGING, pose_of, posed, read_whole_pose
from samii_rig.rig.pose import at_pose as at_pose
from samii_rig.rig.pose import read_pose as read_pose
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.pose import Angle
from samii_rig.types import Recording


def by_pose(
    recordings: Sequence[Recording], poses: Sequence[Angle]
) -> list[tuple[Angle, list[Recording]]]:
    """The recordings of each pose, in order of appearance. poses : of each recording."""
    out: dict[Angle, list[Recording]] = {}
    for recording, pose in zip(recordings, poses, strict=True):
        out.setdefault(pose, []).append(recording)
    return list(out.items())


def given_poses(n: int, rig: Rig, given: Sequence[str]) -> list[Angle]:
    """The pose of each of n recordings in words; InputError as of `poses_of`."""
    if not rig.bent:
        posed(rig, given[0])
    if len(given) != n:
        expected = f"one --pose for each of {n} recordings, in their order"
        raise InputError("--pose", "", f"{len(given)} poses", expected)
    return [read_whole_pose(text, rig) for text in given]


def poses_of(recordings: Sequence[Recording], rig: Rig, given: Sequence[str]) -> list[Angle]:
    """The pose of each recording: as `given`, else that of the rig file that it carries, if
    that has gravity or a bend, else that of `rig`.

    Raises InputError for another number of poses than of recordings, for one that is no angle, and
    for poses of a rig without gravity.
    """
    if given:
        return given_poses(len(recordings), rig, given)
    if not (rig.gravity or rig.bent):
        return [HANGING] * len(recordings)
    out = []
    for recording in recordings:
        own = parse(Rig, recording.rig_toml, recording.source) if recording.rig_toml else rig
        out.append(pose_of(own if own.gravity or own.bent else rig) or HANGING)
    return out
