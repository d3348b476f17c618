"""Multisine files: what a plan drives, and that a run of one comes out as the model says."""

from __future__ import annotations

import numpy as np
import pytest
from experiments_kit import toml
from fake_device import fake_rig
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.multisine import Multisine
from samii_rig.errors import InputError
from samii_rig.model.sampled import sampled_response
from samii_rig.record.reader import read_recording
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.rig.load import load_rig, parse
from samii_rig.run.dryrun import predict
from samii_rig.run.experiments import load_experiment
from samii_rig.run.loop import run
from samii_rig.run.sink import recorded_channels
from samii_rig.signal import statistics
from samii_rig.signal.estimate import estimate
from samii_rig.signal.multisine import multisine, odd_lines
from sim.rig import open_rig

RIG = fake_rig()
GOOD = {
    "experiment": "multisine",
    "name": "many",
    "actuator": "v",
    "unit": "V",
    "period": 4.0,
    "low_hz": 1.0,
    "high_hz": 20.0,
    "amplitudes": [0.5, 1.0],
    "realisations": 2,
    "periods": 3,
    "settle": 2,
    "ramp": 0.5,
}


def experiment(**changes):
    return parse(Multisine, toml({**GOOD, **changes}), "many.toml")


def recorded(segment):
    return segment.u[slice(*segment.recorded)]


@given(
    low=st.floats(0.1, 5.0),
    width=st.floats(2.0, 30.0),
    period=st.floats(2.0, 20.0),
    group=st.integers(2, 8),
    seed=st.integers(0, 1000),
)
def test_of_each_group_of_odd_lines_one_is_left_out(low, width, period, group, seed):
    lines = odd_lines(low, low + width, period, group, np.random.default_rng(seed))
    both = np.sort(np.concatenate([lines.excited, lines.odd]))
    assert np.all(both % 2 == 1)
    assert np.all(np.diff(both) == 2)
    assert both[0] / period >= low - 1e-6
    assert both[-1] / period <= low + width + 1e-6
    place = np.searchsorted(both, lines.odd)
    np.testing.assert_array_equal(place // group, np.arange(both.size // group))


def test_only_odd_lines_of_the_band_are_driven_and_detection_lines_are_empty():
    for segment in experiment().plan(RIG).segments:
        n = 2000
        size = np.abs(np.fft.rfft(recorded(segment)[:n]))
        driven = np.flatnonzero(size > 1e-9 * size.max())
        assert np.all(driven % 2 == 1)
        assert 4 <= driven[0] <= 7
        assert 77 <= driven[-1] <= 80
        # 38 odd lines, of which nine whole groups of four lose one each.
        assert driven.size == 38 - 9
        np.testing.assert_allclose(size[driven], size[driven[0]])


def test_the_recorded_segment_is_whole_periods_and_the_ramps_lie_outside():
    for segment in experiment().plan(RIG).segments:
        assert segment.kind == "periodic"
        x = recorded(segment)
        assert x.size == 4 * 2000
        np.testing.assert_array_equal(x[2000:], x[:-2000])
        start, stop = segment.recorded
        assert start == 250 + 2000
        assert segment.u.size - stop == 250
        np.testing.assert_array_equal(segment.u[250:start], x[:2000])
        steepest = np.abs(np.diff(x)).max()
        whole = np.concatenate([[0.0], segment.u, [0.0]])
        assert np.abs(np.diff(whole)).max() <= 1.01 * steepest


def test_the_peak_is_the_level_and_all_realisations_have_one_spectrum():
    plan = experiment(realisations=4).plan(RIG)
    for level in (0.5, 1.0):
        waves = [recorded(s) for s in plan.segments if s.level == level]
        assert max(np.abs(w).max() for w in waves) == pytest.approx(level, rel=1e-12)
        rms = [np.sqrt(np.mean(w**2)) for w in waves]
        np.testing.assert_allclose(rms, rms[0])
        assert level / rms[0] <= 2.5
        assert abs(np.corrcoef(waves)[0, 1]) < 0.5
        assert max(np.abs(s.u).max() for s in plan.segments if s.level == level) <= level
    a, b = (next(s for s in plan.segments if s.level == x) for x in (0.5, 1.0))
    np.testing.assert_allclose(b.u, 2 * a.u)


@settings(max_examples=25)
@given(crest=st.floats(1.9, 4.0), seed=st.integers(0, 1000))
def test_the_crest_factor_is_reached_without_changing_the_amplitudes(crest, seed):
    lines = np.arange(5, 161, 2)
    amplitude = np.linspace(1.0, 0.3, lines.size)
    x = multisine(1000, lines, amplitude, crest, np.random.default_rng(seed))
    assert np.sqrt(np.mean(x**2)) == pytest.approx(1.0)
    assert np.abs(x).max() <= crest
    size = np.abs(np.fft.rfft(x))[lines]
    np.testing.assert_allclose(size / size[0], amplitude, rtol=1e-9)


def test_a_schedule_shapes_the_spectrum():
    plan = experiment(schedule=[[5.0, 1.0], [10.0, 0.1]]).plan(RIG)
    x = recorded(plan.segments[0])[:2000]
    size, f = np.abs(np.fft.rfft(x)), np.arange(1001) / 4
    low, high = (np.unique(np.round(size[b & (size > 1e-6)], 6)) for b in (f < 5, f > 10))
    assert high[0] / low[0] == pytest.approx(0.1, rel=1e-4)


def test_the_seed_decides_the_phases_and_the_order_is_as_asked():
    a, b, c = (experiment(seed=s).plan(RIG).segments[0].u for s in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    plan = experiment(order="by_realisation").plan(RIG)
    assert [(s.level, s.repeat) for s in plan.segments] == [(0.5, 0), (1.0, 0), (0.5, 1), (1.0, 1)]


def test_the_reference_can_be_driven_instead():
    plan = experiment(drive="reference", unit="rad", amplitudes=[0.1]).plan(RIG)
    assert not plan.segments[0].u.any()
    assert max(np.abs(s.theta_ref).max() for s in plan.segments) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"high_hz": 0.5}, "high_hz: 0.5 Hz; expected more than low_hz"),
        ({"group": 1}, "group"),
        ({"periods": 1}, "periods"),
        ({"settle": 0}, "settle"),
        ({"crest": 0.9}, "crest"),
        ({"kp": -1.0}, "kp"),
        ({"amplitudes": [1.0, 1.0]}, "each level once"),
        ({"schedule": [[5.0, 0.001]]}, "schedule"),
        ({"schedule": [[5.0, 1.0], [4.0, 1.0]]}, "must increase"),
    ],
)
def test_what_is_wrong_in_a_file_is_said_in_one_line(change, words):
    with pytest.raises(InputError) as wrong:
        experiment(**change)
    assert words in str(wrong.value)
    assert "\n" not in str(wrong.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"actuator": "valve"}, "expected an actuator of pendulum: v"),
        ({"unit": "count"}, "expected 'V', the unit of actuator v"),
        ({"period": 1.0007}, "expected a whole number of samples, such as 1 s"),
        ({"period": 1e-5}, "expected a whole number of samples, such as 0.002 s"),
        ({"period": 0.2}, "4 odd lines between low_hz and high_hz at least"),
        ({"high_hz": 230.0}, "expected at most 225 Hz, 0.45 of the rate"),
        ({"periods": 1000, "realisations": 1000}, "a plan of at most 3 hours"),
        ({"drive": "reference", "unit": "rad", "kp": 0.0}, "acts through kp alone"),
    ],
)
def test_what_the_rig_cannot_do_is_said_in_one_line(change, words):
    with pytest.raises(InputError) as wrong:
        experiment(**change).plan(RIG)
    assert words in str(wrong.value)
    assert "\n" not in str(wrong.value)


