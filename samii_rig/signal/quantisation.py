"""Rounding errors: those that repeats do not show, and those that follow the motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from samii_rig.signal.groups import Group, Piece, Selection
from samii_rig.signal.steps import LEAST_STEPS, step_of, steps_moved
from samii_rig.types import Finding, Float, Recording, Segment


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
            f"{channel.name} scatters by less than its step of {step:g} "
            f"{channel.unit} makes (step^2/12)"
        )
    return floor, messages


def coarse(cut: Recording, segment: Segment, selection: Selection) -> list[Finding]:
    """Outputs that move by less than a step: their rounding follows the motion, as no noise does,
    and a response that is estimated from them is not the rig's."""
    out = []
    for channel in selection.outputs:
        x = cut.values[:, cut.column(channel.name)]
        x = x[np.isfinite(x)]
        steps = steps_moved(channel, x)
        if 0 < steps < LEAST_STEPS:
            step = step_of(channel, x)
            text = (
                f"{cut.place(segment)}: {channel.name} moves by {steps:.2g} of its step of "
                f"{step:.3g} {channel.unit} (root mean square), so its rounding hides the response"
            )
            out.append(Finding("resolution", "warning", text, channel.name, segment.name))
    return out
