"""How promising one more effect is, before it is refitted.

The uncertain parameters and the effects of the model so far are projected out of what it
leaves. The effect is then tried over its whole range, and from its best and its weakest try
one step further along its own derivative: so one that matters only in a narrow range, or
hardly at all, is not passed over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.model import Model
from samii_rig.diagnose.refit import Fitted, Problem
from samii_rig.errors import SamiiRigError
from samii_rig.types import Float

APART = 2.5  # of logarithms: two starts from which different optima may be reached
LONGEST = 3.0  # a step of a logarithm
LOOSE = 1e-3  # precision of an unknown without a prior, which keeps the projection regular
OTHERS = 10  # starts behind the best among which a second is looked for

Start = tuple[float, ...]


@dataclass(frozen=True, slots=True)
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
        rows = np.diag(np.where(known, 1 / prior, LOOSE))
        Q = np.linalg.qr(np.concatenate([base.jacobian, rows]))[0]
        return cls(problem, base, Q, np.where(known, base.x / prior, 0.0))

    def look(self, model: Model, known: Float, effect: Effect) -> tuple[float, list[Start]] | None:
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
            nothing = self._left(np.concatenate([self._base_residual(), self.tail]))
            best = min(tried, key=lambda t: t[0])
            weak = min(tried, key=lambda t: float(np.sum((t[2] - nothing) ** 2)))
            for cost, start, left in {best[1]: best, weak[1]: weak}.values():
                moved, more = self._stepped(model, known, effect, start, left)
                gain = max(gain, self.base.cost - cost + more)
                tried += moved
        tried.sort(key=lambda t: t[0])
        starts = [tried[0][1]]
        other = next((t[1] for t in tried[1:OTHERS] if _apart(t[1], starts[0])), None)
        if other is not None:
            starts.append(other)
        return max(gain, self.base.cost - tried[0][0]), starts

    def _base_residual(self) -> Float:
        return self.problem.residual(self.base.model.response(self.base.x, self.problem.at))

    def _left(self, whole: Float) -> Float:
        return np.asarray(whole - self.directions @ (self.directions.T @ whole))

    def _cost(self, model: Model, known: Float, start: Start) -> tuple[float, Start, Float] | None:
        """Chi-square with the effect at `start`, and what is left."""
        try:
            h = model.response(np.append(known, np.log(start)), self.problem.at)
        except SamiiRigError:
            return None
        r = self.problem.residual(h)
        if not np.all(np.isfinite(r)):
            return None
        left = self._left(np.concatenate([r, self.tail]))
        return float(left @ left), start, left

    def _stepped(
        self, model: Model, known: Float, effect: Effect, start: Start, left: Float
    ) -> tuple[list[tuple[float, Start, Float]], float]:
        """Tries one step along the strength's derivative, and by how much it should help."""
        try:
            _, dh = model.gradient(np.append(known, np.log(start)), self.problem.at)
        except SamiiRigError:
            return [], 0.0
        j = model.n - len(effect.unknowns)
        slope = self.problem.whiten(dh[:, :, j : j + 1])[:, 0]
        slope = self._left(np.concatenate([slope, np.zeros(self.tail.size)]))
        power = float(slope @ slope)
        if not power > 0 or not math.isfinite(power):
            return [], 0.0
        step = -float(slope @ left) / power
        unknown, value = effect.unknowns[0], start[0]
        ways = [value * math.exp(min(max(step, -LONGEST), LONGEST))]
        # Weak effects are linear in a strength or in its inverse.
        ways += [value * (1 + step)] if step > -1 else []
        ways += [value / (1 - step)] if step < 1 else []
        inside = {min(max(w, unknown.low), unknown.high) for w in ways}
        found = [self._cost(model, known, (w, *start[1:])) for w in sorted(inside)]
        return [f for f in found if f is not None], power * step**2 if found else 0.0


def _apart(a: Start, b: Start) -> bool:
    return any(abs(math.log(x / y)) > APART for x, y in zip(a, b, strict=True))
