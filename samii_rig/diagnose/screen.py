"""How promising one more effect is, before it is refitted.

The uncertain parameters and the effects of the model so far are projected out of what it
leaves. A part that acts through one complex number at each frequency, or a factor on a channel,
is tried over its whole range without a further response of the chain (`moebius`), and its best
tries are brought to their optimum. Any other effect is tried at its starts, and from its best
and its weakest try one step further along its own derivative: so one that matters only in a
narrow range, or hardly at all, is not passed over.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from samii_rig.diagnose.effect import Effect, Unknown
from samii_rig.diagnose.model import Model
from samii_rig.diagnose.moebius import Place
from samii_rig.diagnose.refit import Fitted, Problem
from samii_rig.errors import SamiiRigError
from samii_rig.types import Complex, Float

APART = 2.5  # of logarithms: two starts from which different optima may be reached
LONGEST = 3.0  # a step of a logarithm
LOOSE = 1e-3  # precision of an unknown without a prior, which keeps the projection regular
OTHERS = 10  # starts behind the best among which a second is looked for
FINER = 4  # times as many tries as starts where they cost next to nothing
WIDER = (1 / 12, 1.0, 8.0)  # tries about an only start
MANY = 20  # starts that are already fine
VALLEYS = 2  # tries that are brought to their optimum
VALLEY = 0.7  # of a logarithm: tries in different valleys
ROUNDS = 6  # of that, at most
SETTLED = 0.05  # of chi-square, gained in one of them: less and they end
STEP = 1e-4  # of a logarithm, for derivatives of a law
SECOND = 0.6  # of the best try's gain: less is no start of its own

Start = tuple[float, ...]
Found = tuple[float, list[Start]]
Tried = tuple[float, Start, Float]  # chi-square, where, and what is left


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
        rows = np.diag(np.where(known, 1 / prior, LOOSE))
        Q = np.linalg.qr(np.concatenate([base.jacobian, rows]))[0]
        return cls(problem, base, Q, np.where(known, base.x / prior, 0.0))

    @cached_property
    def response(self) -> Complex:
        """(n, q) of the fit."""
        return self.base.model.response(self.base.x, self.problem.at)

    @cached_property
    def s(self) -> Complex:
        """(n,) rad/s."""
        return np.asarray(2j * np.pi * self.problem.at.frequency, np.complex128)

    def left(self) -> float:
        """Chi-square of what the fit leaves, with the directions projected out."""
        r, _, whole = self._parts
        return float(np.sum(np.abs(r) ** 2) + np.sum(self.tail**2) - np.sum(whole**2))

    def through(self, place: Place, effect: Effect, fixed: Start = ()) -> Found | None:
        """`look` for a part at a place. fixed : unknowns that belong to the place."""
        assert effect.jump is not None
        x_of = effect.jump.x
        own = np.array(fixed)

        def phi(values: Float) -> Complex:
            whole = np.concatenate([values, np.tile(own, (len(values), 1))], axis=1)
            return place.phi(x_of(self.s, whole))

        found = self._over(place.b, phi, effect.unknowns[: len(effect.unknowns) - own.size])
        return found and (found[0], [(*start, *fixed) for start in found[1]])

    def channel(self, effect: Effect) -> Found | None:
        """`look` for a factor on a channel."""
        factor = effect.factor
        assert factor is not None
        model, at = self.base.model, self.problem.at
        on = model.entries(effect, at)
        b = np.zeros_like(self.response)
        b[:, on] = (self.response - at.aliases)[:, on]

        def phi(values: Float) -> Complex:
            return np.stack([factor.value(self.s, one)[0] - 1 for one in values])

        return self._over(b, phi, effect.unknowns)

    def _over(
        self, b: Complex, phi: Callable[[Float], Complex], unknowns: tuple[Unknown, ...]
    ) -> Found | None:
        """All of a fine grid over the unknowns, and the optima that its best lead to."""
        quad = self._quadratic(b)
        finer = FINER if len(unknowns) < 3 else 1
        tries = np.array(list(product(*(_fine(u, finer) for u in unknowns))))
        with np.errstate(all="ignore"):
            cost, _ = quad.cost(phi(tries))
        order = np.argsort(cost)
        if not math.isfinite(cost[order[0]]):
            return None
        if not unknowns:
            return self.base.cost - float(cost[0]), [()]
        y = np.log(tries)
        chosen = [int(order[0])]
        for i in order[1:]:
            if len(chosen) == VALLEYS or not math.isfinite(cost[i]):
                break
            if all(np.max(np.abs(y[i] - y[j])) > VALLEY for j in chosen):
                chosen.append(int(i))
        with np.errstate(all="ignore"):
            end, at = quad.descend(phi, y[chosen], cost[chosen], unknowns)
        best = np.argsort(end)
        gain = self.base.cost - end
        starts = [at[best[0]]]
        for i in best[1:]:
            apart = np.max(np.abs(at[i] - starts[0])) > VALLEY
            if apart and gain[i] > SECOND * gain[best[0]] and len(starts) < 2:
                starts.append(at[i])
        return float(gain[best[0]]), [tuple(np.exp(y).tolist()) for y in starts]

    def _quadratic(self, b: Complex) -> _Quadratic:
        """Chi-square as a function of phi."""
        v = (self.problem.root @ b[:, :, None])[:, :, 0]
        r, Q, whole = self._parts
        P = np.einsum("nqj,nq->nj", Q, v)
        return _Quadratic(
            lin=np.sum(r.conj() * v, axis=1),
            square=np.sum(np.abs(v) ** 2, axis=1),
            P=P,
            power=float(np.sum(np.abs(r) ** 2) + np.sum(self.tail**2)),
            q=whole,
        )

    @cached_property
    def _parts(self) -> tuple[Complex, Complex, Float]:
        """What is left (n, q), the directions' conjugates (n, q, m), and their product (m,)."""
        e = self.response - self.problem.data.H
        r = (self.problem.root @ e[:, :, None])[:, :, 0]
        half = r.size
        Q = self.directions
        conj = (Q[:half] - 1j * Q[half : 2 * half]).reshape(*r.shape, -1)
        whole = Q.T @ np.concatenate([r.real.ravel(), r.imag.ravel(), self.tail])
        return r, conj, whole

    def look(self, model: Model, known: Float, effect: Effect) -> Found | None:
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
        if len(effect.unknowns) > 1:
            tried.insert(0, self._descended(model, known, effect, tried[0]))
        starts = [tried[0][1]]
        other = next((t[1] for t in tried[1:OTHERS] if _apart(t[1], starts[0])), None)
        if other is not None:
            starts.append(other)
        return max(gain, self.base.cost - tried[0][0]), starts

    def _base_residual(self) -> Float:
        return self.problem.residual(self.response)

    def _left(self, whole: Float) -> Float:
        return np.asarray(whole - self.directions @ (self.directions.T @ whole))

    def _cost(self, model: Model, known: Float, start: Start) -> Tried | None:
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

    def _descended(self, model: Model, known: Float, effect: Effect, best: Tried) -> Tried:
        """The best try after a few damped Gauss-Newton steps in all of the effect's unknowns."""
        first = model.n - len(effect.unknowns)
        low, high = np.log([(u.low, u.high) for u in effect.unknowns]).T
        damping = 1e-2
        for _ in range(ROUNDS):
            cost, start, left = best
            y = np.log(start)
            try:
                _, dh = model.gradient(np.append(known, y), self.problem.at)
            except SamiiRigError:
                break
            slopes = self.problem.whiten(dh[:, :, first:])
            J = self._left(np.concatenate([slopes, np.zeros((self.tail.size, y.size))]))
            A = J.T @ J
            A[np.diag_indices(y.size)] += damping * np.diag(A) + 1e-9 * np.max(np.diag(A)) + 1e-30
            if not np.all(np.isfinite(A)):
                break
            step = np.clip(-np.linalg.solve(A, J.T @ left), -LONGEST, LONGEST)
            new = self._cost(model, known, tuple(np.exp(np.clip(y + step, low, high)).tolist()))
            if new is None or new[0] >= cost:
                damping *= 30
                continue
            best, damping = new, damping * 0.1
            if cost - new[0] < SETTLED:
                break
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


