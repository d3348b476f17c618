"""The beam element: coordinates [w1, theta1, w2, theta2] of two nodes, length h.

With shear (Timoshenko) the functions are the exact static ones, cubic in w and quadratic in
theta, coupled by phi = 12 EI/(GA h^2); phi = 0 leaves the cubics of Hermite with theta = w'
(Euler-Bernoulli). Both fields are continuous from element to element, so that natural
frequencies come out too high, never too low (Rayleigh-Ritz).
"""

import numpy as np

from samii_rig.types import Float

# Gauss-Legendre, exact to degree 7; the mass holds products of two cubics.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


def stiffness(EI: float, h: float, phi: float = 0.0) -> Float:
    """(4, 4) integral of EI theta'^2 + GA (w' - theta)^2; EI in N m^2, h in m."""
    a, b = (4 + phi) * h**2, (2 - phi) * h**2
    return (EI / h**3 / (1 + phi)) * np.array(
        [
            [12, 6 * h, -12, 6 * h],
            [6 * h, a, -6 * h, b],
            [-12, -6 * h, 12, -6 * h],
            [6 * h, b, -6 * h, a],
        ]
    )


def consistent_mass(mu: float, h: float, phi: float = 0.0, J: float = 0.0) -> Float:
    """(4, 4) integral of mu w^2 + J theta^2, mu in kg/m, J in kg m: no mass is lumped."""
    m = np.zeros((4, 4))
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        x = h * (1 + node) / 2
        w, theta = shape(x, h, phi), rotation(x, h, phi)
        m += h * weight / 2 * (mu * np.outer(w, w) + J * np.outer(theta, theta))
    return m


def tension(N: tuple[float, float], h: float, phi: float = 0.0) -> Float:
    """(4, 4) integral of N theta^2, N in N from node 1 to node 2: the geometric stiffness."""
    k = np.zeros((4, 4))
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        u = (1 + node) / 2
        theta = rotation(h * u, h, phi)
        k += h * weight / 2 * (N[0] + (N[1] - N[0]) * u) * np.outer(theta, theta)
    return k


def shape(x: float, h: float, phi: float = 0.0) -> Float:
    """(4,) the deflection at x m from node 1 for a unit of each coordinate."""
    u = x / h
    return np.array(
        [
            1 + phi - phi * u - 3 * u**2 + 2 * u**3,
            h * ((1 + phi / 2) * u - (2 + phi / 2) * u**2 + u**3),
            phi * u + 3 * u**2 - 2 * u**3,
            h * (u**3 - (1 - phi / 2) * u**2 - phi / 2 * u),
        ]
    ) / (1 + phi)


def rotation(x: float, h: float, phi: float = 0.0) -> Float:
    """(4,) the section's rotation there."""
    u = x / h
    return np.array(
        [
            6 * (u**2 - u) / h,
            1 + phi - (4 + phi) * u + 3 * u**2,
            6 * (u - u**2) / h,
            3 * u**2 - (2 - phi) * u,
        ]
    ) / (1 + phi)


def curvature(x: float, h: float, phi: float = 0.0) -> Float:
    """(4,) theta' there, 1/m a unit of each coordinate; its error falls with h^2."""
    u = x / h
    return np.array(
        [
            6 * (2 * u - 1) / h**2,
            (6 * u - 4 - phi) / h,
            6 * (1 - 2 * u) / h**2,
            (6 * u - 2 + phi) / h,
        ]
    ) / (1 + phi)
