"""Parts at a point: a jump of one state, driven by another, at a port or along a body.

A row of `POINTS` is the jump and its conjugate (diagnosis of point faults), the element that makes
it, its law x(s) and its unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal

import numpy as np

from samii_rig.diagnose.physics import along as along_
from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.along import Along, stretches
from samii_rig.diagnose.physics.effect import Effect, Jump, Key, Unknown, Values
from samii_rig.diagnose.physics.insert import DISPLACEMENT, VOLUME
from samii_rig.diagnose.physics.scales import PAIRS, RANGE, SMALLEST, STARTS, Places, middle, spread
from samii_rig.model.tmm import State
from samii_rig.rig.schema import (
    ANGLE_SOURCES,
    Branch,
    Element,
    GravityStiffness,
    Inertia,
    LumpedMass,
    RelativeAngle,
    Rig,
    RigidLink,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
    parameters,
)
from samii_rig.rig.schema.elements import flattened
from samii_rig.types import Complex, Float
from samii_rig.units import STANDARD_GRAVITY

Law = Literal["spring", "softness", "column", "damper", "slip", "mass"]
LOSS = (1e-4, 10.0)  # damping force over spring force in mid band
LOSS_STARTS = (0.05,)  # the same, at which a search starts
# Damping ratio of an oscillator: that of a steel part clamped well; with more it is a damper and
# does not resonate.
LEAST_DAMPED, MOST_DAMPED = 1e-3, 0.3
# Of the mass of all bodies: who hangs more on a rig knows of it. Ten of SAMII are a car.
MOST_HUNG = 10.0
JOINTS = (TorsionalSpring, TranslationalSpring, *ANGLE_SOURCES)
# Parts of the way along a stretch at which a search begins; its ends are ports. What moves a rigid
# link goes with the square of the place at most; a beam has its modes between.
ON_LINK, ON_BEAM = (0.3, 0.75), (0.2, 0.5, 0.8)


@dataclass(frozen=True, slots=True)
class Point:
    """A row: physics at a point.

    jump, by : the state that jumps and the one that drives it.
    law : what x(s) is: softness 1/(k + c s), column the same with k = D^2/C_h, slip 1/(c s),
        spring k + c s, damper c s, mass m s^2. strong, loss : symbols of its parameters, loss ""
        where there is none.
    kind : the element that it adds to the rig file. tag : in that element's name.
    reported : symbol that the strong one is told by; "" for its own.
    at_source : whether it belongs to a source only. either_sign : whether the strong one may
        be negative (a pendulum upside down). along : whether it may stand along a body.
    """

    physics: str
    jump: State
    by: State
    law: Law
    strong: str
    loss: str
    kind: type[Any]
    tag: str
    reported: str = ""
    at_source: bool = False
    either_sign: bool = False
    along: bool = False

    @property
    def units(self) -> dict[str, str]:
        """Units of the element's parameters, by symbol."""
        return insert.units_of(self.kind)

    @property
    def pair(self) -> int:
        """Its jump among `scales.PAIRS`."""
        return PAIRS.index((self.jump, self.by))

    def bounds(self, x: float, w: float) -> tuple[float, float]:
        """Of the strong unknown. x : of the jump where it begins to matter, at w rad/s."""
        match self.law:
            case "softness" | "column" | "slip":
                scale = 1 / x if self.law != "slip" else 1 / (x * w)
                low, high = (scale * r for r in RANGE)
                if self.law == "column":  # C_h/D^2 is the compliance
                    return DISPLACEMENT**2 / high, DISPLACEMENT**2 / low
                return low, high
            case "spring" | "damper" | "mass":
                scale = x / w ** ("spring", "damper", "mass").index(self.law)
                return scale / RANGE[1], scale / RANGE[0]

    def unknowns(self, x: float, w: float) -> tuple[Unknown, ...]:
        """The strong one, and the loss over it."""
        low, high = self.bounds(x, w)
        unit = VOLUME if self.law == "column" else self.units[self.strong]
        strong = Unknown(self.reported or self.strong, unit, low, high, spread(low, high, STARTS))
        if not self.loss:
            return (strong,)
        return strong, Unknown(self.loss, self.units[self.loss], *LOSS, LOSS_STARTS)

    def values(self, name: str, x: Float, sign: float, w: float) -> dict[Key, float]:
        """Parameters of the element of this name."""
        out = dict.fromkeys(((name, s) for s in self.units), 0.0)
        strong = self._strong(x, sign)
        out[name, "k" if self.law == "column" else self.strong] = float(strong)
        if self.loss:
            out[name, self.loss] = float(strong * x[1] / w)
        return out

    def report(self, x: Float, sign: float, w: float) -> Float:
        """The strong parameter and the loss, as they are told."""
        own = x[0] if self.law == "column" else sign * x[0]
        return np.array([own, self._strong(x, sign) * x[1] / w] if self.loss else [own])

    def x(self, s: Complex, x: Float, sign: float, w: float) -> Complex:
        """x(s), (m, n), of unknowns (m, k)."""
        strong = self._strong(x.T, sign)
        value = np.asarray(strong)[:, None]
        more = s * (strong * x[:, 1] / w)[:, None] if self.loss else 0.0 * s
        match self.law:
            case "softness" | "column":
                return np.asarray(1 / (value + more))
            case "slip":
                return np.asarray(1 / (value * s))
            case "spring":
                return np.asarray(value + more)
            case "damper":
                return np.asarray(value * s)
            case "mass":
                return np.asarray(value * s**2)

    def _strong(self, x: Float, sign: float) -> Any:
        return DISPLACEMENT**2 / x[0] if self.law == "column" else sign * x[0]


