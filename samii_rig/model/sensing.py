"""What the sensors of a rig read of the states at the ports, as the kernels' terms."""

from __future__ import annotations

from collections.abc import Sequence

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


def terms(rig: Rig, places: Sequence[tuple[str, float]]) -> tuple[Int, Float]:
    """`term` and `term_c` of `System`; places : the ports, see `CompiledChain`."""
    elements = {e.name: e for e in rig.element}
    behind = {name: port for port, (name, _) in enumerate(places)}  # the last of its ports
    before = {}
    port = 0
    for name in elements:
        before[name] = port
        port = behind[name]
    term: list[tuple[int, int, int, int]] = []
    term_c: list[tuple[float, float, float, float]] = []

    def add(
        i: int,
        port: int,
        w: float = 0.0,
        theta: float = 0.0,
        M: float = 0.0,
        V: float = 0.0,
        factor: int = ONE,
        spring: int = -1,
    ) -> None:
        term.append((i, port, factor, spring))
        term_c.append((w, theta, M, V))

    for i, sensor in enumerate(rig.sensor):
        match sensor:
            case RelativeAngle():
                # Summed over the parts, not theta behind less theta before: the rotation of
                # the whole may be much larger than that of the joint.
                for name in sensor.across:
                    element = elements[name]
                    law = POINTS.get(element.kind)
                    if law and law.pair == THETA_M:
                        add(i, before[name], M=1.0, factor=COMPLIANCE, spring=before[name])
                    elif isinstance(element, (*BEAMS, Gear)):
                        add(i, behind[name], theta=1.0)
                        add(i, before[name], theta=-1.0)
            case AbsoluteAngle():
                add(i, behind[sensor.after], theta=1.0)
            case Moment():
                add(i, behind[sensor.after], M=1.0)
            case Displacement() | Velocity():
                factor = VELOCITY if isinstance(sensor, Velocity) else ONE
                add(i, behind[sensor.after], w=1.0, factor=factor)
                if sensor.against is not None:
                    add(i, behind[sensor.against], w=-1.0, factor=factor)
            case Force():
                add(i, behind[sensor.after], V=-1.0)
            case Pressure():
                add(i, behind[sensor.after], V=1.0 / (sensor.area or 1.0))
            case Strain():
                port = before[sensor.on]
                if sensor.position > 0:
                    port = places.index((sensor.on, sensor.position))
                add(i, port, M=-sensor.height)
            case Current():
                source = elements[sensor.of]
                if isinstance(source, ANGLE_SOURCES):
                    add(i, behind[sensor.of], M=-1.0 / sensor.constant)
                elif isinstance(source, MOTION_SOURCES):
                    add(i, behind[sensor.of], V=1.0 / sensor.constant)
            case Acceleration():
                port, arm = before[sensor.on], sensor.position
                if isinstance(elements[sensor.on], BEAMS):
                    arm = 0.0
                    if sensor.position > 0:
                        port = places.index((sensor.on, sensor.position))
                elif not isinstance(elements[sensor.on], RigidLink):
                    port = behind[sensor.on]  # a table moves what is behind it
                add(i, port, w=1.0, theta=arm, factor=ACCELERATION)
                if sensor.tilt:
                    add(i, port, theta=sensor.tilt * rig.tilt_gravity(sensor.on))
    return (
        np.array(term, dtype=np.int64).reshape(-1, 4),
        np.array(term_c, dtype=np.float64).reshape(-1, 4),
    )
