"""What stands beside the best force, and whether it need.

Through the chain that another explanation moves, one may seem to leave less. So all that competes
here is refitted through its own, until that stands still.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from samii_rig.diagnose.fit.explanations import (
    NEAR_BEST,
    Explanation,
    Explanations,
    named,
    unlikely,
)
from samii_rig.diagnose.fit.ranking import moved, ranking
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.screen import Screen
from samii_rig.diagnose.forces.fits import ForceFits
from samii_rig.diagnose.forces.laws import FRICTION, HYSTERESIS, UNEVEN
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.table import PRESLID, presliding, uneven
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.types import Float

FORMED_AGAIN = 3  # times that the likelihood is made anew about the best explanation
REFERENCE_STILL = 0.5  # standard deviations, a move from one to the next that is none
NO_MOVE = 1e-3  # of a logarithm: a refit of few steps has ended
RENEWED = 3  # times that the chain through which a force acts is renewed in between
ANEW = 2  # times that presliding is tried: before the likelihood stands about a friction, and then
BESIDE = 6  # linear effects that are refitted beside the best force, and the other way round


class BesideForce(ForceFits):
    """A force alone, with linear effects, and with others in their place.

    preslid : how often presliding was tried in the place of the friction of each explanation.
    """

    def __post_init__(self) -> None:
        self.preslid: Counter[frozenset[str]] = Counter()
        super().__post_init__()

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
        if sum(e.physical for e in best.effects) == 1:
            self._exactly(best)

    def _exactly(self, best: Explanation) -> None:
        """Refit a force alone with the slopes that the chain's parameters give the force itself: of
        a strong one they are not of second order. Where that ends at unlikely values, from those of
        the rig file too: what a linear fit bent to do the force's work may lie in another valley.
        """
        model, start = best.fitted.model, best.fitted.x
        end = self.refitted_exactly(model, start)
        if end is None or unlikely(end):
            nominal = np.concatenate([np.zeros(model.n_nominal), start[model.n_nominal :]])
            ends = (end, self.refitted_exactly(model, nominal))
            end = min(filter(None, ends), key=lambda fitted: fitted.cost, default=None)
        if end is not None and end.cost < best.fitted.cost:
            del self.found[best.key]
            self.keep(best.effects, end)
        self._ways.clear()

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
        self.keep(effects, last)

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

    def _either_way(self, best: Explanation) -> None:
        """Dry friction that may differ by direction, from where it did not; what sticks and slips
        after Dahl's law, from where it did after Bouc's and Wen's."""
        forced = next((e for e in best.effects if e.force is not None), None)
        if forced is None or forced.force is None:
            return
        other = None
        if forced.force.law is FRICTION:
            other, least = uneven(forced), self.critical_value
        elif forced.force.law is HYSTERESIS:
            other, least = presliding(forced, self.paths), 0.0
        if other is None:
            return
        other = self._of_table(other)
        at = best.effects.index(forced)
        effects = (*best.effects[:at], *best.effects[at + 1 :], other)
        own = best.fitted.model.own(at)
        start = np.append(
            np.delete(best.fitted.x, list(own)), np.resize(best.fitted.x[list(own)], 2)
        )
        end = self.refitted_from(effects, start)
        if end is not None and best.fitted.chi2 - end.chi2 > least:
            self.keep(effects, end)

    def _of_table(self, effect: Effect) -> Effect:
        """The same effect of the table, whose bounds are those of its models; put there if none
        is."""
        if effect.key not in {e.key for e in self.table}:
            self.use((*self.table, effect))
        return next(e for e in self.table if e.key == effect.key)

    def _presliding(self, best: Explanation) -> bool:
        """Dry friction with presliding, from where that which does not ended; whether
        it explains more."""
        forced = next(e for e in best.effects if e.force is not None)
        assert forced.force is not None
        if forced.force.law not in (FRICTION, UNEVEN) or self.exhausted:
            return False
        other = presliding(forced, self.paths)
        if other is None or self.preslid[best.key] >= ANEW:
            return False
        self.preslid[best.key] += 1
        other = self._of_table(other)
        linear, old = tuple(e for e in best.effects if e is not forced), best.fitted
        own = list(old.model.own(best.effects.index(forced)))
        T_c, known = float(old.x[own[0]]), np.delete(old.x, own)
        motion = self.paths.motion(forced.force.place, of_speed=False)
        top = max(float(np.max(np.abs(y))) for y in motion)
        # What the chain bent to do the force's work may lie in another valley.
        stated = np.concatenate([np.zeros(old.model.n_nominal), known[old.model.n_nominal :]])
        for chain, share in self.each([(c, g) for c in (known, stated) for g in PRESLID]):
            start = np.concatenate([chain, [T_c, T_c - np.log(share * top)]])
            least = min(e.fitted.cost for e in self.found.values())
            self.keep((*linear, other), self.refitted_from((*linear, other), start, least))
        found = self.found.get(frozenset(e.key for e in (*linear, other)))
        return found is not None and old.chi2 - found.fitted.chi2 > self.critical_value

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
            needed = self.critical_value_of((effect,))
            if drop < needed / 2 or self.model(effects) is None:
                continue
            end = self.refitted(effects, best, np.log(starts[0]).tolist())
            alone = [best, self.found.get(frozenset({effect.key}))]
            if end is not None and all(
                e is None or e.fitted.chi2 - end.chi2 > needed for e in alone
            ):
                self._renewed(effects, end.x)

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
