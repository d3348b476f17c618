"""The device's feedback loops: checked in the rig file, run by the device, closed in the model.

Plan: a filter that could do harm never loads; the simulated device does what the filter's
formula says and what the closed model says; the response from v to the sensors does not know
of the loop; every way out of a run with a loop ends at zero volts; the dry run foresees it.
"""

from __future__ import annotations

from dataclasses import replace
from threading import Event

import numpy as np
import pytest
from feedback_kit import (
    A_0,
    BAND,
    LOOP,
    RATE,
    SAMII,
    TEXT,
    THETA,
    Memory,
    U,
    V,
    plan_for,
    rig_with,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError, InputError, LimitError
from samii_rig.model.feedback import analogue, digital, reach, sections, state_space
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.schema import Feedback
from samii_rig.run.client import Client
from samii_rig.run.dryrun import predict
from samii_rig.run.loop import run
from samii_rig.safety.judgement import command_violation
from samii_rig.safety.latest import Latest
from samii_rig.safety.limits import gate_limits
from samii_rig.safety.readback import Sent
from samii_rig.signal.estimate import estimate
from samii_rig.types import Quality, Recording
from sim.rig import open_rig

W = 5.6  # rad/s, corner of the damping loop


def loop(**changes) -> Feedback:
    given = {"name": "f", "sensor": "a_0", "actuator": "v_2", "unit": "V/(m/s^2)", "max": 2.0}
    return Feedback(**{**given, "gain": 1.0, **changes})


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("-5.6, -5.6, -5.6", "-5.6, 0.0", "pole at 0+0j rad/s: not stable"),
        ("-5.6, -5.6, -5.6", "-5.6, [2.0, 3.0]", "pole at 2+3j rad/s: not stable"),
        ("-5.6, -5.6, -5.6", "[-2.0, -3.0]", "expected the one of the pair with im > 0"),
        ("max = 2.0", "max = 2.0\nzeros = [1, 2, 3, 4]", "4 zeros over 3 poles: not proper"),
        ("max = 2.0", "max = 2.0\nnumerator = [1]", "expected one form"),
        ("max = 2.0", "max = 0", "greater than 0"),
        ('"a_0"', '"a_9"', "sensor 'a_9' does not exist; expected one of"),
        ('"v_2"', '"v_9"', "actuator 'v_9' does not exist"),
        ('"V/(m/s^2)"', '"V/g"', "unit 'V/g' of F(s); expected 'V/(m/s^2)'"),
    ],
)
def test_a_filter_that_could_do_harm_is_refused_in_one_line(old, new, said):
    with pytest.raises(InputError) as caught:
        rig_with(LOOP.replace(old, new))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_both_forms_of_a_filter_are_the_same():
    poles = loop(gain=18.0, zeros=(-2.0,), poles=((-1.0, 2.0), -3.0))
    fraction = loop(
        gain=18.0, numerator=(1.0, 2.0), denominator=tuple(np.poly([-1 + 2j, -1 - 2j, -3]).real)
    )
    s = 1j * np.geomspace(0.1, 100, 30)
    np.testing.assert_allclose(analogue(poles, s), analogue(fraction, s), rtol=1e-12)


stable = st.lists(
    st.one_of(
        st.floats(-300, -0.5),
        st.tuples(st.floats(-200, -0.5), st.floats(0.5, 300)),
    ),
    min_size=1,
    max_size=3,
)


@given(stable, st.lists(st.floats(-50, 50), max_size=1), st.integers(0, 2**31))
@settings(max_examples=25)
def test_the_digital_filter_is_tustins_whatever_its_poles(poles, zeros, seed):
    f = loop(poles=tuple(poles), zeros=tuple(zeros))
    z = np.exp(2j * np.pi * np.array([0.01, 0.7, 3.0, 20.0, 120.0]) / RATE)
    wanted = digital(f, z, RATE)
    sos = np.insert(sections(f, RATE), 3, 1.0, axis=1)
    _, by_sections = signal.sosfreqz(sos, np.angle(z))
    np.testing.assert_allclose(by_sections, wanted, rtol=1e-6)
    A, B, C, D = state_space(f, RATE)
    by_states = [(C @ np.linalg.solve(x * np.eye(len(A)) - A, B) + D)[0, 0] for x in z]
    np.testing.assert_allclose(by_states, wanted, rtol=1e-6)
    # No input, however chosen, makes more of it than the bounds say.
    y = np.sign(np.random.default_rng(seed).standard_normal(4000))
    out, bound = signal.sosfilt(sos, y), reach(f, RATE)
    assert np.abs(out).max() <= bound.peak * (1 + 1e-9)
    assert np.abs(np.diff(out)).max() * RATE <= bound.slew * (1 + 1e-9)


