"""The most likely powers of disturbances, of which each is known to look alike in all sensors.

Whittle's likelihood of scatters S_b of w_b lines, C_b = sum_k p_k(b) u_k(b) u_k(b)^H,

    log L = - sum_b  w_b log det C_b + tr(C_b^-1 S_b),    p_k(b) = sum_c g_c(b) lambda_kc,

grows in multiplicative steps of lambda (Fevotte, Bertin and Durrieu 2009, Neural Comput. 21, eq.
2.11), each longer than the one before while it does (Salakhutdinov and Roweis 2003, Proc. ICML).
"""

from __future__ import annotations

import numba
import numpy as np

from samii_rig.types import Complex, Float

STEPS = 200  # at most: without progress they end before
PROGRESS = 0.02  # of the logarithm of the likelihood, gained by a step, that goes on
# Power of a multiplicative step that never lowers the likelihood, and by how much longer the next
# is: 55 steps lead as far as 200 that are all sure, and one in 15 comes back.
SURE_STEP, LONGER = 0.5, 1.2
LOUD = 1e-6  # of all, power of a component that counts
REGULAR = 1e-9  # of each sensor's own power, that keeps C regular


def most_likely(u: Complex, S: Complex, w: Float, g: Float, known: Float) -> Float:
    """(K, c) powers lambda, 0 of what is not `LOUD`.

    u : (b, q, K). S : (b, q, q) sums of w (b,) lines each. g : (b, c). known : (b, q) power that
    the first q of u have beside.
    """
    q, K = u.shape[1:]
    size = np.sum(np.abs(u) ** 2, axis=1)
    mean = (w @ size) / np.sum(w)
    power = np.repeat(q / np.where(mean > 0, mean, np.inf)[:, None], g.shape[1], axis=1)
    power /= K * g.shape[1] * np.mean(g, axis=0)
    A = _products(u)
    before, far = -np.inf, SURE_STEP
    last, change = power, np.ones_like(power)
    for _ in range(STEPS):
        p = g @ power.T
        p[:, :q] += known
        log, a, b = _pulls(A, S, w, p)
        if log < before:  # too far: from the same place, a step that is sure
            far = SURE_STEP if far > SURE_STEP else far / 2
            power = last * change**far
            continue
        if log - before < PROGRESS:
            break
        before, last = log, power
        down = b.T @ g
        change = np.divide(a.T @ g, down, out=np.zeros_like(power), where=down > 0)
        far *= LONGER
        power = last * change**far
    power = last
    share = power * ((w @ size)[:, None] / np.sum(w))
    return np.where(share > LOUD * np.sum(share), power, 0.0)


def _products(u: Complex) -> Float:
    """(b, q, q, K) of each u (b, q, K) the real part of u_i u_j* at (i, j), j <= i, and the
    imaginary part at (j, i)."""
    both = u[:, :, None, :] * u[:, None, :, :].conj()
    lower = np.tri(u.shape[1], dtype=bool)[None, :, :, None]
    return np.ascontiguousarray(np.where(lower, both.real, both.imag.swapaxes(1, 2)))


@numba.njit(cache=True, error_model="numpy")
def _inverted(C: Complex, L: Complex, own: Complex) -> float:
    """log det C of C (q, q), of which the lower half counts, and its inverse as own; L : room."""
    q, log = len(C), 0.0
    for i in range(q):  # C = L L^H
        C[i, i] *= 1 + REGULAR
        for j in range(i + 1):
            x = C[i, j]
            for k in range(j):
                x -= L[i, k] * L[j, k].conjugate()
            L[i, j] = np.sqrt(x.real) if i == j else x / L[j, j].real
        log += 2 * np.log(L[i, i].real)
    for j in range(q):  # L by its inverse
        L[j, j] = 1 / L[j, j].real
        for i in range(j + 1, q):
            x = 0j
            for k in range(j, i):
                x -= L[i, k] * L[k, j]
            L[i, j] = x / L[i, i].real
    for i in range(q):
        for j in range(q):
            x = 0j
            for k in range(max(i, j), q):
                x += L[k, i].conjugate() * L[k, j]
            own[i, j] = x
    return log


@numba.njit(cache=True, fastmath={"reassoc", "contract", "nsz"}, error_model="numpy")
def _pulls(A: Float, S: Complex, w: Float, p: Float) -> tuple[float, Float, Float]:
    """log L, and of each power (b, K) what lets it grow, u^H C^-1 S C^-1 u, and what holds it, w
    u^H C^-1 u. A : as `_products` has them. p : (b, K) powers."""
    n, q, _, K = A.shape
    grow, hold = np.zeros((n, K)), np.zeros((n, K))
    C, L = np.zeros((q, q), np.complex128), np.zeros((q, q), np.complex128)
    own, both = np.zeros((q, q), np.complex128), np.zeros((q, q), np.complex128)
    total = 0.0
    for b in range(n):
        for i in range(q):
            for j in range(i + 1):
                real, imag = 0.0, 0.0
                for k in range(K):
                    real += A[b, i, j, k] * p[b, k]
                if j < i:
                    for k in range(K):
                        imag += A[b, j, i, k] * p[b, k]
                C[i, j] = complex(real, imag)
        total -= w[b] * _inverted(C, L, own)
        for i in range(q):
            for j in range(q):
                x = 0j
                for k in range(q):
                    x += own[i, k] * S[b, k, j]
                C[i, j] = x
            total -= C[i, i].real
        for i in range(q):
            for j in range(i + 1):
                x = 0j
                for k in range(q):
                    x += C[i, k] * own[k, j]
                both[i, j] = x
        # Of Hermitian matrices M, u^H M u: each pair once.
        for i in range(q):
            for j in range(i + 1):
                times = 1.0 if i == j else 2.0
                x, y = times * both[i, j], times * w[b] * own[i, j]
                for k in range(K):
                    grow[b, k] += x.real * A[b, i, j, k]
                    hold[b, k] += y.real * A[b, i, j, k]
                if j < i:
                    for k in range(K):
                        grow[b, k] += x.imag * A[b, j, i, k]
                        hold[b, k] += y.imag * A[b, j, i, k]
    return total, grow, hold
