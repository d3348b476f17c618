"""The dry run: what the model predicts is what the simulated rig then does, and a plan that
would break a limit is refused with the level that would not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from fake_device import RATE, FakeDevice, K, fake_rig
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from samii_rig.errors import InputError, LimitError
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Limit, Rig
from samii_rig.run.dryrun import predict
from samii_rig.run.experiments import load_experiment
from samii_rig.run.loop import run
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.signal.excitation import swept_sine
from sim.rig import open_rig

FAKE = fake_rig()


class Memory:
    def __init__(self):
        self.blocks, self.segments = [], []

    def write(self, block):
        self.blocks.append(block)

    def event(self, time, name, payload):
        pass

    def segment(self, segment):
        self.segments.append(segment)


def plan_for(rig: Rig, levels, *, drive="output", kp=None, band=(0.5, 40.0), duration=8.0) -> Plan:
    u, f = swept_sine(rig.rate_hz, *band, duration, ramp=0.5, lead_in=0.3, ring_down=1.5)
    rest = np.zeros_like(u)
    unit = rig.actuator[0].unit if drive == "output" else "rad"
    parts = []
    for i, level in enumerate(levels):
        pair = (level * u, rest) if drive == "output" else (rest, level * u)
        parts.append(PlannedSegment(f"s{i}", "burst", level, unit, i, *pair, band, f))
    kp = rig.centring.kp if kp is None else kp
    name = rig.actuator[0].name
    return Plan("test", rig.rate_hz, name, kp, rig.centring.sensor, tuple(parts), 0)


def simulate(rig, plan, **settings_):
    """(stop record, values of each channel in each segment) of the simulated rig."""
    sink, device = Memory(), open_rig(rig, settings_)
    stop = run(plan, rig, device, sink)
    values = np.concatenate([b.values for b in sink.blocks])
    sequence = np.concatenate([b.sequence for b in sink.blocks])
    names = [c.name for c in device.sensor.channels]
    parts = []
    for s in sink.segments:
        inside = (sequence >= s.start) & (sequence < s.stop)
        parts.append(dict(zip(names, values[inside].T, strict=True)))
    return stop, parts


@pytest.mark.parametrize(
    ("name", "drive", "levels"),
    [("samii", "output", [0.05, 0.1]), ("sflr", "reference", [0.2, 0.4])],
)
def test_the_simulated_rig_reaches_the_predicted_peaks(name, drive, levels):
    rig, _ = load_rig(name)
    plan = plan_for(rig, levels, drive=drive)
    predicted = predict(plan, rig)
    predicted.refuse()
    stop, parts = simulate(rig, plan, noise=False)
    assert stop.status == "completed"
    for i, part in enumerate(parts):
        for j, channel in enumerate(predicted.channels):
            if channel in part:
                # Half a step of the drive's converter is not in the prediction.
                slack = 0.5 * rig.actuator[0].resolution if channel == plan.actuator else 0.0
                peak = np.abs(part[channel]).max()
                assert predicted.peaks[i, j] == pytest.approx(peak, rel=0.01, abs=slack), channel


def test_what_a_burst_leaves_behind_is_part_of_the_next_ones_prediction():
    """SAMII's first mode rings for a minute: a silent segment after a burst is not at rest."""
    rig, _ = load_rig("samii")
    plan = plan_for(rig, [0.1, 0.1], band=(1.2, 2.5))
    silent = replace(plan.segments[1], u=np.zeros_like(plan.segments[1].u))
    plan = replace(plan, segments=(plan.segments[0], silent))
    predicted = predict(plan, rig)
    _, parts = simulate(rig, plan, noise=False)
    peak = np.abs(parts[1]["a_2"]).max()
    assert peak > 0.5
    assert predicted.peaks[1, predicted.channels.index("a_2")] == pytest.approx(peak, rel=0.01)


def test_without_centring_the_drift_adds_up_over_the_segments():
    plan = plan_for(FAKE, [0.02] * 3, kp=0.0)
    push = tuple(replace(s, u=s.u + 0.01) for s in plan.segments)
    predicted = predict(replace(plan, segments=push), FAKE)
    theta = predicted.peaks[:, predicted.channels.index("theta")]
    each = K * push[0].u.sum() / RATE
    np.testing.assert_allclose(theta, each * np.arange(1, 4), rtol=0.05)
    np.testing.assert_allclose(np.diff(theta), each, rtol=1e-3)


