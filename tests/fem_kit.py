"""Rigs that the tests of the finite element model share."""

from typing import Any

from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig, TorsionalSpring

UNITS = {
    "EI": "N m^2", "mu": "kg/m", "L": "m", "eta": "1", "tau": "s", "r": "m", "m": "kg",
    "I": "kg m^2", "k": "N m/rad", "c": "N m s/rad", "K": "rad/(s V)", "p": "rad/s",
}  # fmt: skip
SOURCE = ("source", "angular_velocity_source", {"K": 0.5, "p": 150.0})
Part = tuple[str, str, dict[str, float]]


def chain(*parts: Part, base: str = "clamped", tip: str = "free", sensors: Any = None) -> Rig:
    """A chain of (name, kind, values), by default with an encoder at its element "source"."""
    elements = []
    for name, kind, numbers in parts:
        values = {k: {"value": x, "unit": UNITS[k], "source": "test"} for k, x in numbers.items()}
        extra = {"input": "v"} if kind == "angular_velocity_source" else {}
        elements.append({"name": name, "kind": kind, **values, **extra})
    angle = {"name": "y", "kind": "relative_angle", "across": ["source"], "unit": "rad"}
    return Rig.model_validate(
        {
            "name": "test", "base": base, "tip": tip, "rate_hz": 500.0, "element": elements,
            "sensor": sensors or [angle],
            "actuator": [{"name": "v", "unit": "V", "low": -1.0, "high": 1.0}],
        }
    )  # fmt: skip


def samii(collocated: bool = False) -> Rig:
    """The shipped rig; `collocated` puts the encoder at the source alone (paper 1)."""
    rig = load_rig("samii")[0]
    encoder, *others = rig.sensor
    if collocated:
        encoder = encoder.model_copy(update={"across": ("joint_2_source",)})
    return rig.model_copy(update={"sensor": (encoder, *others)})


def without_springs(rig: Rig, names: set[str]) -> Rig:
    """The rig with these joints taken out of the chain, encoder at the source."""
    kept = tuple(e for e in rig.element if e.name not in names)
    encoder = rig.sensor[0].model_copy(update={"across": ("joint_2_source",)})
    return rig.model_copy(update={"element": kept, "sensor": (encoder, *rig.sensor[1:])})


def with_stiffness(rig: Rig, values: dict[str, float]) -> Rig:
    """The rig with other stiffnesses of some joints, N m/rad."""
    elements = tuple(
        e.model_copy(update={"k": e.k.model_copy(update={"value": values[e.name]})})
        if isinstance(e, TorsionalSpring) and e.name in values
        else e
        for e in rig.element
    )
    return rig.model_copy(update={"element": elements})


def undamped(rig: Rig) -> Rig:
    """The rig without any damping, for the transfer matrices' natural frequencies."""
    elements = tuple(
        e.model_copy(
            update={
                symbol: getattr(e, symbol).model_copy(update={"value": 0.0})
                for symbol in ("c", "tau", "eta")
                if hasattr(e, symbol)
            }
        )
        for e in rig.element
    )
    return rig.model_copy(update={"element": elements})
