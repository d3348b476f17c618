"""A parameter and the values that a study gives it: read before the model is imported."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.schema import Key, Rig, flattened, parameters
from samii_rig.types import Float

MOST_POINTS = 100_000  # some 0.1 s each: three hours of one core


@dataclass(frozen=True, slots=True)
class Varied:
    """A parameter and its values.

    key : (element, symbol). own : the rig file's value. values : (n,) from the lowest to the
        highest, in equal steps or, with `log`, equal ratios.
    """

    key: Key
    unit: str
    own: float
    values: Float
    log: bool

    @property
    def name(self) -> str:
        """`element.symbol`."""
        return ".".join(self.key)

    @property
    def one_sign(self) -> bool:
        """Whether percentages of it mean something: the range does not hold 0."""
        return bool(self.values[0] * self.values[-1] > 0)


def vary(rig: Rig, text: str) -> Varied:
    """`element.symbol=LOW:HIGH:N` or, in equal ratios, `element.symbol=LOW:HIGH:N:log`.

    Raises InputError for an unknown parameter or what is no range of two values or more.
    """
    name, _, given = text.partition("=")
    element, _, symbol = name.partition(".")
    elements = {e.name: parameters(e) for e in flattened(rig.element)}
    if element not in elements:
        raise InputError("--vary", "", name, f"an element of {rig.name}: {', '.join(elements)}")
    own = elements[element].get(symbol)
    if own is None:
        expected = f"a parameter of {element}: {', '.join(elements[element])}"
        raise InputError("--vary", "", name, expected)
    log = given.endswith(":log")
    try:
        first, second, third = given.removesuffix(":log").split(":")
        low, high, n = float(first), float(second), int(third)
    except ValueError:
        expected = "LOW:HIGH:N or LOW:HIGH:N:log"
        raise InputError("--vary", name, given, expected) from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError("--vary", name, given, "LOW below HIGH, both finite")
    if log and low <= 0:
        raise InputError("--vary", name, given, "LOW above 0, as its steps are ratios")
    if not 2 <= n <= MOST_POINTS:
        raise InputError("--vary", name, given, f"2 to {MOST_POINTS:,} values")
    values = np.geomspace(low, high, n) if log else np.linspace(low, high, n)
    return Varied((element, symbol), own.unit, own.value, values, log)
