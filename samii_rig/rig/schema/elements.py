"""The elements of a chain as the rig file gives them: kinds, parameters, units, what is allowed.

Every physical parameter carries its unit, its tolerance and where the number came from.
The state vector along the chain is z = [w, theta, M, V, 1] (paper 2, eq. 8), its sign
convention w' = theta, theta' = M/EI, M' = V, V' = -mu s^2 w (paper 1, eq. 1-5, where the
first state is written -w). Of a chain that moves along itself, `motion = "axial"`, w is the
displacement along it and -V the force of tension; theta and M rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field

from samii_rig.rig.schema.base import (
    ElementBase,
    Finite,
    Name,
    NonNegative,
    Parameter,
    Positive,
    Quantity,
    Rule,
    Strict,
    both_or_neither,
    contradiction,
    converted,
    not_negative,
    not_zero,
    parameters,
    positive,
    quantities,
    some_mass,
    some_stiffness,
    zero,
)
from samii_rig.rig.schema.pose import BendAngle

__all__ = [
    "Finite",
    "Name",
    "NonNegative",
    "Parameter",
    "Positive",
    "Quantity",
    "Strict",
    "contradiction",
    "converted",
    "parameters",
    "quantities",
]

End = Literal["clamped", "pinned", "free"]
Motion = Literal["lateral", "axial"]


class Beam(ElementBase):
    """Euler-Bernoulli beam (paper 1, eq. 1-9).

    Its complex stiffness is EI (1 + j eta + s tau): `eta` is a constant loss factor
    (not causal, so the simulated rig replaces it by a causal fit), `tau` a viscous
    (Kelvin-Voigt) damping time, which is causal.
    """

    kind: Literal["beam"]
    EI: Annotated[Parameter, positive("N m^2")]
    mu: Annotated[Parameter, positive("kg/m")]
    L: Annotated[Parameter, positive("m")]
    eta: Annotated[Parameter, not_negative("1")] = zero("1")
    tau: Annotated[Parameter, not_negative("s")] = zero("s")


class TimoshenkoBeam(ElementBase):
    """Beam with shear and rotary inertia: w' = theta - V/GA, M' = V + J s^2 theta.

    GA is the shear stiffness (shear coefficient included), J the rotary inertia a metre.
    Both stiffnesses carry the factor 1 + j eta + s tau of `Beam`.
    """

    kind: Literal["timoshenko_beam"]
    EI: Annotated[Parameter, positive("N m^2")]
    mu: Annotated[Parameter, positive("kg/m")]
    L: Annotated[Parameter, positive("m")]
    eta: Annotated[Parameter, not_negative("1")] = zero("1")
    tau: Annotated[Parameter, not_negative("s")] = zero("s")
    GA: Annotated[Parameter, positive("N")]
    J: Annotated[Parameter, not_negative("kg m")]


class RigidLink(ElementBase):
    """Rigid body: length L, centre of gravity r from its upstream joint, mass m,
    second moment of inertia I about the centre of gravity."""

    rule: ClassVar[Rule | None] = some_mass

    kind: Literal["rigid_link"]
    L: Annotated[Parameter, not_negative("m")]
    r: Annotated[Parameter, not_negative("m")]
    m: Annotated[Parameter, not_negative("kg")]
    I: Annotated[Parameter, not_negative("kg m^2")]  # noqa: E741 the papers' symbol


class LumpedMass(ElementBase):
    """Mass and second moment of inertia at a point: V+ = V- - m s^2 w, M+ = M- + I s^2 theta."""

    kind: Literal["lumped_mass", "mass"]
    m: Annotated[Parameter, not_negative("kg")]
    I: Annotated[Parameter, not_negative("kg m^2")] = zero("kg m^2")  # noqa: E741


class Inertia(LumpedMass):
    """A lumped mass that only turns: a rotor, a flywheel, a pulley."""

    kind: Literal["inertia"]  # type: ignore[assignment]
    m: Annotated[Parameter, not_negative("kg")] = zero("kg")
    I: Annotated[Parameter, positive("kg m^2")]  # noqa: E741


class Gear(ElementBase):
    """A gear or belt drive without play: theta+ = theta-/n, M+ = n M-.

    n is how often the base's side turns for one turn behind it; negative for the other sense.
    """

    rule: ClassVar[Rule | None] = not_zero("n")

    kind: Literal["gear"]
    n: Annotated[Parameter, AfterValidator(Quantity("1", "any"))]


class Spindle(ElementBase):
    """From rotation to translation, a screw or a rack: w+ = lead theta-, V+ = -M-/lead.

    Before it an axial chain turns, behind it it slides; what turned stays behind.
    """

    rule: ClassVar[Rule | None] = not_zero("lead")

    kind: Literal["spindle"]
    lead: Annotated[Parameter, AfterValidator(Quantity("m/rad", "any"))]


class Bend(ElementBase):
    """A joint at rest at an angle: what lies beyond leaves the line of the chain by `angle`.

    What is across the chain before it is across and along what lies beyond, which is as stiff along
    itself as a rigid body: w+ = w- cos(angle), V+ = (V- - m s^2 sin^2(angle) w-)/cos(angle), m the
    mass of all that lies beyond.
    """

    kind: Literal["bend"]
    angle: BendAngle


class TorsionalSpring(ElementBase):
    """Torsional spring and damper in parallel: theta+ = theta- + M/(c s + k).

    k = 0 leaves the damper alone; behind an angular velocity source that is the actuator
    with intrinsic velocity feedback, c = g_v (paper 1, eq. 18 and section V-A).
    """

    rule: ClassVar[Rule | None] = some_stiffness

    kind: Literal["torsional_spring"]
    k: Annotated[Parameter, not_negative("N m/rad")]
    c: Annotated[Parameter, not_negative("N m s/rad")] = zero("N m s/rad")


class TranslationalSpring(ElementBase):
    """Spring and damper across the chain: w+ = w- - V/(c s + k); the shear force is -V.

    Of an axial chain the spring or damper between two parts, -V its tension.
    """

    rule: ClassVar[Rule | None] = some_stiffness

    kind: Literal["translational_spring", "spring", "damper"]
    k: Annotated[Parameter, not_negative("N/m")] = zero("N/m")
    c: Annotated[Parameter, not_negative("N s/m")] = zero("N s/m")


class TorsionalGroundSpring(ElementBase):
    """Torsional spring and damper to the ground: M+ = M- + (c s + k) theta."""

    kind: Literal["torsional_ground_spring"]
    k: Annotated[Parameter, not_negative("N m/rad")]
    c: Annotated[Parameter, not_negative("N m s/rad")] = zero("N m s/rad")


class TranslationalGroundSpring(ElementBase):
    """Spring and damper to the ground: V+ = V- - (c s + k) w."""

    kind: Literal["translational_ground_spring", "ground_spring", "ground_damper"]
    k: Annotated[Parameter, not_negative("N/m")] = zero("N/m")
    c: Annotated[Parameter, not_negative("N s/m")] = zero("N s/m")


class GravityStiffness(ElementBase):
    """Moment of gravity about a joint, M+ = M- + k theta (paper 2, eq. 4): k = m g r of what
    hangs on the joint, negative for what stands on it."""

    kind: Literal["gravity_stiffness"]
    k: Annotated[Parameter, AfterValidator(Quantity("N m/rad", "any"))]


class Rod(ElementBase):
    """A rod that is stretched along itself, with waves in it: w' = -V/EA, V' = -mu s^2 w.

    Its complex stiffness is EA (1 + s tau), tau a viscous (Kelvin-Voigt) damping time.
    """

    kind: Literal["rod"]
    EA: Annotated[Parameter, positive("N")]
    mu: Annotated[Parameter, positive("kg/m")]
    L: Annotated[Parameter, positive("m")]
    tau: Annotated[Parameter, not_negative("s")] = zero("s")


class OilColumn(ElementBase):
    """Compressible oil between valve and vane: theta+ = theta- + M C_h/D^2.

    D displacement of the motor, C_h = volume/bulk modulus.
    """

    kind: Literal["oil_column"]
    D: Annotated[Parameter, positive("m^3/rad")]
    C_h: Annotated[Parameter, not_negative("m^3/Pa")]


class Cylinder(ElementBase):
    """The oil in a cylinder's two chambers, which gives way: w+ = w- - V/k(s).

    It stands behind the velocity source that the valve's flow makes, K = flow gain/A_1, flows
    in and out as A_1 to A_2. A_1, A_2 piston areas, V_1, V_2 volumes at the working point with
    the pipes, B bulk modulus, leak between the chambers as flow a pressure. With
    S_k = A_1^k/V_1 + A_2^k/V_2 and g = B leak,
    k(s) = B (S_2 s + g (S_2 S_0 - S_1^2))/(s + g S_0) (Merritt, Hydraulic Control Systems, 6-1,
    for both chambers apart).
    """

    kind: Literal["cylinder"]
    A_1: Annotated[Parameter, positive("m^2")]
    A_2: Annotated[Parameter, positive("m^2")]
    V_1: Annotated[Parameter, positive("m^3")]
    V_2: Annotated[Parameter, positive("m^3")]
    B: Annotated[Parameter, positive("Pa")]
    leak: Annotated[Parameter, not_negative("m^3/(s Pa)")] = zero("m^3/(s Pa)")


class HydraulicLine(ElementBase):
    """A line of length L between a valve and a vane, with waves in it.

    It stands directly behind the angular velocity source that `source` names, whose flow
    enters its valve end: theta+ = theta- + (source)/cosh(G) + M tanh(G)/(Z D^2 s) with
    G = L sqrt((rho s/A + R) A s/B) and Z = sqrt((rho s/A + R) B/(A s)). A cross-section, rho
    density, B bulk modulus, R laminar resistance (pressure a flow a metre).
    """

    kind: Literal["hydraulic_line"]
    source: Name
    D: Annotated[Parameter, positive("m^3/rad")]
    L: Annotated[Parameter, positive("m")]
    A: Annotated[Parameter, positive("m^2")]
    rho: Annotated[Parameter, positive("kg/m^3")]
    B: Annotated[Parameter, positive("Pa")]
    R: Annotated[Parameter, not_negative("Pa s/m^4")] = zero("Pa s/m^4")


class LumpedLine(ElementBase):
    """A line between a valve and a vane in one lump: at the valve its oil gives way, C_h, against
    a resistance R_h; towards the vane it has to be moved, inertance L_h.

    It stands directly behind the angular velocity source that `source` names:
    theta+ = theta- + ((2 zeta omega s + omega^2) (source) + omega^2 M C_h/D^2)/N,
    N = s^2 + 2 zeta omega s + omega^2, omega^2 = 1/(L_h C_h), zeta = R_h/2 sqrt(C_h/L_h).
    """

    kind: Literal["lumped_line"]
    source: Name
    D: Annotated[Parameter, positive("m^3/rad")]
    C_h: Annotated[Parameter, positive("m^3/Pa")]
    omega: Annotated[Parameter, positive("rad/s")]
    zeta: Annotated[Parameter, not_negative("1")]


class AngularVelocitySource(ElementBase):
    """Angular velocity source with a first-order lag (paper 2, eq. 1):
    theta+ = theta- + K p v exp(-s tau)/(s (s + p)), v the input called `input`.

    The unit of K is rad/s per unit of that input, "rad/(s V)" for volts; tau is a dead time.
    """

    kind: Literal["angular_velocity_source"]
    input: Name
    K: Parameter
    p: Annotated[Parameter, positive("rad/s")]
    tau: Annotated[Parameter, not_negative("s")] = zero("s")


class AngularVelocitySource2(ElementBase):
    """Angular velocity source with a second-order lag (paper 2, eq. 2):
    theta+ = theta- + K omega^2 v exp(-s tau)/(s (s^2 + 2 zeta omega s + omega^2))."""

    kind: Literal["angular_velocity_source_2"]
    input: Name
    K: Parameter
    omega: Annotated[Parameter, positive("rad/s")]
    zeta: Annotated[Parameter, positive("1")]
    tau: Annotated[Parameter, not_negative("s")] = zero("s")


class TorqueSource(ElementBase):
    """Torque K v exp(-s tau)/(1 + s/p) on the chain, positive as theta: M+ = M- - torque.

    It reacts against the ground. A motor inside a joint is two of them on one input, -K
    before the joint's spring and damper and K behind. Without p there is no lag. The unit of K
    is "N m/V" for volts.
    """

    kind: Literal["torque_source"]
    input: Name
    K: Parameter
    p: Annotated[Parameter | None, positive("rad/s")] = None
    tau: Annotated[Parameter, not_negative("s")] = zero("s")


class ForceSource(ElementBase):
    """Force K v exp(-s tau)/(1 + s/p) on the chain, positive as w: V+ = V- + force.

    It reacts against the ground (a shaker). Between two parts there are two of them on one input,
    -K on the one and K on the other. The unit of K is "N/V" for volts.
    """

    kind: Literal["force_source"]
    input: Name
    K: Parameter
    p: Annotated[Parameter | None, positive("rad/s")] = None
    tau: Annotated[Parameter, not_negative("s")] = zero("s")


class DisplacementSource(ElementBase):
    """Prescribed displacement (a testing machine):
    w+ = w- + K omega^2 v exp(-s tau)/(s^2 + 2 zeta omega s + omega^2).

    It moves what follows against what comes before, whatever force that takes; omega and zeta
    are those of its own control. The unit of K is "m/V" for volts.
    """

    kind: Literal["displacement_source"]
    input: Name
    K: Parameter
    omega: Annotated[Parameter, positive("rad/s")]
    zeta: Annotated[Parameter, positive("1")]
    tau: Annotated[Parameter, not_negative("s")] = zero("s")


class VelocitySource(ElementBase):
    """Prescribed velocity with a first-order lag (a spindle, a cylinder on its valve):
    w+ = w- + K p v exp(-s tau)/(s (s + p)). The unit of K is "m/(s V)" for volts."""

    kind: Literal["velocity_source"]
    input: Name
    K: Parameter
    p: Annotated[Parameter, positive("rad/s")]
    tau: Annotated[Parameter, not_negative("s")] = zero("s")


class AccelerationSource(ElementBase):
    """A shaker's table, its acceleration K v above its suspension's natural frequency:
    w+ = w- + K v exp(-s tau)/(s^2 + 2 zeta omega s + omega^2).

    No table keeps an acceleration for ever, so omega and zeta are its own. Where the acceleration
    of the table was measured and is the input, it has neither: w+ = w- + K v exp(-s tau)/s^2. The
    unit of K is "m/(s^2 V)" for volts.
    """

    rule: ClassVar[Rule | None] = both_or_neither("omega", "zeta")

    kind: Literal["acceleration_source"]
    input: Name
    K: Parameter
    omega: Annotated[Parameter | None, positive("rad/s")] = None
    zeta: Annotated[Parameter | None, positive("1")] = None
    tau: Annotated[Parameter, not_negative("s")] = zero("s")

    @property
    def suspension(self) -> tuple[float, float]:
        """omega, rad/s, and zeta; 0 and 0 for none."""
        if self.omega is None or self.zeta is None:
            return 0.0, 0.0
        return self.omega.value, self.zeta.value


Passive = Annotated[
    Beam
    | TimoshenkoBeam
    | RigidLink
    | LumpedMass
    | Inertia
    | TorsionalSpring
    | TranslationalSpring
    | TorsionalGroundSpring
    | TranslationalGroundSpring
    | GravityStiffness
    | Rod
    | OilColumn
    | Cylinder,
    Field(discriminator="kind"),
]


class Branch(ElementBase):
    """A side chain, fixed to the main chain at this place and running on in its direction.

    element : its own elements from there to its `tip`; no sources, and no sensor stands on it.
    """

    kind: Literal["branch"]
    element: Annotated[tuple[Passive, ...], Field(min_length=1)]
    tip: End = "free"


Source = (
    AngularVelocitySource
    | AngularVelocitySource2
    | TorqueSource
    | ForceSource
    | DisplacementSource
    | VelocitySource
    | AccelerationSource
)
ANGLE_SOURCES = (AngularVelocitySource, AngularVelocitySource2)
MOTION_SOURCES = (DisplacementSource, VelocitySource, AccelerationSource)  # prescribe w
SOURCES = (*ANGLE_SOURCES, TorqueSource, ForceSource, *MOTION_SOURCES)
BEAMS = (Beam, TimoshenkoBeam)
LINES = (HydraulicLine, LumpedLine)
TRANSFORMERS = (Gear, Spindle, Bend)

Element = Annotated[
    Beam
    | TimoshenkoBeam
    | RigidLink
    | LumpedMass
    | Inertia
    | Gear
    | Spindle
    | Bend
    | TorsionalSpring
    | TranslationalSpring
    | TorsionalGroundSpring
    | TranslationalGroundSpring
    | GravityStiffness
    | Rod
    | OilColumn
    | Cylinder
    | HydraulicLine
    | LumpedLine
    | Branch
    | AngularVelocitySource
    | AngularVelocitySource2
    | TorqueSource
    | ForceSource
    | DisplacementSource
    | VelocitySource
    | AccelerationSource,
    Field(discriminator="kind"),
]

# What a chain along itself is made of.
AXIAL = (
    LumpedMass,
    TranslationalSpring,
    TranslationalGroundSpring,
    Rod,
    Cylinder,
    Branch,
    ForceSource,
    *MOTION_SOURCES,
)

# What may stand before its spindle.
TURNING = (
    LumpedMass,
    TorsionalSpring,
    TorsionalGroundSpring,
    GravityStiffness,
    OilColumn,
    Gear,
    *LINES,
    *ANGLE_SOURCES,
    TorqueSource,
)


def output_unit(kind: str) -> str:
    """Unit of what a source of this kind gives."""
    match kind:
        case "torque_source":
            return "N m"
        case "force_source":
            return "N"
        case "displacement_source":
            return "m"
        case "velocity_source":
            return "m/s"
        case "acceleration_source":
            return "m/s^2"
    return "rad/s"


def input_unit(kind: str, unit: str) -> str:
    """Unit of K of a source of this kind with an input in `unit`."""
    # A `/` is for the next factor alone: of an input in N m the bracket makes it one of both.
    whole = f"({unit})" if set(unit) & set(" /*") else unit
    way, a, time = output_unit(kind).partition("/")
    return f"{way}/({time} {unit})" if a else f"{way}/{whole}"


def flattened(elements: tuple[Any, ...]) -> Iterator[Any]:
    """All elements base to tip; those of a branch follow it."""
    for element in elements:
        yield element
        if isinstance(element, Branch):
            yield from element.element
