"""The pose that a rig stands in: another one than its file's, in the rig and in the file's text.

A recording keeps the text of its rig file, and so the pose that it was made in.
"""

from __future__ import annotations

import math
import re

from samii_rig.errors import InputError, one_of
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Bend, Rig
from samii_rig.rig.schema.pose import Angle, Pose, bend_angle
from samii_rig.units import convert

HANGING = Angle(value=0.0, unit="rad")
_WRITTEN = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\S+)\s*")
_TABLE = re.compile(r"^\s*\[", re.MULTILINE)  # where a file's own fields end
_POSE = re.compile(r"^[ \t]*pose[ \t]*=.*$", re.MULTILINE)
_POSE_TABLE = re.compile(r"^[ \t]*\[pose\][^\n]*\n(?:(?![ \t]*\[)[^\n]*\n)*", re.MULTILINE)
_GRAVITY = re.compile(r"^[ \t]*gravity[ \t]*=.*$", re.MULTILINE)


def read_pose(text: str, where: str = "--pose") -> Angle:
    """A pose as people write it, "30 deg" or "0.5rad"; InputError for anything else."""
    _, _, pose = _read(text, where)
    return pose


def pose_of(rig: Rig) -> Angle | None:
    """The pose of a rig: its angle, with those of its bends if it has any."""
    return _with_bends(rig.pose or HANGING, _bends(rig)) if rig.bent else rig.pose


def _bends(rig: Rig) -> dict[str, Angle]:
    return {e.name: e.angle for e in rig.element if isinstance(e, Bend)}


def _with_bends(angle: Angle, bends: dict[str, Angle]) -> Pose:
    own = tuple(bends.items())
    return Pose(value=angle.value, unit=angle.unit, written=angle.written, bends=own)


def at_pose(rig: Rig, pose: Angle | None) -> Rig:
    """The rig in another pose; one without gravity has none but that of its bends.

    Raises InputError for a bend that the rig does not have.
    """
    angle = pose
    if isinstance(pose, Pose):
        rig = _bent_by(rig, pose)
        angle = Angle(value=pose.value, unit=pose.unit, written=pose.written)
    return rig.model_copy(update={"pose": angle}) if rig.gravity else rig


def _bent_by(rig: Rig, pose: Pose) -> Rig:
    wanted = dict(pose.bends)
    own = _bends(rig)
    if foreign := [name for name in wanted if name not in own]:
        raise InputError(rig.name, "pose", foreign[0], f"a bend: {one_of(foreign[0], own)}")
    turned = [
        e.model_copy(update={"angle": wanted.get(e.name, e.angle)}) if isinstance(e, Bend) else e
        for e in rig.element
    ]
    return rig.model_copy(update={"element": tuple(turned)})


def in_words(pose: Angle) -> str:
    """A pose in words."""
    angle = f"{math.degrees(pose.value):.4g} deg"
    if not isinstance(pose, Pose):
        return angle
    return ", ".join((angle, *(f"{n} {math.degrees(a.value):.4g} deg" for n, a in pose.bends)))


def read_whole_pose(text: str, rig: Rig, where: str = "--pose") -> Angle:
    """A pose of a rig as people write it, with its bends: "30 deg" or "30 deg, elbow 60 deg"; bends
    that are not named stay as the rig file has them. InputError for anything else."""
    first, *others = (part.strip() for part in text.split(","))
    angle = read_pose(first, where)
    if not rig.bent:
        if others:
            raise InputError(where, "", text, f"an angle alone: {rig.name} has no bend")
        return angle
    found = _bends(rig)
    for other in others:
        name, _, rest = other.partition(" ")
        if name not in found:
            raise InputError(where, "", text, f"a bend and its angle: {one_of(name, found)}")
        try:
            found[name] = bend_angle(read_pose(rest, where))
        except ValueError as error:
            raise InputError(where, name, rest, str(error).partition("; expected ")[2]) from None
    return _with_bends(angle, found)


def posed(rig: Rig, text: str, where: str = "--pose") -> Rig:
    """The rig in the pose that `text` gives; InputError for one without gravity."""
    pose = read_pose(text, where)
    if rig.gravity == 0:
        expected = f"none, as {rig.name} has no gravity: expected gravity = 9.81 in the rig file"
        raise InputError(where, "", text, expected)
    return at_pose(rig, pose)


def posed_text(rig_toml: str, text: str, where: str = "--pose") -> str:
    """The text of a rig file in the pose that `text` gives: its line `pose` replaced, or one added
    behind `gravity` in place of a table `pose`; all else stays as it is written.

    InputError for a rig without gravity, and for a file that has neither line.
    """
    wanted = posed(parse(Rig, rig_toml, "the rig file"), text, where)
    number, unit, _ = _read(text, where)
    line = f'pose = {{ value = {number}, unit = "{unit}" }}'
    table = _TABLE.search(rig_toml)
    end = table.start() if table else len(rig_toml)
    head, rest = rig_toml[:end], rig_toml[end:]
    if _POSE.search(head):
        head = _POSE.sub(line, head, count=1)
    else:
        head = _GRAVITY.sub(lambda found: f"{found[0]}\n{line}", head, count=1)
        rest = _POSE_TABLE.sub("", rest, count=1)
    new = head + rest
    try:
        same = parse(Rig, new, "the rig file") == wanted
    except InputError:
        same = False
    if not same:
        expected = "gravity and pose on a line each, above all tables of the rig file"
        raise InputError(where, "", text, expected)
    return new


def _read(text: str, where: str) -> tuple[str, str, Angle]:
    """Number and unit as written, and the angle."""
    found = _WRITTEN.fullmatch(text)
    try:
        value = convert(float(found[1]), found[2], "rad") if found else None
    except ValueError:  # "1.2.3"
        value = None
    if value is None or not found:
        raise InputError(where, "", text, 'an angle with its unit, for example "30 deg"')
    written = "" if found[2] == "rad" else found[2]
    return repr(float(found[1])), found[2], Angle(value=value, unit="rad", written=written)
