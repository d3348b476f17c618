"""The two functions that are minimised: misfit in noise units, and of the logarithm.

Both are sums of squares of real residuals with an analytic Jacobian, over all responses and
with the priors as further residuals. The first is the likelihood. The second, the complex
logarithm of model over measurement, has fewer wrong minima far from the optimum: a resonance
in the wrong place costs what it is off, not a thousand times its noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from samii_rig.identify.data import Data
from samii_rig.identify.parameters import Space
from samii_rig.identify.predict import Predictor
from samii_rig.types import Complex, Float

# A logarithm of a response is not taken to be known better than this: 10 % of gain or 6
# degrees. Below it the first stage would look at what only the second can resolve.
LOG_FLOOR = 0.1
STEPS = 60  # evaluations of either stage at most; 4 to 15 are usual
# First damping, of the squared norm of a column of the Jacobian, near the minimum and far from
# it. With a tenth of FAR 5 of 100 starts within 30 % of the truth end in another minimum.
NEAR, FAR = 1e-3, 0.1
LEAST_SCALE = 1e-8  # of the largest norm: a parameter that nothing depends on stays in place
AGREES = 0.25  # of the decrease that the linear model expects, at least, to end there

Evaluated = tuple[Float, Float]


def noise_misfit(data: Data, space: Space, predictor: Predictor, x: Float) -> Evaluated:
    """Residuals (n,) in noise units and their Jacobian (n, n_free) at x."""
    H, dH = predictor.gradient(x)
    rows: list[Complex] = []
    slopes: list[Complex] = []
    for d, h, dh in zip(data.lines, H, dH, strict=True):
        # A complex entry of variance C has C/2 in each of its parts.
        weight = np.sqrt(2 * d.factor)[:, None, None] * d.root
        rows.append(weight @ (h - d.H)[:, :, None])
        slopes.append(weight @ dh)
    return _real(rows, slopes, space, x)


def log_misfit(data: Data, space: Space, predictor: Predictor, x: Float) -> Evaluated:
    """Residuals of log(model/measurement), phases within half a turn, and their Jacobian."""
    return _real(*_logarithms(data, predictor, x), space, x)


def gain_misfit(data: Data, space: Space, predictor: Predictor, x: Float) -> Evaluated:
    """Residuals of log|model/measurement|, without the phase, and their Jacobian."""
    rows, slopes = _logarithms(data, predictor, x)
    return _real([_gain(r) for r in rows], [_gain(s) for s in slopes], space, x)


def _logarithms(data: Data, predictor: Predictor, x: Float) -> tuple[list[Complex], list[Complex]]:
    H, dH = predictor.gradient(x)
    rows: list[Complex] = []
    slopes: list[Complex] = []
    for d, h, dh in zip(data.lines, H, dH, strict=True):
        size = np.abs(d.H) ** 2
        weight = 1 / np.sqrt(LOG_FLOOR**2 + d.sd**2 / np.where(size > 0, size, 1e-300))
        left: Complex = np.log(h / np.where(size > 0, d.H, h))
        rows.append((weight * left)[:, :, None])
        slopes.append((weight / h)[:, :, None] * dh)
    return rows, slopes


def _gain(logarithm: Complex) -> Complex:
    return np.asarray(logarithm.real + 0j)


def chi_square(data: Data, predictor: Predictor, x: Float) -> list[Float]:
    """T^2 = e^H C^-1 e of every line, (n,) for each response."""
    H = predictor.response(x)
    return [
        np.sum(np.abs(d.root @ (h - d.H)[:, :, None]) ** 2, axis=(1, 2))
        for d, h in zip(data.lines, H, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where one start led: x, half the sum of squares there, the residuals' Jacobian."""

    x: Float
    cost: float
    jacobian: Float
    converged: bool


Misfit = Callable[[Data, Space, Predictor, Float], Evaluated]


def minimise(
    misfit: Misfit,
    data: Data,
    space: Space,
    predictor: Predictor,
    start: Float,
    *,
    fixed: int | None = None,
    tolerance: float = 1e-9,
    damping: float = NEAR,
) -> Minimum:
    """A local minimum within the bounds by the method of Levenberg and Marquardt.

    The normal equations: with a few parameters they cost nothing beside the model, and the
    columns are scaled by their norms (More, 1978), so that what is lost in digits is what the
    noise has long taken. Each step moves the parameters that no bound holds and ends at the
    bounds (projection).

    fixed : index of a parameter that stays at its start (profile likelihood).
    tolerance : of the cost and of x, relative, at which it ends.
    damping : the first one; `FAR` where the start may be far away.
    """
    free = np.ones(start.size, bool)
    if fixed is not None:
        free[fixed] = False
    x = np.where(free, np.clip(start, space.lower, space.upper), start)
    r, J = misfit(data, space, predictor, x)
    cost, growth = float(r @ r) / 2, 2.0
    scale = np.zeros(start.size)
    for _ in range(STEPS - 1):
        slope, curvature = J.T @ r, J.T @ J
        scale = np.maximum(scale, np.sqrt(np.diagonal(curvature)))
        floor = LEAST_SCALE * float(scale.max(initial=0.0)) + np.finfo(float).tiny
        held = ((x <= space.lower) & (slope > 0)) | ((x >= space.upper) & (slope < 0))
        moving = np.flatnonzero(free & ~held)
        if not moving.size:
            return Minimum(x, cost, J, True)
        damped = curvature[np.ix_(moving, moving)]
        damped = damped + np.diag(damping * np.maximum(scale, floor)[moving] ** 2)
        trial = x.copy()
        trial[moving] -= np.linalg.solve(damped, slope[moving])
        trial = np.where(free, np.clip(trial, space.lower, space.upper), start)
        step = trial - x
        expected = -float(step @ slope + step @ curvature @ step / 2)
        small = float(np.linalg.norm(step)) < tolerance * (tolerance + float(np.linalg.norm(x)))
        if small or expected <= 0:
            return Minimum(x, cost, J, True)
        r_new, J_new = misfit(data, space, predictor, trial)
        new = float(r_new @ r_new) / 2
        gain = (cost - new) / expected
        if gain > 0:
            ends = cost - new < tolerance * cost and gain > AGREES
            x, r, J, cost = trial, r_new, J_new, new
            damping, growth = damping * max(1 / 9, 1 - (2 * gain - 1) ** 3), 2.0
            if ends:
                return Minimum(x, cost, J, True)
        else:
            if expected < tolerance * cost:
                return Minimum(x, cost, J, True)
            damping, growth = damping * growth, 2 * growth
    return Minimum(x, cost, J, False)


def _real(rows: list[Complex], slopes: list[Complex], space: Space, x: Float) -> Evaluated:
    """Real and imaginary parts one below the other, then the priors."""
    r = np.concatenate([row.reshape(-1) for row in rows])
    J = np.concatenate([slope.reshape(-1, x.size) for slope in slopes])
    known = np.flatnonzero(np.isfinite(space.prior_sd))
    prior = (x - space.prior_mean)[known] / space.prior_sd[known]
    slope = np.zeros((known.size, x.size))
    slope[np.arange(known.size), known] = 1 / space.prior_sd[known]
    return np.concatenate([r.real, r.imag, prior]), np.concatenate([J.real, J.imag, slope])
