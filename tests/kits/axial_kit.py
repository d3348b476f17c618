"""Chains that move along themselves, a line an element."""

from typing import Any

from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import AXIAL, input_unit, quantities

KINDS = {word: kind for kind in AXIAL for word in kind.model_fields["kind"].annotation.__args__}
SECOND = {"omega": 60.0, "zeta": 0.4}


def part(kind: str, name: str = "", **values: float) -> dict[str, Any]:
    """The table of an element, its units filled in."""
    units = {symbol: q.unit for symbol, q in quantities(KINDS[kind]).items()}
    out: dict[str, Any] = {"kind": kind, "name": name or kind}
    if kind.endswith("source"):
        out["input"] = "v"
        units["K"] = input_unit(kind, "V")
    for symbol, value in values.items():
        out[symbol] = {"value": value, "unit": units[symbol], "source": "test"}
    return out


def branch(*inner: dict[str, Any], name: str = "side", tip: str = "free") -> dict[str, Any]:
    return {"kind": "branch", "name": name, "tip": tip, "element": list(inner)}


def place(kind: str, after: str, name: str = "y", **more: Any) -> dict[str, Any]:
    """The table of a sensor."""
    unit = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s^2", "force": "N"}[kind]
    where = "on" if kind == "acceleration" else "after"
    return {"name": name, "kind": kind, where: after, "unit": unit, **more}


def axial(
    *parts: dict[str, Any], sensor: Any, base: str = "clamped", tip: str = "free", **more: Any
) -> Rig:
    """A rig of these tables, with one actuator v in volts."""
    return Rig.model_validate(
        {
            "name": "test", "motion": "axial", "base": base, "tip": tip, "rate_hz": 500.0,
            "element": list(parts), "sensor": sensor,
            "actuator": [{"name": "v", "unit": "V", "low": -1.0, "high": 1.0}], **more,
        }
    )  # fmt: skip
