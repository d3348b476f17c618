"""What changes from run to run: a joint that is not the same in every series of runs.

No one stiffness fits what was measured apart in time where a joint warms up or wears. Each joint in
turn is given a stiffness of its own in every series of runs (an excitation at one level), all else
in common; the one that explains most of what is left is the place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from samii_rig.diagnose.data.measured import Measured, binned
from samii_rig.diagnose.fit.intervals import TAIL
from samii_rig.diagnose.fit.ranking import moved
from samii_rig.diagnose.fit.refit import Fitted, Problem
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.fit.stated import IN_DATA
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Value
from samii_rig.errors import SamiiRigError
from samii_rig.rig.schema import Parameter, parameters
from samii_rig.types import Float

VARIATION = "stiffness_variation"  # its name in the table
STIFFNESS = "k"  # symbol of the parameters that may change
WIDTH = 0.5  # of the logarithm of a stiffness, before the data, from one series to the next
LARGEST_CHANGE = 3.0  # of that logarithm
KNOWN_STIFFNESS = 1e-4  # relative, of a stiffness for which the rig file has no tolerance
SERIES_BINS = 100  # of each series
ROUNDS = 4  # of Gauss and Newton
MOSTLY = 0.5  # of what one stiffness for all leaves over the noise, that must be explained


@dataclass(frozen=True, slots=True)
class Changing:
    """A joint that is not the same in all series of runs.

    sites : (site, probability), the likeliest first. series : (amplitude, its unit, whether it is
        periodic) of each. change : (m,) relative, of the stiffness at the first site from its
        mean over the series; sd : (m,).
    """

    sites: tuple[tuple[str, float], ...]
    series: tuple[tuple[float, str, bool], ...]
    change: Float
    sd: Float

    @property
    def parameters(self) -> dict[str, Value]:
        """By symbol, with its interval."""
        free = self.change.size - 1
        return {"spread": spread_of(float(np.sum(self.change**2)) / free, free)}

    def describe(self) -> str:
        """In words."""
        each = ", ".join(
            f"{100 * d:+.2g} % (+/- {100 * s:.1g}) in "
            f"{'periodic runs' if periodic else 'bursts'} of {value:.3g} {unit}"
            for (value, unit, periodic), d, s in zip(self.series, self.change, self.sd, strict=True)
        )
        return (
            f"{self.sites[0][0]} changes from run to run; its stiffness, against its mean: {each}"
        )


def between_runs(search: Search, base: Fitted, decide: Measured) -> Changing | None:
    """The joint whose stiffness changes between the series of runs that were fitted and those that
    `decide`; None where that is not most of what `base` leaves."""
    base = _every_joint(search, base)
    series = _series(search, base, decide)
    joints = [i for i, (_, symbol) in enumerate(base.model.keys) if symbol == STIFFNESS]
    if len(series) < 2 or not joints:
        return None
    none = _fitted(base, [p for _, p in series], None)
    ends = [_fitted(base, [p for _, p in series], i) for i in joints]
    if none is None or not (known := [(e, i) for e, i in zip(ends, joints, strict=True) if e]):
        return None
    expected = sum(p.expected for _, p in series)
    cost = np.array([e[0] for e, _ in known])
    gain = none[0] - float(np.min(cost))
    if gain < max(IN_DATA, MOSTLY * (none[0] - expected)):
        return None
    # What even the best leaves makes the others less unlikely.
    weight = -0.5 * cost / max(1.0, float(np.min(cost)) / expected)
    p = np.exp(weight - np.max(weight))
    order = np.argsort(cost)
    names = [base.model.keys[known[k][1]][0] for k in order]
    (_, change, cov), _ = known[int(order[0])]
    centred = np.eye(change.size) - 1 / change.size  # the mean is the rig file's own parameter
    explained = gain / max(none[0] - expected, gain)
    return Changing(
        sites=tuple(zip(names, (explained * p / p.sum())[order].tolist(), strict=True)),
        series=tuple((*search.lines.levels[k], search.lines.periodic[k]) for k, _ in series),
        change=np.expm1(centred @ change),
        sd=np.sqrt(np.diag(centred @ cov @ centred)),
    )


def spread_of(square: float, free: int) -> Value:
    """Standard deviation of stiffnesses that are normal, with its 90 % interval. square : their
    mean square, of so many degrees of freedom."""
    low, high = (math.sqrt(square * free / stats.chi2.ppf(q, free)) for q in (1 - TAIL, TAIL))
    return Value(math.sqrt(square), "1", low, high)


def _every_joint(search: Search, base: Fitted) -> Fitted:
    """The same with every stiffness among the model's parameters, also one without a tolerance: it
    is known, but need not stay."""

    def freed(p: Parameter) -> Parameter:
        known = p.tolerance > 0 or p.value == 0
        return p if known else p.model_copy(update={"tolerance": KNOWN_STIFFNESS})

    elements = tuple(
        e.model_copy(update={STIFFNESS: freed(parameters(e)[STIFFNESS])})
        if STIFFNESS in parameters(e)
        else e
        for e in search.rig.element
    )
    model = Model(search.rig.model_copy(update={"element": elements}), base.model.effects)
    return replace(base, model=model, x=moved(base.model, base.x, model))


def _series(search: Search, base: Fitted, decide: Measured) -> list[tuple[int, Problem]]:
    """Index of its level, and lines, of each series of runs that keeps its level to itself."""
    out = []
    for lines in (search.lines, decide):
        for level in np.unique(lines.level[lines.level >= 0]):
            some = lines.take(lines.level == level)
            shape = base.model.response(base.x, search.grid.at(some.frequency, some.level))
            out.append((int(level), Problem.of(binned(some, shape, SERIES_BINS), search.grid)))
    return out


def _fitted(
    base: Fitted, series: list[Problem], joint: int | None
) -> tuple[float, Float, Float] | None:
    """Chi-square with priors, changes (m,) of a stiffness's logarithm in each series and their
    covariance, all else in common; the same for all with `joint` None."""
    model, n, m = base.model, base.model.n, len(series) if joint is not None else 0
    sd = np.concatenate([model.prior, np.full(m, WIDTH)])
    known = np.isfinite(sd)
    precision = np.where(known, 1 / np.where(known, sd, 1.0) ** 2, 0.0)
    y = np.concatenate([base.x, np.zeros(m)])
    best: tuple[float, Float, Float] | None = None
    for _ in range(ROUNDS):
        A, g = np.diag(precision), precision * y
        cost = float(precision @ y**2)
        for k, problem in enumerate(series):
            x = y[:n].copy()
            if joint is not None:
                x[joint] += y[n + k]
            try:
                h, dh = model.gradient(x, problem.at)
            except SamiiRigError:
                return best
            J, r = problem.whiten(dh), problem.residual(h)
            own = np.zeros((J.shape[0], m))
            if joint is not None:
                own[:, k] = J[:, joint]
            J = np.concatenate([J, own], axis=1)
            cost, A, g = cost + float(r @ r), A + J.T @ J, g + J.T @ r
        cov = np.linalg.pinv(A, hermitian=True)
        if best is not None and cost >= best[0]:
            return best
        best = cost, y[n:].copy(), cov[n:, n:]
        y = y - np.clip(cov @ g, -LARGEST_CHANGE, LARGEST_CHANGE)
    return best
