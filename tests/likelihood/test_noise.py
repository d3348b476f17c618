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
