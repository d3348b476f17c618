"""The elements of a chain as the rig file gives them: kinds, parameters, units, what is allowed.

Every physical parameter carries its unit, its tolerance and where the number came from.
The state vector along the chain is z = [w, theta, M, V, 1] (paper 2, eq. 8), its sign
convention w' = theta, theta' = M/EI, M' = V, V' = -mu s^2 w (paper 1, eq. 1-5, where the
first state is written -w).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
End = Literal["clamped", "pinned", "free"]


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


@dataclass(frozen=True, slots=True)
class Quantity:
    """What a parameter must be: its unit, and the sign of its value."""

    unit: str
    sign: Literal["positive", "not negative", "any"]

    def refusal(self, value: float) -> str | None:
        """Why `value` is not allowed, as a statement with what would be; None if it is."""
        if not math.isfinite(value):
            return f"value {value:g} {self.unit}; expected a finite number"
        if self.sign == "positive" and value <= 0:
            return f"value {value:g} {self.unit}; expected more than 0"
        if self.sign == "not negative" and value < 0:
            return f"value {value:g} {self.unit}; expected 0 or more"
        return None

    def __call__(self, parameter: Parameter | None) -> Parameter | None:
        """The parameter itself; ValueError if it is not allowed."""
        if parameter is None:
            return None
        if parameter.unit != self.unit:
            raise ValueError(f"unit {parameter.unit!r}; expected {self.unit!r}")
        refusal = self.refusal(parameter.value)
        if refusal:
            raise ValueError(refusal)
        return parameter


def _positive(unit: str) -> AfterValidator:
    return AfterValidator(Quantity(unit, "positive"))


def _not_negative(unit: str) -> AfterValidator:
    return AfterValidator(Quantity(unit, "not negative"))


def _zero(unit: str) -> Parameter:
    return Parameter(value=0.0, unit=unit, source="absent from the rig file: none")


class ElementBase(Strict):
    """What every element has."""

    name: Name

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        wrong = contradiction(type(self), {k: p.value for k, p in parameters(self).items()})
        if wrong:
            raise ValueError(wrong)
        return self


class Beam(ElementBase):
    """Euler-Bernoulli beam (paper 1, eq. 1-9).

    Its complex stiffness is EI (1 + j eta + s tau): `eta` is a constant loss factor
    (not causal, so the simulated rig replaces it by a causal fit), `tau` a viscous
    (Kelvin-Voigt) damping time, which is causal.
    """

    kind: Literal["beam"]
    EI: Annotated[Parameter, _positive("N m^2")]
    mu: Annotated[Parameter, _positive("kg/m")]
    L: Annotated[Parameter, _positive("m")]
    eta: Annotated[Parameter, _not_negative("1")] = _zero("1")
    tau: Annotated[Parameter, _not_negative("s")] = _zero("s")


class TimoshenkoBeam(ElementBase):
    """Beam with shear and rotary inertia: w' = theta - V/GA, M' = V + J s^2 theta.

    GA is the shear stiffness (shear coefficient included), J the rotary inertia a metre.
    Both stiffnesses carry the factor 1 + j eta + s tau of `Beam`.
    """

    kind: Literal["timoshenko_beam"]
    EI: Annotated[Parameter, _positive("N m^2")]
    mu: Annotated[Parameter, _positive("kg/m")]
    L: Annotated[Parameter, _positive("m")]
    eta: Annotated[Parameter, _not_negative("1")] = _zero("1")
    tau: Annotated[Parameter, _not_negative("s")] = _zero("s")
    GA: Annotated[Parameter, _positive("N")]
    J: Annotated[Parameter, _not_negative("kg m")]


class RigidLink(ElementBase):
    """Rigid body: length L, centre of gravity r from its upstream joint, mass m,
    second moment of inertia I about the centre of gravity."""

    kind: Literal["rigid_link"]
    L: Annotated[Parameter, _not_negative("m")]
    r: Annotated[Parameter, _not_negative("m")]
    m: Annotated[Parameter, _not_negative("kg")]
    I: Annotated[Parameter, _not_negative("kg m^2")]  # noqa: E741 the papers' symbol


class LumpedMass(ElementBase):
    """Mass and second moment of inertia at a point: V+ = V- - m s^2 w, M+ = M- + I s^2 theta."""

    kind: Literal["lumped_mass"]
    m: Annotated[Parameter, _not_negative("kg")]
    I: Annotated[Parameter, _not_negative("kg m^2")] = _zero("kg m^2")  # noqa: E741


class TorsionalSpring(ElementBase):
    """Torsional spring and damper in parallel: theta+ = theta- + M/(c s + k).

    k = 0 leaves the damper alone; behind an angular velocity source that is the actuator
    with intrinsic velocity feedback, c = g_v (paper 1, eq. 18 and section V-A).
    """

    kind: Literal["torsional_spring"]
    k: Annotated[Parameter, _not_negative("N m/rad")]
    c: Annotated[Parameter, _not_negative("N m s/rad")] = _zero("N m s/rad")


class TranslationalSpring(ElementBase):
    """Spring and damper across the chain: w+ = w- - V/(c s + k); the shear force is -V."""

    kind: Literal["translational_spring"]
    k: Annotated[Parameter, _not_negative("N/m")]
    c: Annotated[Parameter, _not_negative("N s/m")] = _zero("N s/m")


class TorsionalGroundSpring(ElementBase):
    """Torsional spring and damper to the ground: M+ = M- + (c s + k) theta."""

    kind: Literal["torsional_ground_spring"]
    k: Annotated[Parameter, _not_negative("N m/rad")]
    c: Annotated[Parameter, _not_negative("N m s/rad")] = _zero("N m s/rad")


class TranslationalGroundSpring(ElementBase):
    """Spring and damper to the ground: V+ = V- - (c s + k) w."""

    kind: Literal["translational_ground_spring"]
    k: Annotated[Parameter, _not_negative("N/m")]
    c: Annotated[Parameter, _not_negative("N s/m")] = _zero("N s/m")


class GravityStiffness(ElementBase):
    """Moment of gravity about a joint, M+ = M- + k theta (paper 2, eq. 4): k = m g r of what
    hangs on the joint, negative for what stands on it."""

    kind: Literal["gravity_stiffness"]
    k: Annotated[Parameter, AfterValidator(Quantity("N m/rad", "any"))]


class OilColumn(ElementBase):
    """Compressible oil between valve and vane: theta+ = theta- + M C_h/D^2.

    D displacement of the motor, C_h = volume/bulk modulus.
    """

    kind: Literal["oil_column"]
    D: Annotated[Parameter, _positive("m^3/rad")]
    C_h: Annotated[Parameter, _not_negative("m^3/Pa")]


class HydraulicLine(ElementBase):
    """A line of length L between a valve and a vane, with waves in it.

    It stands directly behind the angular velocity source that `source` names, whose flow
    enters its valve end: theta+ = theta- + (source)/cosh(G) + M tanh(G)/(Z D^2 s) with
    G = L sqrt((rho s/A + R) A s/B) and Z = sqrt((rho s/A + R) B/(A s)). A cross-section, rho
    density, B bulk modulus, R laminar resistance (pressure a flow a metre).
    """

    kind: Literal["hydraulic_line"]
    source: Name
    D: Annotated[Parameter, _positive("m^3/rad")]
    L: Annotated[Parameter, _positive("m")]
    A: Annotated[Parameter, _positive("m^2")]
    rho: Annotated[Parameter, _positive("kg/m^3")]
    B: Annotated[Parameter, _positive("Pa")]
    R: Annotated[Parameter, _not_negative("Pa s/m^4")] = _zero("Pa s/m^4")


class LumpedLine(ElementBase):
    """A line between a valve and a vane in one lump: at the valve its oil gives way, C_h, against
    a resistance R_h; towards the vane it has to be moved, inertance L_h.

    It stands directly behind the angular velocity source that `source` names:
    theta+ = theta- + ((2 zeta omega s + omega^2) (source) + omega^2 M C_h/D^2)/N,
    N = s^2 + 2 zeta omega s + omega^2, omega^2 = 1/(L_h C_h), zeta = R_h/2 sqrt(C_h/L_h).
    """

    kind: Literal["lumped_line"]
    source: Name
    D: Annotated[Parameter, _positive("m^3/rad")]
    C_h: Annotated[Parameter, _positive("m^3/Pa")]
    omega: Annotated[Parameter, _positive("rad/s")]
    zeta: Annotated[Parameter, _not_negative("1")]


class AngularVelocitySource(ElementBase):
    """Angular velocity source with a first-order lag (paper 2, eq. 1):
    theta+ = theta- + K p v exp(-s tau)/(s (s + p)), v the input called `input`.

    The unit of K is rad/s per unit of that input, "rad/(s V)" for volts; tau is a dead time.
    """

    kind: Literal["angular_velocity_source"]
    input: Name
    K: Parameter
    p: Annotated[Parameter, _positive("rad/s")]
    tau: Annotated[Parameter, _not_negative("s")] = _zero("s")


class AngularVelocitySource2(ElementBase):
    """Angular velocity source with a second-order lag (paper 2, eq. 2):
    theta+ = theta- + K omega^2 v exp(-s tau)/(s (s^2 + 2 zeta omega s + omega^2))."""

    kind: Literal["angular_velocity_source_2"]
    input: Name
    K: Parameter
    omega: Annotated[Parameter, _positive("rad/s")]
    zeta: Annotated[Parameter, _positive("1")]
    tau: Annotated[Parameter, _not_negative("s")] = _zero("s")


class TorqueSource(ElementBase):
    """Torque K v exp(-s tau)/(1 + s/p) on the chain, positive as theta: M+ = M- - torque.

    It reacts against the ground. A motor inside a joint is two of them on one input, -K
    before the joint's spring and damper and K behind. Without p there is no lag. The unit of K
    is "N m/V" for volts.
    """

    kind: Literal["torque_source"]
    input: Name
    K: Parameter
    p: Annotated[Parameter | None, _positive("rad/s")] = None
    tau: Annotated[Parameter, _not_negative("s")] = _zero("s")


class ForceSource(ElementBase):
    """Lateral force K v exp(-s tau)/(1 + s/p) on the chain, positive as w: V+ = V- + force.

    It reacts against the ground (a shaker). The unit of K is "N/V" for volts.
    """

    kind: Literal["force_source"]
    input: Name
    K: Parameter
    p: Annotated[Parameter | None, _positive("rad/s")] = None
    tau: Annotated[Parameter, _not_negative("s")] = _zero("s")


Passive = Annotated[
    Beam
    | TimoshenkoBeam
    | RigidLink
    | LumpedMass
    | TorsionalSpring
    | TranslationalSpring
    | TorsionalGroundSpring
    | TranslationalGroundSpring
    | GravityStiffness
    | OilColumn,
    Field(discriminator="kind"),
]


class Branch(ElementBase):
    """A side chain, fixed to the main chain at this place and running on in its direction.

    element : its own elements from there to its `tip`; no sources, and no sensor stands on it.
    """

    kind: Literal["branch"]
    element: Annotated[tuple[Passive, ...], Field(min_length=1)]
    tip: End = "free"


Source = AngularVelocitySource | AngularVelocitySource2 | TorqueSource | ForceSource
SOURCES = (AngularVelocitySource, AngularVelocitySource2, TorqueSource, ForceSource)
ANGLE_SOURCES = (AngularVelocitySource, AngularVelocitySource2)
BEAMS = (Beam, TimoshenkoBeam)
LINES = (HydraulicLine, LumpedLine)

Element = Annotated[
    Beam
    | TimoshenkoBeam
    | RigidLink
    | LumpedMass
    | TorsionalSpring
    | TranslationalSpring
    | TorsionalGroundSpring
    | TranslationalGroundSpring
    | GravityStiffness
    | OilColumn
    | HydraulicLine
    | LumpedLine
    | Branch
    | AngularVelocitySource
    | AngularVelocitySource2
    | TorqueSource
    | ForceSource,
    Field(discriminator="kind"),
]


def _some_stiffness(v: Mapping[str, float]) -> str | None:
    return "k and c are both 0; expected one above 0" if v["k"] == 0 and v["c"] == 0 else None


def _some_mass(v: Mapping[str, float]) -> str | None:
    return "I without m; expected a mass above 0" if v["m"] == 0 and v["I"] > 0 else None


_RULES: dict[type[BaseModel], Callable[[Mapping[str, float]], str | None]] = {
    TorsionalSpring: _some_stiffness,
    TranslationalSpring: _some_stiffness,
    RigidLink: _some_mass,
}


def contradiction(kind: type[BaseModel], values: Mapping[str, float]) -> str | None:
    """What is wrong with an element's `values` (by symbol) together; None if nothing is."""
    rule = _RULES.get(kind)
    return rule(values) if rule else None


@cache
def quantities(kind: type[BaseModel]) -> dict[str, Quantity]:
    """What each parameter of a kind of element must be, by symbol."""
    out: dict[str, Quantity] = {}
    for symbol, field in kind.model_fields.items():
        for item in field.metadata:
            if isinstance(item, AfterValidator) and isinstance(item.func, Quantity):
                out[symbol] = item.func
    return out


def parameters(element: BaseModel) -> dict[str, Parameter]:
    """The element's physical parameters by symbol, in the order of its class."""
    return {k: v for k, v in iter(element) if isinstance(v, Parameter)}


def flattened(elements: tuple[Any, ...]) -> Iterator[Any]:
    """All elements base to tip; those of a branch follow it."""
    for element in elements:
        yield element
        if isinstance(element, Branch):
            yield from element.element
