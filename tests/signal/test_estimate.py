"""The estimates that decide: their intervals hold, the method is chosen and said."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from samii_rig.errors import EstimateError, InputError
from samii_rig.signal import noise, statistics
from samii_rig.signal.estimate import estimate
from samii_rig.signal.periodic import transient_left
from samii_rig.types import Channel, Recording, Segment

STUDY = Path(__file__).resolve().parents[2] / "benchmarks" / "coverage_study.py"
SPEC = importlib.util.spec_from_file_location("coverage_study", STUDY)
assert SPEC is not None
assert SPEC.loader is not None
study = importlib.util.module_from_spec(SPEC)
sys.modules["coverage_study"] = study
SPEC.loader.exec_module(study)

SENSOR, DISTURBANCE = study.SENSOR, study.DISTURBANCE


@pytest.fixture(scope="module")
def bursts() -> np.ndarray:
    """(4, 3, n, 6): runs of three bursts in closed loop, disturbed."""
    return study.simulate(
        study.plant(),
        study.swept_sine(**study.BURST),
        (4, 3),
        np.random.default_rng(5),
        sensor=SENSOR,
        disturbance=DISTURBANCE,
    )


def test_ninety_percent_intervals_hold_in_ninety_percent_of_runs_reduced():
    u = study.swept_sine(**study.BURST)
    found = study.coverage(study.runs(60, 17, repeats=3, u=u, kind="burst", method="burst"))
    both = (found.inside["real"] + 0.0 + found.inside["imag"]) / 2
    for name, band in found.bands().items():
        assert 0.88 < both[:, band].mean() < 0.92, name
        assert found.ratio[:, band].mean() == pytest.approx(1, abs=0.1), name
    assert np.all(np.abs(both.mean(axis=(0, 1)) - 0.9) < 0.02)
    assert found.inside["magnitude"].mean() == pytest.approx(0.9, abs=0.015)
    assert found.inside["phase"].mean() == pytest.approx(0.9, abs=0.015)
    whole = np.ones(found.frequency.size, bool)
    assert study.percentile_ratio(found, whole) == pytest.approx(1, abs=0.07)
    assert study.kolmogorov(found)[1] > 1e-3


def test_noise_through_the_loop_biases_h1_and_not_the_way_through_the_reference():
    found = study.loop_bias(24, 3)
    assert found.h1_relative > 0.2
    assert found.h1_sigma > 1.5
    assert found.ours_sigma < 1.2


def test_friction_makes_both_estimates_best_linear_approximations_and_levels_tell():
    found = study.friction(1)
    np.testing.assert_allclose(found.h1, found.ours, rtol=0.01)
    assert found.ours[0] < 0.9
    assert all(a < b for a, b in zip(found.ours[:-1], found.ours[1:], strict=True))
    assert found.p_value < 1e-6


def test_three_bursts_at_rest_are_taken_line_by_line_and_it_says_so(bursts):
    r = estimate([study.recording(bursts[0])])[0]
    assert r.method.startswith("burst")
    assert "through u" in r.method
    assert "no leakage" in r.why
    assert r.n_averages == 3
    assert r.H.shape == (r.frequency.size, 4, 1)
    assert r.covariance.shape == (r.frequency.size, 4, 4)
    assert np.all(np.linalg.eigvalsh(r.covariance)[:, 0] > 0)
    assert r.frequency[0] < 1 < 28 < r.frequency[-1]
    # The sweep passes with amplitude 1; the loop takes some of it.
    assert np.median(r.input_rms) == pytest.approx(np.sqrt(0.5), rel=0.1)


def test_levels_are_never_pooled(bursts):
    recording = study.recording(bursts[0])
    a, b, c = recording.segments
    mixed = replace(recording, segments=(a, b, replace(c, level=2.0)))
    found = estimate([mixed, study.recording(bursts[1])])
    assert [r.level for r in found] == [1.0, 2.0]
    assert [r.n_averages for r in found] == [5, 1]


def test_one_burst_is_estimated_by_local_models(bursts):
    r = estimate([study.recording(bursts[0][:1])], band=(5, 12))[0]
    assert r.method.startswith("local")
    assert "one sweep" in r.why


def test_a_recording_without_segments_is_one_single_sweep(bursts):
    recording = replace(study.recording(bursts[0][:1]), segments=())
    r = estimate([recording], band=(5, 12))[0]
    assert r.method.startswith("local")
    assert r.level == pytest.approx(1.0, abs=1e-3)


def test_without_a_reference_the_input_takes_its_place_and_that_is_said(bursts):
    recording = study.recording(bursts[0])
    channels = tuple(replace(c, role="sensor") if c.name == "u" else c for c in recording.channels)
    r = estimate(
        [replace(recording, channels=channels)],
        outputs=["theta", "a_0"],
        method="local",
        band=(5, 9),
    )[0]
    assert any(f.kind == "closed_loop" for f in r.findings)
    assert "through v" in r.method


def test_both_references_add_up_through_the_gain_of_the_loop(bursts):
    recording = study.recording(bursts[0])
    u = recording.values[:, 0]
    channels = (
        recording.channels[0],
        Channel("theta_ref", "rad", "reference"),
        *recording.channels[1:],
    )
    values = np.column_stack([0.5 * u, u / 8.0, recording.values[:, 1:]])
    quality = np.zeros(values.shape, np.uint8)
    two = replace(recording, channels=channels, values=values, quality=quality)
    with pytest.raises(InputError, match="one reference column"):
        estimate([two])
    known = replace(two, rig_toml='[centring]\nsensor = "theta"\nkp = 4.0\n')
    r = estimate([known])[0]
    assert "u + 4 theta_ref" in r.method
    np.testing.assert_allclose(r.H, estimate([recording])[0].H, rtol=1e-9)


def _periodic(u, y):
    """One run at 100 Hz of a command that repeats itself."""
    t = np.arange(u.size, dtype=np.int64)
    values = np.stack([u, u, y], axis=1)
    return Recording(
        (Channel("u", "V", "reference"), Channel("v", "V", "command"), Channel("y", "rad")),
        100.0,
        t * 10_000_000,
        t,
        values,
        np.zeros(values.shape, np.uint8),
        (Segment("m", "periodic", 0, u.size, 1.0, "V"),),
    )


def test_whole_periods_of_a_multisine_are_free_of_leakage():
    rng = np.random.default_rng(2)
    n, periods = 400, 6
    lines = np.arange(3, 60, 2)
    t = np.arange(n * periods)
    u = sum(np.cos(2 * np.pi * k * t / n + rng.uniform(0, 6.3)) for k in lines)
    y = np.zeros(u.size)
    for i in range(1, u.size):
        y[i] = 0.8 * y[i - 1] + 0.2 * u[i - 1]
    r = estimate([_periodic(u, y + 1e-3 * rng.normal(size=u.size))])[0]
    assert r.method.startswith("periodic")
    assert r.n_averages == periods - 1
    np.testing.assert_allclose(r.frequency, lines * 0.25)
    z = np.exp(2j * np.pi * r.frequency / 100)
    _, p_value = statistics.model_distance(r, (0.2 / (z - 0.8))[:, None, None])
    assert np.mean(p_value < 0.1) < 0.35
    np.testing.assert_allclose(r.input_rms, np.sqrt(0.5), rtol=1e-6)


def test_a_command_that_is_rounded_to_rest_gives_no_response():
    """A level below the converter's step: only the start of the run moves it."""
    t = np.arange(400 * 5)
    u = 0.4 * np.cos(2 * np.pi * 5 * t / 400) + 0.05 * np.cos(2 * np.pi * 9 * t / 400)
    rounded = _periodic(u, np.zeros(u.size))
    values = rounded.values.copy()
    values[:, 1] = np.round(u)
    values[:50, 1] = 1.0
    values[:, 2] = 1e-3 * np.random.default_rng(3).normal(size=u.size)
    with pytest.raises(EstimateError, match="the input v stands still in all that is estimated"):
        estimate([replace(rounded, values=values)])


