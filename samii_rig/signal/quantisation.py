"""Rounding errors: those that repeats do not show, and those that follow the motion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from samii_rig.signal.groups import Group, Piece, Selection
from samii_rig.types import Channel, Finding, Float, Recording, Segment

# Distinct values at most of a signal whose resolution is inferred from its steps.
COARSE_VALUES = 1000
# Steps of its converter by which a signal moves at least, root mean square while it moves. A normal
# signal of one step is rounded to an error that knows nothing of it (to 5e-9, Widrow and Kollar
# 2008, 6.2); of half a step 1.4 % of it is lost, of a third a fifth, and of a sine below half a
# step all: with half a step, 2 of 16 recordings of nothing were told as something.
LEAST_STEPS = 1.0


def floor_of(group: Group, pieces: Sequence[Piece]) -> tuple[Float, dict[int, str]]:
    """(n_out,) variance per line of each output's rounding, and a message where it is not zero.

    A converter's step q makes an error of q^2/12 while its value moves. Errors of repeats
    of one deterministic signal are the same: they do not average out, and do not show.
    """
    floor = np.zeros(len(group.selection.outputs))
    messages = {}
    for i, channel in enumerate(group.selection.outputs):
        x = pieces[0].z[:, i + 1]
        step = step_of(channel, x)
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


def step_of(channel: Channel, x: Float) -> float:
    """The step of a channel with values x (n,): as stated, or as they show it; 0 if they do not."""
    return channel.resolution or _step(x)


def coarse(cut: Recording, segment: Segment, selection: Selection) -> list[Finding]:
    """Outputs that move by less than a step: their rounding follows the motion, as no noise does,
    and a response that is estimated from them is not the rig's."""
    out = []
    for channel in selection.outputs:
        x = cut.values[:, cut.column(channel.name)]
        x = x[np.isfinite(x)]
        step, moved = step_of(channel, x), _moved(x)
        if 0 < moved < LEAST_STEPS * step:
            text = (
                f"{cut.place(segment)}: {channel.name} moves by {moved / step:.2g} of its step of "
                f"{step:.3g} {channel.unit} (root mean square), so its rounding hides the response"
            )
            out.append(Finding("resolution", "warning", text, channel.name, segment.name))
    return out


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
