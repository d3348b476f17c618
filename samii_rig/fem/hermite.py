"""The cubic Euler-Bernoulli beam element: coordinates [w1, theta1, w2, theta2], length h."""

import numpy as np

from samii_rig.types import Float


def stiffness(EI: float, h: float) -> Float:
    """(4, 4) integral of EI N'' N''^T, N the functions of `shape`; EI in N m^2, h in m."""
    return (EI / h**3) * np.array(
        [
            [12, 6 * h, -12, 6 * h],
            [6 * h, 4 * h**2, -6 * h, 2 * h**2],
            [-12, -6 * h, 12, -6 * h],
            [6 * h, 2 * h**2, -6 * h, 4 * h**2],
        ]
    )


def consistent_mass(mu: float, h: float) -> Float:
    """(4, 4) integral of mu N N^T, mu in kg/m: no mass is added or lumped, so that natural
    frequencies come out too high, never too low (Rayleigh-Ritz)."""
    return (mu * h / 420) * np.array(
        [
            [156, 22 * h, 54, -13 * h],
            [22 * h, 4 * h**2, 13 * h, -3 * h**2],
            [54, 13 * h, 156, -22 * h],
            [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
        ]
    )


def shape(x: float, h: float) -> Float:
    """(4,) the deflection at x m from node 1 for a unit of each coordinate."""
    u = x / h
    return np.array(
        [
            1 - 3 * u**2 + 2 * u**3,
            h * (u - 2 * u**2 + u**3),
            3 * u**2 - 2 * u**3,
            h * (u**3 - u**2),
        ]
    )
