"""What gravity does to a chain: the tension that its weight makes, and what that resists; and what
lies beyond a bend, as the bend carries it along.

The chain hangs on its base (or stands on it), so the tension at a place is the weight of all that
lies beyond, pull = g cos(pose) a kilogram; beyond a bend its angle adds to the pose. Turned by
theta, each piece of the chain is shorter along the pull by theta^2/2 of its length: the energy is
1/2 integral N theta^2 dx. So

    rigid body   M jumps by k theta, k = N_beyond L + pull m r
    beam         M' = V + N(x) theta, N' = -pull mu

With N = 0 beyond, a body on a pinned base is the physical pendulum, k = m g r. The height of a mass
is a sum of terms of one angle each, so a bend adds none that couples two.

At a bend all that lies beyond moves as one along itself, by w sin(angle): before it stands a mass
m_beyond sin^2(angle), which resists w alone.

A beam is cut into segments. In each, N(x) = N + N'(x - middle) is replaced by the constant matrix
of Magnus (the exponent, to fourth order in the length h): N in the middle, and the commutator

    theta' = M/EI - d theta,   M' = V + N theta + d M,   d = h^2 N'/(12 EI).

Blanes, Casas, Oteo, Ros, The Magnus expansion and some of its applications, Physics Reports 470
(2009), eq. 254. The segments are so many that what is left out is below `FINE`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.model.timoshenko import LENGTH, MU, SLOPE, TENSION
from samii_rig.rig.schema import Beam, TimoshenkoBeam
from samii_rig.types import Float

# h^3 N'/(12 EI), the commutator over a segment: what follows it in the exponent is its square
# and less. A hanging strip with N L^2/EI = 12 then has its frequencies to 1e-9.
FINE = 2e-3
MOST = 64  # segments between two places: a rope so slack that its EI is a trillionth of N L^2
BODY_L, BODY_R, BODY_M = 0, 1, 2  # places among a rigid body's parameters


def segments(beam: Beam | TimoshenkoBeam, pull: float, start: float, stop: float) -> list[float]:
    """Where a stretch of a beam is cut, m from its upstream end, both ends left out."""
    if pull == 0:
        return []
    slope = abs(pull) * beam.mu.value / (12 * beam.EI.value)
    n = min(MOST, math.ceil((stop - start) * (slope / FINE) ** (1 / 3)))
    return [start + (stop - start) * i / n for i in range(1, n)]


@dataclass(frozen=True, slots=True)
class Weight:
    """Which operations of a compiled chain weigh something, and what the weight loads.

    pulls : at each operation. beams : all; taut : those with tension. bodies : rigid bodies;
    moments : the operation before each of them that holds its moment, -1 for one without.
    branches : operations that are branches. bends : masses that stand before a bend, and
    sin^2 of its angle.
    """

    pulls: tuple[float, ...]
    beams: tuple[int, ...]
    taut: tuple[int, ...]
    bodies: tuple[int, ...]
    moments: tuple[int, ...]
    branches: tuple[int, ...]
    bends: tuple[tuple[int, float], ...]

    @property
    def size(self) -> int:
        """Loads: N and N' of each taut beam, then k of each body, then m of each bend."""
        return 2 * len(self.taut) + len(self.bodies) + len(self.bends)

    def slots(self, slots: list[list[int]], first: int) -> None:
        """Number the loads in the operations' slots from `first` on."""
        for i, e in enumerate(self.taut):
            slots[e][TENSION], slots[e][SLOPE] = first + 2 * i, first + 2 * i + 1
        first += 2 * len(self.taut)
        for j, e in enumerate(self.moments):
            if e >= 0:
                slots[e][0] = first + j
        for k, (e, _) in enumerate(self.bends):
            slots[e][BODY_M] = first + len(self.bodies) + k

    def masses(self, pars: Float, branches: Sequence[float]) -> Float:
        """(n_op,) kg of each operation."""
        m = np.zeros(len(pars))
        beams, bodies = list(self.beams), list(self.bodies)
        m[beams] = pars[beams, MU] * pars[beams, LENGTH]
        m[bodies] = pars[bodies, BODY_M]
        m[list(self.branches)] = branches
        return m

    def load(self, pars: Float, branches: Sequence[float]) -> None:
        """Write the loads into the parameters (n_op, WIDTH); branches : kg of each."""
        m = self.masses(pars, branches)
        beyond, pulls = np.cumsum(m[::-1])[::-1] - m, self.pulls
        for e in self.taut:
            pars[e, TENSION] = pulls[e] * (beyond[e] + m[e] / 2)
            pars[e, SLOPE] = -pulls[e] * pars[e, MU]
        for at, e in zip(self.moments, self.bodies, strict=True):
            if at >= 0:
                arm = beyond[e] * pars[e, BODY_L] + m[e] * pars[e, BODY_R]
                pars[at, 0] = pulls[e] * arm
        for e, part in self.bends:
            pars[e, BODY_M] = part * beyond[e]

    def mass_slopes(self, pars: Float, by: Float, branches: Sequence[Float]) -> Float:
        """(n_op, n_values) of `masses`; by (n_op, WIDTH, n_values) of the parameters."""
        out = np.zeros((by.shape[0], by.shape[2]))
        beams, bodies = list(self.beams), list(self.bodies)
        out[beams] = pars[beams, MU, None] * by[beams, LENGTH] + (
            pars[beams, LENGTH, None] * by[beams, MU]
        )
        out[bodies] = by[bodies, BODY_M]
        for e, slopes in zip(self.branches, branches, strict=True):
            out[e] = slopes
        return out

    def slopes(self, pars: Float, by: Float, masses: Float, dm: Float) -> Float:
        """(size, n_values) of the loads, in their order."""
        beyond = np.cumsum(masses[::-1])[::-1] - masses
        d_beyond = np.cumsum(dm[::-1], axis=0)[::-1] - dm
        out: list[Float] = []
        for e in self.taut:
            out += [self.pulls[e] * (d_beyond[e] + dm[e] / 2), -self.pulls[e] * by[e, MU]]
        for e in self.bodies:
            turned = beyond[e] * by[e, BODY_L] + d_beyond[e] * pars[e, BODY_L]
            own = masses[e] * by[e, BODY_R] + dm[e] * pars[e, BODY_R]
            out.append(self.pulls[e] * (turned + own))
        out += [part * d_beyond[e] for e, part in self.bends]
        return np.array(out).reshape(self.size, by.shape[2])
