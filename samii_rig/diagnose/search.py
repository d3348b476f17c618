"""Which physics, and where: every hypothesis refitted, weighed, added and taken away again.

A screen holds each effect, at starts over its whole range, against what the model so far
cannot explain, with the uncertain parameters projected out. The best are refitted jointly with
these parameters. Effects are added while the evidence grows, each is then tried without and
with every other in its place.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.measured import Measured, binned
from samii_rig.diagnose.model import Grid, Model, grid
from samii_rig.diagnose.nonlinear_model import model_of
from samii_rig.diagnose.ranking import moved, ranking
from samii_rig.diagnose.refit import STEPS, Fitted, Problem, refit
from samii_rig.diagnose.screen import Screen, Start
from samii_rig.errors import SamiiRigError
from samii_rig.rig.schema import Rig
from samii_rig.types import Float

MOST = 5  # effects in one explanation, if all are of one physics
MIXED = 2  # effects of different physics: with more, sums of them mimic what is in no table
FIRST, LATER = 30, 6  # candidates that are refitted in the first round, and in later ones
CHANCE = (0.5, 0.4, 0.02)  # before the data: of nothing, one, two effects missing
FEWER = 0.05  # of each further effect
NEAR = 25.0  # of the logarithm of evidence: explanations further below the best are let go
WORTH = 8.0  # of chi-square, gain in the screen below which a candidate is not refitted
FIVE = 5.0  # standard deviations of chi-square beyond which what is left is more than noise
ALIKE, MOST_ALIKE = 0.1, 40  # correlation that counts, and bins over which it is looked for
EXACT = 2e-4  # of the mismatch: what beams, sensors and integrators are modelled to
ENOUGH = 1.15  # chi-square over its mean below which growth looks at one explanation only
SATURATED = "torsional_compliance"  # joints that give: what is missing in many places at once
MOST_SATURATED = 12  # of these places
WEAK = (4, 5, 6)  # tenths of the range at which they start
BEAM = 2  # explanations that are grown further
HOPELESS = 20.0  # times the best chi-square, above which an explanation is let go
AGAIN, STILL = 4, 0.3  # times that bins are made anew at most, and a move that is none
SWAPS = 2  # rounds of them, the second about what won the first
ANYHOW = 2  # of the most promising in another's place are refitted whatever the screen says
SHARE = 0.3  # of the best candidate's gain: one that promises less is not refitted
GROSS = 8.0  # chi-square over its mean above which candidates race before they are refitted
AHEAD, FINALISTS = 5, 5  # steps of that race, and how many go on

Candidate = tuple[float, tuple[Effect, ...], list[Float]]  # chi-square hoped for, and starts


@dataclass(frozen=True, slots=True)
class Explanation:
    """Some effects, refitted. weight : logarithm of evidence times prior."""

    effects: tuple[Effect, ...]
    fitted: Fitted
    weight: float

    @property
    def key(self) -> frozenset[str]:
        """The same for the same effects in another order."""
        return frozenset(e.key for e in self.effects)


@dataclass
class Search:
    """The search on one set of lines.

    lines : those that are fitted. grid : of all frequencies. table : all single effects.
    found : every explanation that was refitted, by key.
    """

    rig: Rig
    lines: Measured
    grid: Grid
    table: Sequence[Effect]
    found: dict[frozenset[str], Explanation] = field(default_factory=dict)
    problem: Problem = field(init=False)
    temperature: float = 1.0
    _gross: float = 0.0  # chi-square that the nominal model leaves
    _rows: Counter[str] = field(init=False)
    _total: dict[str, float] = field(init=False)
    _models: dict[tuple[str, ...], Model | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._rows = Counter(e.physics for e in self.table)
        self._total = {p: sum(e.weight for e in self.table if e.physics == p) for p in self._rows}
        model = Model(self.rig)
        at = self.grid.at(self.lines.frequency)
        x = np.zeros(model.n)
        shape = model.response(x, at)
        self.problem = Problem.of(binned(self.lines, shape, misfit=math.inf), self.grid)
        nominal = refit(model, self.problem, x)
        self._rebin(nominal)
        self._keep((), refit(model, self.problem, nominal.x))

    @property
    def nominal(self) -> Explanation:
        """Nothing is missing."""
        return self.found[frozenset()]

    def ranked(self) -> list[Explanation]:
        """All explanations, the most probable first."""
        return sorted(self.found.values(), key=lambda e: -e.weight)

    def weigh(self, effects: Iterable[Effect], fitted: Fitted) -> float:
        """Logarithm of evidence times prior, less what effects beside the first must be worth
        where the mismatch is gross: they may not live on what models are not exact to."""
        effects = tuple(effects)
        beside = self.inexact(effects, self._gross)
        return fitted.evidence(self.temperature) + self.log_prior(effects) - beside

    def inexact(self, effects: Sequence[Effect], gross: float) -> float:
        """Logarithm of evidence that effects beside the first must be worth on lines where the
        nominal model leaves `gross` of chi-square."""
        return 0.5 * EXACT**2 * gross / self.temperature * max(len(effects) - 1, 0)

    def temper(self) -> None:
        """Take the temperature of the explanation that fits best, and weigh all anew.

        What even that leaves is a part of the truth that is not in the table, and has structure
        along frequency: lines count by how much they and their neighbours say that is new.
        """
        best = min(self.found.values(), key=lambda e: e.fitted.cost)
        self.temperature = self.leftover(best.fitted)
        for key, e in self.found.items():
            self.found[key] = replace(e, weight=self.weigh(e.effects, e.fitted))

    def leftover(self, fitted: Fitted) -> float:
        """Chi-square per degree of freedom times the bins over which what is left is alike; 1
        where noise would leave as much."""
        left = self.ratio(fitted)
        if left <= 1 + FIVE * math.sqrt(self.lines.spread):
            return 1.0
        h = fitted.model.response(fitted.x, self.problem.at)
        r = (self.problem.root @ (h - self.problem.data.H)[:, :, None])[:, :, 0]
        power = float(np.sum(np.abs(r) ** 2))
        alike = 1.0
        for lag in range(1, min(MOST_ALIKE, len(r) - 1)):
            rho = float(np.sum(r[lag:] * r[:-lag].conj()).real) / power
            if rho < ALIKE:
                break
            alike += 2 * rho
        return left * alike

    def ratio(self, fitted: Fitted) -> float:
        """Chi-square per degree of freedom over all lines, also inside the bins."""
        found, mean = self.problem.data.inside
        # Directions that the data determine take chi-square away.
        taken = float(np.trace(np.linalg.solve(fitted.precision(), fitted.information)))
        return (fitted.chi2 + found) / max(self.problem.expected + mean - taken, 1.0)

    def run(self, *, briefly: bool = False) -> list[Explanation]:
        """Grow, swap, prune; all explanations, the most probable first. briefly : single effects
        alone."""
        self.grow(self.nominal, FIRST)
        self.temper()
        if briefly:
            return self.ranked()
        for turn in range(MOST - 1):
            before = self._nearest() if turn == 0 else self.ranked()[0]
            if not before.effects:
                break
            self.renew(before)
            if turn == 0 and not self._enough(self.ranked()[0]):
                self.saturate(SATURATED)
            for base in self._beam():
                self.grow(base, LATER)
            self.temper()
            self.prune()
            if self.ranked()[0].key == before.key:
                break
        for _ in range(SWAPS):
            best = self.ranked()[0]
            if not best.effects:
                break
            self.swap(best)
            self.temper()
            self.prune()
            if self.ranked()[0].key == best.key:
                break
        return self.ranked()

    def log_prior(self, effects: Iterable[Effect]) -> float:
        """Before the data: of how many, which rows, which sites of a row."""
        effects = tuple(effects)
        n = len(effects)
        chance = CHANCE[n] if n < len(CHANCE) else CHANCE[-1] * FEWER ** (n - len(CHANCE) + 1)
        each = (math.log(e.weight / self._total[e.physics] / len(self._rows)) for e in effects)
        return math.log(chance) + math.lgamma(n + 1) + sum(each)

    def grow(self, base: Explanation, most: int) -> None:
        """Refit `base` with each of the most promising further effects."""
        if len(base.effects) >= MOST:
            return
        tried: list[Candidate] = []
        for drop, effect, starts in self.screen(base)[:most]:
            effects = (*base.effects, effect)
            model = self._model(effects)
            known_ = frozenset(e.key for e in effects) in self.found
            if drop < WORTH or known_ or self._mixed(effects) or not model:
                continue
            known = _moved(base, model)
            whole = [np.append(known, np.log(start)) for start in starts]
            tried.append((base.fitted.cost - drop, effects, whole))
        if base.fitted.cost > GROSS * self.problem.expected:
            tried = self._ahead([*tried, *self._switches(base)])
        best = min((e.fitted.cost for e in self.found.values()), default=math.inf)
        reached = base.fitted.cost
        for predicted, effects, starts_ in tried:
            if base.fitted.cost - predicted < SHARE * (base.fitted.cost - reached):
                continue
            end: Fitted | None = None
            for x in starts_:
                new = self._from(effects, x, best)
                if new is not None and (end is None or new.cost < end.cost):
                    end = new
                if end is not None and end.cost < predicted + WORTH:
                    break
            if end is not None:
                self._keep(effects, end)
                reached = min(reached, end.cost)
                best = min(best, end.cost + 2 * NEAR)

    def _switches(self, base: Explanation) -> list[Candidate]:
        """Effects that are there or not, from the nominal parameters as the rig file has them:
        where a gross mismatch has bent these, no step along them shows what such an effect does."""
        out: list[Candidate] = []
        for effect in self.table:
            effects = (*base.effects, effect)
            model = None if effect.unknowns or self._mixed(effects) else self._model(effects)
            if model is not None and frozenset(e.key for e in effects) not in self.found:
                x = _moved(base, model)
                x[: model.n_nominal] = 0.0
                out.append((-math.inf, effects, [x]))
        return out

    @staticmethod
    def _mixed(effects: Sequence[Effect]) -> bool:
        """Whether these are too many of different physics."""
        return len(effects) > MIXED and len({e.physics for e in effects}) > 1

    def _ahead(self, tried: Sequence[Candidate]) -> list[Candidate]:
        """Those that a few steps of a refit bring farthest, from where these ended.

        Far from the noise the nominal parameters stand where they mend what is missing, and
        what a screen about them says of a cure does not rank it.
        """
        ends = []
        for _, effects, starts in tried:
            for x in starts:
                end = self._from(effects, x, steps=AHEAD)
                if end is not None:
                    ends.append((end.cost, effects, [end.x]))
        return sorted(ends, key=lambda end: end[0])[:FINALISTS]

    def screen(self, base: Explanation) -> list[tuple[float, Effect, list[Start]]]:
        """How far chi-square should fall with each further effect, and one or two starts for its
        refit; the largest first."""
        look = Screen.of(self.problem, base.fitted)
        return ranking(look, self.table, base.effects, self._model)

    def saturate(self, physics: str) -> None:
        """Every place of one physics at once, taken away again one by one while that is better.

        What is missing everywhere in small parts is not found by adding one part after another.
        """
        effects = tuple(e for e in self.table if e.physics == physics)
        if not 2 <= len(effects) <= MOST_SATURATED:
            return
        ends = []
        for tenth in WEAK:
            start = [
                math.log(u.starts[tenth * len(u.starts) // 10]) for e in effects for u in e.unknowns
            ]
            end = self._refit(effects, self.nominal, start)
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
        self._keep(whole.effects, whole.fitted)

    def _least(self, whole: Explanation) -> list[int]:
        """Its effects, first the one without which chi-square should rise least."""
        bare = [self.bare(whole, i) for i in range(len(whole.effects))]
        left = [Screen.of(self.problem, e.fitted).left() if e else math.inf for e in bare]
        return [int(i) for i in np.argsort(left)]

    def prune(self) -> None:
        """Try the best explanation without each of its effects, until none can go."""
        while True:
            best = self.ranked()[0]
            if len(best.effects) < 2:
                return
            for i in range(len(best.effects)):
                self.without(best, i)
            if self.ranked()[0].key == best.key:
                return

    def without(self, whole: Explanation, i: int) -> Explanation | None:
        """`whole` less its effect i, refitted."""
        effects = whole.effects[:i] + whole.effects[i + 1 :]
        key = frozenset(e.key for e in effects)
        if key not in self.found:
            model = whole.fitted.model
            first = model.n_nominal + sum(len(e.unknowns) for e in whole.effects[:i])
            gone = range(first, first + len(whole.effects[i].unknowns))
            less = replace(whole.fitted, x=np.delete(whole.fitted.x, list(gone)))
            base = Explanation(effects, less, 0.0)
            end = self._refit(effects, base)
            if end is None:
                return None
            self._keep(effects, end)
        return self.found[key]

    def swap(self, whole: Explanation) -> None:
        """Every effect of `whole` taken out, and every other tried in its place, about where
        `whole` left the rest."""
        enough = whole.fitted.cost + 4 * NEAR * self.temperature
        for i, gone in enumerate(whole.effects):
            base = self.bare(whole, i)
            if base is None:
                continue
            screened = self.screen(base)
            for rank, (drop, effect, starts) in enumerate(screened[: LATER + 1]):
                effects = (*base.effects, effect)
                done = frozenset(e.key for e in effects) in self.found or self._mixed(effects)
                # At the place of what was taken out a simpler law may do what that did.
                there = effect.jump and gone.jump and effect.jump.place == gone.jump.place
                if done or (rank >= ANYHOW and not there and base.fitted.cost - drop > enough):
                    continue
                end = self._refit(effects, base, np.log(starts[0]).tolist(), enough)
                if end is not None:
                    self._keep(effects, end)

    def bare(self, whole: Explanation, i: int) -> Explanation | None:
        """`whole` less its effect i, not refitted."""
        effects = whole.effects[:i] + whole.effects[i + 1 :]
        less = self._model(effects)
        old = whole.fitted.model
        if less is None or less.keys != old.keys:
            return None
        first = old.n_nominal + sum(len(e.unknowns) for e in whole.effects[:i])
        own = range(first, first + len(whole.effects[i].unknowns))
        x = np.delete(whole.fitted.x, list(own))
        h, dh = less.gradient(x, self.problem.at)
        J, r = self.problem.whiten(dh), self.problem.residual(h)
        fitted = Fitted(less, x, float(r @ r), whole.fitted.penalty, J, J.T @ J)
        return Explanation(effects, fitted, 0.0)

    def _nearest(self) -> Explanation:
        """The most probable explanation; where even that leaves much, the one nearest to the lines
        themselves: bins about a gross mismatch hide how well another would do."""
        ranked = self.ranked()
        if self._enough(ranked[0]):
            return ranked[0]
        at = self.grid.at(self.lines.frequency, self.lines.level)

        def left(e: Explanation) -> float:
            return float(np.sum(self.lines.chi_square(e.fitted.model.response(e.fitted.x, at))))

        return min(ranked[:FINALISTS], key=left)

    def _beam(self) -> list[Explanation]:
        ranked = self.ranked()
        best = ranked[0]
        size = len(best.effects)
        near = [e for e in ranked if len(e.effects) == size]
        grown = near[:1] if self._enough(best) else near[:BEAM]
        if size > MIXED:  # many places of one physics may stand for two of different physics
            one = [e for e in ranked if len(e.effects) == 1]
            grown += [e for e in one if e.weight > best.weight - 4 * NEAR][:1]
        return grown

    def _enough(self, explanation: Explanation) -> bool:
        """Whether what an explanation leaves is near what noise would."""
        return explanation.fitted.chi2 < ENOUGH * self.problem.expected

    def renew(self, best: Explanation) -> None:
        """Bins anew about the best explanation until it stands still, for bins about a model that
        is off lead to one that is; and what may still compete refitted on them."""
        keep = [
            e
            for e in self.ranked()[:FIRST]
            if e.weight > best.weight - 4 * NEAR and e.fitted.cost < HOPELESS * best.fitted.cost
        ]
        nominal = self.nominal
        for _ in range(AGAIN):
            self._rebin(best.fitted)
            end = self._refit(best.effects, best)
            if end is None:
                break
            still = best.fitted.away(end) < STILL
            best = replace(best, fitted=end)
            if still:
                break
        self.found.clear()
        for e in {e.key: e for e in (*keep, best, nominal)}.values():
            end = self._refit(e.effects, e)
            if end is not None:
                self._keep(e.effects, end)

    def _rebin(self, fitted: Fitted) -> None:
        """Bins, and aliases, as of this model: those of a rigid joint are not those of one that
        gives, by as little as a large effect leaves room for a small one."""
        old = self.grid
        chain = fitted.model.plain(fitted.x)
        self.grid = grid(self.rig, old.frequency, old.sensor, old.actuator, chain)
        at = self.grid.at(self.lines.frequency)
        shape = fitted.model.response(fitted.x, at)
        misfit = fitted.cost / self.problem.expected
        self.problem = Problem.of(binned(self.lines, shape, misfit=misfit), self.grid)

    def _model(self, effects: tuple[Effect, ...]) -> Model | None:
        """The model with these effects; None if the rig does not allow them together."""
        key = tuple(e.key for e in effects)
        if key not in self._models:
            try:
                self._models[key] = model_of(self.rig, effects)
            except SamiiRigError:
                self._models[key] = None
        return self._models[key]

    def _refit(
        self,
        effects: tuple[Effect, ...],
        base: Explanation,
        more: Sequence[float] = (),
        give_up: float = math.inf,
        *,
        far: bool = True,
    ) -> Fitted | None:
        """From where `base` ended, and `more` logarithms of further unknowns."""
        model = self._model(effects)
        if model is None:
            return None
        return self._from(effects, np.append(_moved(base, model), more), give_up, far=far)

    def _from(
        self,
        effects: tuple[Effect, ...],
        start: Float,
        give_up: float = math.inf,
        steps: int = STEPS,
        *,
        far: bool = True,
    ) -> Fitted | None:
        """From a vector of the model with these effects, which the rig allows together; None where
        that is no rig, or no step can be computed."""
        model = self._model(effects)
        assert model is not None
        try:
            return refit(model, self.problem, start, far=far, give_up=give_up, steps=steps)
        except (SamiiRigError, np.linalg.LinAlgError):
            return None

    def _keep(self, effects: tuple[Effect, ...], fitted: Fitted) -> None:
        if not effects:
            self._gross = fitted.chi2
        made = Explanation(effects, fitted, self.weigh(effects, fitted))
        old = self.found.get(made.key)
        if old is None or made.weight > old.weight:
            self.found[made.key] = made


def _moved(base: Explanation, model: Model) -> Float:
    return moved(base.fitted.model, base.fitted.x, model)
