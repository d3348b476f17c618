"""A command that a meter showed: the loop's own law, held as long as its loop holds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_device import fake_rig
from scipy.signal import butter, sosfilt, windows

from samii_rig.likelihood.inputs import (
    BESIDE_TURN,
    Meter,
    calibrated,
    jumps,
    meter_noise,
    rest_of,
    sent,
    times_of,
)
from samii_rig.likelihood.pieces import Input, Wiring, pieces_of
from samii_rig.types import Channel, Float, Recording

RATE, N, KP, STEP = 500.0, 6000, 3.0, 3e-4
METER = 4e-3  # V, noise of a meter


def signal(t: Float) -> Float:
    return np.sin(2 * np.pi * (0.5 + 1.5 * t) * t) * np.exp(-t / 40)


def angle(t: Float) -> Float:
    return 0.1 * np.sin(2 * np.pi * (0.5 + 1.5 * t) * t - 0.7) * np.exp(-t / 40)


def recorded(times: int, kp: float = KP, seed: int = 1) -> Recording:
    """A loop `times` as fast as the record, its command as a meter shows it."""
    fast = np.arange(N * times) / (RATE * times)
    law = signal(fast) - kp * angle(fast)
    before = np.append(law[0], law[:-1])
    noise = METER * np.random.default_rng(seed).standard_normal(N)
    v = (0.5 * (law + before))[::times] + noise
    t = fast[::times]
    values = np.column_stack([signal(t), v, angle(t)])
    channels = (
        Channel("u", "V", "reference"),
        Channel("v", "V", "command", -10.0, 10.0, STEP),
        Channel("theta", "rad", "sensor"),
    )
    return Recording(
        channels, RATE, np.arange(N) * 2_000_000, np.arange(N), values,
        np.zeros(values.shape, np.uint8), (),
    )  # fmt: skip


@pytest.mark.parametrize("times", [2, 3, 4, 8])
@pytest.mark.parametrize("kp", [0.0, KP])
def test_a_meters_noise_is_gone_and_the_hold_is_the_loops(times: int, kp: float) -> None:
    run = recorded(times, kp)
    v, _, edges = sent(run, 1, kp, run.values[:, 2])
    # What a hold of T/times gives of a smooth law: its mean over the period before.
    half = 0.5 / (RATE * times)
    inner = np.linspace(-half, half, 41)
    t = np.arange(N) / RATE
    want = np.mean([signal(t - half + d) - kp * angle(t - half + d) for d in inner], axis=0)
    inside = slice(5, -5)
    assert not edges.any()
    assert np.std((v - want)[inside]) < 2e-4 < METER / 10


@pytest.mark.parametrize("times", [1, 2, 4, 10])
@pytest.mark.parametrize("kp", [0.0, KP])
def test_how_often_the_loop_ran_is_told_and_so_is_what_was_sent(times: int, kp: float) -> None:
    runs = [recorded(times, kp, seed) for seed in (1, 2)]
    found = [Meter.of(run, 1, KP, run.values[:, 2]) for run in runs]
    assert times_of(found) == times
    for run, meter in zip(runs, found, strict=True):
        assert meter is not None
        assert meter.kp == kp
        assert abs(meter.late - 0.5 / times) < 5 * meter.sd < 5e-3
        v, _, _ = sent(run, 1, KP, run.values[:, 2], times)
        np.testing.assert_array_equal(v, run.values[:, 0] - kp * run.values[:, 2])


def test_how_often_is_not_told_where_two_numbers_are_as_near() -> None:
    meter = Meter.of(run := recorded(10), 1, KP, run.values[:, 2])
    assert meter is not None
    assert times_of([meter]) == 10
    assert times_of([replace(meter, sd=2e-3)]) == 0  # a ninth as well as an eleventh
    assert times_of([replace(meter, late=0.4)]) == 0  # no whole number
    assert times_of([meter, None]) == 0
    assert times_of([]) == 0


def test_samples_that_were_lost_are_no_edges() -> None:
    run = recorded(2)
    lost = np.zeros(N, np.bool_)
    lost[2000:2100] = True
    run.values[lost, 0] += 0.5  # a guess that is far off
    assert Meter.of(run, 1, KP, run.values[:, 2]) is None
    meter = Meter.of(run, 1, KP, run.values[:, 2], lost)
    assert meter is not None
    assert not meter.far[lost].any()
    assert times_of([meter]) == 2


def test_a_command_that_was_recorded_as_sent_is_left_as_it_is() -> None:
    run = recorded(1)
    values = run.values.copy()
    law = values[:, 0] - KP * values[:, 2]
    values[:, 1] = np.rint(law / STEP) * STEP
    run = Recording(
        run.channels, run.rate_hz, run.time, run.sequence, values, run.quality, run.segments
    )
    v, _, _ = sent(run, 1, KP, values[:, 2])
    np.testing.assert_array_equal(v, values[:, 1])


@pytest.mark.parametrize("kp", [0.0, KP])
def test_of_a_command_at_rest_the_loop_s_law_is_left_however_loud_the_meter(kp: float) -> None:
    run = recorded(2, kp)
    theta = 1e-3 * run.values[:, 2]  # another joint moves this one a little
    noise = METER * np.random.default_rng(2).standard_normal(N)
    run.values[:, 0], run.values[:, 1], run.values[:, 2] = 0.0, noise - kp * theta, theta
    assert kp * np.std(theta) < METER / 10
    v, _, _ = sent(run, 1, kp, theta)
    assert np.std((v + kp * theta)[5:-5]) < METER / 100


def test_of_a_command_at_rest_what_the_law_does_not_say_is_left_as_it_is() -> None:
    run = recorded(2)
    theta = run.values[:, 2]
    noise = METER * np.random.default_rng(2).standard_normal(N)
    # A loop of twice the gain that is stated.
    run.values[:, 0], run.values[:, 1] = 0.0, noise - 2 * KP * theta
    v, _, _ = sent(run, 1, KP, theta)
    np.testing.assert_array_equal(v, run.values[:, 1])


def test_a_clipped_command_is_no_meters_noise() -> None:
    run = recorded(2)
    run.values[:, 1] = np.clip(run.values[:, 1], -0.6, 0.6)
    v, _, _ = sent(run, 1, KP, run.values[:, 2])
    np.testing.assert_array_equal(v, run.values[:, 1])


def test_without_a_reference_there_is_no_law() -> None:
    run = recorded(2)
    run = Recording(
        run.channels[1:], run.rate_hz, run.time, run.sequence, run.values[:, 1:],
        run.quality[:, 1:], (),
    )  # fmt: skip
    v, _, _ = sent(run, 0, KP, run.values[:, 1])
    np.testing.assert_array_equal(v, run.values[:, 0])


@pytest.mark.parametrize("times", [0, 4])
def test_a_sensors_noise_is_none_of_what_drives_its_loop(times: int) -> None:
    """It would drive a free change of the response to the sensor by the sensor itself."""
    run = recorded(4)
    own = 5e-3 * np.random.default_rng(3).standard_normal(N)
    run.values[:, 2] += own
    run.values[:, 1] -= KP * own  # the meter shows the noise that went round the loop, too
    _, r, _ = sent(run, 1, KP, run.values[:, 2], times)
    window = windows.hann(N)
    above = np.fft.rfftfreq(N, 1 / RATE) > 100.0  # what is driven ends below

    def largest(x: Float) -> float:
        return float(np.max(np.abs(np.fft.rfft(window * x))[above]))

    assert largest(r) < 0.1 * KP * largest(own)


def test_an_edge_within_a_sample_is_told() -> None:
    run = recorded(4, kp=0.0)
    run.values[3000:, 0] += 0.8
    run.values[3000, 1] += 0.4
    run.values[3001:, 1] += 0.8
    v, _, edges = sent(run, 1, 0.0, None)
    assert np.flatnonzero(edges).size > 0
    assert np.all(np.abs(np.flatnonzero(edges) - 3000) <= 3)
    assert np.std(v[:2990] - run.values[:2990, 1]) > METER / 2


def test_a_jump_of_a_loop_that_ran_faster_than_the_record_lies_between_samples() -> None:
    """As its meter shows, however many times as fast."""
    run = recorded(4)
    run.values[3000:, :2] += 0.15  # as the meter shows it, the law has it: it passes for no edge
    theta = run.values[:, 2]
    found = {4: Meter.of(run, 1, KP, theta), 1: Meter.of(recorded(1), 1, KP, theta)}
    assert {times: m is not None and m.faster for times, m in found.items()} == {4: True, 1: False}
    assert not sent(run, 1, KP, theta)[2].any()
    wired = Wiring((Input("v", "theta", KP),), ("theta",))
    (piece,) = pieces_of([run], fake_rig(), wired)
    assert {2999, 3000} <= {at for at, _ in piece.edges}


def test_a_command_that_rests_for_most_of_the_record_is_left_as_it_is() -> None:
    """Where it rests it is its law exactly, and says nothing of a meter."""
    run = recorded(1, kp=0.0)
    run.values[N // 4 :, 0] = 0.0
    run.values[:, 1] = np.rint(run.values[:, 0] / STEP) * STEP
    run.values[N // 4 - 5 : N // 4 + 5, 1] += STEP
    v, _, edges = sent(run, 1, 0.0, None)
    np.testing.assert_array_equal(v, run.values[:, 1])
    assert not edges.any()


def test_of_a_meters_noise_lines_lose_the_part_that_is_none_of_the_input() -> None:
    rng, n, meter = np.random.default_rng(3), 8000, 5 * METER
    t = np.arange(n) / RATE
    f = np.arange(2.0, 40.0)
    r = np.cos(2 * np.pi * f * t[:, None] + f) @ np.geomspace(1, 5e-3, f.size)
    shown = r + meter * rng.standard_normal(n)
    made, (noise, left, _) = calibrated(shown, STEP)
    assert np.std(made - r) == pytest.approx(left, rel=0.5)
    assert left < 0.45 * meter
    assert noise == meter_noise(shown, STEP) == pytest.approx(meter, rel=0.05)
    power = [np.abs(np.fft.rfft(x)) ** 2 for x in (r, shown, made)]
    silent = power[0] < 1e-6 * np.max(power[0])
    assert np.sum(power[2][silent]) < 0.2 * np.sum(power[1][silent])
    np.testing.assert_allclose(power[2][~silent], power[0][~silent], rtol=0.4)
    # What a converter rounds drives the rig as it is, and noise up to half the rate may be meant.
    held = np.rint(r / STEP) * STEP
    np.testing.assert_array_equal(calibrated(held, STEP)[0], held)
    wide = rng.standard_normal(n)
    np.testing.assert_array_equal(calibrated(wide, STEP)[0], wide)
    assert meter_noise(held, STEP) == meter_noise(wide, STEP) == 0.0


@pytest.mark.parametrize("kind", ["random", "sweep"])
def test_a_meters_noise_is_none_of_an_input_that_is_cut(kind: str) -> None:
    """Its ends leak as much as a meter's noise has; where they are, the input is as it was."""
    rng, n, meter = np.random.default_rng(5), 8000, 5 * METER
    if kind == "random":
        sos = butter(8, 25.0, fs=RATE, output="sos")
        r = 3 * sosfilt(sos, rng.standard_normal(2 * n))[n:]
    else:
        t = np.arange(n) / RATE
        r = np.sin(2 * np.pi * (1.0 + 25.0 * t / t[-1]) * t + 1.0)
    made, (noise, left, _) = calibrated(r + meter * rng.standard_normal(n), STEP)
    assert noise == pytest.approx(meter, rel=0.05)
    off = made - r
    assert np.std(off) == pytest.approx(left, rel=0.5)
    assert left < 0.6 * meter
    assert np.max(np.abs(off[[0, -1]])) < 4 * meter
    window = windows.hann(n)
    power = np.abs(np.fft.rfft(window * off)) ** 2 / float(window @ window)
    above = np.fft.rfftfreq(n, 1 / RATE) > 120.0
    assert np.mean(power[above]) < 0.05 * meter**2


