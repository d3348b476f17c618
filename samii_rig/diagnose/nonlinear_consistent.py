"""A force in the loop and the parameters about it, until both stand still.

A refit knows how a force's describing function moves with the parameters, not how its part in
time does; computing that anew where a refit ended, and refitting again, creeps along valleys that
the data hardly see. What such turns left of the data says where they lead.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from samii_rig.diagnose.nonlinear_model import LevelModel
from samii_rig.diagnose.refit import Fitted, Problem, refit
from samii_rig.types import Float

TURNS = 12  # at most
STILL = 0.5  # standard deviations that a turn moves the parameters, at its end
PLAIN = 3  # turns between leaps: they lead back into the valley
GAIN = 0.5  # of the cost, that a leap must promise
FIRM = 1e-4  # of the largest, singular values of differences that a leap rests on


def self_consistent(fitted: Fitted, computed: Callable[[LevelModel, Float], Problem]) -> Fitted:
    """Where turns of computing the force and refitting end, from where `fitted` is.

    computed : the problem with the force as it is in time at a vector of the model. Of the
    vectors that were tried, that with the least cost is where the last refit begins.
    """
    model, x = fitted.model, fitted.x
    assert isinstance(model, LevelModel)
    tried: list[tuple[Float, Float]] = []  # vector, whitened residuals with those of the priors
    best, least = x, np.inf
    for turn in range(TURNS):
        problem = computed(model, x)
        left = _left(model, problem, x)
        if (cost := float(left @ left)) < least:
            best, least = x, cost
        tried.append((x, left))
        end = refit(model, problem, x, far=False)
        step = end.x - x
        x = end.x
        if float(step @ end.precision() @ step) < STILL**2:
            break
        if turn % PLAIN == PLAIN - 1:
            x = _leap(model, tried[-PLAIN:], x)
    return refit(model, computed(model, best), best, far=False)


def _left(model: LevelModel, problem: Problem, x: Float) -> Float:
    n = model.n_nominal
    return np.concatenate(
        [problem.residual(model.response(x, problem.at)), x[:n] / model.prior[:n]]
    )


def _leap(model: LevelModel, tried: list[tuple[Float, Float]], x: Float) -> Float:
    """To the least squares on the plane through the vectors that were tried; x where that
    promises nothing."""
    base, left = tried[-1]
    by = np.stack([r - left for _, r in tried[:-1]], axis=1)
    times = np.linalg.lstsq(by, -left, rcond=FIRM)[0]
    there = left + by @ times
    if float(left @ left - there @ there) < GAIN:
        return x
    along = np.stack([v - base for v, _ in tried[:-1]], axis=1)
    return np.asarray(np.clip(base + along @ times, model.lower, model.upper))
