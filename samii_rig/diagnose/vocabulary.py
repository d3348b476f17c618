"""The table of physics: what may have been left out of a rig file, as data.

A row of `POINTS` is a jump of one state at a port, driven by its conjugate (diagnosis of point
faults), the element that makes it, and its unknowns. Rows of channels are factors. A lab adds
effects by the entry point `samii_rig.effects`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from itertools import product
from typing import Any, Literal

import numpy as np

from samii_rig.devices.plugins import asked, named, wrong
from samii_rig.diagnose import bodies, channels, insert, less
from samii_rig.diagnose.effect import Effect, Jump, Key, Unknown, Values
from samii_rig.diagnose.insert import DISPLACEMENT, VOLUME
from samii_rig.diagnose.scales import PAIRS, REACH, Places, middle, places, spread
from samii_rig.model.tmm import State
from samii_rig.rig.elements import quantities
from samii_rig.rig.schema import (
    ANGLE_SOURCES,
    GravityStiffness,
    LumpedMass,
    RelativeAngle,
    Rig,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
)
from samii_rig.types import Complex, Float

Law = Literal["spring", "softness", "column", "damper", "slip", "mass"]
GROUP = "samii_rig.effects"  # of entry points
LOSS = (1e-4, 10.0)  # damping force over spring force in mid band
LOSS_STARTS = (0.05,)
MOST_DAMPED = 0.3  # damping ratio of an oscillator; with more it is a damper and does not resonate
JOINTS = (TorsionalSpring, TranslationalSpring, *ANGLE_SOURCES)


@dataclass(frozen=True, slots=True)
class Point:
    """A row: physics at a port.

    jump, by : the state that jumps and the one that drives it.
    law : what x(s) is: softness 1/(k + c s), column the same with k = D^2/C_h, slip 1/(c s),
        spring k + c s, damper c s, mass m s^2. strong, loss : symbols of its parameters, loss ""
        where there is none.
    kind : the element that it adds to the rig file.
    at_source : whether it belongs to a source only. either_sign : whether the strong one may
        be negative (a pendulum upside down).
    """

    physics: str
    jump: State
    by: State
    law: Law
    strong: str
    loss: str
    kind: type[Any]
    at_source: bool = False
    either_sign: bool = False

    @property
    def units(self) -> dict[str, str]:
        """Units of the element's parameters, by symbol."""
        return {symbol: q.unit for symbol, q in quantities(self.kind).items()}  # type: ignore[arg-type]


POINTS: tuple[Point, ...] = (
    Point("torsional_compliance", "theta", "M", "softness", "k", "c", TorsionalSpring),
    Point("translational_compliance", "w", "V", "softness", "k", "c", TranslationalSpring),
    Point("added_mass", "V", "w", "mass", "m", "", LumpedMass),
    Point("added_inertia", "M", "theta", "mass", "I", "", LumpedMass),
    Point("ground_spring", "M", "theta", "spring", "k", "c", TorsionalGroundSpring),
    Point("ground_spring", "V", "w", "spring", "k", "c", TranslationalGroundSpring),
    Point("gravity_stiffness", "M", "theta", "spring", "k", "", GravityStiffness, either_sign=True),
    Point("viscous_damping", "M", "theta", "damper", "c", "", TorsionalGroundSpring),
    Point("viscous_damping", "V", "w", "damper", "c", "", TranslationalGroundSpring),
    Point("velocity_feedback", "theta", "M", "slip", "c", "", TorsionalSpring, True),
    Point("hydraulic_compressibility", "theta", "M", "column", "C_h", "c", TorsionalSpring, True),
)

REPORTED = {"velocity_feedback": {"c": "g_v"}, "added_inertia": {"I": "J"}}


def hypotheses(rig: Rig, low_hz: float, high_hz: float, *, signed: bool = False) -> list[Effect]:
    """Every single effect that the table knows on this rig; ranges are those of the band.

    signed : with what is taken away, or less than the rig file has: what may change between two
    states.
    """
    where = places(rig, low_hz, high_hz)
    out: list[Effect] = []
    for row in POINTS:
        for port in range(len(where.names)):
            out += _point(rig, where, row, port)
    out += _oscillators(rig, where)
    out += bodies.effects(rig, where)
    out += less.effects(rig) if signed else ()
    out += channels.effects(rig, low_hz, high_hz)
    return out + list(plugged(rig, low_hz, high_hz))


