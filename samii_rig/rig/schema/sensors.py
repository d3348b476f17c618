"""The sensors of a rig file: kinds, places, what each one's chain does to the signal."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from samii_rig.rig.schema.base import Finite, Name, NonNegative, Positive, Strict


class AntiAlias(Strict):
    """Analogue low-pass before the converter: a Butterworth of this order and corner."""

    order: Annotated[int, Field(ge=1, le=8)]
    corner_hz: Positive


class SensorBase(Strict):
    """What every sensor has beside its place on the chain.

    si_unit : of what its kind measures.
    noise_rms : white noise of the converted samples, in `unit`.
    resolution : one step of the converter, in `unit`; 0 for none.
    offset : constant error in `unit`.
    low, high : ends of the converter's range in `unit`.
    highpass_hz : corner of a first-order high-pass (a piezo's), 0 for none.
    gain : what the channel shows over what is there, 1 for a true calibration.
    lag : s, time constant of a first-order low-pass in the sensor's chain, 0 for none.
    delay : s from the instant of sampling as stamped back to the value's own time.
    stale_after : s without a new sample after which the channel is stale.
    """

    si_unit: ClassVar[str]
    name: Name
    unit: str
    noise_rms: NonNegative = 0.0
    resolution: NonNegative = 0.0
    offset: Finite = 0.0
    low: float = -math.inf
    high: float = math.inf
    highpass_hz: NonNegative = 0.0
    antialias: AntiAlias | None = None
    gain: Finite = 1.0
    lag: NonNegative = 0.0
    delay: NonNegative = 0.0
    stale_after: Positive = 0.05
    calibration: str = Field(default="", description="how unit and scale are known")

    @property
    def own_noise(self) -> float:
        """Root mean square of noise and rounding together, in `unit`."""
        return math.hypot(self.noise_rms, self.resolution / math.sqrt(12))

    @field_validator("unit")
    @classmethod
    def _of_its_kind(cls, unit: str) -> str:
        if unit != cls.si_unit:
            raise ValueError(f"is {unit!r}; expected {cls.si_unit!r}")
        return unit

    @model_validator(mode="after")
    def _range(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g}, high {self.high:g}; expected low below high")
        return self


class RelativeAngle(SensorBase):
    """Rotation after the last minus rotation before the first of the elements named.

    `across = ["source"]` is an encoder collocated with the actuator,
    `across = ["source", "spring"]` one that sees the joint's spring too (paper 2, eq. 11).
    """

    si_unit = "rad"
    kind: Literal["relative_angle"]
    across: Annotated[tuple[Name, ...], Field(min_length=1)]


class AbsoluteAngle(SensorBase):
    """Rotation after the element named, against the ground."""

    si_unit = "rad"
    kind: Literal["absolute_angle"]
    after: Name


class Acceleration(SensorBase):
    """Acceleration s^2 w + tilt g theta at `position` metres from the upstream end of a rigid
    link or beam, or of a mass or a table, which have no extent; tilt is 1 for a sensor that turns
    with it in the vertical plane and reads gravity as an acceleration towards positive w, -1 the
    other way round."""

    si_unit = "m/s^2"
    kind: Literal["acceleration"]
    on: Name
    position: NonNegative = 0.0
    tilt: Finite = 0.0


class Moment(SensorBase):
    """Internal moment M after the element named."""

    si_unit = "N m"
    kind: Literal["moment"]
    after: Name


class Displacement(SensorBase):
    """Displacement w behind the element `after`, less that behind `against`; without `against`
    it is one against the ground."""

    si_unit = "m"
    kind: Literal["displacement"]
    after: Name
    against: Name | None = None


class Velocity(SensorBase):
    """Velocity s w of the same places as `Displacement`."""

    si_unit = "m/s"
    kind: Literal["velocity"]
    after: Name
    against: Name | None = None


class Force(SensorBase):
    """A load cell behind the element `after`: -V, which of an axial chain is tension."""

    si_unit = "N"
    kind: Literal["force"]
    after: Name


class Pressure(SensorBase):
    """A pressure of the element `after`, a cylinder: with `chamber` that in its chamber 1 or 2,
    over the one at rest; with `area`, m^2, the load pressure (A_1 p_1 - A_2 p_2)/area, its push
    over the area."""

    si_unit = "Pa"
    kind: Literal["pressure"]
    after: Name
    area: Positive | None = None
    chamber: Literal[1, 2] | None = None

    @model_validator(mode="after")
    def _one_of(self) -> Self:
        if (self.area is None) == (self.chamber is None):
            given = "neither area nor chamber" if self.area is None else "area and chamber"
            raise ValueError(f"{given}; expected area for the load pressure, or chamber 1 or 2")
        return self


class Strain(SensorBase):
    """A strain gauge at `position` metres from the upstream end of a beam: -height theta'.

    height : m from the neutral fibre to the gauge, positive on the side of positive w. A half or
    full bridge of bending reads a multiple of it, its `gain`.
    """

    si_unit = "m/m"
    kind: Literal["strain"]
    on: Name
    position: NonNegative = 0.0
    height: Finite

    @model_validator(mode="after")
    def _off_the_fibre(self) -> Self:
        if self.height == 0:
            raise ValueError(
                "height 0; expected the distance from the neutral fibre, where there is no strain"
            )
        return self


class Current(SensorBase):
    """The current of the motor that the source `of` is: what it pushes with, over `constant`.

    constant : N m/A of a source that turns, N/A of one that slides. A source of motion pushes with
    what its load asks of it, one of a force or torque with K v.
    """

    si_unit = "A"
    kind: Literal["current"]
    of: Name
    constant: Positive


Sensor = Annotated[
    RelativeAngle
    | AbsoluteAngle
    | Acceleration
    | Moment
    | Displacement
    | Velocity
    | Force
    | Pressure
    | Strain
    | Current,
    Field(discriminator="kind"),
]


def places(sensor: Sensor) -> tuple[str, ...]:
    """Names of the elements that a sensor's place refers to."""
    match sensor:
        case RelativeAngle():
            return sensor.across
        case AbsoluteAngle() | Moment() | Force() | Pressure():
            return (sensor.after,)
        case Displacement() | Velocity():
            return (sensor.after,) if sensor.against is None else (sensor.after, sensor.against)
        case Acceleration() | Strain():
            return (sensor.on,)
        case Current():
            return (sensor.of,)
