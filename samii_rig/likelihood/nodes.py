"""Lines of a contour between which a change of the response is taken for linear."""

from __future__ import annotations

import numpy as np

from samii_rig.likelihood.contour import Contour
from samii_rig.types import Complex, Float, Int

SPACING = 0.2  # nodes, times the distance over which the reference's response turns by 1 rad
WIDEST = 0.1  # nodes, apart over frequency at most
# Nodes over lines of the contour, at most, of a change that is free where noise is estimated: at
# the lowest lines one a line would leave no noise to be seen.
FREE_NODES = 0.1
BELOW = 2**0.5  # the same, below the band: a change of 1/s is linear between them to 3 %
ABOUT = 2**0.5  # times a line, and part of it, that are about it: an octave holds a mode's peak


def nodes_of(
    contour: Contour, H: Complex, band: tuple[float, float], *, spare: bool = False
) -> Int:
    """Lines of the contour between which a change of the response is taken for linear.

    H : (M//2 + 1, q) reference on the contour, each sensor over its size about a line. spare : few
    of them at the lowest lines, but where the response turns more than a double integrator's.
    """
    f = contour.frequency
    inside = (f >= band[0]) & (f <= band[1])
    size, turn = np.linalg.norm(H, axis=1), np.linalg.norm(np.gradient(H, axis=0), axis=1)
    turning = np.divide(turn, size, out=np.zeros_like(turn), where=size > 0)
    each = 1 / np.maximum(np.arange(f.size), 1)
    if spare:
        density = np.maximum(turning - 2 * each, 0.0) / SPACING + np.minimum(
            each / WIDEST, FREE_NODES
        )
    else:
        density = turning / SPACING + each / WIDEST
    place = np.cumsum(np.where(inside, np.minimum(density, 1.0), 0.0))
    first, last = np.flatnonzero(inside)[[0, -1]]
    marks = np.arange(place[first], place[last], 1.0)
    # An input below the band moves what integrates it, and the end of a record makes that seen
    # at all lines.
    below = first / BELOW ** np.arange(1.0, np.log(max(first, 1)) / np.log(BELOW))
    low = np.rint(np.append(below, 0.0)).astype(np.int64)
    return np.unique(np.concatenate([low, np.searchsorted(place, marks), [last]]))


def size_about(H: Complex) -> Float:
    """(n, q) root mean square of a response (n, q) about each of its lines from 0 Hz on: over it a
    sensor of the drive's angle, which falls with the frequency, covers no mode of another one."""
    k = np.arange(len(H))
    first = np.floor(k / ABOUT).astype(np.int64)
    behind = np.minimum(np.ceil(k * ABOUT), k[-1]).astype(np.int64) + 1
    power = np.cumsum(np.concatenate([np.zeros((1, H.shape[1])), np.abs(H) ** 2]), axis=0)
    mean = (power[behind] - power[first]) / (behind - first)[:, None]
    return np.asarray(np.sqrt(np.maximum(mean, np.finfo(np.float64).tiny)))


def between(nodes: Int, few: Int) -> Float:
    """(b, m) a change on the nodes, of one on few of them, linear between."""
    return np.stack([np.interp(nodes, few, one) for one in np.eye(few.size)], axis=1)
