"""Gravity and the chain's angle to it, as the rig file gives them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field

from samii_rig.rig.schema.base import Finite, Strict
from samii_rig.units import convert

if TYPE_CHECKING:
    from samii_rig.rig.schema.rig import Rig

LEVEL = 1e-12  # |cos(pose)| below which a chain is level: 90 deg in rad is rounded to 1e-16


class Angle(Strict):
    """An angle in rad; written : the unit that the file gives it in, if that is another."""

    value: Finite
    unit: str
    written: str = Field(default="", description="unit that the value was given in")


def _in_rad(angle: Angle) -> Angle:
    value = convert(angle.value, angle.unit, "rad")
    if value is None:
        raise ValueError(f"unit {angle.unit!r}; expected 'rad' or 'deg'")
    if angle.unit == "rad":
        return angle
    return Angle(value=value, unit="rad", written=angle.unit)


Pose = Annotated[Angle, AfterValidator(_in_rad)]


def pull(gravity: float, pose: Angle | None) -> float:
    """Gravity along the chain, base to tip, m/s^2: g where it hangs, -g where it stands."""
    along = math.cos(pose.value) if pose else 1.0
    return gravity * along if abs(along) > LEVEL else 0.0


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
