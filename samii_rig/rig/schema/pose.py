"""Gravity, the chain's angle to it, and where it is bent, as the rig file gives them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator

from samii_rig.rig.schema.base import INTERNAL, Finite, Strict
from samii_rig.rig.schema.sensors import Displacement, Velocity
from samii_rig.units import convert

if TYPE_CHECKING:
    from samii_rig.rig.schema.rig import Rig

# Least |cos| of a bend, 0.1 deg from a right angle. There what lies beyond has no motion across it
# that the base could give; what is divided by cos loses three digits on the way.
LEAST_ACROSS = 1.7e-3
LEVEL = 1e-12  # |cos(pose)| below which a chain is level: 90 deg in rad is rounded to 1e-16


class Angle(Strict):
    """An angle in rad.

    source : where the number came from; the file alone keeps it. written : the unit that the file
    gives it in, if that is another.
    """

    value: Finite
    unit: str
    source: str = ""
    written: Annotated[str, INTERNAL] = ""


class Pose(Angle):
    """The angle of the chain, and those of its joints at rest at one: (name of the bend, angle)."""

    bends: tuple[tuple[str, Angle], ...] = ()


def _in_rad(angle: Angle) -> Angle:
    value = convert(angle.value, angle.unit, "rad")
    if value is None:
        raise ValueError(f"unit {angle.unit!r}; expected 'rad' or 'deg'")
    # Without its source: the same angle is one pose, whoever measured it.
    written = angle.written if angle.unit == "rad" else angle.unit
    return Angle(value=value, unit="rad", written=written)


PoseAngle = Annotated[Angle, AfterValidator(_in_rad)]


def _bent(angle: Angle) -> Angle:
    if abs(math.cos(angle.value)) < LEAST_ACROSS:
        raise ValueError(
            f"{math.degrees(angle.value):.5g} deg; expected at least 0.1 deg from a right angle, "
            "where what lies beyond has no motion across it that comes from the base"
        )
    return angle


def bend_angle(angle: Angle) -> Angle:
    """The same; ValueError for one that a bend cannot have."""
    return _bent(_in_rad(angle))


BendAngle = Annotated[Angle, AfterValidator(_in_rad), AfterValidator(_bent)]


def pull(gravity: float, pose: Angle | None) -> float:
    """Gravity along the chain, base to tip, m/s^2: g where it hangs, -g where it stands."""
    along = math.cos(pose.value) if pose else 1.0
    return gravity * along if abs(along) > LEVEL else 0.0


def pulls(rig: Rig) -> tuple[float, ...]:
    """`pull` at each element of the chain: a bend turns all that lies beyond it."""
    at, out = rig.pose.value if rig.pose else 0.0, []
    for e in rig.element:
        if e.kind == "bend":
            at += e.angle.value
        out.append(pull(rig.gravity, Angle(value=at, unit="rad")))
    return tuple(out)


def check_bend(rig: Rig) -> None:
    """ValueError, in one line, for a bent chain whose motion along itself is more than one number:
    the state of a chain has none along it."""
    bends = [i for i, e in enumerate(rig.element) if e.kind == "bend"]
    if not bends:
        return
    first, *more = (rig.element[i].name for i in bends)
    if more:
        raise ValueError(
            f"element {more[0]}: a second bend; expected {first} alone, as the motion along the "
            "chain between two bends is none of its states"
        )
    if rig.base == "free":
        raise ValueError(
            f"element {first}: a bend behind base 'free', which moves along the chain too; "
            "expected base 'clamped' or 'pinned'"
        )
    if rig.tip != "free":
        raise ValueError(
            f"element {first}: a bend before tip {rig.tip!r}, which would hold the chain along "
            "itself; expected tip 'free'"
        )
    _check_sides(rig, bends[0])


def _check_sides(rig: Rig, bend: int) -> None:
    """No displacement of one side is read against the other, where it has another direction."""
    beyond = {e.name for e in rig.element[bend:]}
    for s in rig.sensor:
        if not isinstance(s, Displacement | Velocity) or s.against is None:
            continue
        if (s.after in beyond) != (s.against in beyond):
            raise ValueError(
                f"sensor {s.name}: against {s.against!r}, on the other side of the bend "
                f"{rig.element[bend].name}; expected a place on the same side, where w has the "
                "same direction"
            )


def check_gravity(rig: Rig) -> None:
    """ValueError, in one line, where gravity has no meaning or nothing that carries the weight."""
    if rig.gravity == 0:
        if rig.pose is not None:
            raise ValueError("pose: without gravity; expected gravity, for example 9.81 (m/s^2)")
        return
    if rig.motion == "axial":
        raise ValueError(
            f"gravity: {rig.gravity:g} m/s^2 of a chain with motion 'axial', where it is a "
            "constant force that no vibration sees; expected none"
        )
    if rig.base == "free":
        raise ValueError(
            "gravity: base 'free' carries no weight; expected base 'clamped' or 'pinned'"
        )
