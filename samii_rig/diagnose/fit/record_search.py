"""The search on whole records: every explanation held against every sample.

Explanations are compared by the likelihood of whole records (`samii_rig.likelihood`) about the
best one so far, made anew whenever that moves. Responses line by line serve for what is seen
better there: a first step from far away, and pictures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np
from scipy import optimize, stats

from samii_rig.diagnose.fit import forms
from samii_rig.diagnose.fit.explanations import FIVE, Explanation, alike, threshold
from samii_rig.diagnose.fit.forms import Form
from samii_rig.diagnose.fit.gap import gap_of
from samii_rig.diagnose.fit.refit import Fitted, Problem, counted, refit
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.fit.usual import RECORDS
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import Grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.rows import RESONANT
from samii_rig.diagnose.result import Band, Gap, Used
from samii_rig.errors import EstimateError
from samii_rig.likelihood.form import Reduced
from samii_rig.likelihood.pieces import Wiring
from samii_rig.likelihood.reduce import LineResiduals
from samii_rig.signal.statistics import octaves
from samii_rig.types import Complex, Float, Int

COOLER = 10**0.5  # times less noise from one refit to the next, where a plain one leaves too much
NOMINAL = "nominal model of whole records"
# Lines at which the nominal model is found before all of them are looked at: a likelihood of so
# many takes 5 s of a core where it needs a thousand nodes, and they tell the noise to 1 %.
FIRST_LINES = 8000
MOST_MADE = 6  # times that the likelihood is made about the nominal model
# Noise units by which a change from the reference may be off between nodes, where it is taken for
# linear, for the likelihood to stand: less than noise makes of one unknown.
OFF_BETWEEN = 0.5
ALARM = 2e-3  # chance that noise alone makes the best of all effects look missing
HIGHEST_CRITICAL = 1e3  # of chi-square, beyond what any table asks for


class Recorded(Protocol):
    """Records as a search needs them: of one state of a rig, or of two."""

    @property
    def wired(self) -> Wiring:
        """Which columns are read."""
        ...

    @property
    def sensor(self) -> Int:
        """(q,) indices into the rig's sensors."""
        ...

    @property
    def lines(self) -> int:
        """Lines of the records that take part."""
        ...

    @property
    def left_out(self) -> tuple[tuple[str, str], ...]:
        """Records that do not, and why."""
        ...

    def about(self, fitted: Fitted) -> Reduced:
        """The likelihood near a fit, on the lines that are fitted."""
        ...

    def nodes(self, found: Reduced, fitted: Fitted) -> Grid:
        """The nodes of a likelihood."""
        ...

    def between(self, found: Reduced, fitted: Fitted) -> Grid:
        """What is between them."""
        ...

    def residuals(self, fitted: Fitted, noise: Reduced, *, shown: bool = False) -> LineResiduals:
        """What a fit leaves, line by line."""
        ...

    @property
    def own_aliases(self) -> bool:
        """Whether every model folds back what is its own from above the rate."""
        ...

    def with_own_aliases(self) -> Recorded:
        """The same, where it does."""
        ...

    def thinned(self, most: int) -> Recorded:
        """The same at so few of its lines that each state has hardly more than `most`."""
        ...

    def showing(self, fitted: Fitted, noise: Reduced) -> Recorded:
        """The same up to the line above which nothing that a fit answers shows in noise."""
        ...


