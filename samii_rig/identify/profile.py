"""Profile likelihood: what the data say of one parameter whatever the others are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from samii_rig.errors import InputError
from samii_rig.identify.likelihood import minimise, noise_misfit
from samii_rig.identify.maximum_likelihood import Problem
from samii_rig.identify.result import Identification
from samii_rig.levenberg import Minimum
from samii_rig.types import Float

STEPS = 12  # refits on each side at most
CLOSE = 0.01  # sigma, how near to the quantile is near enough


@dataclass(frozen=True, slots=True)
class Profile:
    """Profile likelihood of one parameter: the others are refitted at each of its values.

    values : (n,) SI, increasing. rise : (n,) twice the logarithm of the likelihood ratio.
    low, high : where the rise meets the level's quantile; a bound of the search if it does
        not, and `open_low`, `open_high` say so.
    """

    name: str
    values: Float
    rise: Float
    low: float
    high: float
    open_low: bool
    open_high: bool


def profile(posed: Problem, found: Identification, name: str, level: float = 0.9) -> Profile:
    """Profile likelihood of the parameter `name` around what `solve` found for `posed`.

    Raises InputError for a name that was not free.
    """
    if name not in found.names:
        raise InputError("profile", "parameter", name, f"one of {', '.join(found.names)}")
    i = found.names.index(name)
    start = float(posed.space.start[i])
    centre = np.log(found.values / posed.space.start)
    here = minimise(noise_misfit, posed.data, posed.space, posed.predictor, centre)
    quantile = float(special.ndtri((1 + level) / 2))
    step = quantile * min(float(np.sqrt(found.log_covariance[i, i])), 1.0)
    below, closed_low = _side(posed, here, i, -1.0, quantile, step)
    above, closed_high = _side(posed, here, i, 1.0, quantile, step)
    x, rise = np.array(sorted([*below, (float(here.x[i]), 0.0), *above])).T
    values = start * np.exp(x)
    low, high = start * np.exp(below[-1][0]), start * np.exp(above[-1][0])
    if start < 0:
        return Profile(name, values[::-1], rise[::-1], high, low, not closed_high, not closed_low)
    return Profile(name, values, rise, low, high, not closed_low, not closed_high)


def _side(
    posed: Problem, here: Minimum, i: int, side: float, quantile: float, step: float
) -> tuple[list[tuple[float, float]], bool]:
    """(x, rise) of points outwards, the end last, and whether the rise got there.

    The root of the rise is close to linear in the parameter: secant steps along it.
    """
    bound = posed.space.lower[i] if side < 0 else posed.space.upper[i]
    centre, x = float(here.x[i]), here.x
    far, reached = 0.0, 0.0
    points: list[tuple[float, float]] = []
    for _ in range(STEPS):
        trial = x.copy()
        trial[i] = centre + side * (far + step)
        stop = bool((trial[i] - bound) * side >= 0)
        if stop:
            trial[i] = bound
        end = minimise(noise_misfit, posed.data, posed.space, posed.predictor, trial, fixed=i)
        rise = float(np.sqrt(max(2 * (end.cost - here.cost), 0.0)))
        points.append((float(trial[i]), rise**2))
        if abs(rise - quantile) < CLOSE:
            return points, True
        if stop and rise < quantile:
            return points, False
        now = abs(float(trial[i]) - centre)
        slope = (rise - reached) / (now - far)
        far, reached, x = now, rise, end.x
        step = (quantile - rise) / slope if slope > 0 else now
        step = float(np.clip(step, -0.7 * now, 2 * now))
    return points, reached >= quantile
