"""Changes of a rig file: an element put in, a sensor or source exchanged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, get_args

from samii_rig.errors import InputError
from samii_rig.rig.schema import (
    AngularVelocitySource,
    AngularVelocitySource2,
    Branch,
    Element,
    Inertia,
    LumpedLine,
    LumpedMass,
    Parameter,
    RelativeAngle,
    Rig,
    TorsionalSpring,
    TranslationalSpring,
)
from samii_rig.rig.schema.elements import quantities

PREFIX = "added_"  # of the names of what is put in
DISPLACEMENT = 1.475e-5  # m^3/rad, of a vane motor of a joint; C_h is stated for this one
VOLUME = "m^3/Pa"  # of C_h
SOURCE = "not in the nominal rig file; identified from recordings"


def parameter(value: float, unit: str) -> Parameter:
    """A parameter of something that the nominal rig file does not have."""
    return Parameter(value=value, unit=unit, source=SOURCE)


def element_of(kind: type[Any], name: str, units: dict[str, str]) -> Any:
    """An element of `kind` with every parameter of `units` at 1, by symbol."""
    values = {symbol: parameter(1.0, unit) for symbol, unit in units.items()}
    return kind(kind=tag(kind), name=name, **values)


def units_of(kind: type[Any], *symbols: str) -> dict[str, str]:
    """Units of some parameters of an element of `kind`, of all that have one if none is said."""
    every = quantities(kind)  # type: ignore[arg-type]
    return {symbol: every[symbol].unit for symbol in symbols or every}


def tag(kind: type[Any]) -> str:
    """What a rig file calls an element of `kind`."""
    name: str = get_args(kind.model_fields["kind"].annotation)[0]
    return name


def oscillator(name: str, *, turning: bool = False) -> Branch:
    """A mass on a spring and damper across the chain, elements `name`_spring and `name`_mass.
    turning : about it: an inertia on a torsional spring."""
    spring = TorsionalSpring if turning else TranslationalSpring
    body, symbol = (Inertia, "I") if turning else (LumpedMass, "m")
    parts = (
        element_of(spring, f"{name}_spring", units_of(spring, "k", "c")),
        element_of(body, f"{name}_mass", units_of(body, symbol)),
    )
    return Branch(kind="branch", name=name, element=parts)


def line(rig: Rig, source: str, name: str) -> Rig:
    """The rig with a line in one lump right behind a source, seen by all that sees the source."""
    values = {symbol: parameter(1.0, unit) for symbol, unit in units_of(LumpedLine).items()}
    made = LumpedLine(kind="lumped_line", name=name, source=source, **values)
    order = [e.name for e in rig.element]
    at = order.index(source) + 1
    behind = order[at] if at < len(order) else None
    seen = [s.name for s in rig.sensor if isinstance(s, RelativeAngle) and source in s.across]
    sensors = tuple(_across(s, source, behind, name, seen) for s in rig.sensor)
    elements = (*rig.element[:at], made, *rig.element[at:])
    return rig.model_copy(update={"element": elements, "sensor": sensors})


def inserted(rig: Rig, after: str | None, element: Element, seen_by: Sequence[str] = ()) -> Rig:
    """The rig with `element` behind the one called `after` (None: at the base).

    What was inserted there before stays in front. `seen_by` names the relative angles at
    whose end it stands that measure across it too; one that spans both neighbours does anyhow.
    """
    order = [e.name for e in rig.element]
    at = 0 if after is None else order.index(after) + 1
    while at < len(order) and _put_in(rig.element[at]):
        at += 1
    elements = (*rig.element[:at], element, *rig.element[at:])
    before = order[at - 1] if at > 0 else None
    behind = order[at] if at < len(order) else None
    sensors = tuple(_across(s, before, behind, element.name, seen_by) for s in rig.sensor)
    return rig.model_copy(update={"element": elements, "sensor": sensors})


def _put_in(element: Element) -> bool:
    return element.name.startswith(PREFIX)


def _across(
    sensor: Any, before: str | None, behind: str | None, name: str, seen_by: Sequence[str]
) -> Any:
    if not isinstance(sensor, RelativeAngle):
        return sensor
    across = list(sensor.across)
    between = before in across and behind in across
    if between or (sensor.name in seen_by and before in across):
        across.insert(across.index(str(before)) + 1, name)
    elif sensor.name in seen_by and behind in across:
        across.insert(across.index(str(behind)), name)
    return sensor.model_copy(update={"across": tuple(across)})


def sensor_changed(rig: Rig, name: str, **update: object) -> Rig:
    """The rig with other fields of one sensor."""
    sensors = tuple(s.model_copy(update=update) if s.name == name else s for s in rig.sensor)
    return rig.model_copy(update={"sensor": sensors})


def measured_across(rig: Rig, name: str, span: Sequence[str]) -> Rig:
    """The rig with one relative angle measured from the first to the last element of `span`.

    Raises InputError where it is none, as of a sensor whose column was exchanged with another's.
    What was put in among these, or right behind them where the sensor measures across it, is seen
    all the same: oil belongs to its source.
    """
    order = [e.name for e in rig.element]
    first, last = order.index(span[0]), order.index(span[-1])
    old: Sequence[str] | None = next(
        (s.across for s in rig.sensor if isinstance(s, RelativeAngle) and s.name == name), None
    )
    if old is None:
        raise InputError(rig.name, f"sensor.{name}", "no angle", "one across elements")
    while last + 1 < len(order) and _put_in(rig.element[last + 1]) and order[last + 1] in old:
        last += 1
    return sensor_changed(rig, name, across=tuple(order[first : last + 1]))


def replaced(rig: Rig, sensor: Any) -> Rig:
    """The rig with another sensor in place of the one that has its name."""
    sensors = tuple(sensor if s.name == sensor.name else s for s in rig.sensor)
    return rig.model_copy(update={"sensor": sensors})


def actuator_changed(rig: Rig, name: str, change: Callable[[Any], dict[str, object]]) -> Rig:
    """The rig with other fields of one actuator."""
    actuators = tuple(a.model_copy(update=change(a)) if a.name == name else a for a in rig.actuator)
    return rig.model_copy(update={"actuator": actuators})


def exchanged(rig: Rig, a: str, b: str) -> Rig:
    """The rig with two sensors' channels swapped."""
    by_name = {s.name: s for s in rig.sensor}
    other = {a: by_name[b], b: by_name[a]}
    sensors = tuple(
        other[s.name].model_copy(update={"name": s.name}) if s.name in other else s
        for s in rig.sensor
    )
    return rig.model_copy(update={"sensor": sensors})


def second_order(rig: Rig, source: str, omega: float = 1.0, zeta: float = 1.0) -> Rig:
    """The rig with the lag of an angular velocity source of second order."""

    def change(e: Element) -> Element:
        if not (isinstance(e, AngularVelocitySource) and e.name == source):
            return e
        return AngularVelocitySource2(
            kind="angular_velocity_source_2",
            name=e.name,
            input=e.input,
            K=e.K,
            omega=parameter(omega, "rad/s"),
            zeta=parameter(zeta, "1"),
            tau=e.tau,
        )

    return rig.model_copy(update={"element": tuple(change(e) for e in rig.element)})
