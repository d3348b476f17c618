"""The rod element: displacements at four even nodes, length h, cubic between them."""

import numpy as np

from samii_rig.types import Float

NODES = 4
_AT = np.linspace(-1.0, 1.0, NODES)
# Gauss-Legendre, exact to degree 7; the mass holds products of two cubics.
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(4)


def _shapes() -> tuple[Float, Float]:
    """Values and slopes (by -1 to 1) of the nodes' functions at the points, (point, node)."""
    values, slopes = np.zeros((4, NODES)), np.zeros((4, NODES))
    for i, node in enumerate(_AT):
        others = np.delete(_AT, i)
        poly = np.polynomial.Polynomial.fromroots(others) / np.prod(node - others)
        values[:, i], slopes[:, i] = poly(_POINTS), poly.deriv()(_POINTS)
    return values, slopes


_VALUES, _SLOPES = _shapes()


def stiffness(EA: float, h: float) -> Float:
    """(4, 4) integral of EA w'^2; EA in N, h in m."""
    return np.asarray(2 * EA / h * np.einsum("p,pi,pj->ij", _WEIGHTS, _SLOPES, _SLOPES))


def consistent_mass(mu: float, h: float) -> Float:
    """(4, 4) integral of mu w^2, mu in kg/m."""
    return np.asarray(mu * h / 2 * np.einsum("p,pi,pj->ij", _WEIGHTS, _VALUES, _VALUES))