POINTS: tuple[Point, ...] = (
    Point(
        "torsional_compliance", "theta", "M", "softness", "k", "c", TorsionalSpring, "spring_",
        along=True,
    ),
    Point(
        "translational_compliance", "w", "V", "softness", "k", "c", TranslationalSpring,
        "shear_spring_", along=True,
    ),
    Point("added_mass", "V", "w", "mass", "m", "", LumpedMass, "mass_", along=True),
    Point("added_inertia", "M", "theta", "mass", "I", "", LumpedMass, "inertia_", "J", along=True),
    Point(
        "ground_spring", "M", "theta", "spring", "k", "c", TorsionalGroundSpring, "brace_",
        along=True,
    ),
    Point(
        "ground_spring", "V", "w", "spring", "k", "c", TranslationalGroundSpring, "brace_",
        along=True,
    ),
    Point(
        "gravity_stiffness", "M", "theta", "spring", "k", "", GravityStiffness, "gravity_",
        either_sign=True,
    ),
    Point(
        "viscous_damping", "M", "theta", "damper", "c", "", TorsionalGroundSpring, "damper_",
        along=True,
    ),
    Point(
        "viscous_damping", "V", "w", "damper", "c", "", TranslationalGroundSpring, "damper_",
        along=True,
    ),
    Point(
        "velocity_feedback", "theta", "M", "slip", "c", "", TorsionalSpring, "slip_", "g_v",
        at_source=True,
    ),
    Point(
        "hydraulic_compressibility", "theta", "M", "column", "C_h", "c", TorsionalSpring, "oil_",
        at_source=True,
    ),
)  # fmt: skip


def effects(rig: Rig, where: Places) -> Iterator[Effect]:
    """All of them on this rig."""
    for row in POINTS:
        for port in range(len(where.names)):
            yield from _at_port(rig, where, row, port)
    hanging = _hanging_on(where)
    for port in range(len(where.names)):
        yield from _hanging_at(rig, where, hanging, port)
    for at, element in enumerate(rig.element):
        for stretch in stretches(rig, element):
            for row in POINTS:
                yield from _along(rig, where, row, at, stretch)
            if not hanging.turning:  # then no body has a length
                yield from _hanging_along(rig, where, hanging, at, stretch)


