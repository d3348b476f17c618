"""Two states of a rig under one set of nominal parameters: the likelihoods of both, summed.

An effect is in the state after alone. Nominal parameters are in both, so their errors cancel. The
sum is exact: the nodes of both likelihoods stand one behind the other, and a model predicts both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.fit.summed import Stacked, Summed, parts_of
from samii_rig.diagnose.fit.usual import STATES
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import Grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Gap
from samii_rig.likelihood.form import Reduced
from samii_rig.likelihood.pieces import Wiring
from samii_rig.likelihood.reduce import LineResiduals
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, Int


@dataclass(frozen=True, slots=True)
class BothGrid(Stacked):
    """The rows of the state after, then those of the state before."""

    @property
    def split(self) -> int:
        """How many are of the state after."""
        return self.sizes[0]

    @property
    def changed(self) -> slice:
        """As of `Grid`."""
        return slice(0, self.split)


class States(Model):
    """A rig before, and the same with effects after; x is the vector of the model before, then what
    is free after alone, then the logarithms of the effects' unknowns.

    after : rig file of the state after. It differs from that before by what is known of each.
    """

    def __init__(self, before: Model, after: Rig, effects: Sequence[Effect] = ()) -> None:
        super().__init__(after, effects)
        self.before, self.after = before, Model(after, effects)
        own, n = self.after.n_nominal, before.n
        # Parameters that a state does not have, or that are known there, are the other's alone.
        more = [i for i, key in enumerate(self.after.keys) if key not in before.keys]
        self.keys = (*before.keys, *(self.after.keys[i] for i in more))
        self.n_nominal = n + len(more)
        self.n = self.n_nominal + self.after.n - own
        at = [self.keys.index(key) for key in self.after.keys]
        self.on = np.array([*at, *range(self.n_nominal, self.n)], np.int64)
        free = [*more, *range(own, self.after.n)]
        self.prior = np.append(before.prior, self.after.prior[free])
        self.lower = np.append(before.lower, self.after.lower[free])
        self.upper = np.append(before.upper, self.after.upper[free])

    def having(self, effects: Sequence[Effect]) -> Model:
        """As of `Model`."""
        return States(self.before, self.rig, effects)

    def under(self, change: Callable[[Rig], Rig]) -> Model:
        """As of `Model`."""
        return States(self.before.under(change), change(self.rig), self.effects)

    def parts(self, x: Float) -> list[Float]:
        """As of `Model`."""
        return self.after.parts(x[self.on])

    def values(self, x: Float) -> dict[tuple[str, str], float]:
        """As of `Model`, in the state after."""
        return self.after.values(x[self.on])

    def response(self, x: Float, at: Grid) -> Complex:
        """As of `Model`; on a grid of one state, after."""
        if not isinstance(at, BothGrid):
            return self.after.response(x[self.on], at)
        after, before = at.parts()
        each = (
            self.after.response(x[self.on], after),
            self.before.response(x[: self.before.n], before),
        )
        return np.concatenate(each)

    def gradient(self, x: Float, at: Grid) -> tuple[Complex, Complex]:
        """As of `Model`."""
        both = isinstance(at, BothGrid)
        after, before = at.parts() if isinstance(at, BothGrid) else (at, at)
        h, dh = self.after.gradient(x[self.on], after)
        slopes = np.zeros((*h.shape, self.n), complex)
        slopes[:, :, self.on] = dh
        if not both:
            return h, slopes
        h_before, dh = self.before.gradient(x[: self.before.n], before)
        more = np.zeros((*h_before.shape, self.n), complex)
        more[:, :, : self.before.n] = dh
        return np.concatenate([h, h_before]), np.concatenate([slopes, more])


def _after(fitted: Fitted) -> Fitted:
    """A fit of both as a model of the state after. Its derivatives stay those of both."""
    model = fitted.model
    assert isinstance(model, States)
    return replace(fitted, model=model.after, x=fitted.x[model.on])


def _before(fitted: Fitted) -> Fitted:
    model = fitted.model
    assert isinstance(model, States)
    return replace(fitted, model=model.before, x=fitted.x[: model.before.n])


@dataclass(frozen=True)
class Both:
    """The records of two states.

    alike : whether the state before holds what no model explains, and the state after is taken to
    hold the same; then what counts is what the two responses differ by.
    """

    after: Whole
    before: Whole
    alike: bool = False

    @property
    def wired(self) -> Wiring:
        """As of `Recorded`; the same of both."""
        return self.after.wired

    @property
    def sensor(self) -> Int:
        """As of `Recorded`."""
        return self.after.sensor

    @property
    def lines(self) -> int:
        """As of `Recorded`."""
        return self.after.lines + self.before.lines

    @property
    def left_out(self) -> tuple[tuple[str, str], ...]:
        """As of `Recorded`."""
        return self.after.left_out + self.before.left_out

    @property
    def own_aliases(self) -> bool:
        """As of `Recorded`."""
        return self.after.own_aliases

    def with_own_aliases(self) -> Both:
        """As of `Recorded`."""
        return replace(
            self, after=self.after.with_own_aliases(), before=self.before.with_own_aliases()
        )

    def thinned(self, most: int) -> Both:
        """As of `Recorded`."""
        return replace(self, after=self.after.thinned(most), before=self.before.thinned(most))

    def showing(self, fitted: Fitted, noise: Reduced) -> Both:
        """As of `Recorded`, of either state."""
        after, before = parts_of(noise)
        top = max(
            self.after.shown_to(_after(fitted), after),
            self.before.shown_to(_before(fitted), before),
        )
        return replace(self, after=self.after.up_to(top), before=self.before.up_to(top))

    def about(self, fitted: Fitted) -> Summed:
        """As of `Recorded`."""
        before = self.before.about(_before(fitted))
        after = self.after.about(_after(fitted), before.frequency if self.alike else None)
        return Summed.of([after, before], alike=self.alike)

    def nodes(self, found: Reduced, fitted: Fitted) -> Grid:
        """As of `Recorded`."""
        after, before = parts_of(found)
        return BothGrid.of(
            [self.after.nodes(after, _after(fitted)), self.before.nodes(before, _before(fitted))]
        )

    def between(self, found: Reduced, fitted: Fitted) -> Grid:
        """As of `Recorded`."""
        after, before = parts_of(found)
        each = (
            self.after.between(after, _after(fitted)),
            self.before.between(before, _before(fitted)),
        )
        return BothGrid.of(each)

    def residuals(self, fitted: Fitted, noise: Reduced, *, shown: bool = False) -> LineResiduals:
        """As of `Recorded`, of the state after: there a change shows."""
        return self.after.residuals(_after(fitted), parts_of(noise)[0], shown=shown)


class StatesSearch(RecordSearch):
    """As `RecordSearch`, for what changed between two states.

    before : a fit of the state before, from which all start. by_line : of the state after.
    """

    usual = STATES

    def __init__(self, both: Both, by_line: Search, before: Fitted) -> None:
        self._common, self._alike = before, both.alike
        super().__init__(both, by_line)

    def shown(self, before: Fitted, after: Fitted) -> tuple[float, float, Gap]:
        """As of `RecordSearch`; where what no model explains is alike in both states it is known
        on the lines that are fitted alone, and these are shown."""
        if not self._alike:
            return super().shown(before, after)
        a, b = self.ratio(before), self.ratio(after)
        closed = (a - b) / (a - 1) if a > 1 else a - b
        return a, b, Gap(closed, closed, closed, of_noise=a <= 1)

    def by_state(self) -> list[tuple[Whole, Fitted, Float]]:
        """The records after and before, the nominal model of each, and the nodes of their
        likelihoods."""
        both, fitted = self.whole, self.nominal.fitted
        assert isinstance(both, Both)
        after, before = (part.frequency for part in parts_of(self.reduced))
        return [(both.after, _after(fitted), after), (both.before, _before(fitted), before)]

    def first(self) -> Fitted:
        """As of `RecordSearch`."""
        model, x = self.made(()), self._common.x
        return replace(self._common, model=model, x=np.append(x, np.zeros(model.n - x.size)))

    def made(self, effects: tuple[Effect, ...]) -> Model:
        """As of `Explanations`."""
        return States(self._common.model, self.rig, effects)
