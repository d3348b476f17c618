"""What is simulated: a chain of parts with what hangs on it, its sensors and its inputs' paths.

It begins as the rig file says, with the nominal parameters that were drawn; an effect returns
another one with something added or changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from samii_rig.errors import InputError
from samii_rig.rig.schema import ActuatorSpec, Rig, SensorBase, parameters

Key = tuple[str, str]  # (element, symbol) of a physical parameter
Values = Mapping[Key, float]

KINDS = (
    "beam",
    "rigid_link",
    "lumped_mass",
    "torsional_spring",
    "translational_spring",
    "torsional_ground_spring",
    "translational_ground_spring",
    "gravity_stiffness",
    "oil_column",
    "cylinder",
    "gear",
    "spindle",
    "angular_velocity_source",
    "angular_velocity_source_2",
    "torque_source",
    "force_source",
    "velocity_source",
    "displacement_source",
    "acceleration_source",
)
# Other words of the rig file for the same thing.
SAME_AS = {
    "mass": "lumped_mass",
    "inertia": "lumped_mass",
    "spring": "translational_spring",
    "damper": "translational_spring",
    "ground_spring": "translational_ground_spring",
    "ground_damper": "translational_ground_spring",
}
EXTENDED = ("beam", "rigid_link")  # kinds on which a place may lie between two ports
ANGLE_SOURCES = ("angular_velocity_source", "angular_velocity_source_2")
MOTION_SOURCES = ("velocity_source", "displacement_source", "acceleration_source")  # prescribe w
SOURCES = (*ANGLE_SOURCES, *MOTION_SOURCES, "torque_source", "force_source")
JOINTS = ("torsional_spring", "translational_spring")


@dataclass(frozen=True, slots=True)
class Part:
    """One element of the chain with its numbers, by the rig file's symbols, SI units."""

    name: str
    kind: str
    values: dict[str, float]


@dataclass(frozen=True, slots=True)
class Attachment:
    """Something at a place of the chain: `x` m from the upstream end of the part `on`; of a part
    without extent `x` is 0 and means right behind it.

    mass : values m (kg) and J (kg m^2). ground, ground_torsion : spring k and damper c to the
    ground. oscillator : a mass m on a spring k and a damper c, across the chain. crack : a spring k
    and a damper c against a jump of a beam's slope there.
    """

    kind: Literal["mass", "ground", "ground_torsion", "oscillator", "crack"]
    on: str
    x: float
    values: dict[str, float]


@dataclass(frozen=True, slots=True)
class Relaxation:
    """Maxwell branches beside the spring of the joint `on`: sum of k s t/(1 + s t), for k in
    `stiffness` (N m/rad or N/m) and t in `times` (s)."""

    on: str
    stiffness: tuple[float, ...]
    times: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Force:
    """A law that is not linear: `law` of `samii_rig`'s vocabulary or `bouc_wen`, `parametric` or
    `one_sided`.

    on : the joint whose relative motion it opposes, or the actuator. values : its numbers.
    ground : it opposes the motion of the body `on`, at its downstream end, against the ground.
    """

    law: str
    on: str
    values: dict[str, float]
    ground: bool = False


@dataclass(frozen=True, slots=True)
class Lag:
    """A filter in the input's path: p/(s + p), or omega^2/(s^2 + 2 zeta omega s + omega^2)."""

    p: float = 0.0
    omega: float = 0.0
    zeta: float = 0.0


@dataclass(frozen=True, slots=True)
class Drive:
    """One input: its converter, and what lies between that and the sources that it moves.

    sources : names of these parts, base to tip. path : filters in series. delay : s by which the
    sources act later than the converter's output changes.
    """

    actuator: ActuatorSpec
    sources: tuple[str, ...]
    path: tuple[Lag, ...] = ()
    delay: float = 0.0

    @property
    def name(self) -> str:
        """The actuator's."""
        return self.actuator.name