def plugged(rig: Rig, low_hz: float, high_hz: float) -> Iterator[Effect]:
    """The effects of other packages: each entry point of `samii_rig.effects` is a function
    (rig, low_hz, high_hz) -> iterable of Effect, seen by the command line, the service and workers.

    Raises InputError with the entry point's name for what it raises or gives in place of effects.
    """
    for point in entry_points(group=GROUP):
        who = named(point)
        with asked(who, "effects"):
            made = list(point.load()(rig, low_hz, high_hz))
        for effect in made:
            if not isinstance(effect, Effect):
                raise wrong(who, "effects", effect, "an Effect")
        yield from made


def _scale(row: Point, where: Places, port: int) -> float:
    """The value of the strong unknown at which the jump begins to matter."""
    x = where.strength(PAIRS.index((row.jump, row.by)), port)
    w = middle(where)
    match row.law:
        case "softness" | "column":
            return 1 / x
        case "slip":
            return 1 / (x * w)
        case "spring":
            return x
        case "damper":
            return x / w
        case "mass":
            return x / w**2
    raise ValueError(row.law)


def _point(rig: Rig, where: Places, row: Point, port: int) -> Iterator[Effect]:
    scale = _scale(row, where, port)
    if not 0 < scale < math.inf:
        return
    kinds = {e.name: e for e in rig.element}
    names = where.names[port]
    if row.at_source and not any(isinstance(kinds[n], ANGLE_SOURCES) for n in names):
        return
    low, high = (scale * x for x in REACH)
    if row.law in ("spring", "damper", "mass"):
        low, high = scale / REACH[1], scale / REACH[0]
    if row.law == "column":  # C_h/D^2 is the compliance
        low, high = DISPLACEMENT**2 / high, DISPLACEMENT**2 / low
    w = middle(where)
    unit = VOLUME if row.law == "column" else row.units[row.strong]
    unknowns = [Unknown(row.strong, unit, low, high, spread(low, high, 11))]
    if row.loss:
        unknowns.append(Unknown(row.loss, row.units[row.loss], *LOSS, LOSS_STARTS))
    unknowns[0] = _renamed(row, unknowns[0])
    after = names[0] if port > 0 else None
    signs = (1.0, -1.0) if row.either_sign else (1.0,)
    for (seen, tail), sign in product(_readings(rig, row, names, port), signs):
        name = f"{insert.PREFIX}{_TAGS[row.physics]}{port}{tail}"

        def build(r: Rig, name: str = name, seen: tuple[str, ...] = seen) -> Rig:
            made = insert.element_of(row.kind, name, row.units)
            return insert.inserted(r, after, made, seen)

        def values(x: Float, _: Values, name: str = name, sign: float = sign) -> dict[Key, float]:
            out = dict.fromkeys(((name, s) for s in row.units), 0.0)
            strong = DISPLACEMENT**2 / float(x[0]) if row.law == "column" else sign * float(x[0])
            out[name, "k" if row.law == "column" else row.strong] = strong
            if row.loss:
                out[name, row.loss] = strong * float(x[1]) / w
            return out

        def report(x: Float, sign: float = sign) -> Float:
            strong = DISPLACEMENT**2 / x[0] if row.law == "column" else x[0]
            return np.array([x[0], strong * x[1] / w]) if row.loss else sign * x

        def x_of(s: Complex, x: Float, sign: float = sign) -> Complex:
            strong = DISPLACEMENT**2 / x[:, 0] if row.law == "column" else sign * x[:, 0]
            return _x(row, s, strong, strong * x[:, 1] / w if row.loss else 0.0 * strong)

        site, others = _site(rig, row, names)
        yield Effect(
            physics=row.physics,
            site=site,
            unknowns=tuple(unknowns),
            build=build,
            parameters=values,
            jump=Jump(f"{row.jump} by {row.by} at port {port}{tail}", x_of, (row.jump, row.by)),
            aliases=tuple((row.physics, o) for o in others),
            report=report,
            weight=1 / len(signs),
            variant=name if sign > 0 else f"{name} negative",
        )


