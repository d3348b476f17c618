"""How large a part at a place must be to matter: the rig's own impedances.

A jump of state j at a port, driven by the conjugate state i, z+ = z- + e_j x (e_i' z-), is
strong where x times the Green's function of i there is about one. Ranges of unknowns are
derived from it, so the table of physics needs no number of any rig.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from samii_rig.model.tmm import Chain, State
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

PAIRS: tuple[tuple[State, State], ...] = (("theta", "M"), ("w", "V"), ("V", "w"), ("M", "theta"))
STATES: tuple[State, ...] = ("w", "theta", "M", "V")
BAND_POINTS = 60  # of the band, at which the chain's own stiffness and mass are taken
# Of a stiffness or damping over the chain's own, from gross to invisible: a force sensor in line
# with a cylinder shows a spring to ground of 6e-6 of the cylinder's stiffness. And where on that a
# search begins: 0.6 decades apart the next start is near enough for a refit. An odd number has the
# same one in the middle if the range is turned round, as that of oil is beside a spring's.
RANGE, STARTS = (1e-3, 1e7), 15
SMALLEST = 1e-5  # part of what is there; the data of no bench show less


@dataclass(frozen=True, slots=True)
class Places:
    """Where elements may be inserted, and what a jump does there.

    names : for each port the elements before and behind it.
    own : (pair, port, n) response of the conjugate state to a unit jump, at `frequency`.
    moved : (pair, port, n) the conjugate state itself under a unit input.
    """

    frequency: Float
    names: tuple[tuple[str, ...], ...]
    own: Complex
    moved: Complex

    def strength(self, pair: int, port: int) -> float:
        """x at which the jump begins to matter, over the band in the geometric mean; inf if
        nothing drives it there."""
        own = np.abs(self.own[pair, port])
        moved = np.abs(self.moved[pair, port])
        if not np.all(own > 0) or np.median(moved) == 0:
            return float("inf")
        return float(1 / np.exp(np.mean(np.log(own))))


def places(rig: Rig, low_hz: float, high_hz: float) -> Places:
    """All ports of the rig in a band."""
    chain = Chain(rig)
    f = np.geomspace(low_hz, high_hz, BAND_POINTS)
    at = chain.places()
    elements = [e.name for e in rig.element]
    last = {name: max(i for i, (n, _) in enumerate(at) if n == name and i > 0) for name in elements}
    index = [0, *(last[name] for name in elements)]
    driven = chain.field(f)[:, 0]
    own = np.zeros((len(PAIRS), len(index), f.size), complex)
    moved = np.zeros_like(own)
    for j, (jump, conjugate) in enumerate(PAIRS):
        i = STATES.index(conjugate)
        G = chain.field(f, [(port, jump) for port in index])
        for q, port in enumerate(index):
            own[j, q] = G[:, q, port, i]
            moved[j, q] = driven[:, port, i]
    names = tuple(
        tuple(elements[k] for k in (q - 1, q) if 0 <= k < len(elements)) for q in range(len(index))
    )
    return Places(f, names, own, moved)


def spread(low: float, high: float, n: int) -> tuple[float, ...]:
    """n starts, evenly in the logarithm inside the bounds."""
    edges = np.geomspace(low, high, n + 2)[1:-1]
    return tuple(float(x) for x in edges)


def middle(where: Places) -> float:
    """Angular frequency in the middle of the band, rad/s."""
    return 2 * math.pi * float(np.exp(np.mean(np.log(where.frequency))))
