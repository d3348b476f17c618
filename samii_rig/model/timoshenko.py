"""A beam with shear and rotary inertia: its matrix in a form that keeps its digits, its gradient.

    w' = theta - V/GA,   theta' = M/EI,   M' = V + J s^2 theta,   V' = -mu s^2 w

z' = A z has four waves exp(+-lambda x), lambda^2 from

    lambda^4 - lambda^2 (mu s^2/GA + J s^2/EI) + mu s^2 (1 + J s^2/GA)/EI = 0.

A tension N + N' (x - L/2) (`weight`) adds itself times theta to M'. The power series bears it as
it is; waves, where they are much shorter than the beam, have that of the middle: J s^2 is then
J s^2 + N in the equation above. Such a beam of Euler and Bernoulli is one whose shear stiffness is
beyond all numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from samii_rig.types import Complex, Float

LONG = 1.5  # |lambda_1| L from which the waves are used: they lose (lambda L)^-3 at most
TERMS = 26  # of the power series: 1.5^26/26! < 1e-22
# The same of a beam with tension, which its waves do not know to change: the series costs two
# digits at |lambda_1| L = 5, and 5^48/48! < 1e-27.
TENSE_LONG, TENSE_TERMS = 5.0, 48
EI, MU, LENGTH, ETA, TAU, GA, J, TENSION, SLOPE = range(9)  # places among the parameters
RIGID_IN_SHEAR = 1e150  # N, GA of a beam without shear: its reciprocal adds to no other number
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


def full(kind: str, p: Float) -> Float:
    """The parameters of a beam of either kind, as this module reads them."""
    if kind != "beam":
        return p
    out = p.copy()
    out[GA] = RIGID_IN_SHEAR
    return out


def _tense(p: Float) -> bool:
    return bool(p[TENSION] != 0 or p[SLOPE] != 0)


def _g(s: Complex, p: Float) -> Complex:
    return np.asarray(1 + 1j * p[ETA] * np.where(s.imag < 0, -1.0, 1.0) + s * p[TAU])


def waves(s: Complex, p: Float) -> Waves:
    """Wave numbers and states of the four waves at s (n,), rad/s. p : as of `full`."""
    g = _g(s, p)
    B, G = p[EI] * g, p[GA] * g
    m, j = p[MU] * s**2, p[J] * s**2 + p[TENSION]
    b, c = m / G + j / B, m * (1 + j / G) / B
    root = np.sqrt((m / G - j / B) ** 2 - 4 * m / B)
    root = np.where((root.conj() * b).real < 0, -root, root)
    big = (b + root) / 2
    other = c / np.where(big == 0, 1.0, big)
    other = np.where(np.abs(other) < 1e-14 * np.abs(big), 1e-14 * big, other)
    one, two = np.sqrt(big), np.sqrt(other)
    swap = two.real > one.real
    one, two = np.where(swap, two, one), np.where(swap, one, two)
    reach = TENSE_LONG if _tense(p) else LONG
    long = np.maximum(np.abs(one), np.abs(two)) * p[LENGTH] > reach
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
    """c_k (terms, n, 4, m) with z(x) = sum_k (x/L)^k c_k for the states z (n, 4, m) at x = 0."""
    g = _g(s, p)
    L, B, G = p[LENGTH], p[EI] * g, p[GA] * g
    m, j = p[MU] * s**2, p[J] * s**2 + p[TENSION] - p[SLOPE] * L / 2
    terms = TENSE_TERMS if _tense(p) else TERMS
    out = np.zeros((terms, *z.shape), complex)
    out[0] = z
    for k in range(1, terms):
        w, t, M, V = (out[k - 1, :, i] * (L / k) for i in range(4))
        out[k, :, 0] = t - V / G[:, None]
        out[k, :, 1] = M / B[:, None]
        out[k, :, 2] = V + j[:, None] * t
        if k > 1 and p[SLOPE]:
            out[k, :, 2] += p[SLOPE] * L**2 / k * out[k - 2, :, 1]
        out[k, :, 3] = -m[:, None] * w
    return out


def matrix(s: Complex, p: Float) -> Complex:
    """(2, ROWS, n) for the kernel, forwards and mirrored: a uniform beam is its own mirror, one
    whose tension falls is that of one whose tension rises."""
    forwards = _matrix(s, p)
    if p[SLOPE] == 0:
        return np.stack([forwards, forwards])
    back = p.copy()
    back[SLOPE] = -p[SLOPE]
    return np.stack([forwards, _matrix(s, back)])


def _matrix(s: Complex, p: Float) -> Complex:
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
    return out


def scaling(s: Complex, p: Float) -> tuple[Complex, Float]:
    """1/(E1 E2) = mantissa exp(log), (n,) each at s (n,), rad/s: what the kernel's scaling took out
    of the determinant. p : the element's parameters in the schema's order."""
    w = waves(s, p)
    total = np.where(w.long, (w.one + w.two) * p[LENGTH], 0.0)
    return np.exp(1j * total.imag), np.asarray(total.real)


def gradient(s: Complex, p: Float, z: Complex, zh: Complex) -> Complex:
    """(9, n, n_sensor, n_source) dy/dp at unit sources.

    z (n, 8, n_source), zh (n, 8, n_sensor) : states behind (4) and before the beam (4) and
    the sensors' duals. dy/dx_ij = -zh^T J e_i z_j summed over the beam for each entry of A
    (`gradient`), so all follow from the integrals of w wh, theta thetah, M Mh, V Vh and of
    theta thetah times the distance from the middle.
    """
    found = waves(s, p)
    integral = np.zeros((5, s.size, zh.shape[2], z.shape[2]), complex)
    for chosen, take in ((found.long, _long_integrals), (~found.long, _short_integrals)):
        if chosen.any():
            part = Waves(*(x[chosen] for x in found))
            integral[:, chosen] = take(s[chosen], p, part, z[chosen], zh[chosen])
    w, t, M, V = (z[:, None, i, :] for i in range(4))
    wh, th, Mh, Vh = (zh[:, i, :, None] for i in range(4))
    ww, tt, MM, VV, xtt = integral
    g = found.g[:, None, None]
    s2 = (s**2)[:, None, None]
    B, G, L = p[EI] * g, p[GA] * g, p[LENGTH]
    by_g = MM / (B * g) + VV / (G * g)
    by_L = p[MU] * s2 * w * wh + t * Vh + th * V - M * Mh / B - V * Vh / G + p[J] * s2 * t * th
    if _tense(p):
        change = np.where(found.long, 0.0, p[SLOPE])[:, None, None]  # waves know of none
        by_L += (p[TENSION] + change * L / 2) * t * th - change * tt / 2
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
            tt,
            xtt,
        ]
    )


def _long_integrals(s: Complex, p: Float, w: Waves, z: Complex, zh: Complex) -> Complex:
    """(5, n, n_sensor, n_source): growing waves by their amplitudes behind the beam, decaying
    ones by those before it. The last is 0: waves do not know of a change of tension."""
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
    found = [np.einsum("nk,nm,nkm,nka,nmb->nba", v[..., i], v[..., i], Phi, a, ah, optimize=True)
             for i in range(4)]  # fmt: skip
    return np.stack([*found, np.zeros_like(found[0])])


def _short_integrals(s: Complex, p: Float, w: Waves, z: Complex, zh: Complex) -> Complex:
    c, ch = _series(s, p, z[:, 4:]), _series(s, p, zh[:, 4:])
    k = np.arange(len(c))
    power = k[:, None] + k
    weight = p[LENGTH] / (power + 1)
    found = np.einsum("knia,kl,lnib->inba", c, weight, ch, optimize=True)
    if p[SLOPE] == 0:
        return np.concatenate([found, np.zeros_like(found[:1])])
    from_middle = p[LENGTH] ** 2 * (1 / (power + 2) - 0.5 / (power + 1))
    turned = np.einsum("kna,kl,lnb->nba", c[:, :, 1], from_middle, ch[:, :, 1], optimize=True)
    return np.concatenate([found, turned[None]])


def end_slopes(s: Complex, p: Float, z: Complex) -> tuple[Complex, Complex]:
    """w' and theta' where the state is z (n, ..., 4); p of a Timoshenko beam,
    or with GA infinite of an Euler-Bernoulli beam."""
    shape = (-1, *(1,) * (z.ndim - 2))
    g = _g(s, p).reshape(shape)
    return z[..., 1] - z[..., 3] * (1 / p[GA]) / g, z[..., 2] / (p[EI] * g)
