"""A stiffness that is not the same all the time: it swings, drifts, or differs from run to run.

To first order a spring that is softer by dk(t) adds the torque dk(t) phi(t), phi the way over it as
the linear rig moves. With pull(t) what a fit leaves, taken back to the torque that would
explain it, how far a change cos(Omega t) lies along that is the Fourier coefficient of phi pull,

    P(Omega) = sum_t phi(t) pull(t) exp(-j Omega t),   |P|^2 has the mean
    V(Omega) = sum_tau R_phi(tau) R_pull(tau) cos(Omega tau)

under noise alone, which knows nothing of phi: R_phi the products of the motion with itself, R_pull
the covariance of the pull, of the noise's own spectrum. So 2 |P|^2/V is chi-square with two degrees
of freedom at every Omega, summed over the records with two for each. Where it is largest both
phases are computed exactly: ends and all, and as one where the motion is short for a slow swing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from samii_rig.diagnose.fit.between_runs import STIFFNESS
from samii_rig.diagnose.fit.exact import NINETY
from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.forces.laws import HARDENING
from samii_rig.diagnose.forces.reach import Span
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.likelihood.reduce import CYCLES
from samii_rig.likelihood.unexplained import Unexplained
from samii_rig.types import Complex, Float, Int

FASTEST = 0.2  # of the highest frequency in the records: what varies faster is no stiffness
FINE = 4  # frequencies for each that the longest record tells apart
ALARM = 2e-3  # chance that noise alone makes any stiffness vary
ONE_PHASE = 1e-3  # of V: less variance is that of a phase which the motion does not show
ROUNDED = 1e-6  # of the largest variance: less is rounding


@dataclass(frozen=True, slots=True)
class Varying:
    """A stiffness that varies.

    sites : (site, probability), the likeliest first. hz : at which it varies most there; 0 where it
    differs from record to record. depth, sd : relative to the stiffness; amplitude of a swing, rms
    of what records differ by. gain : of chi-square, beyond what noise makes in the mean.
    """

    sites: tuple[tuple[str, float], ...]
    hz: float
    depth: float
    sd: float
    gain: float

    def told(self) -> str:
        """In words."""
        swing = f", as by a swing at {self.hz:.3g} Hz," if self.hz > 0 else " between records"
        return (
            f"the stiffness of {self.sites[0][0]} is not constant: it varies{swing} by "
            f"{100 * self.depth:.2g} % (+/- {100 * NINETY * self.sd:.1g})"
        )


def varying(search: ForceSearch, best: Explanation) -> Varying | None:
    """The stiffness that varies, by what an explanation leaves of the records; None where noise
    could do that."""
    left = search.unexplained(best.fitted)
    records, reach = search.levels.records, search.reach
    longest = max(len(p.z) for p in records.pieces) / records.rate_hz
    # What is slower than the lines that count is as a sensor that wanders.
    f = np.arange(CYCLES / longest, FASTEST * records.band[1], 1 / (FINE * longest))
    found: list[tuple[str, Swing]] = []
    for spring in (e for e in search.forces if e.quasi is not None and e.quasi.law is HARDENING):
        assert spring.quasi is not None
        ports = reach.ports(spring.quasi.place, of_speed=False)
        if ports is None or not f.size or not reach.scale((spring.site, STIFFNESS)) > 0:
            continue
        motion = reach.motion(spring.quasi.place, of_speed=False)
        each = zip(reach.spans, motion, ports.sensors, left, strict=True)
        found.append((spring.site, Swing.of([Pulled.of(*one) for one in each], f)))
    if not found:
        return None
    found.sort(key=lambda one: -one[1].gain)
    site, most = found[0]
    if len(found) * 2 * longest * f[-1] * most.chance > ALARM:
        return None
    k = reach.scale((site, STIFFNESS))
    depth, sd = (math.sqrt(x / most.known) / k for x in (most.gain, 1.0))
    if depth > 1:  # no stiffness varies by more than all of it: something else is missing
        return None
    p = np.exp([(one.gain - most.gain) / 2 for _, one in found])
    return Varying(
        sites=tuple(
            (name, float(share)) for (name, _), share in zip(found, p / p.sum(), strict=True)
        ),
        hz=most.hz,
        depth=depth,
        sd=sd,
        gain=most.gain,
    )


@dataclass(frozen=True, slots=True)
class Pulled:
    """Of one piece and its repeats.

    span, left : of the piece. phi : (M,) the way over the spring. sensors : (M//2 + 1, q) lines of
    a unit force. times : (rows,) of each the motion. f : (m,) Hz. P : (rows, m). V : (m,) of a row
    that is once the motion.
    """

    span: Span
    left: Unexplained
    phi: Float
    sensors: Complex
    times: Float
    f: Float
    P: Complex
    V: Float

    @classmethod
    def of(cls, span: Span, phi: Float, sensors: Complex, left: Unexplained) -> Pulled:
        """As above."""
        times = np.ones(len(left.white))
        times[0] = span.times  # a piece is so many times the motion, its repeats differ
        pull = np.stack(
            [pulled(span, sensors, left.k, a, t) for a, t in zip(left.pull, times, strict=True)]
        )
        size = 2 * phi.size  # nothing wraps around
        phi = phi * span.alive
        f = np.arange(size // 2 + 1) * (span.rate_hz * span.n / span.samples / size)
        P, V = np.fft.rfft(phi * pull, size, axis=1), _variance(span, phi, sensors, left)
        return cls(span, left, phi, sensors, times, np.asarray(f, np.float64), P, V)

    def chi_square(self) -> Float:
        """(m,) 2 |P|^2/V of all rows; none where no sensor shows the force."""
        power = np.sum(np.abs(self.P / self.times[:, None]) ** 2, axis=0)
        seen = ROUNDED * self.V.max() < self.V
        return np.asarray(np.divide(2 * power, self.V, out=np.zeros_like(power), where=seen))

    def exact(self, hz: float) -> tuple[float, int, float]:
        """Chi-square of all rows at a frequency, beyond what another constant stiffness of each
        does, its degrees of freedom, and what is known of both phases of a swing."""
        at = int(np.argmin(np.abs(self.f - hz)))
        t = np.pi * self.f[at] / self.f[-1] * np.arange(self.phi.size)
        G = self._products([np.ones(t.size), np.cos(t), np.sin(t)])
        pull = np.stack([self.P[:, 0].real, self.P[:, at].real, -self.P[:, at].imag]) / self.times
        if not G[0, 0] > ROUNDED * self.V.max():
            return 0.0, 0, 0.0
        share = G[1:, :1] / G[0, 0]
        power, phases = np.linalg.eigh(G[1:, 1:] - share * G[:1, 1:])
        shown = power > ONE_PHASE * np.trace(G[1:, 1:])
        along = phases.T @ (pull[1:] - share * pull[:1])
        chi2 = np.sum(along[shown] ** 2 / power[shown, None])
        known = float(np.sum(power[shown])) * float(self.times @ self.times)
        return float(chi2), int(np.count_nonzero(shown)) * self.times.size, known

    def constants(self) -> tuple[Float, Float]:
        """(rows,) how far a constant change lies along what is left, and what is known of it."""
        known = self._products([np.ones(self.phi.size)])[0, 0]
        return self.P[:, 0].real, np.asarray(known * self.times**2)

    def _products(self, shapes: Sequence[Float]) -> Float:
        """Of what forces phi x (M,) add to the whitened lines of a row that is once the motion."""
        span, left = self.span, self.left
        each = [span.lines(span.damped(self.phi * x), self.sensors, left.k) for x in shapes]
        white = (left.root @ np.stack(each, axis=2)).reshape(-1, len(shapes)) / span.times
        return np.asarray((white.conj().T @ white).real)


def pulled(span: Span, sensors: Complex, k: Int, lines: Complex, times: float) -> Float:
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
class Swing:
    """At one spring, where most is explained. hz : 0 for what differs from record to record. chi2,
    with `free` degrees of freedom. known : of its amplitude's square, or of its mean square."""

    hz: float
    chi2: float
    free: int
    known: float

    @classmethod
    def of(cls, pieces: Sequence[Pulled], f: Float) -> Swing:
        """Of all pieces, at one of f (m,) Hz or from record to record."""
        scan = np.sum([np.interp(f, one.f, one.chi_square()) for one in pieces], axis=0)
        hz = float(f[np.argmax(scan)])
        chi2, free, known = zip(*(one.exact(hz) for one in pieces), strict=True)
        # Where noise is louder than it is told, at the lowest lines say, it is so beside too.
        near = scan[(f > hz / 2) & (f < 2 * hz)]
        usual = stats.chi2.median(2 * sum(one.times.size for one in pieces))
        louder = max(float(np.median(near)) / float(usual), 1.0)
        swing = cls(hz, sum(chi2) / louder, sum(free), sum(known) / 2 / louder)
        return min(swing, _between(pieces), key=lambda one: one.chance)

    @property
    def gain(self) -> float:
        """Of chi-square, beyond what noise makes in the mean."""
        return self.chi2 - self.free

    @property
    def chance(self) -> float:
        """That noise makes as much at one frequency."""
        return float(stats.chi2.sf(self.chi2, self.free)) if self.free else 1.0


def _between(pieces: Sequence[Pulled]) -> Swing:
    """What differs from record to record: a constant of each, but for what all have in common.
    Repeats differ by what they do not have in common."""
    each = [one.constants() for one in pieces]
    P, known = (np.concatenate(x) for x in zip(*each, strict=True))
    first = np.cumsum([0, *(len(x) for x, _ in each[:-1])])
    seen = known > ROUNDED * known.max(initial=0.0)
    common = first[seen[first]]
    free = int(np.count_nonzero(seen)) - min(len(common), 1)
    if free <= 0:
        return Swing(0.0, 0.0, 0, 1.0)
    chi2 = float(np.sum(P[seen] ** 2 / known[seen]))
    if len(common):
        chi2 -= float(np.sum(P[common])) ** 2 / float(np.sum(known[common]))
    return Swing(0.0, chi2, free, float(np.sum(known[seen])))
