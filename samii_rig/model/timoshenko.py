"""A beam with shear and rotary inertia: its matrix in a form that keeps its digits, its gradient.

    w' = theta - V/GA,   theta' = M/EI,   M' = V + J s^2 theta,   V' = -mu s^2 w

z' = A z has four waves exp(+-lambda x), lambda^2 from

    lambda^4 - lambda^2 (mu s^2/GA + J s^2/EI) + mu s^2 (1 + J s^2/GA)/EI = 0.

U is kept as P, two decays and Q: with the amplitudes (a, b, m, n) = P z of the waves
(+lambda_1, -lambda_1, +lambda_2, -lambda_2), Re lambda_1 >= Re lambda_2 >= 0, behind the beam
z = Q (a/E1, E1 b, m/E2, E2 n), E = exp(-lambda L). The kernel scales as it needs, so that
only decaying factors are left (`sweep.waves`). Where the waves are longer than the beam they
are nearly alike and P loses digits; there a power series of U stands in Q, its P only sorts
the states, and E1 = E2 = 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from samii_rig.types import Complex, Float

LONG = 1.5  # |lambda_1| L from which the waves are used: they lose (lambda L)^-3 at most
TERMS = 26  # of the power series: 1.5^26/26! < 1e-22
EI, MU, LENGTH, ETA, TAU, GA, J = range(7)  # places among the parameters
ROWS = 34  # P (16), Q (16), E1, E2
SORT = np.zeros((4, 4))  # (w, theta, M, V) to (theta, w, M, V): theta leads, as in the sweep
SORT[0, 1] = SORT[1, 0] = SORT[2, 2] = SORT[3, 3] = 1.0


class Waves(NamedTuple):
    """(n,) each, but vectors (n, 4 waves, 4 states), dual (n, 4 waves, 4): rows of P.

    long : where the waves are used. g : 1 + j eta + s tau.
    """

    g: Complex
    one: Complex
    two: Complex
    long: np.ndarray
    vectors: Complex
    dual: Complex


def _g(s: Complex, p: Float) -> Complex:
    return np.asarray(1 + 1j * p[ETA] * np.where(s.imag < 0, -1.0, 1.0) + s * p[TAU])


def waves(s: Complex, p: Float) -> Waves:
    """Wave numbers and states of the four waves."""
    g = _g(s, p)
    B, G = p[EI] * g, p[GA] * g
    m, j = p[MU] * s**2, p[J] * s**2
    b, c = m / G + j / B, m * (1 + j / G) / B
    root = np.sqrt((m / G - j / B) ** 2 - 4 * m / B)
    root = np.where((root.conj() * b).real < 0, -root, root)
    big = (b + root) / 2
    other = c / np.where(big == 0, 1.0, big)
    other = np.where(np.abs(other) < 1e-14 * np.abs(big), 1e-14 * big, other)
    one, two = np.sqrt(big), np.sqrt(other)
    swap = two.real > one.real
    one, two = np.where(swap, two, one), np.where(swap, one, two)
    long = np.maximum(np.abs(one), np.abs(two)) * p[LENGTH] > LONG
    vectors = np.zeros((s.size, 4, 4), complex)
    for k, x in ((0, one), (2, two)):
        x = np.where(x == 0, 1.0, x)
        # shear = lambda^2 - m/GA and rotary = EI lambda^2 - j multiply to -m; the one that
        # cancels is taken from the other.
        shear, rotary = x**2 - m / G, B * x**2 - j
        bad = np.abs(shear) * np.abs(B * x**2) < np.abs(rotary) * np.abs(x**2)
        safe = np.where(rotary == 0, 1.0, rotary)
        shear = np.where(bad, -m / safe, shear)
        for i, sign in ((k, 1.0), (k + 1, -1.0)):
            vectors[:, i, 0] = 1.0
            vectors[:, i, 1] = sign * shear / x
            vectors[:, i, 2] = B * shear
            vectors[:, i, 3] = -sign * m / x
    dual = np.zeros_like(vectors)
    for i, mirrored in ((0, 1), (1, 0), (2, 3), (3, 2)):
        v, u = vectors[:, i], vectors[:, mirrored]
        row = np.stack([-u[:, 3], u[:, 2], -u[:, 1], u[:, 0]], axis=1)  # u^T J
        scale = np.sum(row * v, axis=1)
        dual[:, i] = row / np.where(scale == 0, 1.0, scale)[:, None]
    return Waves(g, one, two, np.asarray(long), vectors, dual)


def _series(s: Complex, p: Float, z: Complex) -> Complex:
    """c_k (TERMS, n, 4, m) with z(x) = sum_k (x/L)^k c_k for the states z (n, 4, m) at x = 0."""
    g = _g(s, p)
    L, B, G = p[LENGTH], p[EI] * g, p[GA] * g
    m, j = p[MU] * s**2, p[J] * s**2
    out = np.zeros((TERMS, *z.shape), complex)
    out[0] = z
    for k in range(1, TERMS):
        w, t, M, V = (out[k - 1, :, i] * (L / k) for i in range(4))
        out[k, :, 0] = t - V / G[:, None]
        out[k, :, 1] = M / B[:, None]
        out[k, :, 2] = V + j[:, None] * t
        out[k, :, 3] = -m[:, None] * w
    return out


def matrix(s: Complex, p: Float) -> Complex:
    """(2, ROWS, n) for the kernel, forwards and mirrored: a uniform beam is its own mirror."""
    w = waves(s, p)
    out = np.zeros((ROWS, s.size), complex)
    P = np.where(w.long[:, None, None], w.dual, SORT)
    Q = np.swapaxes(w.vectors, 1, 2).copy()
    short = ~w.long
    if short.any():
        eye = np.broadcast_to(np.eye(4, dtype=complex), (int(short.sum()), 4, 4))
        U = _series(s[short], p, eye).sum(axis=0)
        Q[short] = U @ SORT
    out[:16] = P.reshape(-1, 16).T
    out[16:32] = Q.reshape(-1, 16).T
    out[32] = np.where(short, 1.0, np.exp(-w.one * p[LENGTH]))
    out[33] = np.where(short, 1.0, np.exp(-w.two * p[LENGTH]))
    return np.stack([out, out])


def scaling(s: Complex, p: Float) -> tuple[Complex, Float]:
    """1/(E1 E2) as mantissa exp(log): what the kernel's scaling took out of the determinant."""
    w = waves(s, p)
    total = np.where(w.long, (w.one + w.two) * p[LENGTH], 0.0)
    return np.exp(1j * total.imag), np.asarray(total.real)


