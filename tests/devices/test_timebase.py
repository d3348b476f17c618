"""Two clocks held against each other: offset and drift are found, with an honest uncertainty."""

import numpy as np
import pytest

from samii_rig.devices.timebase import INTERVAL, ClockModel, Timed

NS = 1e9
FRAME = 8_000_000  # ns between pairs, as a node with batches of four at 500 Hz gives them


def pairs(seed, seconds, *, offset=3.7e12, drift=4e-5, floor=0.0, late=0.0):
    """(n, 2) device's and host's times: delay of the floor, an exponential tail of 0.3 ms, and now
    and then 20 ms; `late`: a span at the end in which everything is 30 ms late."""
    rng = np.random.default_rng(seed)
    device = 5 * 10**9 + np.arange(round(seconds * NS / FRAME), dtype=np.int64) * FRAME
    delay = floor + rng.exponential(3e-4, len(device))
    delay += 0.02 * (rng.random(len(device)) < 0.02)
    delay[device > device[-1] - late * NS] += 0.03
    host = device + offset + drift * (device - device[0]) + delay * NS
    return np.column_stack([device, host.astype(np.int64)]), device, offset, drift


def model_of(data, latency=(0.0, 0.0)):
    model = ClockModel(latency)
    for part in np.array_split(data, 50):
        model.add(part)
    return model


def off(fit, device, offset, drift):
    """s by which the fit's host time is wrong at the newest sample."""
    true = device[-1:] + offset + drift * (device[-1:] - device[0])
    return float((fit.host(device[-1:]) - true)[0]) / NS


@pytest.mark.parametrize("seconds", [0.6, 5.0, 40.0])
def test_the_offset_is_known_to_what_is_stated(seconds):
    # The floor of the delay is anywhere within the latency that is stated.
    latency, wrong = (0.0, 1e-3), []
    for seed in range(60):
        floor = np.random.default_rng(seed + 1000).uniform(*latency)
        data, *truth = pairs(seed, seconds, floor=floor)
        fit = model_of(data, latency).fit()
        wrong.append(off(fit, *truth) / fit.sigma)
    # Evenly distributed: +-sqrt(3) sigma, and the tail of the promptest pairs on top.
    assert np.std(wrong) == pytest.approx(1.0, abs=0.35)
    assert np.abs(wrong).max() < 2.2


def test_the_drift_is_known_to_what_is_stated():
    wrong = []
    for seed in range(40):
        data, *_, drift = pairs(seed, 30.0)
        fit = model_of(data).fit()
        assert fit.drift_sigma < 2e-6
        wrong.append((fit.drift - drift) / fit.drift_sigma)
    assert 0.5 < np.std(wrong) < 2.0
    assert np.abs(wrong).max() < 6.0


def test_a_busy_spell_does_not_move_the_line():
    data, *truth = pairs(3, 20.0, late=1.0)
    fit = model_of(data).fit()
    assert abs(off(fit, *truth)) < 3e-4


def test_nothing_is_said_before_enough_came():
    model = ClockModel()
    assert not model.ready
    model.add(pairs(1, 0.2)[0])
    with pytest.raises(ValueError, match="expected 3"):
        model.fit()


def test_there_and_back_is_the_same_time():
    fit = model_of(pairs(2, 10.0)[0]).fit()
    device = np.arange(10) * 1_234_567_891
    assert np.abs(fit.device(fit.host(device)) - device).max() <= 2


def test_a_known_latency_is_taken_off_and_its_width_is_uncertainty():
    data = pairs(5, 10.0)[0]
    plain, known = model_of(data).fit(), model_of(data, (2e-3, 4e-3)).fit()
    assert plain.offset - known.offset == pytest.approx(3e6, abs=1.0)
    assert known.sigma == pytest.approx(np.hypot(plain.sigma, 2e-3 / np.sqrt(12)))


def test_it_follows_a_clock_for_a_minute_and_forgets_what_was_before():
    data, *truth = pairs(6, 90.0)
    model = model_of(data)
    kept = {int(d) // INTERVAL for d, _ in model._pairs}
    assert len(kept) == 600
    assert abs(off(model.fit(), *truth)) < 2e-4


def test_a_device_says_by_two_members_that_it_is_timed():
    class Node:
        latency = (0.0, 1e-3)

        def arrivals(self):
            return np.zeros((0, 2), np.int64)

    assert isinstance(Node(), Timed)
    assert not isinstance(object(), Timed)
