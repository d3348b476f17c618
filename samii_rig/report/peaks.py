"""Resonance peaks of a measured gain: what stands out by more than its noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.signal import find_peaks

from samii_rig.types import Float, FrequencyResponse

_PROMINENCE_DB = 3.0  # a peak of half the power of its feet is seen as one by eye
_PROMINENCE_SIGMA = 8.0  # of the smoothed curve, a difference of two among some thousands
_SMOOTH_TO = 0.03  # relative standard deviation to which noisy stretches are averaged
_WIDTHS = (1, 3, 7, 15, 31, 63)  # lines
# Lines over which the roughness of the curve itself is taken, by its median: a resonance of a
# few lines does not raise it, noise that the covariance understates does.
_NEIGHBOURS = 61
_PER_NEPER = 20 / np.log(10)  # dB


@dataclass(frozen=True, slots=True)
class Peak:
    """A peak of |H| at a line.

    sigma : standard deviation of `gain`, in its unit. prominence_db : above the higher foot.
    """

    frequency_hz: float
    gain: float
    sigma: float
    prominence_db: float


def relative_sigma(response: FrequencyResponse) -> Float:
    """(n_freq, n_out, n_in) standard deviation of |H| over |H|, to first order."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(response.variance() / 2) / np.abs(response.H)


def peaks(response: FrequencyResponse, output: int, input: int = 0) -> tuple[Peak, ...]:
    """Peaks of one entry of H, lowest frequency first.

    Noisy stretches are averaged over as many lines as bring them to 3 % first. A peak then
    stands above the higher of its two feet by 3 dB and by eight standard deviations,
    whichever is more; the standard deviation is the stated one or the roughness of the
    curve, whichever is more. Gain and sigma are those of the line at the peak.
    """
    gain = np.abs(response.H[:, output, input])
    relative = relative_sigma(response)[:, output, input]
    good = np.isfinite(gain) & (gain > 0) & np.isfinite(relative)
    f, gain, relative = response.frequency[good], gain[good], relative[good]
    if len(f) < 3:
        return ()
    level, sigma = _smoothed(np.log(gain), np.maximum(relative, _roughness(np.log(gain))))
    at, shape = find_peaks(_PER_NEPER * level, prominence=_PROMINENCE_DB)
    tall = shape["prominences"]
    clear = tall > _PROMINENCE_SIGMA * _PER_NEPER * sigma[at]
    return tuple(
        Peak(float(f[i]), float(gain[i]), float(gain[i] * relative[i]), float(height))
        for i, height in zip(at[clear], tall[clear], strict=True)
    )


def _smoothed(log_gain: Float, sigma: Float) -> tuple[Float, Float]:
    """Each line averaged over the fewest lines that bring it to `_SMOOTH_TO`, and its sigma."""
    level, left = log_gain.copy(), sigma.copy()
    for width in _WIDTHS[1:]:
        wide = uniform_filter1d(log_gain, width, mode="reflect")
        # At the ends the same lines are counted twice: half as many are averaged.
        distinct = np.full(len(sigma), float(width))
        distinct[: width // 2] = distinct[-(width // 2) :] = width / 2
        noise = np.sqrt(uniform_filter1d(sigma**2, width, mode="reflect") / distinct)
        rough = left > _SMOOTH_TO
        level[rough], left[rough] = wide[rough], noise[rough]
    return level, left


def _roughness(log_gain: Float) -> Float:
    """(n,) standard deviation of a line against its two neighbours, from the local median."""
    bend = np.zeros_like(log_gain)
    bend[1:-1] = np.abs(log_gain[1:-1] - (log_gain[:-2] + log_gain[2:]) / 2)
    bend[0], bend[-1] = bend[1], bend[-2]
    # A Gaussian's median absolute value is 0.6745 sigma; the bend has 3/2 of a line's variance.
    scale = 0.6745 * np.sqrt(1.5)
    return np.asarray(median_filter(bend, size=_NEIGHBOURS, mode="reflect") / scale)
