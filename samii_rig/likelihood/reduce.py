"""Whole records as few numbers: the likelihood of every model near a reference model.

With S the reference and d = H - S on the nodes of a contour, the spectra of all pieces are

    Z = L(S) + A d + noise,

A as in `leak`. chi-square = |A d - (Z - L(S))|^2 in noise units is a quadratic form in d: it is
kept as a triangular factor, and what no smooth d explains as one number. The noise is that of the
residual of the best d, smoothed along frequency: a transient is in A, and does it no harm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from samii_rig.errors import EstimateError
from samii_rig.likelihood import nuisance, rounding, spikes
from samii_rig.likelihood.contour import EXACT, SMOOTH, Contour
from samii_rig.likelihood.leak import columns
from samii_rig.likelihood.noise import Disturbances, Noise
from samii_rig.likelihood.past import SAME, directions, likely, shown
from samii_rig.likelihood.pieces import Loops, Piece, Samples, across
from samii_rig.likelihood.seen import Answers, Seen
from samii_rig.types import Complex, Float, Int

SPACING = 0.2  # nodes, times the distance over which the reference's response turns by 1 rad
WIDEST = 0.1  # nodes, apart over frequency at most
# Nodes over lines of the contour, at most, of a change that is free where noise is estimated: at
# the lowest lines one a line would leave no noise to be seen.
SPARE = 0.1
BELOW = 2**0.5  # the same, below the band: a change of 1/s is linear between them to 3 %
ENOUGH = 0.75  # lines over unknowns of a change, from which a piece shows its noise by itself
# Of an input's largest in any piece, what it does in one that it does not excite: where noise is
# told no change of its response is free there, which would fit that with its converter's rounding.
RESTS = 0.01
RIDGES, MORE = 5, 30.0  # tries of a ridge, each so many times the one before
CYCLES = (
    5  # in a record, of its lowest line: below, wandering is as large as what polynomials leave
)
AT_ONCE = 1024  # lines whose products are formed together: 4 MB at 120 nodes, what a cache holds

Response = Callable[[Complex], Complex]
"""(n,) s -> (n, q) of the reference model, from input to sensors; (n, q m) of m inputs, all inputs
of the first sensor first. Beyond half the rate of records that hold not every sample of the rig:
from and to all of its samples."""

Part = Callable[[Int], NDArray[np.bool_]]
"""Which lines of a piece, by their number."""


@dataclass(frozen=True, slots=True)
class Lines:
    """The lines of one piece. k : (n,) of its DFT. frequency : (n,) Hz."""

    k: Int
    frequency: Float


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


def by_sensor(dh: Complex) -> Float:
    """(q 2 b, p) of derivatives (b, q, p): of each sensor all real parts, then imaginary ones."""
    b, q, p = dh.shape
    return np.stack([dh.real, dh.imag]).transpose(2, 0, 1, 3).reshape(2 * q * b, p)


@dataclass(frozen=True)
class Records:
    """All pieces, on common contours.

    bands : Hz, of the lines of each that take part. steps : of each sensor's converter, none where
    they are not known. least : samples for which the contours are long
    enough at least, so that those of other records are the same. driven : Hz up to which the input
    is more than noise, so that a change of the response shows. undriven : inputs that nothing
    excites. What they did is known; a change of the response to it would fit the noise in it.
    every : samples of the rig for each that was recorded.
    """

    pieces: tuple[Piece, ...]
    rate_hz: float
    bands: tuple[tuple[float, float], ...]
    steps: tuple[float, ...] = ()
    least: int = 0
    driven: float = np.inf
    undriven: tuple[int, ...] = ()
    every: int = 1

    @property
    def changing(self) -> tuple[float, float]:
        """Hz between which a change of the response shows."""
        low, high = self.band
        return low, min(high, self.driven)

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
        return max(self.least, *(len(p.r) for p in self.pieces))

    @property
    def count(self) -> int:
        """Lines of all pieces."""
        return sum(self.lines(piece).k.size for piece in self.pieces)

    def exact(self) -> Contour:
        """The contour of predictions."""
        return Contour.over(self.longest, self.rate_hz, EXACT)

    def fine(self) -> Contour:
        """That of all samples of the rig, where not every one was recorded."""
        return Contour.over(self.longest * self.every, self.rate_hz * self.every, EXACT)

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

    def residual(self, samples: Samples | Piece, k: Int, H: Complex, contour: Contour) -> Complex:
        """(n, q) lines k of what H (M//2 + 1, q) on `exact` leaves of samples, a sample's power."""
        e = _left_in_time(samples, H, contour)
        return np.asarray(np.fft.rfft(e, axis=0)[k] / np.sqrt(len(e)))

    def without_spikes(self, H: Complex) -> Records:
        """The same, without spikes that show beside what H on `exact` predicts: as `spikes`, whose
        cubic is blind to them where the motion is fast; and with those that it predicts."""
        exact = self.exact()

        def without(samples: Samples | Piece) -> Float:
            e = _left_in_time(samples, H, exact)
            z = samples.z
            if none := spikes.as_predicted(e, samples.struck, self.step):
                at, sensor, more = zip(*none, strict=True)
                z, e = z.copy(), e.copy()
                z[at, sensor] += more
                e[at, sensor] += more
            mended, found = spikes.mended(e, self.step)
            return z + (mended - e) if found else z

        def each(found: tuple[Samples, ...]) -> tuple[Samples, ...]:
            return tuple(replace(x, z=without(x), struck=()) for x in found)

        pieces = tuple(
            replace(
                p, z=without(p), struck=(), repeats=each(p.repeats), contrasts=each(p.contrasts)
            )
            for p in self.pieces
        )
        return replace(self, pieces=pieces)

    def seen(self, H: Complex, loop: Loops, response: Response) -> list[Seen]:
        """Of each piece what H on `exact`, of a response, leaves, and what else is in it."""
        rms = [np.sqrt(np.mean(by_input(p.r) ** 2, axis=1)) for p in self.pieces]
        answers = Answers.of(
            H, self.exact(), loop, self.longest, np.max(rms, axis=0), self.pieces[0].inputs
        )
        if self.every > 1 and any(p.edges for p in self.pieces):
            contour = self.fine()
            fine = contour.record(response(contour.s), self.longest * self.every)
            folded = nuisance.folding(answers.impulse, fine, self.every)
            answers = replace(answers, folded=folded)
        return [Seen.of(p, self.lines(p).k, answers, self.step) for p in self.pieces]


def _left_in_time(samples: Samples | Piece, H: Complex, contour: Contour) -> Float:
    """(n, q) what H on a contour leaves of samples."""
    left = samples.z - contour.predicted(H, samples.r)[len(samples.r) - len(samples.z) :]
    return across(left, samples.lost) if isinstance(samples, Piece) else left


@dataclass(frozen=True, slots=True)
class LineResiduals:
    """What a model leaves, line by line, nuisances at their best.

    frequency : (n,) Hz. chi2 : (n,) of all sensors together, 2 q in the mean.
    each : (n, q) of each sensor by itself, 1 in the mean.
    """

    frequency: Float
    chi2: Float
    each: Float


def residuals_by_line(
    records: Records, response: Response, noise: Reduced, loop: Loops = (), *parts: Part
) -> list[LineResiduals]:
    """The lines of all pieces under one model, in units of the noise that `noise` has: of each of
    some parts, nuisances at their best there; of all lines where none is said."""
    H = response(records.exact().s)
    records = records.without_spikes(H)
    every = _rows(records, None, records.seen(H, loop, response))
    out = []
    for part in parts or (lambda k: np.ones(k.size, bool),):
        rows = every.take(part(every.k))
        white = np.empty_like(rows.e)
        for on, N in rows.each():
            both = np.concatenate([rows.e[on][:, :, None], N], axis=2)
            both = np.sqrt(2) * noise.noise.whitened(rows.f[on], rows.piece[on], both)
            Q = orthonormal(as_real(both[:, :, 1:].reshape(-1, N.shape[2])))
            goal = as_real(both[:, :, 0].ravel())
            goal -= Q @ (Q.T @ goal)
            white[on] = as_complex(goal).reshape(on.size, -1)
        each = noise.noise.scaled(rows.f, rows.piece, white) / 2
        out.append(LineResiduals(rows.f, np.sum(np.abs(white) ** 2, axis=1), each))
    return out


def nodes_of(
    contour: Contour, H: Complex, band: tuple[float, float], *, spare: bool = False
) -> Int:
    """Lines of the contour between which a change of the response is taken for linear.

    H : (M//2 + 1, q) reference on the contour, each sensor in units of its noise. spare : few of
    them at the lowest lines, but where the response turns more than a double integrator's.
    """
    f = contour.frequency
    inside = (f >= band[0]) & (f <= band[1])
    turning = np.linalg.norm(np.gradient(H, axis=0), axis=1) / np.linalg.norm(H, axis=1)
    each = 1 / np.maximum(np.arange(f.size), 1)
    if spare:
        density = np.maximum(turning - 2 * each, 0.0) / SPACING + np.minimum(each / WIDEST, SPARE)
    else:
        density = turning / SPACING + each / WIDEST
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

    X : (n, 2 b) what a change on the nodes does, (n, 2 b m) of m inputs. e : (n, q) what the
    reference leaves.
    N : of each piece (n_i, q, m_i) the nuisances of its lines.
    f : (n,) Hz. k : (n,) numbers of the lines. piece : (n,) which.
    order : (n,) of the lines of all pieces, one after the other, which these are.
    """

    X: Complex
    e: Complex
    N: Sequence[Complex]
    f: Float
    k: Int
    piece: Int
    order: Int

    def take(self, which: NDArray[np.bool_]) -> Rows:
        """Some of the lines."""
        N = [one[which[self.piece == i]] for i, one in enumerate(self.N)]
        return Rows(
            self.X[which], self.e[which], N, self.f[which], self.k[which],
            self.piece[which], self.order[which],
        )  # fmt: skip

    def each(self) -> list[tuple[Int, Complex]]:
        """Of each piece its lines, and their nuisances."""
        every = ((np.flatnonzero(self.piece == i), N) for i, N in enumerate(self.N))
        return [(on, N) for on, N in every if on.size]


def reduced(
    records: Records,
    response: Response,
    disturbances: Disturbances,
    loop: Loops = (),
    part: Part | None = None,
    at: Float | None = None,
) -> Reduced:
    """The likelihood of all models near a reference.

    disturbances : what each of them makes in all sensors, along frequency.
    loop : those that `response` has closed. part : which lines of a piece
    count, by their number. at : Hz of the nodes; None for as dense as the reference turns.
    """
    return formed(records, response, disturbances, loop, part, at)[0]


def formed(
    records: Records,
    response: Response,
    disturbances: Disturbances,
    loop: Loops = (),
    part: Part | None = None,
    at: Float | None = None,
) -> tuple[Reduced, Rows]:
    """As `reduced`, and the lines that it was made of."""
    smooth, exact = records.smooth(), records.exact()
    H, S = response(exact.s), response(smooth.s)
    records = records.without_spikes(H)
    inside = (smooth.frequency > records.band[0]) & (smooth.frequency < records.band[1])
    shape = S / np.median(np.abs(S[inside]), axis=0)
    if at is None:
        nodes = nodes_of(smooth, shape, records.changing)
    else:
        nodes = np.rint(at * (smooth.samples / smooth.rate_hz)).astype(np.int64)
    seen = records.seen(H, loop, response)
    free = _between(nodes, nodes_of(smooth, shape, records.changing, spare=True))

    known = rounding.Added.of([s.rounding for s in seen])

    def told(with_past: Records) -> tuple[Rows, _Free, Callable[[rounding.Added], Noise]]:
        changes = _columns(with_past, smooth, nodes)
        rows = _rows(records, changes, seen)
        change = _Free.of(rows, changes, free)
        left = _with_repeats(records, H, seen, rows, *_residual(change, seen))
        return rows, change, lambda known: Noise.of(*left, disturbances=disturbances, known=known)

    rows, change, noise = told(records)
    power = noise(known)
    with_past = _with_past(records, change, seen, power)
    if with_past is not None:
        rows, _, noise = told(with_past)
        power = noise(known)
    times = _as_changes(rows, seen, power)
    if np.any(times > 1):
        power = noise(replace(known, times=times))
    counted = np.ones(rows.f.size, bool) if part is None else part(rows.k)
    rows = rows.take(counted)
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
        differing=_differing(records, H, seen, power),
        log_determinant=form.log_determinant,
    )
    return made, rows


def _with_past(
    records: Records, change: _Free, seen: Sequence[Seen], noise: Noise
) -> Records | None:
    """The same records, with what moved the rig before each piece as far as its lines show that,
    whatever the change of the response is; None where nothing did."""
    W = _weights(change.rows, noise)
    pieces = list(records.pieces)
    for which, on, X in change.groups:
        own = [(i, seen[i]) for i in which]
        group = change.rows.piece[on]
        blocks = []
        for i, s in own:
            before = s.past.likely / math.sqrt(len(pieces[i].z))  # lines are a sample's
            blocks.append((np.flatnonzero(group == i), before, s.N[:, :, s.beside]))
        found = _past_of(orthonormal(X), blocks, change.rows.e[on], W[on])
        if found is None:
            continue
        for i, s in own:
            amplitudes, found = np.split(found, [s.past.impulses.shape[1]])
            if s.past.begins(s.left, amplitudes):
                pieces[i] = s.past.before(pieces[i], amplitudes)
    if all(a is b for a, b in zip(pieces, records.pieces, strict=True)):
        return None
    return replace(records, pieces=tuple(pieces))


def _as_changes(rows: Rows, seen: Sequence[Seen], noise: Noise) -> Float:
    """(q,) times by which rounding shows more in a change of each sensor's response than noise of
    its power that is independent from line to line, 1 at least.

    The error of a motion of few steps repeats as the motion does: after each step, at each passage
    of a mode, in pieces that move alike. Of all places in the step at which the sensor may rest,
    alike in all pieces, those count that leave least of what is read.
    """
    out = np.ones(rows.e.shape[1])
    coarse = sorted({c for s in seen for c in s.rounding.draws})
    if not coarse:
        return out
    C = np.diagonal(noise.covariance(rows.f, rows.piece), axis1=1, axis2=2).real
    for c in coarse:
        draws = [
            s.rounding.draws[c].T
            if c in s.rounding.draws
            else np.zeros((len(s.e), rounding.OFFSETS), complex)
            for s in seen
        ]
        scale = 1 / np.sqrt(C[:, c])[:, None]
        errors = np.asarray(np.concatenate(draws)[rows.order] * scale, np.complex128)
        beyond = np.sum(np.abs(rows.e[:, c, None] * scale - errors) ** 2, axis=0)
        errors = errors[:, np.argsort(beyond)[: rounding.LIKELY]]
        Q = orthonormal(as_real(rows.X * scale))
        power = np.mean(np.abs(errors) ** 2, axis=1) / 2  # of the real part, and of the other
        independent = float(np.sum(np.tile(power, 2) * np.sum(Q**2, axis=1)))
        if independent > 0:
            shows = float(np.sum((Q.T @ as_real(errors)) ** 2)) / rounding.LIKELY
            out[c] = max(shows / independent, 1.0)
    return out


def _past_of(
    Q: Float, blocks: Sequence[tuple[Int, Complex, Complex]], e: Complex, W: Complex
) -> Float | None:
    """The amplitudes of what moved the rig before pieces that share one change, as `past.likely`.

    Q : (2 n, p) directions of the change, of each sensor. blocks : of each piece its lines, the
    shapes of what was before, and those beside them. e : (n, q) lines. W : as of `likely`.
    """
    if len(blocks) == 1:
        ((_, before, beside),) = blocks
        return likely(_beyond(Q, before), _beyond(Q, e[:, :, None])[:, :, 0], _beyond(Q, beside), W)
    # Side by side the shapes of many pieces would be many times as much as all lines: of each its
    # products, and what all lose to the change by its p directions.
    n, q = e.shape
    We = (W @ e[:, :, None])[:, :, 0]
    K, pull = _products(as_complex(Q), W, We)

    def along(at: Int, x: Complex) -> Float:
        """(q p, m) of lines x (k, q, m) along the change."""
        there = Q[np.concatenate([at, n + at])].T
        return np.concatenate([there @ as_real(x[:, c]) for c in range(q)])

    last = sum(before.shape[2] for _, before, _ in blocks)
    m = last + sum(beside.shape[2] for _, _, beside in blocks)
    square, head, first = np.zeros((m, m)), np.zeros(m), 0
    B, T = np.zeros((len(K), m)), np.zeros((len(K), m))
    for at, before, beside in blocks:
        A = np.concatenate([before, beside], axis=2)
        place = np.r_[first : first + before.shape[2], last : last + beside.shape[2]]
        first, last = first + before.shape[2], last + beside.shape[2]
        WA, flat = W[at] @ A, A.reshape(-1, A.shape[2]).conj().T
        square[np.ix_(place, place)] = (flat @ WA.reshape(-1, A.shape[2])).real
        head[place] = (flat @ We[at].ravel()).real
        B[:, place], T[:, place] = along(at, A), along(at, WA)
    square += B.T @ (K @ B) - T.T @ B - B.T @ T
    own = along(np.arange(n), e[:, :, None])[:, 0]
    head += B.T @ (K @ own - pull) - T.T @ own
    return shown(square, head, sum(before.shape[2] for _, before, _ in blocks))


def _beyond(Q: Float, x: Complex) -> Complex:
    """Lines (n, q, m) less what is along directions Q (2 n, p) of each sensor."""
    flat = as_real(x.reshape(len(x), -1))
    return as_complex(flat - Q @ (Q.T @ flat)).reshape(x.shape)


def _with_repeats(
    records: Records, H: Complex, seen: Sequence[Seen], rows: Rows, left: Complex, free: Float
) -> tuple[Float, Complex, Float, Int]:
    """Frequency, lines, freedom and piece of all that the noise is estimated from: what repeats
    differ by, too."""
    every = [(rows.f, left, free, rows.piece)]
    for i, (piece, own) in enumerate(zip(records.pieces, seen, strict=True)):
        if np.any(rounding.alike(piece, records.step) > rounding.ALIKE):
            continue
        for f, e, some in _beside(records, piece, piece.repeats, H, own):
            every.append((f, e, some, np.full(f.size, i)))
    f, left, free, which = (np.concatenate(x) for x in zip(*every, strict=True))
    order = np.argsort(f, kind="stable")
    return f[order], left[order], free[order], which[order]


def _beside(
    records: Records, piece: Piece, others: Sequence[Samples], H: Complex, own: Seen
) -> list[tuple[Float, Complex, Float]]:
    """Of the repeats or contrasts of a piece: Hz (n,), what H leaves without nuisances (n, q), and
    the freedom left (n,)."""
    if not others:
        return []
    lines, exact = records.lines(piece), records.exact()
    left = np.stack([records.residual(samples, lines.k, H, exact) for samples in others], axis=2)
    left, free = _without(left, own.N)
    return [(lines.frequency, left[:, :, i], free) for i in range(len(others))]


def _differing(
    records: Records, H: Complex, seen: Sequence[Seen], noise: Noise
) -> tuple[float, float]:
    """Chi-square of the levels against each other, and its mean."""
    total = count = 0.0
    for i, (piece, own) in enumerate(zip(records.pieces, seen, strict=True)):
        every = _beside(records, piece, piece.contrasts, H, own)
        if every:
            f, left = every[0][0], np.stack([e for _, e, _ in every], axis=2)
            total += 2 * float(np.sum(np.abs(noise.whitened(f, np.full(f.size, i), left)) ** 2))
            count += 2.0 * left.shape[1] * sum(float(np.sum(free)) for _, _, free in every)
    return total, count


def _rows(records: Records, changes: Sequence[Complex] | None, seen: Sequence[Seen]) -> Rows:
    """changes : of each piece what one on the nodes does; None where none is asked for."""
    lines = [records.lines(p) for p in records.pieces]
    size = [x.k.size for x in lines]
    order = np.argsort(np.concatenate([x.frequency for x in lines]), kind="stable")
    # Where each line of each piece stands.
    place = np.split(np.argsort(order), np.cumsum(size)[:-1])
    n, q = order.size, seen[0].e.shape[1]
    X = np.empty((n, changes[0].shape[1] if changes else 0), complex)
    e, f = np.zeros((n, q), complex), np.zeros(n)
    k, which = np.zeros(n, np.int64), np.zeros(n, np.int64)
    for i, on in enumerate(place):
        if changes:
            X[on] = changes[i]
        e[on], f[on], k[on], which[on] = seen[i].e, lines[i].frequency, lines[i].k, i
    return Rows(X, e, [s.N for s in seen], f, k, which, order)


def _without(e: Complex, N: Complex) -> tuple[Complex, Float]:
    """(n, q, p) without nuisances (n, q, m), each sensor's by itself, and the freedom left (n,)."""
    n, q = e.shape[:2]
    out, used = np.zeros_like(e), np.zeros(2 * n)
    for c in range(q):
        Q = _spanned(_nuisances_of(N[:, c]))
        goal = as_real(e[:, c])
        goal = goal - Q @ (Q.T @ goal)
        used += _lengths(Q)
        out[:, c] = as_complex(goal)
    return out, np.maximum(1 - (used[:n] + used[n:]) / (2 * q), 0.0)


def as_real(x: Complex) -> Float:
    """Real parts over imaginary parts."""
    return np.concatenate([x.real, x.imag])


def as_complex(x: Float) -> Complex:
    """From real parts over imaginary parts."""
    half = len(x) // 2
    return np.asarray(x[:half] + 1j * x[half:])


def _columns(records: Records, contour: Contour, nodes: Int) -> list[Complex]:
    """Of each piece (n_lines, 2 n_nodes), in units of the root of its record's power, of several
    inputs one beside the other; those of one shape are computed together."""
    out: dict[int, Complex] = {}
    shapes = [
        (p.history, len(p.z), band) for p, band in zip(records.pieces, records.bands, strict=True)
    ]
    for shape in set(shapes):
        own = [i for i, s in enumerate(shapes) if s == shape]
        X = [contour.damped(r) for i in own for r in by_input(records.pieces[i].r)]
        lines = records.lines(records.pieces[own[0]])
        both = columns(contour, np.stack(X), nodes, *shape[:2], lines.k)
        m = len(both) // len(own)
        for j in records.undriven:
            both[j::m] = 0.0
        both *= 1 / np.sqrt(shape[1])
        for j, i in enumerate(own):
            out[i] = both[j] if m == 1 else np.concatenate(both[j * m : (j + 1) * m], axis=1)
    return [out[i] for i in range(len(records.pieces))]


def by_input(r: Float) -> Float:
    """(m, n) of r (n,) or (n, m)."""
    return r[None] if r.ndim == 1 else r.T


def _between(nodes: Int, few: Int) -> Float:
    """(b, m) a change on the nodes, of one on few of them, linear between."""
    return np.stack([np.interp(nodes, few, one) for one in np.eye(few.size)], axis=1)


@dataclass(frozen=True, slots=True)
class _Free:
    """A change that is free where noise is estimated, and the lines that show it together: each
    piece's by themselves where they are enough.

    rows : of all lines. groups : pieces, their lines (n,), and (2 n, p) what the change does in
    these, of every sensor.
    """

    rows: Rows
    groups: list[tuple[Sequence[int], Int, Float]]

    @classmethod
    def of(cls, rows: Rows, changes: Sequence[Complex], spare: Float) -> _Free:
        """changes : of each piece, as `_columns`. spare : (b, m) the change that is free, on the
        nodes."""
        b, n = len(spare), len(rows.e)
        parts = range(0, rows.X.shape[1], b)
        each = []
        for change in changes:
            real = as_real(change)
            each.append(np.concatenate([real[:, i : i + b] @ spare for i in parts], axis=1))
        if len(parts) > 2:
            _excited(each, len(parts) // 2)
        pieces = [on for on, _ in rows.each()]
        if all(len(on) >= ENOUGH * _free(X) for on, X in zip(pieces, each, strict=True)):
            alone = zip(pieces, each, strict=True)
            return cls(rows, [([i], on, X) for i, (on, X) in enumerate(alone)])
        X = np.empty((2 * n, each[0].shape[1]))
        for on, own in zip(pieces, each, strict=True):
            X[np.concatenate([on, n + on])] = own
        return cls(rows, [(range(len(each)), np.arange(n), X)])


def _residual(change: _Free, seen: Sequence[Seen]) -> tuple[Complex, Float]:
    """What the best change of each sensor in each piece leaves (n, q), and the freedom (n,) that
    each line has left: pieces that differ by more than noise are not noise."""
    n, q = change.rows.e.shape
    left, free = np.zeros((n, q), complex), np.zeros(n)
    for which, on, X in change.groups:
        piece = change.rows.piece[on]
        each = [(np.flatnonzero(piece == i), seen[i].N) for i in which]
        left[on], free[on] = _of_pieces(change.rows.e[on], each, X)
    return left, free


def _excited(each: Sequence[Float], inputs: int) -> None:
    """Take out of what changes do in each piece (2 n, p) what those of an input do that rests in
    it."""
    parts = [X.reshape(len(X), inputs, -1) for X in each]
    size = np.sqrt([np.mean(np.sum(X**2, axis=2), axis=0) for X in parts])
    for X, rests in zip(parts, size < RESTS * size.max(axis=0), strict=True):
        X[:, rests] = 0.0


def _free(X: Float) -> int:
    """Columns that do anything."""
    return int(np.count_nonzero(np.any(X != 0, axis=0)))


def _of_pieces(e: Complex, each: Sequence[tuple[Int, Complex]], X: Float) -> tuple[Complex, Float]:
    """As `_residual`, of pieces that share one change X (2 n, p). Nuisances are projected out piece
    by piece: side by side those of many pieces would be many times as much as all lines.

    each : of every piece its lines, and their nuisances.
    """
    n, q = e.shape
    goal, used = as_real(e), np.zeros(2 * n)
    size = np.linalg.norm(X, axis=0)
    X = X / np.where(size > 0, size, 1.0)
    for c in range(q):
        change = X.copy()
        for on, N in each:
            at = np.concatenate([on, n + on]) if len(each) > 1 else slice(None)
            own = _spanned(_nuisances_of(N[:, c]))
            change[at] -= own @ (own.T @ change[at])
            goal[at, c] -= own @ (own.T @ goal[at, c])
            used[at] += _lengths(own)
        change = _spanned(change)
        goal[:, c] -= change @ (change.T @ goal[:, c])
        used += _lengths(change)
    return as_complex(goal), np.maximum(1 - (used[:n] + used[n:]) / (2 * q), 0.0)


def _nuisances_of(N: Complex) -> Float:
    """(2 n, m) those of (n, m_all) that there are in one sensor, of size 1."""
    some = as_real(N[:, np.any(N != 0, axis=0)])
    return np.asarray(some / np.linalg.norm(some, axis=0))


def _lengths(Q: Float) -> Float:
    """(n,) squares of the rows of Q (n, m)."""
    return np.asarray(np.einsum("ij,ij->i", Q, Q))


def orthonormal(X: Float) -> Float:
    """The directions of the columns of X (n, m), n > m."""
    scale = np.linalg.norm(X, axis=0)
    return _spanned(X / np.where(scale > 0, scale, 1.0))


def _spanned(X: Float) -> Float:
    """The directions of columns that are of size 1, or were before something was projected out."""
    values, vectors = np.linalg.eigh(X.T @ X)
    kept = values > SAME * np.max(values, initial=0.0)
    return np.asarray(X @ (vectors[:, kept] / np.sqrt(values[kept])))


@dataclass(frozen=True, slots=True)
class _Form:
    known: float
    factor: Float
    target: Float
    total: float
    nuisances: int
    log_determinant: float


def _quadratic(rows: Rows, noise: Noise, reference: Complex) -> _Form:
    """factor, target of `Reduced`, and chi-square of the reference with the best nuisances."""
    b, q = reference.shape  # q : of each input by itself, where there are several
    W = _weights(rows, noise)
    We = (W @ rows.e[:, :, None])[:, :, 0]
    M, g = _products(rows.X, W, We)
    cross, own_head = _nuisances(rows, W, We)
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
        nuisances=own_head.size,
        log_determinant=-2
        * float(np.sum(np.linalg.slogdet(W)[1])),  # but for a constant of the lines
    )


def _weights(rows: Rows, noise: Noise) -> Complex:
    """(n, q, q) twice the inverse of the noise: real and imaginary parts count by themselves."""
    L = np.linalg.inv(noise.root(rows.f, rows.piece))
    return np.asarray(2 * (L.conj().swapaxes(1, 2) @ L))


def _nuisances(rows: Rows, W: Complex, We: Complex) -> tuple[Float, Float]:
    """The directions of all nuisances, of length 1: their products with the changes of all nodes
    (q 2 b, m), and with what the reference leaves (m,)."""
    found = []
    for on, N in rows.each():
        X = rows.X[on]
        q, m = N.shape[1:]
        flat = N.reshape(-1, m)
        WN = W[on] @ N
        square = (flat.conj().T @ WN.reshape(-1, m)).real
        values, turn = directions(square)
        cross = as_real(X).T @ as_real(WN.reshape(-1, q * m))
        cross = cross.reshape(-1, q, m).swapaxes(0, 1).reshape(-1, m)
        head = (flat.conj().T @ We[on].ravel()).real
        found.append((values, turn, cross, head))
    largest = max(float(np.max(values, initial=0.0)) for values, *_ in found)
    crosses, heads = [], []
    for values, turn, cross, head in found:
        kept = values > SAME * largest
        root = turn[:, kept] / np.sqrt(values[kept])
        crosses.append(cross @ root)
        heads.append(root.T @ head)
    return np.concatenate(crosses, axis=1), np.concatenate(heads)


def _products(X: Complex, W: Complex, We: Complex) -> tuple[Float, Float]:
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
