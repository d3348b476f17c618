"""The rig file: a serial chain, its sensors, its actuators, its limits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Self

from pydantic import Field, field_validator, model_validator

from samii_rig.rig.schema.actuators import ActuatorSpec
from samii_rig.rig.schema.base import NonNegative, Positive, Strict
from samii_rig.rig.schema.conversion import in_si
from samii_rig.rig.schema.device import Device, Service
from samii_rig.rig.schema.elements import Bend, Element, End, Motion
from samii_rig.rig.schema.limits import Agreement, Limit, Monitor
from samii_rig.rig.schema.loops import Centring, Feedback
from samii_rig.rig.schema.pose import PoseAngle, pull, pulls
from samii_rig.rig.schema.references import check_references, unlike
from samii_rig.rig.schema.sensors import Sensor
from samii_rig.units import STANDARD_GRAVITY


class Rig(Strict):
    """A rig file. Elements stand in the order base to tip.

    motion : "lateral" for a chain that bends and turns, "axial" for one that moves along itself.
    gravity : m/s^2, 0 for none. pose : angle of the chain at its base to the way down: 0 (if left
        out) it hangs, 90 deg it is level, 180 deg it stands.
    """

    name: str = Field(min_length=1)
    description: str = ""
    motion: Motion = "lateral"
    base: End
    tip: End
    rate_hz: Positive
    gravity: NonNegative = 0.0
    pose: PoseAngle | None = None
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
        unlike(item.name for item in items)
        return items

    @model_validator(mode="after")
    def _references(self) -> Self:
        check_references(self)
        return self

    def centring_of(self, actuator: str) -> Centring | None:
        """The loop on one actuator: [centring] on the first, its own on another."""
        first, *others = self.actuator
        if actuator == first.name:
            return self.centring
        return next((a.centring for a in others if a.name == actuator), None)

    @property
    def centred(self) -> frozenset[str]:
        """Sensors that centring loops are closed around."""
        loops = (self.centring_of(a.name) for a in self.actuator)
        return frozenset(loop.sensor for loop in loops if loop is not None)

    @property
    def pull(self) -> float:
        """Gravity along the chain, base to tip, m/s^2: negative where it stands."""
        return pull(self.gravity, self.pose)

    @property
    def pulls(self) -> tuple[float, ...]:
        """The same at each element: a bend turns all that lies beyond it."""
        return pulls(self)

    @property
    def bent(self) -> bool:
        """Whether a bend is in the chain."""
        return any(isinstance(e, Bend) for e in self.element)

    def tilt_gravity(self, on: str) -> float:
        """What an accelerometer that tilts with the element `on` reads a rad, m/s^2: gravity along
        the chain there, or with no gravity in the rig file that of a hanging chain."""
        if not self.gravity:
            return STANDARD_GRAVITY
        return self.pulls[[e.name for e in self.element].index(on)]

    def units(self) -> dict[str, str]:
        """Unit of every channel, actuators, sensors and monitors, by name."""
        return {x.name: x.unit for x in (*self.actuator, *self.sensor, *self.monitor)}

    def limits_on(self, channel: str) -> Iterator[Limit]:
        """The limits on one channel."""
        return (limit for limit in self.limit if limit.channel == channel)
