"""Forces that depend on amplitude as further hypotheses of whole records.

What each force may explain is bounded to first order; the few that may matter are computed in time
under the recorded commands. Linear explanations and those with a force then stand on the very same
lines with the same weights, about the best of them, and one rule decides. A force is held against
what is left beside one linear effect too, and linear effects against what a force leaves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy

import numpy as np

from samii_rig.diagnose.fit.explanations import (
    NEAR_BEST,
    Explanation,
    Explanations,
    named,
    threshold,
)
from samii_rig.diagnose.fit.ranking import moved, ranking
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import STEPS, Fitted
from samii_rig.diagnose.fit.screen import Screen
from samii_rig.diagnose.forces.laws import FRICTION
from samii_rig.diagnose.forces.model import ForceModel, model_of
from samii_rig.diagnose.forces.paths import TransferPaths
from samii_rig.diagnose.forces.problem import ForceProblem, Moved
from samii_rig.diagnose.forces.screen import ForceScreen, Score, first_order, scaled
from samii_rig.diagnose.forces.table import forces, uneven
from samii_rig.diagnose.forces.way import Ways
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import SamiiRigError
from samii_rig.likelihood.reduce import LineResiduals
from samii_rig.likelihood.unexplained import Unexplained, as_rounding, evenly, unexplained
from samii_rig.types import Float

CLOSER = 2  # times that the best strength is looked at closer
TIMES = (0.05, 20.0)  # of a strength, one such step
TRIED = 4  # physics of which a force is refitted
FEW = 6  # steps of that: it starts from its best strength, and what may win is refitted again
# Of what an effect must explain, that a force explains to first order to be computed in time:
# strong ones were seen to gain 3 times as much once refitted, weak ones gain what it says.
STRONG, WEAK = 0.3, 0.45
MARCHED = 12  # forces that are computed in time
# Samples under which forces are computed, those of slopes too: 15 s of a core. The most promising
# come first.
MOST_MARCHED = 20_000_000
LESS = 0.08  # of the largest bound, below which a force is not
PROMISING = 0.25  # of what the best force gains, at least
FORMED_AGAIN = 3  # times that the likelihood is made anew about the best explanation
REFERENCE_STILL = 0.5  # standard deviations, a move from one to the next that is none
NO_MOVE = 1e-3  # of a logarithm: a refit of few steps has ended
RENEWED = 6  # times that the chain through which a force acts is renewed in between
RIVALS = 4  # linear explanations that forces are held against
INCONSISTENT = 1e-4  # chance of a true force to explain lines as unevenly, below which it is none
# The same of a linear effect, whose refit may end elsewhere: of 14 right ones the least even had
# 1e-5, the oscillator that took a few lines of a clipped command 3e-29.
LINEAR_INCONSISTENT = 1e-10
BESIDE = 6  # linear effects that are refitted beside the best force, and the other way round


class ForceSearch(RecordSearch):
    """As `RecordSearch`, on the complete likelihood, with every level by itself.

    most_explained : of chi-square, the most that any force did, consistent or not.
    """

    most_explained = 0.0

    def __init__(self, linear: RecordSearch, known: Sequence[Explanation] = ()) -> None:
        assert isinstance(linear.whole, Whole)  # of one state
        self.levels = whole = linear.whole.by_level().with_harmonics()
        self._ways = Ways(acting=tuple(whole.acting.tolist()))
        self.linear = linear
        moved = _of_data(linear).fitted
        self.paths = TransferPaths(whole, moved.model, moved.x)
        self.forces = tuple(forces(whole.rig, self.paths))
        super().__init__(whole, linear.by_line)
        self.use((*linear.table, *self.forces))
        self._again(known)

    def __post_init__(self) -> None:
        self.stage = self.linear.stage
        self.use(self.table)
        ranked = self.linear.ranked()
        self._about(ranked[0].fitted)
        kept = [e for e in ranked[:RIVALS] if e.weight > ranked[0].weight - NEAR_BEST]
        # Beside what is wrong with the data a force is held against what the rig lacks otherwise.
        self._only((self.linear.nominal, _of_data(self.linear), *kept))

    def _only(self, some: Sequence[Explanation]) -> None:
        """Refit some explanations, and forget all others."""
        self.found = {}
        self._again(list({e.key: e for e in some}.values()))

    def _again(self, some: Sequence[Explanation]) -> None:
        """Refit some explanations, each from where it ended."""
        for e in self.each(some, lambda e: named(e.effects)):
            end = self.refitted(e.effects, e, far=False)
            if end is not None:
                self.keep(e.effects, end)

    def _about(self, fitted: Fitted) -> None:
        self._ways.clear()
        self.problem = ForceProblem.near(self.levels, fitted, self.by_line.problem, self._ways)
        between = self.levels.between(self.reduced, fitted)
        self._between = between, fitted.model.response(fitted.x, between)

    def on(self, levels: Whole, fitted: Fitted) -> ForceSearch:
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

    @property
    def won(self) -> bool:
        """Whether the best explanation has a force."""
        return isinstance(self.ranked()[0].fitted.model, ForceModel)

    def settle(self) -> None:
        """Refit what promises most, and all that may compete again about the best of it, until
        that stands still."""
        base = _of_data(self)
        # Without what is wrong with the data itself nothing can be seen of a force beside it.
        faulty = bool(base.effects)
        single = (e for e in self.ranked() if len(e.effects) == 1)
        first = base if faulty else next(single, None)
        ahead = 0.0 if first is None else self.nominal.fitted.cost - first.fitted.cost
        both = [self.nominal] if first is None or faulty else [self.nominal, first]
        scores = self.scores(both)
        self._try([h for h in scores if h.own[0] >= STRONG * ahead], self.nominal, 0)
        if first is not None:
            self._try(self.scores([first]) if faulty else scores, first, -1)
        self.take_overdispersion()
        for _ in range(FORMED_AGAIN):
            best = self.ranked()[0]
            if not isinstance(best.fitted.model, ForceModel):
                return
            self._about(best.fitted)
            near = [e for e in self.ranked() if e.weight > best.weight - NEAR_BEST]
            self._only((*near, self.nominal))
            self._through(self.ranked()[0])
            self.take_overdispersion()
            after = self.ranked()[0]
            if self.exhausted or (
                after.key == best.key and after.fitted.away(best.fitted) < REFERENCE_STILL
            ):
                break
        self._either_way(self.ranked()[0])
        self.pair()
        self._alone()
        best = self.ranked()[0]
        self._rivals()
        if self.ranked()[0].key != best.key:
            self._alone()
        self._forget_inconsistent()
        self.take_overdispersion()

    def _forget_inconsistent(self) -> None:
        """Without explanations whose force does not explain at all lines what it says that it does:
        what is left of an input's edges, say, is like dry friction at some and not at others."""
        while isinstance(model := (best := self.ranked()[0]).fitted.model, ForceModel):
            linear = tuple(e for e in best.effects if e.force is None)
            x = np.delete(best.fitted.x, list(model.unknowns))
            base = self.refitted_from(linear, x)
            if base is None:
                return
            if self._to_noise(base, best.fitted) or self._consistent(base, best.fitted):
                return
            del self.found[best.key]

    def _to_noise(self, before: Fitted, after: Fitted) -> bool:
        """Whether a force may be off for its motion, as it began in a gap, and leaves no more than
        noise where another fit leaves more."""
        moving = any(piece.moving for piece in self.levels.records.pieces)
        return moving and self.ratio(after) < threshold(self.spread) < self.ratio(before)

    def _consistent(self, before: Fitted, after: Fitted) -> bool:
        """Whether what one fit has more than another shows at all lines as it should, and is more
        than rounding may do along it."""
        a, b = self.unexplained(before, rounded=True), self.unexplained(after)
        fall = (before.chi2 - after.chi2) / as_rounding(a, b)
        return self._even(a, b, after) > INCONSISTENT and fall > self.critical_value

    def _even(
        self, before: Sequence[Unexplained], after: Sequence[Unexplained], fitted: Fitted
    ) -> float:
        samples = [len(p.z) for p in self.levels.records.pieces]
        return evenly(before, after, samples, self.ratio(fitted))

    def explains_evenly(self, before: Explanation, after: Explanation) -> bool:
        """Whether what one linear explanation has more than another shows at all lines of these
        records as it should; so where it cannot be refitted to them. Their lines are among these:
        where nothing is left of what it explained there, these are not understood well enough."""
        a = self.refitted(before.effects, before, far=False)
        b = self.refitted(after.effects, after, far=False)
        if a is None or b is None or b.chi2 > a.chi2 - self.critical_value:
            return True
        return self._even(self.unexplained(a), self.unexplained(b), b) > LINEAR_INCONSISTENT

    def _alone(self) -> None:
        """The force of the best explanation without each linear effect beside it, from where both
        ended: refitted by itself before it may have stopped elsewhere, and what stands beside it
        would seem to be needed for that alone."""
        best = self.ranked()[0]
        if not isinstance(best.fitted.model, ForceModel):
            return
        for i, gone in enumerate(best.effects):
            if gone.force is None:
                fewer, old = best.effects[:i] + best.effects[i + 1 :], best.fitted
                x = np.delete(old.x, list(old.model.own(i)))
                if (model := self.model(fewer)) is not None:
                    self._renewed(fewer, moved(old.model, x, model))

    def _rivals(self) -> None:
        """The forces of the best explanation beside what does as well as each linear effect there
        does while these are as they are: which of them fit best without the forces says little."""
        best = self.ranked()[0]
        forces = tuple(e for e in best.effects if e.force is not None)
        if not forces:
            return
        plain, rest = self.linear_part(best)
        for effects, end in self._instead(plain, rest):
            if end is not None and end.cost < rest.fitted.cost + 2 * NEAR_BEST:
                self._beside_force((*effects, *forces), end, best)

    def _instead(
        self, plain: Explanations, rest: Explanation
    ) -> Iterator[tuple[tuple[Effect, ...], Fitted | None]]:
        """Linear effects that may do what those of `rest` do, refitted as `linear_part` has them:
        by a screen where each stands, and what the linear search could not tell from them."""
        for i, gone in enumerate(rest.effects):
            less = plain.without_refit(rest, i)
            if less is None:
                continue
            screen = Screen.of(plain.problem, less.fitted)
            ranked = ranking(screen, self.linear.table, less.effects, plain.model)
            others = [r for r in ranked if r[1].key != gone.key]
            some = [*others[:BESIDE], *(r for r in others[BESIDE:] if r[1].within(gone))]
            for _, effect, starts in self.each(some, lambda r: named([r[1]])):
                effects = (*less.effects, effect)
                yield effects, plain.refitted(effects, less, np.log(starts[0]).tolist())
        for e in self.each(self._alike(rest), lambda e: named(e.effects)):
            yield e.effects, plain.refitted(e.effects, e)

    def _alike(self, rest: Explanation) -> list[Explanation]:
        """What the linear search could not tell from some linear effects: it refitted them from
        where each would be, and not about where the nominal parameters are beside another."""
        same = self.linear.found.get(rest.key)
        if same is None:
            return []
        others = (e for e in self.linear.ranked() if e.key != rest.key)
        as_many = (e for e in others if len(e.effects) == len(rest.effects))
        return [e for e in as_many if abs(e.weight - same.weight) < NEAR_BEST][:BESIDE]

    def _beside_force(self, effects: tuple[Effect, ...], plain: Fitted, best: Explanation) -> None:
        """Refit the forces of `best` beside other linear effects, from where these fit what it
        leaves without them. effects : the linear ones, then the forces."""
        if (model := self.model(effects)) is None:
            return
        linear = moved(plain.model, plain.x, model)
        forces = [i for i, e in enumerate(best.effects) if e.force is not None]
        strengths = [best.fitted.x[k] for i in forces for k in best.fitted.model.own(i)]
        self._renewed(effects, np.concatenate([linear, strengths]))

    def _renewed(self, effects: tuple[Effect, ...], start: Float) -> None:
        """Refit some effects and keep where that ends, the chain through which a force acts renewed
        where each refit ended: through another chain it may seem to leave less."""
        last = None
        for _ in range(FORMED_AGAIN):
            self._ways.clear()
            end = self.refitted_from(effects, start)
            if end is None:
                break
            still = float(np.max(np.abs(end.x - start))) < NO_MOVE
            last, start = end, end.x
            if still:
                break
        if last is not None:
            self.keep(effects, last)

    def _try(self, scores: Sequence[Score], base: Explanation, at: int) -> None:
        """Refit the forces that may be the best beside `base`, by its gains there."""
        some = _promising(scores, self.critical_value, at)
        for score in self.each(some, lambda h: named([h.effect])):
            if self.exhausted:
                return
            effects = (*base.effects, score.effect)
            best = min(e.fitted.cost for e in self.found.values())
            end = self.refitted(effects, base, np.log(score.strengths).tolist(), best)
            if end is None:
                continue
            fall = base.fitted.chi2 - end.chi2
            self.most_explained = max(self.most_explained, fall)
            if fall > (self.critical_value if base.effects else 0):
                self.keep(effects, end)

    def _through(self, best: Explanation) -> None:
        """Refit it with the chain through which its force acts renewed where each refit ended,
        until that stands still."""
        for _ in range(RENEWED):
            if self.exhausted or not isinstance(best.fitted.model, ForceModel):
                return
            self._ways.clear()
            end = self.refitted(best.effects, best)
            if end is None:
                return
            del self.found[best.key]
            self.keep(best.effects, end)
            still, best = best.fitted.away(end) < REFERENCE_STILL, self.found[best.key]
            if still:
                return

    def _either_way(self, best: Explanation) -> None:
        """Dry friction that may differ by direction, from where it did not."""
        forced = next((e for e in best.effects if e.force is not None), None)
        if forced is None or forced.force is None or forced.force.law is not FRICTION:
            return
        other = uneven(forced)
        at = best.effects.index(forced)
        effects = (*best.effects[:at], *best.effects[at + 1 :], other)
        own = best.fitted.model.own(at)
        start = np.append(np.delete(best.fitted.x, list(own)), np.repeat(best.fitted.x[own[0]], 2))
        if other.key not in {e.key for e in self.table}:
            self.use((*self.table, other))
        end = self.refitted_from(effects, start)
        if end is not None and best.fitted.chi2 - end.chi2 > self.critical_value:
            self.keep(effects, end)

    def pair(self) -> None:
        """Linear effects beside the best force; each of both must explain what an effect must."""
        best = self.ranked()[0]
        real = [e for e in best.effects if e.physical]
        single = len(real) == 1 and isinstance(best.fitted.model, ForceModel)
        if not single or self.exhausted:  # one that did not come to rest would lack much beside it
            return
        plain, rest = self.linear_part(best)
        assert isinstance(plain, RecordSearch)
        for drop, effect, starts in ranking(
            Screen.of(plain.problem, rest.fitted), self.linear.table, (), plain.model
        )[:BESIDE]:
            effects = (*best.effects, effect)
            if drop < self.critical_value / 2 or self.model(effects) is None:
                continue
            end = self.refitted(effects, best, np.log(starts[0]).tolist())
            alone = [best, self.found.get(frozenset({effect.key}))]
            if end is not None and all(
                e is None or e.fitted.chi2 - end.chi2 > self.critical_value for e in alone
            ):
                self._renewed(effects, end.x)

    @property
    def exhausted(self) -> bool:
        """Whether as many forces were computed as a person waits for."""
        return self._ways.marched > MOST_MARCHED

    def is_enough(self) -> bool:
        """Whether the best explanation leaves no more than noise."""
        return self.ratio(self.ranked()[0].fitted) < threshold(self.spread)

    def scores(self, bases: Sequence[Explanation]) -> list[Score]:
        """Every force that may explain as much as an effect must beside the first of some
        explanations, or beside the last, with what it gains beside each."""
        screens = tuple(Screen.of(self._force_problem, e.fitted) for e in bases)
        screen = ForceScreen(self._force_problem, screens)
        scores = first_order(self.forces, self.paths, screen)
        # Beside the first it must do as much as what the last has more did.
        ahead = screens[0].base.cost - min(one.base.cost for one in screens)
        some = self._matter(scores, ahead)[:MARCHED]
        each = self.each(some, lambda h: named([h.effect]))
        found = [self._closer(h, screen, bases[0]) for h in each]
        return [
            h
            for h in found
            if h is not None
            and (h.own[0] >= STRONG * ahead or h.own[-1] >= self.critical_value / 2)
        ]

    def _matter(self, scores: Sequence[Score], ahead: float) -> list[Score]:
        """Those that to first order may do enough beside one of the bases. ahead : of chi-square,
        what it has to do as well beside the first."""
        if not scores:
            return []
        may = np.array([h.may for h in scores])
        share = np.array([WEAK if h.weak else STRONG for h in scores])
        least = np.maximum(share[:, None] * self.critical_value, LESS * np.max(may, axis=0))
        least[:, 0] = np.maximum(least[:, 0], STRONG**2 * ahead)
        enough = np.any(may > least, axis=1)
        return [h for h, on in zip(scores, enough, strict=True) if on]

    def _closer(self, score: Score, screen: ForceScreen, base: Explanation) -> Score | None:
        """The same, computed in time where the first order leads, and closer to its best."""
        effect, old = score.effect, base.fitted
        model = self.model((*base.effects, effect))
        assert effect.force is not None
        if not isinstance(model, ForceModel):
            return None
        known = moved(old.model, old.x, model)
        low, high = np.array([(u.low, u.high) for u in effect.unknowns]).T
        strengths, times, best = score.strengths, score.times, None
        if effect.force.law.of_command is not None:
            best = score  # such a force does not depend on what it does: the first order is all
        for _ in range(1 + CLOSER):
            if not times > 0:
                break
            times = min(max(times, TIMES[0]), TIMES[1]) if best else times
            law, largest = effect.force.law, self.paths.largest(effect.force.place)
            there = np.clip(scaled(law, strengths, times, largest), low, high)
            try:
                g = self._force_problem.change(model, np.append(known, np.log(there)))
            except SamiiRigError:  # no rig is stable with so much of it
                times = math.sqrt(times)
                continue
            strengths = there
            own, may, each = screen.gains(g)
            at = int(np.argmax(own))
            times = float(each[at])
            if best is None or own[at] > np.max(best.own):
                best = Score(effect, strengths, own, may, times, weak=False)
        return best

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


