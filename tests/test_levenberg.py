"""The one damped least squares: known minima, bounds, what nothing depends on, and damping."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from samii_rig.levenberg import ByFactor, ByGain, Normal, descend, minimise, step
from samii_rig.types import Float

Evaluated = Callable[[Float], tuple[Float, Float]]
FREE = (np.full(2, -np.inf), np.full(2, np.inf))


def rosenbrock(x: Float) -> tuple[Float, Float]:
    """Minimum 0 at (1, 1), at the end of a curved valley."""
    a, b = x
    return np.array([10 * (b - a * a), 1 - a]), np.array([[-20 * a, 10.0], [-1.0, 0.0]])


def beale(x: Float) -> tuple[Float, Float]:
    """Minimum 0 at (3, 1/2)."""
    a, b = x
    n = np.arange(1, 4)
    r = np.array([1.5, 2.25, 2.625]) - a * (1 - b**n)
    return r, np.stack([b**n - 1, a * n * b ** (n - 1)], axis=1)


def jennrich(x: Float) -> tuple[Float, Float]:
    """Jennrich and Sampson: minimum 124.362 at (0.2578, 0.2578), residuals that do not vanish."""
    i = np.arange(1, 11)
    e = np.exp(i[:, None] * x)
    return 2 + 2 * i - e.sum(axis=1), -i[:, None] * e


@pytest.mark.parametrize(
    ("problem", "start", "end", "cost"),
    [
        (rosenbrock, (-1.2, 1.0), (1.0, 1.0), 0.0),
        (beale, (1.0, 1.0), (3.0, 0.5), 0.0),
        (jennrich, (0.3, 0.4), (0.2578, 0.2578), 124.362),
    ],
)
def test_known_minima_are_found(problem: Evaluated, start, end, cost: float) -> None:
    """More, Garbow and Hillstrom, ACM Trans. Math. Software 7, 1981: problems 1, 5 and 6."""
    found = minimise(problem, np.array(start), *FREE)
    assert found.converged
    assert found.x == pytest.approx(end, abs=1e-4)
    assert 2 * found.cost == pytest.approx(cost, abs=1e-3)
    assert found.jacobian == pytest.approx(problem(found.x)[1])


def test_slopes_are_asked_for_where_a_step_was_not_refused_alone() -> None:
    tried, asked = [], []

    def lazily(x: Float) -> tuple[Float, Callable[[], Float]]:
        tried.append(x)
        r, J = rosenbrock(x)
        return r, lambda: asked.append(x) or J

    found, other = (minimise(f, np.array([-1.2, 1.0]), *FREE) for f in (lazily, rosenbrock))
    np.testing.assert_array_equal(found.x, other.x)
    np.testing.assert_array_equal(found.jacobian, other.jacobian)
    assert len(asked) < len(tried)


def test_the_minimum_on_a_bound_is_that_along_the_bound() -> None:
    """Rosenbrock with a <= 1/2: b = a^2 there."""
    found = minimise(rosenbrock, np.array([-1.2, 1.0]), FREE[0], np.array([0.5, np.inf]))
    assert found.converged
    assert found.x == pytest.approx([0.5, 0.25], abs=1e-6)


def test_a_parameter_that_nothing_depends_on_stays() -> None:
    found = minimise(
        lambda x: (np.array([x[0] - 2.0]), np.array([[1.0, 0.0]])), np.array([0.0, 7.0]), *FREE
    )
    assert found.converged
    assert found.x == pytest.approx([2.0, 7.0])


def test_a_step_of_many_problems_at_once_is_that_of_each() -> None:
    rng = np.random.default_rng(1)
    J = rng.normal(size=(4, 7, 3)) * [1.0, 1e2, 1e-2]
    A, g = J.swapaxes(1, 2) @ J, rng.normal(size=(4, 3))
    added = 0.1 * np.einsum("mkk->mk", A)
    every = step(A, g, added)
    for i in range(4):
        assert step(A[i], g[i], added[i]) == pytest.approx(every[i])
        assert (A[i] + np.diag(added[i])) @ every[i] == pytest.approx(-g[i], rel=1e-9)


def test_damping_by_gain_is_less_the_better_the_linear_model() -> None:
    good, poor = ByGain(1.0).after(1.0, 1.0), ByGain(1.0).after(0.3, 1.0)
    assert good.value == pytest.approx(1 / 9)
    assert poor.value == pytest.approx(1 + 0.4**3)
    refused = ByGain(1.0).after(-1.0, 1.0).after(-1.0, 1.0).after(-1.0, 1.0)
    assert refused.value == pytest.approx(2 * 4 * 8)
    assert refused.after(1.0, 1.0).growth == 2.0


def test_damping_by_factors_has_a_floor() -> None:
    law = ByFactor(1.0, shrink=0.1, grow=5.0, least=0.05)
    assert law.after(1.0, 1.0).after(1.0, 1.0).value == 0.05
    assert law.after(-1.0, 1.0).value == 5.0


class At:
    """x and x^2, where the model exists: |x| < 3."""

    def __init__(self, x: float) -> None:
        self.x, self.cost = np.array([x]), x * x


def test_where_the_model_has_nothing_to_say_a_shorter_step_is_tried() -> None:
    asked: list[float] = []

    def trial(now: At, by: Normal, damping: float) -> At | None:
        asked.append(damping)
        x = float(now.x[0] - 10 / (1 + damping))
        return At(x) if abs(x) < 3 else None

    end = descend(
        At(2.5),
        lambda now: Normal(np.eye(1), now.x),
        trial,
        lambda p: p.gain > 0,
        ByFactor(0.5, shrink=0.5, grow=2.0),
        trials=20,
    )
    assert asked == [0.5, 1.0, 2.0]  # to -4.2, where there is no model; to -2.5, no better; to -0.8
    assert end.settled
    assert end.at.x == pytest.approx(2.5 - 10 / 3)


def test_a_descent_ends_after_so_many_tries_from_one_point_and_says_that_it_did_not_settle() -> (
    None
):
    asked = []

    def trial(now: At, by: Normal, damping: float) -> At:
        asked.append(damping)
        return At(10.0)

    by = ByFactor(1.0, shrink=0.5, grow=2.0)
    end = descend(
        At(1.0), lambda now: Normal(np.eye(1), now.x), trial, lambda p: False, by, trials=9, tries=3
    )
    assert asked == [1.0, 2.0, 4.0]
    assert not end.settled
    assert end.at.cost == 1.0


def test_a_cost_that_is_no_number_is_refused() -> None:
    def trial(now: At, by: Normal, damping: float) -> At:
        return At(math.nan)

    by = ByFactor(1.0, shrink=0.5, grow=2.0)
    end = descend(
        At(1.0), lambda now: Normal(np.eye(1), now.x), trial, lambda p: False, by, trials=4
    )
    assert end.at.cost == 1.0
