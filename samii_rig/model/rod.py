"""A rod that is stretched along itself: its matrix in a form that keeps its digits, its gradient.

    w' = -V/G,   V' = -m w,   G = EA (1 + s tau),   m = mu s^2

Two waves exp(+-lambda x), lambda^2 = m/G, with V = -+ lambda G w. The matrix has the form of
`timoshenko.matrix`: the amplitudes P z of the growing and the decaying wave, theta and M, which
rest; behind the rod z = Q (a/E1, E1 b, theta, M) with E1 = exp(-lambda L), E2 = 1. Where the wave
is longer than the rod the two are nearly alike, and a power series of the matrix stands in Q.
"""

from __future__ import annotations

import math

import numpy as np

from samii_rig.model.timoshenko import LONG_BEAM, ROWS, SORT, TERMS
from samii_rig.types import Complex, Float

EA, MU, LENGTH, TAU = range(4)  # places among the parameters
_TURN = np.array([1.0, -1.0, 1.0, -1.0])  # theta and V of a mirrored chain


def _waves(s: Complex, p: Float) -> tuple[Complex, Complex, Complex, np.ndarray]:
    """G, m, lambda with Re lambda >= 0, and where the rod is long."""
    G = np.asarray(p[EA] * (1 + s * p[TAU]))
    m = np.asarray(p[MU] * s**2)
    lam = np.sqrt(m / np.where(G == 0, 1.0, G))
    return G, m, lam, np.asarray(np.abs(lam) * p[LENGTH] > LONG_BEAM)


def matrix(s: Complex, p: Float) -> Complex:
    """(2, ROWS, n) for the kernel, forwards and mirrored: a uniform rod is its own mirror."""
    G, m, lam, long = _waves(s, p)
    P = np.zeros((s.size, 4, 4), complex)
    Q = np.zeros_like(P)
    P[:] = SORT
    short = ~long
    U = np.zeros((int(short.sum()), 4, 4), complex)
    U[:] = np.eye(4)
    U[:, np.ix_([0, 3], [0, 3])[0], np.ix_([0, 3], [0, 3])[1]] = _short(
        p[LENGTH], G[short], m[short]
    )
    Q[short] = U @ SORT
    z = np.where(long, lam * G, 1.0)  # impedance of a wave
    P[long] = 0.0
    P[long, 0, 0] = P[long, 1, 0] = 0.5
    P[long, 0, 3], P[long, 1, 3] = -0.5 / z[long], 0.5 / z[long]
    P[long, 2, 1] = P[long, 3, 2] = 1.0
    Q[long, 0, 0] = Q[long, 0, 1] = 1.0
    Q[long, 3, 0], Q[long, 3, 1] = -z[long], z[long]
    Q[long, 1, 2] = Q[long, 2, 3] = 1.0
    out = np.zeros((ROWS, s.size), complex)
    out[:16] = P.reshape(-1, 16).T
    out[16:32] = Q.reshape(-1, 16).T
    out[32] = np.where(long, np.exp(-lam * p[LENGTH]), 1.0)
    out[33] = 1.0
    return np.stack([out, out])


def _short(L: float, G: Complex, m: Complex) -> Complex:
    """(n, 2, 2) from (w, V) to those behind the rod, by the series in q = m L^2/G."""
    q = m * L**2 / G
    c, sh = np.zeros_like(q), np.zeros_like(q)
    for k in range(TERMS // 2, -1, -1):
        c = c * q + 1 / math.factorial(2 * k)
        sh = sh * q + 1 / math.factorial(2 * k + 1)
    return np.moveaxis(np.array([[c, -L * sh / G], [-L * m * sh, c]]), 2, 0)


def scaling(s: Complex, p: Float) -> tuple[Complex, Float]:
    """1/(E1 E2) = mantissa exp(log), (n,) each at s (n,), rad/s: what the kernel's scaling took out
    of the determinant. p : the element's parameters in the schema's order."""
    _, _, lam, long = _waves(s, p)
    total = np.where(long, lam * p[LENGTH], 0.0)
    return np.exp(1j * total.imag), np.asarray(total.real)


def gradient(s: Complex, p: Float, z: Complex, zh: Complex) -> Complex:
    """(4, n, n_sensor, n_source) dy/dp at unit sources, as `timoshenko.gradient`.

    With e = m w wh - V Vh/G, the same everywhere in the rod, and [w Vh] its change along it,
    the integrals of m w wh and V Vh/G are (L e - [w Vh])/2 and (-L e - [w Vh])/2.
    """
    G, m, _, _ = (x[:, None, None] if x.ndim else x for x in _waves(s, p))
    w, V, w0 = (z[:, None, i, :] for i in (0, 3, 4))
    wh, Vh, Vh0 = (zh[:, i, :, None] for i in (0, 3, 7))
    along = w * Vh - w0 * Vh0
    energy = m * w * wh - V * Vh / G
    L = p[LENGTH]
    moved, stretched = (L * energy - along) / 2, (-L * energy - along) / 2
    by_g = stretched * p[EA] / G
    return np.stack([stretched / p[EA], moved / p[MU], energy, s[:, None, None] * by_g])
