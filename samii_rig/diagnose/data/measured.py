"""What was measured, in noise units and small enough to refit a model a thousand times.

All lines of all responses count, each with its full covariance. Neighbouring lines are
combined after the model's own shape has been divided out, which loses nothing where the
ratio of truth to model is smooth; where it is not, the bin is split (`binned`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from samii_rig.errors import InputError
from samii_rig.identify.data import collect
from samii_rig.rig.schema import Rig
from samii_rig.signal import welch
from samii_rig.types import Complex, Float, FrequencyResponse, Int

BINS = 180  # to begin with; a refit costs a few milliseconds
MOST_BINS = 400  # after divisions
SPLIT = 6.0  # standard deviations of chi-square inside a bin above which it is divided
COARSE = 0.01  # of a model's misfit, over noise, that may be lost in a bin
SHAPE = 0.6  # weight of the response's own arc (logarithm, radians) against log frequency
TEST_LINE = 5  # the last of so many lines is a test line
PERIODIC = ("periodic", "stepped")  # methods of excitations that repeat themselves
# Methods of which a line is a whole number of cycles a record (or a period).
WHOLE = ("burst", "settled", "periodic")
# Cycles a record up to which a slow drift leaves more than the covariance, pooled over
# neighbouring lines, says: what is left of it falls with the square of the frequency.
DRIFTING = 4.5
# Of a bin's precision, what is below is rounding: its lines know a sum of entries alone.
SUMS = 1e-12
DIFFER = 1.5  # chi-square per degree of freedom of levels against each other
TRANSIENTS = "local"  # method of responses from single transients: see `usable`


@dataclass(frozen=True, slots=True)
class Measured:
    """Lines, or bins of lines, sorted by frequency.

    frequency : (n,) Hz. H : (n, q) of the entries (sensor, actuator), (q,) indices into the
        rig's. W : (n, q, q) precision such that e^H W e of the truth has the mean `expected`
        (n,), about twice the entries measured there; 0 where an entry was not measured. Of
        entries that an undriven loop ties together W knows their sum alone.
    level : (n,) index into `levels`, -1 where several were combined; a periodic excitation
        and a transient of one level have an index each (`periodic`: of each level, whether it
        is one). ringing : of each level, whether its runs ended while the rig still moved, so
        that local models had to part the transient from the response.
    scatter : (n,) each line's part of the variance of chi-square.
    inside : chi-square lost by combining lines, and the mean of that under the truth.
    """

    frequency: Float
    H: Complex
    W: Complex
    expected: Float
    level: Int
    scatter: Float
    levels: tuple[tuple[float, str], ...]
    periodic: tuple[bool, ...]
    ringing: tuple[bool, ...]
    sensor: Int
    actuator: Int
    outputs: tuple[str, ...]
    inside: tuple[float, float]
    rate_hz: float

    @property
    def n(self) -> int:
        """Lines or bins."""
        return int(self.frequency.size)

    @property
    def spread(self) -> float:
        """Relative variance of chi-square over all lines."""
        return float(np.sum(self.scatter) / max(float(np.sum(self.expected)), 1e-300) ** 2)

    def root(self) -> Complex:
        """(n, q, q) R with R^H R = W."""
        values, vectors = np.linalg.eigh(self.W)
        return np.asarray(
            np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.conj().swapaxes(1, 2)
        )

    def disagreeing(self) -> tuple[float, float]:
        """Chi-square of the levels against each other, line by line, and its mean."""
        f, which = np.unique(self.frequency, return_inverse=True)
        A = summed(self.W, which, f.size)
        b = summed(np.einsum("nij,nj->ni", self.W, self.H), which, f.size)
        common = np.einsum("gij,gj->gi", np.linalg.pinv(A, rcond=1e-12, hermitian=True), b)
        times = np.bincount(which)[which]
        several = times > 1
        mean = float(np.sum((self.expected * (1 - 1 / times))[several]))
        return float(np.sum(self.chi_square(common[which])[several])), mean

    def differing(self) -> float:
        """Chi-square per degree of freedom of the levels against each other, line by line; nan
        where no line was measured at two of them."""
        left, mean = self.disagreeing()
        return left / mean if mean > 0 else math.nan

    def depends_on_level(self) -> bool:
        """Whether levels differ by far more than noise makes them."""
        return self.differing() > DIFFER

    def take(self, mask: NDArray[np.bool_]) -> Measured:
        """Some of the lines."""
        return replace(
            self,
            frequency=self.frequency[mask],
            H=self.H[mask],
            W=self.W[mask],
            expected=self.expected[mask],
            level=self.level[mask],
            scatter=self.scatter[mask],
        )

    def splits(self) -> tuple[Measured, Measured | None, Measured]:
        """The lines to fit, to decide on and to show on; their noise is independent.

        Transients (bursts) are fitted. Of a periodic excitation the middle level shows and the
        others decide whether what was fitted holds; of less than three levels, lines in turn.
        One of a level whose bursts end while the rig rings is fitted as well: what a force does
        is known where the input repeats itself alone. If that leaves none but the middle level,
        its lines decide and show in turn. Where there is but one kind of excitation, one line
        in five of it shows, at least one, and nothing but the fit decides.
        """
        turn = np.zeros(self.n, dtype=np.int64)
        for level in np.unique(self.level):
            at = np.flatnonzero(self.level == level)
            turn[at] = np.arange(at.size)
        repeats = np.array(self.periodic)[self.level]
        if repeats.any() and not repeats.all():
            own = sorted(np.unique(self.level[repeats]), key=lambda k: self.levels[k][0])
            others = [k for k in own if k != own[len(own) // 2]] if len(own) > 2 else []
            in_place = [k for k in others if self._bursts_ring(k)]
            fitted = ~repeats | np.isin(self.level, in_place)
            deciding = [k for k in others if k not in in_place]
            decides = np.isin(self.level, deciding) if deciding else ~fitted & (turn % 2 == 0)
            shown = ~fitted & ~decides
            if shown.any():
                return self.take(fitted), self.take(decides), self.take(shown)
            return self.take(~repeats), None, self.take(repeats)
        shown = turn % TEST_LINE == TEST_LINE - 1
        if not shown.any():  # a few frequencies, one by one
            shown = np.arange(self.n) == self.n // 2
        return self.take(~shown), None, self.take(shown)

    def _bursts_ring(self, level: int) -> bool:
        """Whether the transients of a periodic level's amplitude end while the rig moves."""
        alike = zip(self.levels, self.periodic, self.ringing, strict=True)
        return any(r and not p and x == self.levels[level] for x, p, r in alike)

    def chi_square(self, h: Complex) -> Float:
        """(n,) e^H W e of a prediction (n, q)."""
        e = h - self.H
        return np.asarray(np.einsum("ni,nij,nj->n", e.conj(), self.W, e).real)

    def per_dof(self, h: Complex) -> float:
        """Chi-square of a prediction (n, q) per degree of freedom."""
        return float(np.sum(self.chi_square(h)) / np.sum(self.expected))