@dataclass(frozen=True, slots=True)
class _Quadratic:
    """Chi-square with directions projected out, of residuals r + v phi.

    lin (n,) : conj(r) v. square (n,) : |v|^2. P (n, m) : directions on v. power, q (m,) : of r.
    """

    lin: Complex
    square: Float
    P: Complex
    power: float
    q: Float

    def cost(self, phi: Complex) -> tuple[Float, Float]:
        """(m,) of phi (m, n), and the directions' parts."""
        q = self.q + (phi @ self.P).real
        power = self.power + 2 * (phi @ self.lin).real + (np.abs(phi) ** 2) @ self.square
        cost = power - np.sum(q**2, axis=1)
        return np.where(np.isfinite(cost), cost, np.inf), q

    def descend(
        self,
        phi_of: Callable[[Float], Complex],
        y: Float,
        cost: Float,
        unknowns: tuple[Unknown, ...],
    ) -> tuple[Float, Float]:
        """Chi-square and logarithms (m, k) after a few damped Gauss-Newton steps from y."""
        low, high = np.log([(u.low, u.high) for u in unknowns]).T
        m, k = y.shape
        damping = np.full(m, 1e-2)
        for turn in range(ROUNDS):
            ahead = (y[:, None, :] + STEP * np.eye(k)).reshape(-1, k)
            every = phi_of(np.exp(np.concatenate([y, ahead])))
            phi = every[:m]
            d = (every[m:].reshape(m, k, -1) - phi[:, None, :]) / STEP
            q = self.q + (phi @ self.P).real
            own = (d @ self.P).real
            pull = self.lin.conj() + self.square * phi
            g = np.einsum("mkn,mn->mk", d.conj(), pull).real - np.einsum("mkj,mj->mk", own, q)
            H = ((d.conj() * self.square) @ d.swapaxes(1, 2)).real - own @ own.swapaxes(1, 2)
            diagonal = np.einsum("mkk->mk", H)
            tiny = 1e-9 * np.max(np.abs(diagonal), axis=1, initial=1e-30)[:, None]
            A = H + (damping[:, None] * np.abs(diagonal) + tiny)[:, :, None] * np.eye(k)
            if not (np.all(np.isfinite(A)) and np.all(np.isfinite(g))):
                break
            step = np.clip(-np.linalg.solve(A, g[:, :, None])[:, :, 0], -LONGEST, LONGEST)
            new = np.clip(y + step, low, high)
            there, _ = self.cost(phi_of(np.exp(new)))
            better = there < cost
            settled = turn > 0 and not np.any(cost - there > SETTLED)
            y = np.where(better[:, None], new, y)
            cost = np.where(better, there, cost)
            damping = np.where(better, damping * 0.1, damping * 30)
            if settled:
                break
        return cost, y


def _fine(unknown: Unknown, finer: int) -> Float:
    """Values at which an effect is tried where a try costs next to nothing."""
    starts = np.array(unknown.starts)
    if starts.size == 1:
        return np.asarray(np.clip(starts * WIDER, unknown.low, unknown.high))
    if starts.size >= MANY:
        return starts
    return np.append(np.geomspace(unknown.low, unknown.high, finer * starts.size), starts[-1])


def _apart(a: Start, b: Start) -> bool:
    return any(abs(math.log(x / y)) > APART for x, y in zip(a, b, strict=True))
