"""Whole samples by which sensors of one recording stand behind those of another.

Both answer as one rig does, so the ratio of their responses has the phase -omega m / rate at all
frequencies where a logger shifted one by m samples. Physics that differs turns it about a resonance
alone, and a lag by no whole number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from samii_rig.errors import EstimateError
from samii_rig.signal.rows import whole_rows
from samii_rig.signal.welch import spectra
from samii_rig.types import Complex, Float, Recording

FARTHEST = 5  # samples; a logger that is later has another fault
FRAMES = 8  # windows that a recording holds at least; fewer tell no phase from noise
# Part of an input's largest power that a line has at least: below, as above a sweep, is noise.
EXCITED = 1e-3
# Coherence times frames from which a line is no chance: noise alone reaches it in 5 of 1e5 lines.
CHANCE = 10.0
# Lines times the square of their mean cosine about a shift, from which a band is none where frames
# are few that hold a line: 8 of 100 bands of noise reach it, 1 in 10 of them near the shift.
BAND_ALIKE = 2.5
SHORTEST, LONGEST = 32, 2048  # samples of a window: 13 lines, and those that resolve a resonance
SKIPPED = 2  # lines from 0 on, where the window leaks what was taken out with the mean
# Bands of equal information that each show the same shift: what turns the phase about a resonance
# turns it in one of them. Each knows it to `SURE` samples (one standard deviation) and may miss it
# by `WHOLE` and two of these, by three quarters of a sample at most; all together by half of
# `WHOLE` and two of theirs, by 0.41 of one.
BANDS, SURE, WHOLE = 3, 0.25, 0.25
FINE = 0.05  # samples between two shifts that are tried


@dataclass(frozen=True, slots=True)
class Phases:
    """What a recording shows of the responses of all sensors to all that drives it.

    omega : (n_freq,) rad/sample. H : (m, n_freq) of each sensor to every one of `drives` columns,
    the first sensor's first; variance : (m, n_freq) of its phase in rad^2, infinite where it may be
    noise.
    """

    omega: Float
    H: Complex
    variance: Float
    drives: int

    @classmethod
    def of(cls, recording: Recording, sensors: Sequence[str], n: int) -> Phases | None:
        """Of these sensors; None where too little was recorded in one go for windows of n
        samples."""
        drives = driving(recording)
        names, p = [*drives, *sensors], len(drives)
        kept, breaks = whole_rows(recording, names)
        pieces = np.split(recording.columns(names)[kept], breaks)
        try:
            matrix = spectra(pieces, recording.rate_hz, nperseg=n)
        except EstimateError:
            return None
        S = matrix.S[SKIPPED:-SKIPPED]
        power = np.maximum(np.einsum("fii->fi", S).real, np.finfo(float).tiny)
        cross = S[:, p:, :p]
        coherence = np.abs(cross / power[:, None, :p] * (cross.conj() / power[:, p:, None]))
        coherence = np.clip(coherence, np.finfo(float).eps, 1.0)
        # Of a phase, for averages of `dof` frames (Bendat and Piersol, Random Data, 2010, 9.91).
        variance = (1 - coherence) / (2 * matrix.dof * coherence)
        dark = power[:, None, :p] < EXCITED * power[:, None, :p].max(axis=0)
        variance[(coherence * matrix.dof < CHANCE) | dark] = np.inf
        omega = 2 * np.pi * matrix.frequency[SKIPPED:-SKIPPED] / recording.rate_hz
        H = cross / power[:, None, :p]
        flat = (len(omega), -1)
        return cls(omega, H.reshape(flat).T, variance.reshape(flat).T, p)


def driving(recording: Recording) -> tuple[str, ...]:
    """Columns that drive a run: references that move, in which no loop is, or the commands."""
    references = [n for n in recording.names("reference") if np.ptp(recording.values_of(n)) > 0]
    return tuple(references) or recording.names("command")


def compared(recordings: Sequence[Recording]) -> list[int]:
    """Of each, driven alike, the samples by which its sensors stand behind those of the first, as
    `shift_between`; 0 where too little was recorded to tell."""
    common = set.intersection(*(set(r.names("sensor")) for r in recordings))
    sensors = [name for name in recordings[0].names("sensor") if name in common]
    n = 2 ** int(np.log2(max(min(len(r) for r in recordings) / FRAMES, 1)))
    if n < SHORTEST or not sensors:
        return [0] * len(recordings)
    first, *others = (Phases.of(r, sensors, min(n, LONGEST)) for r in recordings)
    return [0, *(shift_between(first, o) if first and o else 0 for o in others)]


def shift_between(first: Phases, other: Phases) -> int:
    """Samples by which the sensors of `other` stand behind those of `first`; 0 where no whole
    number is what all frequencies and all sensors show."""
    ratio, variance = other.H * first.H.conj(), first.variance + other.variance
    weight = np.where(ratio != 0, 1 / (variance + FINE**2), 0.0)
    turned = np.angle(ratio)
    tried = np.arange(-FARTHEST - 1, FARTHEST + 1 + FINE / 2, FINE)
    off = 1 - np.cos(turned[..., None] + first.omega[:, None] * tried)
    off = off * weight[..., None]
    told = weight * first.omega**2
    if told.sum() * SURE**2 < BANDS:
        return 0
    best = float(tried[np.argmin(off.sum(axis=(0, 1)))])
    shift = round(best)
    if abs(best - shift) > WHOLE / 2 + 2 / np.sqrt(told.sum()):
        return 0
    every, p = slice(None), first.drives
    sensors = [(slice(i, i + p), every) for i in range(0, len(told), p)]
    parts = [(every, band) for band in _bands(told.sum(axis=0))]
    parts += [one for one in sensors if told[one].sum() * BANDS >= told.sum()]
    # A shift of all is one of each, and its lines agree in more than what chance brings together.
    for part in parts:
        if not told[part].any():
            continue
        late = tried[np.argmin(off[part].sum(axis=(0, 1)))]
        near = np.cos(turned + shift * first.omega)[part][weight[part] > 0]
        far = abs(late - shift) > WHOLE + 2 / np.sqrt(told[part].sum())
        if far or near.size * near.mean() ** 2 < BAND_ALIKE:
            return 0
    return shift if abs(shift) <= FARTHEST else 0


def _bands(told: Float) -> list[slice]:
    """Of lines that tell `told` (n,) each, `BANDS` in a row that tell as much."""
    reached = np.cumsum(told)
    inner = np.searchsorted(reached, reached[-1] * np.arange(1, BANDS) / BANDS)
    edges = [0, *inner.tolist(), len(told)]
    return [slice(a, b) for a, b in pairwise(edges)]
