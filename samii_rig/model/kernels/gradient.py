"""dy/dp of one element from the states z and zh (the sensor's dual) at its ends.

dy/dp = -w(zh, dU/dp z_before), see `solve`. Written out, every one is symmetric in z, zh:

    spring   dC:  -M Mh                              C = 1/(c s + k)
    link     dm:  s^2 g gh,  dI: s^2 theta thetah,   g = w + r theta at the upstream end
             dr:  m s^2 (theta gh + g thetah),  dL: theta Vh + thetah V   (V behind it)
    beam     EI d/dEI: int M Mh / EI dx,  mu d/dmu: mu s^2 int w wh dx,
             dL: mu s^2 w wh + theta Vh + thetah V - M Mh / EI   (behind it).

The integrals need no quadrature. U = F(beta) but for scales, with
N_L = diag(0, -1, -2, -3) and N_E = diag(0, 0, 1, 1),

    L dU/dL = L A U = [N_L, U] + beta dU/dbeta,    EI dU/dEI = [N_E, U] - beta dU/dbeta / 4,

so both follow from the states at the ends; that loses beta^-4 of the digits, and short
beams use the series of the integrals of the four functions' products instead.
"""

from __future__ import annotations

import math

import numpy as np

from samii_rig.model.kernels.beam import stiffness
from samii_rig.model.kernels.lanes import LANES, conj, get, inverse, load, norm2, part, put, scaled
from samii_rig.model.kernels.registers import (
    BEAM,
    BETA4,
    IS_LONG,
    LINK,
    LONG,
    M_THETA,
    RESULT,
    SPRING,
    THETA_M,
    W_V,
    ZH,
    K,
    S,
    Z,
)
from samii_rig.types import Float

_TERMS = 8  # (2 beta)^(4n) / (4n)! < 1e-16 at the threshold


def _integral_series() -> Float:
    """Coefficients (10, _TERMS) in q = beta^4 of int_0^1 k_i k_j dx, i <= j,
    k_i(x) = sum_n q^n x^(4n+i) / (4n+i)!."""
    table = np.zeros((10, _TERMS))
    row = 0
    for i in range(4):
        for j in range(i, 4):
            for m in range(_TERMS):
                for n in range(_TERMS - m):
                    a, b = 4 * m + i, 4 * n + j
                    table[row, m + n] += 1 / (math.factorial(a) * math.factorial(b) * (a + b + 1))
            row += 1
    return table


_SERIES = _integral_series()


@part
def integrals(W: Float, regime: int) -> None:
    """Fill K with the ten integrals of a short beam."""
    if regime == LONG:
        return
    for row in range(10):
        for i in range(LANES):
            put(W, K, i, complex(_SERIES[row, _TERMS - 1], 0.0))
        for n in range(_TERMS - 2, -1, -1):
            for i in range(LANES):
                z = get(W, K, i) * get(W, BETA4, i)
                put(W, K, i, complex(z.real + _SERIES[row, n], z.imag))
        for i in range(2 * LANES):
            W[(K + 2 + 2 * row) * LANES + i] = W[K * LANES + i]


@part
def point(W: Float, pair: int, direct: float, z: Float, zh: Float) -> None:
    """RESULT: dy/dx of a point element, z+ = z- + e_i x e_j^T z-: -zh^T J e_i z_j."""
    if pair == THETA_M:
        # `direct`: a sensor across the element reads direct * x M itself.
        for i in range(LANES):
            Mh = get(zh, 4, i)
            put(W, RESULT, i, -get(z, 4, i) * complex(Mh.real - direct, Mh.imag))
        return
    # Signs of J; which state by which dual.
    if pair == W_V:
        row, sign = 6, 1.0
    elif pair == M_THETA:
        row, sign = 2, 1.0
    else:
        row, sign = 0, -1.0
    for i in range(LANES):
        put(W, RESULT, i, scaled(get(z, row, i) * get(zh, row, i), sign))


@part
def _spring(W: Float, k: float, c: float, direct: float, z: Float, zh: Float) -> None:
    # `direct`: a sensor across the spring reads direct * C M itself.
    for i in range(LANES):
        s = get(W, S, i)
        C = inverse(complex(k + c * s.real, c * s.imag))
        Mh = get(zh, 4, i)
        y = C * C * get(z, 4, i) * complex(Mh.real - direct, Mh.imag)
        put(W, RESULT, i, y)
        put(W, RESULT + 2, i, s * y)


@part
def _link(W: Float, L: float, r: float, m: float) -> None:
    for i in range(LANES):
        s2 = get(W, S + 2, i)
        t, th = get(W, Z + 2, i), get(W, ZH + 2, i)
        g = get(W, Z, i) - scaled(t, L - r)
        gh = get(W, ZH, i) - scaled(th, L - r)
        put(W, RESULT, i, t * get(W, ZH + 6, i) + th * get(W, Z + 6, i))
        put(W, RESULT + 2, i, scaled(s2 * (t * gh + th * g), m))
        put(W, RESULT + 4, i, s2 * g * gh)
        put(W, RESULT + 6, i, s2 * t * th)


