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
from scipy.optimize import least_squares

from samii_rig.identify.data import Data
from samii_rig.identify.parameters import Space
from samii_rig.identify.predict import Predictor
from samii_rig.types import Complex, Float

# A logarithm of a response is not taken to be known better than this: 10 % of gain or 6
# degrees. Below it the first stage would look at what only the second can resolve.
LOG_FLOOR = 0.1
STEPS = 60  # of either stage at most; 5 to 15 are usual

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
    H, dH = predictor.gradient(x)
    rows: list[Complex] = []
    slopes: list[Complex] = []
    for d, h, dh in zip(data.lines, H, dH, strict=True):
        size = np.abs(d.H) ** 2
        weight = 1 / np.sqrt(LOG_FLOOR**2 + d.sd**2 / np.where(size > 0, size, 1e-300))
        left: Complex = np.log(h / np.where(size > 0, d.H, h))
        rows.append((weight * left)[:, :, None])
        slopes.append(weight[:, :, None] * dh / h[:, :, None])
    return _real(rows, slopes, space, x)


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
) -> Minimum:
    """A local minimum by a trust region method within the bounds.

    fixed : index of a parameter that stays at its start (profile likelihood).
    tolerance : of the cost and of x, relative, at which it ends.
    """
    moving = np.array([i for i in range(start.size) if i != fixed], dtype=np.int64)
    held: dict[bytes, Evaluated] = {}

    def at(free: Float) -> Evaluated:
        # The solver asks for residuals and Jacobian one after the other; they cost as one.
        key = free.tobytes()
        if key not in held:
            x = start.copy()
            x[moving] = free
            held.clear()
            held[key] = misfit(data, space, predictor, x)
        return held[key]

    margin = 1e-9 * (space.upper - space.lower)[moving]
    inside = np.clip(start[moving], space.lower[moving] + margin, space.upper[moving] - margin)

    def residual(free: Float) -> Float:
        return at(free)[0]

    def slope(free: Float) -> Float:
        return at(free)[1][:, moving]

    result = least_squares(
        residual,
        inside,
        jac=slope,
        bounds=(space.lower[moving], space.upper[moving]),
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        gtol=None,
        max_nfev=STEPS,
    )
    x = start.copy()
    x[moving] = result.x
    return Minimum(x, float(result.cost), at(result.x)[1], bool(result.status > 0))


def _real(rows: list[Complex], slopes: list[Complex], space: Space, x: Float) -> Evaluated:
    """Real and imaginary parts one below the other, then the priors."""
    r = np.concatenate([row.reshape(-1) for row in rows])
    J = np.concatenate([slope.reshape(-1, x.size) for slope in slopes])
    known = np.flatnonzero(np.isfinite(space.prior_sd))
    prior = (x - space.prior_mean)[known] / space.prior_sd[known]
    slope = np.zeros((known.size, x.size))
    slope[np.arange(known.size), known] = 1 / space.prior_sd[known]
    return np.concatenate([r.real, r.imag, prior]), np.concatenate([J.real, J.imag, slope])
