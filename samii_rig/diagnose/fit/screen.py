"""How promising one more effect is, before it is refitted.

The uncertain parameters and the effects of the model so far are projected out of what it
leaves. A part that acts through one complex number at each frequency, or a factor on a channel,
is tried over its whole range without a further response of the chain (`moebius`), and its best
trials are brought to their optimum. Any other effect is tried at its starts, and from its best
and its weakest try one step further along its own derivative: so one that matters only in a
narrow range, or hardly at all, is not passed over.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy import linalg

from samii_rig.diagnose.fit import forms
from samii_rig.diagnose.fit.forms import (
    DESCENT_ENDS,
    DESCENT_ROUNDS,
    FORM_DAMPING,
    LONGEST_STEP,
    Form,
    bounded_step,
)
from samii_rig.diagnose.fit.moebius import Place
from samii_rig.diagnose.fit.refit import Fitted, Problem
from samii_rig.diagnose.physics.effect import Effect, Unknown
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import SamiiRigError
from samii_rig.levenberg import Normal, Progress, descend
from samii_rig.types import Complex, Float

DISTINCT_STARTS = 2.5  # of logarithms: two starts from which different optima may be reached
LOOSE = 1e-3  # precision of an unknown without a prior, which keeps the projection regular
OTHER_STARTS = 10  # starts behind the best among which a second is looked for
CHEAP_TRIALS = 4  # times as many trials as starts where they cost next to nothing
TRIALS_ABOUT = (1 / 12, 1.0, 8.0)  # trials about an only start
MANY = 20  # starts that are already fine
MINIMA = 2  # trials that are brought to their optimum
DISTINCT_MINIMA = 0.7  # of a logarithm: trials near different minima
SECOND = 0.6  # of the best try's gain: less is no start of its own

Start = tuple[float, ...]
Found = tuple[float, list[Start]]
Tried = tuple[float, Start, Float]  # chi-square, where, and what is left


@dataclass(frozen=True, slots=True)
class _Point:
    """Logarithms x of an effect's unknowns, chi-square there, and what is left."""

    x: Float
    cost: float
    left: Float