@pytest.mark.parametrize("behind", [1.0, 0.5])
def test_the_jumps_of_steps_stay_as_sharp_as_they_are(behind: float) -> None:
    """Line by line they are below a meter's noise. behind : part of a jump that a sample shows
    which a meter reads at its instant."""
    rng, n, meter = np.random.default_rng(7), 12000, 4 * METER
    r = np.zeros(n)
    for at, size in ((2000, 0.4), (5000, -0.7), (9000, 0.3)):
        r[at:] += size
        r[at] -= (1 - behind) * size
    made, (noise, left, _) = calibrated(r + meter * rng.standard_normal(n), STEP)
    assert noise == pytest.approx(meter, rel=0.1)
    off = made - r
    assert np.max(np.abs(off)) < 5 * meter
    assert np.std(off) == pytest.approx(left, rel=0.5)
    assert left < 0.3 * meter


@pytest.mark.parametrize("meter", [0.0, 5 * METER])
def test_jumps_beside_a_fast_sweep_are_no_meters_noise(meter: float) -> None:
    """Both together look white, and bend as noise does: a sweep to a fifth of the rate, and steps
    behind it."""
    n, t = 40000, np.arange(36000) / RATE
    sweep = np.sin(np.pi * 0.2 * RATE / t[-1] * t**2)
    steps = np.repeat([0.0, 1.0, -1.0, 0.0], 1000)
    r = np.concatenate([sweep, steps]) + meter * np.random.default_rng(9).standard_normal(n)
    assert meter_noise(np.rint(r / STEP) * STEP, STEP) == pytest.approx(meter, rel=0.15)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_binary_input_is_as_wide_as_noise_and_is_none(seed: int) -> None:
    v = 0.5 * np.sign(np.repeat(np.random.default_rng(seed).standard_normal(500), 10))
    v = np.rint(v / STEP) * STEP
    assert meter_noise(v, STEP) == 0.0
    np.testing.assert_array_equal(calibrated(v, STEP)[0], v)


