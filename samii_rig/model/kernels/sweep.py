"""The stable sweep: which states are possible at a port, seen from one end of the chain.

The states that one end's boundary condition allows form a plane; two columns span it.
A sweep carries both through the elements and changes their basis on the way so that they
never become parallel. Between elements they have the form

    column 1 = (w1, theta1, M1, V1),    column 2 = (w2, 0, M2, V2),

which every rigid link keeps. A spring turns much moment into rotation; restoring
theta2 = 0 behind it is done by formulas in which nothing cancels. In a beam the columns
are written as the four waves exp(+-beta x/L), exp(+-j beta x/L) and combined so that only
column 1 holds the fastest growing one; both are then scaled by it, so exponentials only
decay.

A change of basis is X_after = U X_before B; the 2x2 matrix B of each element is kept, so
a solution a (coefficients in the last basis) is carried back by a_before = B a_after,
which again holds decaying factors only.

The sweep from the tip is the same one on the mirrored chain: with theta and V reversed,
U^-1 is the U of the mirrored element.
"""

from __future__ import annotations

from samii_rig.model.kernels.basis import exchange, restore
from samii_rig.model.kernels.lanes import LANES, TINY, conj, get, norm2, part, pick, put, scaled
from samii_rig.model.kernels.points import hinge, jump, link, spring
from samii_rig.model.kernels.registers import (
    BEAM,
    BEAM_KIND,
    EXCHANGE,
    FLAG,
    HINGE,
    IS_LONG,
    JUMP,
    LINK,
    LONG,
    MIXED,
    SHORT,
    SPRING,
    THETA2,
    WAVES,
    B,
    Factors,
    S,
    X,
    Y,
)
from samii_rig.types import Complex, Float, Int


@part
def _exchange_if(W: Float, swaps: int) -> None:
    """Exchange the columns of the lanes that need it, if there are any; sets FLAG."""
    if swaps > 0:
        exchange(W, X, X + 8, False)
    else:
        for i in range(LANES):
            W[FLAG * LANES + i] = 0.0


@part
def _put_change(W: Float, i: int, rho: complex, E1: complex, E2: complex) -> None:
    """B of lane i: the exchange where FLAG is 1, column 2 less rho times column 1, then the
    scales E1 and E2 of the columns."""
    flag = W[FLAG * LANES + i]
    keep = 1.0 - flag
    put(W, B, i, scaled(E1, keep))
    put(W, B + 2, i, complex(-flag - keep * rho.real, -keep * rho.imag) * E2)
    put(W, B + 4, i, scaled(E1, flag))
    put(W, B + 6, i, complex(keep - flag * rho.real, -flag * rho.imag) * E2)


@part
def waves(W: Float, m: Complex, start: int) -> None:
    """Carry X over a matrix given by its waves, as `long_beam`; m (34, n) see `timoshenko`."""
    last = m.shape[1] - 1
    swaps = 0
    for i in range(LANES):
        n = min(start + i, last)
        w, t, M, V = get(W, X, i), get(W, X + 2, i), get(W, X + 4, i), get(W, X + 6, i)
        a1 = m[0, n] * w + m[1, n] * t + m[2, n] * M + m[3, n] * V
        put(W, X, i, a1)
        for k in range(1, 4):
            r = 4 * k
            y = m[r, n] * w + m[r + 1, n] * t + m[r + 2, n] * M + m[r + 3, n] * V
            put(W, X + 2 * k, i, y)
        w, M, V = get(W, X + 8, i), get(W, X + 10, i), get(W, X + 12, i)
        a2 = m[0, n] * w + m[2, n] * M + m[3, n] * V
        put(W, X + 8, i, a2)
        put(W, THETA2, i, m[4, n] * w + m[6, n] * M + m[7, n] * V)
        put(W, X + 10, i, m[8, n] * w + m[10, n] * M + m[11, n] * V)
        put(W, X + 12, i, m[12, n] * w + m[14, n] * M + m[15, n] * V)
        swaps += norm2(a2) > EXCHANGE * norm2(a1)
    _exchange_if(W, swaps)
    for i in range(LANES):
        n = min(start + i, last)
        E1, E2 = m[32, n], m[33, n]
        a, b, c, d = get(W, X, i), get(W, X + 2, i), get(W, X + 4, i), get(W, X + 6, i)
        rho = get(W, X + 8, i) * scaled(conj(a), 1.0 / (norm2(a) + TINY))
        bo = get(W, THETA2, i) - rho * b
        co = get(W, X + 10, i) - rho * c
        do = get(W, X + 12, i) - rho * d
        b, c, d = b * (E1 * E1), c * (E1 / E2), d * (E1 * E2)
        bo, do = bo * (E1 * E2), do * (E2 * E2)
        for k in range(4):
            r = 16 + 4 * k
            put(W, X + 2 * k, i, m[r, n] * a + m[r + 1, n] * b + m[r + 2, n] * c + m[r + 3, n] * d)
        put(W, X + 8, i, m[17, n] * bo + m[18, n] * co + m[19, n] * do)
        put(W, THETA2, i, m[21, n] * bo + m[22, n] * co + m[23, n] * do)
        put(W, X + 10, i, m[25, n] * bo + m[26, n] * co + m[27, n] * do)
        put(W, X + 12, i, m[29, n] * bo + m[30, n] * co + m[31, n] * do)
        _put_change(W, i, rho, E1, E2)


