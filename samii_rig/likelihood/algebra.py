"""Lines as real numbers, and the directions that they span."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.types import Complex, Float

SAME = 1e-9  # of the largest, power in a direction that columns do not have
AT_ONCE = 1024  # lines whose products are formed together: 4 MB at 120 nodes, what a cache holds
NEGLIGIBLE = 1e-6  # of the noise's, power of what is known to be so small: a thousandth of it


def by_sensor(dh: Complex) -> Float:
    """(q 2 b, p) of derivatives (b, q, p): of each sensor all real parts, then imaginary ones."""
    b, q, p = dh.shape
    return np.stack([dh.real, dh.imag]).transpose(2, 0, 1, 3).reshape(2 * q * b, p)


def as_real(x: Complex) -> Float:
    """Real parts over imaginary parts."""
    return np.concatenate([x.real, x.imag])


def as_complex(x: Float) -> Complex:
    """From real parts over imaginary parts."""
    half = len(x) // 2
    return np.asarray(x[:half] + 1j * x[half:])


def by_input(r: Float) -> Float:
    """(m, n) of r (n,) or (n, m)."""
    return r[None] if r.ndim == 1 else r.T


def lengths(Q: Float) -> Float:
    """(n,) squares of the rows of Q (n, m)."""
    return np.asarray(np.einsum("ij,ij->i", Q, Q))


def orthonormal(X: Float) -> Float:
    """The directions of the columns of X (n, m), n > m."""
    scale = np.linalg.norm(X, axis=0)
    return spanned(X / np.where(scale > 0, scale, 1.0))


def spanned(X: Float) -> Float:
    """The directions of columns that are of size 1, or were before something was projected out."""
    return np.asarray(X @ root_of(X.T @ X))


def root_of(square: Float) -> Float:
    """(p, m) R so that X R are the directions of columns X, from their products (p, p), as of
    `spanned`."""
    if not len(square):
        return square
    values, vectors = np.linalg.eigh(square)
    kept = values > SAME * np.max(values, initial=0.0)
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]))


@dataclass(frozen=True, slots=True)
class Shrinking:
    """What columns X (n, p) leave of lines: Q = X C (n, m) projects, or shrinks. Q is not formed,
    as that is most of the work where columns are many."""

    X: Float
    C: Float

    @classmethod
    def of(cls, X: Float, prior: Float) -> Shrinking:
        """So that r - Q Q' r is what columns X (n, p) leave of r that have amplitudes as likely as
        a normal deviation makes them: of 1/sqrt(prior), none where prior (p,) is 0. Its square is
        that of r in the noise that unit noise and the columns make together."""
        square = X.T @ X
        scale = np.sqrt(np.where(prior > 0, prior, np.diagonal(square)))
        scale = 1 / np.where(scale > 0, scale, 1.0)
        square *= scale[:, None] * scale
        any_, some = np.flatnonzero(prior == 0), np.flatnonzero(prior > 0)
        root = root_of(square[np.ix_(any_, any_)])
        C = np.zeros((len(prior), root.shape[1]))
        C[any_] = root
        if some.size:
            across = root.T @ square[np.ix_(any_, some)]
            power, turn = np.linalg.eigh(square[np.ix_(some, some)] - across.T @ across)
            kept = power > NEGLIGIBLE
            power, turn = power[kept], turn[:, kept]
            turn = turn * np.sqrt((1 - 1 / np.sqrt(1 + power)) / power)
            beside = np.zeros((len(prior), turn.shape[1]))
            beside[any_], beside[some] = -root @ (across @ turn), turn
            C = np.concatenate([C, beside], axis=1)
        return cls(X, scale[:, None] * C)

    def left(self, r: Float) -> Float:
        """(n, ...) of lines r (n, ...)."""
        return np.asarray(r - self.X @ (self.C @ (self.C.T @ (self.X.T @ r))))


def directions(square: Float) -> tuple[Float, Float]:
    """Values (m,) of a matrix (m, m) of products, increasing, and the directions (m, m) that have
    them."""
    if not len(square):
        return np.zeros(0), square
    # Each in units of its own size: a metre and a metre a second squared are of one kind here.
    size = np.sqrt(np.maximum(np.diagonal(square), np.finfo(np.float64).tiny))
    values, turn = np.linalg.eigh(square / np.outer(size, size))
    return values, turn / size[:, None]
