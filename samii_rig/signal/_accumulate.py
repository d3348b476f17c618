"""The compiled inner loop of `samii_rig.signal.welch`."""

from __future__ import annotations

import numba
import numpy as np

from samii_rig.types import Complex, Float

STRIP = 512  # frequencies at a time: the sums of a strip stay in the first cache


def accumulate(X: Complex, total: Float) -> None:
    """Add X_i X_j^* of each frame to `total`.

    X : (c, frames, n_freq). total : (c^2, n_freq), for i = 0 ... c - 1 the power of i, then
    for each j > i the real and the imaginary part of X_i X_j^*.
    """
    _accumulate(X.view(np.float64), total)


@numba.njit(cache=True, fastmath=True, nogil=True)
def _accumulate(X: Float, total: Float) -> None:
    c, frames, doubled = X.shape
    n_freq = doubled // 2
    for first in range(0, n_freq, STRIP):
        last = min(first + STRIP, n_freq)
        for m in range(frames):
            row = 0
            for i in range(c):
                a = X[i, m]
                power = total[row]
                for k in range(first, last):
                    power[k] += a[2 * k] * a[2 * k] + a[2 * k + 1] * a[2 * k + 1]
                row += 1
                for j in range(i + 1, c):
                    b = X[j, m]
                    real, imag = total[row], total[row + 1]
                    for k in range(first, last):
                        real[k] += a[2 * k] * b[2 * k] + a[2 * k + 1] * b[2 * k + 1]
                        imag[k] += a[2 * k + 1] * b[2 * k] - a[2 * k] * b[2 * k + 1]
                    row += 2
