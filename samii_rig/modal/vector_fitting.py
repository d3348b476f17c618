"""Rational models of a given order from nothing: vector fitting for a start, then least squares.

Start: vector fitting (Gustavsen and Semlyen, IEEE Trans. Power Delivery 14, 1999), one QR an
entry (Deschrijver et al., IEEE Microwave Wireless Components Letters 18, 2008). It weighs
entries by themselves and is not a least squares estimate, so `refine` follows.
"""

from __future__ import annotations

import numpy as np

from samii_rig.modal.rational import EXTRAS, Rational, functions
from samii_rig.modal.refine import refine, weights
from samii_rig.types import Complex, Float

RELOCATIONS = 12  # of the poles by vector fitting; a few are usual
DAMPING = 0.01  # of the poles to begin with
NEW_DAMPING = 0.3  # of a pair put to the poles of a smaller fit
BEYOND = 1.5  # where it is put, over the highest frequency
SMOOTH = 15  # lines over which what is left is summed to find where most of it is


def fit_rational(
    s: Complex,
    G: Complex,
    weight: Complex,
    scale: float,
    n_pairs: int,
    smaller: Rational | None = None,
) -> Rational:
    """Fit by `n_pairs` pairs of poles (vector fitting may turn pairs into real poles).

    s : (n,) rad/s over scale, on the imaginary axis. G : (n, p). weight : (n, p, p) that turns
    errors into uncorrelated ones of E|e|^2 = 2.
    smaller : a fit by one pair less. Noise leads vector fitting astray where poles are weak,
        so its poles and a new pair, beyond the band or where most is left, are tried too.
    """
    spread = np.geomspace(abs(s[0]), abs(s[-1]), n_pairs + 2)[1:-1]
    pairs, real = spread * (-DAMPING + 1j), np.zeros(0)
    own = 1 / np.sqrt(np.sum(np.abs(np.linalg.inv(weight)) ** 2, axis=2))
    for _ in range(RELOCATIONS):
        pairs, real = _relocated(s, G, own, pairs, real)
    starts = [(pairs, real)]
    if smaller is not None:
        left = (weight @ (G - smaller.evaluate(s))[:, :, None])[:, :, 0]
        power = np.convolve(np.sum(np.abs(left) ** 2, axis=1), np.ones(SMOOTH), mode="same")
        for size in (abs(s[int(np.argmax(power))]), BEYOND * abs(s[-1])):
            pair = size * (-NEW_DAMPING + 1j * np.sqrt(1 - NEW_DAMPING**2))
            starts.append((np.append(smaller.pairs, pair), smaller.real))
    W = weights(weight)
    return min((refine(s, G, W, scale, *start) for start in starts), key=lambda fit: fit.chi2)


def _relocated(
    s: Complex, G: Complex, weight: Float, pairs: Complex, real: Float
) -> tuple[Complex, Float]:
    """Zeros of sigma(s) = 1 + sum c_m f_m(s), with sigma G fitted by the same poles."""
    whole = functions(s, pairs, real)
    poles = whole[:, :-EXTRAS]
    n, left = poles.shape[1], whole.shape[1]
    rows, rhs = [], []
    for k in range(G.shape[1]):
        w = weight[:, k : k + 1]
        A = np.hstack([w * whole, -w * G[:, k : k + 1] * poles])
        b = (w * G[:, k : k + 1])[:, 0]
        stacked = np.vstack([A.real, A.imag])
        size = np.linalg.norm(stacked, axis=0)
        Q, R = np.linalg.qr(stacked / size)
        rows.append(R[left:, left:] * size[left:])
        rhs.append(Q[:, left:].T @ np.concatenate([b.real, b.imag]))
    A = np.vstack(rows)
    size = np.linalg.norm(A, axis=0)
    c = np.linalg.lstsq(A / size, np.concatenate(rhs), rcond=None)[0] / size
    M, column = np.zeros((n, n)), np.zeros(n)
    for m, a in enumerate(pairs):
        M[2 * m : 2 * m + 2, 2 * m : 2 * m + 2] = [[a.real, a.imag], [-a.imag, a.real]]
        column[2 * m] = 2.0
    first = 2 * pairs.size
    M[range(first, n), range(first, n)] = real
    column[first:] = 1.0
    zeros = np.linalg.eigvals(M - np.outer(column, c))
    zeros = -np.abs(zeros.real) + 1j * zeros.imag
    return zeros[zeros.imag > 0], zeros[zeros.imag == 0].real
