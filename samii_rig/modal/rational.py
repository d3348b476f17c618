"""Rational models with common poles.

    G_k(s) = sum_m r_km/(s - a_m) + conjugates + e_k/s + d_k + h_k s

for each entry k of the response, poles common to all. The last three stand for an
integrating actuator and for what lies beyond the band. Residues enter in real numbers: a pair
of poles has the two functions 1/(s - a) + 1/(s - a*) and j/(s - a) - j/(s - a*).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.types import Complex, Float

EXTRAS = 3  # functions 1/s, 1, s


@dataclass(frozen=True, slots=True)
class Rational:
    """A fitted model; s is in units of `scale` rad/s within.

    pairs : (n_pair,) poles with Im > 0, each for its conjugate as well. real : (n_real,).
    coefficients : (p, 2 n_pair + n_real + EXTRAS) real, in the order of the functions.
    covariance : of all parameters: pairs (Re, Im by turns), real poles, then coefficients
        entry by entry.
    chi2 : sum of squares of the residuals in noise units.
    """

    scale: float
    pairs: Complex
    real: Float
    coefficients: Float
    covariance: Float
    chi2: float

    @property
    def n_poles(self) -> int:
        """Real parameters of the poles, which is their number."""
        return 2 * self.pairs.size + self.real.size

    def residues(self) -> Complex:
        """(p, n_pair) complex residues at `pairs`, in units of scale."""
        c = self.coefficients[:, : 2 * self.pairs.size]
        return np.asarray(c[:, 0::2] + 1j * c[:, 1::2])

    def evaluate(self, s: Complex) -> Complex:
        """(n, p) at s in units of scale."""
        return np.asarray(functions(s, self.pairs, self.real) @ self.coefficients.T)

    def slopes(self, s: Complex) -> Complex:
        """(n, p, n_poles) derivatives by the parameters of the poles."""
        n = self.coefficients.shape[0]
        out = np.zeros((s.size, n, self.n_poles), complex)
        R = self.residues()
        for m, a in enumerate(self.pairs):
            up = R[None, :, m] / (s[:, None] - a) ** 2
            down = R[None, :, m].conj() / (s[:, None] - a.conjugate()) ** 2
            out[:, :, 2 * m] = up + down
            out[:, :, 2 * m + 1] = 1j * (up - down)
        first = 2 * self.pairs.size
        for m, b in enumerate(self.real):
            out[:, :, first + m] = self.coefficients[None, :, first + m] / (s[:, None] - b) ** 2
        return out


def functions(s: Complex, pairs: Complex, real: Float, extras: bool = True) -> Complex:
    """(n, n_function) the partial fractions at s, and 1/s, 1, s."""
    columns = []
    for a in pairs:
        up, down = 1 / (s - a), 1 / (s - a.conjugate())
        columns += [up + down, 1j * (up - down)]
    columns += [1 / (s - b) for b in real]
    if extras:
        columns += [1 / s, np.ones_like(s), s]
    return np.stack(columns, axis=1)