def summed(values: Complex, which: Int, n: int) -> Complex:
    """(n, ...) sums of `values` over the lines of each of n groups. which : of each line."""
    out = np.zeros((n, *values.shape[1:]), complex)
    np.add.at(out, which, values)
    return out


def repeated(response: FrequencyResponse) -> bool:
    """Whether repeats tell a response's noise."""
    if response.estimator in welch.METHODS:  # whose leakage is not in their covariance
        return False
    return response.n_averages > 1 or response.estimator != TRANSIENTS


def usable(responses: Sequence[FrequencyResponse]) -> list[FrequencyResponse]:
    """The responses whose intervals a chi-square test can rest on.

    Those of one transient (a step, a single sweep) have no repeats to take the noise from, and
    what the local models leave of the transient is not in their covariance. They are used only
    where there is nothing else.
    """
    trusted = [r for r in responses if repeated(r)]
    return trusted or list(responses)


def measured(
    responses: Sequence[FrequencyResponse], rig: Rig, band: tuple[float, float] | None = None
) -> Measured:
    """All lines of `responses`, as `identify.data.collect` gives them.

    Raises what `collect` does; InputError where the sample rate is not the rig's.
    """
    data = collect(responses, rig, band)
    rate = data.lines[0].response.rate_hz
    whole_part(rate, rig)
    columns = [[d.actuator, *(np.full(d.p, a) for a, _ in d.follow)] for d in data.lines]
    by_column = [(d, own) for d, each in zip(data.lines, columns, strict=True) for own in each]
    pairs = sorted(
        {(int(s), int(a)) for d, own in by_column for s, a in zip(d.sensor, own, strict=True)}
    )
    levels = tuple(dict.fromkeys(_level(d.response) for d in data.lines))
    ringing = {_level(d.response) for d in data.lines if d.response.estimator == TRANSIENTS}
    blocks = []
    for d, each in zip(data.lines, columns, strict=True):
        n, q = len(d.frequency), len(pairs)
        H = np.zeros((n, q), complex)
        half = np.zeros((n, d.p, q), complex)  # half H is what was measured, in units of its noise
        at = [
            [pairs.index((int(s), int(a))) for s, a in zip(d.sensor, own, strict=True)]
            for own in each
        ]
        H[:, at[0]] = d.H
        for own, moved in zip(at, (np.ones((n, d.p)), *(x for _, x in d.follow)), strict=True):
            half[:, :, own] += d.root * moved[:, None, :]
        W = 2 * d.factor[:, None, None] * (half.conj().swapaxes(1, 2) @ half)
        expected = 2 * d.factor * d.mean()
        index = levels.index(_level(d.response))
        groups = max(1.0, n / d.shared[0])
        alone = max(1.0, n / d.shared[1])
        sized = float(np.sum(expected))
        variance = sized**2 * (1 / alone + 1 / (float(np.mean(d.dof)) * groups)) / d.p
        scatter = variance * expected / sized
        block = (d.frequency, H, W, expected, np.full(n, index), scatter)
        blocks.append([x[_clear_of_drift(d.response, d.frequency)] for x in block])
    f, H, W, expected, level, noise = (np.concatenate(x) for x in zip(*blocks, strict=True))
    order = np.argsort(f, kind="stable")
    return Measured(
        frequency=f[order],
        H=H[order],
        W=W[order],
        expected=expected[order],
        level=level[order],
        scatter=noise[order],
        levels=tuple((value, unit) for value, unit, _ in levels),
        periodic=tuple(repeats for _, _, repeats in levels),
        ringing=tuple(level in ringing for level in levels),
        sensor=np.array([s for s, _ in pairs], dtype=np.int64),
        actuator=np.array([a for _, a in pairs], dtype=np.int64),
        outputs=tuple(rig.sensor[s].name for s, _ in pairs),
        inside=(0.0, 0.0),
        rate_hz=rate,
    )


