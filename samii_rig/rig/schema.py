"""The rig file: a serial chain, its sensors, its actuator, its limits.

Every physical parameter carries its unit, its tolerance and where the number came from.
The state vector along the chain is z = [w, theta, M, V, 1] (paper 2, eq. 8), its sign
convention w' = theta, theta' = M/EI, M' = V, V' = -mu s^2 w (paper 1, eq. 1-5, where the
first state is written -w).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)

Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Strict(BaseModel):
    """A table of the rig file: unknown keys are errors, values cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="constants")


class Parameter(Strict):
    """A physical parameter.

    tolerance : relative standard deviation of `value` as a prior, 0 for exact.
    source : where the number came from, e.g. "[published] paper 1, Table II".
    """

    value: Finite
    unit: str
    tolerance: NonNegative = 0.0
    source: str = Field(min_length=1)


def _checked(unit: str, *, positive: bool) -> AfterValidator:
    def check(parameter: Parameter) -> Parameter:
        if parameter.unit != unit:
            raise ValueError(f"unit {parameter.unit!r}; expected {unit!r}")
        if positive and parameter.value <= 0:
            raise ValueError(f"value {parameter.value:g} {unit}; expected more than 0")
        if not positive and parameter.value < 0:
            raise ValueError(f"value {parameter.value:g} {unit}; expected 0 or more")
        return parameter

    return AfterValidator(check)


def _zero(unit: str) -> Parameter:
    return Parameter(value=0.0, unit=unit, source="absent from the rig file: none")


class Beam(Strict):
    """Euler-Bernoulli beam (paper 1, eq. 1-9).

    Its complex stiffness is EI (1 + j eta + s tau): `eta` is a constant loss factor
    (not causal, so the simulated rig replaces it by a causal fit), `tau` a viscous
    (Kelvin-Voigt) damping time, which is causal.
    """

    kind: Literal["beam"]
    name: Name
    EI: Annotated[Parameter, _checked("N m^2", positive=True)]
    mu: Annotated[Parameter, _checked("kg/m", positive=True)]
    L: Annotated[Parameter, _checked("m", positive=True)]
    eta: Annotated[Parameter, _checked("1", positive=False)] = _zero("1")
    tau: Annotated[Parameter, _checked("s", positive=False)] = _zero("s")


class RigidLink(Strict):
    """Rigid body: length L, centre of gravity r from its upstream joint, mass m,
    second moment of inertia I about the centre of gravity."""

    kind: Literal["rigid_link"]
    name: Name
    L: Annotated[Parameter, _checked("m", positive=False)]
    r: Annotated[Parameter, _checked("m", positive=False)]
    m: Annotated[Parameter, _checked("kg", positive=False)]
    I: Annotated[Parameter, _checked("kg m^2", positive=False)]  # noqa: E741 the papers' symbol


class TorsionalSpring(Strict):
    """Torsional spring and damper in parallel: theta+ = theta- + M/(c s + k)."""

    kind: Literal["torsional_spring"]
    name: Name
    k: Annotated[Parameter, _checked("N m/rad", positive=True)]
    c: Annotated[Parameter, _checked("N m s/rad", positive=False)] = _zero("N m s/rad")


class AngularVelocitySource(Strict):
    """Angular velocity source with a first-order lag (paper 2, eq. 1):
    theta+ = theta- + K p v / (s (s + p)), v the input called `input`.

    The unit of K is rad/s per unit of that input, "rad/(s V)" for volts.
    """

    kind: Literal["angular_velocity_source"]
    name: Name
    input: Name
    K: Parameter
    p: Annotated[Parameter, _checked("rad/s", positive=True)]


Element = Annotated[
    Beam | RigidLink | TorsionalSpring | AngularVelocitySource, Field(discriminator="kind")
]


def parameters(element: BaseModel) -> dict[str, Parameter]:
    """The element's physical parameters by symbol, in the order of its class."""
    return {k: v for k, v in iter(element) if isinstance(v, Parameter)}


