"""Which physics, and where: every hypothesis refitted, weighed, added and taken away again.

Effects are added while the evidence grows; each is then tried without, and with every other in its
place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from samii_rig.diagnose.fit.around import BROAD, FIRST, LATER, SWAPS, Around, each_physics
from samii_rig.diagnose.fit.explanations import NEAR_BEST, Explanation, named, threshold
from samii_rig.diagnose.fit.growing import FINALISTS, MIXED, MOST
from samii_rig.diagnose.fit.usual import LINES
from samii_rig.diagnose.physics.effect import Effect

ENOUGH = 1.15  # chi-square over its mean below which growth looks at one explanation only
SATURATED = "torsional_compliance"  # joints that give: what is missing in many places at once
BEAM = 2  # explanations to which further effects are added
HOPELESS = 20.0  # times the best chi-square, above which an explanation is let go
# Times the cost that an explanation seemed to have, above which it was no such one.
OVER_SEEMING = 3.0
BINNED_AGAIN, BINS_STILL = 4, 0.3  # times that bins are made anew at most, and a move that is none


class Search(Around):
    """What is tried, in its order."""

    usual = LINES

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
                for base in list(each_physics(self.ranked()))[:BROAD]:
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

    def _surely_meant(self) -> Explanation:
        """As of `meant` of the most probable, where nothing without what is wrong with the data
        comes near."""
        best = self.ranked()[0]
        meant = self.meant(best.effects) or self.nominal
        rival = next((e for e in self.ranked() if not meant.key <= e.key), None)
        sure = rival is None or rival.weight < best.weight - 4 * NEAR_BEST
        return meant if sure else self.nominal

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
        broad = list(each_physics(self.ranked()))[:BROAD]
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
            self.keep(e.effects, end)


def faulty(effects: Sequence[Effect]) -> bool:
    """Whether these are of the data alone, not of the rig."""
    return bool(effects) and not any(e.physical for e in effects)
