"""The local polynomial method with several references: one record of anything, leakage removed.

Around each frequency f0, with x = (f - f0)/W over the lines of a window and R_k the references,

    Z(f) = sum_k G_k(x) R_k(f) + T_i(x) + noise,        Z = [V; Y],

G_k polynomials of degree 2, T_i one for each record i: what it starts and ends with (Pintelon and
Schoukens, 2nd ed., section 7.2.2; Schoukens, Vandersteen, Barbe and Pintelon, 2009). Then
H = G_y(0) G_v(0)^-1, as many references as inputs, which has no bias in closed loop, and
E[dH dH^H] = N x Q Q^H with N the covariance of e = Y - H V and Q the solution's own part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from samii_rig.errors import EstimateError
from samii_rig.signal.several import solve
from samii_rig.signal.spectra import Spectrum
from samii_rig.types import Complex, Float, Int

DEGREE = 2  # of G_k and of T
FREE = 16  # complex degrees of freedom of a window's residual at least, 4 for each output
INPUTS_CHUNK = 256  # windows at a time: some MB of matrices
# Ratio of singular values of the regressors below which two references do the same in a window.
LEAST_LEFT = 1e-4


@dataclass(frozen=True, slots=True)
class Fit:
    """H (n_freq, n_out, n_in); covariance (n_freq, p, p); noise (n_freq, n_out) power of e at a
    line; output (n_freq, n_out) : mean power at the lines of the window; apart (n_freq,) whether
    the references differ there; dof of a column; rows : lines of one window."""

    H: Complex
    covariance: Complex
    noise: Float
    output: Float
    apart: NDArray[np.bool_]
    dof: float
    rows: int


def fit(spectra: Sequence[Spectrum], at: Int, n_in: int, *, at_rest: bool) -> Fit:
    """Local polynomial fit at the lines `at` of records of one length.

    spectra : Z holds n_in references, n_in inputs and the outputs side by side. at_rest : whether
        the records start and end at rest, so that there is nothing to remove.

    Raises EstimateError if the records have too few lines for a local model.
    """
    n_lines, q = spectra[0].Z.shape
    n_out = q - 2 * n_in
    pieces = len(spectra)
    unknown = (DEGREE + 1) * (n_in + (0 if at_rest else pieces))
    free = max(FREE, 4 * n_out)
    # Three times as many lines as a record has coefficients of its own transient.
    width = max(-(-(free + unknown) // pieces), 0 if at_rest else 3 * (DEGREE + 1))
    width += 1 - width % 2
    if width > n_lines:
        raise EstimateError(
            f"{n_lines} lines are too few for local models of {n_in} references; a longer "
            "record would do"
        )
    Z = np.stack([s.Z for s in spectra])
    parts = [
        _windows(Z, at[k : k + INPUTS_CHUNK], width, n_in, at_rest)
        for k in range(0, at.size, INPUTS_CHUNK)
    ]
    joined = [np.concatenate([p[k] for p in parts]) for k in range(5)]
    dof = float(pieces * width - unknown)
    H, covariance, noise, output, apart = joined
    return Fit(H, covariance, noise.real, output.real, apart.real > 0, dof, width)


def _windows(Z: Complex, at: Int, width: int, n_in: int, at_rest: bool) -> tuple[Complex, ...]:
    pieces, n_lines, _ = Z.shape
    start = np.clip(at - width // 2, 0, n_lines - width)
    rows = start[:, None] + np.arange(width)
    x = (rows - at[:, None]) / (width / 2)
    near = Z[:, rows].transpose(1, 0, 2, 3)  # (n_freq, piece, line, q)
    powers = x[:, None, :, None] ** np.arange(DEGREE + 1)
    R = near[..., :n_in]
    by_reference = (R[..., None] * powers[:, :, :, None, :]).reshape(*R.shape[:3], -1)
    blocks = [by_reference]
    if not at_rest:
        own = np.eye(pieces)[None, :, None, :, None] * powers[:, :, :, None, :]
        every = np.broadcast_to(own, (len(at), *own.shape[1:]))
        blocks.append(every.reshape(*R.shape[:3], -1).astype(complex))
    X = np.concatenate(blocks, axis=3).reshape(len(at), pieces * width, -1)
    size = np.sqrt(np.mean(np.abs(X) ** 2, axis=1, keepdims=True))
    unit = X / np.where(size > 0, size, 1.0)
    target = near[..., n_in:].reshape(len(at), pieces * width, -1)
    left, singular, right = np.linalg.svd(unit, full_matrices=False)
    apart = singular[:, -1] > LEAST_LEFT * singular[:, 0]
    kept = np.maximum(singular, LEAST_LEFT * singular[:, :1])[:, :, None]
    back = right.conj().transpose(0, 2, 1)
    inverse = back @ (left.conj().transpose(0, 2, 1) / kept)
    B = inverse @ target
    rest = target - unit @ B
    value = np.arange(n_in) * (DEGREE + 1)  # the coefficients of x^0
    scale = size[:, 0, value]
    G = B[:, value].transpose(0, 2, 1) / scale[:, None, :]
    H, A = _joint(G, n_in, apart)
    e = rest[..., n_in:] - rest[..., :n_in] @ H.transpose(0, 2, 1)
    dof = pieces * width - X.shape[2]
    N = e.transpose(0, 2, 1) @ e.conj() / dof
    Q = (inverse[:, value] / scale[:, :, None]).transpose(0, 2, 1) @ A
    power = np.mean(np.abs(target[..., n_in:]) ** 2, axis=1)
    noise = np.diagonal(N, axis1=1, axis2=2)
    parts = (H, solve.covariance(N, Q), noise, power, apart)
    return tuple(np.asarray(x, complex) for x in parts)


def _joint(G: Complex, n_in: int, apart: NDArray[np.bool_]) -> tuple[Complex, Complex]:
    """H and G_v^-1 from G (n_freq, n_in + n_out, n_in); of no meaning where not `apart`."""
    size = np.linalg.norm(G[:, :n_in], axis=2, keepdims=True)
    if not np.all(size > 0):
        raise EstimateError("an input follows none of the references; expected one for each input")
    unit = np.where(apart[:, None, None], G[:, :n_in] / size, np.eye(n_in))
    A = np.linalg.inv(unit) / size.transpose(0, 2, 1)
    return np.asarray(G[:, n_in:] @ A), np.asarray(A)