@dataclass(frozen=True)
class RecordProblem(Problem):
    """The likelihood of whole records near a reference. at : the nodes of its contour.

    data, root : of responses line by line; `by_line` is the problem that they pose.
    """

    by_line: Problem = field(kw_only=True)
    reduced: Reduced = field(kw_only=True)

    @classmethod
    def about(cls, whole: Recorded, fitted: Fitted, by_line: Problem) -> RecordProblem:
        """About a fit."""
        found = whole.about(fitted)
        if found.inside[1] < 1:
            raise EstimateError(
                f"the records excite {whole.lines} lines, no more than a response has unknowns, so "
                "nothing shows the noise; a longer record or one that excites a wider band would"
            )
        at = whole.nodes(found, fitted)
        return cls(by_line.data, by_line.root, at, by_line=by_line, reduced=found)

    @property
    def lines(self) -> Problem:
        """As of `Problem`."""
        return self.by_line

    @property
    def expected(self) -> float:
        """As of `Problem`."""
        return self.reduced.known

    def residual(self, h: Complex) -> Float:
        """As of `Problem`."""
        return self.reduced.residual(h)

    def whiten(self, dh: Complex) -> Float:
        """As of `Problem`."""
        return self.reduced.slopes(dh)

    def with_noise_times(self, times: float) -> RecordProblem:
        """The same with noise of so many times the power."""
        root, form = math.sqrt(times), self.reduced
        warm = replace(form, factor=form.factor / root, target=form.target / root)
        return replace(self, reduced=warm)

    def toward(self, h: Complex) -> RecordProblem:
        """As of `Problem`."""
        goal = self.reduced.slopes((h - self.reduced.reference)[:, :, None])[:, 0]
        return replace(self, reduced=replace(self.reduced, target=goal))

    def forms(self, left: Float, directions: Float) -> Callable[[Complex], Form]:
        """As of `Problem`."""
        p, on = self.reduced.factor.shape[0], self.at.changed
        directions = counted(directions)
        turned = directions.T @ left
        F, A = self._by_node
        sides = np.column_stack([left[:p] - directions[:p] @ turned, directions[:p]])
        pull, *turn = (sides.T @ F).reshape(sides.shape[1], A.shape[0], -1)
        power = float(left @ left - turned @ turned)
        along = np.array(turn).reshape(-1, *A.shape[:2])
        return lambda b: forms.Dense.of(b[on], A, pull, along, power, on)

    @cached_property
    def _by_node(self) -> tuple[Float, Float]:
        """(p, n 2 q) the factor, of the nodes that a part changes: of each the real parts of all
        sensors, then imaginary ones; and the products of its columns (n, 2 q, n, 2 q)."""
        F = self.reduced.factor[..., self.at.changed]
        p, q, _, n = F.shape
        F = np.ascontiguousarray(F.transpose(0, 3, 2, 1)).reshape(p, -1)
        return F, (F.T @ F).reshape(n, 2 * q, n, 2 * q)


@lru_cache(maxsize=64)
def _reached(unknowns: tuple[int, ...]) -> float:
    """Chi-square that noise reaches in the best of effects of so many unknowns each, with half of
    `ALARM`: the other half is that of effects that resonate."""

    def false_alarm(t: float) -> float:
        return float(np.sum(stats.chi2.sf(t, unknowns or (1,)))) - ALARM / 2

    return float(optimize.brentq(false_alarm, 1.0, HIGHEST_CRITICAL))