class AntiAlias(Strict):
    """Analogue low-pass before the converter: a Butterworth of this order and corner."""

    order: Annotated[int, Field(ge=1, le=8)]
    corner_hz: Positive


class SensorBase(Strict):
    """What every sensor has beside its place on the chain.

    noise_rms : white noise of the converted samples, in `unit`.
    resolution : one step of the converter, in `unit`; 0 for none.
    offset : constant error in `unit`.
    low, high : ends of the converter's range in `unit`.
    highpass_hz : corner of a first-order high-pass (a piezo's), 0 for none.
    delay : s from the instant of sampling as stamped back to the value's own time.
    stale_after : s without a new sample after which the channel is stale.
    """

    name: Name
    unit: str
    noise_rms: NonNegative = 0.0
    resolution: NonNegative = 0.0
    offset: Finite = 0.0
    low: float = -math.inf
    high: float = math.inf
    highpass_hz: NonNegative = 0.0
    antialias: AntiAlias | None = None
    delay: NonNegative = 0.0
    stale_after: Positive = 0.05
    calibration: str = Field(default="", description="how unit and scale are known")

    @model_validator(mode="after")
    def _range(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g}, high {self.high:g}; expected low below high")
        return self


def _unit(expected: str) -> AfterValidator:
    def check(unit: str) -> str:
        if unit != expected:
            raise ValueError(f"is {unit!r}; expected {expected!r}")
        return unit

    return AfterValidator(check)


class RelativeAngle(SensorBase):
    """Rotation after the last minus rotation before the first of the elements named.

    `across = ["source"]` is an encoder collocated with the actuator,
    `across = ["source", "spring"]` one that sees the joint's spring too (paper 2, eq. 11).
    """

    kind: Literal["relative_angle"]
    across: Annotated[tuple[Name, ...], Field(min_length=1)]
    unit: Annotated[str, _unit("rad")]


class AbsoluteAngle(SensorBase):
    """Rotation after the element named, against the ground."""

    kind: Literal["absolute_angle"]
    after: Name
    unit: Annotated[str, _unit("rad")]


class Acceleration(SensorBase):
    """Lateral acceleration s^2 w at `position` metres from the upstream end of a rigid
    link or beam."""

    kind: Literal["acceleration"]
    on: Name
    position: NonNegative
    unit: Annotated[str, _unit("m/s^2")]


class Moment(SensorBase):
    """Internal moment M after the element named."""

    kind: Literal["moment"]
    after: Name
    unit: Annotated[str, _unit("N m")]


Sensor = Annotated[
    RelativeAngle | AbsoluteAngle | Acceleration | Moment, Field(discriminator="kind")
]


class ActuatorSpec(Strict):
    """The input of the rig: the converter that drives an angular velocity source.

    The converter holds each sample until the next (zero-order hold); `delay` s pass
    between a sample's time stamp and the moment the output changes. `deadman` s after the
    last command the device itself drops its output to zero; without it the rig cannot be armed.
    """

    name: Name
    unit: str
    low: Finite
    high: Finite
    resolution: NonNegative = 0.0
    delay: NonNegative = 0.0
    deadman: Positive | None = None

    @model_validator(mode="after")
    def _range(self) -> Self:
        if not self.low < 0 < self.high:
            raise ValueError(f"low {self.low:g}, high {self.high:g}; expected 0 between them")
        return self


class Limit(Strict):
    """What a channel must never exceed while the actuator is live, and why.

    max : largest absolute value, in `unit`. max_rate : largest absolute change, unit/s.
    """

    channel: Name
    unit: str
    max: Positive
    max_rate: Positive | None = None
    reason: str = Field(min_length=1)


class Device(Strict):
    """Which driver opens the rig (an entry point of `samii_rig.devices`) and its settings."""

    driver: str = "simulated"
    settings: dict[str, Any] = Field(default_factory=dict)


