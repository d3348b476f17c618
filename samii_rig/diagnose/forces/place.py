"""Where a force is fed into a rig, and what drives it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from samii_rig.diagnose.physics import insert
from samii_rig.rig.schema import (
    ActuatorSpec,
    Moment,
    Parameter,
    RelativeAngle,
    Rig,
    TorqueSource,
)

EXTRA = f"{insert.PREFIX}force"  # the input and the sensor that the chain has more

Kind = Literal["joint", "drive", "command", "flow"]


@dataclass(frozen=True, slots=True)
class Place:
    """A place.

    kind : `joint`, a torque between both sides of `across`, driven by the angle over it;
        `drive`, on the input of the source, driven by the source's own angle; `command`, on
        the input, driven by the input; `flow`, on the input, driven by it and by the torque
        behind the source.
    across : elements, base to tip; of a drive, flow or command the source.
    """

    kind: Kind
    across: tuple[str, ...]

    @property
    def own_input(self) -> bool:
        """Whether the force has an input of its own."""
        return self.kind == "joint"

    @property
    def name(self) -> str:
        """Different for different places."""
        return " ".join((self.kind, *self.across))

    def widened(self, rig: Rig, name: str = EXTRA) -> Rig:
        """The rig with the force's input behind its own and its sensor behind its own; `name` of
        both."""
        names = [e.name for e in rig.element]
        first, last = names.index(self.across[0]), self.across[-1]
        before = names[first - 1] if first > 0 else None
        sensor: RelativeAngle | Moment
        sensor = RelativeAngle(kind="relative_angle", name=name, across=self.across, unit="rad")
        match self.kind:
            case "joint":
                rig = insert.inserted(rig, last, _torque(1.0, name, "behind"))
                rig = insert.inserted(rig, before, _torque(-1.0, name, "before"))
            case "flow":
                sensor = Moment(kind="moment", name=name, after=last, unit="N m")
        update: dict[str, object] = {"sensor": (*rig.sensor, sensor)}
        if self.own_input:
            spec = ActuatorSpec(name=name, unit="N m", low=-1.0, high=1.0)
            update["actuator"] = (*rig.actuator, spec)
        return rig.model_copy(update=update)


def _torque(K: float, name: str, side: str) -> TorqueSource:
    gain = Parameter(value=K, unit="1", source="unit torque")
    return TorqueSource(kind="torque_source", name=f"{name}_{side}", input=name, K=gain)
