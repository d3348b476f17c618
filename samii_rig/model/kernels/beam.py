"""What a beam needs at each s before any sweep: its wave number, waves and series.

beta^4 = -mu s^2 L^4 / EI, paper 1 below eq. (2) with s = j omega, EI the complex stiffness
EI (1 + j eta + s tau).
"""

from __future__ import annotations

import math

from samii_rig.model.kernels.lanes import LANES, get, inverse, norm2, part, put, root, scaled
from samii_rig.model.kernels.registers import (
    BEAM,
    BETA,
    DECAY,
    IS_LONG,
    LONG,
    MIXED,
    PHASE,
    SHORT,
    S,
)
from samii_rig.model.kernels.registers import BETA4 as Q
from samii_rig.model.kernels.waves import circle, decay
from samii_rig.types import Float

# |beta| = 1.5 parts the series from the waves. Below, six terms of each series leave 1e-19;
# above, going to waves and back costs no more than beta^-3.
THRESHOLD = 1.5**8  # of |beta^4|^2
BEYOND = 690.0  # exp(-x) is 0 for all purposes, and need not become smaller


# 1/(4n+k)! for c_k = sum_n q^n / (4n+k)!, n = 0..5.
_C0 = tuple(1.0 / math.factorial(4 * n) for n in range(6))
_C1 = tuple(1.0 / math.factorial(4 * n + 1) for n in range(6))
_C2 = tuple(1.0 / math.factorial(4 * n + 2) for n in range(6))
_C3 = tuple(1.0 / math.factorial(4 * n + 3) for n in range(6))


@part
def stiffness(s: complex, EI: float, eta: float, tau: float) -> complex:
    """EI (1 + j eta + s tau); at Im s < 0 the loss factor is -eta, see `elements`."""
    sign = 1.0 - 2.0 * (s.imag < 0)
    return complex(EI * (1.0 + tau * s.real), EI * (eta * sign + tau * s.imag))


@part
def _series(q: complex, c: tuple[float, ...]) -> complex:
    z = complex(c[5] * q.real + c[4], c[5] * q.imag)
    z = z * q + c[3]
    z = z * q + c[2]
    z = z * q + c[1]
    return z * q + c[0]


@part
def _decay(x: float) -> float:
    return decay(x if x < BEYOND else BEYOND)


@part
def _waves(W: Float, L: float) -> None:
    for i in range(LANES):
        beta = get(W, BETA, i)
        x, y = beta.real, beta.imag
        low = abs(y)
        sign = 2.0 * (y > 0) - 1.0
        e1, e2 = circle(-y), circle(x)
        e2 = complex(e2.real, e2.imag * sign)
        ey, ed = _decay(low), _decay(x - low)
        E1, E2 = scaled(e1, ey * ed), scaled(e2, ey)
        put(W, BEAM, i, E1)
        put(W, BEAM + 2, i, E2)
        put(W, BEAM + 4, i, scaled(e1 * complex(e2.real, -e2.imag), ed))
        put(W, BEAM + 6, i, E1 * E2)
        put(W, BEAM + 8, i, E1 * E1)
        put(W, BEAM + 10, i, E2 * E2)
        W[(BEAM + 12) * LANES + i] = sign
        put(W, PHASE, i, e1 * e2)
        W[DECAY * LANES + i] = beta.real + abs(beta.imag)
        a, stiff = get(W, BEAM + 25, i), get(W, BEAM + 27, i)
        u = inverse(beta)
        g1, g2 = scaled(u, L), a * (u * u)
        put(W, BEAM + 13, i, g1)
        put(W, BEAM + 15, i, g2)
        put(W, BEAM + 17, i, g1 * g2)
        h1, h2 = scaled(beta, 1.0 / L), stiff * (beta * beta)
        put(W, BEAM + 19, i, scaled(h1, 0.25))
        put(W, BEAM + 21, i, scaled(h2, 0.25))
        put(W, BEAM + 23, i, scaled(h1 * h2, 0.25))


@part
def _functions(W: Float) -> None:
    for i in range(LANES):
        q = get(W, Q, i)
        c1, c2, c3 = _series(q, _C1), _series(q, _C2), _series(q, _C3)
        put(W, BEAM + 29, i, _series(q, _C0))
        put(W, BEAM + 31, i, c1)
        put(W, BEAM + 33, i, c2)
        put(W, BEAM + 35, i, c3)
        put(W, BEAM + 37, i, q * c1)
        put(W, BEAM + 39, i, q * c2)
        put(W, BEAM + 41, i, q * c3)


@part
def prepare(W: Float, EI: float, mu: float, L: float, eta: float, tau: float) -> int:
    """Fill the beam's rows from s and s^2; SHORT, LONG or MIXED."""
    longs = 0
    for i in range(LANES):
        stiff = stiffness(get(W, S, i), EI, eta, tau)
        a = scaled(inverse(stiff), L * L)
        q = scaled(get(W, S + 2, i) * a, -mu * L * L)
        put(W, BEAM + 25, i, a)
        put(W, BEAM + 27, i, scaled(stiff, 1.0 / (L * L)))
        put(W, Q, i, q)
        put(W, BETA, i, root(root(q)))
        long = norm2(q) > THRESHOLD
        W[IS_LONG * LANES + i] = 1.0 * long
        longs += long
    if longs > 0:
        _waves(W, L)
    if longs < LANES:
        _functions(W)
        for i in range(LANES):
            if W[IS_LONG * LANES + i] == 0.0:
                W[PHASE * LANES + i] = 1.0
                W[(PHASE + 1) * LANES + i] = 0.0
                W[DECAY * LANES + i] = 0.0
    if longs == 0:
        return SHORT
    return LONG if longs == LANES else MIXED
