"""Undamped modes and complex poles of a constrained mechanism, by the null space of Phi."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, eigh, eigvals, null_space

from samii_rig.errors import InputError
from samii_rig.types import Complex, Float

# Parts of the basis with less mass than this, relative, have none: rounding leaves 1e-16, the
# stiffest mode of a fine mesh 1e-6.
MASSLESS = 1e-12
# Time constants of massless parts shorter than this, times the frequency scale, are none.
INSTANT = 1e-12


@dataclass(frozen=True, slots=True)
class Modes:
    """Undamped modes, lowest first.

    omega : (n,) rad/s. shapes : (n_q, n) in all coordinates, modal masses 1 (SI).
    """

    omega: Float
    shapes: Float

    @property
    def frequency_hz(self) -> Float:
        """(n,) natural frequencies, Hz."""
        return np.asarray(self.omega / (2 * np.pi))


@dataclass(frozen=True, slots=True)
class Basis:
    """All motions that the constraints allow: `modes`, and `massless` (n_q, n_z) motions that
    store energy but have no mass (as between two springs), of unit stiffness. scale : rad^2/s^2,
    a squared frequency of the order of the highest modes, what rounding is relative to."""

    modes: Modes
    massless: Float
    scale: float


def basis(M: Float, K: Float, Phi: Float, where: str) -> Basis:
    """The solutions of (K - omega^2 M) x + Phi^T lambda = 0, Phi x = 0.

    Raises InputError, naming the rig `where`, if the constraints overdetermine the motion or
    something can move without mass and stiffness.
    """
    N = null_space(Phi) if Phi.shape[0] else np.eye(M.shape[0])
    if N.shape[1] != Phi.shape[1] - Phi.shape[0]:
        raise InputError.saying(where, "", "held twice in one direction; expected supports once")
    m, k = N.T @ M @ N, N.T @ K @ N
    if not m.size:
        return Basis(Modes(np.zeros(0), N), N, 1.0)
    # The inverse problem M x = mu (K + scale M) x bears rigid modes and massless parts alike.
    scale = float(np.trace(k) / np.trace(m)) if np.trace(m) > 0 and np.trace(k) > 0 else 1.0
    try:
        mu, X = eigh(m, k + scale * m)
    except LinAlgError as error:
        raise InputError.saying(
            where, "", "a part has neither mass nor stiffness; expected one of them"
        ) from error
    mu, X = mu[::-1], N @ X[:, ::-1]
    heavy = mu > MASSLESS * mu[0]
    omega = np.sqrt(np.maximum(1 / mu[heavy] - scale, 0.0))
    return Basis(Modes(omega, X[:, heavy] / np.sqrt(mu[heavy])), X[:, ~heavy], scale)


def poles(b: Basis, C: Float) -> Complex:
    """(n,) the roots s, rad/s, of s^2 M + s C + K on the basis, Im >= 0, by modulus.

    A massless part with damping adds a real root, one without none.
    """
    omega, F = b.modes.omega, b.modes.shapes
    c, turn = np.linalg.eigh(b.massless.T @ C @ b.massless)
    slow = c > INSTANT / np.sqrt(b.scale)
    c, Z = c[slow], (b.massless @ turn)[:, slow]
    Cf, Cfz = F.T @ C @ F, F.T @ C @ Z
    n, m = omega.size, c.size
    # States omega f, f', z:  f'' + Cf f' + Cfz z' + omega^2 f = 0,  c z' + Cfz^T f' + z = 0.
    A = np.zeros((2 * n + m, 2 * n + m))
    A[:n, n : 2 * n] = np.diag(omega)
    A[n : 2 * n, :n] = -np.diag(omega)
    A[n : 2 * n, n : 2 * n] = -Cf + (Cfz / c) @ Cfz.T
    A[n : 2 * n, 2 * n :] = Cfz / c
    A[2 * n :, n : 2 * n] = -Cfz.T / c[:, None]
    A[2 * n :, 2 * n :] = -np.diag(1 / c)
    s = np.asarray(eigvals(A), dtype=np.complex128)
    s = s[s.imag >= 0]
    return s[np.argsort(abs(s), kind="stable")]
