"""Samples that stand alone: what a contact or a converter did to one sensor at one instant.

A rig moves on from sample to sample. A cubic through the neighbours misses a sample by what the
motion and the noise make of it there; a sample that it misses by far, alone in time and among the
sensors, takes the cubic's value. The loop's input is computed before: the loop saw the spike.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from samii_rig.types import Float

SPIKE = 8.0  # robust standard deviations; of Gaussian noise one sample in 1e15 is as far off
QUIET = 5.0  # the same, of a sample that is as its neighbours are
REACH = 2  # samples on either side, through which the cubic runs
BLOCK = 256  # samples, over which the scale of what is missed is one number
MOST = 0.01  # of all samples: more are no spikes
TO_SD = 1.4826  # median of |x| to the standard deviation of a Gaussian x
# Robust standard deviations from what a model predicts, of a sample that is none of a spike but the
# rig's own motion: that of one in 400, and so little of a spike does no harm.
AS_PREDICTED = 3.0

Spike = tuple[int, int, float]
"""Sample, sensor, and how much more was recorded there than is taken."""


def mended(z: Float, step: Float) -> tuple[Float, tuple[Spike, ...]]:
    """z (n, q) without spikes, and these.

    step : (q,) of the converters, 0 where it is not known.
    """
    n, q = z.shape
    spikes: list[Spike] = []
    if n < 4 * BLOCK:
        return z, ()
    off = np.stack([_missed(z[:, i]) for i in range(q)], axis=1)
    scale = np.stack([_scale(off[:, i], step[i]) for i in range(q)], axis=1)
    loud = np.abs(off) > QUIET * scale
    out = z
    for i in range(q):
        others = _widened(np.any(np.delete(loud, i, axis=1), axis=1))
        found = _alone(z[:, i], off[:, i], scale[:, i], others)
        if 0 < found.size <= MOST * n:
            out = z.copy() if out is z else out
            out[found, i] -= off[found, i]
            spikes += [(int(at), i, float(off[at, i])) for at in found]
    return out, tuple(spikes)


def as_predicted(e: Float, spikes: Sequence[Spike], step: Float) -> list[Spike]:
    """Of these, which are none: a start that rings at many frequencies has samples that stand as
    far from a cubic, and a model of the rig predicts them. e : (n, q) what it leaves of the mended
    samples. step : as of `mended`."""
    scale = {
        i: _scale(_missed(e[:, i]), step[i]) for i in {i for _, i, _ in spikes}
    }  # that of the noise, where the model is right
    found = []
    for at, i, more in spikes:
        around = e[at - REACH : at + REACH + 1, i].copy()
        around[REACH] += more
        if abs(_missed(around)[REACH]) <= AS_PREDICTED * scale[i][at]:
            found.append((at, i, more))
    return found


def _alone(z: Float, off: Float, scale: Float, others: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Samples that are far off, without which their neighbours are not."""
    high = np.abs(off)
    far = np.flatnonzero((high > SPIKE * scale) & ~others)
    far = far[(far > 2 * REACH) & (far < z.size - 2 * REACH - 1)]
    far = np.array([i for i in far if high[i] == high[i - REACH : i + REACH + 1].max()], np.int64)
    kept = []
    for i in far:
        around = z[i - 2 * REACH : i + 2 * REACH + 1].copy()
        around[2 * REACH] -= off[i]
        if np.all(np.abs(_missed(around)) <= QUIET * scale[i]):
            kept.append(int(i))
    return np.array(kept, np.int64)


def _missed(z: Float) -> Float:
    """(n,) by which a cubic through two neighbours on either side misses a sample."""
    out = np.zeros_like(z)
    out[2:-2] = z[2:-2] - (4 * (z[1:-3] + z[3:-1]) - z[:-4] - z[4:]) / 6
    return out


def _scale(off: Float, step: float) -> Float:
    """(n,) robust standard deviation of what is missed about each sample."""
    blocks = -(-off.size // BLOCK)
    padded = np.pad(np.abs(off), (0, blocks * BLOCK - off.size), mode="reflect")
    each = TO_SD * np.median(padded.reshape(blocks, BLOCK), axis=1)
    near = np.maximum(each, np.maximum(np.append(each[1:], 0.0), np.insert(each[:-1], 0, 0.0)))
    return np.repeat(np.maximum(near, max(step, 1e-300)), BLOCK)[: off.size]


def _widened(on: NDArray[np.bool_]) -> NDArray[np.bool_]:
    out = on.copy()
    for k in range(1, REACH + 1):
        out[k:] |= on[:-k]
        out[:-k] |= on[k:]
    return out
