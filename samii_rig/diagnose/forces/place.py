"""Where a force is fed into a rig, and what drives it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.along import AT_A_POINT, BODIES, cut, stretches
from samii_rig.errors import InputError
from samii_rig.rig.schema import (
    BEAMS,
    SOURCES,
    AbsoluteAngle,
    ActuatorSpec,
    Displacement,
    Element,
    Force,
    ForceSource,
    LumpedMass,
    Moment,
    Parameter,
    RelativeAngle,
    Rig,
    Sensor,
    TorqueSource,
    TorsionalGroundSpring,
    TranslationalGroundSpring,
)

EXTRA = f"{insert.PREFIX}force"  # the input and the sensor that the chain has more

Kind = Literal["joint", "ground", "drive", "command", "flow"]


@dataclass(frozen=True, slots=True)
class Place:
    """A place.

    kind : `joint`, a torque between both sides of `across`, driven by the angle over it, or, where
        it `slides`, a force driven by the way over it; `ground`, one between what is behind
        `across`, or at `position` m from the upstream end of a beam, and the ground;
        `drive`, on the input of the source, driven by the source's own angle; `command`, on
        the input, driven by the input; `flow`, on the input, driven by it and by the torque
        behind the source.
    across : elements, base to tip; of a drive, flow or command the source.
    """

    kind: Kind
    across: tuple[str, ...]
    slides: bool = False
    position: float | None = None

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
        way = ("along",) if self.kind == "ground" and self.slides else ()
        at = () if self.position is None else (f"{self.position:g}",)
        return " ".join((self.kind, *way, *self.across, *at))

    def augmented(self, rig: Rig, name: str = EXTRA) -> Rig:
        """The rig with the force's input behind its own and its sensor behind its own; `name` of
        both."""
        names = [e.name for e in rig.element]
        first, last = names.index(self.across[0]), self.across[-1]
        before = names[first - 1] if first > 0 else None
        sensor: Sensor
        match self.kind:
            case "joint" | "ground":
                source = self._source(1.0, name, "behind")
                if self.position is not None:
                    rig, last = _into(rig, last, self.position, source), source.name
                else:
                    rig = insert.inserted(rig, last, source)
                if self.kind == "joint":
                    rig = insert.inserted(rig, before, self._source(-1.0, name, "before"))
                if self.position is None:
                    rig = _read_behind(rig, last, f"{name}_behind")
                sensor = self._moved(name, before, last)
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

    def _moved(self, name: str, before: str | None, last: str) -> Sensor:
        """What drives a force between two parts, or between what is behind `last` and ground."""
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


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a rig that moves, and may rub or run against the ground.

    site : its name. others : names of what else is there. after : the element that it is behind;
    or the beam that it is on, `position` m from the upstream end. held : whether it slides, and
    whether it turns, on a spring to the ground that is a place by itself.
    """

    site: str
    others: tuple[str, ...]
    after: str
    position: float | None = None
    held: tuple[bool, bool] = (False, False)

    def to_ground(self, *, slides: bool) -> Place:
        """The place between it and the ground."""
        return Place("ground", (self.after,), slides, self.position)


def parts(rig: Rig) -> Iterator[Part]:
    """The bodies of a rig, ends of beams and links among them; where a sensor stands on a beam."""
    at: list[Element] = []  # what one point has
    for element in rig.element:
        if not isinstance(element, AT_A_POINT):
            yield from _at_point(at)
            at = []
        at.append(element)
        if isinstance(element, BEAMS):
            yield from _with_sensor(rig, element)
    yield from _at_point(at)


def _at_point(at: list[Element]) -> Iterator[Part]:
    slides = any(isinstance(e, TranslationalGroundSpring) for e in at)
    turns = any(isinstance(e, TorsionalGroundSpring) for e in at)
    some = [e.name for e in at if isinstance(e, (LumpedMass, *BODIES))]
    if some:
        yield Part(some[-1], tuple(some[:-1]), at[-1].name, held=(slides, turns))


def _with_sensor(rig: Rig, beam: Element) -> Iterator[Part]:
    for along in list(stretches(rig, beam))[1:]:  # from one sensor to the next
        yield Part(beam.name, (), beam.name, along.start)


def _into(rig: Rig, beam: str, position: float, part: Element) -> Rig:
    """The rig with a part in a beam, at `position` m from its upstream end.

    Raises InputError where another part stands along it already.
    """
    element = next(e for e in rig.element if e.name == beam)
    at = (a for a in stretches(rig, element) if a.start <= position <= a.end)
    if (along := next(at, None)) is None:
        raise InputError(rig.name, "position", position, f"one along {beam}, in one piece")
    share = (position - along.start) / (along.end - along.start)
    return cut(rig, along, part, math.exp(share))


def _read_behind(rig: Rig, last: str, name: str) -> Rig:
    """The rig whose load cells behind a part read all that it passes on, the force beside too."""
    for s in rig.sensor:
        if isinstance(s, Moment | Force) and s.after == last:
            rig = insert.sensor_changed(rig, s.name, after=name)
    return rig
