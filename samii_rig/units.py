"""Units of measured quantities as people write them, and exact factors between them.

A unit is a factor to the SI, which is a rational number times a power of pi, and a dimension. What
is not in the table by name is read as a product: "N/mm", "kg cm^2", "rad/(s V)".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from math import inf, isfinite, pi

STANDARD_GRAVITY = 9.80665  # m/s^2, exactly

Dimension = tuple[tuple[str, int], ...]  # (base unit, exponent), sorted; an angle is one of its own


@dataclass(frozen=True, slots=True)
class Unit:
    """scale pi^turns SI units of `dimension`; `quantity` in words, "" for a product."""

    scale: Fraction
    turns: int
    dimension: Dimension
    quantity: str = ""

    def __mul__(self, other: Unit) -> Unit:
        exponents = dict(self.dimension)
        for base, power in other.dimension:
            exponents[base] = exponents.get(base, 0) + power
        return Unit(self.scale * other.scale, self.turns + other.turns, _dimension(exponents), "")

    def to_the(self, power: int) -> Unit:
        """The unit raised to a whole power."""
        raised = tuple((base, n * power) for base, n in self.dimension if power)
        return Unit(self.scale**power, self.turns * power, raised)


def _dimension(exponents: dict[str, int]) -> Dimension:
    return tuple(sorted((base, n) for base, n in exponents.items() if n))


_GRAVITY = Fraction("9.80665")
_POUND_FORCE = Fraction("4.4482216152605")
_INCH = Fraction("0.0254")

# Quantity -> dimension, and unit -> how many SI units it is. Where one name means two things
# ("g"), the first counts for a name that stands alone.
_SI: dict[str, tuple[dict[str, int], dict[str, str | Fraction]]] = {
    "number": ({}, {"1": "1", "%": "1e-2"}),
    "voltage": ({"V": 1}, {"V": "1", "mV": "1e-3", "uV": "1e-6", "kV": "1e3"}),
    "current": ({"A": 1}, {"A": "1", "mA": "1e-3", "uA": "1e-6"}),
    "charge": ({"A": 1, "s": 1}, {"C": "1", "nC": "1e-9", "pC": "1e-12"}),
    "count": ({"count": 1}, {"count": "1", "counts": "1"}),
    "acceleration": (
        {"m": 1, "s": -2},
        {
            "m/s^2": "1",
            "m/s2": "1",
            "m/s/s": "1",
            "mm/s^2": "1e-3",
            "g": _GRAVITY,
            "gn": _GRAVITY,
            "mg": _GRAVITY / 1000,
        },
    ),
    "mass": ({"kg": 1}, {"kg": "1", "g": "1e-3", "mg": "1e-6", "t": "1e3", "lb": "0.45359237"}),
    "velocity": ({"m": 1, "s": -1}, {"m/s": "1", "mm/s": "1e-3"}),
    "length": (
        {"m": 1},
        {"m": "1", "dm": "0.1", "cm": "1e-2", "mm": "1e-3", "um": "1e-6", "nm": "1e-9"}
        | {"in": _INCH, "ft": 12 * _INCH},
    ),
    "volume": ({"m": 3}, {"l": "1e-3", "ml": "1e-6"}),
    "time": ({"s": 1}, {"s": "1", "ms": "1e-3", "us": "1e-6", "min": "60", "h": "3600"}),
    "force": (
        {"kg": 1, "m": 1, "s": -2},
        {"N": "1", "kN": "1e3", "MN": "1e6", "mN": "1e-3", "lbf": _POUND_FORCE, "kgf": _GRAVITY},
    ),
    "impulse": ({"kg": 1, "m": 1, "s": -1}, {"Ns": "1"}),
    "torque": (
        {"kg": 1, "m": 2, "s": -2},
        {"N m": "1", "Nm": "1", "kN m": "1e3", "kNm": "1e3", "mNm": "1e-3", "Nmm": "1e-3"},
    ),
    "pressure": (
        {"kg": 1, "m": -1, "s": -2},
        {
            "Pa": "1",
            "kPa": "1e3",
            "MPa": "1e6",
            "GPa": "1e9",
            "hPa": "1e2",
            "bar": "1e5",
            "mbar": "1e2",
            "psi": _POUND_FORCE / _INCH**2,
        },
    ),
    "strain": ({}, {"m/m": "1", "um/m": "1e-6", "mm/m": "1e-3"}),
    "angle": ({"rad": 1}, {"rad": "1", "mrad": "1e-3"}),
    "angular velocity": ({"rad": 1, "s": -1}, {"rad/s": "1"}),
    "angular acceleration": ({"rad": 1, "s": -2}, {"rad/s^2": "1"}),
}
# The same with a factor pi. Hz is a corner or a speed in turns a second.
_TURNING: dict[str, tuple[dict[str, int], dict[str, str | Fraction]]] = {
    "angle": ({"rad": 1}, {"deg": Fraction(1, 180), "rev": "2"}),
    "angular velocity": (
        {"rad": 1, "s": -1},
        {"deg/s": Fraction(1, 180), "rpm": Fraction(1, 30), "Hz": "2", "kHz": "2000"},
    ),
    "angular acceleration": ({"rad": 1, "s": -2}, {"deg/s^2": Fraction(1, 180)}),
}


def _named() -> dict[str, tuple[Unit, ...]]:
    out: dict[str, tuple[Unit, ...]] = {}
    for turns, table in ((0, _SI), (1, _TURNING)):
        for quantity_, (exponents, units) in table.items():
            for name, scale in units.items():
                made = Unit(Fraction(scale), turns, _dimension(exponents), quantity_)
                out[name] = (*out.get(name, ()), made)
    return out


_NAMED = _named()
_SPELLINGS = str.maketrans(
    {"µ": "u", "μ": "u", "²": "^2", "³": "^3", "⁴": "^4", "·": " ", "*": " ", "°": "deg"}
)
_TOKEN = re.compile(r"\s*(?:(?P<unit>[A-Za-z%]+|1)(?:\^?(?P<power>-?\d{1,2}))?|(?P<sign>[/()]))")
MOST_TOKENS = 24  # of one unit; ours have at most eight


def _meanings(unit: str) -> tuple[Unit, ...]:
    """All that a unit may mean, () if it is not known."""
    plain = " ".join(unit.translate(_SPELLINGS).replace("^^", "^").split())
    if plain.startswith("(") and plain.endswith(")") and "(" not in plain[1:]:
        plain = plain[1:-1].strip()
    return _NAMED.get(plain) or _product(plain)


def _product(text: str) -> tuple[Unit, ...]:
    """A product of named units; each / is for the next factor or bracket alone."""
    tokens: list[re.Match[str]] = []
    at = 0
    while at < len(text):
        found = _TOKEN.match(text, at)
        if not found or len(tokens) == MOST_TOKENS:
            return ()
        tokens.append(found)
        at = found.end()
    choices: list[list[Unit]] = []
    signs, sign = [1], 1
    for token in tokens:
        match token["sign"]:
            case "/":
                sign = -sign
            case "(":
                signs.append(signs[-1] * sign)
                sign = 1
            case ")":
                signs.pop()
                if not signs:
                    return ()
            case _:
                power = signs[-1] * sign * int(token["power"] or 1)
                choices.append([u.to_the(power) for u in _NAMED.get(token["unit"], ())])
                sign = 1
    if len(signs) != 1 or sign != 1 or not choices:
        return ()
    return tuple(_joined(each) for each in product(*choices))


def _joined(units: tuple[Unit, ...]) -> Unit:
    whole = Unit(Fraction(1), 0, ())
    for unit in units:
        whole = whole * unit
    return whole


def pretty(words: str) -> str:
    """Units in words as they are printed: `m/s\u00b2`; files and channels have `m/s^2`."""
    return words.replace("^2", "\u00b2").replace("^3", "\u00b3").replace("^4", "\u2074")


def quantity(unit: str) -> str:
    """What a unit measures, as "acceleration"; "" for a unit that is not known or a product."""
    found = _meanings(unit)
    return found[0].quantity if found else ""


def others(unit: str) -> str:
    """`, or mm, um, in, ft`: the names of other units of the same quantity; "" for none."""
    wanted = {meaning.dimension for meaning in _meanings(unit)}
    names = [
        name
        for name, meant in _NAMED.items()
        if name != unit and any(m.dimension in wanted for m in meant)
    ]
    return f", or {', '.join(names)}" if names else ""


def _pairs(given: str, wanted: str) -> Iterator[tuple[Unit, Unit]]:
    for a, b in product(_meanings(given), _meanings(wanted)):
        if a.dimension == b.dimension:
            yield a, b


def factor(given: str, wanted: str) -> float | None:
    """What a value in `given` is multiplied by to be in `wanted`; None if they measure different
    things, or one is not known and they are not written alike."""
    return convert(1.0, given, wanted)


def convert(value: float, given: str, wanted: str) -> float | None:
    """`value` of unit `given` in `wanted`, rounded once (and once more by a factor pi); None as
    `factor`."""
    if given == wanted or not isfinite(value):
        return value if given == wanted or next(_pairs(given, wanted), None) else None
    for a, b in _pairs(given, wanted):
        # As the number was written: 0.1 is a tenth.
        exact = Fraction(repr(float(value))) * a.scale / b.scale
        try:
            return float(exact) * pi ** (a.turns - b.turns)
        except OverflowError:  # larger than any float, which who reads it refuses
            return inf if exact > 0 else -inf
    return None
