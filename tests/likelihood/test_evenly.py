"""Whether a change explains all lines alike."""

from __future__ import annotations

import numpy as np

from samii_rig.likelihood.unexplained import Unexplained, evenly

LINES, SENSORS, SAMPLES = 300, 2, 4000


def chance(rng: np.random.Generator, size: np.ndarray, *, hidden: np.ndarray) -> float:
    """Of a change of this size at each line, of which the records hold the part `hidden`."""
    noise = rng.standard_normal((2, 1, LINES, SENSORS))
    d = size[:, None] * np.exp(1j * rng.uniform(0, 2 * np.pi, (LINES, SENSORS)))
    before = noise[0] + 1j * noise[1] + hidden[:, None] * d
    k, root = np.arange(10, 10 + LINES), np.tile(np.eye(SENSORS, dtype=complex), (LINES, 1, 1))
    a, b = (Unexplained(k, root, white) for white in (before, before - d))
    return evenly([a], [b], [SAMPLES])


def test_a_change_that_is_there_is_even_whatever_its_size_and_shape() -> None:
    rng = np.random.default_rng(1)
    whole = np.ones(LINES)
    shapes = (0.3 * whole, 3.0 * whole, np.geomspace(5.0, 0.05, LINES))
    each = [chance(rng, size, hidden=whole) for size in shapes for _ in range(100)]
    assert min(each) > 1e-4
    # It is off by what is foretold: a small one's chance is anything, alike.
    assert 0.35 < np.mean(each[:100]) < 0.65


def test_a_change_that_is_there_in_some_lines_alone_is_not() -> None:
    """The same fall of chi-square, half of the lines against the others."""
    rng = np.random.default_rng(2)
    part = np.where(np.arange(LINES) < LINES / 2, 1.6, 0.2)
    each = [chance(rng, 0.6 * np.ones(LINES), hidden=part) for _ in range(100)]
    assert np.quantile(each, 0.9) < 1e-4


def test_what_a_law_is_off_by_counts_less_than_that() -> None:
    """Five per cent of a change a hundred times the noise."""
    rng = np.random.default_rng(3)
    part = np.where(np.arange(LINES) < LINES / 2, 1.05, 0.95)
    assert chance(rng, 10.0 * np.ones(LINES), hidden=part) > 1e-4