def gradient(s: Complex, p: Float, z: Complex, zh: Complex) -> Complex:
    """(7, n, n_sensor, n_source) dy/dp at unit sources.

    z (n, 8, n_source), zh (n, 8, n_sensor) : states behind (4) and before the beam (4) and
    the sensors' duals. dy/dx_ij = -zh^T J e_i z_j summed over the beam for each entry of A
    (`gradient`), so all follow from the integrals of w wh, theta thetah, M Mh, V Vh.
    """
    full = waves(s, p)
    integral = np.zeros((4, s.size, zh.shape[2], z.shape[2]), complex)
    for chosen, take in ((full.long, _long_integrals), (~full.long, _short_integrals)):
        if chosen.any():
            part = Waves(*(x[chosen] for x in full))
            integral[:, chosen] = take(s[chosen], p, part, z[chosen], zh[chosen])
    w, t, M, V = (z[:, None, i, :] for i in range(4))
    wh, th, Mh, Vh = (zh[:, i, :, None] for i in range(4))
    ww, tt, MM, VV = integral
    g = full.g[:, None, None]
    s2 = (s**2)[:, None, None]
    B, G = p[EI] * g, p[GA] * g
    by_g = MM / (B * g) + VV / (G * g)
    by_L = p[MU] * s2 * w * wh + t * Vh + th * V - M * Mh / B - V * Vh / G + p[J] * s2 * t * th
    sign = np.where(s.imag < 0, -1.0, 1.0)[:, None, None]
    return np.stack(
        [
            MM / (B * p[EI]),
            s2 * ww,
            by_L,
            1j * sign * by_g,
            s[:, None, None] * by_g,
            VV / (G * p[GA]),
            s2 * tt,
        ]
    )


def _long_integrals(s: Complex, p: Float, w: Waves, z: Complex, zh: Complex) -> Complex:
    """(4, n, n_sensor, n_source): growing waves by their amplitudes behind the beam, decaying
    ones by those before it."""
    L = p[LENGTH]
    a = np.zeros((s.size, 4, z.shape[2]), complex)
    ah = np.zeros((s.size, 4, zh.shape[2]), complex)
    for k in range(4):
        at = slice(0, 4) if k % 2 == 0 else slice(4, 8)
        a[:, k] = np.einsum("ni,nim->nm", w.dual[:, k], z[:, at])
        ah[:, k] = np.einsum("ni,nim->nm", w.dual[:, k], zh[:, at])
    numbers = np.stack([w.one, w.one, w.two, w.two])
    Phi = np.zeros((s.size, 4, 4), complex)
    for k in range(4):
        for m in range(4):
            x, y = numbers[k], numbers[m]
            if k % 2 == m % 2:
                Phi[:, k, m] = -np.expm1(-(x + y) * L) / (x + y)
            elif k // 2 == m // 2:
                Phi[:, k, m] = L * np.exp(-x * L)
            else:
                Phi[:, k, m] = (np.exp(-y * L) - np.exp(-x * L)) / (x - y)
    v = w.vectors
    return np.stack(
        [np.einsum("nk,nm,nkm,nka,nmb->nba", v[..., i], v[..., i], Phi, a, ah, optimize=True)
         for i in range(4)]
    )  # fmt: skip


def _short_integrals(s: Complex, p: Float, w: Waves, z: Complex, zh: Complex) -> Complex:
    c, ch = _series(s, p, z[:, 4:]), _series(s, p, zh[:, 4:])
    k = np.arange(TERMS)
    weight = p[LENGTH] / (k[:, None] + k + 1)
    return np.asarray(np.einsum("knia,kl,lnib->inba", c, weight, ch, optimize=True))


def end_slopes(s: Complex, p: Float, z: Complex) -> tuple[Complex, Complex]:
    """w' and theta' where the state is z (n, ..., 4); p of a Timoshenko beam,
    or with GA infinite of an Euler-Bernoulli beam."""
    shape = (-1, *(1,) * (z.ndim - 2))
    g = _g(s, p).reshape(shape)
    return z[..., 1] - z[..., 3] * (1 / p[GA]) / g, z[..., 2] / (p[EI] * g)
