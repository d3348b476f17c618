"""A command that was measured, not recorded as it was sent: the loop's law without a meter's noise.

v = u + kp (theta_ref - theta) holds for what was sent. What a meter shows of it is that, a part of
a sample later and with noise of its own, which never drove the rig. Three weights on neighbouring
samples of the law tell the one from the other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from samii_rig.types import Float, Recording

NOISE = 0.1  # of what was measured, sd, that may be the meter's
# Samples further out than so many sd are none of its noise, but edges within a sample; of all
# samples they may be this part.
FAR, EDGES = 7.0, 1e-3
LOUDER = 2.0  # noise among the lines of the command, over that of all lines: no noise above
BUSY = 0.01  # of the command's largest line, in power, above which a line is the command's
TO_SD = 1.4826  # median of |x| to the standard deviation of a Gaussian x


def sent(
    recording: Recording, command: int, kp: float, theta: Float | None
) -> tuple[Float, NDArray[np.bool_]]:
    """(n,) the command as it drove the rig, as near as the recording tells; and where it has an
    edge within a sample, so that nobody knows when that came.

    command : its column. theta : (n,) of the sensor around which a loop of gain kp is closed.
    """
    channel = recording.channels[command]
    v = np.asarray(recording.values[:, command], np.float64)
    none = np.zeros(v.size, np.bool_)
    if not recording.names("reference"):
        return v, none
    each = [_drawn(recording, v, _law(recording, command, k, theta)) for k in {kp, 0.0}]
    drawn, off = min(each, key=lambda one: float(np.sum(one[1] ** 2)))
    far = _far(off)
    return (drawn, far) if _noise(off, v, far, channel.resolution) else (v, none)


def _law(recording: Recording, command: int, kp: float, theta: Float | None) -> Float:
    """(n,) u + kp (theta_ref - theta)."""
    law = np.zeros(recording.sequence.size)
    for name in recording.names("reference"):
        column = recording.column(name)
        alike = recording.channels[column].unit == recording.channels[command].unit
        law += (1.0 if alike else kp) * recording.values[:, column]
    return law if theta is None or kp == 0 else law - kp * theta


def _drawn(recording: Recording, v: Float, law: Float) -> tuple[Float, Float]:
    """(n,) what weighted neighbours of the law make of a command, the command itself where they are
    not known; and what they leave of it."""
    near = np.stack([np.roll(law, k) for k in (-1, 0, 1)], axis=1)
    whole = np.isfinite(v) & np.all(np.isfinite(near), axis=1)
    whole[[0, -1]] = False
    jumps = np.flatnonzero(np.diff(recording.sequence) != 1)
    whole[jumps] = whole[jumps + 1] = False
    if np.count_nonzero(whole) < v.size // 2:
        return v, v
    weights = np.linalg.lstsq(near[whole], v[whole], rcond=None)[0]
    drawn = np.where(whole, near @ weights, v)
    return drawn, np.asarray(v - drawn)


def _sd(off: Float) -> float:
    return TO_SD * float(np.nanmedian(np.abs(off)))


def _far(off: Float) -> NDArray[np.bool_]:
    return np.asarray(np.abs(off) > FAR * _sd(off))


def _noise(off: Float, v: Float, far: NDArray[np.bool_], step: float) -> bool:
    """Whether what the law leaves of a command is a meter's noise: more than its converter's steps,
    small, with next to no sample far out, and no louder where the command is."""
    known = np.isfinite(off) & np.isfinite(v)
    if not step < _sd(off) < NOISE * float(np.std(v[known])) or np.mean(far) > EDGES:
        return False
    rest = np.where(far, 0.0, off)[known]
    power, own = (np.abs(np.fft.rfft(x - np.mean(x)))[1:] ** 2 for x in (rest, v[known]))
    busy = own > BUSY * np.max(own)
    return bool(np.mean(power[busy]) < LOUDER * np.mean(power))
