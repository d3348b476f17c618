"""Lines of all pieces as a quadratic form in a change of the response on the nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from samii_rig.errors import EstimateError
from samii_rig.likelihood.algebra import AT_ONCE, SAME, as_real, by_sensor, directions
from samii_rig.likelihood.noise import Noise
from samii_rig.likelihood.rows import Rows
from samii_rig.types import Complex, Float

RIDGES, MORE = 5, 30.0  # tries of a ridge, each so many times the one before


@dataclass(frozen=True, slots=True)
class Reduced:
    """A quadratic form in what a model has on the nodes.

    frequency : (b,) Hz of the nodes, s = sigma + 2 pi j f. reference : (b, q).
    factor : (m, q, 2, b) so that factor . (Re d, Im d) - target (m,) is standard normal noise;
    of one state upper triangular.
    known : directions of d of which the records hold information, the mean of chi-square.
    inside : chi-square that no d explains, and its mean.
    noise : of a sample. differing : chi-square of levels against each other, and its mean.
    log_determinant : twice the sum over the lines of the logarithm of the determinant of the noise,
    which with chi-square is the deviance of a model with this noise.
    """

    frequency: Float
    sigma: float
    reference: Complex
    factor: Float
    target: Float
    known: float
    inside: tuple[float, float]
    noise: Noise
    differing: tuple[float, float]
    log_determinant: float

    def residual(self, h: Complex) -> Float:
        """(m,) in noise units, of a response (b, q)."""
        return np.asarray(self.slopes((h - self.reference)[:, :, None])[:, 0] - self.target)

    def slopes(self, dh: Complex) -> Float:
        """(m, p) of derivatives (b, q, p)."""
        flat = by_sensor(dh)
        C = self.factor.reshape(len(flat), -1).T  # upper triangular
        if flat.shape[1] == 1:
            return np.asarray(linalg.blas.dtrmv(C, flat[:, 0], lower=1, trans=1)[:, None])
        return np.asarray(linalg.blas.dtrmm(1.0, C, flat, lower=1, trans_a=1))

    @property
    def excited(self) -> NDArray[np.bool_]:
        """(q 2 b,) directions of d at inputs that something excites; the others have the ridge."""
        size = np.linalg.norm(self.factor.reshape(len(self.target), -1), axis=0)
        return np.asarray(size > 2 * SAME)

    @property
    def between(self) -> Float:
        """(b - 1,) Hz, in the middle between nodes."""
        return np.asarray((self.frequency[:-1] + self.frequency[1:]) / 2)

    def interpolation_error(self, d: Complex, middle: Complex) -> float:
        """Noise units by which a change d (b, q) is off that is taken for linear between nodes, and
        is `middle` (b - 1, q) there."""
        off = middle - (d[:-1] + d[1:]) / 2
        gap = np.diff(self.frequency)
        # Nodes on neighbouring lines of the contour have nothing between them.
        off[gap < 1.5 * gap.min()] = 0.0
        at_nodes = np.zeros_like(d)
        at_nodes[:-1] += off / 2
        at_nodes[1:] += off / 2
        return float(np.linalg.norm(self.slopes(at_nodes[:, :, None])))


@dataclass(frozen=True, slots=True)
class _Form:
    known: float
    factor: Float
    target: Float
    total: float
    nuisances: int
    log_determinant: float


def quadratic(rows: Rows, noise: Noise, reference: Complex) -> _Form:
    """factor, target of `Reduced`, and chi-square of the reference with the best nuisances."""
    b, q = reference.shape  # q : of each input by itself, where there are several
    W = weights(rows, noise)
    We = (W @ rows.e[:, :, None])[:, :, 0]
    M, g = np.zeros((q * 2 * b, q * 2 * b)), np.zeros(q * 2 * b)
    for on, X in rows.changes():
        own, head = products(X, W[on], We[on])
        M += own
        g += head
    beside = _nuisances(rows, W, We)
    cross, own_head = beside.cross, beside.head
    # Where nothing was excited nothing is known: there the diagonal keeps the factor regular, and
    # takes the directions' place. What nuisances leave is as exact as what they were taken from.
    diagonal = np.diagonal(M).copy()
    M -= cross @ cross.T
    g -= cross @ own_head
    largest = np.repeat(np.max(diagonal.reshape(q, -1), axis=1), 2 * b)  # in its own unit
    largest = np.where(largest > 0, largest, 1.0)  # `Reduced.excited`
    C, ridge = _factor(M, SAME * np.maximum(diagonal, SAME * largest))
    turned, _ = linalg.lapack.dtrtri(C)
    return _Form(
        known=C.shape[0] - float(ridge @ np.einsum("ij,ij->i", turned, turned)),
        factor=np.ascontiguousarray(C).reshape(-1, q, 2, b),
        target=linalg.solve_triangular(C, g, trans="T", check_finite=False),
        total=float(np.sum(rows.e.conj() * We).real) - float(own_head @ own_head),
        nuisances=beside.free,
        # But for a constant of the lines.
        log_determinant=beside.log_determinant - 2 * float(np.sum(np.linalg.slogdet(W)[1])),
    )


def weights(rows: Rows, noise: Noise) -> Complex:
    """(n, q, q) twice the inverse of the noise: real and imaginary parts count by themselves."""
    L = np.linalg.inv(noise.root(rows.f, rows.piece))
    return np.asarray(2 * (L.conj().swapaxes(1, 2) @ L))


class _Nuisances(NamedTuple):
    """The directions of all nuisances, of length 1: their products with the changes of all nodes
    (q 2 b, m), and with what the reference leaves (m,). free : of how many nothing is known.
    log_determinant : what the others add to that of the noise."""

    cross: Float
    head: Float
    free: int
    log_determinant: float


def _nuisances(rows: Rows, W: Complex, We: Complex) -> _Nuisances:
    found = []
    likely, log_determinant = 0, 0.0
    for (on, N, prior), (_, X) in zip(rows.each(), rows.changes(), strict=True):
        q, m = N.shape[1:]
        flat, WN = as_real(N.reshape(-1, m)), as_real((W[on] @ N).reshape(-1, m))
        square = flat.T @ WN
        some = prior > 0
        log_determinant += np.linalg.slogdet(square[np.ix_(some, some)] + np.eye(some.sum()))[1]
        likely += int(some.sum())
        values, turn = directions(square + np.diag(prior))
        cross = as_real(X).T @ WN.reshape(-1, q * m)
        cross = cross.reshape(-1, q, m).swapaxes(0, 1).reshape(-1, m)
        head = flat.T @ as_real(We[on].ravel())
        found.append((values, turn, cross, head))
    largest = max(float(np.max(values, initial=0.0)) for values, *_ in found)
    crosses, heads = [], []
    for values, turn, cross, head in found:
        kept = values > SAME * largest
        root = turn[:, kept] / np.sqrt(values[kept])
        crosses.append(cross @ root)
        heads.append(root.T @ head)
    cross, head = np.concatenate(crosses, axis=1), np.concatenate(heads)
    return _Nuisances(cross, head, head.size - likely, log_determinant)


def products(X: Complex, W: Complex, We: Complex) -> tuple[Float, Float]:
    """(q 2 b, q 2 b) real parts of X^H W_ij X of lines X (n, 2 b), sensor by sensor, and (q 2 b,)
    of X^H We of lines We (n, q)."""
    q, size = W.shape[1], X.shape[1]
    M, g = np.zeros((q * size, q * size)), np.zeros((q, size))
    for first in range(0, len(X), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        # Real parts beside imaginary ones, as they stand in memory: real parts of products.
        x = np.ascontiguousarray(X[some].T)
        real, scaled = x.view(np.float64), np.empty_like(x)
        w = np.ascontiguousarray(W[some].transpose(1, 2, 0))
        g += np.ascontiguousarray(We[some].T).view(np.float64) @ real.T
        for i in range(q):
            own = slice(i * size, (i + 1) * size)
            root = np.multiply(x, np.sqrt(w[i, i].real), out=scaled).view(np.float64)
            M[own, own] += root @ root.T
            for j in range(i + 1, q):
                other = np.multiply(x, w[i, j], out=scaled).view(np.float64)
                M[own, j * size : (j + 1) * size] += real @ other.T
    # In place: with eight sensors and some hundred nodes M is the most that is kept of any record.
    for i in range(q):
        for j in range(i + 1, q):
            one, other = slice(i * size, (i + 1) * size), slice(j * size, (j + 1) * size)
            M[other, one] = M[one, other].T
    return M, g.ravel()


def _factor(M: Float, ridge: Float) -> tuple[Float, Float]:
    """The upper factor of M (m, m) plus a ridge (m,) on its diagonal, and the ridge: as small as it
    can be, where records of few periods leave most directions unknown. M is changed."""
    diagonal = np.diagonal(M).copy()
    for _ in range(RIDGES):
        np.fill_diagonal(M, diagonal + ridge)
        try:
            return linalg.cholesky(M, check_finite=False), ridge
        except np.linalg.LinAlgError:
            ridge = MORE * ridge
    raise EstimateError("the records hold no numbers that a response could be told from")