def _at_port(rig: Rig, where: Places, row: Point, port: int) -> Iterator[Effect]:
    x = where.strength(row.pair, port)
    if not 0 < x < math.inf:
        return
    kinds = {e.name: e for e in rig.element}
    names = where.names[port]
    if row.at_source and not any(isinstance(kinds[n], ANGLE_SOURCES) for n in names):
        return
    w = middle(where)
    unknowns = row.unknowns(x, w)
    if row.kind is GravityStiffness:
        if (strong := _below(unknowns[0], _heaviest(rig))) is None:
            return
        unknowns = (strong, *unknowns[1:])
    after = names[0] if port > 0 else None
    signs = (1.0, -1.0) if row.either_sign else (1.0,)
    site, others, position = _site(rig, row, names, port)
    for (seen, tail), sign in product(_readings(rig, row, names, port), signs):
        name = f"{insert.PREFIX}{row.tag}{port}{tail}"

        def build(r: Rig, name: str = name, seen: tuple[str, ...] = seen) -> Rig:
            made = insert.element_of(row.kind, name, row.units)
            return insert.inserted(r, after, made, seen)

        def values(x: Float, _: Values, name: str = name, sign: float = sign) -> dict[Key, float]:
            return row.values(name, x, sign, w)

        def report(x: Float, sign: float = sign) -> Float:
            return row.report(x, sign, w)

        def x_of(s: Complex, x: Float, sign: float = sign) -> Complex:
            return row.x(s, x, sign, w)

        yield Effect(
            physics=row.physics,
            site=site,
            unknowns=unknowns,
            build=build,
            parameters=values,
            jump=Jump(f"{row.jump} by {row.by} at port {port}{tail}", x_of, (row.jump, row.by)),
            aliases=tuple((row.physics, o) for o in others),
            report=report,
            weight=1 / len(signs),
            variant=name if sign > 0 else f"{name} negative",
            position=position,
        )