@settings(max_examples=15)
@given(level=st.floats(0.01, 30.0))
def test_the_level_that_is_named_passes_and_a_little_more_does_not(level):
    predicted = predict(plan_for(FAKE, [level, level / 2], duration=2.0), FAKE)
    try:
        predicted.refuse()
    except LimitError as refusal:
        largest = float(re.search(r"would not: ([0-9.e+-]+) V", str(refusal))[1])
        predict(plan_for(FAKE, [largest, largest / 2], duration=2.0), FAKE).refuse()
        more = 1.011 * largest
        with pytest.raises(LimitError):
            predict(plan_for(FAKE, [more, more / 2], duration=2.0), FAKE).refuse()
    else:
        assert predicted.margins[0].margin >= 0.0


def test_a_refusal_names_the_number_the_limit_its_reason_and_the_level():
    with pytest.raises(LimitError) as refusal:
        predict(plan_for(FAKE, [1.0, 7.0]), FAKE).refuse()
    line = str(refusal.value)
    for words in ("theta would reach 0.8", "s1", "level 7 V", "limit of 0.35 rad", "the frame"):
        assert words in line
    assert "\n" not in line


def test_what_the_dry_run_lets_through_the_gate_does_not_trip():
    """At 99 % of the largest level the gate, which judges by bounds, still sees no cause."""
    rig, _ = load_rig("samii")
    one = predict(plan_for(rig, [0.1]), rig)
    largest = min(m.largest_level for m in one.margins)
    stop, _ = simulate(rig, plan_for(rig, [0.99 * largest]), seed=3)
    assert stop.status == "completed"
    stop, _ = simulate(rig, plan_for(rig, [1.1 * largest]), seed=3)
    assert stop.status == "tripped"


@settings(max_examples=25)
@given(kp=st.floats(10.0, 8000.0))
def test_a_loop_is_refused_exactly_when_its_poles_leave_the_unit_circle(kp):
    """theta'' = -p theta' + K p v, held for a sample, v = -kp theta."""
    p = 100.0
    M = expm(np.array([[0, 1, 0], [0, -p, K * p], [0, 0, 0]]) / RATE)
    poles = np.linalg.eigvals(M[:2, :2] - kp * np.outer(M[:2, 2], [1, 0]))
    growth = np.log(np.abs(poles).max()) * RATE  # 1/s
    assume(abs(growth) > 2.0)  # the circle of the dry run is that much larger than one
    plan = plan_for(FAKE, [1e-4], kp=kp, duration=3.0)
    said = ""
    try:
        predict(plan, FAKE)
    except LimitError as refusal:
        said = str(refusal)
    assert ("unstable" in said) == (growth > 0)


def test_a_sensor_that_would_clip_is_refused_though_no_limit_is_set():
    sensor = FAKE.sensor[0].model_copy(update={"low": -0.05, "high": 0.2})
    rig = FAKE.model_copy(update={"sensor": (sensor,)})
    with pytest.raises(LimitError, match=r"over its range of 0.05 rad \(end of the converter"):
        predict(plan_for(rig, [1.0]), rig).refuse()


def test_a_limit_on_a_rate_counts_too():
    limit = Limit(channel="theta", unit="rad", max=1.0, max_rate=0.1, reason="hose")
    rig = FAKE.model_copy(update={"limit": (limit,)})
    with pytest.raises(LimitError, match=r"over its rate of 0.1 rad/s \(hose\)"):
        predict(plan_for(rig, [1.0]), rig).refuse()


def test_an_offset_uses_up_margin_and_may_leave_none():
    def with_offset(x):
        sensor = FAKE.sensor[0].model_copy(update={"offset": x})
        return FAKE.model_copy(update={"sensor": (sensor,)})

    def margin(rig):
        found = predict(plan_for(rig, [0.5]), rig).margins
        return next(m for m in found if (m.channel, m.what) == ("theta", "limit"))

    assert margin(with_offset(0.1)).predicted == pytest.approx(margin(FAKE).predicted + 0.1)
    assert margin(with_offset(0.1)).largest_level < margin(FAKE).largest_level
    hopeless = predict(plan_for(FAKE, [0.5]), with_offset(0.4))
    with pytest.raises(LimitError, match="no level would not"):
        hopeless.refuse()


