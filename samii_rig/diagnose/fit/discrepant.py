"""Where every explanation leaves more than noise: what is named is named against a discrepancy.

What no law describes stands beside the noise (`discrepancy`), and all single effects are looked for
again. A second effect would be the discrepancy's. An effect counts only if

- nominal parameters do not stand at values that their tolerances make unlikely: these would do the
  work, not the effect;
- each level and each sensor by itself is explained no worse with it than without. Recordings that
  repeat each other are compared in `agreeing`.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from samii_rig.diagnose.fit.discrepancy import Discrepancy, weighed
from samii_rig.diagnose.fit.explanations import Explanation, named, unlikely
from samii_rig.diagnose.fit.ranking import moved
from samii_rig.diagnose.fit.record_search import RecordProblem, RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.errors import EstimateError
from samii_rig.likelihood.form import Reduced
from samii_rig.types import Int

SCALE_ROUNDS = 3  # of scale and search; two do where the first round finds what is missing
SCALE_STILL = 0.15  # nepers of the scale that are no change: a seventh of an interval of 90 %
KEPT = 12  # explanations that are refitted beside another discrepancy
WORSE = 9.0  # of chi-square, three noise units: a level or sensor that is explained worse


@dataclass(frozen=True, slots=True)
class _Part:
    """What some records or sensors say by themselves. on : (k,) columns of the response that it
    has; form : of these."""

    name: str
    on: Int
    form: Reduced


class DiscrepantSearch(RecordSearch):
    """As `RecordSearch`, what is more than noise taken for a discrepancy."""

    partial = True
    discrepancy = Discrepancy(0.0, 1.0)

    def __init__(self, linear: RecordSearch) -> None:
        self.linear = linear
        super().__init__(linear.whole, linear.by_line)

    def __post_init__(self) -> None:
        self.use(self.linear.table)
        self.stage = self.linear.stage
        assert isinstance(self.linear.problem, RecordProblem)
        self.plain, self._between = self.linear.problem, self.linear._between
        self.problem, self._rig = self.plain, self.linear._rig
        self._shape = self.plain.reduced.reference
        self.keep((), self.linear.nominal.fitted)
        for e in self.linear.ranked():
            if sum(x.physical for x in e.effects) < 2:
                self.keep(e.effects, e.fitted)

    def settle(self) -> None:
        """Scale, length and what is missing, in turn, until they stand still."""
        self._learn()
        for _ in range(SCALE_ROUNDS):
            self.run(briefly=True)
            if self._learn():
                return

    def _learn(self) -> bool:
        """The most likely discrepancy beside the first explanation that holds, and what was found
        refitted; whether it stood still."""
        fit, old = next(e for e in self.ranked() if self.holds(e)).fitted, self.discrepancy
        h, dh = fit.model.gradient(fit.x, self.plain.at)
        there = replace(fit, jacobian=(J := self.plain.whiten(dh)), information=J.T @ J)
        self._shape = h
        new = weighed(self.plain.reduced, h, there, self.plain.residual(h)).discrepancy
        still = (
            new.length == old.length and abs(math.log(new.scale / (old.scale or 1.0))) < SCALE_STILL
        )
        self.discrepancy = new
        self._with_discrepancy()
        ranked = self.ranked()
        self.found = {}
        some = [*ranked[:KEPT], *(e for e in ranked[KEPT:] if not e.effects)]
        for e in self.each(some, lambda e: named(e.effects)):
            end = self.refitted(e.effects, e, far=False)
            self.keep(e.effects, end)
        return still

    def _about(self, fitted: Fitted) -> None:
        super()._about(fitted)
        assert isinstance(self.problem, RecordProblem)
        self.plain = self.problem
        self._shape = self.plain.reduced.reference
        self.__dict__.pop("_levels", None)
        self._with_discrepancy()

    def _with_discrepancy(self) -> None:
        form = self.discrepancy.added_to(self.plain.reduced, self._shape)
        self.problem = replace(self.plain, reduced=form)
        self.__dict__.pop("_parts", None)

    def overdispersion_of(self, fitted: Fitted) -> float:
        """As of `Explanations`: nothing but noise and discrepancy is left."""
        return 1.0

    def ratio(self, fitted: Fitted) -> float:
        """As of `RecordSearch`, in units of the noise alone."""
        r = self.plain.residual(fitted.model.response(fitted.x, self.plain.at))
        return super().ratio(replace(fitted, chi2=float(r @ r)))

    def closed(self, before: Fitted, after: Fitted) -> float:
        """As of `Explanations`, over noise and discrepancy: in units of the noise alone the few
        lines that it is far below count for all."""
        a, b = (super(DiscrepantSearch, self).ratio(f) for f in (before, after))
        return (a - b) / (a - 1) if a > 1 else 0.0

    def holds(self, explanation: Explanation) -> bool:
        """As of `Explanations`: whether it explains each level and each sensor, and not by nominal
        parameters at unlikely values."""
        if not any(e.physical for e in explanation.effects):
            return True
        return not unlikely(explanation.fitted) and not self.worse(explanation)

    def worse(self, explanation: Explanation) -> list[str]:
        """Levels and sensors that by themselves speak against the effects of an explanation.

        With a times the change that its effects make, nominal parameters free, a part has
        a = a_0 +- s. It is explained worse with (a = 1) than without (a = 0) by (1 - 2 a_0)/s^2 of
        chi-square.
        """
        fit = explanation.fitted
        n = fit.model.n_nominal
        real = tuple(e for e in explanation.effects if not e.physical)
        less = self.model(real)
        if less is None:
            return []
        own = [k for i, e in enumerate(explanation.effects) if e.physical for k in fit.model.own(i)]
        x_without = moved(fit.model, np.delete(fit.x, own), less)
        h, dh = fit.model.gradient(fit.x, self.problem.at)
        change = h - less.response(x_without, self.problem.at)
        sd = fit.model.prior[:n]
        out = []
        for part in self._parts:
            on = part.on
            r = np.append(part.form.residual(h[:, on]), fit.x[:n] / sd)
            J = np.concatenate([part.form.slopes(dh[:, on, :n]), np.diag(1 / sd)])
            by = np.append(part.form.slopes(change[:, on, None])[:, 0], np.zeros(n))
            Q = np.linalg.qr(J)[0]
            by, r = by - Q @ (Q.T @ by), r - Q @ (Q.T @ r)
            # a_0 = 1 - by r/|by|^2, s = 1/|by|
            if float(2 * by @ r - by @ by) > WORSE:
                out.append(part.name)
        return out

    @cached_property
    def _parts(self) -> list[_Part]:
        """Each level, and each sensor, with the discrepancy beside the noise."""
        form, sensors = self.plain.reduced, self.whole.wired.sensors
        every = np.arange(form.reference.shape[1])
        found = [_Part(f"{name} alone", every, x) for name, x in self._levels]
        if len(sensors) > 1:  # of several inputs each sensor has a column of each
            each = np.split(every, len(sensors))
            found += [_Part(n, on, _alone(form, on)) for n, on in zip(sensors, each, strict=True)]
        shape = self._shape
        return [replace(p, form=self.discrepancy.added_to(p.form, shape[:, p.on])) for p in found]

    @cached_property
    def _levels(self) -> list[tuple[str, Reduced]]:
        """The likelihood of each level by itself, on the nodes of all, where there are several: not
        of one that is too short to show its noise."""
        whole = self.whole
        assert isinstance(whole, Whole)
        records = whole.by_level().records
        levels = sorted({p.levels for p in records.pieces})
        if len(levels) < 2:
            return []
        fitted, at = self.ranked()[0].fitted, self.plain.reduced.frequency
        out = []
        for level in levels:
            of = [i for i, p in enumerate(records.pieces) if p.levels == level]
            some = replace(
                records,
                pieces=tuple(records.pieces[i] for i in of),
                bands=tuple(records.bands[i] for i in of),
                least=records.longest,
            )
            words = " and ".join(f"{value:g} {unit}" for value, unit in level)
            with suppress(EstimateError):
                out.append((words, replace(whole, records=some).about(fitted, at)))
        return out


def _alone(form: Reduced, on: Int) -> Reduced:
    """What some columns say, whatever the responses in the others are."""
    m = len(form.factor)
    others = np.delete(form.factor, on, axis=1).reshape(m, -1)
    Q = linalg.qr(others)[0][:, others.shape[1] :]
    return replace(
        form,
        reference=form.reference[:, on],
        factor=np.tensordot(Q.T, form.factor[:, on], 1),
        target=Q.T @ form.target,
    )