def whole_part(rate_hz: float, rig: Rig) -> int:
    """How many of the rig's samples there are to each that was recorded.

    Raises InputError where that is no whole number.
    """
    times = rig.rate_hz / rate_hz
    if times < 1 - 1e-6 or abs(times / round(times) - 1) > 1e-6:
        whole = f"the rig's rate, {rig.rate_hz:g} Hz, or a whole part of it"
        raise InputError("recording", "rate_hz", rate_hz, whole)
    return round(times)


def _level(response: FrequencyResponse) -> tuple[float, str, bool]:
    return response.level, response.level_unit, response.estimator in PERIODIC


def of_level(
    responses: Sequence[FrequencyResponse], level: tuple[float, str], periodic: bool
) -> list[FrequencyResponse]:
    """Those of one entry of `Measured.levels`."""
    return [r for r in responses if _level(r) == (*level, periodic)]


def _clear_of_drift(response: FrequencyResponse, f: Float) -> NDArray[np.bool_]:
    """Which lines a drift does not reach; all of them where that would be few."""
    whole = response.estimator in WHOLE and response.frequency.size > 2 * DRIFTING
    if not whole:
        return np.ones(f.size, dtype=bool)
    return np.asarray(f > DRIFTING * float(np.min(np.diff(response.frequency))))


