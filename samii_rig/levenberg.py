"""Damped least squares by the method of Levenberg and Marquardt: every local fit of the project.

With residuals r, their Jacobian J, A = J^T J and g = J^T r a step d solves

    (A + lambda D^2) d = -g.                                                            (1)

The damping lambda shrinks after a step that lowers the cost r^T r and grows after one that does
not. D, how far a step may go and when a descent ends are the problem's; nothing else differs.
More, The Levenberg-Marquardt algorithm: implementation and theory, 1978. Nielsen, Damping parameter
in Marquardt's method, report IMM-REP-1999-05, 1999.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from samii_rig.types import Float

FASTEST = 1 / 9  # of lambda, kept after a step that gained what the linear model expects: Nielsen's
TRIALS = 60  # of `minimise` at most; 4 to 15 are usual
NEAR = 1e-3  # first damping of `minimise`, of the squared norm of a column: near the minimum
LEAST_SCALE = 1e-8  # of the largest norm: a parameter that nothing depends on stays in place
AGREES = 0.25  # of the decrease that the linear model expects, at least, to end there
TINY = 1e-300  # keeps a row that nothing depends on from being divided by 0


class Point(Protocol):
    """Parameters x (k,) and the cost there."""

    @property
    def x(self) -> Float:
        """(k,)."""
        ...

    @property
    def cost(self) -> float:
        """r^T r, with what stands for priors."""
        ...


@dataclass(frozen=True, slots=True)
class Normal:
    """The normal equations at a point. A : (k, k). g : (k,), half the gradient of the cost."""

    A: Float
    g: Float

    def expected(self, d: Float) -> float:
        """By how much the linear model says that a step d lowers the cost."""
        return -float(2 * d @ self.g + d @ self.A @ d)

    def held(self, x: Float, lower: Float, upper: Float) -> NDArray[np.bool_]:
        """(k,) whether a bound keeps a parameter from moving downhill."""
        return np.asarray(((x <= lower) & (self.g > 0)) | ((x >= upper) & (self.g < 0)))


def step(A: Float, g: Float, added: Float) -> Float:
    """(..., k) d of equation (1), solved in scaled unknowns: only the noise takes digits.

    A : (..., k, k). g : (..., k). added : (..., k), lambda D^2. Raises LinAlgError.
    """
    k = np.arange(g.shape[-1])
    damped = A.copy()
    damped[..., k, k] += added
    size = np.sqrt(np.maximum(damped[..., k, k], TINY))
    scaled = damped / (size[..., :, None] * size[..., None, :])
    return np.asarray(-np.linalg.solve(scaled, (g / size)[..., None])[..., 0] / size)


class Damping(Protocol):
    """lambda, and what becomes of it."""

    @property
    def value(self) -> float:
        """The lambda of the next step."""
        ...

    def after(self, gain: float, expected: float) -> Damping:
        """After a step that lowered the cost by `gain`, or did not where that is not positive."""
        ...


@dataclass(frozen=True, slots=True)
class ByGain:
    """Nielsen's: less, the nearer a step came to what was expected; more and more if it failed."""

    value: float
    growth: float = 2.0

    def after(self, gain: float, expected: float) -> ByGain:
        """As of `Damping`."""
        if not gain > 0:
            return ByGain(self.value * self.growth, 2 * self.growth)
        ratio = gain / expected if expected > 0 else 0.0
        return ByGain(self.value * max(FASTEST, 1 - (2 * ratio - 1) ** 3))


@dataclass(frozen=True, slots=True)
class ByFactor:
    """Fixed factors. least : below which it never falls."""

    value: float
    shrink: float
    grow: float
    least: float = 0.0

    def after(self, gain: float, expected: float) -> ByFactor:
        """As of `Damping`."""
        factor = self.shrink if gain > 0 else self.grow
        return replace(self, value=max(self.value * factor, self.least))


@dataclass(frozen=True, slots=True)
class Progress:
    """What a trial brought: gain of cost (not positive where it was refused), what was expected,
    the cost now, and how many steps were taken."""

    gain: float
    expected: float
    cost: float
    steps: int


P = TypeVar("P", bound=Point)
N = TypeVar("N", bound=Normal)


