"""A stiffness that is not the same all the time: it swings, drifts, or differs from run to run.

To first order a spring that is softer by dk(t) adds the torque dk(t) phi(t), phi the way over it as
the linear rig moves. With pull(t) what a fit leaves, taken back to the torque that would
explain it, how far a change cos(Omega t) lies along that is the Fourier coefficient of phi pull,

    P(Omega) = sum_t phi(t) pull(t) exp(-j Omega t),   |P|^2 has the mean
    V(Omega) = sum_tau R_phi(tau) R_pull(tau) cos(Omega tau)

under noise alone, which knows nothing of phi: R_phi the products of the motion with itself, R_pull
the covariance of the pull, of the noise's own spectrum. So 2 |P|^2/V is chi-square with two degrees
of freedom at every Omega, summed over the records with two for each. Where it is largest both
phases are computed exactly: ends and all, and as one where the motion is short for a slow
modulation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import optimize, stats
from scipy.sparse import linalg

from samii_rig.diagnose.fit.between_runs import STIFFNESS
from samii_rig.diagnose.forces.laws import HARDENING
from samii_rig.diagnose.forces.paths import Span
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.likelihood.pieces import turn_to
from samii_rig.likelihood.unexplained import Unexplained
from samii_rig.types import Complex, Float, Int

# Periods in the longest record: a slower swing moves no line beside another, and is a constant.
SLOWEST = 1.0
FASTEST = 0.2  # of the highest frequency in the records: what varies faster is no stiffness
FINE = 4  # frequencies for each that the longest record resolves
ALARM = 2e-3  # chance that noise alone makes any stiffness vary
ONE_PHASE = 1e-3  # of V: less variance is that of a phase which the motion does not show
FLAT_OVER = 1e-2  # of the distance between frequencies that are tried: nearer, chi-square is flat
# Powers of the motion that a spring's force has which is not the same to both sides: of one that is
# stiffer to one side, and of the first that a curve has.
SIDES = (1, 2)
SELF_SOLVED = 1e-3  # of a force, to which what it does to itself is solved
ROUNDED = 1e-6  # of the largest variance: less is rounding
VARIANCES = (
    400  # that are tried: 40 to a decade where records differ by ten, as likelihoods are flat there
)


@dataclass(frozen=True, slots=True)
class Springs:
    """The springs of a rig, and what noise may make of their search.

    each : (site, its place). f : (m,) Hz, at which a modulation is looked for. longest : s, record.
    """

    each: tuple[tuple[str, Place], ...]
    f: Float
    longest: float

    @classmethod
    def of(cls, search: ForceSearch) -> Springs:
        """Of a rig that moves."""
        records, paths = search.levels.records, search.paths
        longest = max(len(p.z) for p in records.pieces) / records.rate_hz
        f = np.arange(SLOWEST / longest, FASTEST * records.band[1], 1 / (FINE * longest))
        laws = [e for e in search.forces if e.force is not None and e.force.law is HARDENING]
        each = ((e.site, e.force.place) for e in laws if e.force is not None)
        return cls(
            tuple(one for one in each if f.size and paths.scale((one[0], STIFFNESS)) > 0),
            f,
            longest,
        )

    def pieces(
        self, search: ForceSearch, left: Sequence[Unexplained], only: str = ""
    ) -> dict[str, list[PieceModulation]]:
        """What is `left` of all pieces, taken back to each spring at which a force acts. only : the
        spring that is looked at, all if none."""
        each = (
            (site, piece_modulations(search, place, left))
            for site, place in self.each
            if only in ("", site)
        )
        return {site: pieces for site, pieces in each if pieces}

    def strongest(
        self, by_site: Mapping[str, Sequence[PieceModulation]]
    ) -> list[tuple[str, Modulation]]:
        """Of each spring what explains most, the best first; none where noise could do as much."""
        found = [
            (site, Modulation.of(pieces, self.f, 2 * self.longest * float(self.f[-1])))
            for site, pieces in by_site.items()
        ]
        found.sort(key=lambda one: -one[1].gain)
        if not found or len(found) * found[0][1].false_alarm > ALARM:
            return []
        return found


def piece_modulations(
    search: ForceSearch, place: Place, left: Sequence[Unexplained]
) -> list[PieceModulation]:
    """What is left of all pieces, taken back to a place; none where no force acts there."""
    paths = search.paths
    ports = paths.ports(place, of_speed=False)
    if ports is None:
        return []
    motion = paths.motion(place, of_speed=False)
    each = zip(paths.spans, motion, ports.sensors, left, strict=True)
    return [PieceModulation.of(*one) for one in each]


@dataclass(frozen=True, slots=True)
class PieceModulation:
    """Of one piece and its repeats.

    span, left : of the piece. phi : (M,) the way over the spring. sensors : (M//2 + 1, q) lines of
    a unit force. times : (rows,) of each the motion. along : (rows, M) phi pull. f : (m,) Hz.
    P : (rows, m). V : (m,) of a row that is once the motion.
    """

    span: Span
    left: Unexplained
    phi: Float
    sensors: Complex
    times: Float
    along: Float
    f: Float
    P: Complex
    V: Float

    @classmethod
    def of(cls, span: Span, phi: Float, sensors: Complex, left: Unexplained) -> PieceModulation:
        """As above."""
        times = np.ones(len(left.white))
        times[0] = span.times  # a piece is so many times the motion, its repeats differ
        pull = np.stack(
            [
                projected_back(span, sensors, left.k, a, t)
                for a, t in zip(left.pull, times, strict=True)
            ]
        )
        size = 2 * phi.size  # nothing wraps around
        phi = phi * span.alive
        f = np.arange(size // 2 + 1) * (span.rate_hz * span.n / span.samples / size)
        along = phi * pull
        P, V = np.fft.rfft(along, size, axis=1), _variance(span, phi, sensors, left)
        return cls(span, left, phi, sensors, times, along, np.asarray(f, np.float64), P, V)

    def chi_square(self) -> Float:
        """(m,) 2 |P|^2/V of all rows; none where no sensor shows the force."""
        power = np.sum(np.abs(self.P / self.times[:, None]) ** 2, axis=0)
        seen = ROUNDED * self.V.max() < self.V
        return np.asarray(np.divide(2 * power, self.V, out=np.zeros_like(power), where=seen))

    def exact(self, hz: float) -> tuple[float, int, float]:
        """Chi-square of all rows at a frequency, beyond what another constant stiffness of each
        does, its degrees of freedom, and what is known of both phases of a modulation."""
        chi2, free, known = (float(x) for x in np.sum(self.each(hz), axis=0))
        return chi2, round(free), known

    def each(self, hz: float) -> Float:
        """(rows, 3) chi-square of each row, its degrees of freedom, and what is known, as of
        `exact`: repeats show a modulation alike, as its phase is another in each."""
        chi2, free, known = self._rows(hz)
        rows = chi2.size
        return np.column_stack([chi2, np.full(rows, free), np.full(rows, known / rows)])

    def differing(self, hz: float) -> tuple[float, int]:
        """Chi-square of what repeats differ by, of them alone, and its degrees of freedom. hz : 0
        for what differs from record to record."""
        if hz > 0:
            chi2, free, _ = self._rows(hz)
        else:
            P, known, _ = self.constants()
            shown = bool(known[0] > ROUNDED * self.V.max())
            chi2, free = (P**2 / known, 1) if shown else (0 * P, 0)
        return float(np.sum(chi2[1:])), free * (self.times.size - 1)

    def _rows(self, hz: float) -> tuple[Float, int, float]:
        """Chi-square of each row, its degrees of freedom, and what all tell of both phases."""
        G, pull = self.normal([hz])
        if not G[0, 0] > ROUNDED * self.V.max():
            return np.zeros(self.times.size), 0, 0.0
        share = G[1:, :1] / G[0, 0]
        power, phases = np.linalg.eigh(G[1:, 1:] - share * G[:1, 1:])
        shown = power > ONE_PHASE * np.trace(G[1:, 1:])
        along = phases.T @ (pull[1:] - share * pull[:1])
        chi2 = np.sum(along[shown] ** 2 / power[shown, None], axis=0)
        # Records that repeat each other are turned, by which their sum of squares stays.
        known = float(np.sum(power[shown])) * float(self.times[0] ** 2)
        return chi2, int(np.count_nonzero(shown)), known

    def constants(self) -> tuple[Float, Float, Float]:
        """(rows,) how far a constant change lies along what is left, what is known of it, and of
        one that is as large in each record as the motion is."""
        known = self._products([np.ones(self.phi.size)])[0, 0]
        return self.P[:, 0].real / self.times, np.full(self.times.size, known), self.times

    def uneven(self, power: int) -> tuple[Float, Float]:
        """Normal equations (2, 2) of a constant and of a stiffness that follows the sign of the
        motion (its force has power 1) or the motion (2), and their right side (2,). What repeats
        differ by has neither."""
        shape = np.sign(self.phi) if power == 1 else self.phi
        shapes = [np.ones(self.phi.size), shape]
        size = np.array([self.times[0], self.times[0] ** power])
        G = self._products(shapes) * np.outer(size, size)
        return G, np.array(shapes) @ self.along[0] / self.times[0] * size

    def changes(self, each: Sequence[float]) -> Float:
        """(rows, 1 + 2 m) of a row that is once the motion: a constant, and the cosine and sine by
        which a stiffness swings at m frequencies."""
        G, pull = self.normal(each)
        return np.asarray(np.linalg.lstsq(G, pull, rcond=ONE_PHASE**2)[0].T)

    def without(self, hz: float) -> PieceModulation:
        """The same less what a constant and a modulation do at their best."""
        span, left = self.span, self.left
        forces = self.phi * (self.changes([hz]) @ np.array(self._waves([hz])))
        lines = [span.lines(span.damped(e), self.sensors, left.k) / span.times for e in forces]
        white = left.white - np.einsum("nij,rnj->rni", left.root, np.stack(lines))
        return PieceModulation.of(span, self.phi, self.sensors, replace(left, white=white))

    def added(
        self, changes: Float, each: Sequence[float], back: Complex, parts: Sequence[float]
    ) -> Float:
        """(rows, samples, q) what sensors show of these, at the record's rate. back : as `Ports`
        has it. parts : of the records, of which the first row is the sum."""
        forces = self.forces(changes, each, back, parts)
        return np.stack([self.span.sampled(self.span.damped(e), self.sensors) for e in forces])

    def of_records(self, parts: Sequence[float]) -> tuple[Float, Float]:
        """(rows, records) by which records are turned to rows, and (records,) how many times the
        motion each has. parts : of the records, of which the first row is the sum."""
        turn = turn_to(np.array(parts))
        return turn, self.times[0] * turn[0]

    def forces(
        self, changes: Float, each: Sequence[float], back: Complex, parts: Sequence[float]
    ) -> Float:
        """(rows, M) the force of each row, e = dk (motion + back e) of each record by itself: what
        the change adds to the motion it changes too."""
        turn, size = self.of_records(parts)
        dk = (turn.T @ changes / size[:, None]) @ np.array(self._waves(each))
        each_record = zip(dk, size, strict=True)
        return np.asarray(turn @ np.stack([self._force(x, n, back) for x, n in each_record]))

    def _force(self, dk: Float, size: float, back: Complex) -> Float:
        """(M,) e = dk (size phi + back e)."""
        span, M = self.span, self.phi.size

        def rest(e: Float) -> Float:
            moved = np.fft.irfft(back * span.damped(e), M) / span.decay * span.alive
            return np.asarray(e - dk * moved)

        first = dk * (size * self.phi)
        if not first.any():
            return first
        whole = linalg.LinearOperator((M, M), matvec=rest, dtype=first.dtype)
        return np.asarray(linalg.gmres(whole, first, rtol=SELF_SOLVED, maxiter=1)[0])

    def _waves(self, each: Sequence[float], *, slopes: bool = False) -> list[Float]:
        """(M,) a constant, then cosine and sine of each frequency; then both times t (s). Time runs
        from the record's first sample; the input before it stands at the end."""
        M, span = self.phi.size, self.span
        t = np.arange(M, dtype=float)
        t[M - span.before :] -= M
        t *= span.samples / span.n / span.rate_hz
        both = [wave(2 * np.pi * hz * t) for hz in each for wave in (np.cos, np.sin)]
        return [np.ones(M), *both, *(t * x for x in both if slopes)]

    def normal(self, each: Sequence[float], *, slopes: bool = False) -> tuple[Float, Float]:
        """Normal equations (n, n) of a constant and both phases of each frequency, n = 1 + 2 m, or
        of those times t too, n = 1 + 4 m, of a row that is once the motion; and their right sides
        (n, rows)."""
        shapes = self._waves(each, slopes=slopes)
        return self._products(shapes), np.array(shapes) @ self.along.T / self.times

    def _products(self, shapes: Sequence[Float]) -> Float:
        """Of what forces phi x (M,) add to the whitened lines of a row that is once the motion."""
        span, left = self.span, self.left
        each = [span.lines(span.damped(self.phi * x), self.sensors, left.k) for x in shapes]
        white = (left.root @ np.stack(each, axis=2)).reshape(-1, len(shapes)) / span.times
        return np.asarray((white.conj().T @ white).real)


def projected_back(span: Span, sensors: Complex, k: Int, lines: Complex, times: float) -> Float:
    """(M,) so that its product with a force (M,), summed up, is that of `lines` (n, q) with what
    the force adds to the lines k: `Span.lines` and `Span.damped` turned round."""
    spectrum = np.zeros((span.n // 2 + 1, lines.shape[1]), complex)
    spectrum[k] = lines
    size = times * math.sqrt(span.samples) / 2
    y = np.fft.irfft(spectrum, span.n, axis=0) * (size / span.decay[: span.n])[:, None]
    back = np.sum(sensors.conj() * np.fft.rfft(y, span.decay.size, axis=0), axis=1)
    return np.asarray(np.fft.irfft(back, span.decay.size) * span.alive * span.decay)


def _variance(span: Span, phi: Float, sensors: Complex, left: Unexplained) -> Float:
    """(M + 1,) V at multiples of half the contour's spacing, of a row that is once the motion."""
    M, n = phi.size, span.n
    at = np.rint(left.k * (M / n)).astype(np.int64)
    power = np.zeros(M // 2 + 1)
    white = (left.root @ sensors[at][:, :, None])[:, :, 0]
    np.add.at(power, at, np.sum(np.abs(white) ** 2, axis=1) * (span.samples / n**2))
    of_pull = np.fft.irfft(power, M)[:n] * (M / 2)
    of_phi = np.fft.irfft(np.abs(np.fft.rfft(phi, 2 * M)) ** 2, 2 * M)
    both = np.zeros(2 * M)
    both[:n] = of_phi[:n] * of_pull
    both[1 - n :] = both[1:n][::-1]
    return np.asarray(np.fft.rfft(both).real)


@dataclass(frozen=True, slots=True)
class Modulation:
    """At one spring, where most is explained. hz : 0 for what differs from record to record. chi2,
    with `free` degrees of freedom. known : of its amplitude's square, or of its mean square.
    trials : independent ones at this spring, of which it is the best: half the probability of a
    false alarm is that of a modulation at any frequency.
    louder : the noise there than it is told, in its power. each : (m, 3) chi-square, degrees of
    freedom and what is known, of records that do not show it alike; none where they do."""

    hz: float
    chi2: float
    free: int
    known: float
    trials: float = 2.0
    louder: float = 1.0
    each: Float = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def of(cls, pieces: Sequence[PieceModulation], f: Float, many: float) -> Modulation:
        """Of all pieces, at one frequency of f (m,) Hz, of which so many are independent, or from
        record to record."""
        hz = float(f[np.argmax(_scan(pieces, f))])
        # Without the modulation, which is as wide as the motion is short.
        louder = louder_beside([one.without(hz) for one in pieces], hz, f)
        return min(
            cls._at(pieces, hz, 2 * many, louder), _between(pieces), key=lambda one: one.false_alarm
        )

    @classmethod
    def _at(
        cls,
        pieces: Sequence[PieceModulation],
        hz: float,
        trials: float,
        louder: float,
    ) -> Modulation:
        each = np.concatenate([one.each(hz) for one in pieces]) / [louder, 1.0, louder]
        chi2, free, known = (float(x) for x in np.sum(each, axis=0))
        return cls(hz, chi2, round(free), known / 2, trials, louder, each)

    def closer(self, pieces: Sequence[PieceModulation], step: float) -> Modulation:
        """The same at the best frequency within a step (Hz) of its own."""
        if not self.hz > 0:
            return self

        def lost(hz: float) -> float:
            return -sum(one.exact(hz)[0] for one in pieces)

        ends = (self.hz - step, self.hz + step)
        found = optimize.minimize_scalar(
            lost, bounds=ends, method="bounded", options={"xatol": FLAT_OVER * step}
        )
        return self._at(pieces, float(found.x), self.trials, self.louder)

    @property
    def gain(self) -> float:
        """Of chi-square, beyond what noise makes in the mean."""
        return self.chi2 - self.free

    @property
    def false_alarm(self) -> float:
        """That noise makes as much at this spring."""
        return self.trials * float(stats.chi2.sf(self.chi2, self.free)) if self.free else 1.0

    @property
    def evidence(self) -> float:
        """Logarithm of the likelihood that it adds, of random phases whose variance is the most
        likely one and the same in all records, less that of all that was tried: (chi2 - free -
        free log(chi2/free))/2 where all show it alike. A record that hardly shows it cannot have
        more of it than the others."""
        if not 0 < self.free < self.chi2:
            return 0.0
        alike = np.array([[self.chi2, self.free, 1.0]])
        return _likeliest(self.each if len(self.each) else alike) - math.log(self.trials)


def _likeliest(each: Float) -> float:
    """Logarithm of the likelihood that phases of one variance add to noise alone, at the most
    likely variance: with v = 1 + variance x known of a record, the sum of (chi2 (1 - 1/v) - free
    log v)/2 over the records. each : (m, 3) chi-square, degrees of freedom and known of them."""
    chi2, free, known = each[(each[:, 1] > 0) & (each[:, 2] > 0)].T
    variance = np.geomspace(1 / known.max(), chi2.max() / known.min(), VARIANCES)
    v = 1 + variance[:, None] * known
    return float(np.max(np.sum(chi2 * (1 - 1 / v) - free * np.log(v), axis=1), initial=0.0)) / 2


def uneven(pieces: Sequence[PieceModulation]) -> float:
    """Chi-square that a spring explains which is not the same to both sides, alike in all pieces,
    beyond another constant stiffness: it swings as the motion does."""
    found = []
    for power in SIDES:
        G, b = (sum(x) for x in zip(*(one.uneven(power) for one in pieces), strict=True))
        share = G[0, 1] / G[0, 0] if G[0, 0] > 0 else 0.0
        known = G[1, 1] - share * G[0, 1]
        found.append((b[1] - share * b[0]) ** 2 / known if known > ROUNDED * G[1, 1] else 0.0)
    return float(max(found))


def louder_beside(pieces: Sequence[PieceModulation], hz: float, f: Float) -> float:
    """How much louder than it is told the noise is around a frequency, of its power: where it is,
    at the lowest lines say, it is so beside too. f : (m,) Hz at which that is looked at."""
    near = _scan(pieces, f[(f > hz / 2) & (f < 2 * hz)])
    usual = stats.chi2.median(2 * sum(one.times.size for one in pieces))
    return max(float(np.median(near)) / float(usual), 1.0) if near.size else 1.0


def _scan(pieces: Sequence[PieceModulation], f: Float) -> Float:
    """Chi-square (m,) of all pieces at f (m,) Hz."""
    return np.asarray(np.sum([np.interp(f, one.f, one.chi_square()) for one in pieces], axis=0))


def _between(pieces: Sequence[PieceModulation]) -> Modulation:
    """What differs from record to record: a constant of each, but for what all have in common.
    Repeats differ by what they do not have in common."""
    P, known, times = (np.concatenate(x) for x in zip(*(one.constants() for one in pieces),
                                                       strict=True))  # fmt: skip
    first = np.cumsum([0, *(one.times.size for one in pieces[:-1])])
    seen = known > ROUNDED * known.max(initial=0.0)
    common = first[seen[first]]
    free = int(np.count_nonzero(seen)) - min(len(common), 1)
    if free <= 0:
        return Modulation(0.0, 0.0, 0, 1.0)
    chi2 = float(np.sum(P[seen] ** 2 / known[seen]))
    if len(common):
        t = times[common]
        chi2 -= float(t @ P[common]) ** 2 / float(t**2 @ known[common])
    return Modulation(0.0, chi2, free, float(np.mean(known[seen])) * free)