class Centring(Strict):
    """The loop that keeps the joint centred: v = u + kp (theta_ref - theta).

    It runs in the device, at the sample rate. kp is in actuator units per sensor unit.
    """

    sensor: Name
    kp: NonNegative


class Rig(Strict):
    """A rig file. Elements stand in the order base to tip."""

    name: str = Field(min_length=1)
    description: str = ""
    base: Literal["clamped", "pinned", "free"]
    tip: Literal["clamped", "pinned", "free"]
    rate_hz: Positive
    element: Annotated[tuple[Element, ...], Field(min_length=1)]
    sensor: Annotated[tuple[Sensor, ...], Field(min_length=1)]
    actuator: Annotated[tuple[ActuatorSpec, ...], Field(min_length=1)]
    limit: tuple[Limit, ...] = ()
    centring: Centring | None = None
    device: Device = Device()

    @field_validator("element", "sensor", "actuator")
    @classmethod
    def _unique(cls, items: tuple[Any, ...]) -> tuple[Any, ...]:
        seen: set[str] = set()
        for item in items:
            if item.name in seen:
                raise ValueError(f"name {item.name!r} occurs twice; expected each once")
            seen.add(item.name)
        return items

    @model_validator(mode="after")
    def _references(self) -> Self:
        elements = {e.name: e for e in self.element}
        order = [e.name for e in self.element]
        inputs = {a.name: a for a in self.actuator}
        for e in self.element:
            if isinstance(e, RigidLink) and e.m.value == 0 and e.I.value > 0:
                raise ValueError(f"element {e.name}: I without m; expected a mass above 0")
            if isinstance(e, AngularVelocitySource):
                if e.input not in inputs:
                    raise ValueError(
                        f"element {e.name}: input {e.input!r} is no actuator; "
                        f"expected one of {sorted(inputs)}"
                    )
                unit = f"rad/(s {inputs[e.input].unit})"
                if e.K.unit != unit:
                    raise ValueError(
                        f"element {e.name}: K has unit {e.K.unit!r}; expected {unit!r}"
                    )
        driven = {e.input for e in self.element if isinstance(e, AngularVelocitySource)}
        for a in self.actuator:
            if a.name not in driven:
                raise ValueError(
                    f"actuator {a.name}: drives no element; expected one with this input"
                )
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
            if isinstance(s, Acceleration):
                host = elements[s.on]
                if not isinstance(host, Beam | RigidLink):
                    raise ValueError(
                        f"sensor {s.name}: {s.on} has no extent; expected a link or beam"
                    )
                if s.position > host.L.value:
                    raise ValueError(
                        f"sensor {s.name}: position {s.position:g} m lies beyond {s.on}; "
                        f"expected at most {host.L.value:g} m"
                    )
        units = self.units()
        clash = set(inputs) & {s.name for s in self.sensor}
        if clash:
            raise ValueError(f"sensor {min(clash)}: an actuator has that name; expected another")
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
        if self.centring and self.centring.sensor not in {s.name for s in self.sensor}:
            raise ValueError(
                f"centring: sensor {self.centring.sensor!r} does not exist; "
                f"expected one of {[s.name for s in self.sensor]}"
            )
        return self

    def units(self) -> dict[str, str]:
        """Unit of every channel, actuators and sensors, by name."""
        return {x.name: x.unit for x in (*self.actuator, *self.sensor)}

    def limits_on(self, channel: str) -> Iterator[Limit]:
        """The limits on one channel."""
        return (limit for limit in self.limit if limit.channel == channel)


def places(sensor: SensorBase) -> tuple[str, ...]:
    """Names of the elements that a sensor's place refers to."""
    match sensor:
        case RelativeAngle():
            return sensor.across
        case AbsoluteAngle() | Moment():
            return (sensor.after,)
        case Acceleration():
            return (sensor.on,)
    raise TypeError(type(sensor))
