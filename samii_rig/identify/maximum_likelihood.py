"""Maximum likelihood identification of a rig's parameters from frequency responses.

    found = identify(responses, load_rig("samii")[0], ["joint_1.k", "joint_2.k"])
    found.values, found.interval(), found.sentences()

All channels of all responses at once, in noise units, with the full covariance of every line
(`data` says how its few degrees of freedom are taken into account).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.identify.data import Data, collect
from samii_rig.identify.identifiability import identifiability
from samii_rig.identify.likelihood import (
    FAR,
    chi_square,
    log_misfit,
    minimise,
    noise_misfit,
)
from samii_rig.identify.parameters import Free, Space, changed, space
from samii_rig.identify.predict import Predictor
from samii_rig.identify.result import Identification, bounds_met, residuals_of
from samii_rig.levenberg import Minimum
from samii_rig.progress import Progress, counted
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.pose import Angle
from samii_rig.signal.whitening import Fit, goodness
from samii_rig.types import Float, FrequencyResponse

STARTS = 8
SPREAD = 0.3  # half width of the starts around the first, relative
COARSE = 1e-3  # relative change of the cost at which the first stage hands over
# Half of chi-square: two ends that differ by less are one optimum, by a hundredth of a sigma.
SAME_OPTIMUM = 1e-4
ROUNDS = 4  # of aliases taken anew; two are usual


@dataclass(frozen=True, slots=True)
class Problem:
    """Data, free parameters and model of one identification."""

    rig: Rig
    data: Data
    space: Space
    predictor: Predictor

    def from_start(self, x: Float) -> Minimum:
        """The optimum that x leads to: first on the logarithm, then in noise units."""
        to = (self.data, self.space, self.predictor)
        near = minimise(log_misfit, *to, x, tolerance=COARSE, damping=FAR)
        return minimise(noise_misfit, *to, near.x)

    def polished(self, found: Minimum) -> Minimum:
        """The optimum with the aliases of the optimum."""
        for _ in range(ROUNDS):
            self.predictor.update_aliases(found.x)
            before = found.x
            found = minimise(noise_misfit, self.data, self.space, self.predictor, before)
            scale = np.linalg.norm(found.jacobian @ (found.x - before))
            if scale**2 < SAME_OPTIMUM:
                break
        return found

    def changed(self, x: Float) -> Rig:
        """The rig at x."""
        return changed(self.rig, self.space.mapping(x))

    def fit(self, x: Float, n_free: int) -> Fit:
        """The test of the model at x."""
        return goodness(self.data.lines, chi_square(self.data, self.predictor, x), n_free)


def problem(
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    free: Sequence[str | Free],
    *,
    prior: bool = False,
    band: tuple[float, float] | None = None,
    outputs: Sequence[str] | None = None,
    poses: Sequence[Angle | None] = (),
) -> Problem:
    """What `identify` solves; the arguments and errors are the same."""
    if poses and len(poses) != len(responses):
        have = f"{len(poses)} poses of {len(responses)} responses"
        raise InputError("identify", "poses", have, "one for each response")
    chosen = space(rig, free, prior)
    data = collect(responses, rig, band, outputs)
    needed = sum(1 for sd in chosen.prior_sd if not np.isfinite(sd))
    if data.independent() < needed:
        have = f"{data.independent():.0f} real numbers for {needed} parameters without a prior"
        expected = "more lines, more outputs, fewer free parameters or their priors"
        raise InputError("identify", "data", have, expected)
    return Problem(rig, data, chosen, Predictor(rig, data, chosen, poses))


def identify(
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    free: Sequence[str | Free],
    *,
    prior: bool = False,
    band: tuple[float, float] | None = None,
    outputs: Sequence[str] | None = None,
    starts: int = STARTS,
    poses: Sequence[Angle | None] = (),
) -> Identification:
    """Maximum likelihood, or maximum posterior, estimate of `free` from `responses`.

    Parameters
    ----------
    responses : one or several levels or experiments on this rig, one sample rate.
    free : names `element.symbol`, or `Free` for bounds and a start of one's own.
    prior : use the rig file's tolerances as Gaussian priors on the logarithms.
    band : Hz. outputs : the channels to use, default all that were measured.
    poses : of the rig in each response, if they differ: one set of parameters for all.
    starts : of the search, as in `solve`.

    Raises
    ------
    InputError : unknown or doubled parameters, a start of zero, channels that the rig does
        not have, a band without lines, fewer data than parameters.
    EstimateError : covariances of too few degrees of freedom, or singular.
    """
    posed = problem(responses, rig, free, prior=prior, band=band, outputs=outputs, poses=poses)
    return solve(posed, starts=starts)


def solve(
    posed: Problem,
    *,
    starts: int = STARTS,
    spread: float = SPREAD,
    seed: int = 1,
    progress: Progress = lambda _stage: None,
) -> Identification:
    """`identify` for a problem that is already set up.

    starts : the first is the rig file's values, the others are drawn within `spread` of them
        (relative) by the generator of `seed`. progress : is called with how many are done.

    InputError for no start, or a spread outside 0 to 1.
    """
    if starts < 1:
        raise InputError("identify", "starts", starts, "1 or more")
    if not 0 <= spread < 1:
        raise InputError("identify", "spread", spread, "0 or more and below 1")
    rng = np.random.default_rng(seed)
    n = posed.space.start.size
    ends = []
    for i in counted(range(starts), progress, "starts"):
        x = np.log1p(rng.uniform(-spread, spread, n)) if i else np.zeros(n)
        ends.append(posed.from_start(np.clip(x, posed.space.lower, posed.space.upper)))
    best = min(ends, key=lambda end: end.cost)
    progress("best of them")
    reached = sum(1 for end in ends if end.cost <= best.cost * (1 + SAME_OPTIMUM) + SAME_OPTIMUM)
    return _result(posed, posed.polished(best), starts, reached)


def _result(posed: Problem, found: Minimum, starts: int, reached: int) -> Identification:
    data, free = posed.data, posed.space
    n = free.start.size
    J = found.jacobian
    s, vt = np.linalg.svd(J, full_matrices=False)[1:]
    # A direction that nothing holds is known at least to lie within the bounds.
    s = np.maximum(s, 1 / np.max(free.upper - free.lower))
    measured = J[: data.n_real]
    prediction = posed.predictor.response(found.x)
    outputs = [name for d in data.lines for name in d.outputs]
    at_bound, on_top = bounds_met(free, found.x)
    return Identification(
        rig=posed.changed(found.x),
        names=free.names,
        units=free.units,
        start=free.start,
        values=free.values(found.x),
        log_covariance=(vt.T / s**2) @ vt,
        prior_sd=free.prior_sd,
        fit=posed.fit(found.x, n),
        start_fit=posed.fit(np.zeros(n), 0),
        residuals=residuals_of(data, prediction),
        identifiability=identifiability(measured, free.names, outputs),
        at_bound=at_bound,
        starts=starts,
        reached=reached,
        prediction=tuple(prediction),
        on_top=on_top,
    )
