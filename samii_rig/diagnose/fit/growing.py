"""Effects added to an explanation, and taken away again.

A screen holds each effect, at starts over its whole range, against what the model so far
cannot explain, with the uncertain parameters projected out. The best are refitted jointly with
these parameters. Where the mismatch is large a screen does not rank, and all compete.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from samii_rig.diagnose.fit.explanations import NEAR_BEST, Explanation, Explanations, named
from samii_rig.diagnose.fit.ranking import moved, ranking
from samii_rig.diagnose.fit.refit import Fitted, far_off, refit
from samii_rig.diagnose.fit.screen import Screen, Start
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.types import Float

MOST = 5  # effects in one explanation, if all are of one physics
MIXED = 2  # effects of different physics: with more, sums of them mimic what is in no table
STRAIGHT = 15  # candidates that are refitted from the nominal parameters as the rig file has them
WORTH = 8.0  # of chi-square, gain in the screen below which a candidate is not refitted
MOST_SATURATED = 12  # places that one physics is put in at once, at most
WEAK_STARTS = (4, 5, 6)  # tenths of its range at which it starts there
SHARE = 0.3  # of the best candidate's gain: one that promises less is not refitted
PENALISED = 3.0  # of a nominal parameter's penalty, above which the refit hides what is missing
LARGE_MISMATCH = (
    8.0  # chi-square over its mean, above which candidates compete by halving before a refit
)
AHEAD, FINALISTS = 5, 5  # steps of a round of that, and how many go on after it
FALLING = 0.5  # of its cost, after a leg, below which one is still on its way and runs another
OTHER_PHYSICS = 3  # of other physics than theirs, that go on too
SWITCHED = 12  # effects without unknowns among those: the nearest as the rig file has the rest

Candidate = tuple[float, tuple[Effect, ...], list[Float]]  # chi-square hoped for, and starts


class Growing(Explanations):
    """Explanations that grow by an effect, or lose one."""

    # The latest screen, and what it was about: single effects and pairs begin with the same one.
    _screened: tuple[tuple[object, ...], list[tuple[float, Effect, list[Start]]]] | None = None
    # The lines, and the effects, from which the rig as its file has it was extended.
    _straightened: tuple[object, frozenset[str]] = None, frozenset()

    def screen(self, base: Explanation) -> list[tuple[float, Effect, list[Start]]]:
        """How far chi-square should fall with each further effect, and one or two starts for its
        refit; the largest first."""
        about = self.problem, base.fitted, self.table
        if self._screened is None or any(
            a is not b for a, b in zip(self._screened[0], about, strict=True)
        ):
            screen = Screen.of(self.problem, base.fitted)
            every = self.each(self.table, lambda e: named([e]))
            self._screened = about, ranking(screen, every, base.effects, self.model)
        return self._screened[1]

    def forward(
        self, base: Explanation, most: int, *, again: bool = False, open_to_all: bool = False
    ) -> None:
        """Refit `base` with each of the most promising further effects; again : those too that
        were refitted from elsewhere. open_to_all : where halving decides, not of those alone."""
        if len(base.effects) >= MOST:
            return
        tried: list[Candidate] = []
        large_mismatch = base.fitted.cost > LARGE_MISMATCH * self.problem.expected
        entered = None if large_mismatch and open_to_all else most
        for drop, effect, starts in self.screen(base)[:entered]:
            effects = (*base.effects, effect)
            model = self.model(effects)
            known_ = not again and frozenset(e.key for e in effects) in self.found
            if drop < WORTH or known_ or self._mixed(effects) or not model:
                continue
            known = moved(base.fitted.model, base.fitted.x, model)
            whole = [np.append(known, np.log(start)) for start in starts]
            tried.append((base.fitted.cost - drop, effects, whole))
        if large_mismatch:
            tried = self._ahead([*tried, *self._switches(base)])
        best = min((e.fitted.cost for e in self.found.values()), default=math.inf)
        reached = base.fitted.cost
        for predicted, effects, starts_ in self.each(tried, lambda one: named(one[1])):
            if base.fitted.cost - predicted < SHARE * (base.fitted.cost - reached):
                continue
            end: Fitted | None = None
            for x in starts_:
                new = self.refitted_from(effects, x, best)
                if new is not None and (end is None or new.cost < end.cost):
                    end = new
                if end is not None and end.cost < predicted + WORTH:
                    break
            if end is not None:
                self.keep(effects, end)
                reached = min(reached, end.cost)
                best = min(best, end.cost + 2 * NEAR_BEST)

    def _switches(self, base: Explanation) -> list[Candidate]:
        """Effects that are there or not, from the nominal parameters as the rig file has them:
        where a large mismatch has moved these, no step along them shows what such an effect
        does."""
        nearest: dict[tuple[str, str], tuple[float, tuple[Effect, ...], Float]] = {}
        for effect in self.table:
            effects = (*base.effects, effect)
            model = None if effect.unknowns or self._mixed(effects) else self.model(effects)
            if model is None or frozenset(e.key for e in effects) in self.found:
                continue
            x = moved(base.fitted.model, base.fitted.x, model)
            x[: model.n_nominal] = 0.0
            off = far_off(model, self.problem, x)
            # Of the units of a channel, or of its shifts, one is nearest wherever the rest stands.
            kin = effect.physics, effect.site
            if kin not in nearest or off < nearest[kin][0]:
                nearest[kin] = off, effects, x
        out: list[Candidate] = []
        for _, effects, x in nearest.values():
            there = self.refitted_from(effects, x, steps=0)
            if there is not None:
                out.append((there.cost, effects, [x]))
        return sorted(out, key=lambda one: one[0])[:SWITCHED]

    @staticmethod
    def _mixed(effects: Sequence[Effect]) -> bool:
        """Whether these are too many of different physics."""
        real = [e.physics for e in effects if e.physical]
        return len(real) > MIXED and len(set(real)) > 1

    def _ahead(self, tried: Sequence[Candidate]) -> list[Candidate]:
        """Those that the first steps of a refit bring farthest, from where these ended.

        Far from the noise the nominal parameters stand where they mend what is missing, and
        what a screen about them says of a cure does not rank it.
        """
        ends = []
        for _, effects, starts in self.each(tried, lambda one: named(one[1])):
            for x in starts:
                end = self._run(effects, x)
                if end is not None:
                    ends.append((end.cost, effects, [end.x]))
        ends.sort(key=lambda end: end[0])
        first, rest = ends[:FINALISTS], ends[FINALISTS:]
        seen = {end[1][-1].physics for end in first}
        others: dict[str, Candidate] = {}
        for other in rest:
            if (physics := other[1][-1].physics) not in seen:
                others.setdefault(physics, other)
        return first + list(others.values())[:OTHER_PHYSICS]

    def _run(self, effects: tuple[Effect, ...], x: Float) -> Fitted | None:
        """A refit for as long as it falls fast: who starts far away is not behind for that."""
        end, cost = self.refitted_from(effects, x, steps=0, far=False), math.inf
        while end is not None and end.cost < FALLING * cost:
            cost = end.cost
            end = self.refitted_from(effects, end.x, steps=AHEAD, far=False) or end
        return end

    def _bent(self, best: Explanation) -> bool:
        """Whether nominal parameters at unlikely values may hide what is missing."""
        n = self.nominal.fitted.model.n_nominal
        return max(self.nominal.fitted.penalty, best.fitted.penalty) > PENALISED * n

    def _forward_straight(self, base: Explanation) -> None:
        """Forward from the rig as its file has it, once on the same lines."""
        problem, key = self._straightened
        if problem is not self.problem or key != base.key:
            self._straightened = self.problem, base.key
            self.forward(self._straight(base), STRAIGHT, again=True)

    def _straight(self, base: Explanation) -> Explanation:
        """The same, the rig as its file has it: where the refitted one took values that their
        tolerances make unlikely, it has done what is missing by them, and hides it."""
        model, x = base.fitted.model, base.fitted.x.copy()
        x[: model.n_nominal] = 0.0
        there = refit(model, self.problem, x, far=False, steps=0)
        return Explanation(base.effects, there, 0.0)

    def saturate(self, physics: str) -> None:
        """Every place of one physics at once, taken away again one by one while that is better.

        What is missing everywhere in small parts is not found by adding one part after another.
        """
        # A crack is none of many joints, and one body carries no two.
        effects = tuple(e for e in self.table if e.physics == physics and not e.pieces)
        if not 2 <= len(effects) <= MOST_SATURATED:
            return
        ends = []
        for tenth in self.each(WEAK_STARTS, lambda _: named(effects[:1]) + " and everywhere else"):
            start = [
                math.log(u.starts[tenth * len(u.starts) // 10]) for e in effects for u in e.unknowns
            ]
            end = self.refitted(effects, self.nominal, start)
            ends += [end] if end is not None else []
        if not ends:
            return
        end = min(ends, key=lambda end: end.cost)
        whole = Explanation(effects, end, self.weigh(effects, end))
        while whole.effects:
            least = self._least(whole)
            less = [self.without(whole, i) for i in least[:2]]
            best = max((e for e in less if e is not None), key=lambda e: e.weight, default=None)
            if best is None or best.weight < whole.weight:
                break
            whole = best
        self.keep(whole.effects, whole.fitted)

    def _least(self, whole: Explanation) -> list[int]:
        """Its effects, first the one without which chi-square should rise least."""
        each = [self.without_refit(whole, i) for i in range(len(whole.effects))]
        left = [Screen.of(self.problem, e.fitted).chi_square() if e else math.inf for e in each]
        return [int(i) for i in np.argsort(left)]

    def backward(self) -> None:
        """Try the best explanation without each of its effects, until none can go."""
        while True:
            best = self.ranked()[0]
            if len(best.effects) < 2:
                return
            for i in self.each(range(len(best.effects)), in_place_of(best)):
                self.without(best, i)
            if self.ranked()[0].key == best.key:
                return


def in_place_of(whole: Explanation) -> Callable[[int], str]:
    """What is looked at while effect i of an explanation is left out, in words."""
    return lambda i: f"another in place of {named(whole.effects[i : i + 1])}"
