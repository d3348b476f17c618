"""Confirmation of a force on everything that was recorded while its input repeated itself.

The lines of whole periods are held against the linear part of the model; what is left must be
what the force does in time, its harmonics on silent lines among it, in units of the noise that
the same lines show about it. Nothing of the describing functions is used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.measured import Measured
from samii_rig.diagnose.model import grid as plain_grid
from samii_rig.diagnose.nonlinear_driven import forced, periods
from samii_rig.diagnose.nonlinear_levels import LevelGrid
from samii_rig.diagnose.nonlinear_model import LevelModel
from samii_rig.diagnose.refit import Fitted
from samii_rig.types import Float, FrequencyResponse, Recording

NEAR = 12  # lines on either side over which the noise of one is pooled
CERTAIN = 3.5  # standard deviations from nothing, that a force must be seen
LIKE = 0.5  # of itself: how far what is seen may be from what it should be


@dataclass(frozen=True, slots=True)
class Seen:
    """How much of a force is in what a linear model leaves: share of it, its standard deviation,
    and by how much chi-square falls from a linear explanation to that with the force."""

    share: float
    sd: float
    fall: float
    inputs: int

    @property
    def holds(self) -> bool:
        """Whether the force is there, as strong as it should be, and better than without."""
        return (
            self.share > CERTAIN * self.sd
            and abs(self.share - 1) < max(LIKE, CERTAIN * self.sd)
            and self.fall > CERTAIN**2
        )

    def told(self) -> str:
        """In words."""
        return (
            f"computed in time under {self.inputs} recorded inputs: {self.share:.2f} +- "
            f"{self.sd:.2f} of the force is in what the linear model leaves"
        )


def seen(
    linear: Fitted,
    with_force: Fitted,
    at: LevelGrid,
    lines: Measured,
    responses: Sequence[FrequencyResponse],
    runs: Sequence[Recording],
) -> Seen | None:
    """The force in the recordings of repeated inputs; None without any, or as `forced`."""
    model, x = with_force.model, with_force.x
    assert isinstance(model, LevelModel)
    rig = model.rig
    names = (rig.actuator[int(lines.actuator[0])].name, *lines.outputs)
    kept = periods(rig, lines, responses, runs, names)
    given = {k: blocks[:, :, 0] for k, blocks in kept.items()}
    found = forced(model, x, given, model.strength(x)[0])
    if not found:
        return None
    both = power = fall = 0.0
    for one in found:
        on = (one.frequency >= lines.frequency[0]) & (one.frequency <= lines.frequency[-1])
        f, V, E = one.frequency[on], one.V[on], one.E[on]
        there = plain_grid(rig, f, at.sensor, at.actuator)
        Y = np.fft.rfft(kept[one.level][:, :, 1:].mean(axis=0), axis=0)[one.bins[on]]
        left = Y - model.response(x, there) * V[:, None]
        other = Y - linear.model.response(linear.x, there) * V[:, None]
        does = model.per_force(x, there) * E[:, None]
        noise = _pooled(np.abs(left - does) ** 2)
        both += float(np.sum((does.conj() * left).real / noise))
        power += float(np.sum(np.abs(does) ** 2 / noise))
        fall += float(np.sum((np.abs(other) ** 2 - np.abs(left - does) ** 2) / noise))
    if not power > 0:
        return None
    # Of a complex line each part has half the noise.
    return Seen(both / power, math.sqrt(0.5 / power), fall, len(found))


def _pooled(power: Float) -> Float:
    """(n, q) the mean over neighbouring lines."""
    total = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
    i = np.arange(len(power))
    low, high = np.maximum(i - NEAR, 0), np.minimum(i + NEAR + 1, len(power))
    return np.asarray((total[high] - total[low]) / (high - low)[:, None] + 1e-300)
