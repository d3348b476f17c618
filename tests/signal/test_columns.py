"""Columns that a logger shifted: found by the loop's own law, set right, and told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from samii_rig.signal.columns import FARTHEST, aligned, is_aligned, is_open, shift_of
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, Recording, Segment

N, RATE, KP, STEP = 4000, 500.0, 4.0, 1e-3
RIG_TOML = f'[centring]\nsensor = "theta"\nkp = {KP}\n'


def loop(resolution: float = STEP, seed: int = 1, rig_toml: str = RIG_TOML) -> Recording:
    """v = u - kp theta, rounded, of a slow joint with a noisy encoder."""
    rng = np.random.default_rng(seed)
    t = np.arange(N) / RATE
    u = np.sin(2 * np.pi * (0.5 + 2.0 * t) * t)
    theta = np.cumsum(u) * 2e-3 + 1e-4 * rng.standard_normal(N)
    v = u - KP * theta
    if resolution:
        v = np.rint(v / resolution) * resolution
    a = np.gradient(theta) + 1e-5 * rng.standard_normal(N)
    channels = (
        Channel("u", "V", "reference"),
        Channel("v", "V", "command", -10.0, 10.0, resolution),
        Channel("theta", "rad", "sensor"),
        Channel("a", "m/s^2", "sensor"),
    )
    values = np.column_stack([u, v, theta, a])
    return Recording(
        channels, RATE, np.arange(N) * 2_000_000, np.arange(N), values,
        np.zeros(values.shape, np.uint8), (Segment("sweep", "single", 0, N, 1.0, "V", 0),),
        rig_toml=rig_toml, source="run.mcap",
    )  # fmt: skip


def late(recording: Recording, m: int) -> Recording:
    """What was measured m rows later, without the rows that then hold nothing."""
    values = recording.values.copy()
    values[:, 2:] = np.roll(values[:, 2:], m, axis=0)
    return rows(replace(recording, values=values), slice(max(m, 0), N + min(m, 0)))


def rows(recording: Recording, kept: slice | np.ndarray) -> Recording:
    return replace(
        recording,
        time=recording.time[kept],
        sequence=recording.sequence[kept],
        values=recording.values[kept],
        quality=recording.quality[kept],
    )


@pytest.mark.parametrize("m", [-FARTHEST, -2, -1, 1, 3, FARTHEST])
def test_columns_that_stand_late_are_set_right(m: int):
    whole = loop()
    ((found, finding),) = aligned([late(whole, m)])
    assert finding is not None
    assert f"{abs(m)} sample" in finding.message
    assert "run.mcap" in finding.message
    np.testing.assert_array_equal(found.values, whole.values[found.sequence])
    assert len(found) >= N - 2 * abs(m)


def test_rows_beside_a_gap_are_given_up_and_no_other():
    whole = loop()
    kept = np.r_[0:1500, 1600:N]
    ((found, _),) = aligned([rows(late(whole, 3), kept[kept < N - 3])])
    np.testing.assert_array_equal(found.values, whole.values[found.sequence])
    assert len(found) >= kept.size - 12


def test_a_recording_in_order_is_left_as_it_is():
    whole = loop()
    assert aligned([whole]) == [(whole, None)]


@pytest.mark.parametrize("m", [-4, -1, 2, FARTHEST])
def test_recordings_of_one_input_are_set_beside_each_other_where_no_law_is_known(m: int):
    first, other = loop(rig_toml=""), loop(seed=2, rig_toml="")
    (_, no), (found, finding) = aligned([first, late(other, m)])
    assert no is None
    assert finding is not None
    assert f"beside run.mcap what was measured stands {abs(m)} sample" in finding.message
    np.testing.assert_array_equal(found.values, other.values[found.sequence])


def test_they_are_though_each_lacks_rows_of_its_own():
    first, other = loop(rig_toml=""), loop(seed=2, rig_toml="")
    gaps = np.r_[0:700, 760:N], np.r_[0:2000, 2110 : N - 3]
    (_, no), (found, finding) = aligned([rows(first, gaps[0]), rows(late(other, 3), gaps[1])])
    assert no is None
    assert finding is not None
    assert "3 samples later" in finding.message
    np.testing.assert_array_equal(found.values, other.values[found.sequence])


def test_two_of_which_most_rows_are_missing_are_left_as_they_are():
    first, other = loop(rig_toml=""), loop(seed=2, rig_toml="")
    few = np.r_[0:900, 3000:N]
    assert [said for _, said in aligned([first, rows(late(other, 3), few[few < N - 3])])] == [
        None,
        None,
    ]


def test_recordings_of_other_inputs_are_left_as_they_are():
    other = late(loop(rig_toml=""), 2)
    values = other.values.copy()
    values[:, :2] = np.random.default_rng(5).standard_normal((len(values), 2))
    other = replace(other, values=values)
    assert [said for _, said in aligned([loop(rig_toml=""), other])] == [None, None]


@pytest.mark.parametrize(
    "unknown",
    [
        late(loop(rig_toml=""), 2),
        late(loop(rig_toml="[centring"), 2),
        replace(
            late(loop(), 2), channels=tuple(replace(c, role="sensor") for c in loop().channels)
        ),
        rows(late(loop(), 2), slice(0, 6)),
    ],
)
def test_where_the_law_is_not_known_nothing_is_moved(unknown: Recording):
    assert shift_of(unknown) == 0


@pytest.mark.parametrize("m", [-1, 0, 3])
def test_a_law_that_holds_tells_of_every_shift_of_none_too(m: int):
    """A dead time of as much is then the rig's."""
    run = loop()
    # And another that hardly moves, of which it tells none.
    slow = replace(run, values=run.values * [1.0, 1.0, 1e-3, 1.0])
    slow.values[:, 1] = slow.values[:, 0] - KP * slow.values[:, 2]
    assert is_aligned([loop(rig_toml=""), slow, late(run, m)])
    assert not is_aligned([slow])