@dataclass(frozen=True, slots=True)
class Setup:
    """The whole of what is simulated. drives : in the order of the rig file's actuators.

    motion : "lateral" or "axial", as of the rig file.
    """

    base: str
    parts: tuple[Part, ...]
    sensors: tuple[SensorBase, ...]
    drives: tuple[Drive, ...]
    attachments: tuple[Attachment, ...] = ()
    relaxations: tuple[Relaxation, ...] = ()
    forces: tuple[Force, ...] = ()
    motion: str = "lateral"

    def part(self, name: str) -> Part:
        """The part called `name`; KeyError if there is none."""
        for part in self.parts:
            if part.name == name:
                return part
        raise KeyError(name)

    def driven(self, drive: Drive) -> Setup:
        """The same with `drive` in place of the one of its name."""
        return replace(
            self, drives=tuple(drive if d.name == drive.name else d for d in self.drives)
        )

    def turning(self) -> set[str]:
        """Names of the parts that may turn: of an axial chain those before its spindle."""
        names = [p.name for p in self.parts]
        return set(names if self.motion == "lateral" else names[: self._spindle()])

    def shifting(self) -> set[str]:
        """Names of the parts that may shift: none of a lateral chain that has no mass to shift."""
        names = [p.name for p in self.parts]
        if self.motion == "axial":
            return set(names[self._spindle() :])
        heavy = any(p.values.get("m", 0.0) > 0 or p.kind == "beam" for p in self.parts)
        return set(names if heavy else ())

    def _spindle(self) -> int:
        return next((i for i, p in enumerate(self.parts) if p.kind == "spindle"), 0)

    def with_value(self, name: str, symbol: str, value: float) -> Setup:
        """The same with one number of one part changed."""
        parts = tuple(
            replace(p, values={**p.values, symbol: value}) if p.name == name else p
            for p in self.parts
        )
        return replace(self, parts=parts)

    def inserted(self, after: str | None, part: Part) -> Setup:
        """The same with `part` behind the part `after`, or at the base."""
        at = 0 if after is None else [p.name for p in self.parts].index(after) + 1
        return replace(self, parts=(*self.parts[:at], part, *self.parts[at:]))

    def attached(self, *items: Attachment) -> Setup:
        """The same with more that hangs on it."""
        return replace(self, attachments=(*self.attachments, *items))


@dataclass(frozen=True, slots=True)
class Nominal:
    """The physical parameters that the rig file gives with a tolerance.

    keys : (n,) which; tolerance : relative standard deviation of each; value : the file's.
    """

    keys: tuple[Key, ...]
    value: tuple[float, ...]
    tolerance: tuple[float, ...]
    units: tuple[str, ...] = field(default=())


def nominal(rig: Rig) -> Nominal:
    """The parameters of `rig` that have a tolerance and are not 0."""
    found = [
        ((e.name, symbol), p.value, p.tolerance, p.unit)
        for e in rig.element
        for symbol, p in parameters(e).items()
        if p.tolerance > 0 and p.value != 0
    ]
    keys, value, tolerance, units = zip(*found, strict=True) if found else ((), (), (), ())
    return Nominal(keys, value, tolerance, units)


def setup_of(rig: Rig, values: Values) -> Setup:
    """The rig as its file says, with `values` in place of the file's.

    InputError for what this plant cannot simulate: feedback beside the centring, a tip that is
    not free, elements outside `KINDS`.
    """
    if rig.feedback:
        raise InputError(rig.name, "feedback", rig.feedback[0].name, "none for this plant")
    if rig.tip != "free":
        raise InputError(rig.name, "tip", rig.tip, "'free' for this plant")
    if rig.pull:
        raise InputError(rig.name, "gravity", rig.gravity, "none for this plant, or a level pose")
    parts = []
    for e in rig.element:
        kind = SAME_AS.get(e.kind, e.kind)
        if kind not in KINDS:
            raise InputError(rig.name, f"element[{e.name}].kind", e.kind, f"one of {KINDS}")
        own = {s: values.get((e.name, s), p.value) for s, p in parameters(e).items()}
        parts.append(Part(e.name, kind, own))
    drives = tuple(_drive(rig, a, parts) for a in rig.actuator)
    return Setup(rig.base, tuple(parts), rig.sensor, drives, motion=rig.motion)


def _drive(rig: Rig, actuator: ActuatorSpec, parts: list[Part]) -> Drive:
    moved = {e.name for e in rig.element if getattr(e, "input", None) == actuator.name}
    sources = [p for p in parts if p.name in moved]
    delays = {p.values["tau"] for p in sources}
    if len(delays) != 1:
        raise InputError(
            rig.name, "tau", sorted(delays), f"one dead time for all sources of {actuator.name}"
        )
    return Drive(actuator, tuple(p.name for p in sources), delay=delays.pop())
