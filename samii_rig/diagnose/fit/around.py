"""What else is tried about the best explanation, so that it is the best.

A search that adds effects one by one stops where no single one helps: another in the place of each,
other starts, a simpler law, a mistake of measurement that mimics what was found.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from samii_rig.diagnose.fit.explanations import NEAR_BEST, Explanation, named
from samii_rig.diagnose.fit.growing import Growing, in_place_of
from samii_rig.diagnose.fit.ranking import moved, ranking
from samii_rig.diagnose.fit.refit import far_off, profiled, refit
from samii_rig.diagnose.fit.screen import Screen
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.faults import SHIFTED
from samii_rig.types import Float

FIRST, LATER = 30, 6  # candidates that are refitted in the first round, and in later ones
TENTHS = (2, 5, 8)  # tenths of their range at which several unknowns start together
SWAPS = 2  # rounds of exchanges, the second about what won the first
ANYHOW = 2  # of the most promising in another's place are refitted whatever the screen says
PROFILED, MOST_PROFILED = 12, 2  # values of each unknown over its range, of so many at most
NEXT = 2  # shifts of columns beside the best: one to either side
BROAD = 4  # single effects of different physics that are extended where none is enough


class Around(Growing):
    """Explanations near the best one."""

    def exchange(self, whole: Explanation) -> None:
        """Every effect of `whole` taken out, and every other tried in its place, about where
        `whole` left the rest."""
        enough = whole.fitted.cost + 4 * NEAR_BEST * self.overdispersion
        for i in self.each(range(len(whole.effects)), in_place_of(whole)):
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
            model = self.model((other,)) if other.name == shift.name else None
            if model is not None and other is not shift:
                x = moved(best.fitted.model, best.fitted.x, model)[: model.n]
                off.append((far_off(model, self.problem, x), other))
        nearest = [other for _, other in sorted(off, key=lambda one: one[0])[:NEXT]]
        for other, (effect, own) in product(nearest, list(beside.values())[:BROAD]):
            effects = (other, effect)
            if (model := self.model(effects)) is not None:
                x = np.append(np.zeros(model.n - own.size), own)
                self.keep(effects, self.refitted_from(effects, x))
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
                self.keep(e.effects, end)
        self.take_overdispersion()

    def _along_valleys(self) -> None:
        """The most promising effect of each physics of several unknowns from all over their range,
        where the best leaves more than noise: a narrow valley that bends with the nominal
        parameters is found along these alone."""
        for e in self.each(list(each_physics(self.ranked()))[:BROAD], lambda e: named(e.effects)):
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
                self.keep(e.effects, end)
        self.take_overdispersion()


def each_physics(ranked: Sequence[Explanation]) -> Iterator[Explanation]:
    """The first single effect of each physics."""
    seen = set()
    for e in ranked:
        if len(e.effects) == 1 and e.effects[0].physics not in seen:
            seen.add(e.effects[0].physics)
            yield e
