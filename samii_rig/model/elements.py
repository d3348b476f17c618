"""The plain 5x5 transfer matrix of each element, as the papers write them.

State vector z = [w, theta, M, V, 1] (paper 2, eq. 8); a matrix carries it from the
upstream to the downstream side of its element. These are for reading, for tests and as
the benchmark's peer. Their product loses all digits on a long beam at high frequency
(cosh and sinh cancel); `samii_rig.model.tmm` gives the same response without that.

Paper 1 is "Two Competing Linear Models for Flexible Robots", paper 2 "Transfer Matrix
Modelling of Hydraulically Actuated Flexible Robots" (both Krauss, Book, Bruels).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from samii_rig.errors import InputError
from samii_rig.model.laws import POINTS, SOURCE_LAWS
from samii_rig.model.transformer import plain
from samii_rig.rig.schema import (
    MOTION_SOURCES,
    SOURCES,
    AccelerationSource,
    Beam,
    Bend,
    Branch,
    Element,
    ForceSource,
    Gear,
    LumpedMass,
    RigidLink,
    Rod,
    Spindle,
    TimoshenkoBeam,
    TorqueSource,
    TorsionalSpring,
    parameters,
)
from samii_rig.types import Complex, Float

# w V^ - V w^ - theta M^ + M theta^ is the same on both sides of every element without a
# source: U^T J U = J for the leading 4x4 block.
J: NDArray[np.float64] = np.array(
    [
        [0.0, 0.0, 0.0, 1.0],
        [0.0, 0.0, -1.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [-1.0, 0.0, 0.0, 0.0],
    ]
)


def _identity(s: Complex) -> Complex:
    return np.broadcast_to(np.eye(5, dtype=complex), (*s.shape, 5, 5)).copy()


def beam_matrix(
    s: Complex, EI: float, mu: float, L: float, eta: float = 0.0, tau: float = 0.0
) -> Complex:
    """Euler-Bernoulli beam (paper 1, eq. 1-9), shape (..., 5, 5) for s of shape (...).

    Stiffness EI (1 + j eta + s tau), N m^2; mu in kg/m, L in m. At Im s < 0 the loss
    factor changes sign, so that the response of a real input is real. beta^4 is
    -mu s^2 L^4 / EI (eq. 2 with s = j omega); the entries are the four functions
    (cosh +- cos)/2, (sinh +- sin)/2 of beta, divided by the power of beta that makes
    each even in it. They need beta != 0.
    """
    s = np.asarray(s, dtype=complex)
    stiffness = EI * (1 + 1j * eta * np.where(s.imag < 0, -1.0, 1.0) + s * tau)
    q = -mu * s**2 * L**4 / stiffness
    beta = np.sqrt(np.sqrt(q))
    c0 = (np.cosh(beta) + np.cos(beta)) / 2
    c1 = (np.sinh(beta) + np.sin(beta)) / (2 * beta)
    c2 = (np.cosh(beta) - np.cos(beta)) / (2 * beta**2)
    c3 = (np.sinh(beta) - np.sin(beta)) / (2 * beta**3)
    a = L**2 / stiffness  # paper 1, eq. (5)
    U = _identity(s)
    U[..., 0, 0] = U[..., 1, 1] = U[..., 2, 2] = U[..., 3, 3] = c0
    U[..., 0, 1] = U[..., 2, 3] = L * c1
    U[..., 1, 2] = a / L * c1
    U[..., 0, 2] = U[..., 1, 3] = a * c2
    U[..., 0, 3] = a * L * c3
    U[..., 1, 0] = U[..., 3, 2] = q * c3 / L
    U[..., 2, 0] = U[..., 3, 1] = q * c2 / a
    U[..., 2, 1] = L / a * q * c3
    U[..., 3, 0] = q * c1 / (a * L)
    return U


def rigid_link_matrix(s: Complex, L: float, r: float, m: float, I: float) -> Complex:  # noqa: E741
    """Rigid body (the R of paper 1, eq. 11), shape (..., 5, 5).

    L in m, centre of gravity r m from the upstream end, m in kg, I in kg m^2 about the
    centre of gravity. The centre's force A = m s^2 (w + r theta) gives V1 = V0 - A and
    M1 = M0 + L V0 - (L - r) A + I s^2 theta.
    """
    s = np.asarray(s, dtype=complex)
    U = _identity(s)
    U[..., 0, 1] = U[..., 2, 3] = L
    U[..., 2, 0] = -(L - r) * m * s**2
    U[..., 2, 1] = (I - (L - r) * r * m) * s**2
    U[..., 3, 0] = -m * s**2
    U[..., 3, 1] = -m * r * s**2
    return U


def torsional_spring_matrix(s: Complex, k: float, c: float = 0.0) -> Complex:
    """Torsional spring and damper, theta+ = theta- + M/(c s + k), shape (..., 5, 5).

    Paper 1, eq. (10), with the damper of paper 2, eq. (7); k in N m/rad, c in N m s/rad.
    """
    s = np.asarray(s, dtype=complex)
    U = _identity(s)
    U[..., 1, 2] = 1 / (c * s + k)
    return U


def angular_velocity_source_matrix(s: Complex, K: float, p: float) -> Complex:
    """Angular velocity source at unit input, theta+ = theta- + K p/(s (s + p)).

    Paper 2, eq. (1) and the last column of eq. (7), shape (..., 5, 5); K in rad/s per unit
    of the input, p in rad/s.
    """
    s = np.asarray(s, dtype=complex)
    U = _identity(s)
    U[..., 1, 4] = K * p / (s * (s + p))
    return U


def timoshenko_matrix(
    s: Complex, EI: float, mu: float, L: float, eta: float, tau: float, GA: float, J: float
) -> Complex:
    """exp(A L) of the beam of `schema.TimoshenkoBeam`, shape (..., 5, 5)."""
    s = np.asarray(s, dtype=complex)
    g = 1 + 1j * eta * np.where(s.imag < 0, -1.0, 1.0) + s * tau
    A = np.zeros((*s.shape, 4, 4), complex)
    A[..., 0, 1] = A[..., 2, 3] = 1.0
    A[..., 0, 3] = -1 / (GA * g)
    A[..., 1, 2] = 1 / (EI * g)
    A[..., 2, 1] = J * s**2
    A[..., 3, 0] = -mu * s**2
    U = _identity(s)
    U[..., :4, :4] = expm(A * L)
    return U


def rod_matrix(s: Complex, EA: float, mu: float, L: float, tau: float = 0.0) -> Complex:
    """Rod along itself, w' = -V/(EA (1 + s tau)), V' = -mu s^2 w, shape (..., 5, 5)."""
    s = np.asarray(s, dtype=complex)
    stiffness = EA * (1 + s * tau)
    lam = np.sqrt(mu * s**2 / stiffness)
    U = _identity(s)
    U[..., 0, 0] = U[..., 3, 3] = np.cosh(lam * L)
    U[..., 0, 3] = -np.sinh(lam * L) / (stiffness * lam)
    U[..., 3, 0] = -np.sinh(lam * L) * stiffness * lam
    return U


# Rows and columns of the pairs of `laws`, and the rows and signs of the sources' jumps.
_PLACES = ((1, 2), (0, 3), (2, 1), (3, 0))


def point_matrix(kind: str, s: Complex, p: Float) -> Complex:
    """Any point element of `laws` with parameters p, shape (..., 5, 5)."""
    s = np.asarray(s, dtype=complex)
    U = _identity(s)
    law = POINTS[kind]
    U[(..., *_PLACES[law.pair])] = law.value(s.ravel(), p).reshape(s.shape)
    return U


def branch_matrix(branch: Branch, s: Complex) -> Complex:
    """M and V lose what the side chain takes at its root, moved by w and theta, (..., 5, 5)."""
    s = np.asarray(s, dtype=complex)
    whole = _identity(s)
    for element in branch.element:
        whole = matrix(element, s) @ whole
    zero = {"clamped": [0, 1], "pinned": [0, 2], "free": [2, 3]}[branch.tip]
    rows = whole[..., zero, :]
    U = _identity(s)
    U[..., 2:4, :2] = np.linalg.solve(rows[..., 2:4], rows[..., :2])
    return U


def matrix(element: Element, s: Complex) -> Complex:
    """The (..., 5, 5) matrix of any element of a rig file at s, rad/s.

    A line's source has no line in it here: it lets all of its flow through.

    Raises InputError for a kind of element that has no such matrix.
    """
    p = {symbol: parameter.value for symbol, parameter in parameters(element).items()}
    match element:
        case Beam():
            return beam_matrix(s, **p)
        case TimoshenkoBeam():
            return timoshenko_matrix(s, **p)
        case RigidLink():
            return rigid_link_matrix(s, **p)
        case LumpedMass():
            return rigid_link_matrix(s, 0.0, 0.0, **p)
        case TorsionalSpring():
            return torsional_spring_matrix(s, **p)
        case Rod():
            return rod_matrix(s, **p)
        case Bend():
            expected = "none by itself: its matrix holds the mass of what lies beyond"
            raise InputError("element", element.name, element.kind, expected)
        case Gear() | Spindle():
            U = _identity(np.asarray(s, dtype=complex))
            U[..., :4, :4] = plain(element.kind, *p.values())
            return U
        case Branch():
            return branch_matrix(element, s)
    if not isinstance(element, SOURCES):
        return point_matrix(element.kind, s, np.array([*p.values()]))
    s = np.asarray(s, dtype=complex)
    values = [*p.values()]
    if isinstance(element, TorqueSource | ForceSource) and element.p is None:
        values.insert(1, np.inf)
    if isinstance(element, AccelerationSource) and element.omega is None:
        values[1:1] = element.suspension
    jump = SOURCE_LAWS[element.kind].value(s.ravel(), np.array(values)).reshape(s.shape)
    row, sign = {"torque_source": (2, -1.0), "force_source": (3, 1.0)}.get(element.kind, (1, 1.0))
    row = 0 if isinstance(element, MOTION_SOURCES) else row
    U = _identity(s)
    U[..., row, 4] = sign * element.K.value * jump
    return U