def test_jumps_beside_a_rest_are_edges_and_a_sweep_has_none() -> None:
    run = recorded(1, 0.0)
    u = np.zeros(N)
    u[1000:3000] = 0.7 + 0.1 * np.sin(np.arange(2000) / 20)  # from rest, and back to it
    u[4000:4500] = -0.4
    values = run.values.copy()
    values[:, 0] = u
    found = np.flatnonzero(jumps(replace(run, values=values), 1, 0.0, None))
    assert found.tolist() == [999, 1000, 2999, 3000, 3999, 4000, 4499, 4500]
    assert not jumps(run, 1, 0.0, None).any()


def test_the_end_of_a_cut_sweep_is_no_meters_noise() -> None:
    t = np.arange(5000) / RATE
    cut = np.rint(np.sin(2 * np.pi * (1.0 + 1.6 * t) * t) / STEP) * STEP
    np.testing.assert_array_equal(calibrated(cut, STEP)[0], cut)


def test_a_jump_between_two_smooth_stretches_is_an_edge() -> None:
    run = recorded(1, 0.0)
    values = run.values.copy()
    values[:, 0] = np.sin(np.arange(N) / 8)
    values[2000:, 0] += 0.2
    found = np.flatnonzero(jumps(replace(run, values=values), 1, 0.0, None))
    assert found.tolist() == list(range(1999 - BESIDE_TURN, 2001 + BESIDE_TURN))