@part
def short_beam(W: Float, L: float) -> None:
    """Carry X over a beam of small beta by the plain matrix (paper 1, eq. 9)."""
    for i in range(LANES):
        c0, c1 = get(W, BEAM + 29, i), get(W, BEAM + 31, i)
        c2, c3 = get(W, BEAM + 33, i), get(W, BEAM + 35, i)
        q1, q2, q3 = get(W, BEAM + 37, i), get(W, BEAM + 39, i), get(W, BEAM + 41, i)
        a, stiff = get(W, BEAM + 25, i), get(W, BEAM + 27, i)
        w, t = get(W, X, i), scaled(get(W, X + 2, i), L)
        M, V = a * get(W, X + 4, i), scaled(a * get(W, X + 6, i), L)
        put(W, X, i, c0 * w + c1 * t + c2 * M + c3 * V)
        put(W, X + 2, i, scaled(q3 * w + c0 * t + c1 * M + c2 * V, 1.0 / L))
        put(W, X + 4, i, stiff * (q2 * w + q3 * t + c0 * M + c1 * V))
        put(W, X + 6, i, scaled(stiff * (q1 * w + q2 * t + q3 * M + c0 * V), 1.0 / L))
        w = get(W, X + 8, i)
        M, V = a * get(W, X + 10, i), scaled(a * get(W, X + 12, i), L)
        put(W, X + 8, i, c0 * w + c2 * M + c3 * V)
        put(W, THETA2, i, scaled(q3 * w + c1 * M + c2 * V, 1.0 / L))
        put(W, X + 10, i, stiff * (q2 * w + c0 * M + c1 * V))
        put(W, X + 12, i, scaled(stiff * (q1 * w + q3 * M + c0 * V), 1.0 / L))
        put(W, B, i, complex(1.0, 0.0))
        put(W, B + 2, i, complex(0.0, 0.0))
        put(W, B + 4, i, complex(0.0, 0.0))
        put(W, B + 6, i, complex(1.0, 0.0))


@part
def _to_waves(
    w: complex, t: complex, M: complex, V: complex
) -> tuple[complex, complex, complex, complex]:
    e, f, g, h = w + M, t + V, w - M, t - V
    h = complex(-h.imag, h.real)
    return e + f, e - f, g - h, g + h


@part
def _from_waves(
    a: complex, b: complex, c: complex, d: complex
) -> tuple[complex, complex, complex, complex]:
    e, f, g, h = a + b, a - b, c + d, c - d
    h = complex(-h.imag, h.real)
    return e + g, f + h, e - g, f - h


@part
def long_beam(W: Float) -> None:
    """Carry X over a beam by its four waves.

    With lengths in L/beta the state of a wave exp(lambda beta x/L) is
    (1, lambda, lambda^2, lambda^3), lambda = 1, -1, j, -j: to and from the waves is a
    discrete Fourier transform of four points.
    """
    _exchange_if(W, _split(W))
    _decay(W)


