"""Poly-reference least squares complex frequency domain: poles for every model order, fast.

H(z) = B(z) A(z)^-1 with matrix polynomials in z = exp(j (omega - omega_0) Dt), one row of B an
output, linearised to B_o(z) - H_o(z) A(z) = 0 and weighted by the noise of each entry
(Guillaume, Verboven, Vanlanduyt, Van der Auweraer and Peeters, IMAC 21, 2003). B is eliminated
output by output; the normal equations are Toeplitz, so all orders share one pass over the data.
A's constant term is the identity: the poles that stand for noise then come out unstable and are
dropped (Cauberghe et al., Mechanical Systems and Signal Processing 19, 2005).

Linearised, it is a start, not an estimate: noise biases it. `rational.refine` follows.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.linalg import toeplitz

from samii_rig.types import Complex, Float

Coefficients = Literal["real", "complex"]

ROOM = 1.05  # the polynomials' own band over the data's: its two ends are one point
NEAR_REAL = 0.05  # Im/|s| below which a pole is a real one, which no resonance curve shows
# Relative, of the numerators' normal equations: powers beyond what a band determines.
NUMERATOR_RIDGE = 1e-12


def poles_by_order(
    frequency: Float,
    H: Complex,
    sd: Float,
    orders: range,
    coefficients: Coefficients = "real",
) -> tuple[Complex, ...]:
    """The stable poles of each order, rad/s with Im > 0 in the band, by frequency.

    frequency : (n,) Hz. H : (n, n_out, n_in). sd : (n, n_out) of the noise.
    orders : of the polynomials; an order has order n_in roots, with real coefficients in pairs.
    """
    omega = 2 * np.pi * frequency
    if coefficients == "real":
        middle, step = 0.0, np.pi / (ROOM * omega[-1])
    else:
        middle = (omega[0] + omega[-1]) / 2
        step = 2 * np.pi / (ROOM * (omega[-1] - omega[0]))
    z = np.exp(1j * (omega - middle) * step)
    sums = _sums(z, H, sd, orders[-1], coefficients)
    out = []
    for order in orders:
        roots = _roots(_denominator(sums, order))
        with np.errstate(divide="ignore", invalid="ignore"):
            s = -np.log(roots) / step + 1j * middle
        keep = np.isfinite(s) & (s.real < 0) & (np.abs(s) <= omega[-1]) & (np.abs(s) >= omega[0])
        keep &= s.imag > NEAR_REAL * np.abs(s)
        out.append(s[keep][np.argsort(np.abs(s[keep]))])
    return tuple(out)


def _sums(
    z: Complex, H: Complex, sd: Float, order: int, coefficients: Coefficients
) -> tuple[Complex, Complex, Complex]:
    """Sums over the lines of w z^l, w z^l H_o and w z^l H_o^H H_o for l = -order..order.

    (n_out, 2 order + 1), (n_out, 2 order + 1, n_in), (n_out, 2 order + 1, n_in, n_in).
    """
    n, n_out, n_in = H.shape
    w = 1 / sd[:, :, None] ** 2
    w = w / w.mean()
    powers = z[:, None] ** np.arange(-order, order + 1)
    HH = H.conj()[:, :, :, None] * H[:, :, None, :]
    data = np.concatenate([w, w * H, w * HH.reshape(n, n_out, -1)], axis=2)
    total = (powers.T @ data.reshape(n, -1)).reshape(2 * order + 1, n_out, -1).transpose(1, 0, 2)
    if coefficients == "real":
        total = total.real + 0j
    return (
        total[:, :, 0],
        total[:, :, 1 : 1 + n_in],
        total[:, :, 1 + n_in :].reshape(n_out, -1, n_in, n_in),
    )


def _denominator(sums: tuple[Complex, Complex, Complex], order: int) -> Complex:
    """(order, n_in, n_in) alpha_1 ... of A = I + sum alpha_r z^r."""
    w, wh, whh = sums
    n_in, zero = wh.shape[2], w.shape[1] // 2
    size = order + 1
    lag = zero + np.arange(size)[None, :] - np.arange(size)[:, None]
    M = np.zeros((size * n_in, size * n_in), dtype=np.complex128)
    for o in range(w.shape[0]):
        R = toeplitz(w[o, zero - np.arange(size)], w[o, zero : zero + size])
        R = R + NUMERATOR_RIDGE * size * np.eye(size) * w[o, zero]
        S = wh[o, lag].reshape(size, size * n_in)
        T = whh[o, lag].transpose(0, 2, 1, 3).reshape(size * n_in, size * n_in)
        M += T - S.conj().T @ np.linalg.solve(R, S)
    inner = M[n_in:, n_in:]
    ridge = NUMERATOR_RIDGE * np.trace(inner).real / max(order * n_in, 1) * np.eye(order * n_in)
    alpha = np.linalg.solve(inner + ridge, -M[n_in:, :n_in])
    return np.asarray(alpha.reshape(order, n_in, n_in))


def _roots(alpha: Complex) -> Complex:
    """1/z of all roots of det A(z): eigenvalues of the block companion matrix."""
    order, n_in, _ = alpha.shape
    C = np.zeros((order * n_in, order * n_in), dtype=np.complex128)
    C[:n_in] = -alpha.transpose(1, 0, 2).reshape(n_in, order * n_in)
    C[n_in:, :-n_in] = np.eye((order - 1) * n_in)
    return np.asarray(np.linalg.eigvals(C))
