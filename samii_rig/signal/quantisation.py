"""Rounding errors that repeats of one deterministic signal do not show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from samii_rig.signal.groups import Group, Piece
from samii_rig.types import Float

# Distinct values at most of a signal whose resolution is inferred from its steps.
COARSE_VALUES = 1000


def floor_of(group: Group, pieces: Sequence[Piece]) -> tuple[Float, dict[int, str]]:
    """Variance per line of each output's rounding, and a message where it is not zero.

    A converter's step q makes an error of q^2/12 while its value moves. Errors of repeats
    of one deterministic signal are the same: they do not average out, and do not show.
    """
    floor = np.zeros(len(group.selection.outputs))
    messages = {}
    for i, channel in enumerate(group.selection.outputs):
        x = pieces[0].z[:, i + 1]
        step = channel.resolution or _step(x)
        moving = np.flatnonzero(np.diff(x))
        if step == 0 or moving.size == 0:
            continue
        part = (moving[-1] - moving[0] + 1) / x.size
        floor[i] = step**2 / 12 * part
        messages[i] = (
            f"{channel.name} scatters between repeats by less than its step of {step:g} "
            f"{channel.unit} makes (step^2/12)"
        )
    return floor, messages


def _step(x: Float) -> float:
    """The step of a coarse signal: the smallest difference, when all others are multiples."""
    values = np.unique(x)
    if not 2 <= values.size <= COARSE_VALUES:
        return 0.0
    gaps = np.diff(values)
    step = float(gaps.min())
    multiple = gaps / step
    return step if np.all(np.abs(multiple - np.round(multiple)) < 1e-3) else 0.0