def opened(rig, **changes):
    device = open_rig(rig, {"noise": False, "band_hz": BAND, **changes.pop("settings", {})})
    values = {"kp": 4.0, "max_output": 10.0, "max_rate": 1e9, "max_angle": 1e9, **changes}
    device.actuator.configure(DeviceLoop("theta_2", feedback=rig.feedback, **values))
    return device


def drive(device, u, first=0, then=0.0):
    u = np.asarray(u, dtype=float)
    device.actuator.write(CommandBlock(first, u, np.zeros_like(u)))
    device.clock.sleep(u.size / RATE + then)
    return device.sensor.read()


def fed_back(block, limit=2.0):
    """The loop's output from the samples read back, by the formula."""
    sos = np.insert(sections(rig_with().feedback[0], RATE), 3, 1.0, axis=1)
    return np.clip(signal.sosfilt(sos, block.values[:, A_0]), -limit, limit)


def test_the_device_adds_the_filtered_sensor_from_zero_state():
    block = drive(opened(rig_with()), 2.0 * np.sin(0.02 * np.arange(1000)))
    v, theta, u = (block.values[:, i] for i in (V, THETA, U))
    expected = u - 4.0 * theta + fed_back(block)
    step = SAMII.actuator[0].resolution
    np.testing.assert_allclose(v, expected, atol=0.51 * step)
    assert np.abs(fed_back(block)).max() > 0.1


def test_a_clipped_loop_winds_nothing_up():
    rig = rig_with(LOOP.replace("max = 2.0", "max = 0.02"))
    block = drive(opened(rig), 2.0 * np.sin(0.02 * np.arange(2000)))
    added = block.values[:, V] - block.values[:, U] + 4.0 * block.values[:, THETA]
    step = SAMII.actuator[0].resolution
    np.testing.assert_allclose(added, fed_back(block, 0.02), atol=0.51 * step)
    assert np.mean(np.abs(np.abs(added) - 0.02) < step) > 0.3
    assert not block.quality[:, V].any()


def test_after_zero_the_filter_starts_afresh():
    device = opened(rig_with())
    drive(device, 3.0 * np.ones(300))
    device.actuator.zero()
    device.clock.sleep(0.2)
    quiet = device.sensor.read()
    assert np.all(quiet.values[:, V] == 0.0)
    assert np.abs(quiet.values[:, A_0]).max() > 0.1, "the structure rings on"
    again = drive(device, np.zeros(200), first=int(quiet.sequence[-1]) + 1)
    np.testing.assert_allclose(
        again.values[:, V],
        -4.0 * again.values[:, THETA] + fed_back(again),
        atol=0.51 * SAMII.actuator[0].resolution,
    )


def test_when_the_host_falls_silent_the_deadman_ends_the_loop_too():
    block = drive(opened(rig_with()), 3.0 * np.ones(100), then=0.5)
    v = block.values[:, V]
    alone = slice(101, 100 + round(0.05 * RATE))
    assert np.abs(v[alone]).max() > 0.0
    assert np.all(v[100 + round(0.05 * RATE) + 1 :] == 0.0)


@pytest.mark.parametrize("fault", [{"nan": {"a_0": 0.4}}])
def test_a_sensor_without_a_number_drops_the_device_to_zero(fault):
    device = opened(rig_with(), settings=fault)
    block = drive(device, np.sin(0.05 * np.arange(400)))
    assert np.all(block.values[200:, V] == 0.0)
    assert np.all(block.quality[200:, V] & Quality.LIMITED)
    assert np.isfinite(block.values[:, V]).all()


def test_a_device_refuses_a_loop_that_it_cannot_close():
    device = open_rig(SAMII, {"band_hz": BAND})
    for wrong in (loop(sensor="elbow"), loop(actuator="v_7")):
        with pytest.raises(DeviceError, match=r"elbow|v_7"):
            device.actuator.configure(DeviceLoop("theta_2", 4.0, 5, 1e9, 1, (wrong,)))


@pytest.mark.parametrize(
    ("fault", "status", "said"),
    [
        ({}, "completed", "all 1 segments done"),
        ({"nan": {"a_0": 2.0}}, "tripped", "the device itself changed v_2"),
        ({"stuck": {"a_0": 2.0}}, "tripped", "a_0 is stuck"),
    ],
)
def test_every_end_of_a_run_with_a_loop_is_zero_volts(fault, status, said):
    rig = rig_with()
    sink, device = Memory(), open_rig(rig, {"seed": 1, "band_hz": BAND, **fault})
    stop = run(plan_for(), rig, device, sink)
    assert (stop.status, said in stop.reason) == (status, True), stop
    assert sink.values()[-1, V] == 0.0
    device.clock.sleep(1.0)
    assert np.all(device.sensor.read().values[:, V] == 0.0)


