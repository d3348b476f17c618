"""Units of measured quantities as people write them, and exact factors between them."""

from __future__ import annotations

from math import pi

STANDARD_GRAVITY = 9.80665  # m/s^2, exactly
_BAR, _PSI = 1e5, 6894.757293168361  # Pa; 1 lbf/in^2 = 4.4482216152605 N / (25.4 mm)^2

# Quantity -> unit -> how many SI units it is.
_QUANTITIES: dict[str, dict[str, float]] = {
    "voltage": {"V": 1.0, "mV": 1e-3, "uV": 1e-6, "kV": 1e3},
    "current": {"A": 1.0, "mA": 1e-3, "uA": 1e-6},
    "charge": {"C": 1.0, "nC": 1e-9, "pC": 1e-12},
    "count": {"count": 1.0, "counts": 1.0},
    "acceleration": {
        "m/s^2": 1.0,
        "m/s2": 1.0,
        "m/s/s": 1.0,
        "mm/s^2": 1e-3,
        "g": STANDARD_GRAVITY,
        "gn": STANDARD_GRAVITY,
        "mg": 1e-3 * STANDARD_GRAVITY,
    },
    "velocity": {"m/s": 1.0, "mm/s": 1e-3},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": pi / 180, "rev": 2 * pi},
    "angular velocity": {"rad/s": 1.0, "deg/s": pi / 180, "rpm": pi / 30},
    "angular acceleration": {"rad/s^2": 1.0, "deg/s^2": pi / 180},
    "force": {"N": 1.0, "kN": 1e3, "mN": 1e-3, "lbf": 4.4482216152605},
    "torque": {"N m": 1.0, "Nm": 1.0, "kN m": 1e3, "kNm": 1e3},
    "pressure": {
        "Pa": 1.0,
        "kPa": 1e3,
        "MPa": 1e6,
        "hPa": 1e2,
        "bar": _BAR,
        "mbar": 1e-3 * _BAR,
        "psi": _PSI,
    },
    "strain": {"m/m": 1.0, "um/m": 1e-6, "mm/m": 1e-3},
}
_OF = {unit: (what, f) for what, units in _QUANTITIES.items() for unit, f in units.items()}
_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "²": "^2", "·": " ", "*": " "})


def _known(unit: str) -> tuple[str, float] | None:
    plain = " ".join(unit.translate(_SPELLINGS).replace("^^", "^").split())
    plain = plain.replace("°", "deg")
    if plain.startswith("(") and plain.endswith(")"):
        plain = plain[1:-1].strip()
    return _OF.get(plain)


def quantity(unit: str) -> str:
    """What a unit measures, as "acceleration"; "" for a unit that is not known."""
    found = _known(unit)
    return found[0] if found else ""


def factor(given: str, wanted: str) -> float | None:
    """What a value in `given` is multiplied by to be in `wanted`; None if they measure different
    things, or one is not known and they are not written alike."""
    if given == wanted:
        return 1.0
    a, b = _known(given), _known(wanted)
    if a is None or b is None or a[0] != b[0]:
        return None
    return a[1] / b[1]
