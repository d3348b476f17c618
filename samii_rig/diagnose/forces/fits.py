"""The complete likelihood of whole records, for explanations with a force and without.

Linear explanations and those with a force stand on the very same lines with the same weights, about
the best of them. A force is computed in time under the recorded commands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from typing import Self

import numpy as np

from samii_rig.diagnose.fit.explanations import (
    NEAR_BEST,
    Explanation,
    Explanations,
    named,
    threshold,
)
from samii_rig.diagnose.fit.record_search import MOST_MADE, RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import STEPS, Fitted, penalty_of
from samii_rig.diagnose.forces.model import ForceModel, model_of
from samii_rig.diagnose.forces.paths import TransferPaths
from samii_rig.diagnose.forces.problem import ForceProblem, Moved
from samii_rig.diagnose.forces.table import forces
from samii_rig.diagnose.forces.way import Ways
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import SamiiRigError
from samii_rig.levenberg import TRIALS, minimise
from samii_rig.likelihood.reduce import LineResiduals
from samii_rig.likelihood.unexplained import Unexplained, unexplained
from samii_rig.types import Complex, Float

# Of a logarithm, for a slope by a difference. All of a rig may scale alike, and priors of 1 % alone
# hold that: the bend in a slope, squared, has to be small beside them. Rounding is below 1e-4.
SLOPE_STEP = 1e-6
EXACT_ENDS = 1e-5  # relative, at which a refit with such slopes ends: 0.1 of a chi-square of 10,000
NOWHERE = 1e6  # noise units of every line, more than any rig is off by
FEW = 6  # steps of a refit of a force: what may win is refitted again, from where it ended
# Samples under which forces are computed, those of slopes too: 15 s of a core. The most promising
# come first.
MOST_MARCHED = 20_000_000
RIVALS = 4  # linear explanations that forces are held against


class ForceFits(RecordSearch):
    """Explanations with and without a force, on the complete likelihood, every level by itself.

    own_power : as of `Complete.about`. handed : keys of explanations of an earlier search; None
        where there was none.
    """

    own_power: Float | None = None

    def __init__(self, linear: RecordSearch, known: Sequence[Explanation] | None = None) -> None:
        assert isinstance(linear.whole, Whole)  # of one state
        self.levels = whole = linear.whole.by_level().with_harmonics()
        self._ways = Ways(acting=tuple(whole.acting.tolist()))
        self.linear = linear
        self.handed = None if known is None else {e.key for e in known}
        moved = of_data(linear).fitted
        self.paths = TransferPaths(whole, moved.model, moved.x)
        self.forces = tuple(forces(whole.rig, self.paths))
        super().__init__(whole, linear.by_line)
        self.use((*linear.table, *self.forces))
        self._again(known or ())

    def __post_init__(self) -> None:
        self.stage = self.linear.stage
        self.use(self.table)
        ranked = self.linear.ranked()
        self._about(ranked[0].fitted)
        kept = [e for e in ranked[:RIVALS] if e.weight > ranked[0].weight - NEAR_BEST]
        # Beside what is wrong with the data a force is held against what the rig lacks otherwise.
        self._only((self.linear.nominal, of_data(self.linear), *kept))
        self._where_nothing_was_fitted(ranked[0])

    def _where_nothing_was_fitted(self, best: Explanation) -> None:
        """The likelihood anew about what explained the excited lines best, as long as that moves
        by much on the others: a mode above them stands anywhere in its tolerances at first."""
        for _ in range(MOST_MADE):
            if best.key not in self.found:  # its refit has left what any rig allows
                return
            fitted = self.found[best.key].fitted
            there = fitted.model.response(fitted.x, self.problem.at)[: len(self.reduced.reference)]
            if self._bends(fitted, there) <= self._most_off(fitted):
                return
            self._about(fitted)
            self._only(tuple(self.found.values()))

    def _only(self, some: Sequence[Explanation]) -> None:
        """Refit some explanations, and forget all others."""
        self.found = {}
        self._again(list({e.key: e for e in some}.values()))

    def _again(self, some: Sequence[Explanation]) -> None:
        """Refit some explanations, each from where it ended."""
        for e in self.each(some, lambda e: named(e.effects)):
            end = self.refitted(e.effects, e, far=False)
            self.keep(e.effects, end)

    def _about(self, fitted: Fitted) -> None:
        self._ways.clear()
        by_line = self.by_line.problem
        self.problem = ForceProblem.near(self.levels, fitted, by_line, self._ways, self.own_power)
        between = self.levels.between(self.reduced, fitted)
        self._between = between, fitted.model.response(fitted.x, between)

    def deviance(self, fitted: Fitted) -> float:
        """As of `RecordSearch`, of all lines."""
        return fitted.cost + self.reduced.log_determinant

    def on(self, levels: Whole, fitted: Fitted) -> Self:
        """The same on other records of these inputs, the likelihood about a fit of them."""
        other = copy(self)
        other.levels = other.whole = levels
        other.found = {}
        other._about(fitted)
        return other

    def made(self, effects: tuple[Effect, ...]) -> Model:
        """As of `Explanations`; of a force and linear effects beside it, or of those alone."""
        return model_of(self.rig, effects)

    def refitted_from(
        self,
        effects: tuple[Effect, ...],
        start: Float,
        give_up: float = math.inf,
        steps: int = STEPS,
        *,
        far: bool = True,
    ) -> Fitted | None:
        """As of `Explanations`; a force is computed in time at every step, and its slopes too."""
        if not isinstance(self.model(effects), ForceModel):
            return super().refitted_from(effects, start, give_up, steps, far=far)
        # Every refit of a force is done anew with the likelihood: it goes on from where it ended.
        return super().refitted_from(effects, start, give_up, min(steps, FEW), far=False)

    def refitted_exactly(self, model: Model, start: Float) -> Fitted | None:
        """As `refitted_from`, the chain through which the force acts that of every step, and every
        slope by a difference, as long as the search is not exhausted; None where the rig has no
        partial fractions or is not stable."""
        problem, prior = self._force_problem, model.prior[: model.n_nominal]
        pulls = np.eye(model.n_nominal, model.n) / prior[:, None]
        strengths = list(model.unknowns) if isinstance(model, ForceModel) else []
        # Of x, what the chain through which the force acts was computed for.
        there: Float | None = None

        def response(x: Float) -> Complex:
            nonlocal there
            chain = np.delete(x, strengths)
            if there is None or not np.array_equal(chain, there):
                self._ways.clear()
                there = chain
            return model.response(x, problem.at)

        def slope(x: Float, e: Float, h: Complex) -> Complex:
            try:
                change = response(x + e) - h
            except SamiiRigError:  # no rig is there: the other side
                change = h - response(x - e)
            return np.asarray(change / e.sum())

        def evaluated(x: Float) -> tuple[Float, Callable[[], Float]]:
            # Away from the bound that it stands at, if it does.
            steps = np.where(x + SLOPE_STEP > model.upper, -SLOPE_STEP, SLOPE_STEP)
            try:
                h = response(x)
            except SamiiRigError:  # a step to where no rig is: refused
                rows = problem.goal.size + prior.size
                return np.full(rows, NOWHERE), lambda: np.zeros((rows, x.size))

            def slopes() -> Float:
                # The strengths, which are last, first: the chain is still that of x.
                dh = [slope(x, e, h) for e in np.diag(steps)[::-1]]
                return np.concatenate([problem.whiten(np.stack(dh[::-1], axis=2)), pulls])

            return np.concatenate([problem.residual(h), pulls @ x]), slopes

        samples = self.levels.every * sum(len(p.r) for p in self.levels.records.pieces)
        trials = max((MOST_MARCHED - self._ways.marched) // ((1 + model.n) * samples), 1)
        try:
            end = minimise(
                evaluated, start, model.lower, model.upper,
                tolerance=EXACT_ENDS, trials=min(trials, TRIALS),
            )  # fmt: skip
        except (SamiiRigError, np.linalg.LinAlgError):  # no rig at the start, or on either side
            return None
        if 2 * end.cost >= NOWHERE**2:
            return None
        penalty = penalty_of(model, end.x)
        J = end.jacobian[: len(end.jacobian) - model.n_nominal]
        return Fitted(model, end.x, 2 * end.cost - penalty, penalty, J, J.T @ J)

    @property
    def won(self) -> bool:
        """Whether the best explanation has a force."""
        return isinstance(self.ranked()[0].fitted.model, ForceModel)

    @property
    def exhausted(self) -> bool:
        """Whether as many forces were computed as a person waits for."""
        return self._ways.marched > MOST_MARCHED

    def is_enough(self) -> bool:
        """Whether the best explanation leaves no more than noise."""
        return self.ratio(self.ranked()[0].fitted) < threshold(self.spread)

    def residuals(self, fitted: Fitted, *, shown: bool = False) -> LineResiduals:
        """As of `RecordSearch`."""
        return self._rest(fitted).residuals(fitted, self.reduced, shown=shown)

    def unexplained(self, fitted: Fitted, *, rounded: bool = False) -> list[Unexplained]:
        """What a fit leaves of each piece. rounded : as of `unexplained`."""
        rest, loops = self._rest(fitted), self.levels.wired.loops
        return unexplained(
            rest.records, rest.response(fitted), self.reduced, loops, rounded=rounded
        )

    def _rest(self, fitted: Fitted) -> Whole:
        """The records as those of the linear part of a fit."""
        if not isinstance(fitted.model, ForceModel):
            return self.levels
        return Moved(self.levels, self._ways).without(fitted)

    def linear_part(self, best: Explanation) -> tuple[Explanations, Explanation]:
        """As of `Explanations`: the records without the force of `best`, about which the likelihood
        stands."""
        linear = tuple(e for e in best.effects if e.force is None)
        model = Model(self.rig, linear)
        plain = copy(self)
        plain.problem = self._force_problem.without_force()
        old = best.fitted
        gone = list(old.model.unknowns) if isinstance(old.model, ForceModel) else []
        x = np.delete(old.x, gone)
        h, dh = model.gradient(x, plain.problem.at)
        J, r = plain.problem.whiten(dh), plain.problem.residual(h)
        fitted = Fitted(model, x, float(r @ r), old.penalty, J, J.T @ J)
        return plain, Explanation(linear, fitted, 0.0)

    @property
    def _force_problem(self) -> ForceProblem:
        assert isinstance(self.problem, ForceProblem)
        return self.problem


def of_data(search: Explanations) -> Explanation:
    """What is wrong with the data by the most probable explanation, without what is missing of the
    rig: the nominal model where that is nothing."""
    return search.meant(search.ranked()[0].effects) or search.nominal
