"""What a rig file may mean, and hardly does: reported, never refused.

A length in millimetres that is said to be metres passes every check of its unit and sign.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from samii_rig.rig.schema import (
    Branch,
    ForceSource,
    GravityStiffness,
    LumpedMass,
    Rig,
    RigidLink,
    Rod,
    TorqueSource,
    TorsionalGroundSpring,
    TranslationalGroundSpring,
    parameters,
)
from samii_rig.rig.schema.elements import ANGLE_SOURCES, BEAMS, MOTION_SOURCES, flattened
from samii_rig.units import pretty


@dataclass(frozen=True, slots=True)
class Usual:
    """What a parameter of this unit lies within on a rig in a laboratory. instead : the unit that
    was likely meant if it is a thousand times too large."""

    low: float
    high: float
    instead: str


# By the parameter's unit. A foil of 0.1 mm, a beam as long as a hall; a piezo sensor's gram and
# less, a machine of ten tons. Other units span too much for a bound to show anything.
USUAL = {"m": Usual(1e-4, 30.0, "mm"), "kg": Usual(1e-6, 1e4, "g")}

# What a source of motion can push against: it has inertia, or is held by the ground.
PUSHED = (
    *(*BEAMS, Rod, RigidLink, LumpedMass, Branch),
    *(TorsionalGroundSpring, TranslationalGroundSpring, GravityStiffness),
)


def remarks(rig: Rig) -> list[str]:
    """A line for each parameter outside of what is usual: element, field, value, what would be; for
    a motor that pushes against nothing, and for sources side by side that add up."""
    out = [*_pushing_nothing(rig), *_adding_up(rig)]
    for e in flattened(rig.element):
        for symbol, p in parameters(e).items():
            usual, size = USUAL.get(p.unit), abs(p.value)
            if usual is None or size == 0 or usual.low <= size <= usual.high:
                continue
            value, unit = p.shown()
            meant = f"; were {usual.instead} meant?" if size > usual.high else ""
            out.append(
                f"element {e.name}: {symbol} is {value:g} {pretty(unit)}; usual are "
                f"{usual.low:g} to {usual.high:g} {pretty(p.unit)}{meant}"
            )
    return out


def _pushing_nothing(rig: Rig) -> Iterator[str]:
    for e in rig.element:
        if isinstance(e, PUSHED):
            return
        turns = isinstance(e, ANGLE_SOURCES) and rig.base != "clamped"
        if turns or (isinstance(e, MOTION_SOURCES) and rig.base == "free"):
            yield (
                f"element {e.name}: moves nothing, as base {rig.base!r} gives way and nothing "
                "before it can be pushed against; was base 'clamped' or an inertia before it meant?"
            )


def _adding_up(rig: Rig) -> Iterator[str]:
    for before, e in pairwise(rig.element):
        for alike in (ANGLE_SOURCES, MOTION_SOURCES, TorqueSource, ForceSource):
            if isinstance(before, alike) and isinstance(e, alike) and before.input == e.input:
                yield (
                    f"element {e.name}: adds up with {before.name}, which acts on the same point "
                    f"by the same input {e.input!r}; was a spring between them meant?"
                )
