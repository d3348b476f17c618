"""The two functions that are minimised: misfit in noise units, and of the logarithm.

Both are sums of squares of real residuals with an analytic Jacobian, over all responses and
with the priors as further residuals. The first is the likelihood. The second, the complex
logarithm of model over measurement, has fewer wrong minima far from the optimum: a resonance
in the wrong place costs what it is off, not a thousand times its noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from samii_rig import levenberg
from samii_rig.identify.data import Data
from samii_rig.identify.parameters import Space
from samii_rig.identify.predict import Predictor
from samii_rig.levenberg import Minimum
from samii_rig.types import Complex, Float

# A logarithm of a response is not taken to be known better than this: 10 % of gain or 6
# degrees. Below it the first stage would look at what only the second can resolve.
LOG_FLOOR = 0.1
# First damping far from the minimum. With a tenth of it 5 of 100 starts within 30 % of the truth
# end in another minimum.
FAR = 0.1

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
    damping: float = levenberg.NEAR,
) -> Minimum:
    """A local minimum of a misfit within the bounds of the space: see `levenberg.minimise`.

    fixed : index of a parameter that stays at its start (profile likelihood).
    damping : the first one; `FAR` where the start may be far away.
    """
    lower, upper = space.lower.copy(), space.upper.copy()
    if fixed is not None:
        lower[fixed] = upper[fixed] = start[fixed]
    return levenberg.minimise(
        lambda x: misfit(data, space, predictor, x),
        *(start, lower, upper),
        tolerance=tolerance,
        damping=damping,
    )


def _real(rows: list[Complex], slopes: list[Complex], space: Space, x: Float) -> Evaluated:
    """Real and imaginary parts one below the other, then the priors."""
    r = np.concatenate([row.reshape(-1) for row in rows])
    J = np.concatenate([slope.reshape(-1, x.size) for slope in slopes])
    known = np.flatnonzero(np.isfinite(space.prior_sd))
    prior = (x - space.prior_mean)[known] / space.prior_sd[known]
    slope = np.zeros((known.size, x.size))
    slope[np.arange(known.size), known] = 1 / space.prior_sd[known]
    return np.concatenate([r.real, r.imag, prior]), np.concatenate([J.real, J.imag, slope])
