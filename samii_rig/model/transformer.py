"""Gears, spindles and bends: matrices in the form of `timoshenko.matrix`, and their gradients.

    gear      theta+ = theta-/n,   M+ = n M-
    spindle   w+ = lead theta-,    V+ = -M-/lead,    theta+ = w-,    M+ = -V-
    bend      w+ = across w-,      V+ = V-/across,   across the cosine of its angle

All keep the symplectic product. Behind a spindle theta and M are what w and V were before it,
which rest there as these rested.
"""

from __future__ import annotations

import numpy as np

from samii_rig.model.timoshenko import ROWS, SORT
from samii_rig.types import Complex, Float

_TURN = np.diag([1.0, -1.0, 1.0, -1.0])  # theta and V of a mirrored chain


def plain(kind: str, ratio: float) -> Float:
    """(4, 4) of a gear with n, a spindle with lead or a bend with across = `ratio`."""
    if kind == "gear":
        return np.diag([1.0, 1 / ratio, ratio, 1.0])
    if kind == "bend":
        return np.diag([ratio, 1.0, 1.0, 1 / ratio])
    U = np.zeros((4, 4))
    U[0, 1], U[3, 2], U[1, 0], U[2, 3] = ratio, -1 / ratio, 1.0, -1.0
    return U


def matrix(kind: str, s: Complex, p: Float) -> Complex:
    """(2, ROWS, n) for the kernel, forwards and mirrored."""
    U = plain(kind, p[0])
    out = np.zeros((2, ROWS, s.size), complex)
    for side, u in enumerate((U, _TURN @ np.linalg.inv(U) @ _TURN)):
        out[side, :16] = SORT.ravel()[:, None]
        out[side, 16:32] = (u @ SORT).ravel()[:, None]
    out[:, 32:] = 1.0
    return out


def gradient(kind: str, p: Float, z: Complex, zh: Complex) -> Complex:
    """(1, n, n_sensor, n_source) dy/d ratio at unit sources, -zh^T J dU z: zh behind, z before."""
    r = p[0]
    theta, M = (z[:, None, i, :] for i in (5, 6))
    w, turn, moment, V = (zh[:, i, :, None] for i in range(4))
    if kind == "gear":
        return np.asarray(moment * theta / r**2 + turn * M)[None]
    return np.asarray(V * theta - w * M / r**2)[None]
