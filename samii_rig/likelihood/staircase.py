"""A converter's staircase, where a motion crosses few of its steps.

A motion y is read as y + e, in steps (Widrow and Kollar 2008, Quantization Noise, ch. 4),

    e = sum_h (-1)^h/(pi h) sin(2 pi h (y + o)),

where o is the place in its step at which the sensor rests. Noise of sd sigma that dithers it leaves
exp(-2 (pi h sigma)^2) of harmonic h in the mean. Within few steps e follows the motion, and looks
like another response.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from samii_rig.likelihood.algebra import orthonormal
from samii_rig.types import Float

# Steps within which a motion stays that is not read in proportion: from here on e has less than 2 %
# of a sine (2 J_1(2 pi a)/(pi a) of its amplitude a = 5).
FEW = 10.0
STILL = 1e-3  # steps, of a motion whose error is worth no amplitude
CROSSED_IN = 0.5  # s in which few steps are crossed: some periods of the band
HARMONICS = 3  # lowest, whose amplitudes are free: 83 % of the power of e
STRETCHES = 20  # of a record at most, in each of which the sensor rests at a place of its own
# s for which what wanders, below the band, rests in its step, at least: some periods of the band,
# from which its place is determined.
RESTS_IN_STEP = 1.0
UNSEEN = 0.05  # of a harmonic, what dithering leaves of it that nobody sees

Stretch = tuple[slice, Float]
"""Samples of a record, and shapes (p, m) over them, orthonormal."""


def crossed(y: Float, rate_hz: float) -> Float:
    """(n,) by how much a motion (n,) moves about each sample."""
    width = max(int(CROSSED_IN * rate_hz), 3)
    return np.asarray(ndimage.maximum_filter1d(y, width) - ndimage.minimum_filter1d(y, width))


def within_few(y: Float, rate_hz: float) -> bool:
    """Whether a motion (n,) in steps stays within few of them most of the time that it crosses
    any."""
    moves = crossed(y, rate_hz)
    moves = moves[moves > 0.5]
    return bool(moves.size and np.median(moves) < FEW)


def follows(y: Float, shares: Float, sd: float, rate_hz: float, most: int) -> list[Stretch]:
    """The lowest harmonics of the error of a motion y (n,) in steps, where it stays within few.

    Nobody knows o: sine and cosine of each have amplitudes that are free, in each stretch of their
    own, as o may have moved.
    shares : of the records behind it, whose sum it is, of y. sd : of the noise that dithers each.
    most : shapes of all stretches.
    """
    # Records of nearly one level have nearly the same phases, and o has any.
    levels = np.unique(np.round(np.abs(shares), 3))
    each = 2 * levels.size
    seen = [h for h in range(1, HARMONICS + 1) if math.exp(-2 * (math.pi * h * sd) ** 2) >= UNSEEN]
    harmonics = seen[: most // each]
    if not harmonics:
        return []
    room = most // (each * len(harmonics))
    count = min(STRETCHES, int(y.size / (RESTS_IN_STEP * rate_hz)), room)
    moves = crossed(y, rate_hz)
    out = []
    for on in np.array_split(np.arange(y.size), max(count, 1)):
        own = [_waves(share * y[on], harmonics, share * moves[on] < FEW) for share in levels]
        shapes = orthonormal(np.concatenate(own).T).T
        if len(shapes):
            out.append((slice(int(on[0]), int(on[-1]) + 1), shapes))
    return out


def _waves(y: Float, harmonics: list[int], few: NDArray[np.bool_]) -> Float:
    """(2 h, m) sines and cosines along a motion (m,), less their mean, where it crosses few."""
    phase = 2 * np.pi * np.outer(harmonics, y[few])
    waves = np.concatenate([np.sin(phase), np.cos(phase)])
    out = np.zeros((len(waves), y.size))
    if few.any() and np.ptp(y[few]) >= STILL:
        out[:, few] = waves - np.mean(waves, axis=1, keepdims=True)
    return out
