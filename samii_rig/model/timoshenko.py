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

import numba
import numpy as np

from samii_rig.types import Complex, Float

LONG_BEAM = 1.5  # |lambda_1| L from which the waves are used: they lose (lambda L)^-3 at most
TERMS = 26  # of the power series: 1.5^26/26! < 1e-22
# The same of a beam with tension, which its waves do not know to change: the series costs two
# digits at |lambda_1| L = 5, and 5^48/48! < 1e-27.
TENSE_LONG, TENSE_TERMS = 5.0, 48
EI, MU, LENGTH, ETA, TAU, GA, J, TENSION, SLOPE = range(9)  # places among the parameters
# Of a sum, terms that add nothing to it, and how many of them one after another end it: those of
# one state come every fourth time.
NO_TERM, SMALL = 1e-17, 4
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
    numbers, vectors, dual = _waves(m, j, B, G)
    reach = TENSE_LONG if _tense(p) else LONG_BEAM
    long = np.max(np.abs(numbers), axis=0) * p[LENGTH] > reach
    return Waves(g, numbers[0], numbers[1], np.asarray(long), vectors, dual)


@numba.njit(cache=True, error_model="numpy")
def _waves(m: Complex, j: Complex, B: Complex, G: Complex) -> tuple[Complex, Complex, Complex]:
    """Wave numbers (2, n), vectors and dual (n, 4, 4) as in `Waves`."""
    numbers = np.empty((2, m.size), np.complex128)
    vectors = np.empty((m.size, 4, 4), np.complex128)
    dual = np.empty((m.size, 4, 4), np.complex128)
    for n in range(m.size):
        shears, rotates = m[n] / G[n], j[n] / B[n]
        b, c = shears + rotates, m[n] * (1 + j[n] / G[n]) / B[n]
        root = np.sqrt((shears - rotates) ** 2 - 4 * m[n] / B[n])
        if (root.conjugate() * b).real < 0:
            root = -root
        big = (b + root) / 2
        other = c / big if big != 0 else c
        if abs(other) < 1e-14 * abs(big):
            other = 1e-14 * big
        one, two = np.sqrt(big), np.sqrt(other)
        if two.real > one.real:
            one, two = two, one
        numbers[0, n], numbers[1, n] = one, two
        for k in range(2):
            x = numbers[k, n] if numbers[k, n] != 0 else 1.0 + 0.0j
            # shear = lambda^2 - m/GA and rotary = EI lambda^2 - j multiply to -m; the one that
            # cancels is taken from the other.
            bends = B[n] * x**2
            shear, rotary = x**2 - shears, bends - j[n]
            if abs(shear) * abs(bends) < abs(rotary) * abs(x**2):
                shear = -m[n] / rotary if rotary != 0 else -m[n]
            for i in range(2):
                sign = 1.0 - 2.0 * i
                own = vectors[n, 2 * k + i]
                own[0] = 1.0
                own[1] = sign * shear / x
                own[2] = B[n] * shear
                own[3] = -sign * m[n] / x
        for i in range(4):
            v, u = vectors[n, i], vectors[n, i + 1 - 2 * (i % 2)]  # u : of the mirrored wave
            scale = -u[3] * v[0] + u[2] * v[1] - u[1] * v[2] + u[0] * v[3]  # u^T J v
            if scale == 0:
                scale = 1.0 + 0.0j
            dual[n, i, 0] = -u[3] / scale
            dual[n, i, 1] = u[2] / scale
            dual[n, i, 2] = -u[1] / scale
            dual[n, i, 3] = u[0] / scale
    return numbers, vectors, dual


def _of_series(s: Complex, p: Float) -> tuple[float, Complex, Complex, Complex, Complex, int]:
    """L, EI g, GA g, mu s^2, J s^2 + N at the beam's start, and how many terms the series has."""
    g, L = _g(s, p), float(p[LENGTH])
    m, j = p[MU] * s**2, p[J] * s**2 + p[TENSION] - p[SLOPE] * L / 2
    return L, p[EI] * g, p[GA] * g, m, j, TENSE_TERMS if _tense(p) else TERMS


def _series(s: Complex, p: Float, z: Complex) -> Complex:
    """c_k (terms, n, 4, m) with z(x) = sum_k (x/L)^k c_k for the states z (n, 4, m) at x = 0."""
    L, B, G, m, j, terms = _of_series(s, p)
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


def _across(s: Complex, p: Float) -> Complex:
    """(n, 4, 4) from the state before the beam to that behind it, by the power series."""
    L, B, G, m, j, terms = _of_series(s, p)
    return np.asarray(_summed(m, j, 1 / B, 1 / G, L, float(p[SLOPE]), terms))


@numba.njit(inline="always")
def _adds(term: complex, total: complex) -> bool:
    return abs(term.real) + abs(term.imag) > NO_TERM * (abs(total.real) + abs(total.imag))


@numba.njit(cache=True, error_model="numpy")
def _summed(
    m: Complex, j: Complex, by_B: Complex, by_G: Complex, L: float, slope: float, terms: int
) -> Complex:
    """The sum of `_series` for the four unit states, up to where no further term adds to it."""
    U = np.zeros((m.size, 4, 4), np.complex128)
    for n in range(m.size):
        for state in range(4):
            w = 1.0 + 0.0j if state == 0 else 0.0j
            t = 1.0 + 0.0j if state == 1 else 0.0j
            M = 1.0 + 0.0j if state == 2 else 0.0j
            V = 1.0 + 0.0j if state == 3 else 0.0j
            before = 0.0j  # theta's coefficient one term back
            W, T, B, S = w, t, M, V
            small = 0
            for k in range(1, terms):
                step = L / k
                bent = step * (V + j[n] * t) + slope * L * step * before
                before = t
                w, t, M, V = step * (t - V * by_G[n]), step * M * by_B[n], bent, -step * m[n] * w
                W += w
                T += t
                B += M
                S += V
                adds = _adds(w, W) or _adds(t, T) or _adds(M, B) or _adds(V, S)
                small = 0 if adds else small + 1
                if small == SMALL:
                    break
            U[n, 0, state] = W
            U[n, 1, state] = T
            U[n, 2, state] = B
            U[n, 3, state] = S
    return U


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
        Q[short] = _across(s[short], p) @ SORT
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