def test_a_line_without_power_is_left_out_and_that_is_said():
    """Two pulses two samples apart have none at a quarter of the rate."""
    rng = np.random.default_rng(4)
    n, repeats = 200, 4
    u = np.zeros(n * repeats)
    u[50::n] = u[52::n] = 1.0
    v = u + 1e-3 * rng.normal(size=u.size)
    run = _periodic(u, 2 * v + 1e-3 * rng.normal(size=u.size))
    values = run.values.copy()
    values[:, 1] = v
    each = [Segment(f"b{k}", "burst", k * n, (k + 1) * n, 1.0, "V") for k in range(repeats)]
    r = estimate([replace(run, values=values, segments=tuple(each))], method="burst")[0]
    assert np.all(np.isfinite(r.H))
    assert np.all(np.isfinite(r.covariance))
    assert 25.0 not in r.frequency
    assert {24.5, 25.5} <= set(r.frequency)
    (said,) = (f.message for f in r.findings if "no power" in f.message)
    assert said == "1 line is left out, as the reference has no power there"


def test_a_joint_that_ends_at_another_angle_does_not_leak():
    n = 2000
    t = (np.arange(n) - 200) / 100
    u = np.where((t > 0) & (t < 10), np.sin(2 * np.pi * (0.5 + t / 2) * t) + 0.2, 0.0)
    y = np.cumsum(np.concatenate([[0.0], u[:-1]])) * 0.01
    rng = np.random.default_rng(1)
    repeats = [np.stack([u, u, y + 1e-6 * rng.normal(size=n)], axis=1) for _ in range(3)]
    values = np.concatenate(repeats)
    count = np.arange(3 * n, dtype=np.int64)
    made = Recording(
        (Channel("u", "V", "reference"), Channel("v", "V", "command"), Channel("y", "rad")),
        100.0,
        count * 10_000_000,
        count,
        values,
        np.zeros(values.shape, np.uint8),
        tuple(Segment(f"s{i}", "burst", i * n, (i + 1) * n, 1.0, "V", i) for i in range(3)),
    )
    r = estimate([made], band=(1, 10))[0]
    assert r.method.startswith("burst")
    truth = 0.01 / (np.exp(2j * np.pi * r.frequency / 100) - 1)
    assert np.max(np.abs(r.H[:, 0, 0] / truth - 1)) < 1e-4


