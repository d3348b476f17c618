"""Which physics, and where: every hypothesis refitted, weighed, added and taken away again.

A screen holds each effect, at starts over its whole range, against what the model so far
cannot explain, with the uncertain parameters projected out. The best are refitted jointly with
these parameters. Effects are added while the evidence grows, each is then tried without and
with every other in its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from samii_rig.diagnose.fit.explanations import (
    NEAR_BEST,
    Explanation,
    Explanations,
    named,
    threshold,
)
from samii_rig.diagnose.fit.ranking import moved, ranking
from samii_rig.diagnose.fit.refit import Fitted, far_off, profiled, refit
from samii_rig.diagnose.fit.screen import Screen, Start
from samii_rig.diagnose.fit.usual import LINES
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.faults import SHIFTED
from samii_rig.types import Float

MOST = 5  # effects in one explanation, if all are of one physics
MIXED = 2  # effects of different physics: with more, sums of them mimic what is in no table
FIRST, LATER = 30, 6  # candidates that are refitted in the first round, and in later ones
STRAIGHT = 15  # of them, from the nominal parameters as the rig file has them
WORTH = 8.0  # of chi-square, gain in the screen below which a candidate is not refitted
ENOUGH = 1.15  # chi-square over its mean below which growth looks at one explanation only
SATURATED = "torsional_compliance"  # joints that give: what is missing in many places at once
MOST_SATURATED = 12  # of these places
TENTHS = (2, 5, 8)  # tenths of their range at which several unknowns start together
WEAK_STARTS = (4, 5, 6)  # tenths of the range at which they start
BEAM = 2  # explanations to which further effects are added
HOPELESS = 20.0  # times the best chi-square, above which an explanation is let go
# Times the cost that an explanation seemed to have, above which it was no such one.
OVER_SEEMING = 3.0
BINNED_AGAIN, BINS_STILL = 4, 0.3  # times that bins are made anew at most, and a move that is none
SWAPS = 2  # rounds of them, the second about what won the first
ANYHOW = 2  # of the most promising in another's place are refitted whatever the screen says
SHARE = 0.3  # of the best candidate's gain: one that promises less is not refitted
PENALISED = 3.0  # of a nominal parameter's penalty, above which the refit hides what is missing
LARGE_MISMATCH = (
    8.0  # chi-square over its mean, above which candidates compete by halving before a refit
)
AHEAD, FINALISTS = 5, 5  # steps of a round of that, and how many go on after it
FALLING = 0.5  # of its cost, after a leg, below which one is still on its way and runs another
OTHER_PHYSICS = 3  # of other physics than theirs, that go on too
SWITCHED = 12  # effects without unknowns that compete so: the nearest as the rig file has the rest
PROFILED, MOST_PROFILED = 12, 2  # values of each unknown over its range, of so many at most
NEXT = 2  # shifts of columns beside the best: one to either side
BROAD = 4  # single effects of different physics that are extended where none is enough

Candidate = tuple[float, tuple[Effect, ...], list[Float]]  # chi-square hoped for, and starts


class Search(Explanations):
    """What is tried: effects added, taken away again and swapped."""

    usual = LINES
    # The latest screen, and what it was about: single effects and pairs begin with the same one.
    _screened: tuple[tuple[object, ...], list[tuple[float, Effect, list[Start]]]] | None = None
    # The lines, and the effects, from which the rig as its file has it was extended.
    _straightened: tuple[object, frozenset[str]] = None, frozenset()

    def run(self, *, briefly: bool = False) -> list[Explanation]:
        """Forward, exchange, backward; all explanations, the most probable first. briefly : single
        effects alone, and beside what is wrong with the data."""
        base = self.nominal if briefly else self._surely_meant()
        self.forward(base, FIRST, open_to_all=not briefly)
        if self._bent(self.ranked()[0]):
            self._forward_straight(base)
        self.take_overdispersion()
        best = self.ranked()[0]
        if briefly and faulty(best.effects) and not self._enough(best):
            self.rebin_and_refit(best)
            base = self.ranked()[0]
            self.forward(base, FIRST)
            if self._bent(base):
                self._forward_straight(base)
            self.take_overdispersion()
        if briefly:
            self._plainer()
            return self.ranked()
        if self.ratio(self.ranked()[0].fitted) > threshold(self.spread):
            self._along_valleys()
        about = self.nominal.key
        for turn in range(MOST - 1):
            before = self._nearest() if turn == 0 else self.ranked()[0]
            if not before.effects:
                break
            self.rebin_and_refit(before)
            about = before.key
            if turn == 0 and not self._enough(self.ranked()[0]):
                # What is one of two often stands behind what mimics both.
                for base in list(_each_physics(self.ranked()))[:BROAD]:
                    self.forward(base, LATER)
                self.saturate(SATURATED)
            for base in self._beam():
                self.forward(base, LATER)
            self.take_overdispersion()
            self.backward()
            if self.ranked()[0].key == before.key:
                break
        for _ in range(SWAPS):
            best = self.ranked()[0]
            if not best.effects:
                break
            self.exchange(best)
            self.take_overdispersion()
            self.backward()
            if self.ranked()[0].key == best.key:
                break
        if (best := self.ranked()[0]).key != about and best.effects:
            self.rebin_and_refit(best)
            self.take_overdispersion()
        self._beside_what_was_meant()
        self._behind_the_input()
        self._beside_next_shifts()
        self._from_everywhere()
        self._plainer()
        return self.ranked()

    def _beside_what_was_meant(self) -> None:
        """Every single effect beside what is wrong with the data: an effect that mimics both hid
        which of them is there."""
        best = self.ranked()[0]
        meant = self.meant(best.effects)
        if meant is not None and 0 < len(meant.effects) < len(best.effects):
            self.forward(meant, FIRST)
            self.take_overdispersion()

    def _behind_the_input(self) -> None:
        """Where every sensor is early, it is the input that is late: what is wrong with it, and one
        more effect beside that. No exchange of one early sensor for it leads there."""
        best = self.ranked()[0]
        early = {e.site for e in best.effects if e.physics == "time_offset"}
        if len(early) < 2 or len(early) < np.unique(self.grid.sensor).size:
            return
        bases = []
        for effect in self.table:
            of_input = effect.factor is not None and effect.factor.kind == "input"
            model = self.model((effect,))
            if effect.physical or effect.unknowns or not of_input or model is None:
                continue
            x = moved(best.fitted.model, best.fitted.x, model)[: model.n]
            there = refit(model, self.problem, x, far=False, steps=0)
            bases.append(Explanation((effect,), there, 0.0))
        for base in sorted(bases, key=lambda e: e.fitted.cost)[:BROAD]:
            self.forward(base, LATER, again=True)
        self.take_overdispersion()
        self.backward()

    def _beside_next_shifts(self) -> None:
        """What stands beside a shift of whole samples beside the next shifts, too: a dead time of
        nearly a sample has the shift told one too far, and no exchange of one for the other leads
        back. From the rig as its file has it: the nominal parameters are bent towards the best."""
        best = self.ranked()[0]
        shift = next((e for e in best.effects if e.physics == SHIFTED), None)
        if shift is None:
            return
        beside: dict[str, tuple[Effect, Float]] = {}
        for e in self.ranked():
            if len(e.effects) == 2 and shift in e.effects:
                i = 1 - e.effects.index(shift)
                own = e.fitted.x[e.fitted.model.own(i)]
                beside.setdefault(e.effects[i].physics, (e.effects[i], own))
        off: list[tuple[float, Effect]] = []
        for other in self.table:
            model = self.model((other,)) if (other.physics, other.site) == shift.name else None
            if model is not None and other is not shift:
                x = moved(best.fitted.model, best.fitted.x, model)[: model.n]
                off.append((far_off(model, self.problem, x), other))
        for _, other in sorted(off, key=lambda one: one[0])[:NEXT]:
            for effect, own in list(beside.values())[:BROAD]:
                effects = (other, effect)
                model = self.model(effects)
                if model is None:
                    continue
                x = np.append(np.zeros(model.n - own.size), own)
                end = self.refitted_from(effects, x)
                if end is not None:
                    self.keep(effects, end)
        self.take_overdispersion()
        self.backward()

    def _plainer(self) -> None:
        """The best with a law of fewer unknowns in place of each of its effects: a part that ends
        at the end of its body, or a spring that is all damper, is one that the table has by itself,
        and need not have been refitted."""
        for _ in range(SWAPS):
            best = self.ranked()[0]
            for i, gone in enumerate(best.effects):
                base, some = self.without_refit(best, i), [e for e in self.table if e.within(gone)]
                if base is None or not some:
                    continue
                screen = Screen.of(self.problem, base.fitted)
                for _drop, effect, starts in ranking(screen, some, base.effects, self.model):
                    effects = (*base.effects, effect)
                    end = self.refitted(effects, base, np.log(starts[0]).tolist())
                    if end is not None:
                        self.keep(effects, end)
            self.take_overdispersion()
            if self.ranked()[0].key == best.key:
                return

    def _from_everywhere(self) -> None:
        """Single effects of several unknowns that may still compete, refitted from weak to strong:
        one that stopped in a local minimum beside its own loses to others by that alone."""
        best = self.ranked()[0]
        near = [e for e in self.ranked() if best.effects and e.weight > best.weight - NEAR_BEST]
        several = [e for e in near if len(e.effects) == 1 and len(e.effects[0].unknowns) > 1]
        for e in self.each(several, lambda e: named(e.effects)):
            unknowns = e.effects[0].unknowns
            for tenth in TENTHS:
                start = [math.log(u.starts[tenth * len(u.starts) // 10]) for u in unknowns]
                end = self.refitted(e.effects, self.nominal, start, e.fitted.cost)
                if end is not None:
                    self.keep(e.effects, end)
        self.take_overdispersion()

    def _along_valleys(self) -> None:
        """The most promising effect of each physics of several unknowns from all over their range,
        where the best leaves more than noise: a narrow valley that bends with the nominal
        parameters is found along these alone."""
        for e in self.each(list(_each_physics(self.ranked()))[:BROAD], lambda e: named(e.effects)):
            (effect,) = e.effects
            if not 1 < len(effect.unknowns) <= MOST_PROFILED:
                continue
            each = (
                np.linspace(math.log(u.low), math.log(u.high), PROFILED) for u in effect.unknowns
            )
            model = e.fitted.model
            known = moved(self.nominal.fitted.model, self.nominal.fitted.x, model)
            starts = (np.append(known, own) for own in product(*each))
            found = profiled(model, self.problem, self.nominal.fitted, starts)
            if found and found[0].cost < e.fitted.cost:
                end = self.refitted_from(e.effects, found[0].x)
                if end is not None:
                    self.keep(e.effects, end)
        self.take_overdispersion()

    def _bent(self, best: Explanation) -> bool:
        """Whether nominal parameters at unlikely values may hide what is missing."""
        n = self.nominal.fitted.model.n_nominal
        return max(self.nominal.fitted.penalty, best.fitted.penalty) > PENALISED * n

    def _surely_meant(self) -> Explanation:
        """As of `meant` of the most probable, where nothing without what is wrong with the data
        comes near."""
        best = self.ranked()[0]
        meant = self.meant(best.effects) or self.nominal
        rival = next((e for e in self.ranked() if not meant.key <= e.key), None)
        sure = rival is None or rival.weight < best.weight - 4 * NEAR_BEST
        return meant if sure else self.nominal

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

    def saturate(self, physics: str) -> None:
        """Every place of one physics at once, taken away again one by one while that is better.

        What is missing everywhere in small parts is not found by adding one part after another.
        """
        effects = tuple(e for e in self.table if e.physics == physics)
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
            for i in self.each(range(len(best.effects)), _without(best)):
                self.without(best, i)
            if self.ranked()[0].key == best.key:
                return

    def exchange(self, whole: Explanation) -> None:
        """Every effect of `whole` taken out, and every other tried in its place, about where
        `whole` left the rest."""
        enough = whole.fitted.cost + 4 * NEAR_BEST * self.overdispersion
        for i in self.each(range(len(whole.effects)), _without(whole)):
            gone = whole.effects[i]
            base = self.without_refit(whole, i)
            if base is None:
                continue
            if len(gone.unknowns) > 2:
                self._elsewhere(whole, i, base, enough)
            screened = self.screen(base)
            for rank, (drop, effect, starts) in enumerate(screened[: LATER + 1]):
                effects = (*base.effects, effect)
                done = frozenset(e.key for e in effects) in self.found or self._mixed(effects)
                # At the place of what was taken out a simpler law may do what that did.
                there = effect.jump and gone.jump and effect.jump.place == gone.jump.place
                if done or (rank >= ANYHOW and not there and base.fitted.cost - drop > enough):
                    continue
                end = self.refitted(effects, base, np.log(starts[0]).tolist(), enough)
                if end is not None:
                    self.keep(effects, end)

    def _elsewhere(self, whole: Explanation, i: int, base: Explanation, enough: float) -> None:
        """Effect i of `whole` at every other place, from the values that it has at its own: several
        unknowns that start elsewhere may end far from them."""
        gone = whole.effects[i]
        own = whole.fitted.x[whole.fitted.model.own(i)]
        for effect in self.table:
            alike = effect.physics == gone.physics and len(effect.unknowns) == own.size
            if not alike or effect.key in {e.key for e in whole.effects}:
                continue
            effects = (*base.effects, effect)
            bounds = np.log([(u.low, u.high) for u in effect.unknowns]).T
            if self.model(effects) is None or self._mixed(effects):
                continue
            end = self.refitted(effects, base, np.clip(own, *bounds).tolist(), enough)
            if end is not None and end.cost < enough:
                self.keep(effects, end)

    def _nearest(self) -> Explanation:
        """The most probable explanation; where even that leaves much, the one nearest to the lines
        themselves: bins about a large mismatch hide how well another would do."""
        ranked = self.ranked()
        if self._enough(ranked[0]):
            return ranked[0]
        at = self.grid.at(self.lines.frequency, self.lines.level)

        def cost_there(e: Explanation) -> float:
            return float(np.sum(self.lines.chi_square(e.fitted.model.response(e.fitted.x, at))))

        return min(ranked[:FINALISTS], key=cost_there)

    def _beam(self) -> list[Explanation]:
        ranked = self.ranked()
        best = ranked[0]
        size = len(best.effects)
        near = [e for e in ranked if len(e.effects) == size]
        kept = near[:1] if self._enough(best) else near[:BEAM]
        if size > MIXED:  # many places of one physics may stand for two of different physics
            one = [e for e in ranked if len(e.effects) == 1]
            kept += [e for e in one if e.weight > best.weight - 4 * NEAR_BEST][:1]
        return kept

    def _enough(self, explanation: Explanation) -> bool:
        """Whether what an explanation leaves is near what noise would."""
        return explanation.fitted.chi2 < ENOUGH * self.problem.expected

    def rebin_and_refit(self, best: Explanation) -> None:
        """Bins anew about the best explanation until it stands still, for bins about a model that
        is off lead to one that is; and what may still compete refitted on them."""
        near = [e for e in self.ranked()[:FIRST] if e.weight > best.weight - 4 * NEAR_BEST]
        broad = list(_each_physics(self.ranked()))[:BROAD]
        keep = [e for e in (*near, *broad) if e.fitted.cost < HOPELESS * best.fitted.cost]
        nominal, seemed = self.nominal, best.fitted.cost
        for _ in range(BINNED_AGAIN):
            self.rebin(best.fitted)
            end = self.refitted(best.effects, best)
            if end is None:
                break
            still = best.fitted.away(end) < BINS_STILL
            best = replace(best, fitted=end)
            if still:
                break
        if best.effects and best.fitted.cost > OVER_SEEMING * max(seemed, self.problem.expected):
            # About itself it does nothing of what it seemed to from where it was looked for.
            self.rebin(nominal.fitted)
            keep = [e for e in keep if e.key != best.key]
            best = nominal
        self.found.clear()
        again = list({e.key: e for e in (*keep, best, nominal)}.values())
        for e in self.each(again, lambda e: named(e.effects)):
            end = self.refitted(e.effects, e)
            if end is not None:
                self.keep(e.effects, end)


def faulty(effects: Sequence[Effect]) -> bool:
    """Whether these are of the data alone, not of the rig."""
    return bool(effects) and not any(e.physical for e in effects)


def _without(whole: Explanation) -> Callable[[int], str]:
    return lambda i: f"another in place of {named(whole.effects[i : i + 1])}"


def _each_physics(ranked: Sequence[Explanation]) -> Iterator[Explanation]:
    """The first single effect of each physics."""
    seen = set()
    for e in ranked:
        if len(e.effects) == 1 and e.effects[0].physics not in seen:
            seen.add(e.effects[0].physics)
            yield e