def _x(row: Point, s: Complex, strong: Float, loss: Float) -> Complex:
    """x(s), (m, n), of the row's element."""
    value, more = strong[:, None], s * loss[:, None]
    match row.law:
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
    raise ValueError(row.law)


_TAGS = {
    "torsional_compliance": "spring_",
    "translational_compliance": "shear_spring_",
    "added_mass": "mass_",
    "added_inertia": "inertia_",
    "ground_spring": "brace_",
    "gravity_stiffness": "gravity_",
    "viscous_damping": "damper_",
    "velocity_feedback": "slip_",
    "hydraulic_compressibility": "oil_",
}


def _renamed(row: Point, unknown: Unknown) -> Unknown:
    symbol = REPORTED.get(row.physics, {}).get(unknown.symbol, unknown.symbol)
    return Unknown(symbol, unknown.unit, unknown.low, unknown.high, unknown.starts)


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


def _site(rig: Rig, row: Point, names: tuple[str, ...]) -> tuple[str, tuple[str, ...]]:
    """The element that the place is called by, and the other name that it has."""
    kinds = {e.name: e for e in rig.element}

    def joint(name: str) -> bool:
        return isinstance(kinds[name], JOINTS)

    # What holds a chain of masses to the ground holds a mass, as a person would say it.
    bodily = row.law == "mass" or (rig.motion == "axial" and row.jump == "V")
    ranked = sorted(names, key=lambda n: joint(n) if bodily else not joint(n))
    return ranked[0], tuple(ranked[1:])


def _oscillators(rig: Rig, where: Places) -> Iterator[Effect]:
    w = middle(where)
    low_w, high_w = (2 * math.pi * float(where.frequency[i]) for i in (0, -1))
    pair = PAIRS.index(("V", "w"))
    row = Point("attached_oscillator", "V", "w", "mass", "m", "", LumpedMass)
    for port, names in enumerate(where.names):
        x = where.strength(pair, port)
        if not 0 < x < math.inf:
            continue
        scale = x / w**2
        masses = (1e-5 * scale, 3 * scale)
        name = f"{insert.PREFIX}oscillator_{port}"
        after = names[0] if port > 0 else None

        def build(r: Rig, name: str = name, after: str | None = after) -> Rig:
            return insert.inserted(r, after, insert.oscillator(name))

        def values(x: Float, _: Values, name: str = name) -> dict[Key, float]:
            m, k, c = _oscillating(x)
            return {
                (f"{name}_spring", "k"): float(k),
                (f"{name}_spring", "c"): float(c),
                (f"{name}_mass", "m"): float(m),
            }

        site, others = _site(rig, row, names)
        yield Effect(
            physics="attached_oscillator",
            site=site,
            unknowns=(
                Unknown("m", "kg", *masses, spread(*masses, 7)),
                Unknown("k", "N/m", low_w, 2 * high_w, spread(low_w, high_w, 48)),
                Unknown("c", "N s/m", 1e-3, MOST_DAMPED, (0.05,)),
            ),
            build=build,
            parameters=values,
            aliases=tuple(("attached_oscillator", o) for o in others),
            report=_oscillating,
            jump=Jump(f"V by w at port {port}w", _hanging, ("V", "w")),
            variant=name,
            resonant=True,
        )


def _hanging(s: Complex, x: Float) -> Complex:
    """Force over motion of a mass on a spring, (m, n)."""
    m, w, zeta = (x[:, i : i + 1] for i in range(3))
    held = w**2 + 2 * zeta * w * s
    return np.asarray(m * s**2 * held / (s**2 + held))


def _oscillating(x: Float) -> Float:
    """m, k, c from mass, natural frequency and damping ratio."""
    return np.array([x[0], x[0] * x[1] ** 2, 2 * x[2] * x[0] * x[1]])