@dataclass(frozen=True, slots=True)
class Descent(Generic[P, N]):
    """Where a descent ended, with the normal equations there, and whether it had settled."""

    at: P
    normal: N
    settled: bool


def descend(
    start: P,
    normal: Callable[[P], N],
    trial: Callable[[P, N, float], P | None],
    settled: Callable[[Progress], bool],
    damping: Damping,
    *,
    trials: int,
    tries: int | None = None,
) -> Descent[P, N]:
    """The minimum that `start` leads to.

    normal : the equations at a point.
    trial : the point after a step by these equations with this lambda, within the bounds; the very
        same point where no step is left, None where the model has nothing to say.
    settled : whether that is the end.
    trials : in all. tries : from one point, at most.
    """
    now, equations = start, normal(start)
    steps = failed = 0
    for _ in range(trials):
        new = trial(now, equations, damping.value)
        if new is now:
            return Descent(now, equations, True)
        gain, expected = -np.inf, 0.0
        if new is not None:
            gain, expected = now.cost - new.cost, equations.expected(new.x - now.x)
        damping = damping.after(gain, expected)
        if new is not None and gain > 0:
            now, equations = new, normal(new)
            steps, failed = steps + 1, 0
        else:
            failed += 1
        if new is not None and settled(Progress(gain, expected, now.cost, steps)):
            return Descent(now, equations, True)
        if failed == tries:
            break
    return Descent(now, equations, False)


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where one start led: x, half the sum of squares there, the residuals' Jacobian."""

    x: Float
    cost: float
    jacobian: Float
    converged: bool


def minimise(
    evaluated: Callable[[Float], tuple[Float, Float | Callable[[], Float]]],
    start: Float,
    lower: Float,
    upper: Float,
    *,
    tolerance: float = 1e-9,
    damping: float = NEAR,
    trials: int = TRIALS,
) -> Minimum:
    """A local minimum of the sum of squares within bounds.

    The normal equations: with a few parameters they cost nothing beside the model. The columns are
    scaled by their largest norms so far (More). Each step moves the parameters that no bound holds
    and ends at the bounds (projection).

    evaluated : residuals (n,) and their Jacobian (n, k) at x, or what computes that, which is
        asked for where a step was not refused.
    tolerance : of the cost and of x, relative, at which it ends.
    damping : the first one, of the squared norm of a column. trials : at most.
    """
    norms, J = np.zeros(start.size), np.zeros((0, start.size))  # J where the last step went

    def point(x: Float) -> _Evaluated:
        r, J = evaluated(x)
        return _Evaluated(x, float(r @ r), r, J)

    def normal(now: _Evaluated) -> Normal:
        nonlocal J
        J = now.J() if callable(now.J) else now.J
        by = Normal(J.T @ J, J.T @ now.r)
        np.maximum(norms, np.sqrt(np.diagonal(by.A)), out=norms)
        return by

    def trial(now: _Evaluated, by: Normal, damping: float) -> _Evaluated | None:
        floor = LEAST_SCALE * float(norms.max(initial=0.0)) + np.finfo(float).tiny
        on = np.flatnonzero(~by.held(now.x, lower, upper))
        x, added = now.x.copy(), damping * np.maximum(norms, floor)[on] ** 2
        x[on] += step(by.A[np.ix_(on, on)], by.g[on], added)
        x = np.clip(x, lower, upper)
        size = float(np.linalg.norm(x - now.x))
        if size < tolerance * (tolerance + float(np.linalg.norm(now.x))):
            return now
        # A bound may turn a long step uphill; a short one follows the gradient and goes down.
        return point(x) if by.expected(x - now.x) > 0 else None

    def settled(p: Progress) -> bool:
        if p.gain > 0:
            return p.gain < tolerance * (p.cost + p.gain) and p.gain > AGREES * p.expected
        return p.expected < tolerance * p.cost

    first = point(np.clip(start, lower, upper))
    end = descend(first, normal, trial, settled, ByGain(damping), trials=trials)
    return Minimum(end.at.x, end.at.cost / 2, J, end.settled)


@dataclass(frozen=True, slots=True)
class _Evaluated:
    """x, r^T r, the residuals r and their Jacobian J there, or what computes it."""

    x: Float
    cost: float
    r: Float
    J: Float | Callable[[], Float]
