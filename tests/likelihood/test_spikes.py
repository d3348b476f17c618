"""Samples that stand alone are mended; what a rig does at one instant is not."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.likelihood.spikes import as_predicted, mended
from samii_rig.types import Float

RATE, N, NOISE = 1000.0, 20_000, 1e-3
NO_STEP = np.zeros(2)


def motion(seed: int = 1) -> Float:
    """(N, 2) two sensors of a sweep with noise."""
    t = np.arange(N)[:, None] / RATE - [0.0, 0.007]
    x = [1.0, -0.4] * np.sin(2 * np.pi * (0.5 + 0.6 * t) * t)
    return np.asarray(x + NOISE * np.random.default_rng(seed).standard_normal((N, 2)))


def test_a_sound_record_is_left_as_it_is() -> None:
    z = motion()
    out, found = mended(z, NO_STEP)
    np.testing.assert_array_equal(out, z)
    assert found == ()


def test_spikes_take_the_value_of_the_motion() -> None:
    z = motion()
    at = np.random.default_rng(2).choice(np.arange(100, N - 100), 30, replace=False)
    struck = z.copy()
    struck[at, 0] += 30 * NOISE * np.where(np.arange(30) % 2, 1, -1)
    out, found = mended(struck, NO_STEP)
    assert {(at, i) for at, i, _ in found} == {(int(i), 0) for i in at}
    assert np.max(np.abs(out - z)) < 6 * NOISE
    np.testing.assert_array_equal(np.delete(out, at, axis=0), np.delete(z, at, axis=0))


def test_what_all_sensors_show_at_once_is_a_blow_and_stays() -> None:
    z = motion()
    z[5000] += 50 * NOISE
    out, found = mended(z, NO_STEP)
    np.testing.assert_array_equal(out, z)
    assert not found


def test_what_rings_on_stays() -> None:
    z = motion()
    z[5000:5004, 0] += 60 * NOISE * np.array([1.0, -0.9, 0.8, -0.7])
    np.testing.assert_array_equal(mended(z, NO_STEP)[0], z)


def test_a_converters_own_steps_are_no_spikes() -> None:
    step = np.array([0.05, 0.05])
    z = np.rint(motion() / step) * step
    np.testing.assert_array_equal(mended(z, step)[0], z)


@pytest.mark.parametrize("n", [10, 300])
def test_a_short_stretch_is_left_as_it_is(n: int) -> None:
    z = motion()[:n]
    np.testing.assert_array_equal(mended(z, NO_STEP)[0], z)


def test_what_a_model_predicts_was_no_spike() -> None:
    """Two samples taken for spikes: of one the model leaves its noise, of the other the spike."""
    e = NOISE * np.random.default_rng(4).standard_normal((N, 2))
    own, spike = (5000, 0, 30 * NOISE), (7000, 1, 30 * NOISE)
    e[5000, 0] -= 30 * NOISE  # mended, it is off from what the model predicts
    assert as_predicted(e, (own, spike), NO_STEP) == [own]
