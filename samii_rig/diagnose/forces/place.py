"""Where a force is fed into a rig, and what drives it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from samii_rig.diagnose.physics import insert
from samii_rig.rig.schema import (
    SOURCES,
    AbsoluteAngle,
    ActuatorSpec,
    Displacement,
    Element,
    Force,
    ForceSource,
    Moment,
    Parameter,
    RelativeAngle,
    Rig,
    Sensor,
    TorqueSource,
)

EXTRA = f"{insert.PREFIX}force"  # the input and the sensor that the chain has more

Kind = Literal["joint", "ground", "drive", "command", "flow"]


@dataclass(frozen=True, slots=True)
class Place:
    """A place.

    kind : `joint`, a torque between both sides of `across`, driven by the angle over it, or, where
        it `slides`, a force driven by the way over it; `ground`, one between what is behind
        `across` and the ground;
        `drive`, on the input of the source, driven by the source's own angle; `command`, on
        the input, driven by the input; `flow`, on the input, driven by it and by the torque
        behind the source.
    across : elements, base to tip; of a drive, flow or command the source.
    """

    kind: Kind
    across: tuple[str, ...]
    slides: bool = False

    @property
    def own_input(self) -> bool:
        """Whether the force has an input of its own."""
        return self.kind in ("joint", "ground")

    def acts_on(self, rig: Rig) -> int:
        """Index of the input through which the force acts among those of the rig and its own."""
        if self.own_input:
            return len(rig.actuator)
        return [a.name for a in rig.actuator].index(self.command(rig))

    def command(self, rig: Rig) -> str:
        """The actuator of the source that it stands in the drive of."""
        source = next(e for e in rig.element if e.name == self.across[0])
        assert isinstance(source, SOURCES)
        return source.input

    @property
    def units(self) -> tuple[str, str]:
        """Of a force there, and of what drives it."""
        return ("N", "m") if self.slides else ("N m", "rad")

    @property
    def name(self) -> str:
        """Different for different places."""
        return " ".join((self.kind, *self.across))

    def augmented(self, rig: Rig, name: str = EXTRA) -> Rig:
        """The rig with the force's input behind its own and its sensor behind its own; `name` of
        both."""
        names = [e.name for e in rig.element]
        first, last = names.index(self.across[0]), self.across[-1]
        before = names[first - 1] if first > 0 else None
        sensor: Sensor
        match self.kind:
            case "joint" | "ground":
                rig = insert.inserted(rig, last, self._source(1.0, name, "behind"))
                if self.kind == "joint":
                    rig = insert.inserted(rig, before, self._source(-1.0, name, "before"))
                    rig = _read_behind(rig, last, f"{name}_behind")
                sensor = self._moved(name, before)
            case "flow":
                sensor = Moment(kind="moment", name=name, after=last, unit="N m")
            case _:
                sensor = RelativeAngle(
                    kind="relative_angle", name=name, across=self.across, unit="rad"
                )
        update: dict[str, object] = {"sensor": (*rig.sensor, sensor)}
        if self.own_input:
            spec = ActuatorSpec(name=name, unit=self.units[0], low=-1.0, high=1.0)
            update["actuator"] = (*rig.actuator, spec)
        return rig.model_copy(update=update)

    def _moved(self, name: str, before: str | None) -> Sensor:
        """What drives a force between two parts, or between one and the ground."""
        last = self.across[-1]
        if self.slides:
            against = before if self.kind == "joint" else None
            return Displacement(
                kind="displacement", name=name, after=last, against=against, unit="m"
            )
        if self.kind == "ground":
            return AbsoluteAngle(kind="absolute_angle", name=name, after=last, unit="rad")
        return RelativeAngle(kind="relative_angle", name=name, across=self.across, unit="rad")

    def _source(self, K: float, name: str, side: str) -> Element:
        gain = Parameter(value=K, unit="1", source=f"unit {'force' if self.slides else 'torque'}")
        own = f"{name}_{side}"
        if self.slides:
            return ForceSource(kind="force_source", name=own, input=name, K=gain)
        return TorqueSource(kind="torque_source", name=own, input=name, K=gain)


def _read_behind(rig: Rig, last: str, name: str) -> Rig:
    """The rig whose load cells behind a part read all that it passes on, the force beside too."""
    for s in rig.sensor:
        if isinstance(s, Moment | Force) and s.after == last:
            rig = insert.sensor_changed(rig, s.name, after=name)
    return rig