def test_a_stop_and_a_broken_recorder_end_at_zero_too():
    for kind in ("stop", "exception"):
        rig, event = rig_with(), Event()
        sink, device = Memory(), open_rig(rig, {"seed": 1, "band_hz": BAND})
        taken = sink.write

        def write(block, taken=taken, event=event, kind=kind, sink=sink):
            taken(block)
            if len(sink.blocks) == 4:
                if kind == "exception":
                    raise OSError("disk full")
                event.set()

        sink.write = write
        stop = run(plan_for(), rig, device, sink, Client(stop=event))
        assert stop.status == {"stop": "stopped", "exception": "failed"}[kind]
        assert np.abs(sink.values()[:, V]).max() > 0.0
        device.clock.sleep(1.0)
        assert np.all(device.sensor.read().values[:, V] == 0.0)


def test_the_gate_reckons_with_all_that_the_loop_may_add():
    limits = gate_limits(rig_with(), "v_2", 4.0, "theta_2")
    bare = gate_limits(SAMII, "v_2", 4.0, "theta_2")
    names = [c.channel for c in limits.channels]
    latest = replace(
        Latest.nothing(len(names)), sequence=0, peak=tuple(0.0 for _ in names), next=10
    )
    for level, passes in ((2.9, True), (3.1, False)):
        block = CommandBlock(10, np.full(5, level), np.zeros(5))
        # Out of the slew's way: the block before ended at this level.
        now = replace(latest, u=level)
        assert (command_violation(block, now, limits, Sent()) is None) is passes
        assert command_violation(block, now, bare, Sent()) is None
    rest = CommandBlock(10, np.zeros(5), np.zeros(5))
    shaken = replace(latest, peak=tuple(300.0 if n == "a_0" else 0.0 for n in names))
    assert "rate" in command_violation(rest, shaken, limits, Sent()).reason
    assert "a_0" in names
    assert limits.device_loop().feedback == rig_with().feedback


def test_a_loop_makes_its_sensor_one_that_must_be_alive():
    rig = rig_with(LOOP.replace('"a_0"', '"a_1"'))
    assert "a_1" in [c.channel for c in gate_limits(rig, "v_2", 0.0, "theta_2").sensors]
    assert "a_1" not in [c.channel for c in gate_limits(SAMII, "v_2", 0.0, "theta_2").sensors]


def test_the_dry_run_foresees_the_closed_loop():
    rig = rig_with()
    plan = plan_for(level=0.5)
    predicted, bare = predict(plan, rig), predict(plan, SAMII)
    predicted.refuse()
    sink = Memory()
    run(plan, rig, open_rig(rig, {"noise": False}), sink)
    values = sink.values()
    for name, column in (("v_2", V), ("theta_2", THETA), ("a_0", A_0)):
        foreseen = predicted.peaks[0, predicted.channels.index(name)]
        assert np.abs(values[:, column]).max() == pytest.approx(foreseen, rel=5e-3), name
    i = predicted.channels.index("a_0")
    assert predicted.peaks[0, i] != pytest.approx(bare.peaks[0, i], rel=0.05)
    (own,) = [m for m in predicted.margins if m.channel == "damping"]
    added = fed_back(replace(sink.blocks[0], values=values))
    # Above what it comes to by the part that the sensor's noise and steps could add.
    assert 0.0 < own.predicted - np.abs(added).max() < 0.02


def test_the_dry_run_refuses_a_loop_that_is_clipped_or_unstable():
    small = rig_with(LOOP.replace("max = 2.0", "max = 0.05"))
    with pytest.raises(LimitError, match=r"damping would reach .* over its max"):
        predict(plan_for(level=1.0), small).refuse()
    wrong = rig_with(LOOP.replace("gain = 1296.0", "gain = -1296.0"))
    with pytest.raises(LimitError, match="feedback damping on a_0 would be unstable"):
        predict(plan_for(), wrong)


def test_the_response_from_v_does_not_know_of_the_loop():
    """The estimate through the reference is that of the rig without the loop, within its
    intervals; what the loop does to the structure is in v itself."""
    rig = rig_with()
    sink, device = Memory(), open_rig(rig, {"seed": 4})
    plan = plan_for(level=0.5, duration=16.0, repeats=3, ring_down=14.0)
    run(plan, rig, device, sink)
    sequence = np.concatenate([b.sequence for b in sink.blocks])
    time = np.concatenate([b.time for b in sink.blocks])
    recording = Recording(
        device.sensor.channels,
        RATE,
        time,
        sequence,
        sink.values(),
        np.concatenate([b.quality for b in sink.blocks]),
        tuple(sink.segments),
        rig_toml=TEXT + LOOP,
    )
    (found,) = estimate([recording], band=(1.0, 15.0))
    truth = sampled_response(SAMII, found.frequency)[:, :, 0]
    H, sd = found.H[:, :, 0], np.sqrt(found.variance()[:, :, 0])
    off = np.abs(H - truth) / sd
    assert found.frequency.size > 50
    # |error|^2/variance is 1 in the mean; the biased estimate Y/V would be far off at mode 1.
    assert np.median(off) < 1.2
    assert np.mean(off < 3.0) > 0.9
