"""What is watched on a rig: monitors beside the chain, limits of channels, channels that agree."""

from __future__ import annotations

import math
from typing import Self

from pydantic import Field, model_validator

from samii_rig.rig.schema.base import Finite, Name, NonNegative, Positive, Strict


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
    """Two channels that measure one quantity: if they part, one of them drifts, and no run goes on.

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
