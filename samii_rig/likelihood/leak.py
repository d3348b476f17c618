"""What a change of the response in a few nodes does to every line of a record's spectrum.

A change d(s) that is linear between nodes on a contour, under the damped input X, gives in the
plain DFT of samples h to h + n of a record (no window, k its line)

    E_k = 1/M sum_j d_j X_j (p^h - p^{h+n})/(1 - q),
    p = exp(sigma T + 2 pi j i/M),    q = p exp(-2 pi i k/n),

the sum over all lines j of the contour, those of negative frequency included.

Between nodes that are far from a block of lines the sum is smooth over the block: it is computed at
a few Chebyshev points, and a polynomial through these gives the block's lines.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from samii_rig.likelihood.contour import Contour
from samii_rig.types import Complex, Float, Int

BLOCK = 256  # lines at once: what is summed of one input is 16 kB
# What lies `FAR` half widths of a block from its middle, or further, does to the block's lines what
# a polynomial through so many Chebyshev points says, to (2 + sqrt(3))^-16 = 7e-10.
FAR, POINTS = 2.0, 16


def columns(contour: Contour, X: Complex, nodes: Int, history: int, n: int, lines: Int) -> Complex:
    """Spectra (m, n_lines, 2 n_nodes) of a change of 1 in each node, then of 1j in each.

    X : (m, M//2 + 1) damped inputs. nodes : (n_nodes,) lines of the contour, increasing.
    history, n : of the records. lines : (n_lines,) of their DFT, increasing.
    """
    if not lines.size:
        return np.zeros((X.shape[0], 0, 2 * nodes.size), complex)
    step, by = contour.sigma / contour.rate_hz, np.ascontiguousarray(X)
    turn = np.asarray(lines * (2 * np.pi / n), np.float64)

    def summed(turn: Float, of: Int, wanted: NDArray[np.bool_]) -> Complex:
        out = np.zeros((X.shape[0], turn.size, 2 * nodes.size), complex)
        back = np.cos(turn), -np.sin(turn)
        _leak(step, contour.samples, by, nodes, history, n, *back, of, wanted, out)
        return out

    of = np.arange(lines.size) // BLOCK
    ends = [(own[0], own[-1]) for own in np.split(turn, range(BLOCK, lines.size, BLOCK))]
    middle, half = np.array([[(a + b) / 2, (b - a) / 2] for a, b in ends]).T
    each = np.asarray(nodes * (2 * np.pi / contour.samples), np.float64)
    far = _far(each, middle, half)
    out = summed(turn, of, ~far)
    if far.any():
        points = np.cos((np.arange(POINTS) + 0.5) * (np.pi / POINTS))
        at = (middle[:, None] + half[:, None] * points).ravel()
        few = summed(at, np.repeat(np.arange(middle.size), POINTS), far)
        for i in np.flatnonzero(far.any(axis=1)):  # a block of one line has none
            on = slice(i * BLOCK, (i + 1) * BLOCK)
            own = few[:, i * POINTS : (i + 1) * POINTS]
            out[:, on] += _through(points, (turn[on] - middle[i]) / half[i]) @ own
    return out


def _far(nodes: Float, middle: Float, half: Float) -> NDArray[np.bool_]:
    """(blocks, intervals) whether what is between two of the nodes (b,), rad a sample, and of the
    negative frequencies, is far from all lines of a block."""
    low, high = nodes[:-1], nodes[1:]
    m, reach = middle[:, None], FAR * half[:, None]
    mirrored = np.minimum(m + low, 2 * np.pi - m - high)
    return ((low - m > reach) | (m - high > reach)) & (mirrored > reach) & (half[:, None] > 0)


def _through(points: Float, x: Float) -> Float:
    """(n, POINTS) weights of values at Chebyshev points for those of their polynomial at x (n,)
    (barycentric formula; Berrut and Trefethen 2004, SIAM Review 46)."""
    weight = (-1.0) ** np.arange(POINTS) * np.sqrt(1 - points**2)
    off = x[:, None] - points
    there = np.abs(off) < 1e-14
    parts = weight / np.where(there, 1.0, off)
    parts /= np.sum(parts, axis=1, keepdims=True)
    return np.asarray(np.where(np.any(there, axis=1, keepdims=True), there, parts), np.float64)


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _leak(
    step: float,
    M: int,
    X: Complex,
    nodes: Int,
    history: int,
    n: int,
    back_r: Float,
    back_i: Float,
    of: Int,
    wanted: NDArray[np.bool_],
    out: Complex,
) -> None:
    # Rows of one flat array at offsets known at compile time: only so does the compiler see that
    # they do not overlap, and divide four or eight at once.
    m, lines, b = X.shape[0], back_r.size, nodes.size
    W, sums = np.zeros(6 * BLOCK), np.zeros((m, 8 * BLOCK))
    for start in range(0, lines, BLOCK):
        size = min(BLOCK, lines - start)
        # One by one: for slices numba compiles the words of their shapes' error too, 4 s.
        for i in range(size):
            W[i], W[BLOCK + i] = back_r[start + i], back_i[start + i]
        rows = of[start], of[start + size - 1] + 1
        for at in range(b - 1):
            if not np.any(wanted[rows[0] : rows[1], at]):
                continue
            first, last = nodes[at], nodes[at + 1]
            end = last + 1 if at == b - 2 else last
            sums[:] = 0.0
            for j in range(first, end):
                right = (j - first) / (last - first)
                turn = complex(step, 2 * np.pi * j / M)  # of a sample
                p = np.exp(turn)
                whole = (np.exp(history * turn) - np.exp((history + n) * turn)) / M
                _poles(W, p.real, p.imag)
                for k in range(m):
                    w = X[k, j] * whole
                    mirrored = w.conjugate() if j > 0 else 0j
                    _add(sums[k], W, w.real, w.imag, mirrored.real, mirrored.imag, right)
            for k in range(m):
                own = sums[k]
                for i in range(size):
                    if not wanted[of[start + i], at]:
                        continue
                    up = complex(own[i], own[BLOCK + i])
                    behind = complex(own[2 * BLOCK + i], own[3 * BLOCK + i])
                    down = complex(own[4 * BLOCK + i], own[5 * BLOCK + i])
                    below = complex(own[6 * BLOCK + i], own[7 * BLOCK + i])
                    row = out[k, start + i]
                    row[at] += (up - behind) + (down - below)
                    row[b + at] += 1j * ((up - behind) - (down - below))
                    row[at + 1] += behind + below
                    row[b + at + 1] += 1j * (behind - below)


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _poles(W: Float, pr: float, pi: float) -> None:
    """1/(1 - p b) to rows 2 and 3 of W, 1/(1 - p* b) to rows 4 and 5, of b in rows 0 and 1."""
    for i in range(BLOCK):
        rr, ii = pr * W[i], pi * W[BLOCK + i]
        ri, ir = pr * W[BLOCK + i], pi * W[i]
        x, y = 1 - rr + ii, ri + ir
        over = 1 / (x * x + y * y)
        W[2 * BLOCK + i] = x * over
        W[3 * BLOCK + i] = y * over
        x, y = 1 - rr - ii, ri - ir
        over = 1 / (x * x + y * y)
        W[4 * BLOCK + i] = x * over
        W[5 * BLOCK + i] = y * over


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _add(
    sums: Float,
    W: Float,
    re: float,
    im: float,
    mirrored_re: float,
    mirrored_im: float,
    right: float,
) -> None:
    """What a line of the contour does, and its part in the node to the right, to rows of sums."""
    for i in range(BLOCK):
        a = re * W[2 * BLOCK + i] - im * W[3 * BLOCK + i]
        b = re * W[3 * BLOCK + i] + im * W[2 * BLOCK + i]
        sums[i] += a
        sums[BLOCK + i] += b
        sums[2 * BLOCK + i] += right * a
        sums[3 * BLOCK + i] += right * b
        a = mirrored_re * W[4 * BLOCK + i] - mirrored_im * W[5 * BLOCK + i]
        b = mirrored_re * W[5 * BLOCK + i] + mirrored_im * W[4 * BLOCK + i]
        sums[4 * BLOCK + i] += a
        sums[5 * BLOCK + i] += b
        sums[6 * BLOCK + i] += right * a
        sums[7 * BLOCK + i] += right * b
