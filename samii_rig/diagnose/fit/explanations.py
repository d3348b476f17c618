"""Explanations of one set of lines: refitted jointly with the rig's own parameters, and weighed.

What is the same for all of them is here: the bins in which lines are looked at, the prior and the
overdispersion. Which are tried is the search's (`search`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeVar

import numpy as np
from scipy import stats

from samii_rig.diagnose.data.measured import Measured, binned
from samii_rig.diagnose.fit.ranking import moved
from samii_rig.diagnose.fit.refit import STEPS, Fitted, Problem, refit
from samii_rig.diagnose.fit.stated import IN_DATA
from samii_rig.diagnose.fit.usual import Usual
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import Grid, grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import SamiiRigError
from samii_rig.progress import Begun, Progress, counted
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

PRIOR = (0.5, 0.4, 0.02)  # before the data: of nothing, one, two effects missing
FEWER = 0.05  # of each further effect
FAULTY = 0.4  # before the data, of each that is in how the records were made
NEAR_BEST = 25.0  # of the logarithm of evidence: explanations further below the best are let go
FIVE = 5.0  # standard deviations of chi-square beyond which what is left is more than noise
CORRELATED, MOST_ALIKE = 0.1, 40  # correlation that counts; bins or nodes over which it is sought
UNEXPLAINED = 3e-4  # chance that noise alone leaves more than the threshold
AT_END = 1e-3  # of a nominal parameter's range, from its end
EXACT = 4e-4  # of the mismatch: what beams, sensors and integrators are modelled to

T = TypeVar("T")


def unlikely(fitted: Fitted) -> bool:
    """Whether nominal parameters stand where their tolerances make it unlikely: together, or one of
    them at the end of its range."""
    n = fitted.model.n_nominal
    x, low, high = fitted.x[:n], fitted.model.lower[:n], fitted.model.upper[:n]
    if np.any(np.minimum(x - low, high - x) < AT_END * (high - low)):
        return True
    return fitted.penalty > float(stats.chi2.isf(UNEXPLAINED, n)) if n else False


def threshold(spread: float) -> float:
    """Chi-square per degree of freedom that noise alone exceeds as rarely as `UNEXPLAINED` says.
    spread : its relative variance."""
    return float(stats.gamma.isf(UNEXPLAINED, 1 / spread, scale=spread))


def alike(r: Float | Complex) -> float:
    """The integrated autocorrelation of what a model leaves, r (n, p) by frequency in units of the
    noise: 1 and twice the sum of its correlations, up to the first below `CORRELATED`."""
    power = float(np.sum(np.abs(r) ** 2))
    found = 1.0
    for lag in range(1, min(MOST_ALIKE, len(r) - 1)):
        rho = float(np.sum(r[lag:] * r[:-lag].conj()).real) / power
        if rho < CORRELATED:
            break
        found += 2 * rho
    return found


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


def named(effects: Iterable[Effect]) -> str:
    """Some effects, in words."""
    every = [f"{e.physics.replace('_', ' ')} at {e.site}" for e in effects]
    return " and ".join(every) or "nothing"


@dataclass
class Explanations:
    """All explanations of one set of lines that were refitted.

    lines : those that are fitted. grid : of all frequencies. table : all single effects.
    found : every explanation that was refitted, by key. progress : is told what is tried in each
    round of a `stage`.
    """

    rig: Rig
    lines: Measured
    grid: Grid
    table: Sequence[Effect]
    found: dict[frozenset[str], Explanation] = field(default_factory=dict)
    problem: Problem = field(init=False)
    overdispersion: float = 1.0
    progress: Progress = lambda _stage: None
    stage: str = "nominal model"
    partial: ClassVar[bool] = False  # whether all that can be told leaves much of the mismatch
    usual: ClassVar[Usual] = {}  # how long the rest takes, by where it is
    _round: int = 0
    _nominal_chi2: float = 0.0  # chi-square that the nominal model leaves
    _rows: Counter[str] = field(init=False)
    _total: dict[str, float] = field(init=False)
    _models: dict[tuple[str, ...], Model | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.use(self.table)
        model = Model(self.rig)
        at = self.grid.at(self.lines.frequency)
        x = np.zeros(model.n)
        shape = model.response(x, at)
        self.problem = Problem.of(binned(self.lines, shape, misfit=math.inf), self.grid)
        nominal = refit(model, self.problem, x)
        self.rebin(nominal)
        self.keep((), refit(model, self.problem, nominal.x))

    def begin(self, stage: str, takes: tuple[float, float] | None = None) -> None:
        """Say that a stage begins. takes : as of `Begun`."""
        self.stage, self._round = stage, 0
        self.progress(Begun(stage, self.usual.get(stage), takes))

    def each(self, parts: Sequence[T], name: Callable[[T], str] = lambda _: "") -> Iterator[T]:
        """The parts of one round of the stage, each said before it is tried. How many rounds there
        will be nobody knows."""
        if len(parts) > 1:
            self._round += 1
            here = f"{self.stage}, round {self._round}"
            if here in self.usual:
                self.progress(Begun(here, self.usual[here]))
        within = f"round {max(self._round, 1)}"
        return counted(parts, self.progress, self.stage, name, within)

    def use(self, table: Sequence[Effect]) -> None:
        """Another table, with a prior even over the rows of that."""
        self.table = table
        self._rows = Counter(e.physics for e in table)
        self._total = {p: sum(e.weight for e in table if e.physics == p) for p in self._rows}

    @property
    def nominal(self) -> Explanation:
        """Nothing is missing."""
        return self.found[frozenset()]

    def meant(self, effects: Iterable[Effect]) -> Explanation | None:
        """The nominal model of what was meant to be recorded: with what is no physics of some
        effects; None where that was not refitted."""
        return self.found.get(frozenset(e.key for e in effects if not e.physical))

    def ranked(self) -> list[Explanation]:
        """All explanations, the most probable first."""
        return sorted(self.found.values(), key=lambda e: -e.weight)

    def weigh(self, effects: Iterable[Effect], fitted: Fitted) -> float:
        """Logarithm of evidence times prior, less what effects beside the first must be worth
        where the mismatch is large: they may not live on what models are not exact to."""
        effects = tuple(effects)
        # What is wrong with the data is mended exactly: beside it the rest is what counts.
        meant = self.meant(effects)
        left = meant.fitted.chi2 if meant and meant.effects else self._nominal_chi2
        beside = self.model_error_penalty(effects, left)
        small = sum(
            unknown.small(float(fitted.x[at]))
            for i, e in enumerate(effects)
            for unknown, at in zip(e.unknowns, fitted.model.own(i), strict=True)
        )
        return fitted.evidence(self.overdispersion) + small + self.log_prior(effects) - beside

    def model_error_penalty(self, effects: Sequence[Effect], nominal_chi2: float) -> float:
        """Logarithm of evidence that effects beside the first must be worth on lines where the
        nominal model of what was meant to be recorded leaves `nominal_chi2`; and the first, in the
        place of what is wrong with the data. Two explanations that differ by d sigma differ by d^2
        of chi-square, and a model's error of e sigma moves that by 2 d e at most: by less than d^2
        where d is more than 2 e."""
        beside = max(len(effects) - 1, 0)
        instead = 4 if effects and all(e.physical for e in effects) else 0
        return 0.5 * EXACT**2 * nominal_chi2 / self.overdispersion * (beside + instead)

    def log_prior(self, effects: Iterable[Effect]) -> float:
        """Before the data: of how many, which rows, which sites of a row. What is no physics has
        nothing to do with how much is missing of the rig."""
        effects = tuple(effects)
        n = sum(e.physical for e in effects)
        prior = PRIOR[n] if n < len(PRIOR) else PRIOR[-1] * FEWER ** (n - len(PRIOR) + 1)
        each = (math.log(e.weight / self._total[e.physics] / len(self._rows)) for e in effects)
        faults = (len(effects) - n) * math.log(FAULTY)
        return math.log(prior) + faults + math.lgamma(n + 1) + sum(each)

    def take_overdispersion(self) -> None:
        """Take the overdispersion of the explanation that fits best, and weigh all anew.

        What even that leaves is a part of the truth that is not in the table, and has structure
        along frequency: lines count by how much they and their neighbours say that is new.
        """
        best = min(self.found.values(), key=lambda e: e.fitted.cost)
        self.overdispersion = self.overdispersion_of(best.fitted)
        for key, e in self.found.items():
            self.found[key] = replace(e, weight=self.weigh(e.effects, e.fitted))

    @property
    def critical_value(self) -> float:
        """Chi-square that an effect must explain of the data to be called missing."""
        return IN_DATA

    def critical_value_of(self, effects: Iterable[Effect]) -> float:
        """The same of these effects, as far as their physics asks for more."""
        return self.critical_value

    @property
    def spread(self) -> float:
        """Relative variance of chi-square over all lines."""
        return self.lines.spread

    def overdispersion_of(self, fitted: Fitted) -> float:
        """Chi-square per degree of freedom times the bins over which what is left is alike; 1
        where noise would leave as much."""
        left = self.ratio(fitted)
        if left <= 1 + FIVE * math.sqrt(self.spread):
            return 1.0
        h = fitted.model.response(fitted.x, self.problem.at)
        r = (self.problem.root @ (h - self.problem.data.H)[:, :, None])[:, :, 0]
        return left * alike(r)

    def holds(self, explanation: Explanation) -> bool:
        """Whether it may be told at all, however probable it is."""
        return True

    def closed(self, before: Fitted, after: Fitted) -> float:
        """Part of what one leaves over the noise that the other explains."""
        a, b = self.ratio(before), self.ratio(after)
        return (a - b) / (a - 1) if a > 1 else 0.0

    def ratio(self, fitted: Fitted) -> float:
        """Chi-square per degree of freedom over all lines, also inside the bins."""
        found, mean = self.problem.data.inside
        # Directions that the data determine take chi-square away.
        taken = float(np.trace(np.linalg.solve(fitted.precision(), fitted.information)))
        return (fitted.chi2 + found) / max(self.problem.expected + mean - taken, 1.0)

    def model(self, effects: tuple[Effect, ...]) -> Model | None:
        """The model with these effects; None if the rig does not allow them together."""
        key = tuple(e.key for e in effects)
        if key not in self._models:
            try:
                self._models[key] = self.made(effects)
            except SamiiRigError:
                self._models[key] = None
        return self._models[key]

    def made(self, effects: tuple[Effect, ...]) -> Model:
        """The model with these effects. Raises SamiiRigError."""
        return Model(self.rig, effects)

    def refitted(
        self,
        effects: tuple[Effect, ...],
        base: Explanation,
        more: Sequence[float] = (),
        give_up: float = math.inf,
        *,
        far: bool = True,
    ) -> Fitted | None:
        """From where `base` ended, and `more` logarithms of further unknowns."""
        model = self.model(effects)
        if model is None:
            return None
        start = np.append(moved(base.fitted.model, base.fitted.x, model), more)
        return self.refitted_from(effects, start, give_up, far=far)

    def refitted_from(
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
        model = self.model(effects)
        assert model is not None
        try:
            return refit(model, self.problem, start, far=far, give_up=give_up, steps=steps)
        except (SamiiRigError, np.linalg.LinAlgError):
            return None

    def keep(self, effects: tuple[Effect, ...], fitted: Fitted | None) -> None:
        """Weigh it, and keep it unless the same effects were refitted to more weight. fitted : None
        where a refit ended in none, of which nothing is kept."""
        if fitted is None:
            return
        if not effects:
            self._nominal_chi2 = fitted.chi2
        made = Explanation(effects, fitted, self.weigh(effects, fitted))
        old = self.found.get(made.key)
        if old is None or made.weight > old.weight:
            self.found[made.key] = made

    def without(self, whole: Explanation, i: int) -> Explanation | None:
        """`whole` less its effect i, refitted."""
        effects = whole.effects[:i] + whole.effects[i + 1 :]
        key = frozenset(e.key for e in effects)
        if key not in self.found:
            gone = list(whole.fitted.model.own(i))
            less = replace(whole.fitted, x=np.delete(whole.fitted.x, gone))
            base = Explanation(effects, less, 0.0)
            end = self.refitted(effects, base)
            if end is None:
                return None
            self.keep(effects, end)
        return self.found[key]

    def without_refit(self, whole: Explanation, i: int) -> Explanation | None:
        """`whole` less its effect i, not refitted."""
        effects = whole.effects[:i] + whole.effects[i + 1 :]
        less = self.model(effects)
        old = whole.fitted.model
        if less is None or less.keys != old.keys:
            return None
        x = np.delete(whole.fitted.x, list(old.own(i)))
        h, dh = less.gradient(x, self.problem.at)
        J, r = self.problem.whiten(dh), self.problem.residual(h)
        fitted = Fitted(less, x, float(r @ r), whole.fitted.penalty, J, J.T @ J)
        return Explanation(effects, fitted, 0.0)

    def linear_part(self, best: Explanation) -> tuple[Explanations, Explanation]:
        """Where linear effects can be weighed beside `best`, and the linear part of it there."""
        return self, best

    def rebin(self, fitted: Fitted) -> None:
        """Bins, and aliases, as of this model: those of a rigid joint are not those of one that
        gives, by as little as a large effect leaves room for a small one."""
        old = self.grid
        chain = fitted.model.plain(fitted.x)
        self.grid = grid(self.rig, old.frequency, old.sensor, old.actuator, chain)
        at = self.grid.at(self.lines.frequency)
        shape = fitted.model.response(fitted.x, at)
        misfit = fitted.cost / self.problem.expected
        self.problem = Problem.of(binned(self.lines, shape, misfit=misfit), self.grid)