def binned(
    lines: Measured,
    shape: Complex,
    bins: int = BINS,
    most: int = MOST_BINS,
    misfit: float = 1.0,
) -> Measured:
    """Lines combined into bins, each at the line nearest its middle.

    shape : (n, q) a model at the lines. In a bin the truth is taken for the model times one
    complex factor for each entry; chi-square about that is kept in `inside`, and a bin in
    which it is too large is divided, up to `most` bins. misfit : chi-square over its mean that
    the model has anyhow; where it is large, bins need not be fine.
    """
    split = SPLIT * max(1.0, COARSE * misfit)
    size = np.abs(shape)
    smooth = np.where(size > 0, shape, 1.0)
    arc = np.abs(np.diff(np.log(smooth), axis=0).real) + np.abs(np.angle(smooth[1:] / smooth[:-1]))
    step = np.diff(np.log(lines.frequency)) / np.log(lines.frequency[-1] / lines.frequency[0])
    metric = step + SHAPE * arc.sum(axis=1) / max(float(arc.sum()), 1e-12)
    place = np.concatenate([[0.0], np.cumsum(metric)])
    at = np.searchsorted(place, np.linspace(0, place[-1], min(bins, lines.n) + 1)[:-1])
    starts = np.unique(_edges(lines.frequency, at))
    while True:
        found, chi, mean = combined(lines, smooth, starts)
        counts = np.diff(np.append(starts, lines.n))
        bad = (chi - mean > split * np.sqrt(2 * np.maximum(mean, 1.0))) & (counts > 1)
        more = _edges(lines.frequency, (starts + counts // 2)[bad])
        new = np.unique(np.concatenate([starts, more]))
        if new.size == starts.size or new.size > most:
            return found
        starts = new


def _edges(f: Float, at: Int) -> Int:
    """The same places, moved back to the first line of that frequency (another level's)."""
    return np.asarray(np.searchsorted(f, f[at]), dtype=np.int64)


def combined(lines: Measured, shape: Complex, starts: Int) -> tuple[Measured, Float, Float]:
    """Lines in bins that begin at `starts`, as `binned`; chi-square inside each and its mean."""
    counts = np.diff(np.append(starts, lines.n))
    centre = starts + (counts - 1) // 2
    which = np.repeat(np.arange(starts.size), counts)
    D = shape / shape[centre][which]
    DW = D.conj()[:, :, None] * lines.W
    W = np.add.reduceat(DW * D[:, None, :], starts)
    right = np.add.reduceat((DW @ lines.H[:, :, None])[:, :, 0], starts)
    power = np.add.reduceat(
        np.einsum("ni,nij,nj->n", lines.H.conj(), lines.W, lines.H).real, starts
    )
    diagonal = np.diagonal(W, axis1=1, axis2=2).real
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    unit = W / (scale[:, :, None] * scale[:, None, :])
    inverse = np.linalg.pinv(unit, rcond=SUMS, hermitian=True)
    H = (inverse @ (right / scale)[:, :, None])[:, :, 0] / scale
    chi = np.maximum(power - np.einsum("ni,ni->n", H.conj(), right).real, 0.0)
    expected = np.add.reduceat(lines.expected, starts)
    mean = expected * (1 - 1 / counts)
    same = np.minimum.reduceat(lines.level, starts) == np.maximum.reduceat(lines.level, starts)
    found = replace(
        lines,
        frequency=lines.frequency[centre],
        H=np.asarray(H, np.complex128),
        W=W,
        expected=expected - mean,
        level=np.where(same, lines.level[starts], -1),
        scatter=np.add.reduceat(lines.scatter, starts),
        inside=(float(np.sum(chi)), float(np.sum(mean))),
    )
    return found, chi, mean
