"""The rig file: a serial chain, its sensors, its actuator, its limits.

The elements of the chain stand in `samii_rig.rig.elements` and are found here as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from samii_rig.rig.axial import check_motion
from samii_rig.rig.conversion import in_si
from samii_rig.rig.elements import (
    ANGLE_SOURCES,
    BEAMS,
    LINES,
    MOTION_SOURCES,
    SOURCES,
    AccelerationSource,
    AngularVelocitySource,
    AngularVelocitySource2,
    Beam,
    Branch,
    Cylinder,
    DisplacementSource,
    Element,
    End,
    Finite,
    ForceSource,
    Gear,
    GravityStiffness,
    HydraulicLine,
    LumpedLine,
    LumpedMass,
    Motion,
    Name,
    NonNegative,
    OilColumn,
    Parameter,
    Positive,
    RigidLink,
    Rod,
    Source,
    Spindle,
    Strict,
    TimoshenkoBeam,
    TorqueSource,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
    VelocitySource,
    flattened,
    input_unit,
    parameters,
)
from samii_rig.rig.pose import Pose, check_gravity, pull
from samii_rig.rig.sensors import (
    AbsoluteAngle,
    Acceleration,
    AntiAlias,
    Displacement,
    Force,
    Moment,
    Pressure,
    RelativeAngle,
    Sensor,
    SensorBase,
    Velocity,
    places,
)
from samii_rig.units import STANDARD_GRAVITY

__all__ = [
    "ANGLE_SOURCES",
    "BEAMS",
    "LINES",
    "MOTION_SOURCES",
    "SOURCES",
    "AbsoluteAngle",
    "Acceleration",
    "AccelerationSource",
    "ActuatorSpec",
    "Agreement",
    "AngularVelocitySource",
    "AngularVelocitySource2",
    "AntiAlias",
    "Beam",
    "Branch",
    "Centring",
    "Cylinder",
    "Device",
    "Displacement",
    "DisplacementSource",
    "Element",
    "Feedback",
    "Finite",
    "Force",
    "ForceSource",
    "Gear",
    "GravityStiffness",
    "HydraulicLine",
    "Limit",
    "LumpedLine",
    "LumpedMass",
    "Moment",
    "Monitor",
    "Name",
    "NonNegative",
    "OilColumn",
    "Parameter",
    "Positive",
    "Pressure",
    "RelativeAngle",
    "Rig",
    "RigidLink",
    "Rod",
    "Sensor",
    "SensorBase",
    "Service",
    "Source",
    "Spindle",
    "Strict",
    "TimoshenkoBeam",
    "TorqueSource",
    "TorsionalGroundSpring",
    "TorsionalSpring",
    "TranslationalGroundSpring",
    "TranslationalSpring",
    "Velocity",
    "VelocitySource",
    "flattened",
    "parameters",
    "places",
]


class Monitor(Strict):
    """A channel that says how the rig is and that the chain's model knows nothing of: a supply
    pressure, an oil temperature, the force in a strut. It is recorded and held to its limits.

    usual : its value on a rig that is well, in `unit`; what a simulated rig shows.
    low, high, resolution, stale_after : as of a sensor.
    """

    name: Name
    unit: str = Field(min_length=1)
    usual: Finite
    low: float = -math.inf
    high: float = math.inf
    resolution: NonNegative = 0.0
    stale_after: Positive = 0.05
    calibration: str = Field(default="", description="how unit and scale are known")

    @model_validator(mode="after")
    def _range(self) -> Self:
        if not self.low < self.usual < self.high:
            raise ValueError(
                f"low {self.low:g}, usual {self.usual:g}, high {self.high:g}; expected them to rise"
            )
        return self


class Centring(Strict):
    """The loop that keeps the joint centred: v = u + kp (theta_ref - theta).

    It runs in the device, at the sample rate. kp is in actuator units per sensor unit.
    """

    sensor: Name
    kp: NonNegative


class ActuatorSpec(Strict):
    """The input of the rig: the converter that drives an angular velocity source.

    The converter holds each sample until the next (zero-order hold); `delay` s pass
    between a sample's time stamp and the moment the output changes. `deadman` s after the
    last command the device itself drops its output to zero; without it the rig cannot be armed.

    centring : the loop on this output, where it is not the rig's first; that of the first is the
        rig's own [centring].
    """

    name: Name
    unit: str
    low: Finite
    high: Finite
    resolution: NonNegative = 0.0
    delay: NonNegative = 0.0
    deadman: Positive | None = None
    centring: Centring | None = None

    @model_validator(mode="after")
    def _range(self) -> Self:
        if not self.low < 0 < self.high:
            raise ValueError(f"low {self.low:g}, high {self.high:g}; expected 0 between them")
        return self


class Limit(Strict):
    """What a channel must never exceed while the actuator is live, and why.

    max : largest absolute value, in `unit`. max_rate : largest absolute change, unit/s.
    min : smallest value; of a monitor only, such as a supply pressure.
    """

    channel: Name
    unit: str
    max: Positive
    min: Finite | None = None
    max_rate: Positive | None = None
    reason: str = Field(min_length=1)

    @model_validator(mode="after")
    def _range(self) -> Self:
        if self.min is not None and not self.min < self.max:
            raise ValueError(f"min {self.min:g}, max {self.max:g}; expected min below max")
        return self


class Agreement(Strict):
    """Two channels that tell of one thing: if they part, one of them drifts, and no run goes on.

    sensor : an angle, for instance the one that the centring reads. other : a sensor or monitor of
        the same unit, such as a potentiometer; or the actuator whose angular velocity source turns
        it. over : s over which the way of sensor and source is compared and then forgotten; given
        with an actuator, and only then. max : by which they may part, in the sensor's unit.
    """

    sensor: Name
    other: Name
    max: Positive
    over: Positive | None = None
    reason: str = Field(min_length=1)


class Device(Strict):
    """Which driver opens the rig (an entry point of `samii_rig.devices`) and its settings."""

    driver: str = "simulated"
    settings: dict[str, Any] = Field(default_factory=dict)

    @property
    def simulated(self) -> bool:
        """Nothing moves: the rig is computed in this process, and hurts nobody."""
        return self.driver == "simulated"


class Service(Strict):
    """What `samii-rig serve` does with this rig.

    when_lost : whether a run goes on or stops when the service is gone (killed, crashed) while
        it drives; a service that is started again finds it, either way.
    """

    when_lost: Literal["go_on", "stop"] = "go_on"


MOST_STATES = 8  # of one feedback filter; a damping loop has one to four
Root = Finite | tuple[Finite, Finite]
Roots = Annotated[tuple[Root, ...], Field(max_length=MOST_STATES)]
Coefficients = Annotated[tuple[Finite, ...], Field(max_length=MOST_STATES + 1)]


class Feedback(Strict):
    """A loop that the device closes from a sensor to an actuator, beside the centring:

        v = u + kp (theta_ref - theta) + sum over the loops of clip(F(s) y, -max, max).

    F(s) = gain prod(s - zeros)/prod(s - poles) or gain numerator/denominator, one of the two
    forms; it runs at the sample rate (`samii_rig.model.feedback`) whenever the output is live.

    unit : of F(s), actuator unit per sensor unit.
    zeros, poles : rad/s; [re, im] with im above 0 is a pair and counts its conjugate too.
    numerator, denominator : coefficients of falling powers of s.
    max : largest |output| of this loop, in the actuator's unit; the device clips it there.
    """

    name: Name
    sensor: Name
    actuator: Name
    gain: Finite
    unit: str
    zeros: Roots = ()
    poles: Roots = ()
    numerator: Coefficients = ()
    denominator: Coefficients = ()
    max: Positive

    def zpk(self) -> tuple[list[complex], list[complex], float]:
        """All zeros and poles of F(s), conjugates included, and its leading gain."""
        if not self.denominator:
            return _conjugates(self.zeros), _conjugates(self.poles), self.gain
        zeros = [complex(x) for x in np.roots(self.numerator)]
        poles = [complex(x) for x in np.roots(self.denominator)]
        return zeros, poles, self.gain * self.numerator[0] / self.denominator[0]

    @model_validator(mode="after")
    def _filter(self) -> Self:
        if (self.zeros or self.poles) and (self.numerator or self.denominator):
            raise ValueError("zeros and poles beside numerator and denominator; expected one form")
        if bool(self.numerator) != bool(self.denominator):
            raise ValueError("half of a fraction; expected numerator and denominator")
        for name in ("numerator", "denominator"):
            row = getattr(self, name)
            if row and row[0] == 0:
                raise ValueError(f"{name} {list(row)}; expected a first coefficient that is not 0")
        zeros, poles, _ = self.zpk()
        if len(poles) > MOST_STATES:
            raise ValueError(f"{len(poles)} poles; expected at most {MOST_STATES}")
        if len(zeros) > len(poles):
            raise ValueError(
                f"{len(zeros)} zeros over {len(poles)} poles: not proper; "
                "expected no more zeros than poles"
            )
        for pole in poles:
            if not pole.real < 0:
                raise ValueError(
                    f"pole at {pole:.4g} rad/s: not stable; expected a real part below 0"
                )
        return self


def _conjugates(roots: tuple[Root, ...]) -> list[complex]:
    """Roots as they stand in the file, with the conjugate of every one above the real axis."""
    out: list[complex] = []
    for root in roots:
        value = complex(*root) if isinstance(root, tuple) else complex(root)
        if value.imag < 0:
            raise ValueError(f"root {value:.4g} rad/s; expected the one of the pair with im > 0")
        out += [value, value.conjugate()] if value.imag > 0 else [value]
    return out


def _unlike(names: list[str]) -> None:
    for i, name in enumerate(names):
        if name in names[:i]:
            raise ValueError(f"name {name!r} occurs twice; expected each once")


def _driven(e: Source, inputs: dict[str, ActuatorSpec]) -> None:
    """ValueError if the source has no input or its gain another unit."""
    if e.input not in inputs:
        raise ValueError(
            f"element {e.name}: input {e.input!r} is no actuator; expected one of {sorted(inputs)}"
        )
    expected = input_unit(e.kind, inputs[e.input].unit)
    if e.K.unit != expected:
        raise ValueError(f"element {e.name}: K has unit {e.K.unit!r}; expected {expected!r}")


def _check_centring(rig: Rig) -> None:
    """ValueError for a loop on no sensor, one sensor in two loops, or the first one misplaced."""
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


class Rig(Strict):
    """A rig file. Elements stand in the order base to tip.

    motion : "lateral" for a chain that bends and turns, "axial" for one that moves along itself.
    gravity : m/s^2, 0 for none. pose : angle of the straight chain, base to tip, to the way down:
        0 (if left out) it hangs, 90 deg it is level, 180 deg it stands.
    """

    name: str = Field(min_length=1)
    description: str = ""
    motion: Motion = "lateral"
    base: End
    tip: End
    rate_hz: Positive
    gravity: NonNegative = 0.0
    pose: Pose | None = None
    element: Annotated[tuple[Element, ...], Field(min_length=1)]
    sensor: Annotated[tuple[Sensor, ...], Field(min_length=1)]
    actuator: Annotated[tuple[ActuatorSpec, ...], Field(min_length=1)]
    monitor: tuple[Monitor, ...] = ()
    limit: tuple[Limit, ...] = ()
    agreement: tuple[Agreement, ...] = ()
    centring: Centring | None = None
    feedback: tuple[Feedback, ...] = ()
    device: Device = Device()
    service: Service = Service()

    @model_validator(mode="before")
    @classmethod
    def _units(cls, data: Any) -> Any:
        return in_si(data)

    @field_validator("element", "sensor", "actuator", "monitor", "feedback")
    @classmethod
    def _unique(cls, items: tuple[Any, ...]) -> tuple[Any, ...]:
        _unlike([item.name for item in items])
        return items

    @model_validator(mode="after")
    def _references(self) -> Self:
        elements = {e.name: e for e in self.element}
        order = [e.name for e in self.element]
        inputs = {a.name: a for a in self.actuator}
        _unlike([e.name for e in flattened(self.element)])
        check_motion(self)
        check_gravity(self)
        for before, e in zip((None, *self.element), self.element, strict=False):
            if isinstance(e, SOURCES):
                _driven(e, inputs)
            elif isinstance(e, LINES) and not (
                isinstance(before, ANGLE_SOURCES) and before.name == e.source
            ):
                raise ValueError(
                    f"element {e.name}: source {e.source!r} is no angular velocity source right "
                    "before it; expected one, as the line carries its flow"
                )
        driven = {e.input for e in self.element if isinstance(e, SOURCES)}
        for a in self.actuator:
            if a.name not in driven:
                raise ValueError(
                    f"actuator {a.name}: drives no element; expected one with this input"
                )
        lines = {e.source: e.name for e in self.element if isinstance(e, LINES)}
        for s in self.sensor:
            for name in places(s):
                if name not in elements:
                    raise ValueError(
                        f"sensor {s.name}: element {name!r} does not exist; expected one of {order}"
                    )
            if isinstance(s, RelativeAngle):
                at = [order.index(n) for n in s.across]
                if at != list(range(at[0], at[0] + len(at))):
                    raise ValueError(
                        f"sensor {s.name}: across {list(s.across)} are not neighbours in this "
                        f"order; expected consecutive elements of {order}"
                    )
                for name in s.across:
                    if name in lines and lines[name] not in s.across:
                        raise ValueError(
                            f"sensor {s.name}: across {name} without {lines[name]}; expected "
                            "both, as the source's flow turns the vane at the line's other end"
                        )
            if isinstance(s, Acceleration):
                host = elements[s.on]
                if not isinstance(host, (*BEAMS, RigidLink, LumpedMass, *MOTION_SOURCES)):
                    raise ValueError(
                        f"sensor {s.name}: {s.on} has no extent; expected a link or beam, a mass "
                        "or a table"
                    )
                length = host.L.value if isinstance(host, (*BEAMS, RigidLink)) else 0.0
                if s.position > length:
                    raise ValueError(
                        f"sensor {s.name}: position {s.position:g} m lies beyond {s.on}; "
                        f"expected at most {length:g} m"
                    )
        units = self.units()
        clash = set(inputs) & {s.name for s in self.sensor}
        if clash:
            raise ValueError(f"sensor {min(clash)}: an actuator has that name; expected another")
        clash = {m.name for m in self.monitor} & {x.name for x in (*self.actuator, *self.sensor)}
        if clash:
            raise ValueError(
                f"monitor {min(clash)}: a sensor or actuator has that name; expected another"
            )
        for limit in self.limit:
            if limit.channel not in units:
                raise ValueError(
                    f"limit on {limit.channel!r}: no such channel; expected one of {sorted(units)}"
                )
            if limit.unit != units[limit.channel]:
                raise ValueError(
                    f"limit on {limit.channel}: unit {limit.unit!r}; "
                    f"expected {units[limit.channel]!r}"
                )
            if limit.min is not None and limit.channel not in {m.name for m in self.monitor}:
                raise ValueError(
                    f"limit on {limit.channel}: min {limit.min:g}; expected none, as only a "
                    "monitor has one"
                )
        for pair in self.agreement:
            one, other = pair.sensor, pair.other
            where, known = f"agreement of {one} with {other}", [s.name for s in self.sensor]
            if one not in known or other not in units or one == other:
                raise ValueError(f"{where}: expected a sensor, one of {known}, and another channel")
            if (pair.over is not None) != (other in inputs):
                raise ValueError(f"{where}: expected over, s, with an actuator and only then")
            if pair.over is None and units[one] != units[other]:
                raise ValueError(
                    f"{where}: units {units[one]!r} and {units[other]!r}; expected one"
                )
        _check_centring(self)
        for loop in self.feedback:
            for what, name, known in (
                ("sensor", loop.sensor, [s.name for s in self.sensor]),
                ("actuator", loop.actuator, [a.name for a in self.actuator]),
            ):
                if name not in known:
                    raise ValueError(
                        f"feedback {loop.name}: {what} {name!r} does not exist; "
                        f"expected one of {known}"
                    )
            unit = f"{units[loop.actuator]}/({units[loop.sensor]})"
            if loop.unit != unit:
                raise ValueError(
                    f"feedback {loop.name}: unit {loop.unit!r} of F(s); expected {unit!r}"
                )
        return self

    def centring_of(self, actuator: str) -> Centring | None:
        """The loop on one actuator: [centring] on the first, its own on another."""
        first, *others = self.actuator
        if actuator == first.name:
            return self.centring
        return next((a.centring for a in others if a.name == actuator), None)

    @property
    def pull(self) -> float:
        """Gravity along the chain, base to tip, m/s^2: negative where it stands."""
        return pull(self.gravity, self.pose)

    def tilt_gravity(self) -> float:
        """What a tilting accelerometer reads a rad, m/s^2: `pull`, or with no gravity in the rig
        file that of a hanging chain."""
        return self.pull if self.gravity else STANDARD_GRAVITY

    def units(self) -> dict[str, str]:
        """Unit of every channel, actuators, sensors and monitors, by name."""
        return {x.name: x.unit for x in (*self.actuator, *self.sensor, *self.monitor)}

    def limits_on(self, channel: str) -> Iterator[Limit]:
        """The limits on one channel."""
        return (limit for limit in self.limit if limit.channel == channel)
