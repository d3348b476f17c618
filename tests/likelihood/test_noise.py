"""The noise of all sensors, from lines of it."""

import numpy as np

from samii_rig.likelihood.noise import Noise
from samii_rig.types import Complex, Float, Int

PERIODS = 4  # of the input in the record: its rounding repeats, so it has every fourth line alone


STEP = 0.025  # Hz, from line to line


class Comb:
    """Rounding of a motion that repeats itself: power at the lines of its periods alone."""

    group = np.zeros(1, np.int64)

    def __call__(self, f: Float, group: Int) -> Float:
        """As of `Known`."""
        on = np.rint(f / STEP) % PERIODS == 0
        return np.asarray(np.where(on, 4.0, 0.04)[:, None])

    def cover(self, f: Float, group: Int) -> Float:
        """As of `Known`."""
        return np.zeros((f.size, 1))


def own(f: Float) -> Complex:
    """One sensor, its own noise alone."""
    return np.ones((f.size, 1, 1), complex)


def test_a_rounding_that_repeats_itself_counts_where_it_is() -> None:
    """Lines of the motion have 4.1 of power, those between 0.14: 0.1 is not known beforehand."""
    f = STEP * np.arange(40.0, 1240.0)
    piece = np.zeros(f.size, np.int64)
    power = Comb()(f, piece)[:, 0] + 0.1
    rng = np.random.default_rng(0)
    left = rng.standard_normal((f.size, 2)) @ np.array([1, 1j]) * np.sqrt(power / 2)
    noise = Noise.of(f, left[:, None], np.ones(f.size), piece, own, Comb())
    found = noise.covariance(f, piece)[:, 0, 0].real
    excited = power > 1
    for some in (excited, ~excited):
        assert 0.8 < np.mean(found[some] / power[some]) < 1.2


class Nothing:
    """No noise is known beforehand."""

    group = np.zeros(1, np.int64)

    def __call__(self, f: Float, group: Int) -> Float:
        """As of `Known`."""
        return np.zeros((f.size, 1))

    cover = __call__


def resonant(f: Float, at: float) -> Complex:
    """(n, 1, 1) the response of a mode of 1 % of loss."""
    return np.asarray(1 / (1 - (f / at) ** 2 + 0.01j))[:, None, None]


def test_noise_of_a_mode_that_stands_elsewhere_than_in_the_model_is_that_of_the_lines() -> None:
    """The model has a mode at 13 Hz that the rig has at 14. By blocks of 10 % of the frequency what
    disturbs the rig was taken for 23 times what it is below the one, and for half of it at the
    other; about the one itself for 80 times."""
    f = np.arange(2.0, 30.0, 0.01)
    piece = np.zeros(f.size, np.int64)
    power = 0.01 + 0.02 * np.abs(resonant(f, 14.0)[:, 0, 0]) ** 2
    rng = np.random.default_rng(5)
    left = rng.standard_normal((f.size, 2)) @ np.array([1, 1j]) * np.sqrt(power / 2)

    def disturbed(f: Float) -> Complex:
        return np.concatenate([own(f), resonant(f, 13.0)], axis=2)

    noise = Noise.of(f, left[:, None], np.ones(f.size), piece, disturbed, Nothing())
    ratio = noise.covariance(f, piece)[:, 0, 0].real / power
    for low, high, most in (
        (10.0, 12.7, 1.5),
        (12.7, 13.3, 10.0),  # two blocks of twelve lines hold the mode that is not there
        (13.3, 13.8, 1.5),
        (13.8, 14.2, 1.5),
        (14.2, 18.0, 1.5),
    ):
        there = float(np.exp(np.mean(np.log(ratio[(f > low) & (f < high)]))))
        assert 1 / most < there < most, (low, there)
