"""Numbers of a rig file that may be meant, and hardly are: told, never refused.

A length in millimetres that is said to be metres passes every check of its unit and sign.
"""

from __future__ import annotations

from dataclasses import dataclass

from samii_rig.rig.schema import Rig, parameters
from samii_rig.rig.schema.elements import flattened
from samii_rig.units import pretty


@dataclass(frozen=True, slots=True)
class Usual:
    """What a parameter of this unit lies within on a rig in a laboratory. instead : the unit that
    was likely meant if it is a thousand times too large."""

    low: float
    high: float
    instead: str


# By the parameter's unit. A foil of 0.1 mm, a beam as long as a hall; a piezo sensor's gram and
# less, a machine of ten tons. Other units span too much for a bound to tell anything.
USUAL = {"m": Usual(1e-4, 30.0, "mm"), "kg": Usual(1e-6, 1e4, "g")}


def remarks(rig: Rig) -> list[str]:
    """A line for each parameter outside of what is usual: element, field, value, what would be."""
    out = []
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
