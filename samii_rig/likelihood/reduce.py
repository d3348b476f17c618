"""Whole records as few numbers: the likelihood of every model near a reference model.

With S the reference and d = H - S on the nodes of a contour, the spectra of all pieces are

    Z = L(S) + A d + noise,

A as in `leak`. chi-square = |A d - (Z - L(S))|^2 in noise units is a quadratic form in d: it is
kept as a triangular factor, and what no smooth d explains as one number. The noise is that of the
residual of the best d, smoothed along frequency: a transient is in A, and does it no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from samii_rig.errors import EstimateError
from samii_rig.likelihood import nuisance, rounding
from samii_rig.likelihood.contour import EXACT, SMOOTH, Contour
from samii_rig.likelihood.leak import columns
from samii_rig.likelihood.noise import Disturbances, Noise
from samii_rig.likelihood.pieces import Piece, Samples
from samii_rig.types import Complex, Float, Int

SPACING = 0.2  # nodes, times the distance over which the reference's response turns by 1 rad
WIDEST = 0.1  # nodes, apart over frequency at most
BELOW = 2**0.5  # the same, below the band: a change of 1/s is linear between them to 3 %
ENOUGH = 0.75  # lines over unknowns of a change, from which a piece shows its noise by itself
RIDGES, MORE = 5, 30.0  # tries of a ridge, each so many times the one before
CYCLES = (
    5  # in a record, of its lowest line: below, wandering is as large as what polynomials leave
)
AT_ONCE = 4096  # lines whose products are formed together: 30 MB at 120 nodes
SAME = 1e-9  # of the largest, power in a direction that columns do not have

Response = Callable[[Complex], Complex]
"""(n,) s -> (n, q) of the reference model, from input to sensors."""


@dataclass(frozen=True, slots=True)
class Lines:
    """The lines of one piece. k : (n,) of its DFT. frequency : (n,) Hz."""

    k: Int
    frequency: Float


@dataclass(frozen=True, slots=True)
class Reduced:
    """A quadratic form in what a model has on the nodes.

    frequency : (b,) Hz of the nodes, s = sigma + 2 pi j f. reference : (b, q).
    factor : (m, q, 2, b) so that factor . (Re d, Im d) - target (m,) is standard normal noise.
    known : directions of d that the records tell anything of, the mean of chi-square.
    inside : chi-square that no d explains, and its mean.
    noise : of a sample. differing : chi-square of levels against each other, and its mean.
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

    def residual(self, h: Complex) -> Float:
        """(m,) in noise units, of a response (b, q)."""
        return np.asarray(self.slopes((h - self.reference)[:, :, None])[:, 0] - self.target)

    def slopes(self, dh: Complex) -> Float:
        """(m, p) of derivatives (b, q, p)."""
        b, q, p = dh.shape
        flat = np.stack([dh.real, dh.imag]).transpose(2, 0, 1, 3).reshape(2 * q * b, p)
        return np.asarray(self.factor.reshape(-1, 2 * q * b) @ flat)

    @property
    def between(self) -> Float:
        """(b - 1,) Hz, in the middle between nodes."""
        return np.asarray((self.frequency[:-1] + self.frequency[1:]) / 2)

    def bent(self, d: Complex, middle: Complex) -> float:
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


