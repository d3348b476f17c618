"""What a rig has less of than its file: a mass taken off, a spring gone, a joint worn or tightened.

Between two states what changed may have either sign. A part that is gone is a negative one of the
same physics. Every change here is one of the chain's own parameters.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from samii_rig.diagnose.effect import Effect, Jump, Key, Unknown, Values
from samii_rig.diagnose.scales import spread
from samii_rig.rig.schema import (
    LumpedMass,
    Parameter,
    Rig,
    RigidLink,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
)
from samii_rig.types import Complex, Float

SMALLEST = 1e-5  # part of what is there; the data of no bench show less
LARGEST = 0.6  # of a link's mass: what is left still is a body, whatever its tolerance says
SURELY = 2.0  # tolerances above the rig file's value, up to which all of a part may be gone
RATIO = (0.02, 50.0)  # of a joint's stiffness to what it was: from all but broken to all but rigid
RATIOS = (0.3, 0.6, 0.9, 1.1, 1.6, 3.0)  # at which a search starts
ENDS = (0.05, 0.5, 1.0)  # of a link's length, where a mass may be taken off


def effects(rig: Rig) -> Iterator[Effect]:
    """All of them on this rig."""
    for e in rig.element:
        match e:
            case RigidLink() if e.m.value > 0:
                yield _off_a_link(e)
                yield from _part_of(e.name, "added_inertia", "J", {"I": e.I})
            case LumpedMass():
                yield from _part_of(e.name, "added_mass", "m", {"m": e.m})
                yield from _part_of(e.name, "added_inertia", "J", {"I": e.I})
            case TorsionalSpring() | TranslationalSpring():
                if e.k.value > 0:
                    yield _stiffness(e)
                yield from _part_of(e.name, "viscous_damping", "c", {"c": e.c})
            case TorsionalGroundSpring() | TranslationalGroundSpring():
                if e.k.value > 0:
                    yield from _part_of(e.name, "ground_spring", "k", {"k": e.k, "c": e.c})
                else:
                    yield from _part_of(e.name, "viscous_damping", "c", {"c": e.c})
            case _:
                continue


def _part_of(
    name: str, physics: str, symbol: str, symbols: dict[str, Parameter]
) -> Iterator[Effect]:
    """Less of an element, or none of it: the first of `symbols` falls by x, the others in
    proportion."""
    first, keys = next(iter(symbols.values())), tuple((name, s) for s in symbols)
    whole = first.value
    if whole <= 0:
        return
    bounds = SMALLEST * whole, whole * (1 + SURELY * first.tolerance)

    def values(x: Float, nominal: Values) -> dict[Key, float]:
        left = max(1 - float(x[0]) / nominal[keys[0]], 0.0)
        return {key: nominal[key] * left for key in keys}

    yield Effect(
        physics=physics,
        site=name,
        unknowns=(Unknown(symbol, first.unit, *bounds, (*spread(*bounds, 6), 0.99 * whole)),),
        parameters=values,
        touches=keys,
        report=lambda x: -x,
        variant="less",
    )


def _off_a_link(link: RigidLink) -> Effect:
    """A mass taken off a link, at a place along it."""
    keys = tuple((link.name, s) for s in ("m", "r", "I"))
    L, whole = link.L.value, link.m.value
    bounds = SMALLEST * whole, LARGEST * whole

    def values(x: Float, nominal: Values) -> dict[Key, float]:
        m, r, inertia = (nominal[k] for k in keys)
        gone, at = float(x[0]), float(x[1]) * L
        rest = m - gone
        centre = (m * r - gone * at) / rest
        own = inertia + m * (r - centre) ** 2 - gone * (at - centre) ** 2
        return dict(zip(keys, (rest, centre, own), strict=True))

    starts = spread(*bounds, 8)
    return Effect(
        physics="added_mass",
        site=link.name,
        unknowns=(
            Unknown("m", link.m.unit, *bounds, starts),
            Unknown("position", "L", 1e-3, 1.0, ENDS if L > 0 else (1.0,)),
        ),
        parameters=values,
        touches=keys,
        jump=Jump(f"off {link.name}", lambda s, x: np.asarray(-(s**2) * x[:, :1]), fixed=1),
        report=lambda x: np.array([-x[0], x[1]]),
        variant="less",
    )


def _stiffness(spring: TorsionalSpring | TranslationalSpring) -> Effect:
    """A joint softer or stiffer than it was."""
    key, whole = (spring.name, "k"), spring.k.value

    def values(x: Float, nominal: Values) -> dict[Key, float]:
        return {key: nominal[key] * float(x[0])}

    def x_of(s: Complex, x: Float) -> Complex:
        return np.asarray(whole * (x[:, :1] - 1) + 0 * s)

    return Effect(
        physics="joint_stiffness",
        site=spring.name,
        unknowns=(Unknown("k ratio", "1", *RATIO, RATIOS),),
        parameters=values,
        touches=(key,),
        jump=Jump(f"beside {spring.name}", x_of),
        variant="of the rig file",
    )
