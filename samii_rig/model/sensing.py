"""What the sensors of a rig read of the states at the ports, as the kernels' terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.model.kernels.registers import ACCELERATION, COMPLIANCE, ONE, THETA_M, VELOCITY
from samii_rig.model.laws import POINTS
from samii_rig.rig.schema import (
    ANGLE_SOURCES,
    BEAMS,
    MOTION_SOURCES,
    SOURCES,
    AbsoluteAngle,
    Acceleration,
    Current,
    Displacement,
    Force,
    ForceSource,
    Gear,
    Moment,
    Pressure,
    RelativeAngle,
    Rig,
    RigidLink,
    Sensor,
    Strain,
    TorqueSource,
    Velocity,
)
from samii_rig.types import Float, Int


def source_feed(rig: Rig) -> Float:
    """(n_sensor, n_source) what a sensor reads of the sources' own jumps: a relative angle across
    one that turns, the current of one that pushes."""
    sources = [e for e in rig.element if isinstance(e, SOURCES)]
    feed = np.zeros((len(rig.sensor), len(sources)))
    for i, sensor in enumerate(rig.sensor):
        for j, source in enumerate(sources):
            if isinstance(sensor, RelativeAngle) and isinstance(source, ANGLE_SOURCES):
                feed[i, j] = source.name in sensor.across
            elif isinstance(sensor, Current) and isinstance(source, (ForceSource, TorqueSource)):
                feed[i, j] = (source.name == sensor.of) / sensor.constant
    return feed


def reading_of(sensor: Sensor) -> tuple[str, str] | None:
    """Which law of `READINGS` a sensor has, and of which element; None for one without."""
    match sensor:
        case Strain():
            return "strain", sensor.on
        case Pressure() if sensor.chamber is not None:
            return f"chamber_{sensor.chamber}", sensor.after
    return None


@dataclass(frozen=True, slots=True)
class _Term:
    """What is read of the state z at a port: (w theta M V) z, times a factor; see `System`."""

    port: int
    w: float = 0.0
    theta: float = 0.0
    M: float = 0.0
    V: float = 0.0
    factor: int = ONE
    spring: int = -1


class _Ports:
    """The numbers of the ports about each element; places : all ports, see `CompiledChain`."""

    def __init__(self, rig: Rig, places: Sequence[tuple[str, float]]) -> None:
        self.elements = {e.name: e for e in rig.element}
        self.behind = {name: port for port, (name, _) in enumerate(places)}  # the last of its ports
        self.before: dict[str, int] = {}
        self._places = places
        port = 0
        for name in self.elements:
            self.before[name] = port
            port = self.behind[name]

    def within(self, name: str, position: float) -> int:
        """The port at `position` m from the element's upstream end."""
        return self._places.index((name, position)) if position > 0 else self.before[name]


def terms(rig: Rig, places: Sequence[tuple[str, float]]) -> tuple[Int, Float]:
    """`term` (n_term, 4) and `term_c` (n_term, 4) of `System`; places : the ports, see
    `CompiledChain`."""
    ports = _Ports(rig, places)
    found = [(i, t) for i, sensor in enumerate(rig.sensor) for t in _terms(sensor, rig, ports)]
    term = [(i, t.port, t.factor, t.spring) for i, t in found]
    term_c = [(t.w, t.theta, t.M, t.V) for _, t in found]
    return (
        np.array(term, dtype=np.int64).reshape(-1, 4),
        np.array(term_c, dtype=np.float64).reshape(-1, 4),
    )


def _terms(sensor: Sensor, rig: Rig, ports: _Ports) -> list[_Term]:
    """What a sensor reads, as a sum."""
    behind = ports.behind
    match sensor:
        case RelativeAngle():
            return _angle(sensor, ports)
        case AbsoluteAngle():
            return [_Term(behind[sensor.after], theta=1.0)]
        case Moment():
            return [_Term(behind[sensor.after], M=1.0)]
        case Displacement() | Velocity():
            factor = VELOCITY if isinstance(sensor, Velocity) else ONE
            after = [_Term(behind[sensor.after], w=1.0, factor=factor)]
            if sensor.against is None:
                return after
            return [*after, _Term(behind[sensor.against], w=-1.0, factor=factor)]
        case Force():
            return [_Term(behind[sensor.after], V=-1.0)]
        case Pressure():
            return [_Term(behind[sensor.after], V=1.0 / (sensor.area or 1.0))]
        case Strain():
            return [_Term(ports.within(sensor.on, sensor.position), M=-sensor.height)]
        case Current():
            source = ports.elements[sensor.of]
            if isinstance(source, ANGLE_SOURCES):
                return [_Term(behind[sensor.of], M=-1.0 / sensor.constant)]
            if isinstance(source, MOTION_SOURCES):
                return [_Term(behind[sensor.of], V=1.0 / sensor.constant)]
            return []  # it pushes by its input alone: `source_feed`
        case Acceleration():
            return _acceleration(sensor, rig, ports)


def _angle(sensor: RelativeAngle, ports: _Ports) -> list[_Term]:
    """Summed over the parts, not theta behind less theta before: the rotation of the whole may be
    much larger than that of the joint."""
    found = []
    for name in sensor.across:
        element = ports.elements[name]
        law = POINTS.get(element.kind)
        before = ports.before[name]
        if law and law.pair == THETA_M:
            found.append(_Term(before, M=1.0, factor=COMPLIANCE, spring=before))
        elif isinstance(element, (*BEAMS, Gear)):
            found += [_Term(ports.behind[name], theta=1.0), _Term(before, theta=-1.0)]
    return found


def _acceleration(sensor: Acceleration, rig: Rig, ports: _Ports) -> list[_Term]:
    on, arm = ports.elements[sensor.on], 0.0
    if isinstance(on, BEAMS):
        port = ports.within(sensor.on, sensor.position)
    elif isinstance(on, RigidLink):
        port, arm = ports.before[sensor.on], sensor.position
    else:
        port, arm = ports.behind[sensor.on], sensor.position  # a table moves what is behind it
    found = [_Term(port, w=1.0, theta=arm, factor=ACCELERATION)]
    if sensor.tilt:
        found.append(_Term(port, theta=sensor.tilt * rig.tilt_gravity(sensor.on)))
    return found
