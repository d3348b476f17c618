"""Measured responses in noise units: what every likelihood is made of.

With nu complex degrees of freedom the covariance C that was estimated for p entries is a
complex Wishart matrix, and its inverse is too large, and by chance too large in some
directions. For a linear model fitted with weights w C^-1,

    E[C^-1] = nu/(nu - p) S^-1,   E[C^-1 S C^-1] = nu^3/((nu - p)((nu - p)^2 - 1)) S^-1,

S the true covariance. The factor w = ((nu - p)^2 - 1)/nu^2 is the one for which the inverse
of the information J^H w C^-1 J is the estimator's true covariance, and with several nu it
weighs the lines best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import special

from samii_rig.errors import EstimateError
from samii_rig.types import Complex, Float, FrequencyResponse

# A local quadratic fit over m lines has 9/(4 m) of a line's variance, and neighbours share
# their data: 9/4 of the m estimates are independent.
NEIGHBOURS_SHARE = 2.25
LOCAL_PARAMETERS = 6  # complex numbers of a local model at least: H and a transient, quadratic
REFUSED = 0.01  # p-value below which a model is said not to fit


@dataclass(frozen=True, slots=True)
class Fit:
    """How well a model fits in noise units.

    ratio : mean of T^2 over its mean if the model holds (Hotelling), corrected for the number
        of parameters: chi-square per degree of freedom; 1 when the model holds.
    p_value : probability of such a ratio when the model holds.
    n_real : real numbers fitted.
    """

    ratio: float
    p_value: float
    n_real: int

    @property
    def holds(self) -> bool:
        """Whether the noise alone can explain what is left."""
        return self.p_value >= REFUSED


class Measured(Protocol):
    """Lines of one response, as a fit sees them.

    frequency : (n,) Hz. dof : (n,). p : entries a line.
    shared : lines that share one covariance, and lines that share the data of one estimate.
    """

    @property
    def frequency(self) -> Float:
        """(n,) Hz."""

    @property
    def dof(self) -> Float:
        """(n,) complex degrees of freedom of the covariance."""

    @property
    def shared(self) -> tuple[float, float]:
        """Lines that share one covariance, and one estimate."""

    @property
    def p(self) -> int:
        """Entries a line."""


def factor(dof: Float, p: int) -> Float:
    """w = ((nu - p)^2 - 1)/nu^2 (see above); EstimateError where nu is too small for it."""
    if np.any(dof <= p + 1):
        raise EstimateError(
            f"{float(np.min(dof)):.3g} degrees of freedom are too few to weigh {p} outputs; "
            "more repeats or fewer outputs would do"
        )
    with np.errstate(invalid="ignore"):
        return np.where(np.isinf(dof), 1.0, ((dof - p) ** 2 - 1) / dof**2)


def mean_t2(dof: Float, p: int) -> Float:
    """(n,) the mean of T^2 = e^H C^-1 e when the model holds, nu p/(nu - p)."""
    return np.asarray(p / (1 - p / dof))


def root(C: Complex) -> Complex:
    """(n, p, p) inverse of the lower Cholesky factor of each C.

    Raises EstimateError for an output without noise, or noise that two outputs share.
    """
    scale = np.sqrt(np.diagonal(C, axis1=1, axis2=2).real)
    if not np.all(scale > 0):
        raise EstimateError("an output has no noise at some line; leave it out or pool more lines")
    try:
        lower = np.linalg.cholesky(C / (scale[:, :, None] * scale[:, None, :]))
    except np.linalg.LinAlgError as failure:
        raise EstimateError(
            "the noise covariance is singular: two outputs carry the same noise; "
            "leave one of them out"
        ) from failure
    return np.asarray(np.linalg.inv(lower) / scale[:, None, :])


def shared_lines(response: FrequencyResponse) -> tuple[float, float]:
    """Lines that share one covariance, and lines that share the data of one estimate."""
    dof, n = float(np.median(response.dof)), response.n_averages
    if response.estimator == "local":
        window = (dof + LOCAL_PARAMETERS) / max(n, 1)
        return max(1.0, window), max(1.0, window / NEIGHBOURS_SHARE)
    return max(1.0, dof / max(n - 1, 1)), 1.0


def goodness(lines: Sequence[Measured], t2: Sequence[Float], n_free: int) -> Fit:
    """The test of a model with `n_free` parameters from T^2 of every line of every response.

    T^2 of lines that share a covariance vary together, so the mean of n lines of p entries
    in n_w groups has the relative variance 1/(p n) + 1/(p nu n_w); its distribution is taken
    for a gamma of that variance.
    """
    size = np.array([d.p * len(d.frequency) for d in lines], dtype=np.float64)
    total = sum(
        d.p * float(np.sum(q / mean_t2(d.dof, d.p))) for d, q in zip(lines, t2, strict=True)
    )
    sharing = np.array([d.shared[1] for d in lines])
    taken = 0.5 * n_free * float(np.sum(size * sharing) / np.sum(size))
    ratio = total / max(float(np.sum(size)) - taken, 1.0)
    spread = 0.0
    for d, n in zip(lines, size, strict=True):
        groups = max(1.0, len(d.frequency) / d.shared[0])
        alone = 1 / max(1.0, len(d.frequency) / d.shared[1])
        spread += n**2 * (alone + 1 / (float(np.mean(d.dof)) * groups)) / d.p
    spread /= float(np.sum(size)) ** 2
    p_value = float(special.gammaincc(1 / spread, ratio / spread))
    return Fit(ratio, p_value, round(2 * float(np.sum(size))))