def test_a_law_says_nothing_of_shifts_where_its_encoder_hardly_moves():
    run = loop()
    still = replace(run, values=run.values * [1.0, 1.0, 0.0, 1.0])
    values = still.values.copy()
    values[:, 1] = np.rint(values[:, 0] / STEP) * STEP
    assert not is_aligned([replace(still, values=values)])
    assert not is_aligned([])


def test_a_measured_command_shows_a_shift_too():
    rng = np.random.default_rng(3)
    run = loop(0.0)
    values = run.values.copy()
    values[:, 1] += 1e-4 * rng.standard_normal(N)
    assert shift_of(late(replace(run, values=values), 2)) == 2


def test_a_shift_shows_beside_an_encoder_that_is_as_coarse_as_a_sample_of_motion():
    """Between what was sent and what a voltmeter saw, half a sample and a step of the encoder are
    left by the right shift too."""
    run = loop(0.0)
    values = run.values.copy()
    t = np.arange(N) / RATE
    theta = 0.02 * np.sin(2 * np.pi * (1.0 + 0.5 * t) * t)
    values[:, 2] = np.rint(theta / STEP) * STEP
    v = values[:, 0] - KP * values[:, 2]
    values[:, 1] = (v + np.append(v[0], v[:-1])) / 2
    for m in (-1, 0, 2):
        assert shift_of(late(replace(run, values=values), m)) == m


@pytest.mark.parametrize("m", [-2, 0, 1])
def test_a_shift_shows_where_a_voltmeter_is_noisier_than_what_is_fed_back(m: int):
    """Of every fourth sample of a loop that ran faster than the record."""
    rng = np.random.default_rng(4)
    t = np.arange(4 * N) / (4 * RATE)
    u = np.sin(2 * np.pi * (0.5 + 1.0 * t) * t)
    turn, grow = 2 * np.pi * 5.0 / (4 * RATE), 1 - 0.05 * 2 * np.pi * 5.0 / (4 * RATE)
    theta = 2e-7 * lfilter([1.0], [1.0, -2 * grow * np.cos(turn), grow**2], u)  # a mode of 5 Hz
    v = u - KP * theta
    seen = (v + np.append(v[0], v[:-1])) / 2 + 2e-3 * rng.standard_normal(4 * N)
    values = np.column_stack([u, seen, theta, np.gradient(theta)])[::4]
    assert shift_of(late(replace(loop(0.0), values=values), m)) == m