@dataclass(frozen=True)
class Screen:
    """What a fit leaves, and the directions (n, m) that it may still move in for nothing."""

    problem: Problem
    base: Fitted
    directions: Float
    tail: Float

    @classmethod
    def of(cls, problem: Problem, base: Fitted) -> Screen:
        """The screen about a fit."""
        prior = base.model.prior
        known = np.isfinite(prior)
        m, n = base.jacobian.shape
        both = np.zeros((m + n, n), order="F")  # is itself turned into Q: of long records 100 MB
        both[:m], both[m:] = base.jacobian, np.diag(np.where(known, 1 / prior, LOOSE))
        Q, _ = linalg.qr(both, overwrite_a=True, mode="economic", check_finite=False)
        return cls(problem, base, np.asarray(Q), np.where(known, base.x / prior, 0.0))

    def of_data(self) -> Screen:
        """As if the effect were all there is: the data are what the fit predicts, and moves of the
        parameters away from it cost what their priors say."""
        problem = self.problem.toward(self.response)
        return replace(self, problem=problem, tail=np.zeros_like(self.tail))

    def unprojected(self) -> Screen:
        """With no direction projected out."""
        return replace(self, directions=self.directions[:, :0])

    @cached_property
    def response(self) -> Complex:
        """(n, q) of the fit."""
        return self.base.model.response(self.base.x, self.problem.at)

    @cached_property
    def s(self) -> Complex:
        """(n,) rad/s."""
        return self.problem.at.s

    def residual(self) -> Float:
        """What the fit leaves of data and priors, with the directions projected out."""
        return self._projected(self._whole_residual)

    def chi_square(self) -> float:
        """Chi-square of what the fit leaves, with the directions projected out."""
        left = self._projected(self._whole_residual)
        return float(left @ left)

    def through(self, place: Place, effect: Effect, fixed: Start = ()) -> Found | None:
        """`tried` for a part at a place. fixed : unknowns that belong to the place."""
        assert effect.jump is not None
        x_of = effect.jump.x
        own = np.array(fixed)

        def phi(values: Float) -> Complex:
            whole = np.concatenate([values, np.tile(own, (len(values), 1))], axis=1)
            return place.phi(x_of(self.s, whole))

        found = self._over(place.b, phi, effect.unknowns[: len(effect.unknowns) - own.size])
        return found and (found[0], [(*start, *fixed) for start in found[1]])

    def channel(self, effect: Effect) -> Found | None:
        """`tried` for a factor on a channel."""
        return self._over(*self.factor(effect), effect.unknowns)

    def factor(self, effect: Effect) -> tuple[Complex, Callable[[Float], Complex]]:
        """b (n, q) of a factor on a channel, and phi (m, n) of its unknowns (m, k)."""
        factor = effect.factor
        assert factor is not None
        model, at = self.base.model, self.problem.at
        on = model.entries(factor, at)
        plain = self.base.model.response(self.base.x, at.without_aliases())
        b = np.zeros_like(plain)
        rows = at.changed
        b[rows, on] = plain[rows, on]
        c = np.zeros(len(b), complex)
        if at.loop is not None:
            b, c = at.loop.part(plain, b)

        def phi(values: Float) -> Complex:
            x = np.stack([factor.value(self.s, one)[0] - 1 for one in values])
            return Place(b, c).phi(x)

        return b, phi

    def _over(
        self, b: Complex, phi: Callable[[Float], Complex], unknowns: tuple[Unknown, ...]
    ) -> Found | None:
        """All of a fine grid over the unknowns, and the optima that its best lead to."""
        form = self.form(b)
        finer = CHEAP_TRIALS if len(unknowns) < 3 else 1
        trials = np.array(list(product(*(_fine(u, finer) for u in unknowns))))
        with np.errstate(all="ignore"):
            cost = form.cost(phi(trials))
        order = np.argsort(cost)
        if not math.isfinite(cost[order[0]]):
            return None
        if not unknowns:
            return self.base.cost - float(cost[0]), [()]
        y = np.log(trials)
        chosen = [int(order[0])]
        for i in order[1:]:
            if len(chosen) == MINIMA or not math.isfinite(cost[i]):
                break
            if all(np.max(np.abs(y[i] - y[j])) > DISTINCT_MINIMA for j in chosen):
                chosen.append(int(i))
        with np.errstate(all="ignore"):
            end, at = forms.descend(form, phi, y[chosen], cost[chosen], unknowns)
        best = np.argsort(end)
        gain = self.base.cost - end
        starts = [at[best[0]]]
        for i in best[1:]:
            distinct = np.max(np.abs(at[i] - starts[0])) > DISTINCT_MINIMA
            if distinct and gain[i] > SECOND * gain[best[0]] and len(starts) < 2:
                starts.append(at[i])
        return float(gain[best[0]]), [tuple(np.exp(y).tolist()) for y in starts]

    def form(self, b: Complex) -> Form:
        """Chi-square as a function of phi."""
        key = b.tobytes()
        if key not in self._made:
            self._made[key] = self._forms(b)
        return self._made[key]

    @cached_property
    def _forms(self) -> Callable[[Complex], Form]:
        return self.problem.forms(self._whole_residual, self.directions)

    @cached_property
    def _made(self) -> dict[bytes, Form]:
        """Forms of parts that were asked for: laws at one place have one."""
        return {}

    @cached_property
    def _whole_residual(self) -> Float:
        """What the fit leaves of the data and of the priors, in noise units."""
        return np.concatenate([self._base_residual(), self.tail])

    def tried(self, model: Model, known: Float, effect: Effect) -> Found | None:
        """How far chi-square falls with `effect`, the last of `model`, and where to start.

        known : the model's vector but for that effect's unknowns. None if nothing can be had.
        """
        tried = [
            found
            for start in product(*(u.starts for u in effect.unknowns))
            if (found := self._cost(model, known, start)) is not None
        ]
        if not tried:
            return None
        gain = 0.0
        if effect.unknowns:
            nothing = self._projected(self._whole_residual)
            best = min(tried, key=lambda t: t[0])
            weak = min(tried, key=lambda t: float(np.sum((t[2] - nothing) ** 2)))
            for cost, start, left in {best[1]: best, weak[1]: weak}.values():
                moved, more = self._stepped(model, known, effect, start, left)
                gain = max(gain, self.base.cost - cost + more)
                tried += moved
        tried.sort(key=lambda t: t[0])
        if len(effect.unknowns) > 1:
            tried.insert(0, self._descended(model, known, effect, tried[0]))
        starts = [tried[0][1]]
        other = next((t[1] for t in tried[1:OTHER_STARTS] if _distinct(t[1], starts[0])), None)
        if other is not None:
            starts.append(other)
        return max(gain, self.base.cost - tried[0][0]), starts

    def _base_residual(self) -> Float:
        return self.problem.residual(self.response)

    def _projected(self, whole: Float) -> Float:
        return np.asarray(whole - self.directions @ (self.directions.T @ whole))

    def _cost(self, model: Model, known: Float, start: Start) -> Tried | None:
        """Chi-square with the effect at `start`, and what is left."""
        try:
            left = self.residual_with(model, np.append(known, np.log(start)))
        except SamiiRigError:
            return None
        return (float(left @ left), start, left) if np.all(np.isfinite(left)) else None

    def residual_with(self, model: Model, x: Float) -> Float:
        """What a model with another effect leaves, with the directions projected out."""
        r = self.problem.residual(model.response(x, self.problem.at))
        return self._projected(np.concatenate([r, self.tail]))

    def _descended(self, model: Model, known: Float, effect: Effect, best: Tried) -> Tried:
        """The best try after a few damped Gauss-Newton steps in all of the effect's unknowns."""
        first = model.n - len(effect.unknowns)
        low, high = np.log([(u.low, u.high) for u in effect.unknowns]).T

        def normal(now: _Point) -> Normal:
            _, dh = model.gradient(np.append(known, now.x), self.problem.at)
            slopes = self.problem.whiten(dh[:, :, first:])
            J = self._projected(np.concatenate([slopes, np.zeros((self.tail.size, now.x.size))]))
            return Normal(J.T @ J, J.T @ now.left)

        def trial(now: _Point, by: Normal, damping: float) -> _Point | None:
            nonlocal best
            if not np.all(np.isfinite(by.A)):
                return now
            x = np.clip(now.x + bounded_step(by.A, by.g, damping), low, high)
            new = self._cost(model, known, tuple(np.exp(x).tolist()))
            if new is None:
                return None
            best = min(best, new, key=lambda t: t[0])
            return _Point(x, new[0], new[2])

        def settled(p: Progress) -> bool:
            return 0 < p.gain < DESCENT_ENDS

        start = _Point(np.log(best[1]), best[0], best[2])
        with suppress(SamiiRigError):  # no derivative there: the best so far is it
            descend(start, normal, trial, settled, FORM_DAMPING, trials=DESCENT_ROUNDS)
        return best

    def _stepped(
        self, model: Model, known: Float, effect: Effect, start: Start, left: Float
    ) -> tuple[list[Tried], float]:
        """Tries one step along the strength's derivative, and by how much it should help."""
        try:
            _, dh = model.gradient(np.append(known, np.log(start)), self.problem.at)
        except SamiiRigError:
            return [], 0.0
        j = model.n - len(effect.unknowns)
        slope = self.problem.whiten(dh[:, :, j : j + 1])[:, 0]
        slope = self._projected(np.concatenate([slope, np.zeros(self.tail.size)]))
        power = float(slope @ slope)
        if not power > 0 or not math.isfinite(power):
            return [], 0.0
        step = -float(slope @ left) / power
        unknown, value = effect.unknowns[0], start[0]
        ways = [value * math.exp(min(max(step, -LONGEST_STEP), LONGEST_STEP))]
        # Weak effects are linear in a strength or in its inverse.
        ways += [value * (1 + step)] if step > -1 else []
        ways += [value / (1 - step)] if step < 1 else []
        inside = {min(max(w, unknown.low), unknown.high) for w in ways}
        found = [self._cost(model, known, (w, *start[1:])) for w in sorted(inside)]
        return [f for f in found if f is not None], power * step**2 if found else 0.0


def _fine(unknown: Unknown, finer: int) -> Float:
    """Values at which an effect is tried where a try costs next to nothing."""
    starts = np.array(unknown.starts)
    if starts.size == 1:
        return np.asarray(np.clip(starts * TRIALS_ABOUT, unknown.low, unknown.high))
    if starts.size >= MANY:
        return starts
    return np.append(np.geomspace(unknown.low, unknown.high, finer * starts.size), starts[-1])


def _distinct(a: Start, b: Start) -> bool:
    return any(abs(math.log(x / y)) > DISTINCT_STARTS for x, y in zip(a, b, strict=True))
