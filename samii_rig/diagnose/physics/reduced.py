"""What a rig has less of than its file: a mass taken off, a spring gone, a lag that is not there.

A part that is gone is a negative one of the same physics, at most as large as the file has it.
Every change here is one of the chain's own parameters. In one state the refit moves those that
have a tolerance: of these, only what is farther than it goes is offered. Between two states
nominal parameters are the same in both, and any part of them may be gone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from samii_rig.diagnose.physics.along import Along, stretches
from samii_rig.diagnose.physics.effect import Effect, Jump, Key, Unknown, Values
from samii_rig.diagnose.physics.model import FARTHEST
from samii_rig.diagnose.physics.points import ON_LINK
from samii_rig.diagnose.physics.scales import SMALLEST, spread
from samii_rig.rig.schema import (
    SOURCES,
    LumpedMass,
    Parameter,
    Rig,
    RigidLink,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
    parameters,
)
from samii_rig.types import Complex, Float

LARGEST_PART = 0.6  # of a link's mass: what is left still is a body, whatever its tolerance says
ALL = 1 - 1e-12  # of a part, that the rounding of its logarithm makes no more than it
ALMOST = 0.99  # of a part, a start of a search: the refit goes on to all of it
# Of a joint's stiffness to what it was: from all but broken to all but rigid.
JOINT_RATIO = (0.02, 50.0)
JOINT_RATIOS = (0.3, 0.6, 0.9, 1.1, 1.6, 3.0)  # at which a search starts
FASTER = 1e4  # times, of a corner: from there on a lag is none in any band
# What a source's own parameter is a lag or a delay by.
CORNERS = {"p": "actuator_lag", "omega": "valve_dynamics"}


def effects(rig: Rig, *, between: bool) -> Iterator[Effect]:
    """All of them on this rig, between two states or in one."""
    for e in rig.element:
        match e:
            case RigidLink() if e.m.value > 0:
                if e.L.value > 0:
                    yield from _off_a_link(rig, e, between=between)
                yield from _part_of(e.name, "added_inertia", "J", {"I": e.I}, between=between)
            case LumpedMass():
                yield from _part_of(e.name, "added_mass", "m", {"m": e.m}, between=between)
                yield from _part_of(e.name, "added_inertia", "J", {"I": e.I}, between=between)
            case TorsionalSpring() | TranslationalSpring():
                if e.k.value > 0 and (between or e.k.tolerance == 0):
                    yield _stiffness(e)
                yield from _part_of(e.name, "viscous_damping", "c", {"c": e.c}, between=between)
            case TorsionalGroundSpring() | TranslationalGroundSpring():
                held = {"k": e.k, "c": e.c} if e.k.value > 0 else {"c": e.c}
                physics = "ground_spring" if e.k.value > 0 else "viscous_damping"
                yield from _part_of(e.name, physics, next(iter(held)), held, between=between)
            case _ if isinstance(e, SOURCES):
                own = parameters(e)
                for symbol in CORNERS.keys() & own.keys():
                    yield from _corner(e.name, symbol, own[symbol], between=between)
                tau = {"tau": own["tau"]}
                yield from _part_of(e.name, "transport_delay", "tau", tau, between=between)
            case _:
                continue


def _least(p: Parameter, *, between: bool) -> float:
    """Part of a parameter from which it is an effect that some of it is gone."""
    return SMALLEST if between else max(SMALLEST, FARTHEST * p.tolerance)


def _part_of(
    name: str, physics: str, symbol: str, symbols: dict[str, Parameter], *, between: bool
) -> Iterator[Effect]:
    """Less of an element, or none of it: the first of `symbols` falls by x, the others in
    proportion."""
    first, keys = next(iter(symbols.values())), tuple((name, s) for s in symbols)
    whole, least = first.value, _least(first, between=between)
    if whole <= 0 or least >= ALMOST:
        return
    bounds = least * whole, ALL * whole

    def values(x: Float, nominal: Values) -> dict[Key, float]:
        # A part of what there is, not an amount: where all is gone it still has a slope.
        left = 1 - float(x[0]) / whole
        return {key: nominal[key] * left for key in keys}

    yield Effect(
        physics=physics,
        site=name,
        unknowns=(
            Unknown(symbol, first.unit, *bounds, (*spread(*bounds, 6), ALMOST * whole), ends=True),
        ),
        parameters=values,
        touches=keys,
        report=lambda x: -x,
        variant="less",
    )


def _off_a_link(rig: Rig, link: RigidLink, *, between: bool) -> Iterator[Effect]:
    """A mass taken off a link, at a place along it."""
    keys = tuple((link.name, s) for s in ("m", "r", "I"))
    whole, least = link.m.value, _least(link.m, between=between)
    if least >= LARGEST_PART:
        return
    (along,) = stretches(rig, link)
    bounds = least * whole, LARGEST_PART * whole

    def values(x: Float, nominal: Values, along: Along = along) -> dict[Key, float]:
        m, r, inertia = (nominal[k] for k in keys)
        gone, at = float(x[0]), along.position(float(x[1]))
        rest = m - gone
        centre = (m * r - gone * at) / rest
        own = inertia + m * (r - centre) ** 2 - gone * (at - centre) ** 2
        return dict(zip(keys, (rest, centre, own), strict=True))

    yield Effect(
        physics="added_mass",
        site=link.name,
        unknowns=(
            Unknown("m", link.m.unit, *bounds, spread(*bounds, 8)),
            along.unknown(ON_LINK),
        ),
        parameters=values,
        touches=keys,
        jump=Jump(
            f"V by w {along.place()}",
            lambda s, x: np.asarray(-(s**2) * x[:, :1]),
            ("V", "w"),
            fixed=1,
        ),
        report=lambda x: np.array([-x[0], along.position(float(x[1]))]),
        variant="less",
    )


def _stiffness(spring: TorsionalSpring | TranslationalSpring) -> Effect:
    """A joint softer or stiffer than it was."""
    key, whole = (spring.name, "k"), spring.k.value

    def x_of(s: Complex, x: Float) -> Complex:
        return np.asarray(whole * (x[:, :1] - 1) + 0 * s)

    return Effect(
        physics="joint_stiffness",
        site=spring.name,
        unknowns=(Unknown("k ratio", "1", *JOINT_RATIO, JOINT_RATIOS, ratio=True),),
        parameters=_times(key),
        touches=(key,),
        jump=Jump(f"beside {spring.name}", x_of),
        variant="of the rig file",
    )


def _corner(name: str, symbol: str, corner: Parameter, *, between: bool) -> Iterator[Effect]:
    """A lag of a source that is another than in the file: shorter, or none, and longer."""
    least = _least(corner, between=between)
    faster, slower = faster_than(1 + least), slower_than(1 / (1 + least))
    for unknown, variant in ((faster, "less"), (slower, "more")):
        yield Effect(
            physics=CORNERS[symbol],
            site=name,
            unknowns=(replace(unknown, symbol=f"{symbol} ratio"),),
            parameters=_times((name, symbol)),
            touches=((name, symbol),),
            variant=variant,
        )


def faster_than(low: float) -> Unknown:
    """Ratio of a corner to the file's, from `low` on to where a lag is none."""
    return Unknown("p ratio", "1", low, FASTER, spread(low, math.sqrt(FASTER), len(JOINT_RATIOS)))


def slower_than(high: float) -> Unknown:
    """Ratio of a corner to the file's, up to `high`."""
    low, first = 1 / FASTER, 1 / math.sqrt(FASTER)
    return Unknown("p ratio", "1", low, high, spread(first, high, len(JOINT_RATIOS)))


def _times(key: Key) -> Callable[[Float, Values], dict[Key, float]]:
    """One parameter times the one unknown."""
    return lambda x, nominal: {key: nominal[key] * float(x[0])}