@part
def _beam_ends(W: Float, mu: float, L: float) -> None:
    for i in range(LANES):
        flexibility = get(W, BEAM + 25, i)
        w2, t2, M2, V2 = get(W, Z, i), get(W, Z + 2, i), get(W, Z + 4, i), get(W, Z + 6, i)
        t1, M1, V1 = get(W, Z + 10, i), get(W, Z + 12, i), get(W, Z + 14, i)
        x2, r2, N2, T2 = get(W, ZH, i), get(W, ZH + 2, i), get(W, ZH + 4, i), get(W, ZH + 6, i)
        x1, r1, N1 = get(W, ZH + 8, i), get(W, ZH + 10, i), get(W, ZH + 12, i)
        by_L = scaled(get(W, S + 2, i) * (w2 * x2), mu) + t2 * T2 + r2 * V2
        by_L = by_L - scaled(flexibility * (M2 * N2), 1.0 / (L * L))
        elastic = (x2 * V2 - r2 * M2) - (x1 * V1 - r1 * M1)
        beta = scaled(x1 * V1 - x2 * V2, 3.0) + scaled(r2 * M2 - r1 * M1, 2.0)
        beta = scaled(by_L, L) + beta - (N2 * t2 - N1 * t1)
        by_EI = complex(-elastic.real - 0.25 * beta.real, -elastic.imag - 0.25 * beta.imag)
        keep = W[IS_LONG * LANES + i]
        put(W, RESULT, i, scaled(by_EI, keep))
        put(W, RESULT + 2, i, scaled(beta, 0.25 * keep))
        put(W, RESULT + 4, i, by_L)


@part
def _beam_series(W: Float, mu: float, L: float) -> None:
    for i in range(LANES):
        a, stiff, q = get(W, BEAM + 25, i), get(W, BEAM + 27, i), get(W, BETA4, i)
        u0, u1 = get(W, Z + 8, i), scaled(get(W, Z + 10, i), L)
        u2, u3 = a * get(W, Z + 12, i), scaled(a * get(W, Z + 14, i), L)
        x0, x1 = get(W, ZH + 8, i), scaled(get(W, ZH + 10, i), L)
        x2, x3 = a * get(W, ZH + 12, i), scaled(a * get(W, ZH + 14, i), L)
        k00, k01, k02, k03 = get(W, K + 2, i), get(W, K + 4, i), get(W, K + 6, i), get(W, K + 8, i)
        k11, k12, k13 = get(W, K + 10, i), get(W, K + 12, i), get(W, K + 14, i)
        k22, k23, k33 = get(W, K + 16, i), get(W, K + 18, i), get(W, K + 20, i)
        kinetic = (
            u0 * (k00 * x0 + k01 * x1 + k02 * x2 + k03 * x3)
            + u1 * (k01 * x0 + k11 * x1 + k12 * x2 + k13 * x3)
            + u2 * (k02 * x0 + k12 * x1 + k22 * x2 + k23 * x3)
            + u3 * (k03 * x0 + k13 * x1 + k23 * x2 + k33 * x3)
        )
        # a M(x) L-scaled = u2 k0 + u3 k1 + q (u0 k2 + u1 k3).
        u0, u1, x0, x1 = q * u0, q * u1, q * x0, q * x1
        elastic = (
            u2 * (k00 * x2 + k01 * x3 + k02 * x0 + k03 * x1)
            + u3 * (k01 * x2 + k11 * x3 + k12 * x0 + k13 * x1)
            + u0 * (k02 * x2 + k12 * x3 + k22 * x0 + k23 * x1)
            + u1 * (k03 * x2 + k13 * x3 + k23 * x0 + k33 * x1)
        )
        keep = 1.0 - W[IS_LONG * LANES + i]
        by_EI = get(W, RESULT, i) + scaled(stiff * elastic, keep / L)
        by_mu = get(W, RESULT + 2, i) + scaled(get(W, S + 2, i) * kinetic, keep * mu * L)
        put(W, RESULT, i, by_EI)
        put(W, RESULT + 2, i, by_mu)


@part
def _beam_parameters(W: Float, EI: float, mu: float, eta: float, tau: float) -> None:
    # By the chain rule from the logarithmic derivative by the complex stiffness.
    for i in range(LANES):
        s = get(W, S, i)
        y = get(W, RESULT, i)
        g = scaled(stiffness(s, EI, eta, tau), 1.0 / EI)
        by_g = y * scaled(conj(g), 1.0 / norm2(g))
        sign = 1.0 - 2.0 * (s.imag < 0)
        put(W, RESULT, i, scaled(y, 1.0 / EI))
        put(W, RESULT + 2, i, scaled(get(W, RESULT + 2, i), 1.0 / mu))
        put(W, RESULT + 6, i, complex(-by_g.imag * sign, by_g.real * sign))
        put(W, RESULT + 8, i, s * by_g)


@part
def contributions(
    W: Float, kind: int, par: Float, regime: int, direct: float, z: Float, zh: Float
) -> None:
    """RESULT: dy/dp for the parameters of an element in their order, at a unit source."""
    if kind == SPRING:
        _spring(W, par[0], par[1], direct, z, zh)
        return
    load(W, Z, z, 16)
    load(W, ZH, zh, 16)
    if kind == LINK:
        _link(W, par[0], par[1], par[2])
    else:
        _beam_ends(W, par[1], par[2])
        if regime != LONG:
            _beam_series(W, par[1], par[2])
        _beam_parameters(W, par[0], par[1], par[3], par[4])
