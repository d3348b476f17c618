"""Two states of a rig under one set of nominal parameters: the likelihoods of both, summed.

An effect is in the state after alone. Nominal parameters are in both, so their errors cancel. The
sum is exact: the nodes of both likelihoods stand one behind the other, and a model predicts both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import linalg

from samii_rig.diagnose.fit.records import RecordSearch, Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Grid, Model
from samii_rig.diagnose.result import Gap
from samii_rig.likelihood.pieces import Wiring
from samii_rig.likelihood.reduce import Left, Reduced, by_sensor
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, Int

RANK = 1e-10  # of the largest, a direction of rounding alone


@dataclass(frozen=True, slots=True)
class BothGrid(Grid):
    """The rows of the state after, `split` of them, then those of the state before."""

    split: int = field(kw_only=True)

    @classmethod
    def of(cls, after: Grid, before: Grid) -> BothGrid:
        """Two grids as one."""
        each = (after, before)
        return cls(
            frequency=np.concatenate([g.frequency for g in each]),
            factor=np.concatenate([g.factor for g in each]),
            aliases=np.concatenate([g.aliases for g in each]),
            folded=np.concatenate([g.folded for g in each], axis=1),
            rate_hz=after.rate_hz,
            sensor=after.sensor,
            actuator=after.actuator,
            sigma=np.concatenate([np.full(g.frequency.size, g.sigma) for g in each]),
            loop=after.loop,
            split=after.frequency.size,
        )

    @property
    def changed(self) -> slice:
        """As of `Grid`."""
        return slice(0, self.split)

    def parts(self) -> tuple[Grid, Grid]:
        """After, before."""
        sigma = np.broadcast_to(self.sigma, self.frequency.shape)
        after, before = (
            Grid(
                self.frequency[own], self.factor[own], self.aliases[own], self.folded[:, own],
                self.rate_hz, self.sensor, self.actuator, sigma=sigma[own], loop=self.loop,
            )
            for own in (slice(0, self.split), slice(self.split, None))
        )  # fmt: skip
        return after, before


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


@dataclass(frozen=True, slots=True)
class BothReduced(Reduced):
    """The likelihoods of two states, summed. each : after, before."""

    each: tuple[Reduced, Reduced]

    @classmethod
    def of(cls, after: Reduced, before: Reduced, *, alike: bool) -> BothReduced:
        """alike : what no model explains is free at every node, and the same in both states, which
        have the same nodes."""
        (m, q, _, a), (n, _, _, b) = after.factor.shape, before.factor.shape
        factor = np.zeros((m + n, q, 2, a + b))
        factor[:m, :, :, :a] = after.factor
        factor[m:, :, :, a:] = before.factor
        target = np.concatenate([after.target, before.target])
        known = after.known + before.known
        inside = tuple(x + y for x, y in zip(after.inside, before.inside, strict=True))
        differing = tuple(x + y for x, y in zip(after.differing, before.differing, strict=True))
        if alike:
            common = (factor[..., :a] + factor[..., a:]).reshape(m + n, -1)
            rest, rank = _beside(common)
            factor = (rest.T @ factor.reshape(m + n, -1)).reshape(-1, q, 2, a + b)
            target, known = rest.T @ target, known - rank
        return cls(
            np.concatenate([after.frequency, before.frequency]), after.sigma,
            np.concatenate([after.reference, before.reference]), factor, target, known,
            (inside[0], inside[1]), after.noise, (differing[0], differing[1]), (after, before),
        )  # fmt: skip

    def slopes(self, dh: Complex) -> Float:
        """As of `Reduced`."""
        flat = by_sensor(dh)
        return np.asarray(self.factor.reshape(-1, len(flat)) @ flat)

    def bent(self, d: Complex, middle: Complex) -> float:
        """As of `Reduced`."""
        after, before = self.each
        n = after.frequency.size
        return math.hypot(after.bent(d[:n], middle[: n - 1]), before.bent(d[n:], middle[n - 1 :]))


def _beside(columns: Float) -> tuple[Float, int]:
    """Orthonormal directions (m, m - rank) that no column (m, n) has, and the rank."""
    scale = np.linalg.norm(columns, axis=0)
    Q, R, _ = linalg.qr(columns / np.where(scale > 0, scale, 1.0), pivoting=True)
    size = np.abs(np.diagonal(R))
    rank = int(np.count_nonzero(size > RANK * size[0]))
    return np.asarray(Q[:, rank:]), rank


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

    def about(self, fitted: Fitted) -> BothReduced:
        """As of `Recorded`."""
        before = self.before.about(_before(fitted))
        after = self.after.about(_after(fitted), before.frequency if self.alike else None)
        return BothReduced.of(after, before, alike=self.alike)

    def nodes(self, found: Reduced, fitted: Fitted) -> Grid:
        """As of `Recorded`."""
        after, before = _parts(found)
        return BothGrid.of(
            self.after.nodes(after, _after(fitted)), self.before.nodes(before, _before(fitted))
        )

    def between(self, found: Reduced, fitted: Fitted) -> Grid:
        """As of `Recorded`."""
        after, before = _parts(found)
        return BothGrid.of(
            self.after.between(after, _after(fitted)), self.before.between(before, _before(fitted))
        )

    def left(self, fitted: Fitted, noise: Reduced, *, shown: bool = False) -> Left:
        """As of `Recorded`, of the state after: there a change shows."""
        return self.after.left(_after(fitted), _parts(noise)[0], shown=shown)


def _parts(found: Reduced) -> tuple[Reduced, Reduced]:
    assert isinstance(found, BothReduced)
    return found.each


class StatesSearch(RecordSearch):
    """As `RecordSearch`, for what changed between two states.

    before : a fit of the state before, from which all start. by_line : of the state after.
    """

    def __init__(self, both: Both, by_line: Search, before: Fitted) -> None:
        self._common, self._alike = before, both.alike
        super().__init__(both, by_line)

    def shown(self, before: Fitted, after: Fitted) -> tuple[float, float, Gap]:
        """As of `RecordSearch`; where what no model explains is alike in both states it is known
        on the lines that are fitted alone, and these are shown."""
        if not self._alike:
            return super().shown(before, after)
        a, b = self.ratio(before), self.ratio(after)
        closed = (a - b) / (a - 1) if a > 1 else 0.0
        return a, b, Gap(closed, closed, closed)

    def first(self) -> Fitted:
        """As of `RecordSearch`."""
        model, x = self.made(()), self._common.x
        return replace(self._common, model=model, x=np.append(x, np.zeros(model.n - x.size)))

    def made(self, effects: tuple[Effect, ...]) -> Model:
        """As of `Explanations`."""
        return States(self._common.model, self.rig, effects)
