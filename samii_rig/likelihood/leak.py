"""What a change of the response in a few nodes does to every line of a record's spectrum.

A change d(s) that is linear between nodes on a contour, under the damped input X, gives in the
plain DFT of samples h to h + n of a record (no window, k its line)

    E_k = 1/M sum_j d_j X_j (p^h - p^{h+n})/(1 - q),
    p = exp(sigma T + 2 pi j i/M),    q = p exp(-2 pi i k/n),

the sum over all lines j of the contour, those of negative frequency included.
"""

from __future__ import annotations

import numba
import numpy as np

from samii_rig.likelihood.contour import Contour
from samii_rig.types import Complex, Float, Int

BLOCK = 256  # lines at once: what is summed of one input is 16 kB


def columns(contour: Contour, X: Complex, nodes: Int, history: int, n: int, lines: Int) -> Complex:
    """Spectra (m, n_lines, 2 n_nodes) of a change of 1 in each node, then of 1j in each.

    X : (m, M//2 + 1) damped inputs. nodes : (n_nodes,) lines of the contour, increasing.
    history, n : of the records. lines : (n_lines,) of their DFT.
    """
    step = contour.sigma / contour.rate_hz
    out = np.zeros((X.shape[0], lines.size, 2 * nodes.size), complex)
    turn = 2 * np.pi / n * lines
    by = np.ascontiguousarray(X)
    _leak(step, contour.samples, by, nodes, history, n, np.cos(turn), -np.sin(turn), out)
    return out


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
    out: Complex,
) -> None:
    # Rows of one flat array at offsets known at compile time: only so does the compiler see that
    # they do not overlap, and divide four or eight at once.
    m, lines, b = X.shape[0], back_r.size, nodes.size
    W, sums = np.zeros(6 * BLOCK), np.zeros((m, 8 * BLOCK))
    for start in range(0, lines, BLOCK):
        size = min(BLOCK, lines - start)
        W[:size] = back_r[start : start + size]
        W[BLOCK : BLOCK + size] = back_i[start : start + size]
        for at in range(b - 1):
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
