"""Residues as shape times participation: with several inputs every mode has one shape.

The model's residues R_m (n_out, n_in) are free. A mode's is shape times participation, of rank
one, and with several inputs that is a constraint. The estimate under it is the nearest point that
fulfils it in the metric of the free estimate's information (asymptotically the constrained
maximum likelihood), for all modes and their poles at once; with one input it changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.modal.rational import Rational
from samii_rig.types import Complex, Float

NEWTON_STEPS = 20  # of Gauss-Newton; three are usual
SETTLED = 1e-10  # relative step at which it ends


@dataclass(frozen=True, slots=True)
class Factored:
    """One mode.

    pole : over the model's scale. pole_covariance : (2, 2) of its real and imaginary part.
    shape : (n_out,) 1 at `reference`. shape_covariance : (n_out, 2, 2).
    participation : (n_in,); shape times it is the residue.
    """

    pole: complex
    pole_covariance: Float
    shape: Complex
    shape_covariance: Float
    participation: Complex
    reference: int


def factored(model: Rational, pairs: Sequence[int], n_in: int) -> tuple[Factored, ...]:
    """Pole, shape and participation of these pairs of the model, each with its covariance."""
    if not pairs:
        return ()
    at = np.concatenate([_places(model, m) for m in pairs])
    C = model.covariance[np.ix_(at, at)]
    R = model.residues()
    p = R.shape[0]
    x = np.concatenate([_stacked(model.pairs[m], R[:, m]) for m in pairs])
    size = np.sqrt(np.diag(C))
    metric = np.linalg.inv(C / np.outer(size, size)) / np.outer(size, size)
    starts = [_start(R[:, m].reshape(-1, n_in), size[2 + k * (2 + 2 * p) :][: 2 * p])
              for k, m in enumerate(pairs)]  # fmt: skip
    y = [(complex(model.pairs[m]), *start) for m, start in zip(pairs, starts, strict=True)]
    for _ in range(NEWTON_STEPS if n_in > 1 else 0):
        J, now = _map(y)
        N = J.T @ metric @ J
        step = np.linalg.solve(N, J.T @ metric @ (x - now))
        y = _moved(y, step)
        if np.max(np.abs(J @ step) / size) < SETTLED * np.max(np.abs(x) / size):
            break
    J, _ = _map(y)
    V = np.linalg.inv(J.T @ metric @ J)
    out, first = [], 0
    for pole, psi, L, ref_in in y:
        count = 2 + 2 * psi.size + 2 * (L.size - 1)
        own = V[first : first + count, first : first + count]
        out.append(_one(pole, psi, L, own, ref_in))
        first += count
    return tuple(out)


Part = tuple[complex, Complex, Complex, int]
"""Pole, psi (n_out), L (n_in, 1 at an input) and which input that is."""


def _places(model: Rational, m: int) -> np.ndarray:
    """Where pole and residues of pair m stand in the covariance."""
    p, f = model.coefficients.shape
    residues = model.n_poles + f * np.arange(p)[:, None] + np.array([2 * m, 2 * m + 1])
    return np.concatenate([[2 * m, 2 * m + 1], residues.ravel()])


def _stacked(pole: complex, residues: Complex) -> Float:
    z = np.concatenate([[pole], residues])
    return np.stack([z.real, z.imag], axis=1).ravel()


def _start(R: Complex, sd: Float) -> tuple[Complex, Complex, int]:
    """psi and L of the best rank-one matrix, in rough units of the noise."""
    noise = sd.reshape(R.shape[0], R.shape[1], 2).mean(axis=2)
    rows, columns = noise.mean(axis=1), noise.mean(axis=0)
    U, S, V = np.linalg.svd(R / np.outer(rows, columns))
    ref_in = int(np.argmax(np.abs(V[0])))
    L = V[0] * columns
    return U[:, 0] * S[0] * rows * L[ref_in], L / L[ref_in], ref_in


def _map(y: Sequence[Part]) -> tuple[Float, Float]:
    """Jacobian of poles and residues by the parameters, and their values."""
    blocks, values = [], []
    for pole, psi, L, ref_in in y:
        n_out, n_in = psi.size, L.size
        free = [j for j in range(n_in) if j != ref_in]
        D = np.zeros((1 + n_out * n_in, 1 + n_out + len(free)), dtype=np.complex128)
        D[0, 0] = 1
        for o in range(n_out):
            for j in range(n_in):
                D[1 + o * n_in + j, 1 + o] = L[j]
                if j != ref_in:
                    D[1 + o * n_in + j, 1 + n_out + free.index(j)] = psi[o]
        blocks.append(_real(D))
        values.append(_stacked(pole, np.outer(psi, L).ravel()))
    height, width = sum(b.shape[0] for b in blocks), sum(b.shape[1] for b in blocks)
    J, row, column = np.zeros((height, width)), 0, 0
    for b in blocks:
        J[row : row + b.shape[0], column : column + b.shape[1]] = b
        row, column = row + b.shape[0], column + b.shape[1]
    return J, np.concatenate(values)


def _real(D: Complex) -> Float:
    """A complex linear map on real and imaginary parts by turns."""
    out = np.empty((2 * D.shape[0], 2 * D.shape[1]))
    out[0::2, 0::2], out[0::2, 1::2] = D.real, -D.imag
    out[1::2, 0::2], out[1::2, 1::2] = D.imag, D.real
    return out


def _moved(y: Sequence[Part], step: Float) -> list[Part]:
    z = step[0::2] + 1j * step[1::2]
    out, first = [], 0
    for pole, psi, L, ref_in in y:
        n_out, n_in = psi.size, L.size
        free = [j for j in range(n_in) if j != ref_in]
        moved = L.copy()
        moved[free] += z[first + 1 + n_out : first + 1 + n_out + len(free)]
        out.append((pole + z[first], psi + z[first + 1 : first + 1 + n_out], moved, ref_in))
        first += 1 + n_out + len(free)
    return out


def _one(pole: complex, psi: Complex, L: Complex, V: Float, ref_in: int) -> Factored:
    n_out = psi.size
    sd = np.sqrt(np.diag(V)[2 : 2 + 2 * n_out].reshape(-1, 2).sum(axis=1))
    reference = int(np.argmax(np.abs(psi) / sd))
    shape = psi / psi[reference]
    covariance = np.zeros((n_out, 2, 2))
    for o in range(n_out):
        if o == reference:
            continue
        D = np.array([[1.0, -shape[o]]]) / psi[reference]
        at = np.array([2 + 2 * o, 3 + 2 * o, 2 + 2 * reference, 3 + 2 * reference])
        J = _real(D)
        covariance[o] = J @ V[np.ix_(at, at)] @ J.T
    shape[reference] = 1.0
    return Factored(pole, V[:2, :2], shape, covariance, L * psi[reference], reference)