def test_coarse_steps_that_repeat_are_added_to_the_covariance():
    recording = study.recording(
        study.simulate(
            study.plant(),
            study.swept_sine(**study.BURST),
            (3,),
            np.random.default_rng(0),
            sensor=SENSOR * 1e-3,
            disturbance=0.0,
        )
    )
    step = 0.002
    values = recording.values.copy()
    values[:, 2] = np.round(values[:, 2] / step) * step
    channels = tuple(
        replace(c, resolution=step) if c.name == "theta" else c for c in recording.channels
    )
    coarse = replace(recording, values=values, channels=channels)
    r = estimate([coarse], outputs=["theta"], method="burst", band=(1, 25))[0]
    assert any(f.kind == "dof" and f.channel == "theta" for f in r.findings)
    truth = study.plant().response(r.frequency)[:, 0]
    error = np.abs(r.H[:, 0, 0] - truth) ** 2 / r.covariance[:, 0, 0].real
    assert 0.2 < np.mean(error) < 3


@pytest.mark.parametrize("colour", [0.0, 0.97])
def test_pooling_keeps_its_degrees_of_freedom_when_the_noise_resonates(colour):
    rng = np.random.default_rng(4)
    k = np.arange(300)
    shape = 1 / np.abs(1 - colour * np.exp(-2j * np.pi * (k - 90) / 300))
    found = []
    for _ in range(150):
        e = shape[:, None] * (rng.normal(size=(2, 300, 2)) + 1j * rng.normal(size=(2, 300, 2)))
        of = noise.pooled(e, 2, 15)
        found.append(of.covariance[:, 0, 0].real / (2 * shape**2))
    ratio = np.array(found)
    np.testing.assert_allclose(ratio.mean(axis=0), 1, atol=0.2)
    assert ratio.mean() == pytest.approx(1, abs=0.03)
    # One variance of nu complex degrees of freedom scatters by 1/sqrt(nu).
    assert np.median(ratio.std(axis=0)) == pytest.approx(1 / np.sqrt(of.dof[0]), rel=0.15)