@pytest.mark.parametrize("m", [-2, -1, 0, 1])
def test_between_steps_a_shift_is_not_taken_for_a_delay_of_what_was_sent(m: int):
    """A reference that rests looks the same one row later, but for its few edges. Two converters
    whose steps divide each other make errors that the neighbours of a row explain a little."""
    rng = np.random.default_rng(7)
    step = 3e-4
    u = np.repeat([0.0, 0.04, 0.0, -0.04, 0.0], N // 5)
    theta = lfilter([0.003], [1.0, -0.997], u / KP) + 9e-5 * rng.standard_normal(N)
    theta = np.rint(theta / (step / 8)) * step / 8
    v = np.rint((u - KP * theta) / step) * step
    values = np.column_stack([u, v, theta, np.gradient(theta)])
    assert shift_of(late(replace(loop(step), values=values), m)) == m


def test_recordings_of_one_reference_are_set_beside_each_other_though_their_loops_answer():
    """What a loop feeds back of disturbances makes commands of one reference differ."""
    first, other = loop(rig_toml=""), loop(seed=2, rig_toml="")
    values = other.values.copy()
    values[:, 1] += 0.05 * np.random.default_rng(6).standard_normal(N)
    (_, _), (_, finding) = aligned([first, late(replace(other, values=values), 2)])
    assert finding is not None
    assert "2 samples later" in finding.message


def test_a_law_that_does_not_hold_moves_nothing():
    run = loop(0.0)
    values = run.values.copy()
    values[:, 1] = 0.6 * values[:, 1]
    assert shift_of(late(replace(run, values=values), 2)) == 0


@pytest.mark.parametrize(
    ("limit", "rate", "highest"), [(0.7, 0.02, 8.0), (0.9, 0.002, 8.0), (0.9, 0.02, 30.0)]
)
def test_a_clipped_command_under_a_voltmeter_is_no_shift(limit: float, rate: float, highest: float):
    """What a limit takes off the tops, another shift explains some of."""
    between = 10  # steps of the loop for each row
    t = np.arange(N * between) / (RATE * between)
    u = np.sin(2 * np.pi * (0.3 + highest / 2 / t[-1] * t) * t)
    theta, v, turned = np.zeros(t.size), np.zeros(t.size), 0.0
    for k in range(t.size):
        theta[k] = turned
        v[k] = np.clip(u[k] - KP * turned, -limit, limit)
        turned += rate / between * v[k]
    shown = (v + np.roll(v, 1))[::between] / 2
    rng = np.random.default_rng(1)
    shown = np.rint((shown + 4e-3 * rng.standard_normal(N)) / STEP) * STEP
    whole = loop()
    values = np.column_stack([u[::between], shown, theta[::between], whole.values[:, 3]])
    assert shift_of(replace(whole, values=values)) == 0


def coarse(seed: int, step: float, noise: float, times: int = 10) -> Recording:
    """An encoder that moves by less than a step `step`, V `noise` of a voltmeter whose filter
    reaches over a row to each side, and a loop that runs `times` times a row."""
    rng = np.random.default_rng(seed)
    whole = loop()
    u = np.repeat(whole.values[:, 0], times)
    motion = np.cumsum(u) * 2e-3 / times
    theta = np.rint((motion + 0.3 * step * rng.standard_normal()) / step) * step
    shown = np.hanning(2 * times + 1)
    v = np.convolve(u - KP * theta, shown / shown.sum(), "same")[::times]
    values = whole.values.copy()
    values[:, 1], values[:, 2] = v + noise * rng.standard_normal(N), theta[::times]
    return replace(whole, values=values)


def test_a_sensor_that_moves_by_less_than_its_step_shows_no_shift_beside_a_voltmeter():
    """It steps in few rows. Another shift explained these better in 4 of the 12. So a motor was
    told to have a delay of 17 ms, with 0.995."""
    assert {shift_of(coarse(seed, step=0.1, noise=0.03)) for seed in range(12)} == {0}


def test_the_estimate_is_that_of_the_columns_in_order_and_says_so():
    (right,) = estimate([loop()])
    (found,) = estimate([late(loop(), 2)])
    assert any(f.kind == "timing" and "set right" in f.message for f in found.findings)
    shared = np.interp(right.frequency, found.frequency, np.angle(found.H[:, 0, 0]))
    np.testing.assert_allclose(shared, np.angle(right.H[:, 0, 0]), atol=0.02)


def without_reference(recording: Recording) -> Recording:
    return replace(recording, channels=recording.channels[1:], values=recording.values[:, 1:])


@pytest.mark.parametrize("told", [True, False])
def test_whether_a_loop_ran_is_seen_in_its_command(told: bool):
    closed = loop(1e-5)  # V: below what the encoder's noise makes of the command
    values = closed.values.copy()
    values[:, 1] = values[:, 0]
    opened = replace(closed, values=values)
    for run, want in ((closed, False), (opened, True)):
        seen = run if told else without_reference(run)
        assert is_open(seen, "v", "theta", KP) is want


@pytest.mark.parametrize(("samples", "noise", "moved"), [(1.0, 0.5, 1), (0.7, 0.1, 0)])
def test_beside_noise_what_one_run_is_late_by_is_a_shift_if_it_is_whole(samples, noise, moved):
    """A part of a sample is a delay. noise : its power in what two runs differ by, over that of a
    sample."""
    rng, rows_ = np.random.default_rng(3), np.arange(-50, N)
    t = np.maximum(rows_, 0) / RATE
    theta = np.cumsum(np.sin(2 * np.pi * (0.5 + 2.0 * t) * t)) * 2e-3
    sd = np.sqrt(noise / 2) * np.sqrt(np.mean(np.diff(theta) ** 2))

    def run(by: float) -> Recording:
        own = loop(rig_toml="")
        values = own.values.copy()
        values[:, 2] = np.interp(np.arange(N) - by, rows_, theta) + sd * rng.standard_normal(N)
        values[:, 3] = 1e-3 * rng.standard_normal(N)
        return replace(own, values=values)

    (_, _), (found, said) = aligned([run(0.0), run(samples)])
    assert (said is not None) == bool(moved)
    assert len(found) == N - moved


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_shift_where_a_voltmeter_shows_a_faster_loop_between_two_rows(seed: int):
    """Random to two fifths of half the rate: three rows hardly make what is between them."""
    every, n = 10, 60_000
    rng = np.random.default_rng(seed)
    f = np.fft.rfftfreq(n, 1 / (every * RATE))
    turn = np.exp(2j * np.pi * rng.random(f.size))
    u = np.fft.irfft(np.where((f > 2.0) & (f < 0.2 * RATE), turn, 0.0), n)
    u *= 0.25 / np.std(u)
    theta, v = np.zeros(n), np.zeros(n)
    for k in range(n - 1):
        v[k] = u[k] - KP * theta[k]
        theta[k + 1] = theta[k] + v[k] / (every * RATE)
    shown = (v + np.append(0.0, v[:-1])) / 2 + 1e-3 * rng.standard_normal(n)
    read = theta + 1e-5 * rng.standard_normal(n)
    channels = (
        Channel("u", "V", "reference"),
        Channel("v", "V", "command", -10.0, 10.0, 3e-4),
        Channel("theta", "rad", "sensor"),
    )
    values = np.column_stack([u, shown, read])[::every]
    at = np.arange(len(values))
    record = Recording(
        channels, RATE, at * 2_000_000, at, values, np.zeros(values.shape, np.uint8),
        (Segment("random", "single", 0, at.size, 1.0, "V", 0),), rig_toml=RIG_TOML,
        source="run.mcap",
    )  # fmt: skip
    assert shift_of(record) == 0