@pytest.mark.parametrize("name", ["samii", "sflr"])
def test_the_shipped_campaigns_pass_with_margin(name):
    rig, _ = load_rig(name)
    plan = load_experiment("swept_sine", rig)[0].plan(rig)
    # One round of levels: the repeats change the peaks by a percent.
    predicted = predict(replace(plan, segments=plan.segments[::3]), rig)
    predicted.refuse()
    assert predicted.margins[0].margin > 0.2
    assert any(c.startswith("M_") for c in predicted.channels)
    assert (
        predicted.units[
            predicted.channels.index(next(c for c in predicted.channels if c.startswith("M_")))
        ]
        == "N m"
    )


def test_the_predicted_error_is_the_scatter_of_simulated_runs():
    """White noise on a clean sweep: H from Y/V scatters as predicted, per channel and band."""
    rig, _ = load_rig("samii")
    plan = plan_for(rig, [0.1], duration=6.0)
    predicted = predict(plan, rig)
    n = len(plan.segments[0].u)
    f = np.fft.rfftfreq(n, 1 / rig.rate_hz)
    (clean,) = simulate(rig, plan, noise=False)[1]
    errors = {name: [] for name in ("theta_2", "a_0", "a_2")}
    V = np.fft.rfft(clean["v_2"])
    for seed in range(6):
        (noisy,) = simulate(rig, plan, seed=seed)[1]
        # What the noise made the loop do is part of both; the sensor's own error is left.
        extra = np.fft.rfft(noisy["v_2"]) - V
        for name, found in errors.items():
            H = np.fft.rfft(clean[name]) / V
            found.append((np.fft.rfft(noisy[name]) - np.fft.rfft(clean[name]) - H * extra) / V)
    for band in predicted.bands:
        if band.channel in errors and band.low_hz > 2.0:
            inside = (f >= band.low_hz) & (f < band.high_hz)
            size = np.abs(np.array(errors[band.channel])[:, inside]) ** 2
            assert np.median(np.sqrt(size.mean(axis=0))) == pytest.approx(band.std, rel=0.25), band


def test_more_repeats_and_larger_levels_lower_the_predicted_error():
    def std(levels):
        return np.array([b.std for b in predict(plan_for(SAMII, levels), SAMII).bands])

    SAMII, _ = load_rig("samii")
    one = std([0.05])
    np.testing.assert_allclose(std([0.1]), one / 2, rtol=1e-6)
    np.testing.assert_allclose(std([0.05] * 4), one / 2, rtol=0.02)


@pytest.mark.parametrize(
    ("levels", "passes"), [((3.9,), True), ((4.2,), False), ((2.1, -2.1), False)]
)
def test_the_step_between_segments_and_back_to_rest_counts(levels, passes):
    """Segments are sent without a border: at 500 Hz a step of 4 V is the 2000 V/s allowed."""
    parts = []
    for i, level in enumerate(levels):
        u = np.linspace(0.0, level, 50)  # ends at its level: no ramp down, no ring-down
        u = u if i == 0 else u[::-1]
        f = np.full(50, np.nan)
        parts.append(PlannedSegment(f"s{i}", "burst", 1.0, "V", i, u, 0 * u, (0.5, 40.0), f))
    plan = Plan("test", RATE, "v", 0.0, "theta", tuple(parts), 0)
    predicted = predict(plan, FAKE)
    slew = next(m for m in predicted.margins if (m.channel, m.what) == ("v", "rate"))
    step = abs(levels[0]) if len(levels) == 1 else abs(levels[1] - levels[0])
    assert slew.predicted == pytest.approx(step * RATE)
    stop = run(plan, FAKE, FakeDevice().open(), Memory())
    if passes:
        predicted.refuse()
        assert stop.status == "completed"
    else:
        with pytest.raises(LimitError, match="rate"):
            predicted.refuse()
        assert stop.status == "tripped"


def test_a_rig_that_could_never_be_armed_is_refused_before_it_is_tried():
    rig, _ = load_rig("samii")
    bare = rig.actuator[0].model_copy(update={"deadman": None})
    changed = rig.model_copy(update={"actuator": (bare,)})
    with pytest.raises(InputError, match=r"actuator\[v_2\].deadman"):
        predict(load_experiment("swept_sine", rig)[0].plan(rig), changed)


def test_a_motor_with_nothing_to_push_against_is_refused():
    rig, _ = load_rig("sflr")
    floating = rig.model_copy(update={"base": "pinned"})
    with pytest.raises(InputError, match="moves nothing"):
        predict(load_experiment("swept_sine", rig)[0].plan(rig), floating)
