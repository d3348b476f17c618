"""Carry the columns of a sweep over links, springs and the other elements without extent."""

from __future__ import annotations

from samii_rig.model.kernels.basis import exchange, needs_exchange
from samii_rig.model.kernels.lanes import (
    LANES,
    TINY,
    conj,
    get,
    inverse,
    norm2,
    part,
    pick,
    put,
    scaled,
)
from samii_rig.model.kernels.registers import (
    FLAG,
    M_THETA,
    NUMERATOR,
    RHO,
    SCALE,
    THETA2,
    W_V,
    B,
    S,
    X,
)
from samii_rig.types import Complex, Float


@part
def link(W: Float, L: float, r: float, m: float, inertia: float) -> None:
    """Carry X over a rigid link; see `elements.rigid_link_matrix`."""
    for i in range(LANES):
        s2 = get(W, S + 2, i)
        theta1 = get(W, X + 2, i)
        w1, V1 = get(W, X, i), get(W, X + 6, i)
        w2, V2 = get(W, X + 8, i), get(W, X + 12, i)
        ms2 = scaled(s2, m)
        A1 = ms2 * (w1 + scaled(theta1, r))
        A2 = ms2 * w2
        put(W, X, i, w1 + scaled(theta1, L))
        M1 = get(W, X + 4, i) + scaled(V1, L) - scaled(A1, L - r)
        put(W, X + 4, i, M1 + scaled(s2, inertia) * theta1)
        put(W, X + 6, i, V1 - A1)
        put(W, X + 10, i, get(W, X + 10, i) + scaled(V2, L) - scaled(A2, L - r))
        put(W, X + 12, i, V2 - A2)


@part
def spring(W: Float, k: float, c: float) -> None:
    """Carry X over theta+ = theta- + C M, C = 1/(c s + k), and restore theta2 = 0.

    Behind the spring the columns' rotations are theta1 + C M1 and C M2; column 2 less
    rho times column 1 has none. Its moment, a difference of large numbers if computed so,
    is M2 theta1 over the pivot's rotation.
    """
    awkward = 0
    for i in range(LANES):
        s = get(W, S, i)
        C = inverse(complex(k + c * s.real, c * s.imag))
        theta1, M1, M2 = get(W, X + 2, i), get(W, X + 4, i), get(W, X + 10, i)
        t1 = theta1 + C * M1
        t2 = C * M2
        put(W, NUMERATOR, i, M2 * theta1)
        put(W, X + 2, i, t1)
        put(W, THETA2, i, t2)
        awkward += needs_exchange(t1, t2)
    _after_spring(W, awkward)


@part
def _after_spring(W: Float, awkward: int) -> None:
    if awkward > 0:
        exchange(W, X + 2, THETA2, True)
    else:
        for i in range(LANES):
            W[FLAG * LANES + i] = 0.0
            W[SCALE * LANES + i] = 1.0
    for i in range(LANES):
        t = get(W, X + 2, i)
        scale = W[SCALE * LANES + i]
        divide = scaled(conj(t), 1.0 / (norm2(t) + TINY))
        rho = get(W, THETA2, i) * divide
        put(W, X + 8, i, get(W, X + 8, i) - rho * get(W, X, i))
        # The pivot has been scaled, the numerator not.
        put(W, X + 10, i, scaled(get(W, NUMERATOR, i) * divide, scale))
        put(W, X + 12, i, get(W, X + 12, i) - rho * get(W, X + 6, i))
        put(W, RHO, i, rho)


@part
def hinge(W: Float, C: Complex, start: int) -> None:
    """`spring` with any compliance, C[start:] its values."""
    awkward = 0
    for i in range(LANES):
        x = C[min(start + i, C.shape[0] - 1)]
        theta1, M1, M2 = get(W, X + 2, i), get(W, X + 4, i), get(W, X + 10, i)
        t1 = theta1 + x * M1
        t2 = x * M2
        put(W, NUMERATOR, i, M2 * theta1)
        put(W, X + 2, i, t1)
        put(W, THETA2, i, t2)
        awkward += needs_exchange(t1, t2)
    _after_spring(W, awkward)


@part
def jump(W: Float, pair: int, x: Complex, start: int) -> None:
    """Carry X over a point element that leaves theta2 = 0: every pair but theta <- M.

    The same mirrored, where both states of the one kind and none or both of the other turn.
    With w <- V or V <- w and a large x (a soft spring, a stiff ground) both columns would turn
    into the state that jumps: column 1 then loses so much of column 2 that it has none of it,
    by a formula without x.
    """
    last = x.shape[0] - 1
    to, by, to2, by2 = X, X + 6, X + 8, X + 12
    if pair != W_V:
        to, by, to2, by2 = by, to, by2, to2
    for i in range(LANES):
        y = x[min(start + i, last)]
        sigma = complex(0.0, 0.0)
        if pair == M_THETA:
            put(W, X + 4, i, get(W, X + 4, i) + y * get(W, X + 2, i))
        else:
            a1, b1, a2, b2 = get(W, to, i), get(W, by, i), get(W, to2, i), get(W, by2, i)
            jumped1, jumped2 = a1 + y * b1, a2 + y * b2
            large = norm2(y * b2) > 16.0 * norm2(a2)
            divide = scaled(conj(jumped2), 1.0 / (norm2(jumped2) + TINY))
            sigma = pick(large, jumped1 * divide, sigma)
            put(W, to, i, pick(large, complex(0.0, 0.0), jumped1))
            put(W, by, i, pick(large, (b1 * a2 - b2 * a1) * divide, b1))
            put(W, X + 4, i, get(W, X + 4, i) - sigma * get(W, X + 10, i))
            put(W, to2, i, jumped2)
        put(W, B, i, complex(1.0, 0.0))
        put(W, B + 2, i, complex(0.0, 0.0))
        put(W, B + 4, i, -sigma)
        put(W, B + 6, i, complex(1.0, 0.0))
        W[SCALE * LANES + i] = 1.0