@pytest.mark.parametrize("periods", [0.02, 0.15, 0.36])  # of the oscillation, per sample
def test_where_a_sweep_turns_back_it_has_an_edge(periods: float) -> None:
    run = recorded(1, 0.0)
    n = np.arange(2000)
    up = 0.1 + np.sin(2 * np.pi * (periods - 1e-5 * (2000 - n)) * n + 0.9)
    values = run.values.copy()
    values[:, 0] = np.concatenate([up, up[::-1], np.full(N - 4000, up[0])])
    run = replace(run, values=values)
    found = np.flatnonzero(jumps(run, 1, 0.0, None))
    turn, rest = np.split(found, [2 + 2 * BESIDE_TURN])
    assert rest.size in (0, 2)  # where it comes to rest, if that is a jump
    assert 1997 <= turn[0] + BESIDE_TURN < turn[-1] - BESIDE_TURN <= 2002


def test_without_a_reference_a_closed_loop_rests_within_a_step_of_its_command() -> None:
    run = recorded(2)
    u = np.zeros(N)
    u[1000:3000] = 0.7
    theta = run.values[:, 2]
    v = np.rint((u - KP * theta) / STEP) * STEP
    alone = Recording(
        (replace(run.channels[1], resolution=STEP),), run.rate_hz, run.time, run.sequence,
        v[:, None], run.quality[:, 1:2], (),
    )  # fmt: skip
    found = np.flatnonzero(jumps(alone, 0, KP, theta))
    assert found.tolist() == [999, 1000, 2999, 3000]


def test_the_level_at_rest_is_a_meters_and_that_of_a_drive_is_its_own() -> None:
    rng = np.random.default_rng(3)
    noise = METER * rng.standard_normal(N)
    offset, t = 0.3, np.arange(N) / RATE
    sweep = np.where(t < 0.5, 0.0, signal(t - 0.5))
    steps = np.where((t > 1.0) & (t % 4.0 < 3.0), 1.0, 0.0)
    for v in (sweep, steps):  # both begin at rest, the steps stand up most of the time
        assert rest_of(v + offset + noise, METER, moving=False) == pytest.approx(offset, abs=METER)
    # Cut in motion, it swings to both sides alike; steps do not, and may be biased.
    drawn = rng.standard_normal(N) + offset + noise
    assert rest_of(drawn, METER, moving=True) == pytest.approx(offset, abs=0.05)
    assert rest_of(steps + offset + noise, METER, moving=True) == 0.0


@pytest.mark.parametrize("rate", [500.0, 5000.0, 50000.0])
def test_a_slow_swing_at_a_high_rate_does_not_rest(rate: float) -> None:
    """In 16 samples of 5 kHz a sine of 2 Hz hardly moves: its first value is no rest."""
    t = np.arange(int(20 * rate)) / rate
    found = rest_of(np.cos(2 * np.pi * 2.0 * t), 0.0, moving=False)
    assert found == pytest.approx(0.0, abs=0.01)
