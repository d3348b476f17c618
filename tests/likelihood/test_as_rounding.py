"""What rounding does along a change of the lines, which is not what independent noise does."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.likelihood.unexplained import Unexplained, as_rounding

LINES, OFFSETS = 400, 16
POWER = 0.9  # of the noise, that is rounding


def lines(rng: np.random.Generator, n: int = 1) -> np.ndarray:
    """(n, LINES, 1) of power 2, as noise of real and imaginary parts of variance 1."""
    return rng.standard_normal((n, LINES, 1)) + 1j * rng.standard_normal((n, LINES, 1))


def piece(white: np.ndarray, rounded: np.ndarray | None = None) -> Unexplained:
    root = np.ones((LINES, 1, 1), complex)
    draws = {} if rounded is None else {0: rounded}
    return Unexplained(np.arange(1, LINES + 1), root, white, draws)


def test_rounding_that_is_another_at_every_line_is_noise_as_it_is_told() -> None:
    rng = np.random.default_rng(1)
    noise, d = lines(rng), 0.3 * lines(rng)
    seeds = (np.random.default_rng(100 + seed) for seed in range(40))
    draws = (np.sqrt(POWER) * lines(own, OFFSETS) for own in seeds)
    each = [as_rounding([piece(noise + d, one)], [piece(noise)]) for one in draws]
    # 16 places tell a power of 1 to 0.35 of itself, and less than it is told is none.
    assert np.mean(each) == pytest.approx(1 + 0.4 * 0.35 * POWER, abs=0.06)


def test_rounding_that_repeats_as_the_change_does_has_all_of_its_power_there() -> None:
    """Draws of one shape, with any sign and size as the sensor stands in its step: along that they
    have the power of all lines together."""
    rng = np.random.default_rng(2)
    noise, d = lines(rng), 0.3 * lines(rng)
    unit = d / np.sqrt(np.mean(np.abs(d) ** 2) / 2)
    amplitude = np.sqrt(2 * POWER) * np.cos(2 * np.pi * np.arange(OFFSETS) / OFFSETS)
    found = as_rounding([piece(noise + d, amplitude[:, None, None] * unit)], [piece(noise)])
    # Power of the sum along d over that of independent lines: as many times as there are lines.
    assert found == pytest.approx(1 + POWER * (2 * LINES - 1), rel=0.05)


def test_without_a_sensor_that_nothing_dithers_noise_is_as_it_is_told() -> None:
    rng = np.random.default_rng(3)
    noise, d = lines(rng), 0.3 * lines(rng)
    assert as_rounding([piece(noise + d)], [piece(noise)]) == 1.0