def test_bad_requests_are_answered_in_one_line(bursts):
    recording = study.recording(bursts[0])
    with pytest.raises(InputError, match="method"):
        estimate([recording], method="best")
    with pytest.raises(InputError, match="gaps"):
        estimate([recording], gaps="ignore")
    with pytest.raises(InputError, match="outputs is 'b'"):
        estimate([recording], outputs=["b"])
    with pytest.raises(InputError, match="band"):
        estimate([recording], band=(5, 2))
    with pytest.raises(EstimateError, match="no recording"):
        estimate([])
    with pytest.raises(EstimateError, match="no line between 500"):
        estimate([recording], band=(500, 600))
    still = replace(recording, values=recording.values * [0, 0, 1, 1, 1, 1])
    with pytest.raises((EstimateError, InputError), match=r"input|moves|zero"):
        estimate([still])


def test_real_bursts_of_the_flexible_arm(recordings):
    channels = (
        Channel("u", "count", "reference"),
        Channel("v", "count", "command"),
        Channel("theta", "count", resolution=1.0),
        Channel("a", "count", resolution=1.0),
    )
    made = []
    for path in sorted(recordings.glob("*full-robot_swept_sine_amp-75*")):
        table = np.loadtxt(path)
        count = table[:, 1].astype(np.int64)
        made.append(
            Recording(
                channels,
                500.0,
                count * 2_000_000,
                count,
                table[:, 2:],
                np.zeros((len(table), 4), np.uint8),
                (Segment("sweep", "burst", 0, int(count[-1]) + 1, 75.0, "count"),),
                source=path.name,
            )
        )
    r = estimate(made)[0]
    assert r.n_averages == 3
    assert r.frequency[0] < 1 < 35 < r.frequency[-1]
    middle = (r.frequency > 1) & (r.frequency < 24)
    assert np.median(r.coherence[middle]) > 0.97
    # The tip resonates near 17 Hz.
    a = np.abs(r.H[:, 1, 0])
    assert 15 < r.frequency[middle][np.argmax(a[middle] * (r.frequency[middle] > 10))] < 20


def _multisine(n, rng):
    """One period of odd lines with random phases."""
    lines = np.arange(5, 300, 2)
    phase = rng.uniform(0, 2 * np.pi, lines.size)
    return np.cos(2 * np.pi * lines * (np.arange(n) / n)[:, None] + phase).sum(axis=1)


@pytest.mark.parametrize(("keeps", "noisy"), [(0.5, 0.02), (0.8, 0.02), (0.5, 0.5)])
def test_what_the_start_left_ringing_is_in_the_covariance_of_a_periodic_run(keeps, noisy):
    n, rate = 1000, 100.0
    rng = np.random.default_rng(3)
    u = np.tile(_multisine(n, rng), 6)
    pole = keeps ** (1 / n) * np.exp(2j * np.pi * 60.3 / n)
    a, b = [1.0, -2 * pole.real, abs(pole) ** 2], [0.0, 0.02, 0.0]
    y = signal.lfilter(b, a, u) + noisy * rng.standard_normal(u.size)
    (r,) = estimate([_periodic(u, y)])
    turn = np.exp(-2j * np.pi * r.frequency / rate)
    true = (b[1] * turn) / (1 + a[1] * turn + a[2] * turn**2)
    off = np.abs(r.H[:, 0, 0] - true) ** 2 / r.variance()[:, 0, 0]
    near = np.abs(r.frequency - 6.03) < 0.5
    assert off[near].max() < 9
    assert np.mean(off) < 2
    assert any("still rings" in f.message for f in r.findings)


def test_a_periodic_run_that_has_settled_is_not_said_to_ring():
    n = 1000
    rng = np.random.default_rng(4)
    u = np.tile(_multisine(n, rng), 5)
    told = 0
    for _ in range(40):
        y = u + 0.1 * rng.standard_normal(u.size)
        Z = np.stack([np.fft.rfft(np.column_stack([u, y])[i : i + n], axis=0)[1:-1]
                      for i in range(0, u.size, n)])  # fmt: skip
        told += bool(np.any(transient_left(Z) != 0))
    assert told <= 2
