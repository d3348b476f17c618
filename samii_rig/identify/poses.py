"""Several recordings of one rig, each in a pose of its own."""

from __future__ import annotations

import re
from collections.abc import Sequence

from samii_rig.errors import InputError
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.pose import Angle
from samii_rig.types import Recording
from samii_rig.units import convert

HANGING = Angle(value=0.0, unit="rad")
_WRITTEN = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\S+)\s*")


def read_pose(text: str) -> Angle:
    """A pose as people write it, "30 deg" or "0.5rad"; InputError for anything else."""
    found = _WRITTEN.fullmatch(text)
    try:
        value = convert(float(found[1]), found[2], "rad") if found else None
    except ValueError:  # "1.2.3"
        value = None
    if value is None or not found:
        raise InputError("--pose", "", text, 'an angle with its unit, for example "30 deg"')
    return Angle(value=value, unit="rad", written="" if found[2] == "rad" else found[2])


def at_pose(rig: Rig, pose: Angle | None) -> Rig:
    """The rig in another pose; one without gravity has none."""
    return rig.model_copy(update={"pose": pose}) if rig.gravity else rig


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
    if rig.gravity == 0:
        expected = f"none, as {rig.name} has no gravity: expected gravity = 9.81 in the rig file"
        raise InputError("--pose", "", given[0], expected)
    if len(given) != n:
        expected = f"one --pose for each of {n} recordings, in their order"
        raise InputError("--pose", "", f"{len(given)} poses", expected)
    return [read_pose(text) for text in given]


def poses_of(recordings: Sequence[Recording], rig: Rig, given: Sequence[str]) -> list[Angle]:
    """The pose of each recording: as `given`, else that of the rig file that it carries, if
    that has gravity, else that of `rig`.

    Raises InputError for another number of poses than of recordings, for one that is no angle, and
    for poses of a rig without gravity.
    """
    if given:
        return given_poses(len(recordings), rig, given)
    if rig.gravity == 0:
        return [HANGING] * len(recordings)
    out = []
    for recording in recordings:
        own = parse(Rig, recording.rig_toml, recording.source) if recording.rig_toml else rig
        out.append((own if own.gravity else rig).pose or HANGING)
    return out
