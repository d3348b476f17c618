"""Forces that depend on amplitude as further hypotheses of whole records.

What each force may explain is bounded to first order; the few that may matter are computed in time
under the recorded commands. A force is held against what is left beside one linear effect too, and
linear effects against what a force leaves. One rule decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from typing import TypeVar

import numpy as np

from samii_rig.diagnose.fit.explanations import NEAR_BEST, Explanation, named, threshold
from samii_rig.diagnose.fit.own_noise import MORE_NOISE, estimated, own_power, stated
from samii_rig.diagnose.fit.ranking import moved
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.forces.beside import FORMED_AGAIN, REFERENCE_STILL, BesideForce
from samii_rig.diagnose.forces.fits import of_data
from samii_rig.diagnose.forces.laws import SLACK
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.screen import ForceScreen, Score, first_order, scaled
from samii_rig.diagnose.forces.way import Ways
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.errors import SamiiRigError
from samii_rig.likelihood.unexplained import Unexplained, as_rounding, evenly
from samii_rig.types import Float

CLOSER = 2  # times that the best strength is looked at closer
TIMES = (0.05, 20.0)  # of a strength, one such step
TRIED = 4  # physics of which a force is refitted
# Of what an effect must explain, that a force explains to first order to be computed in time:
# strong ones were seen to gain 3 times as much once refitted, weak ones gain what it says.
STRONG, WEAK = 0.3, 0.45
MARCHED = 12  # forces that are computed in time
LESS = 0.08  # of the largest bound, below which a force is not
PROMISING = 0.25  # of what the best force gains, at least
# Of what passes for noise, that a force leaves before the chain moves with it: three true ones left
# between 0.02 and 0.8, the best of others 0.997.
NOT_NOISE = 0.9
# The same, that it explains before it is refitted, at least: true ones did a sixth and more.
PROMISED = 0.05
# Of a sensor's noise, that repeats scatter by, from which no force passes for it: noise does by 0.9
# to 1.1 of it, play that passes for 6 times the power of a sensor's own by 0.16, for 90 by 0.01.
REPEATED = 0.5
COMPETE = 8  # explanations that compete again about such a force
MIMICS = 3  # physics of which such a force is refitted: a stop that gives bends like a cubic spring
INCONSISTENT = 1e-4  # chance of a true force to explain lines as unevenly, below which it is none
# The same of a linear effect, whose refit may end elsewhere: of 14 right ones the least even had
# 1e-5, the oscillator that took a few lines of a clipped command 3e-29.
LINEAR_INCONSISTENT = 1e-10

One = TypeVar("One")


class ForceSearch(BesideForce):
    """As `RecordSearch`, with forces.

    most_explained : of chi-square, the most that any force did, consistent or not. uneven : of the
        forces that were forgotten as inconsistent the one that did most, and its part of that.
    """

    most_explained = 0.0
    uneven: tuple[Effect, float] | None = None

    def settle(self) -> None:
        """Refit what promises most, and all that may compete again about the best of it, until
        that stands still."""
        base = of_data(self)
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
        self._beyond_noise(promising=bool(scores))
        best = self.ranked()[0]
        if (does := self._does(best)) is not None and does[1] < INCONSISTENT:
            self._presliding(best)
        self.take_overdispersion()
        if not self._to_rest():
            return
        self._either_way(self.ranked()[0])
        self.pair()
        self._alone()
        best = self.ranked()[0]
        self._rivals()
        if self.ranked()[0].key != best.key:
            self._alone()
        self._forget_inconsistent()
        self.take_overdispersion()

    def _beyond_noise(self, *, promising: bool) -> None:
        """Where the records have more noise than their sensors, look for a force that passes for
        it, and stand about it where these are more likely with the noise that it leaves.

        promising : whether any force promises something in the noise as it is estimated: each true
        one that passed for noise did. An earlier search has looked beside the very same nominal
        model.
        """
        before, handed = self.ranked(), self.handed or ()
        known = next((e for e in before if e.key in handed and _alone(e)), None)
        if known is None and (self.handed is not None or not promising):
            return
        whole = self.linear.whole
        assert isinstance(whole, Whole)  # of one state
        more = estimated(self.linear, whole) > MORE_NOISE * stated(whole)
        if not more.any():
            return
        again = self.levels.scatter(of_data(self).fitted, self.reduced)
        if np.all(again[more] > REPEATED):  # hardly any force differs between repeats
            return
        best = known or self._in_sensors_noise(own_power(self.linear, whole))
        if best is None:
            return
        anew = self.on(self.levels, best.fitted)
        end = anew.refitted(best.effects, best, far=False)
        if end is None or anew.deviance(end) > self.deviance(before[0].fitted):
            self._ways.clear()
            return
        self.problem, self._between = anew.problem, anew._between
        best = Explanation(best.effects, end, 0.0)
        self._only((self.nominal, of_data(self), *before[:COMPETE], best))
        self.most_explained = max(self.most_explained, self.nominal.fitted.chi2 - end.chi2)

    def _in_sensors_noise(self, own_power: Float) -> Explanation | None:
        """The force that explains most where the noise is the sensors' own, as many times as large
        as what is left, None where none explains what passes for noise. own_power : (q,)."""
        trial = copy(self)
        trial._ways = Ways(acting=self._ways.acting)
        trial.found = {}
        base = of_data(self)
        try:
            left = trial._as_large(own_power, base)
            trial._only((self.nominal, base, *_first_of_each(self.ranked())))
            base = trial.found[base.key]
            least = PROMISED * base.fitted.cost
            some = [h for h in trial.scores([base]) if h.own[0] > least]
            trial._try(some, base, 0, all_to_the_end=True)
            for many in (MIMICS, 1, 1):
                each = _first_of_each(trial.ranked())[:many]
                best = [e for e in each if e.fitted.cost < NOT_NOISE * base.fitted.cost]
                if not best or trial.exhausted:
                    break
                for e in best:
                    trial._exactly(e)
                first, before = trial.ranked()[0], left
                left = trial._as_large(own_power, first)
                trial._only((trial.nominal, base, first))
                base = trial.found[base.key]
                if np.sum(np.log(before / left)) < math.log(2):  # hardly less
                    break
        except (SamiiRigError, np.linalg.LinAlgError, KeyError):
            return None  # in that noise no rig is near what was recorded
        first = trial.ranked()[0]
        return first if first.fitted.cost < NOT_NOISE * base.fitted.cost else None

    def _as_large(self, own_power: Float, best: Explanation) -> Float:
        """Take noise of the sensors alone that is as large as what an explanation leaves; (q,) how
        many times it has the power of their own."""
        self.own_power = own_power
        self._about(best.fitted)
        complete = self._force_problem.complete
        white = complete.white(complete.rows.e)
        left = np.maximum(np.mean(np.abs(white) ** 2, axis=0) / 2, 1.0)
        self.own_power = own_power * left
        self._about(best.fitted)
        return np.asarray(left)

    def _to_rest(self) -> bool:
        """Make the likelihood anew about the best explanation until that stands still; whether it
        has a force."""
        for _ in range(FORMED_AGAIN):
            best = self.ranked()[0]
            if not isinstance(best.fitted.model, ForceModel):
                return False
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
        return True

    def _forget_inconsistent(self) -> None:
        """Without explanations whose force does not explain at all lines what it says that it does:
        what is left of an input's edges, say, is like dry friction at some and not at others."""
        while isinstance((best := self.ranked()[0]).fitted.model, ForceModel):
            if (does := self._does(best)) is None:
                return
            fall, even = does
            if even > INCONSISTENT and fall > self.critical_value:
                return
            if self._presliding(best):
                self._to_rest()
                self._alone()
                continue
            del self.found[best.key]
            if fall > max(self.critical_value, self.uneven[1] if self.uneven else 0.0):
                self.uneven = next(e for e in best.effects if e.force is not None), fall

    def _does(self, best: Explanation) -> tuple[float, float] | None:
        """As of `_explained`, of the force of an explanation; None where it has none, where the
        rest cannot be refitted, or where it is right anyway."""
        if not isinstance(model := best.fitted.model, ForceModel):
            return None
        linear = tuple(e for e in best.effects if e.force is None)
        base = self.refitted_from(linear, np.delete(best.fitted.x, list(model.unknowns)))
        if base is None or self._to_noise(base, best.fitted):
            return None
        return self._explained(base, best.fitted)

    def _to_noise(self, before: Fitted, after: Fitted) -> bool:
        """Whether a force may be off for its motion, as it began in a gap, and leaves no more than
        noise where another fit leaves more."""
        moving = any(piece.moving for piece in self.levels.records.pieces)
        return moving and self.ratio(after) < threshold(self.spread) < self.ratio(before)

    def _explained(self, before: Fitted, after: Fitted) -> tuple[float, float]:
        """Of chi-square, what one fit has more than another, in units of what rounding may do along
        it; and the chance that it shows at all lines as unevenly."""
        a, b = self.unexplained(before, rounded=True), self.unexplained(after)
        return (before.chi2 - after.chi2) / as_rounding(a, b), self._even(a, b, after)

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

    def _try(
        self, scores: Sequence[Score], base: Explanation, at: int, *, all_to_the_end: bool = False
    ) -> None:
        """Refit the forces that may be the best beside `base`, by its gains there; all of them to
        the end, or as long as each may become the best."""
        some = _promising(scores, self.critical_value, at)
        for score in self.each(some, lambda h: named([h.effect])):
            if self.exhausted:
                return
            effects = (*base.effects, score.effect)
            best = min(e.fitted.cost for e in self.found.values())
            worst = math.inf if all_to_the_end else best
            end = self.refitted(effects, base, np.log(score.strengths).tolist(), worst)
            if end is None:
                continue
            fall = base.fitted.chi2 - end.chi2
            self.most_explained = max(self.most_explained, fall)
            if fall > (self.critical_value if base.effects else 0):
                self.keep(effects, end)

    def scores(self, bases: Sequence[Explanation]) -> list[Score]:
        """Every force that may explain as much as an effect must beside the first of some
        explanations, or beside the last, with what it gains beside each."""
        screen = ForceScreen.of(self._force_problem, [e.fitted for e in bases])
        scores = first_order(self.forces, self.paths, screen)
        # Beside the first it must do as much as what the last has more did.
        ahead = bases[0].fitted.cost - min(e.fitted.cost for e in bases)
        some = _first(self._matter(scores, ahead), MARCHED)
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
                lines = self._force_problem.added(model, np.append(known, np.log(there)))
            except SamiiRigError:  # no rig is stable with so much of it
                times = math.sqrt(times)
                continue
            strengths = there
            ((own, may, each),) = screen.gains([lines])
            at = int(np.argmax(own))
            times = float(each[at])
            if best is None or own[at] > np.max(best.own):
                best = Score(effect, strengths, own, may, times, weak=False)
        return best


