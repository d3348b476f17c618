"""Steps of a converter in what it reads, and how many of them a signal moves by."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from samii_rig.types import Channel, Float

# Distinct values at most of a signal whose resolution is inferred from its steps.
COARSE_VALUES = 1000
# Steps of its converter by which a signal moves at least, root mean square while it moves. A normal
# signal of one step is rounded to an error that knows nothing of it (to 5e-9, Widrow and Kollar
# 2008, 6.2); of half a step 1.4 % of it is lost, of a third a fifth, and of a sine below half a
# step all: with half a step, 2 of 16 recordings of nothing were told as something.
LEAST_STEPS = 1.0
# Steps within which a motion is not read in proportion: the describing function of a staircase
# is within 10 % of 1 from here on.
FEW = 3.0
CROSSED_IN = 0.5  # s in which few steps are crossed, or none: some periods of the band
DRIVES = 0.05  # of the most that it does anywhere, by how much a command moves where it drives


def step_of(channel: Channel, x: Float) -> float:
    """The step of a channel with values x (n,): as stated, or as they show it; 0 if they do not."""
    return channel.resolution or _step(x)


def steps_moved(channel: Channel, x: Float) -> float:
    """Steps by which a channel with values x (n,) moves, root mean square while it moves; inf for
    one without steps."""
    step = step_of(channel, x)
    return _moved(x) / step if step else math.inf


def crossed(x: Float, rate_hz: float) -> Float:
    """(n,) by how much x (n,) moves about each sample."""
    width = max(int(CROSSED_IN * rate_hz), 3)
    return np.asarray(ndimage.maximum_filter1d(x, width) - ndimage.minimum_filter1d(x, width))


def steps_driven(channel: Channel, x: Float, command: Float, rate_hz: float) -> Float:
    """Steps by which a channel with values x (n,) moves about each sample where a command (n,)
    drives; none for one without steps."""
    known = np.isfinite(x + command)
    x, command = x[known], command[known]
    step = step_of(channel, x)
    if step == 0 or x.size == 0:
        return np.zeros(0)
    drives = crossed(command, rate_hz)
    return crossed(x, rate_hz)[drives > DRIVES * np.max(drives)] / step


def _moved(x: Float) -> float:
    """Root mean square by which x (n,) moves; of one that comes to rest, while it moves: that of a
    normal signal of the same fourth moment to second, which is that of x weighed by its power."""
    square = (x - np.mean(x)) ** 2 if x.size else np.zeros(1)
    power = float(np.mean(square))
    return math.sqrt(max(power, float(np.mean(square**2)) / (3 * power))) if power else 0.0


def _step(x: Float) -> float:
    """The step of a coarse signal: the smallest difference, when all others are multiples."""
    values = np.unique(x)
    if not 2 <= values.size <= COARSE_VALUES:
        return 0.0
    gaps = np.diff(values)
    step = float(gaps.min())
    multiple = gaps / step
    return step if np.all(np.abs(multiple - np.round(multiple)) < 1e-3) else 0.0
