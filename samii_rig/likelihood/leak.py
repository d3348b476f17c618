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
from samii_rig.types import Complex, Int


def columns(
    contour: Contour, X: Complex, nodes: Int, history: int, n: int, lines: Int
) -> tuple[Complex, Complex]:
    """Spectra (m, n_lines, n_nodes) of a change of 1, and of 1j, in each node.

    X : (m, M//2 + 1) damped inputs. nodes : (n_nodes,) lines of the contour, increasing.
    history, n : of the records. lines : (n_lines,) of their DFT.
    """
    step = contour.sigma / contour.rate_hz
    shape = (X.shape[0], nodes.size, lines.size)
    up, down = np.zeros(shape, complex), np.zeros(shape, complex)
    back = np.exp(-2j * np.pi * lines / n)
    _leak(step, contour.samples, np.ascontiguousarray(X), nodes, history, n, back, up, down)
    up, down = up.swapaxes(1, 2), down.swapaxes(1, 2)
    return up + down, 1j * (up - down)


@numba.njit(cache=True, fastmath=True)
def _leak(
    step: float,
    M: int,
    X: Complex,
    nodes: Int,
    history: int,
    n: int,
    back: Complex,
    up: Complex,
    down: Complex,
) -> None:
    for at in range(nodes.size - 1):
        first, last = nodes[at], nodes[at + 1]
        end = last + 1 if at == nodes.size - 2 else last
        for j in range(first, end):
            right = (j - first) / (last - first)
            p = np.exp(complex(step, 2 * np.pi * j / M))
            whole = np.exp(history * complex(step, 2 * np.pi * j / M))
            whole -= np.exp((history + n) * complex(step, 2 * np.pi * j / M))
            whole /= M
            for i in range(back.size):
                plus = 1 / (1 - p * back[i])
                minus = 1 / (1 - p.conjugate() * back[i])
                for m in range(X.shape[0]):
                    x = X[m, j] * whole
                    a, b = x * plus, x.conjugate() * minus if j > 0 else 0j
                    up[m, at, i] += (1 - right) * a
                    up[m, at + 1, i] += right * a
                    down[m, at, i] += (1 - right) * b
                    down[m, at + 1, i] += right * b