@part
def _split(W: Float) -> int:
    """X as waves; the number of lanes whose columns must be exchanged."""
    swaps = 0
    for i in range(LANES):
        g1, g2, g3 = get(W, BEAM + 13, i), get(W, BEAM + 15, i), get(W, BEAM + 17, i)
        w, t = get(W, X, i), g1 * get(W, X + 2, i)
        M, V = g2 * get(W, X + 4, i), g3 * get(W, X + 6, i)
        a1, b1, c, d = _to_waves(w, t, M, V)
        # Growing (m) and decaying (n) of the waves exp(+-j beta): which is which
        # depends on the sign of Im beta.
        upper = W[(BEAM + 12) * LANES + i] > 0
        put(W, X, i, a1)
        put(W, X + 2, i, b1)
        put(W, X + 4, i, pick(upper, d, c))
        put(W, X + 6, i, pick(upper, c, d))
        w, M, V = get(W, X + 8, i), g2 * get(W, X + 10, i), g3 * get(W, X + 12, i)
        a2, b2, c, d = _to_waves(w, complex(0.0, 0.0), M, V)
        put(W, X + 8, i, a2)
        put(W, THETA2, i, b2)
        put(W, X + 10, i, pick(upper, d, c))
        put(W, X + 12, i, pick(upper, c, d))
        swaps += norm2(a2) > EXCHANGE * norm2(a1)
    return swaps


@part
def _decay(W: Float) -> None:
    """Carry the waves to the beam's end, as X there, and B."""
    for i in range(LANES):
        a, b, m, n = get(W, X, i), get(W, X + 2, i), get(W, X + 4, i), get(W, X + 6, i)
        rho = get(W, X + 8, i) * scaled(conj(a), 1.0 / (norm2(a) + TINY))
        bo = get(W, THETA2, i) - rho * b
        mo = get(W, X + 10, i) - rho * m
        no = get(W, X + 12, i) - rho * n
        # exp(-beta), decaying exp(+-j beta), and their products and ratio.
        E1, E2, R = get(W, BEAM, i), get(W, BEAM + 2, i), get(W, BEAM + 4, i)
        E12, E11, E22 = get(W, BEAM + 6, i), get(W, BEAM + 8, i), get(W, BEAM + 10, i)
        b, m, n = b * E11, m * R, n * E12
        bo, no = bo * E12, no * E22
        upper = W[(BEAM + 12) * LANES + i] > 0
        h1, h2, h3 = get(W, BEAM + 19, i), get(W, BEAM + 21, i), get(W, BEAM + 23, i)
        w, t, M, V = _from_waves(a, b, pick(upper, n, m), pick(upper, m, n))
        put(W, X, i, scaled(w, 0.25))
        put(W, X + 2, i, h1 * t)
        put(W, X + 4, i, h2 * M)
        put(W, X + 6, i, h3 * V)
        w, t, M, V = _from_waves(complex(0.0, 0.0), bo, pick(upper, no, mo), pick(upper, mo, no))
        put(W, X + 8, i, scaled(w, 0.25))
        put(W, THETA2, i, h1 * t)
        put(W, X + 10, i, h2 * M)
        put(W, X + 12, i, h3 * V)
        _put_change(W, i, rho, E1, E2)


@part
def _swap_store(W: Float) -> None:
    for i in range((S - X) * LANES):
        x = W[X * LANES + i]
        W[X * LANES + i] = W[Y * LANES + i]
        W[Y * LANES + i] = x


@part
def _keep_short(W: Float) -> None:
    for row in range(S - X):
        for i in range(LANES):
            if W[IS_LONG * LANES + i] == 0.0:
                W[(X + row) * LANES + i] = W[(Y + row) * LANES + i]


@part
def step(
    W: Float, kind: int, par: Float, place: Int, f: Factors, mirrored: bool, regime: int, start: int
) -> bool:
    """Carry X over one element; True if that changed the basis."""
    if kind == LINK:
        r = par[0] - par[1] if mirrored else par[1]
        link(W, par[0], r, par[2], par[3])
        return False
    if kind == SPRING:
        spring(W, par[0], par[1])
        return True
    if kind == HINGE:
        hinge(W, f.jump[place[1]], start)
        return True
    if kind == JUMP:
        jump(W, place[0], f.jump[place[1]], start)
        return True
    if kind == WAVES:
        waves(W, f.matrix[place[1], 1 if mirrored else 0], start)
        restore(W)
        return True
    if kind == BEAM_KIND:
        # If lanes lie on both sides of the threshold, both forms; each lane keeps its own.
        if regime == MIXED:
            for i in range((S - X) * LANES):
                W[Y * LANES + i] = W[X * LANES + i]
        if regime != LONG:
            short_beam(W, par[2])
        if regime == MIXED:
            _swap_store(W)
        if regime != SHORT:
            long_beam(W)
        if regime == MIXED:
            _keep_short(W)
        restore(W)
        return True
    return False