def compete_on_records(
    linear: RecordSearch, known: Sequence[Explanation] | None = None
) -> ForceSearch:
    """Let forces compete with what the linear search of whole records found. known : explanations
    with a force, of an earlier search; None where there was none.

    Raises SamiiRigError where no force can be computed on this rig.
    """
    search = ForceSearch(linear, known)
    search.settle()
    return search


def _alone(e: Explanation) -> bool:
    """Whether a force is all that is missing of the rig."""
    real = [x for x in e.effects if x.physical]
    return len(real) == 1 and real[0].force is not None


def _first_of_each(ranked: Sequence[Explanation]) -> list[Explanation]:
    """Of forces that stand alone the best of each physics."""
    return _firsts(filter(_alone, ranked), lambda e: next(x for x in e.effects if x.physical))


def _firsts(ranked: Iterable[One], effect: Callable[[One], Effect]) -> list[One]:
    """Of each physics the first."""
    best: dict[str, One] = {}
    for one in ranked:
        best.setdefault(effect(one).physics, one)
    return list(best.values())


def _first(scores: Sequence[Score], most: int) -> list[Score]:
    """The first so many, and play in which nothing acts: to first order it looks like play."""
    slack = [h for h in scores if h.effect.force is not None and h.effect.force.law is SLACK]
    others = [h for h in scores if h not in slack][:most]
    names = {h.effect.name for h in others}
    return [h for h in scores if h in others or (h in slack and h.effect.name in names)]


def _promising(scores: Sequence[Score], critical_value: float, at: int) -> list[Score]:
    """Those that may be the best: of each physics the first, and the first's at other places."""
    if not scores:
        return []
    ranked = sorted(scores, key=lambda h: -float(h.own[at]))
    some = [h for h in ranked if h.own[at] > max(critical_value / 2, PROMISING * ranked[0].own[at])]
    if not some:
        return []
    first = _firsts(some, lambda h: h.effect)
    # Torques and angles of neighbouring joints go nearly together.
    elsewhere = [h for h in some[1:] if h.effect.physics == some[0].effect.physics]
    return list({h.effect.key: h for h in (*first[:TRIED], *elsewhere[:TRIED])}.values())
