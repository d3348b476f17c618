"""Rigs that the tests of the finite element model share."""

from typing import Any

from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig, TorsionalSpring, elements

SOURCE = ("source", "angular_velocity_source", {"K": 0.5, "p": 150.0})
Part = tuple[str, str, dict[str, Any]]
KINDS = {
    kind.model_fields["kind"].annotation.__args__[0]: kind
    for kind in (
        *elements.SOURCES, *elements.BEAMS, elements.RigidLink, elements.LumpedMass,
        elements.TorsionalSpring, elements.TranslationalSpring, elements.TorsionalGroundSpring,
        elements.TranslationalGroundSpring, elements.GravityStiffness, elements.OilColumn,
        elements.HydraulicLine, elements.LumpedLine, elements.Branch,
    )
}  # fmt: skip
GAIN = {"torque_source": "N m/V", "force_source": "N/V"}  # others: rad/(s V)


def element(name: str, kind: str, values: dict[str, Any]) -> dict[str, Any]:
    """The table of an element; numbers become parameters in the unit that the kind asks for."""
    table: dict[str, Any] = {"name": name, "kind": kind}
    if kind.endswith(("source", "source_2")):
        table["input"] = "v"
    for key, value in values.items():
        if not isinstance(value, float):
            table[key] = value
            continue
        quantity = elements.quantities(KINDS[kind]).get(key)
        unit = GAIN.get(kind, "rad/(s V)") if quantity is None else quantity.unit
        table[key] = {"value": value, "unit": unit, "source": "test"}
    return table


def chain(*parts: Part, base: str = "clamped", tip: str = "free", sensors: Any = None) -> Rig:
    """A chain of (name, kind, values), by default with an encoder at its element "source"."""
    angle = {"name": "y", "kind": "relative_angle", "across": ["source"], "unit": "rad"}
    return Rig.model_validate(
        {
            "name": "test", "base": base, "tip": tip, "rate_hz": 500.0,
            "element": [element(*part) for part in parts], "sensor": sensors or [angle],
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
    changed = tuple(
        e.model_copy(update={"k": e.k.model_copy(update={"value": values[e.name]})})
        if isinstance(e, TorsionalSpring) and e.name in values
        else e
        for e in rig.element
    )
    return rig.model_copy(update={"element": changed})


def undamped(rig: Rig) -> Rig:
    """The rig without any damping, for the transfer matrices' natural frequencies."""
    kept = tuple(
        e.model_copy(
            update={
                symbol: getattr(e, symbol).model_copy(update={"value": 0.0})
                for symbol in ("c", "tau", "eta")
                if hasattr(e, symbol)
            }
        )
        for e in rig.element
    )
    return rig.model_copy(update={"element": kept})
