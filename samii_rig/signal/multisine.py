"""Random-phase odd multisines with detection lines.

A multisine of period T has lines at multiples of 1/T. If only odd ones are driven, whatever
a quadratic (or any even) law adds falls on even lines, and what a cubic (or any odd) law
adds on odd ones. So even lines, and some odd ones that are left out at random, show what is
not linear, apart by kind (Pintelon and Schoukens, System Identification, 2nd ed., chapters
3 and 4; Schoukens et al., IEEE Trans. Instrum. Meas. 54, 2005).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.types import Float, Int

MOST_CLIPS = 500  # after which a crest factor that was not reached is not looked for further
# Clipped a little below what is wanted, since the lines that clipping took away come back.
CLIP_AT = 0.95


@dataclass(frozen=True, slots=True)
class Lines:
    """Harmonic numbers k of the lines k/T in a band.

    excited : odd, driven. odd : odd, left out as detection lines. Every even line between
    is a detection line too.
    """

    excited: Int
    odd: Int


def odd_lines(
    low_hz: float, high_hz: float, period: float, group: int, rng: np.random.Generator
) -> Lines:
    """Odd lines of the band; of each `group` consecutive ones one at random is not driven.

    A left-out line at a fixed place would miss what falls on other places of the comb.
    Lines after the last whole group are driven.
    """
    first, last = int(np.ceil(low_hz * period - 1e-9)), int(np.floor(high_hz * period + 1e-9))
    odd = np.arange(first + (first + 1) % 2, last + 1, 2, dtype=np.int64)
    whole = odd.size // group
    left_out = np.arange(whole) * group + rng.integers(0, group, whole)
    return Lines(np.delete(odd, left_out), odd[left_out])


def multisine(
    n: int, lines: Int, amplitude: Float, crest: float, rng: np.random.Generator
) -> Float:
    """One period of rms 1, (n,) samples, with random phases and these amplitudes.

    lines : harmonic numbers below n/2. amplitude : (n_lines,) of each, relative.
    crest : wanted peak/rms. Phases are drawn evenly over the circle; as long as the crest
        factor is larger, the signal is clipped and the lines take over the phases of the
        clipped signal (van der Ouderaa et al., IEEE Trans. Instrum. Meas. 37, 1988). It
        stops at once when the crest factor is reached, so that phases stay as random, and
        the samples as near to a normal distribution, as the peak allows. If it cannot be
        reached the best that was met is returned.
    """
    spectrum = np.zeros(n // 2 + 1, dtype=np.complex128)
    scale = n / np.sqrt(2.0 * np.sum(amplitude**2))
    phase = rng.uniform(0.0, 2.0 * np.pi, lines.size)
    best, lowest = np.zeros(n), np.inf
    for _ in range(MOST_CLIPS):
        spectrum[lines] = scale * amplitude * np.exp(1j * phase)
        x = np.fft.irfft(spectrum, n)
        peak = float(np.abs(x).max())
        if peak < lowest:
            best, lowest = x, peak
        if peak <= crest:
            break
        at = max(CLIP_AT * crest, 0.8 * peak)
        phase = np.angle(np.fft.rfft(np.clip(x, -at, at))[lines])
    return best


def realisations(
    n: int, lines: Int, amplitude: Float, crest: float, count: int, seed: np.random.SeedSequence
) -> Float:
    """(count, n) periods of one spectrum with phases of their own, the largest peak 1.

    All have the same rms, so that all are answered by the same best linear approximation;
    the peaks of the others are at most 1.
    """
    x = np.stack(
        [
            multisine(n, lines, amplitude, crest, np.random.default_rng(child))
            for child in seed.spawn(count)
        ]
    )
    return np.asarray(x / np.abs(x).max())