def compete_on_records(linear: RecordSearch, known: Sequence[Explanation] = ()) -> ForceSearch:
    """Let forces compete with what the linear search of whole records found. known : explanations
    with a force, of an earlier search.

    Raises SamiiRigError where no force can be computed on this rig.
    """
    search = ForceSearch(linear, known)
    search.settle()
    return search


def _of_data(search: Explanations) -> Explanation:
    """What is wrong with the data by the most probable explanation, without what is missing of the
    rig: the nominal model where that is nothing."""
    return search.meant(search.ranked()[0].effects) or search.nominal


def _promising(scores: Sequence[Score], critical_value: float, at: int) -> list[Score]:
    """Those that may be the best: of each physics the first, and the first's at other places."""
    if not scores:
        return []
    ranked = sorted(scores, key=lambda h: -float(h.own[at]))
    some = [h for h in ranked if h.own[at] > max(critical_value / 2, PROMISING * ranked[0].own[at])]
    if not some:
        return []
    first = list({h.effect.physics: h for h in reversed(some)}.values())[::-1]
    # Torques and angles of neighbouring joints go nearly together.
    elsewhere = [h for h in some[1:] if h.effect.physics == some[0].effect.physics]
    return list({h.effect.key: h for h in (*first[:TRIED], *elsewhere[:TRIED])}.values())
