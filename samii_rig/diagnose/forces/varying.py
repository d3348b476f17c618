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

    sites : (site, probability), the likeliest first. hz : at which it varies most there. slow : Hz,
    below which a record sees a drift, or nothing: it differs from one to the next. depth, sd :
    relative to the stiffness; amplitude of a swing, rms of what is slower. gain : of chi-square,
    beyond what noise makes in the mean.
    """

    sites: tuple[tuple[str, float], ...]
    hz: float
    slow: float
    depth: float
    sd: float
    gain: float

    def told(self) -> str:
        """In words."""
        swing = f", as by a swing at {self.hz:.3g} Hz," if self.hz > self.slow else ""
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
    f = np.arange(0.0, FASTEST * records.band[1], 1 / (FINE * longest))
    found = []
    for spring in (e for e in search.forces if e.quasi is not None and e.quasi.law is HARDENING):
        assert spring.quasi is not None
        ports = reach.ports(spring.quasi.place, of_speed=False)
        if ports is None or not reach.scale((spring.site, STIFFNESS)) > 0:
            continue
        motion = reach.motion(spring.quasi.place, of_speed=False)
        each = zip(reach.spans, motion, ports.sensors, left, strict=True)
        found.append((spring.site, Swing.of([Pulled.of(*one) for one in each], f)))
    if not found:
        return None
    found.sort(key=lambda one: one[1].free - one[1].chi2)
    site, most = found[0]
    tries = len(found) * 2 * longest * f[-1]
    seen = most.free > 0  # by any sensor
    if not seen or tries * float(stats.chi2.sf(most.chi2, most.free)) > ALARM:
        return None
    slow, k = 1 / longest, reach.scale((site, STIFFNESS))
    of_swing = 2.0 if most.hz > slow else 0.5
    depth, sd = (math.sqrt(of_swing * x / most.known) / k for x in (most.gain, 1.0))
    if depth > 1:  # no stiffness varies by more than all of it: something else is missing
        return None
    p = np.exp([(one.gain - most.gain) / 2 for _, one in found])
    return Varying(
        sites=tuple(
            (name, float(share)) for (name, _), share in zip(found, p / p.sum(), strict=True)
        ),
        hz=most.hz,
        slow=slow,
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
        """Chi-square of all rows at a frequency, its degrees of freedom, and V of all. Both phases
        of a swing that is slow for the motion are nearly one."""
        at = int(np.argmin(np.abs(self.f - hz)))
        t = np.pi * self.f[at] / self.f[-1] * np.arange(self.phi.size)
        span, left = self.span, self.left
        each = [span.damped(self.phi * x) for x in (np.cos(t), np.sin(t))]
        lines = np.stack([span.lines(e, self.sensors, left.k) for e in each], axis=2) / span.times
        white = (left.root @ lines).reshape(-1, 2)
        power, phases = np.linalg.eigh((white.conj().T @ white).real)
        shown = power > max(ONE_PHASE * power[1], ROUNDED * self.V.max())
        along = phases.T @ np.stack([self.P[:, at].real, -self.P[:, at].imag]) / self.times
        chi2 = np.sum(along[shown] ** 2 / power[shown, None])
        known = float(np.sum(power)) * float(self.times @ self.times)
        return float(chi2), int(np.count_nonzero(shown)) * self.times.size, known


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
    """At one spring, where most is explained. hz. chi2, with `free` degrees of freedom. known : sum
    of V."""

    hz: float
    chi2: float
    free: int
    known: float

    @classmethod
    def of(cls, pieces: Sequence[Pulled], f: Float) -> Swing:
        """Of all pieces, at one of f (m,) Hz."""
        hz = float(f[np.argmax(sum(np.interp(f, one.f, one.chi_square()) for one in pieces))])
        chi2, free, known = zip(*(one.exact(hz) for one in pieces), strict=True)
        return cls(hz, sum(chi2), sum(free), sum(known))

    @property
    def gain(self) -> float:
        """Of chi-square, beyond what noise makes in the mean."""
        return self.chi2 - self.free