def _readings(
    rig: Rig, row: Point, names: tuple[str, ...], port: int
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Which relative angles at whose end the part stands see it: none, or all of them."""
    tail = "w" if row.jump in ("w", "V") else ""
    yield (), tail
    if row.jump != "theta":
        return
    edge = tuple(
        s.name
        for s in rig.sensor
        if isinstance(s, RelativeAngle) and sum(n in s.across for n in names) == 1
    )
    if edge:
        yield edge, f"{tail}e"


def _site(
    rig: Rig, row: Point, names: tuple[str, ...], port: int
) -> tuple[str, tuple[str, ...], float | None]:
    """The element that the place is called by, the other name that it has, and where it is along
    the first."""
    kinds = {e.name: e for e in rig.element}

    def joint(name: str) -> bool:
        return isinstance(kinds[name], JOINTS)

    # What holds a chain of masses to the ground holds a mass, as a person would say it.
    bodily = row.law == "mass" or (rig.motion == "axial" and row.jump == "V")
    ranked = sorted(names, key=lambda n: joint(n) if bodily else not joint(n))
    body = kinds[ranked[0]]
    position = None
    if isinstance(body, along_.BODIES):
        position = body.L.value if port > 0 and ranked[0] == names[0] else 0.0
    return ranked[0], tuple(ranked[1:]), position


def _strength(where: Places, pair: int, at: int) -> float:
    """As of `Places`, of element `at`: of the end where a part matters the sooner."""
    return min(where.strength(pair, at), where.strength(pair, at + 1))


def _stands_along(rig: Rig, row: Point, body: Element) -> bool:
    """Whether a row's part makes a difference along a body that no port does."""
    if row.jump == "V":  # a mass on a link that has some is in `bodies`
        return not (isinstance(body, RigidLink) and row.law == "mass" and body.m.value > 0)
    # Wherever a part turns a rigid link it does the same, and no link has a crack. What lets w jump
    # is a rod's crack; a beam's shifts nothing across it.
    return not isinstance(body, RigidLink) and (row.jump == "w") == (rig.motion == "axial")


def _along(rig: Rig, where: Places, row: Point, at: int, stretch: Along) -> Iterator[Effect]:
    """A row's part along a body."""
    element = rig.element[at]
    x = _strength(where, row.pair, at)
    if not row.along or not _stands_along(rig, row, element) or not 0 < x < math.inf:
        return
    w = middle(where)
    tail = "w" if row.jump == "V" else ""
    name = f"{insert.PREFIX}{row.tag}{at}{tail}_{stretch.number}"
    yield _standing(
        rig,
        row,
        stretch,
        row.unknowns(x, w),
        (name, insert.element_of(row.kind, name, row.units)),
        lambda x: row.values(name, x, 1.0, w),
        lambda x: row.report(x, 1.0, w),
        lambda s, x: row.x(s, x, 1.0, w),
    )


def _standing(
    rig: Rig,
    row: Point,
    stretch: Along,
    unknowns: tuple[Unknown, ...],
    part: tuple[str, Element],
    values: Callable[[Float], dict[Key, float]],
    report: Callable[[Float], Float],
    x_of: Callable[[Complex, Float], Complex],
) -> Effect:
    """An effect with a place along a body as its last unknown. part : name and element.
    values, report, x_of : of the other unknowns."""
    name, element = part
    body = next(e for e in rig.element if e.name == stretch.body)
    touches = tuple((body.name, s) for s in parameters(body))
    link = isinstance(body, RigidLink)

    def build(r: Rig) -> Rig:
        if link:
            parts = element.element if isinstance(element, Branch) else (element,)
            return along_.carried(r, body.name, f"{name}_on", parts)
        return along_.cut(r, stretch, element)

    def placed(x: Float, nominal: Values) -> dict[Key, float]:
        out = values(x)
        if link:
            out[along_.arm_of(f"{name}_on"), "L"] = stretch.position(float(x[-1]))
            return out
        return out | stretch.of_pieces(float(x[-1]), nominal, [*parameters(body)])

    return Effect(
        physics=row.physics,
        site=body.name,
        unknowns=(*unknowns, stretch.unknown(ON_LINK if link else ON_BEAM)),
        build=build,
        parameters=placed,
        touches=() if link else touches,
        jump=Jump(f"{row.jump} by {row.by} {stretch.place()}", x_of, (row.jump, row.by), fixed=1),
        report=lambda x: np.append(report(x), stretch.position(float(x[-1]))),
        weight=stretch.share,
        variant=f"along {name}",
        pieces=() if link else stretch.pieces,
    )


@dataclass(frozen=True, slots=True)
class Hanging:
    """Something that hangs on and resonates. point : its jump, and its mass or inertia. spring :
    the kind of element that it hangs by."""

    point: Point
    spring: type[Any]

    @property
    def turning(self) -> bool:
        """Whether it turns about the chain, and does not shift across it."""
        return self.point.jump == "M"

    def values(self, name: str, x: Float) -> dict[Key, float]:
        """Parameters of the elements of an oscillator of this name."""
        m, k, c = (float(v) for v in _oscillating(x[:3]))
        spring = f"{name}_spring"
        return {(f"{name}_mass", self.point.strong): m, (spring, "k"): k, (spring, "c"): c}


ACROSS = Hanging(
    Point("attached_oscillator", "V", "w", "mass", "m", "", LumpedMass, "oscillator_"),
    TranslationalSpring,
)
TURNING = Hanging(
    Point("attached_oscillator", "M", "theta", "mass", "I", "", Inertia, "oscillator_", "J"),
    TorsionalSpring,
)


def _hanging_on(where: Places) -> Hanging:
    """What may hang on: a mass, or an inertia where nothing of the rig shifts."""
    shifts = (where.strength(ACROSS.point.pair, port) for port in range(len(where.names)))
    return ACROSS if any(0 < x < math.inf for x in shifts) else TURNING


def _swinging(rig: Rig, where: Places, hanging: Hanging, x: float) -> tuple[Unknown, ...]:
    """Mass or inertia, natural frequency and damping ratio of what hangs on; told as m or J, k, c.
    Empty where nothing moves, or hardly anything, so that no mass matters."""
    if not 0 < x < math.inf:
        return ()
    low_w, high_w = (2 * math.pi * float(where.frequency[i]) for i in (0, -1))
    scale = x / middle(where) ** 2
    # At its own frequency a mass does 1/(2 zeta) times what it does elsewhere.
    least = 2 * LEAST_DAMPED * SMALLEST
    low, high = least * scale, min(3 * scale, MOST_HUNG * _sum(rig, hanging) or math.inf)
    if low >= high:
        return ()
    starts = tuple(m for m in spread(SMALLEST * scale, 3 * scale, 7) if m < high)
    point, units = hanging.point, insert.units_of(hanging.spring)
    symbol, unit = point.reported or point.strong, point.units[point.strong]
    return (
        Unknown(symbol, unit, low, high, starts or (math.sqrt(low * high),)),
        Unknown("k", units["k"], low_w, 2 * high_w, spread(low_w, high_w, 48)),
        Unknown("c", units["c"], LEAST_DAMPED, MOST_DAMPED, (0.05,)),
    )


def _sum(rig: Rig, hanging: Hanging) -> float:
    """kg of all bodies of a rig file, or kg m^2."""
    symbol, total = hanging.point.strong, 0.0
    for p in map(parameters, flattened(rig.element)):
        if symbol == "m" and "mu" in p:
            total += p["mu"].value * p["L"].value
        elif symbol in p:
            total += p[symbol].value
    return total


def _heaviest(rig: Rig) -> float:
    """N m/rad of the weight of all that may hang on a rig, at the end of all its lengths; inf where
    the file has no mass or no length."""
    lengths = sum(e.L.value for e in rig.element if isinstance(e, along_.BODIES))
    return MOST_HUNG * STANDARD_GRAVITY * _sum(rig, ACROSS) * lengths or math.inf


def _below(unknown: Unknown, most: float) -> Unknown | None:
    """The same, of no more than `most`; None where none of it is left."""
    if most >= unknown.high:
        return unknown
    if most <= unknown.low:
        return None
    return replace(unknown, high=most, starts=spread(unknown.low, most, STARTS))


def _hanging_at(rig: Rig, where: Places, hanging: Hanging, port: int) -> Iterator[Effect]:
    point = hanging.point
    unknowns = _swinging(rig, where, hanging, where.strength(point.pair, port))
    if not unknowns:
        return
    names = where.names[port]
    name = f"{insert.PREFIX}{point.tag}{port}"
    after = names[0] if port > 0 else None
    site, others, position = _site(rig, point, names, port)
    part = insert.oscillator(name, turning=hanging.turning)
    tail = "" if hanging.turning else "w"
    yield Effect(
        physics=point.physics,
        site=site,
        unknowns=unknowns,
        build=lambda r: insert.inserted(r, after, part),
        parameters=lambda x, _: hanging.values(name, x),
        aliases=tuple((point.physics, o) for o in others),
        report=_oscillating,
        jump=Jump(
            f"{point.jump} by {point.by} at port {port}{tail}", _hanging, (point.jump, point.by)
        ),
        variant=name,
        position=position,
    )


def _hanging_along(
    rig: Rig, where: Places, hanging: Hanging, at: int, stretch: Along
) -> Iterator[Effect]:
    unknowns = _swinging(rig, where, hanging, _strength(where, hanging.point.pair, at))
    if not unknowns:
        return
    name = f"{insert.PREFIX}{hanging.point.tag}{at}_{stretch.number}"
    yield _standing(
        rig,
        hanging.point,
        stretch,
        unknowns,
        (name, insert.oscillator(name)),
        lambda x: hanging.values(name, x),
        lambda x: _oscillating(x[:3]),
        _hanging,
    )


def _hanging(s: Complex, x: Float) -> Complex:
    """Force over motion of a mass on a spring, (m, n)."""
    m, w, zeta = (x[:, i : i + 1] for i in range(3))
    held = w**2 + 2 * zeta * w * s
    return np.asarray(m * s**2 * held / (s**2 + held))


def _oscillating(x: Float) -> Float:
    """m, k, c from mass, natural frequency and damping ratio."""
    return np.array([x[0], x[0] * x[1] ** 2, 2 * x[2] * x[0] * x[1]])
