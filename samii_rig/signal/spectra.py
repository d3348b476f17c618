"""Spectra of whole pieces, and the band that the reference excites."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from samii_rig.errors import EstimateError
from samii_rig.signal.groups import Piece
from samii_rig.types import Complex, Float, Int

# A line is excited when the energy E of the reference there, or f E, is this part of its
# maximum: E is flat for a linear sweep, f E for a logarithmic one.
BAND_POWER = 1e-2
COMB_POWER = 1e-6  # of the strongest line; a periodic reference has nothing between its lines
SMOOTH_LINES = 9  # the ripple of a swept sine's spectrum is shorter
TAPER = 0.1  # of the length at most, on either end
# A step from head to tail is one above this many standard deviations.
STEP_SIGMA = 5.0
DRIFT_ORDER = 2  # of the polynomial in time; the means of few periods determine no more


@dataclass(frozen=True, slots=True)
class Spectrum:
    """DFT of one piece over its lines 1 ... n/2 - 1, divided by sqrt(n).

    frequency (n_freq,) Hz; R (n_freq,); Z (n_freq, 1 + p), input first. White noise of
    variance s^2 per sample has the variance s^2 at each line, whatever the length.
    """

    frequency: Float
    R: Complex
    Z: Complex
    n: int


def spectrum(
    piece: Piece,
    rate_hz: float,
    window: Float | None = None,
    stepped: NDArray[np.bool_] | None = None,
) -> Spectrum:
    """Spectrum of a piece with its mean taken out, or times `window` (n,).

    stepped : (1 + p,) channels that end at another level than they started from.

    Raises EstimateError for fewer than 8 samples.
    """
    n = len(piece)
    if n < 8:
        raise EstimateError(f"{piece.name}: {n} samples are too few for a spectrum")
    # The last line of an even length is real, not circular; line 0 is the offset.
    lines = slice(1, (n + 1) // 2)
    scale = 1 / np.sqrt(n)
    frequency = np.arange(n, dtype=float)[lines] * (rate_hz / n)
    z = piece.z - piece.z.mean(axis=0) if window is None else piece.z * window[:, None]
    Z = np.asarray(fft.rfft(z, axis=0)[lines] * scale, complex)
    if window is not None and stepped is not None and stepped.any():
        steps = np.diff(piece.z[:, stepped], axis=0, prepend=piece.z[:1, stepped])
        turn = 1 - np.exp(-2j * np.pi * frequency / rate_hz)
        Z[:, stepped] = fft.rfft(steps * window[:, None], axis=0)[lines] * scale / turn[:, None]
    R = np.asarray(fft.rfft(piece.r)[lines] * scale, complex)
    return Spectrum(frequency, R, Z, n)


def burst_spectra(pieces: Sequence[Piece], rate_hz: float) -> tuple[list[Spectrum], float]:
    """Spectra of bursts from rest to rest, and how many lines one independent line is.

    The rest before and after the burst is tapered. That does nothing to what the reference
    caused, which is zero there, but the noise is not: cut off sharply, a noise with resonances
    (or an integrator) leaks into all lines the same way, and neighbouring lines would no
    longer be independent measurements of its covariance.

    A signal that rests at another level than it started from (an integrating actuator, a
    drift) has its differences at rest at both ends; their spectrum over 1 - exp(-j w) is
    the signal's own. It is taken where the step of the mean over the repeats stands out of
    their scatter and of the noise.
    """
    head, tail = rests(pieces[0].r)
    n = len(pieces[0])
    head, tail = min(head, int(TAPER * n)), min(tail // 2, int(TAPER * n))
    window = np.ones(n)
    window[:head] = np.sin(np.pi / 2 * (np.arange(head) + 0.5) / max(head, 1)) ** 2
    window[n - tail :] = np.sin(np.pi / 2 * (np.arange(tail) + 0.5) / max(tail, 1))[::-1] ** 2
    stepped = _stepped(pieces, head, tail)
    out = [
        spectrum(Piece(p.name, p.r, p.z - _level(p.z, head, tail)), rate_hz, window, stepped)
        for p in pieces
    ]
    # Correlation of white noise between lines: the spectrum of the window's square.
    share = np.abs(fft.rfft(window**2)) / float(window @ window)
    return out, float(1 + 2 * np.sum(share[1:] ** 2))


def settled_spectra(pieces: Sequence[Piece], rate_hz: float) -> tuple[list[Spectrum], float]:
    """Spectra of all but the first of bursts that run into each other, each a whole period.

    The tail of the burst before still rings at the start of the next one, and in the settled
    motion that is exactly what is missing after its own end. In the rest after the reference
    each piece is faded over into its predecessor, which changes nothing in the motion, since the
    two are one there, but lets the noise run on smoothly from the end to the start.

    What the means of the settled pieces say of a drift is taken out first: it would be a jump
    from the end of each period to its start, alike in all of them, which no scatter shows.

    Also the correlation of white noise between neighbours, which share the tail faded over.
    """
    tail = min(rests(pieces[0].r)[1] // 2, int(TAPER * len(pieces[0])))
    fade = np.cos(np.pi / 2 * (np.arange(tail) + 0.5) / max(tail, 1))[:, None] ** 2
    out = []
    for before, piece in pairwise(_steady(pieces)):
        z = piece.z.copy()
        end = slice(len(piece) - tail, None)
        z[end] = fade * z[end] + (1 - fade) * before.z[end]
        out.append(spectrum(replace(piece, z=z), rate_hz))
    both = float(np.sum(fade * (1 - fade)))
    return out, both / (len(pieces[0]) - 2 * both)


def _steady(pieces: Sequence[Piece]) -> list[Piece]:
    """The pieces less a parabola in time through the means of all but the first."""
    n, settled = len(pieces[0]), len(pieces) - 1
    if settled < 2:
        return list(pieces)
    means = np.stack([p.z.mean(axis=0) for p in pieces[1:]])
    law = np.polynomial.polynomial.polyfit(np.arange(settled), means, min(settled - 1, DRIFT_ORDER))
    time = (np.arange(n) + 0.5) / n - 0.5
    return [
        replace(p, z=p.z - np.polynomial.polynomial.polyval(time + i, law).T)
        for i, p in enumerate(pieces, start=-1)
    ]


def rests(r: Float) -> tuple[int, int]:
    """Samples before the first and after the last at which the reference (n,) is not zero."""
    busy = np.flatnonzero(r)
    return (int(busy[0]), int(r.size - 1 - busy[-1])) if busy.size else (r.size, r.size)


def excited(spectra: Sequence[Spectrum], band: tuple[float, float] | None) -> Int:
    """(n_line,) indices of the lines of the longest spectrum that a reference excites, in the band
    (lowest and highest Hz).

    Without a band: from the first to the last line at which the smoothed energy of any
    piece's reference stands out (`BAND_POWER`).

    Raises EstimateError if there is none.
    """
    longest = max(spectra, key=lambda s: s.n)
    width = min(SMOOTH_LINES, *(s.R.size for s in spectra))
    energy = [
        np.convolve(np.abs(s.R) ** 2 * s.n, np.ones(width) / width, mode="same") for s in spectra
    ]
    scaled = [x * s.frequency for s, x in zip(spectra, energy, strict=True)]
    top, top_scaled = (max(float(x.max()) for x in xs) for xs in (energy, scaled))
    if top == 0:
        raise EstimateError("the reference is zero throughout; nothing was excited")
    if band is None:
        above = [
            s.frequency[(x > BAND_POWER * top) | (y > BAND_POWER * top_scaled)]
            for s, x, y in zip(spectra, energy, scaled, strict=True)
        ]
        band = (min(f[0] for f in above if f.size), max(f[-1] for f in above if f.size))
    inside = np.flatnonzero((longest.frequency >= band[0]) & (longest.frequency <= band[1]))
    if inside.size == 0:
        raise EstimateError(f"the records hold no line between {band[0]:g} and {band[1]:g} Hz")
    return inside.astype(np.int64)


def comb(spectra: Sequence[Spectrum], band: tuple[float, float] | None) -> Int:
    """(n_line,) indices of the lines of a periodic reference: those that stand out by themselves.

    Raises EstimateError if there is none in the band (lowest and highest Hz).
    """
    first = spectra[0]
    power = np.abs(first.R) ** 2
    inside = power > COMB_POWER * power.max(initial=0.0)
    if band is not None:
        inside &= (first.frequency >= band[0]) & (first.frequency <= band[1])
    if not inside.any():
        raise EstimateError("the periodic reference excites no line in the band")
    return np.flatnonzero(inside).astype(np.int64)


def period(r: Float) -> int:
    """Samples of the shortest period of r (n,) that divides n; n if there is none."""
    n = r.size
    size = float(np.abs(r).max(initial=0.0))
    for count in range(n // 8, 1, -1):
        if n % count == 0:
            p = n // count
            # References are recorded exactly; 1e-9 forgives a change of units.
            if np.abs(r[p:] - r[:-p]).max() <= 1e-9 * size:
                return p
    return n


def _level(z: Float, head: int, tail: int) -> Float:
    """(1 + p,) level at rest; the mean of all where there is hardly any rest."""
    if min(head, tail) < 2:
        return np.asarray(z.mean(axis=0), float)
    return np.asarray((z[:head].mean(axis=0) + z[-tail:].mean(axis=0)) / 2, float)


def _stepped(pieces: Sequence[Piece], head: int, tail: int) -> NDArray[np.bool_]:
    """(1 + p,) whether tail and head level differ by more than noise and scatter explain."""
    if min(head, tail) < 2:
        return np.zeros(pieces[0].z.shape[1], bool)
    steps = np.stack([p.z[-tail:].mean(axis=0) - p.z[:head].mean(axis=0) for p in pieces])
    white = np.mean(
        [p.z[:head].var(axis=0) / head + p.z[-tail:].var(axis=0) / tail for p in pieces], axis=0
    )
    scatter = steps.var(axis=0, ddof=1) if len(pieces) > 1 else white
    error = np.sqrt(np.maximum(white, scatter) / len(pieces))
    return np.asarray(np.abs(steps.mean(axis=0)) > STEP_SIGMA * error, bool)
