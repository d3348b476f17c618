"""What the concealed plant is built of: parts, drives, sensors, laws that are not linear.

A rig file gives the nominal description (`described`). An effect changes it: it inserts a part,
changes a number, or adds a law. Nothing here knows how a diagnosis would look for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from samii_rig.errors import InputError
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    AngularVelocitySource,
    Moment,
    RelativeAngle,
    Rig,
)
from samii_rig.rig.schema.elements import parameters

GRAVITY = 9.80665  # m/s^2, standard gravity


@dataclass(slots=True)
class Part:
    """One part of the chain, base to tip.

    kind : `beam`, `rigid_link`, `lumped_mass`, `torsional_spring`, `translational_spring`,
        `torsional_ground_spring`, `translational_ground_spring`, `gravity_stiffness`,
        `angular_velocity_source`, `oil` (compliance with fluid inertia behind the source),
        `oscillator` (a mass on a spring, beside the chain), `ladder` (relaxing springs
        beside the joint `joint`).
    name : of the rig file's element to which it belongs; an encoder across that element spans
        it as well.
    values : SI numbers by symbol.
    cracks : of a beam, (x, k, c) of each place within it where its slope jumps: m behind its
        upstream end, N m/rad, N m s/rad.
    """

    kind: str
    name: str
    values: dict[str, float]
    ladder: tuple[tuple[float, float], ...] = ()
    cracks: tuple[tuple[float, float, float], ...] = ()


@dataclass(slots=True)
class SensorPath:
    """A sensor's place and all that acts on its signal, in this order up to the converter.

    lags, highpasses : s and Hz of further first-order filters. tilt : a + tilt g theta.
    """

    name: str
    kind: str
    across: tuple[str, ...]
    position: float
    butterworth: tuple[int, float] | None
    highpasses: list[float]
    delay: float
    lags: list[float] = field(default_factory=list)
    gain: float = 1.0
    tilt: float = 0.0


@dataclass(slots=True)
class Drive:
    """From the recorded command of an actuator to its source's velocity: K p/(s + p) and what is
    before it. element : the source.

    delay : s. lags : s, first-order. valves : (omega, zeta) second-order.
    deadband : full width of the dead zone. limit : largest output, both in command units.
    """

    element: str
    K: float
    p: float
    delay: float
    lags: list[float] = field(default_factory=list)
    valves: list[tuple[float, float]] = field(default_factory=list)
    deadband: float = 0.0
    limit: float = float("inf")


@dataclass(slots=True)
class Law:
    """A force that is not linear, see `sim.concealed.laws`.

    kind : a name of `laws.KINDS`. site : the spring it acts beside, or the source. ground : it
    acts instead between the ground and the downstream end of the body `site`, sideways.
    """

    kind: str
    site: str
    values: tuple[float, ...]
    ground: bool = False


@dataclass(slots=True)
class Description:
    """A whole plant. `drives` are in the rig file's order of actuators. `push` is the place of the
    disturbing force, an element's downstream end."""

    base: str
    rate_hz: float
    parts: list[Part]
    sensors: list[SensorPath]
    drives: list[Drive]
    push: str
    laws: list[Law] = field(default_factory=list)

    def part(self, name: str) -> Part:
        """The part that the rig file's element of this name became."""
        return next(p for p in self.parts if p.name == name)

    def drive(self, element: str) -> Drive:
        """The drive whose source this element is; KeyError for another element."""
        for drive in self.drives:
            if drive.element == element:
                return drive
        raise KeyError(element)

    def value(self, element: str, symbol: str) -> float:
        """A number of the rig file's element, be it a part's or a drive's."""
        for drive in self.drives:
            if drive.element == element:
                return float(getattr(drive, symbol))
        return self.part(element).values[symbol]

    def set_value(self, element: str, symbol: str, value: float) -> None:
        """Give it another value."""
        for drive in self.drives:
            if drive.element == element:
                setattr(drive, symbol, value)
                return
        self.part(element).values[symbol] = value

    def insert(self, part: Part, *, after: str) -> None:
        """Put a part behind the last one that belongs to an element."""
        at = max(i for i, p in enumerate(self.parts) if p.name == after)
        self.parts.insert(at + 1, part)

    def sensor(self, name: str) -> SensorPath:
        """The sensor of this name."""
        return next(s for s in self.sensors if s.name == name)


def described(rig: Rig) -> Description:
    """The plant that a rig file describes, nothing hidden.

    InputError for a chain that this plant cannot be: not exactly one angular velocity source for
    each actuator, a tip that is held, or an element of another kind.
    """
    sources = {e.input: e for e in rig.element if isinstance(e, AngularVelocitySource)}
    count = sum(isinstance(e, AngularVelocitySource) for e in rig.element)
    if count != len(rig.actuator) or len(sources) != count:
        raise InputError(rig.name, "element", count, "one angular_velocity_source an actuator")
    if rig.tip != "free":
        raise InputError(rig.name, "tip", rig.tip, "'free', to conceal something in")
    if rig.pull:
        raise InputError(rig.name, "gravity", rig.gravity, "none for this plant, or a level pose")
    parts = []
    for element in rig.element:
        if element.kind not in SUPPORTED:
            known = ", ".join(SUPPORTED)
            raise InputError(rig.name, f"element.{element.name}", element.kind, f"one of {known}")
        values = {symbol: p.value for symbol, p in parameters(element).items()}
        parts.append(Part(element.kind, element.name, values))
    drives = [
        Drive(source.name, source.K.value, source.p.value, a.delay + source.tau.value)
        for a in rig.actuator
        for source in [sources[a.name]]
    ]
    sensors = []
    for s in rig.sensor:
        match s:
            case RelativeAngle():
                across, position = s.across, 0.0
            case AbsoluteAngle() | Moment():
                across, position = (s.after,), 0.0
            case Acceleration():
                across, position = (s.on,), s.position
            case _:
                raise InputError(rig.name, f"sensor.{s.name}", s.kind, "a known sensor")
        low = s.antialias
        path = SensorPath(
            s.name,
            s.kind,
            tuple(across),
            position,
            (low.order, low.corner_hz) if low else None,
            [s.highpass_hz] if s.highpass_hz > 0 else [],
            s.delay,
        )
        for symbol in ("gain", "tilt"):
            setattr(path, symbol, float(getattr(s, symbol, getattr(path, symbol))))
        if (lag := float(getattr(s, "lag", 0.0))) > 0:
            path.lags.append(lag)
        sensors.append(path)
    return Description(rig.base, rig.rate_hz, parts, sensors, drives, rig.element[-1].name)


SUPPORTED = (
    "beam",
    "rigid_link",
    "lumped_mass",
    "torsional_spring",
    "translational_spring",
    "torsional_ground_spring",
    "translational_ground_spring",
    "gravity_stiffness",
    "angular_velocity_source",
)
