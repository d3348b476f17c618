"""Do bursts end at rest? If not, how much still rings, and after how many has it settled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from samii_rig.signal.groups import Piece
from samii_rig.signal.noise import pooled
from samii_rig.signal.spectra import rests
from samii_rig.signal.statistics import hotelling, hotelling_p
from samii_rig.signal.steps import step_of
from samii_rig.types import Channel, Complex, Finding, Float

# A burst still rings when its tail, common to the repeats, is this improbable as noise; over
# all lines of the tail together.
RINGING = 1e-8
TAIL_PART = 0.1  # of the burst, looked at
TAIL_LEAST = 16  # samples
# With one burst there is no scatter: 5 times the tail's own noise, and 2e-3 of the peak.
TAIL_NOISE, TAIL_PEAK = 5.0, 2e-3
# A tail of this part of the peak rings whatever its scatter: where each burst starts in the
# tail of the one before, the ring itself is what differs from tail to tail.
TAIL_LOUD = 0.03
# What a burst still knows of the start from rest may reach this many standard deviations of the
# tail's strongest line: spread over the whole burst it is then below the noise of the estimate.
FORGOTTEN = 5.0
# Lines over which a tail's scatter is estimated at the least: two repeats have one each.
LINES_AROUND = 5
# Of the power of the tail's strongest line: noise that bursts without any are taken to have.
NOISELESS = 1e-24
NEVER = 1_000_000


@dataclass(frozen=True, slots=True)
class Ringing:
    """Motion that has not died out at the end of bursts.

    settled_after : of bursts that run into each other, after how many what is left of the
        start from rest is below the noise; `NEVER` where that is not known.
    """

    finding: Finding
    settled_after: int


def ringing(pieces: Sequence[Piece], channels: Sequence[Channel], highest: float) -> Ringing | None:
    """Motion at the end of the bursts, None if there is none that noise would not make.

    What is common to the tails of all repeats is held against their scatter, line by line up
    to `highest` (cycles per sample) and for all outputs together: the joint covariance would
    see it too. The first burst of a row starts from rest and rings less, so it has no say where
    three or more run into each other. The first of `channels` is the input, which follows
    from the outputs.
    """
    n = min(len(p) for p in pieces)
    _, rest = rests(pieces[0].r)
    tail = min(rest, int(TAIL_PART * n))
    if tail < TAIL_LEAST:
        message = f"{pieces[0].name}: the reference acts until the end; no ring-down was recorded"
        return Ringing(Finding("leakage", "warning", message), NEVER)
    row = len(pieces) > 2 and all(p.follows for p in pieces[1:])
    ends = np.stack([p.z[-tail:, 1:] for p in pieces[row:]])
    ends = ends - ends.mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(ends.mean(axis=0) ** 2, axis=0))
    peak = np.max([np.ptp(p.z[:, 1:], axis=0) for p in pieces], axis=0) / 2
    if len(pieces) > 1:
        read = zip(channels[1:], pieces[0].z[-tail:, 1:].T, strict=True)
        snr = _against_scatter(ends, highest, np.array([step_of(c, x) for c, x in read]))
    else:
        snr = _against_itself(ends[0], peak)
    loud = size > TAIL_LOUD * peak
    if loud.any() and len(pieces) > 1:
        snr = np.maximum(snr, np.where(loud, 1 / TAIL_LOUD, 0.0))
    if not snr.any():
        return None
    i = int(np.argmax(snr))
    part = 100.0 * size[i] / max(peak[i], 1e-300)
    message = (
        f"{channels[i + 1].name} still moves by {size[i]:.3g} {channels[i + 1].unit} (rms, "
        f"{part:.2g} % of its peak) in the last {tail} samples of {pieces[0].name}"
    )
    finding = Finding("leakage", "warning", message, channel=channels[i + 1].name)
    after = _settled_after(ends, highest, n) if row else NEVER
    return Ringing(finding, after)


def _settled_after(ends: Float, highest: float, n: int) -> int:
    """After how many bursts of `n` samples the memory of the start is below the noise.

    What rings at the end is forgotten over a burst by the factor by which it decays in that
    time, read off the two halves of the mean tail, at the line where the ring stands out most and
    of all outputs together. One output by itself may take a slow disturbance for a ring that does
    not decay. ends : (n_burst, tail, p) of those that started in a tail.
    """
    count, tail, _ = ends.shape
    own = np.stack([_hann(x) for x in ends])[:, 1 : max(2, int(highest * tail) + 1)]
    ring, half = own.mean(axis=0), tail // 2
    noise = np.mean(np.abs(own - ring) ** 2, axis=0) / max(count - 1, 1)
    near = uniform_filter1d(noise, LINES_AROUND, axis=0, mode="constant")
    size = np.maximum(near, noise.mean(axis=0))
    weight = 1 / (size + NOISELESS * np.max(np.abs(ring) ** 2, axis=0) + 1e-300)
    power = np.sum(weight * np.abs(ring) ** 2, axis=1)
    line = int(np.argmax(power))
    first, second = (
        _hann(x)[max(1, round((line + 1) * half / tail))]
        for x in (ends.mean(axis=0)[:half], ends.mean(axis=0)[-half:])
    )
    w = weight[line]
    decay = float(abs(np.vdot(first, w * second))) / max(np.vdot(first, w * first).real, 1e-300)
    if decay >= 1:
        return NEVER
    forgotten: float = -math.log(max(decay, 1e-300)) * n / half
    loudness = math.log(max(math.sqrt(float(power[line])) / FORGOTTEN, 1.0))
    return max(1, math.ceil(float(loudness / forgotten)))


def _hann(x: Float) -> Complex:
    """Lines of the columns of x less their mean."""
    x = x - x.mean(axis=0)
    return np.asarray(np.fft.rfft(x * np.hanning(x.shape[0])[:, None], axis=0))


def _against_scatter(ends: Float, highest: float, step: Float) -> Float:
    """(p,) signal to noise of the mean tail's strongest line, 0 where the tail is but noise.

    step : (p,) of the converters. The mean's noise is at least what they make of a motion: where
    repeats read alike, no scatter shows it and none of it averages out.
    """
    n, tail, outputs = ends.shape
    window = np.hanning(tail)
    spectra = np.fft.rfft(ends * window[:, None], axis=1)
    # A line of the windowed tail is 2 lines wide: every second one is nearly independent.
    spectra = spectra[:, 2 : max(4, int(highest * tail) + 1) : 2]
    bins = spectra.shape[1]
    lively = np.mean(np.abs(spectra) ** 2, axis=(0, 1)) > 0
    mean = spectra.mean(axis=0)
    scatter = (spectra - mean)[:, :, lively]
    p = int(np.count_nonzero(lively))
    lines = min(bins, -(-4 * p // (n - 1)))
    if p == 0 or (n - 1) * lines <= p or not np.any(scatter):
        return np.where(lively & np.any(mean, axis=0), np.inf, np.zeros(outputs))
    noise = pooled(scatter, n - 1, lines)
    C = noise.covariance / n
    every, rounding = np.arange(p), step[lively] ** 2 / 12 * np.sum(window**2)
    C[:, every, every] = np.maximum(C[:, every, every].real, rounding)
    t2 = hotelling(mean[:, lively], C)
    if hotelling_p(t2, p, np.maximum(noise.dof, p)).min() >= RINGING / bins:
        return np.zeros(outputs)
    rms = np.sqrt(np.mean(np.abs(spectra - mean) ** 2, axis=(0, 1)) / (n - 1)) + 1e-300
    return np.asarray(np.abs(mean).max(axis=0) / rms * lively)


def _against_itself(end: Float, peak: Float) -> Float:
    """As `_against_scatter` for one burst: against the differences of neighbouring samples."""
    noise = np.std(np.diff(end, axis=0), axis=0) / np.sqrt(2)
    ratio = np.std(end, axis=0) / np.maximum(TAIL_NOISE * noise, TAIL_PEAK * peak + 1e-300)
    return np.where(ratio > 1, ratio, 0.0)
