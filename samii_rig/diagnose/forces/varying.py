"""A stiffness that is not the same all the time: it swings, drifts, or differs from run to run.

To first order a spring that is softer by dk(t) adds the torque dk(t) phi(t), phi the way over it as
the linear rig moves. With pull(t) what a fit leaves, taken back to the torque that would
explain it, how far a change cos(Omega t) lies along that is the Fourier coefficient of phi pull,

    P(Omega) = sum_t phi(t) pull(t) exp(-j Omega t),   |P|^2 has the mean
    V(Omega) = sum_tau R_phi(tau) R_pull(tau) cos(Omega tau)

under noise alone, which knows nothing of phi: R_phi the products of the motion with itself, R_pull
the covariance of the pull, of the noise's own spectrum. So 2 |P|^2/V is chi-square with two degrees
of freedom at every Omega, summed over the records with two for each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from samii_rig.diagnose.fit.exact import NINETY
from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.forces.laws import HARDENING
from samii_rig.diagnose.forces.reach import Span
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.likelihood.unexplained import Unexplained
from samii_rig.types import Complex, Float, Int

FASTEST = 0.5  # of the highest frequency in the records: what varies faster is no stiffness
FINE = 4  # frequencies for each that the longest record tells apart
ALARM = 2e-3  # chance that noise alone makes any stiffness vary
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
        if ports is None:
            continue
        motion = reach.motion(spring.quasi.place, of_speed=False)
        each = zip(reach.spans, motion, ports.sensors, left, strict=True)
        found.append((spring.site, Seen.of([Pulled.of(*one) for one in each], f)))
    if not found:
        return None
    found.sort(key=lambda one: -one[1].most)
    site, seen = found[0]
    rows = sum(len(one.white) for one in left)
    # Of a motion that is short, both phases of a slow swing are one: at worst of all.
    chance = float(stats.chi2.sf(seen.most / 2, rows))
    if len(found) * 2 * longest * f[-1] * chance > ALARM:
        return None
    p = np.exp([(one.most - seen.most) / 2 for _, one in found])
    hz, gain, slow = float(f[seen.at]), seen.most - 2 * rows, 1 / longest
    of_swing = 2.0 if hz > slow else 0.5
    k, known = reach.scale((site, "k")), seen.known[seen.at]
    return Varying(
        sites=tuple(
            (name, float(share)) for (name, _), share in zip(found, p / p.sum(), strict=True)
        ),
        hz=hz,
        slow=slow,
        depth=math.sqrt(of_swing * gain / known) / k,
        sd=math.sqrt(of_swing / known) / k,
        gain=gain,
    )


@dataclass(frozen=True, slots=True)
class Pulled:
    """Of one piece and its repeats. f : (m,) Hz. power : (rows, m) |P|^2. mean : (rows, m) V."""

    f: Float
    power: Float
    mean: Float

    @classmethod
    def of(cls, span: Span, phi: Float, sensors: Complex, left: Unexplained) -> Pulled:
        """phi : (M,) the way over the spring. sensors : (M//2 + 1, q) lines of a unit force."""
        times = np.ones(len(left.white))
        times[0] = span.times  # a piece is so many times the motion, its repeats differ
        pull = np.stack(
            [pulled(span, sensors, left.k, a, t) for a, t in zip(left.pull, times, strict=True)]
        )
        size = 2 * phi.size  # nothing wraps around
        phi = phi * span.alive
        P = np.fft.rfft(phi * pull, size, axis=1)
        V = times[:, None] ** 2 * _variance(span, phi, sensors, left)
        f = np.asarray(
            np.arange(size // 2 + 1) * (span.rate_hz * span.n / span.samples / size), np.float64
        )
        power = np.asarray(np.abs(P) ** 2, np.float64)
        seen = ROUNDED * V.max() < V  # not where no sensor shows the force
        return cls(f, np.where(seen, power, 0.0), np.where(seen, V, 1.0))


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
    """(M + 1,) V at multiples of half the contour's spacing, of a piece that is once the motion."""
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
class Seen:
    """Of one spring. chi2 : (m,) at each frequency. known : (m,) sum of V."""

    chi2: Float
    known: Float

    @classmethod
    def of(cls, pieces: Sequence[Pulled], f: Float) -> Seen:
        """Of all pieces, at f (m,) Hz."""
        chi2 = known = np.zeros(f.size)
        for one in pieces:
            for power, mean in zip(one.power, one.mean, strict=True):
                chi2 = chi2 + np.interp(f, one.f, 2 * power / mean)
                known = known + np.interp(f, one.f, mean)
        return cls(chi2, known)

    @property
    def at(self) -> int:
        """Where it is largest."""
        return int(np.argmax(self.chi2))

    @property
    def most(self) -> float:
        """The largest."""
        return float(self.chi2[self.at])
