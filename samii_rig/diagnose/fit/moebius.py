"""What a part at a place does to every output, as a function of its one complex number x.

    y_k = a_k + b_k phi,    phi = x/(1 - c x),

with b (n, q) and c (n,) of the place, whatever the part there: two evaluations of the chain
stand for every law and every strength. A factor F on a channel is the same with c = 0 and
x = F - 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import Grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.types import Complex, Float

STRENGTH_RATIO = 10.0  # between the two strengths at which the chain is evaluated


@dataclass(frozen=True, slots=True)
class Place:
    """b : (n, q). c : (n,)."""

    b: Complex
    c: Complex

    def phi(self, x: Complex) -> Complex:
        """x/(1 - c x) of (m, n)."""
        return np.asarray(x / (1 - self.c * x))


def place_of(
    model: Model,
    known: Float,
    effect: Effect,
    at: Grid,
    a: Complex,
    fixed: tuple[float, ...] = (),
) -> Place:
    """The place of a part.

    model : with `effect`, which has a `jump`, as its last. known : its vector but for that
    effect's unknowns. a : (n, q) response without it. fixed : values of the unknowns that
    belong to the place.
    """
    assert effect.jump is not None
    first = effect.unknowns[0]
    between = effect.unknowns[1 : len(effect.unknowns) - len(fixed)]
    s = at.s
    middle = np.sqrt(first.low * first.high)
    xs, g = [], []
    for strength in (middle / np.sqrt(STRENGTH_RATIO), middle * np.sqrt(STRENGTH_RATIO)):
        values = np.array([strength, *(u.starts[0] for u in between), *fixed])
        x = effect.jump.x(s, values[None])[0]
        xs.append(x)
        g.append((model.response(np.append(known, np.log(values)), at) - a) / x[:, None])
    # g = b/(1 - c x): the ratio of two gives c, from the entry that moves most.
    k = np.argmax(np.abs(g[0]), axis=1)[:, None]
    g0, g1 = (np.take_along_axis(one, k, 1)[:, 0] for one in g)
    R = np.divide(g0, g1, out=np.ones_like(g0), where=g1 != 0)
    # Where nothing moves both are rounding, and c is none.
    below = R * xs[0] - xs[1]
    c = np.divide(R - 1, below, out=np.zeros_like(R), where=below != 0)
    return Place(g[0] * (1 - c * xs[0])[:, None], np.asarray(c))