def test_the_shipped_file_is_found_and_takes_ten_minutes():
    rig, _ = load_rig("samii")
    plan = load_experiment("multisine", rig)[0].plan(rig)
    assert plan.duration == pytest.approx(612.0)
    assert len({s.level for s in plan.segments}) == 2


def test_the_dry_run_speaks_of_the_driven_lines_alone():
    rig = RIG.model_copy(
        update={"sensor": tuple(s.model_copy(update={"noise_rms": 1e-3}) for s in RIG.sensor)}
    )
    plan = experiment(kp=0.0, amplitudes=[0.1]).plan(rig)
    predicted = predict(plan, rig)
    segment = plan.segments[0]
    n = 3 * 2000
    line = np.abs(np.fft.rfft(recorded(segment)[2000:])).max()
    std = [b.std for b in predicted.bands]
    np.testing.assert_allclose(std, 1e-3 * np.sqrt(n / 2) / line, rtol=1e-3)


# On the simulated rig


def measured(tmp_path, seed, changes, **device):
    """Responses of a short multisine run on the simulated SAMII, and its recording."""
    rig, text = load_rig("samii")
    plan = parse(
        Multisine,
        toml({**GOOD, "actuator": "v_2", "high_hz": 40.0, "settle": 6, **changes}),
        "many.toml",
    ).plan(rig)
    opened = open_rig(rig, {"seed": seed, **device})
    path = tmp_path / "run.mcap"
    channels = recorded_channels(rig, plan, opened.sensor.channels)
    with RunWriter(path, channels, plan.rate_hz, Origin(text)) as writer:
        stopped = run(plan, rig, opened, writer)
        writer.close(stopped)
    recording = read_recording(path)
    assert recording.stop.status == "completed"
    return estimate([recording]), recording, rig


def test_a_run_on_the_linear_rig_gives_the_model_and_no_distortion(tmp_path):
    responses, recording, rig = measured(
        tmp_path, 3, {"period": 8.0, "settle": 4, "amplitudes": [1.0]}
    )
    assert [r.level for r in responses] == [1.0]
    u = recording.values[:, recording.column("u")]
    for s in recording.segments:
        a = int(np.searchsorted(recording.sequence, s.start))
        assert s.stop - s.start == 4 * 4000
        np.testing.assert_array_equal(u[a : a + 12000], u[a + 4000 : a + 16000])
    for r in responses:
        assert r.method.startswith("periodic (over realisations")
        assert "2 realisations of 3 periods" in r.why
        assert r.n_averages == 6
        assert not [f for f in r.findings if f.kind == "distortion"]
        truth = sampled_response(rig, r.frequency)
        size = np.abs(r.H - truth) ** 2 / r.variance()
        # Mean of F(2, 2 nu) is nu/(nu - 1); lines that share a covariance scatter together.
        assert size.mean() == pytest.approx(1.03, abs=0.2)
        _, p_value = statistics.model_distance(r, truth)
        assert 0.02 < np.mean(p_value < 0.1) < 0.2


def test_friction_shows_as_odd_distortion_that_falls_with_the_level(tmp_path):
    responses, _, _ = measured(tmp_path, 4, {}, coulomb_friction=0.05)
    low, high = responses
    for r in responses:
        found = [f for f in r.findings if f.kind == "distortion"]
        assert {f.channel for f in found} == {"theta_2", "a_0", "a_1", "a_2"}
        assert all(f.message.startswith("odd") and f.severity == "warning" for f in found)
        assert np.median(r.even[:, 0]) < 0.05 * np.median(r.odd[:, 0])
    ratio = np.median(low.odd, axis=0) / np.median(high.odd, axis=0)
    assert np.all((ratio > 1.5) & (ratio < 2.7))