class RecordSearch(Search):
    """As `Search`, on whole records."""

    usual = RECORDS
    _between: tuple[Grid, Complex]  # the middles between nodes, and the reference there
    _of_lines = 1.0  # part of the lines that are looked at

    def __init__(self, whole: Recorded, by_line: Search) -> None:
        self.whole, self.by_line = whole, by_line
        one = by_line
        super().__init__(one.rig, one.lines, one.grid, one.table, progress=one.progress)

    def __post_init__(self) -> None:
        self.use(self.table)
        every, self.whole = self.whole, self.whole.thinned(FIRST_LINES)
        self._of_lines = self.whole.lines / every.lines
        fitted = self._nominal(self.first())
        if self._of_lines < 1:
            every = every.showing(fitted, self.reduced)
        if self.ratio(fitted) > threshold(self.spread):
            fitted = self._cooled(fitted)
        if self._of_lines < 1:
            self.whole = every.with_own_aliases() if self.whole.own_aliases else every
            self._of_lines = 1.0
            fitted = self._nominal(fitted)
        self.keep((), fitted)

    def _nominal(self, fitted: Fitted) -> Fitted:
        """The nominal model refitted with the likelihood about it, from a fit on."""
        self._about(fitted)
        self.stage = NOMINAL
        for made in range(MOST_MADE):
            self.progress(f"{NOMINAL}, fit {made + 1} of at most {MOST_MADE}")
            fitted = refit(fitted.model, self.problem, fitted.x)
            if self._stands(fitted):
                break
            self._about(fitted)
        else:  # a large mismatch: the nominal model is weighed where the likelihood stands now
            fitted = refit(fitted.model, self.problem, fitted.x)
        return fitted

    def _cooled(self, fitted: Fitted) -> Fitted:
        """The same, or a better fit: from the parameters of the rig file on, the noise first taken
        for so large that these fit, then for less and less. Modes that lie near each other lead a
        plain refit to the wrong one."""
        model = fitted.model
        x = np.zeros(model.n)
        before, was = (self.problem, self._between), self.deviance(fitted)
        self._about(self._there(model, x))
        cold = self.problem.expected / max(self._there(model, x).cost, 1.0)
        steps = int(np.ceil(-np.log(min(cold, 1.0)) / np.log(COOLER)))
        warm = range(steps, -1, -1)
        for k in self.each(warm, lambda _: "less noise each time"):
            assert isinstance(self.problem, RecordProblem)
            x = refit(model, self.problem.with_noise_times(COOLER**k), x).x
            now = self._there(model, x)
            if not self._stands(now, COOLER**k):
                self._about(now)
            if self.ratio(now) > COOLER**k:  # less noise than what is left tells nothing more
                break
        now = refit(model, self.problem, x)
        if self.deviance(now) < was:
            return now
        self.problem, self._between = before
        return refit(model, self.problem, fitted.x)

    def deviance(self, fitted: Fitted) -> float:
        """Of a fit with the noise about which the likelihood stands: one that leaves much calls it
        noise, and is right where its noise is weighed too."""
        return fitted.cost + self.reduced.inside[0] + self.reduced.log_determinant

    def _there(self, model: Model, x: Float) -> Fitted:
        return refit(model, self.problem, x, far=False, steps=0)

    def first(self) -> Fitted:
        """Where the nominal model starts."""
        return self.by_line.nominal.fitted

    def _about(self, fitted: Fitted) -> None:
        """The likelihood anew, about a fit."""
        self.problem = RecordProblem.about(self.whole, fitted, self.by_line.problem)
        between = self.whole.between(self.reduced, fitted)
        self._between = between, fitted.model.response(fitted.x, between)
        self._rig = fitted.model.effects

    def _stands(self, fitted: Fitted, times: float = 1.0) -> bool:
        """Whether a fit changes the response as linearly between nodes as the likelihood has it, to
        noise of so many times the power, and to what the fit leaves: where that is more than noise,
        no less can be told from it."""
        there = fitted.model.response(fitted.x, self.problem.at)
        most = self._most_off(fitted, times)
        bends = self._bends(fitted, there)
        # What folds back from above is that of the fit about which the likelihood was made, or of
        # each model itself once that shows.
        own = fitted.model.response(fitted.x, self.whole.nodes(self.reduced, fitted))
        folds = float(np.linalg.norm(self.reduced.slopes((own - there)[:, :, None])))
        if folds >= most and not self.whole.own_aliases:
            self.whole = self.whole.with_own_aliases()
        return bends <= most and folds < most

    def _most_off(self, fitted: Fitted, times: float = 1.0) -> float:
        """Noise units of which a change may be off, of all lines together. times : as of
        `_stands`."""
        return OFF_BETWEEN * math.sqrt(max(times, self.ratio(fitted)) * self._of_lines)

    def _bends(self, fitted: Fitted, there: Complex) -> float:
        """Noise units by which a fit changes the response otherwise than linearly between nodes.
        there : (b, q) its response on these."""
        between, reference = self._between
        middle = fitted.model.response(fitted.x, between) - reference
        return self.reduced.interpolation_error(there - self.reduced.reference, middle)

    @property
    def reduced(self) -> Reduced:
        """The likelihood in use."""
        assert isinstance(self.problem, RecordProblem)
        return self.problem.reduced

    @property
    def spread(self) -> float:
        """As of `Explanations`."""
        free = self.reduced.inside[1]
        return 2.0 / self.problem.expected + 2.0 / free  # the noise is known to so much

    @property
    def critical_value(self) -> float:
        """As of `Explanations`, of what does not resonate: with `ALARM`, noise reaches it in the
        best of the table, or what `critical_value_of` says in what resonates."""
        others = (e for e in self.table if e.physics not in RESONANT)
        return _reached(tuple(max(len(e.unknowns), 1) for e in others))

    def critical_value_of(self, effects: Iterable[Effect]) -> float:
        """As of `Explanations`. What resonates is looked for at every line: as many trials of its
        mass and phase, alike at neighbouring places (a bound of the maximum of a scan; Davies 1987,
        Biometrika 74)."""
        if all(e.physics not in RESONANT for e in effects):
            return self.critical_value
        return max(float(stats.chi2.isf(ALARM / (4 * self.whole.lines), 2)), self.critical_value)

    def ratio(self, fitted: Fitted) -> float:
        """Chi-square per degree of freedom of what a change of the response explains."""
        taken = float(np.trace(np.linalg.solve(fitted.precision(), fitted.information)))
        return fitted.chi2 / max(self.problem.expected - taken, 1.0)

    def inconsistent(self) -> tuple[float, float]:
        """Chi-square per degree of freedom of what no change of one linear response explains, and
        its standard deviation from noise."""
        inside, differing = self.reduced.inside, self.reduced.differing
        each = [(inside, 0.0)] if inside[1] > 0 else []
        if differing[1] > 0:  # whose noise is that of the lines inside, known to so much
            each.append((differing, 1 / max(inside[1], 1.0)))
        found = ((x / mean, math.sqrt(2 / mean + 2 * of)) for (x, mean), of in each)
        return max(found, key=lambda one: (one[0] - 1) / one[1])

    def overdispersion_of(self, fitted: Fitted) -> float:
        """As of `Explanations`."""
        left = self.ratio(fitted)
        if left <= 1 + FIVE * math.sqrt(self.spread):
            return 1.0
        h = fitted.model.response(fitted.x, self.problem.at)
        # What is left in the directions of the nodes, in units of what each would have.
        F = self.reduced.factor
        r = self.problem.residual(h)[: F.shape[0]]
        pull = np.tensordot(r, F, 1) / np.linalg.norm(F, axis=0)
        pull = pull.reshape(-1, F.shape[3]).T
        return left * alike(pull)

    def rebin(self, fitted: Fitted) -> None:
        """The likelihood anew, about this fit, unless the one in use serves: what disturbs the rig
        comes out through it, so that the noise is that of one rig."""
        if not self._stands(fitted) or self._rig != fitted.model.effects:
            self._about(fitted)

    def _nearest(self) -> Explanation:
        return self.ranked()[0]

    def residuals(self, fitted: Fitted, *, shown: bool = False) -> LineResiduals:
        """What a fit leaves, line by line: on the lines that are fitted, or on those shown."""
        return self.whole.residuals(fitted, self.reduced, shown=shown)

    def bands(self, fitted: Fitted) -> tuple[Band, ...]:
        """Chi-square per degree of freedom of each sensor in each octave."""
        left = self.residuals(fitted)
        out = []
        for low, high in octaves(left.frequency):
            inside = (left.frequency >= low) & (left.frequency < high)
            if inside.any():
                top = min(high, float(left.frequency[-1]))
                mean = np.mean(left.each[inside], axis=0)
                names = self.whole.wired.sensors
                out += [Band(n, low, top, float(x)) for n, x in zip(names, mean, strict=True)]
        return tuple(out)

    def used(self) -> Used:
        """Lines of the whole records, test lines too; all that were excited take part."""
        return Used(self.whole.lines, self.whole.lines, self.whole.left_out)

    def shown(self, before: Fitted, after: Fitted) -> tuple[float, float, Gap]:
        """On the test lines: chi-square per degree of freedom of both, and the gap closed."""
        a = self.residuals(before, shown=True).chi2
        b = a if after is before else self.residuals(after, shown=True).chi2
        floor = np.full(a.size, 2.0 * self.whole.sensor.size)
        mean = float(np.sum(floor))
        return float(np.sum(a)) / mean, float(np.sum(b)) / mean, gap_of(a, b, floor)

    def at_lines(self, explanation: Explanation) -> Explanation:
        """An explanation of records as one of responses line by line."""
        fitted, problem = explanation.fitted, self.by_line.problem
        h, dh = fitted.model.gradient(fitted.x, problem.at)
        J, r = problem.whiten(dh), problem.residual(h)
        there = replace(fitted, chi2=float(r @ r), jacobian=J, information=J.T @ J)
        return replace(explanation, fitted=there)
