"""What the tables of a rig file say of each other: every name that one gives stands in another.

One function a table. Each raises ValueError, in one line, for the first that is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from samii_rig.rig.schema.axial import check_motion
from samii_rig.rig.schema.elements import (
    ANGLE_SOURCES,
    BEAMS,
    LINES,
    MOTION_SOURCES,
    SOURCES,
    Cylinder,
    LumpedMass,
    RigidLink,
    Source,
    VelocitySource,
    flattened,
    input_unit,
)
from samii_rig.rig.schema.pose import check_bend, check_gravity
from samii_rig.rig.schema.sensors import (
    Acceleration,
    Current,
    Pressure,
    RelativeAngle,
    Strain,
    places,
)

if TYPE_CHECKING:
    from samii_rig.rig.schema.elements import Element
    from samii_rig.rig.schema.rig import Rig
    from samii_rig.rig.schema.sensors import Sensor


def check_references(rig: Rig) -> None:
    """All of them, in the order in which a person reads the file."""
    unlike(e.name for e in flattened(rig.element))
    check_motion(rig)
    check_gravity(rig)
    check_bend(rig)
    _check_inputs(rig)
    _check_sensors(rig)
    _check_channels(rig)
    _check_limits(rig)
    _check_agreements(rig)
    _check_centring(rig)
    _check_feedback(rig)


def unlike(names: Iterable[str]) -> None:
    """Names of one table differ; else ValueError with the first that does not."""
    known = set[str]()
    for name in names:
        if name in known:
            raise ValueError(f"name {name!r} occurs twice; expected each once")
        known.add(name)


def _check_inputs(rig: Rig) -> None:
    """Every source has an actuator, every line a source, every actuator an element."""
    for before, e in zip((None, *rig.element), rig.element, strict=False):
        if isinstance(e, SOURCES):
            _check_source(e, rig)
        elif isinstance(e, LINES) and not (
            isinstance(before, ANGLE_SOURCES) and before.name == e.source
        ):
            raise ValueError(
                f"element {e.name}: source {e.source!r} is no angular velocity source right "
                "before it; expected one, as the line carries its flow"
            )
    driven = {e.input for e in rig.element if isinstance(e, SOURCES)}
    for a in rig.actuator:
        if a.name not in driven:
            raise ValueError(f"actuator {a.name}: drives no element; expected one with this input")


def _check_source(e: Source, rig: Rig) -> None:
    """It has an input, and its gain the unit that goes with that."""
    inputs = {a.name: a for a in rig.actuator}
    if e.input not in inputs:
        raise ValueError(
            f"element {e.name}: input {e.input!r} is no actuator; expected one of {sorted(inputs)}"
        )
    expected = input_unit(e.kind, inputs[e.input].unit)
    if e.K.unit != expected:
        raise ValueError(f"element {e.name}: K has unit {e.K.unit!r}; expected {expected!r}")


def _check_sensors(rig: Rig) -> None:
    order = [e.name for e in rig.element]
    for s in rig.sensor:
        for name in places(s):
            if name not in order:
                raise ValueError(
                    f"sensor {s.name}: element {name!r} does not exist; expected one of {order}"
                )
        if isinstance(s, RelativeAngle):
            _check_across(s, rig)
        if isinstance(s, Acceleration):
            _check_position(s, rig)
        if isinstance(s, Strain):
            _check_gauge(s, rig)
        if isinstance(s, Pressure) and s.chamber is not None:
            _check_kind(s, s.after, rig, (Cylinder,), "a cylinder, which has chambers")
        if isinstance(s, Pressure) and s.area is not None:
            drives = "a cylinder, or the velocity source that stands for one"
            _check_kind(s, s.after, rig, (Cylinder, VelocitySource), drives)
        if isinstance(s, Current):
            _check_kind(s, s.of, rig, SOURCES, "a source")


def _check_across(s: RelativeAngle, rig: Rig) -> None:
    """Neighbours in the chain's order, and a line's two ends together."""
    order = [e.name for e in rig.element]
    at = [order.index(n) for n in s.across]
    if at != list(range(at[0], at[0] + len(at))):
        raise ValueError(
            f"sensor {s.name}: across {list(s.across)} are not neighbours in this "
            f"order; expected consecutive elements of {order}"
        )
    lines = {e.source: e.name for e in rig.element if isinstance(e, LINES)}
    for name in s.across:
        if name in lines and lines[name] not in s.across:
            raise ValueError(
                f"sensor {s.name}: across {name} without {lines[name]}; expected "
                "both, as the source's flow turns the vane at the line's other end"
            )


def _check_position(s: Acceleration, rig: Rig) -> None:
    """On what moves, and no further along than it is long."""
    host = next(e for e in rig.element if e.name == s.on)
    if not isinstance(host, (*BEAMS, RigidLink, LumpedMass, *MOTION_SOURCES)):
        raise ValueError(
            f"sensor {s.name}: {s.on} has no extent; expected a link or beam, a mass or a table"
        )
    length = host.L.value if isinstance(host, (*BEAMS, RigidLink)) else 0.0
    if s.position > length:
        raise ValueError(
            f"sensor {s.name}: position {s.position:g} m lies beyond {s.on}; "
            f"expected at most {length:g} m"
        )


def _check_gauge(s: Strain, rig: Rig) -> None:
    """On a beam and before its end, where the next element begins."""
    _check_kind(s, s.on, rig, BEAMS, "a beam")
    length = next(e.L.value for e in rig.element if isinstance(e, BEAMS) and e.name == s.on)
    if s.position >= length:
        raise ValueError(
            f"sensor {s.name}: position {s.position:g} m is not on {s.on}; "
            f"expected less than {length:g} m"
        )


def _check_kind(
    s: Sensor, name: str, rig: Rig, kinds: tuple[type[Element], ...], said: str
) -> None:
    host = next(e for e in rig.element if e.name == name)
    if not isinstance(host, kinds):
        raise ValueError(f"sensor {s.name}: {name} is of kind {host.kind!r}; expected {said}")


def _check_channels(rig: Rig) -> None:
    """Actuators, sensors and monitors share one list of names."""
    clash = {a.name for a in rig.actuator} & {s.name for s in rig.sensor}
    if clash:
        raise ValueError(f"sensor {min(clash)}: an actuator has that name; expected another")
    clash = {m.name for m in rig.monitor} & {x.name for x in (*rig.actuator, *rig.sensor)}
    if clash:
        raise ValueError(
            f"monitor {min(clash)}: a sensor or actuator has that name; expected another"
        )


def _check_limits(rig: Rig) -> None:
    units, monitors = rig.units(), {m.name for m in rig.monitor}
    for limit in rig.limit:
        if limit.channel not in units:
            raise ValueError(
                f"limit on {limit.channel!r}: no such channel; expected one of {sorted(units)}"
            )
        if limit.unit != units[limit.channel]:
            raise ValueError(
                f"limit on {limit.channel}: unit {limit.unit!r}; expected {units[limit.channel]!r}"
            )
        if limit.min is not None and limit.channel not in monitors:
            raise ValueError(
                f"limit on {limit.channel}: min {limit.min:g}; expected none, as only a "
                "monitor has one"
            )


def _check_agreements(rig: Rig) -> None:
    units, inputs = rig.units(), {a.name for a in rig.actuator}
    known = [s.name for s in rig.sensor]
    for pair in rig.agreement:
        one, other = pair.sensor, pair.other
        where = f"agreement of {one} with {other}"
        if one not in known or other not in units or one == other:
            raise ValueError(f"{where}: expected a sensor, one of {known}, and another channel")
        if (pair.over is not None) != (other in inputs):
            raise ValueError(f"{where}: expected over, s, with an actuator and only then")
        if pair.over is None and units[one] != units[other]:
            raise ValueError(f"{where}: units {units[one]!r} and {units[other]!r}; expected one")


def _check_centring(rig: Rig) -> None:
    """No loop on no sensor, no sensor in two loops, and the first one where it belongs."""
    first = rig.actuator[0]
    if first.centring is not None:
        raise ValueError(
            f"actuator {first.name}: centring on {first.centring.sensor!r}; expected the table "
            "[centring], as this is the rig's first actuator"
        )
    known, owner = [s.name for s in rig.sensor], dict[str, str]()
    for a in rig.actuator:
        loop = rig.centring_of(a.name)
        if loop is None:
            continue
        where = "centring" if a is first else f"actuator {a.name}: centring"
        if loop.sensor not in known:
            raise ValueError(
                f"{where}: sensor {loop.sensor!r} does not exist; expected one of {known}"
            )
        if loop.sensor in owner:
            raise ValueError(
                f"{where}: sensor {loop.sensor!r} centres {owner[loop.sensor]} already; expected "
                "one that this actuator turns"
            )
        owner[loop.sensor] = a.name


def _check_feedback(rig: Rig) -> None:
    units = rig.units()
    for loop in rig.feedback:
        for what, name, known in (
            ("sensor", loop.sensor, [s.name for s in rig.sensor]),
            ("actuator", loop.actuator, [a.name for a in rig.actuator]),
        ):
            if name not in known:
                raise ValueError(
                    f"feedback {loop.name}: {what} {name!r} does not exist; expected one of {known}"
                )
        unit = f"{units[loop.actuator]}/({units[loop.sensor]})"
        if loop.unit != unit:
            raise ValueError(f"feedback {loop.name}: unit {loop.unit!r} of F(s); expected {unit!r}")
