"""What a factor between two units is: told as that, not as physics."""

from __future__ import annotations

import math
from dataclasses import dataclass

from samii_rig.units import STANDARD_GRAVITY


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit taken for another. factor : exact, of the numbers."""

    name: str
    factor: float


UNITS = (
    Unit("degrees for radians", 180 / math.pi),
    Unit("g for m/s^2", STANDARD_GRAVITY),
    Unit("milli for one", 1000.0),
    Unit("hertz for rad/s", 2 * math.pi),
)


def nearest(factor: float) -> tuple[Unit, float]:
    """The unit that a positive factor, or its inverse, is nearest to, and the exact factor."""
    every = [(u, f) for u in UNITS for f in (u.factor, 1 / u.factor)]
    return min(every, key=lambda one: abs(math.log(factor / one[1])))
