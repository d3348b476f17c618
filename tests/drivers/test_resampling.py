"""Samples of one device at the times of another: exact for what is smooth, silent in a gap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.resampling import GAP, Track
from samii_rig.types import Channel, Quality, SampleBlock

CHANNELS = (Channel("M", "N m"), Channel("F", "N"))
PERIOD = 2_000_000  # ns


def block(times, values, quality=None):
    values = np.column_stack([values, -np.asarray(values)])
    quality = np.zeros(values.shape, np.uint8) if quality is None else quality
    n = np.arange(len(times), dtype=np.int64)
    return SampleBlock(CHANNELS, np.asarray(times), n, values, quality)


def filled(times, values, quality=None, now=7):
    track = Track(CHANNELS)
    track.add(np.asarray(times, np.int64), block(times, values, quality), now)
    return track


@given(
    st.lists(st.floats(-10, 10), min_size=4, max_size=4),
    st.integers(0, 2**31),
    st.integers(-(2**60), 2**60),
)
def test_a_cubic_comes_out_as_it_is(coefficients, seed, origin):
    rng = np.random.default_rng(seed)
    t = origin + np.arange(40) * PERIOD + rng.integers(-PERIOD // 3, PERIOD // 3, 40)
    wanted = np.sort(rng.integers(t[2], t[-3], 50))

    def cubic(at):
        return np.polyval(coefficients, (at - t[20]) * 1e-7)

    track = filled(t, cubic(t))
    values, quality = track.at(wanted)
    scale = np.abs(cubic(t)).max() + 1e-9
    np.testing.assert_allclose(values[:, 0], cubic(wanted), atol=1e-9 * scale)
    np.testing.assert_allclose(values[:, 1], -cubic(wanted), atol=1e-9 * scale)
    assert not quality.any()


def test_a_tone_of_a_fifth_of_nyquist_is_kept_to_a_percent():
    rng = np.random.default_rng(1)
    t = np.arange(2000) * PERIOD + rng.integers(-PERIOD // 4, PERIOD // 4, 2000)
    wanted = 10 * PERIOD + np.arange(1900) * PERIOD

    def tone(at):
        return np.sin(2 * np.pi * 50.0 * at * 1e-9)

    values, _ = filled(t, tone(t)).at(wanted)
    assert np.abs(values[:, 0] - tone(wanted)).max() < 0.02


def test_what_stands_still_stays_the_very_same_value():
    t = np.arange(50) * PERIOD + np.random.default_rng(3).integers(0, PERIOD // 2, 50)
    values, _ = filled(t, np.full(50, 0.1)).at(np.arange(10, 40) * PERIOD + 12_345)
    assert np.unique(values[:, 0]).tolist() == [0.1]


def test_nothing_is_known_past_the_newest_and_before_the_oldest():
    t = 100 * PERIOD + np.arange(10) * PERIOD
    track = filled(t, np.ones(10))
    values, quality = track.at(np.array([t[0] - 1, t[3], t[-1] + 1]))
    assert np.isnan(values[[0, 2]]).all()
    assert (quality[[0, 2]] == Quality.MISSING).all()
    assert (values[1] == [1.0, -1.0]).all()
    assert track.known == t[-2]
    assert track.heard == 7


LONGEST = round(GAP * 1e9)  # ns


@pytest.mark.parametrize("gap", [LONGEST - 1, LONGEST + 1])
def test_a_gap_is_bridged_or_missing_by_its_length(gap):
    t = np.concatenate([np.arange(10) * PERIOD, 9 * PERIOD + gap + np.arange(10) * PERIOD])
    middle = np.array([9 * PERIOD + gap // 2])
    values, quality = filled(t, np.linspace(0, 1, 20)).at(middle)
    if gap > LONGEST:
        assert np.isnan(values).all()
        assert (quality == Quality.MISSING).all()
    else:
        assert np.isfinite(values).all()
        assert not quality.any()
    # Right beside it there are two samples, through which a line goes.
    values, quality = filled(t, np.ones(20)).at(np.array([t[8] + 1, t[10] + 1]))
    assert not quality.any()


def test_what_came_without_a_number_leaves_a_gap_and_what_is_clipped_says_so():
    t = np.arange(30) * PERIOD
    values = np.ones(30)
    quality = np.zeros((30, 2), np.uint8)
    values[10:20], quality[10:20] = np.nan, Quality.MISSING
    quality[25, 0] = Quality.CLIPPED
    track = filled(t, values, quality)
    out, flags = track.at(np.array([t[14], t[24] + 1, t[25] + 1, t[27] + 1]))
    assert np.isnan(out[0]).all()
    assert (flags[0] == Quality.MISSING).all()
    assert flags[1:, 0].tolist() == [Quality.CLIPPED, Quality.CLIPPED, 0]
    assert not flags[1:, 1].any()


def test_no_sample_ever_goes_back_in_time():
    track = filled(np.arange(10) * PERIOD, np.ones(10))
    track.add(np.array([5 * PERIOD]), block([5 * PERIOD], [9.0]), 9)
    assert track.heard == 7
    values, _ = track.at(np.array([5 * PERIOD]))
    assert values[0, 0] == 1.0
    empty, flags = Track(CHANNELS).at(np.array([5]))
    assert np.isnan(empty).all()
    assert (flags == Quality.MISSING).all()