@dataclass(frozen=True)
class Records:
    """All pieces, on common contours.

    bands : Hz, of the lines of each that take part. steps : of each sensor's converter, none where
    they are not known. least : samples for which the contours are long
    enough at least, so that those of other records are the same.
    """

    pieces: tuple[Piece, ...]
    rate_hz: float
    bands: tuple[tuple[float, float], ...]
    steps: tuple[float, ...] = ()
    least: int = 0

    @property
    def band(self) -> tuple[float, float]:
        """Hz, from the lowest to the highest line."""
        return min(low for low, _ in self.bands), max(high for _, high in self.bands)

    @property
    def step(self) -> Float:
        """(q,) of each sensor's converter, 0 where it is not known."""
        return np.array(self.steps or (0.0,) * self.pieces[0].z.shape[1])

    @property
    def longest(self) -> int:
        """Samples, input before the piece included."""
        return max(self.least, *(p.r.size for p in self.pieces))

    @property
    def count(self) -> int:
        """Lines of all pieces."""
        return sum(self.lines(piece).k.size for piece in self.pieces)

    def exact(self) -> Contour:
        """The contour of predictions."""
        return Contour.over(self.longest, self.rate_hz, EXACT)

    def smooth(self) -> Contour:
        """The contour of the nodes."""
        return Contour.over(self.longest, self.rate_hz, SMOOTH)

    def lines(self, piece: Piece) -> Lines:
        """The lines of a piece in its band."""
        n = len(piece.z)
        band = self.bands[next(i for i, p in enumerate(self.pieces) if p is piece)]
        low, high = (f * n / self.rate_hz for f in band)
        k = np.arange(max(CYCLES, int(np.ceil(low))), min(int(high), (n - 1) // 2) + 1)
        return Lines(k, np.asarray(k * (self.rate_hz / n), np.float64))

    def left(self, samples: Samples | Piece, k: Int, H: Complex, contour: Contour) -> Complex:
        """(n, q) lines k of what H (M//2 + 1, q) on `exact` leaves of samples, a sample's power."""
        Y = H * contour.damped(samples.r)[:, None]
        n = len(samples.z)
        y = samples.z - contour.record(Y, samples.r.size)[samples.r.size - n :]
        return np.asarray(np.fft.rfft(y, axis=0)[k] / np.sqrt(n))


@dataclass(frozen=True, slots=True)
class Left:
    """What a model leaves, line by line, nuisances at their best.

    frequency : (n,) Hz. chi2 : (n,) of all sensors together, 2 q in the mean.
    each : (n, q) of each sensor by itself, 1 in the mean.
    """

    frequency: Float
    chi2: Float
    each: Float


def left_by(
    records: Records,
    response: Response,
    noise: Reduced,
    loop: tuple[float, int] | None = None,
    part: Callable[[Int], NDArray[np.bool_]] | None = None,
) -> Left:
    """The lines of all pieces under one model, in units of the noise that `noise` has."""
    rows = _rows(records, None, np.zeros(0, np.int64), response(records.exact().s), loop)
    if part is not None:
        rows = rows.take(np.flatnonzero(part(rows.k)))
    n, q = rows.e.shape
    white = np.sqrt(2) * noise.noise.whitened(rows.f, rows.e[:, :, None])[:, :, 0]
    N = np.sqrt(2) * noise.noise.whitened(rows.f, rows.N).reshape(n * q, -1)
    Q = orthonormal(np.concatenate([N.real, N.imag]))
    goal = np.concatenate([white.real.ravel(), white.imag.ravel()])
    goal -= Q @ (Q.T @ goal)
    white = (goal[: n * q] + 1j * goal[n * q :]).reshape(n, q)
    each = noise.noise.scaled(rows.f, white) / 2
    return Left(rows.f, np.sum(np.abs(white) ** 2, axis=1), each)


def nodes_of(contour: Contour, H: Complex, band: tuple[float, float]) -> Int:
    """Lines of the contour between which a change of the response is taken for linear.

    H : (M//2 + 1, q) reference on the contour, each sensor in units of its noise.
    """
    f = contour.frequency
    inside = (f >= band[0]) & (f <= band[1])
    turning = np.linalg.norm(np.gradient(H, axis=0), axis=1) / np.linalg.norm(H, axis=1)
    density = turning / SPACING + 1 / (WIDEST * np.maximum(np.arange(f.size), 1))
    place = np.cumsum(np.where(inside, np.minimum(density, 1.0), 0.0))
    first, last = np.flatnonzero(inside)[[0, -1]]
    marks = np.arange(place[first], place[last], 1.0)
    # An input below the band moves what integrates it, and the end of a record makes that seen
    # at all lines.
    below = first / BELOW ** np.arange(1.0, np.log(max(first, 1)) / np.log(BELOW))
    low = np.rint(np.append(below, 0.0)).astype(np.int64)
    return np.unique(np.concatenate([low, np.searchsorted(place, marks), [last]]))


@dataclass(frozen=True, slots=True)
class Rows:
    """Lines of all pieces by frequency, each in units of the root of its record's power.

    X : (n, 2 b) what a change on the nodes does. e : (n, q) what the reference leaves.
    N : (n, q, m) nuisances. f : (n,) Hz. k : (n,) numbers of the lines. piece : (n,) which.
    order : (n,) of the lines of all pieces, one after the other, which these are.
    """

    X: Complex
    e: Complex
    N: Complex
    f: Float
    k: Int
    piece: Int
    order: Int

    def take(self, which: Any) -> Rows:
        """Some of the lines."""
        return Rows(
            self.X[which], self.e[which], self.N[which], self.f[which], self.k[which],
            self.piece[which], self.order[which],
        )  # fmt: skip


def reduced(
    records: Records,
    response: Response,
    disturbances: Disturbances,
    loop: tuple[float, int] | None = None,
    part: Callable[[Int], NDArray[np.bool_]] | None = None,
    at: Float | None = None,
) -> Reduced:
    """The likelihood of all models near a reference.

    disturbances : what each of them makes in all sensors, along frequency.
    loop : kp and sensor of the loop that `response` has closed. part : which lines of a piece
    count, by their number. at : Hz of the nodes; None for as dense as the reference turns.
    """
    return formed(records, response, disturbances, loop, part, at)[0]


def formed(
    records: Records,
    response: Response,
    disturbances: Disturbances,
    loop: tuple[float, int] | None = None,
    part: Callable[[Int], NDArray[np.bool_]] | None = None,
    at: Float | None = None,
) -> tuple[Reduced, Rows]:
    """As `reduced`, and the lines that it was made of."""
    smooth, exact = records.smooth(), records.exact()
    H, S = response(exact.s), response(smooth.s)
    if at is None:
        inside = (smooth.frequency > records.band[0]) & (smooth.frequency < records.band[1])
        nodes = nodes_of(smooth, S / np.median(np.abs(S[inside]), axis=0), records.band)
    else:
        nodes = np.rint(at * (smooth.samples / smooth.rate_hz)).astype(np.int64)
    rows = _rows(records, smooth, nodes, H, loop)
    left, free = _residual(rows)
    known = rounding.added(records.pieces, records.step, H, exact)
    power = Noise.of(
        *_with_repeats(records, H, exact, loop, rows.f, left, free),
        disturbances=disturbances,
        known=known,
    )
    counted = np.ones(rows.f.size, bool) if part is None else part(rows.k)
    rows = rows.take(np.flatnonzero(counted))
    form = _quadratic(rows, power, S[nodes])
    count = 2.0 * rows.e.shape[1] * int(counted.sum()) - form.nuisances
    made = Reduced(
        frequency=smooth.frequency[nodes],
        sigma=smooth.sigma,
        reference=S[nodes],
        factor=form.factor,
        target=form.target,
        known=form.known,
        inside=(form.total - float(form.target @ form.target), count - form.known),
        noise=power,
        differing=_differing(records, H, exact, loop, power),
    )
    return made, rows


def _with_repeats(
    records: Records,
    H: Complex,
    exact: Contour,
    loop: tuple[float, int] | None,
    f: Float,
    left: Complex,
    free: Float,
) -> tuple[Float, Complex, Float]:
    """Frequency, lines and freedom of all that tells noise: what repeats differ by, too."""
    every = [(f, left, free)]
    for piece in records.pieces:
        if np.any(rounding.alike(piece, records.step) > rounding.ALIKE):
            continue
        every += _beside(records, piece, piece.repeats, H, exact, loop)
    f, left, free = (np.concatenate(x) for x in zip(*every, strict=True))
    order = np.argsort(f, kind="stable")
    return f[order], left[order], free[order]


def _beside(
    records: Records,
    piece: Piece,
    others: Sequence[Samples],
    H: Complex,
    exact: Contour,
    loop: tuple[float, int] | None,
) -> list[tuple[Float, Complex, Float]]:
    """Of the repeats or contrasts of a piece: Hz (n,), what H leaves without nuisances (n, q), and
    the freedom left (n,)."""
    if not others:
        return []
    lines, N = records.lines(piece), _nuisances(records, piece, H, loop)
    left = (records.left(samples, lines.k, H, exact) for samples in others)
    return [(lines.frequency, *_without(e, N)) for e in left]


def _differing(
    records: Records, H: Complex, exact: Contour, loop: tuple[float, int] | None, noise: Noise
) -> tuple[float, float]:
    """Chi-square of the levels against each other, and its mean."""
    total = count = 0.0
    for piece in records.pieces:
        for f, e, free in _beside(records, piece, piece.contrasts, H, exact, loop):
            total += 2 * float(np.sum(np.abs(noise.whitened(f, e[:, :, None])) ** 2))
            count += 2.0 * e.shape[1] * float(np.sum(free))
    return total, count


def _rows(
    records: Records,
    smooth: Contour | None,
    nodes: Int,
    H: Complex,
    loop: tuple[float, int] | None,
) -> Rows:
    """smooth, nodes : of changes; None where none is asked for."""
    exact = records.exact()
    none = [np.zeros((records.lines(p).k.size, 0), complex) for p in records.pieces]
    changes = none if smooth is None else _columns(records, smooth, nodes)
    spectra, errors, frequency, number, nuisances = [], [], [], [], []
    which: list[Int] = []
    for piece, X in zip(records.pieces, changes, strict=True):
        lines = records.lines(piece)
        weight = 1 / np.sqrt(len(piece.z))
        q = piece.z.shape[1]
        spectra.append(X * weight)
        errors.append(records.left(piece, lines.k, H, exact))
        frequency.append(lines.frequency)
        number.append(lines.k)
        which.append(np.full(lines.k.size, len(which)))
        nuisances.append(_nuisances(records, piece, H, loop))
    order = np.argsort(np.concatenate(frequency), kind="stable")
    N = np.zeros((order.size, q, sum(x.shape[2] for x in nuisances)), complex)
    row = column = 0
    for x in nuisances:
        N[row : row + x.shape[0], :, column : column + x.shape[2]] = x
        row, column = row + x.shape[0], column + x.shape[2]
    X, e, f, k, of = (np.concatenate(x)[order] for x in (spectra, errors, frequency, number, which))
    return Rows(X, e, N[order], f, k, of, order)


def _nuisances(
    records: Records, piece: Piece, H: Complex, loop: tuple[float, int] | None
) -> Complex:
    """(n, q, m) of one piece, of size 1 each."""
    k, exact = records.lines(piece).k, records.exact()
    own = [nuisance.wander(len(piece.z), k, piece.z.shape[1])]
    own += [nuisance.past(piece, k, H, exact)] if piece.moving else []
    own += [nuisance.unread(piece, k, H, exact, loop, records.step)]
    own += [nuisance.edges(piece, k, H, exact)]
    own += [nuisance.offsets(piece, k, H, exact, loop)]
    N = np.concatenate(own, axis=2)
    size = np.linalg.norm(N, axis=(0, 1))
    return np.asarray(N[:, :, size > 0] / size[size > 0])


def _without(e: Complex, N: Complex) -> tuple[Complex, Float]:
    """(n, q) without nuisances (n, q, m), each sensor's by itself, and the freedom left (n,)."""
    n, q = e.shape
    out, used = np.zeros_like(e), np.zeros(2 * n)
    for c in range(q):
        Q = orthonormal(_real(N[:, c][:, np.any(N[:, c] != 0, axis=0)]))
        goal = _real(e[:, c])
        goal = goal - Q @ (Q.T @ goal)
        used += np.sum(Q**2, axis=1)
        out[:, c] = goal[:n] + 1j * goal[n:]
    return out, np.maximum(1 - (used[:n] + used[n:]) / (2 * q), 0.0)


def _real(x: Complex) -> Float:
    """Real parts over imaginary parts."""
    return np.concatenate([x.real, x.imag])


def _columns(records: Records, contour: Contour, nodes: Int) -> list[Complex]:
    """Of each piece (n_lines, 2 n_nodes); those of one shape are computed together."""
    out: dict[int, Complex] = {}
    shapes = [
        (p.history, len(p.z), band) for p, band in zip(records.pieces, records.bands, strict=True)
    ]
    for shape in set(shapes):
        own = [i for i, s in enumerate(shapes) if s == shape]
        X = np.stack([contour.damped(records.pieces[i].r) for i in own])
        lines = records.lines(records.pieces[own[0]])
        one, turned = columns(contour, X, nodes, *shape[:2], lines.k)
        for i, a, b in zip(own, one, turned, strict=True):
            out[i] = np.concatenate([a, b], axis=1)
    return [out[i] for i in range(len(records.pieces))]


def _residual(rows: Rows) -> tuple[Complex, Float]:
    """What the best change of each sensor in each piece leaves (n, q), and the freedom (n,) that
    each line has left: pieces that differ by more than noise are not noise."""
    n, q = rows.e.shape
    pieces = [np.flatnonzero(rows.piece == i) for i in np.unique(rows.piece)]
    if min(len(on) for on in pieces) < ENOUGH * rows.X.shape[1]:
        pieces = [np.arange(n)]
    left, free = np.zeros((n, q), complex), np.zeros(n)
    for on in pieces:
        left[on], free[on] = _of_piece(rows.take(on))
    return left, free


def _of_piece(rows: Rows) -> tuple[Complex, Float]:
    Q = orthonormal(_real(rows.X))
    n, q = rows.e.shape
    left, used = np.zeros((n, q), complex), np.sum(Q**2, axis=1) * q
    for c in range(q):
        goal, more = _real(rows.e[:, c]), _real(rows.N[:, c])
        more = more[:, np.any(more != 0, axis=0)]
        more = orthonormal(more - Q @ (Q.T @ more))
        goal = goal - Q @ (Q.T @ goal)
        goal -= more @ (more.T @ goal)
        used += np.sum(more**2, axis=1)
        left[:, c] = goal[:n] + 1j * goal[n:]
    return left, np.maximum(1 - (used[:n] + used[n:]) / (2 * q), 0.0)


def orthonormal(X: Float) -> Float:
    """The directions of the columns of X (n, m), n > m."""
    scale = np.linalg.norm(X, axis=0)
    X = X / np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(X.T @ X)
    kept = values > SAME * values[-1]
    return np.asarray(X @ (vectors[:, kept] / np.sqrt(values[kept])))


@dataclass(frozen=True, slots=True)
class _Form:
    known: float
    factor: Float
    target: Float
    total: float
    nuisances: int


def _quadratic(rows: Rows, noise: Noise, reference: Complex) -> _Form:
    """factor, target of `Reduced`, and chi-square of the reference with the best nuisances."""
    b, q = reference.shape
    sums = _Sums(b, q, rows.N.shape[2])
    L = np.linalg.inv(noise.root(rows.f))
    W = 2 * (L.conj().swapaxes(1, 2) @ L)
    for first in range(0, rows.f.size, AT_ONCE):
        on = slice(first, first + AT_ONCE)
        sums.add(rows.take(on), W[on])
    M, g = sums.matrix, sums.head.T.ravel()
    cross = sums.cross.swapaxes(0, 1).reshape(2 * b * q, -1)
    # Each in units of its own size: a metre and a metre a second squared are of one kind here.
    size = np.sqrt(np.maximum(np.diagonal(sums.nuisance), 1e-300))
    values, turn = np.linalg.eigh(sums.nuisance / np.outer(size, size))
    kept = values > SAME * values[-1]
    root = turn[:, kept] / np.sqrt(values[kept]) / size[:, None]
    cross, own_head = cross @ root, root.T @ sums.nuisance_head
    # Where nothing was excited nothing is known: there the diagonal keeps the factor regular, and
    # takes the directions' place. What nuisances leave is as exact as what they were taken from.
    diagonal = np.diagonal(M).copy()
    M -= cross @ cross.T
    g = g - cross @ own_head
    largest = np.repeat(np.max(diagonal.reshape(q, -1), axis=1), 2 * b)  # in its own unit
    C, ridge = _factor(M, SAME * np.maximum(diagonal, SAME * largest))
    turned, _ = linalg.lapack.dtrtri(C)
    return _Form(
        known=C.shape[0] - float(ridge @ np.sum(turned**2, axis=1)),
        factor=np.ascontiguousarray(C).reshape(-1, q, 2, b),
        target=linalg.solve_triangular(C, g, trans="T", check_finite=False),
        total=sums.total - float(own_head @ own_head),
        nuisances=int(kept.sum()),
    )


def _factor(M: Float, ridge: Float) -> tuple[Float, Float]:
    """The upper factor of M (m, m) plus a ridge (m,) on its diagonal, and the ridge: as small as it
    can be, where records of few periods leave most directions unknown."""
    for _ in range(RIDGES):
        try:
            whole = M + np.diag(ridge)
            return linalg.cholesky(whole, overwrite_a=True, check_finite=False), ridge
        except np.linalg.LinAlgError:
            ridge = MORE * ridge
    raise EstimateError("the records hold no numbers that a response could be told from")


class _Sums:
    """What the normal equations need, summed over lines."""

    def __init__(self, b: int, q: int, m: int) -> None:
        self.total = 0.0
        self.matrix = np.zeros((2 * b * q, 2 * b * q))  # sensor by sensor
        self.head = np.zeros((2 * b, q))
        self.cross = np.zeros((2 * b, q, m))
        self.nuisance = np.zeros((m, m))
        self.nuisance_head = np.zeros(m)

    def add(self, rows: Rows, W: Complex) -> None:
        """Some lines. W : (n, q, q) twice the inverse of the noise of each."""
        n, q, m = rows.N.shape
        size = rows.X.shape[1]
        real = _real(rows.X)
        for i in range(q):
            for j in range(i, q):
                part = real.T @ _real(W[:, i, j, None] * rows.X)
                own, other = slice(i * size, (i + 1) * size), slice(j * size, (j + 1) * size)
                self.matrix[own, other] += part
                if i != j:
                    self.matrix[other, own] += part.T
        back = rows.X.conj().T
        We = (W @ rows.e[:, :, None])[:, :, 0]
        WN = W @ rows.N
        self.total += float(np.sum(rows.e.conj() * We).real)
        self.head += (back @ We).real
        self.cross += (back @ WN.reshape(n, q * m)).real.reshape(-1, q, m)
        flat = rows.N.reshape(n * q, m)
        self.nuisance += (flat.conj().T @ WN.reshape(n * q, m)).real
        self.nuisance_head += (flat.conj().T @ We.ravel()).real
