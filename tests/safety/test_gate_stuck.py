"""A sensor that repeats one value while the output moves the joint ends the run in time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Limit, Rig
from samii_rig.run.loop import run
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.safety.judgement import violation
from samii_rig.safety.latest import Latest, observe
from samii_rig.safety.limits import GateLimits, Stuck, gate_limits
from samii_rig.signal.excitation import swept_sine
from samii_rig.types import Channel, Quality, SampleBlock
from sim.rig import open_rig

SAMII, SFLR = load_rig("samii")[0], load_rig("sflr")[0]
RATE = 500.0
CHANNELS = (Channel("v", "V", "command"), Channel("theta", "rad"))


def limits(rule: Stuck) -> GateLimits:
    whole = gate_limits(SAMII, "v_2", 4.0, "theta_2")
    theta = replace(whole.sensors[0], channel="theta", stuck=rule)
    return replace(whole, sensors=(theta,))


def after(v, theta, *, chunk=20, quality=None) -> Latest:
    """What is known after these samples, given block by block."""
    latest = Latest.nothing(2)
    values = np.column_stack([v, theta])
    flags = np.zeros(values.shape, np.uint8) if quality is None else quality
    for n in range(0, len(values), chunk):
        part = values[n : n + chunk]
        sequence = np.arange(n, n + len(part))
        time = sequence * 2_000_000
        b = SampleBlock(CHANNELS, time, sequence, part, flags[n : n + chunk])
        latest = observe(latest, b, np.array([0, 1]), (0, 1), int(time[-1]))
    return latest


def verdict(rule: Stuck, latest: Latest) -> str:
    found = violation(latest, limits(rule), latest.time)
    return "" if found is None else found.what


ANGLE = Stuck(gain=0.5, after=0.25, travel=0.01, at_once=0.1)


@pytest.mark.parametrize("chunk", [1, 7, 500])
def test_travel_is_the_integral_of_the_output_since_the_last_change(chunk):
    theta = np.r_[np.arange(100) * 1e-4, np.full(151, 0.02)]
    v = np.r_[np.full(100, 3.0), np.full(151, -0.4)]
    latest = after(v, theta, chunk=chunk)
    assert latest.since[1] == 100 * 2_000_000
    assert latest.travel[1] == pytest.approx(-0.4 * 0.3)
    assert latest.effort[1] == pytest.approx(0.4 * 0.3)


def test_an_output_that_was_not_told_moves_nothing():
    v, flags = np.full(101, -0.3), np.zeros((101, 2), np.uint8)
    v[50], flags[50, 0] = math.nan, Quality.MISSING
    latest = after(v, np.full(101, 0.02), chunk=101, quality=flags)
    assert latest.travel[1] == pytest.approx(-0.3 * 99 / RATE)
    assert latest.effort[1] == pytest.approx(0.3 * 99 / RATE)


@pytest.mark.parametrize(
    ("v", "seconds", "what"),
    [
        (0.0, 5.0, ""),  # at rest
        (0.2, 0.24, ""),  # too short to tell
        (0.2, 0.26, "stuck"),
        (-0.2, 0.26, "stuck"),
        (0.07, 0.26, ""),  # moved it by less than the travel allowed
        (0.07, 0.30, "stuck"),
        (2.0, 0.09, ""),
        (2.0, 0.11, "stuck"),  # too far to wait
    ],
)
def test_an_angle_that_does_not_follow_is_stuck(v, seconds, what):
    n = round(seconds * RATE) + 1
    assert verdict(ANGLE, after(np.full(n, v), np.full(n, 0.02))) == what


def test_the_time_counts_from_the_last_change():
    """0.3 s at 0.6 V move it by 30 mrad in the last 0.1 s."""
    theta = np.r_[np.full(100, 0.01), np.full(51, 0.02)]
    assert verdict(ANGLE, after(np.full(151, 0.6), theta)) == ""


def found(rule: Stuck, held: float, travel: float = 0.0, effort: float = 0.0):
    """What a value says that has not changed for so long."""
    fresh = replace(after([0.0], [0.0]), time=round(held * 1e9), good=(round(held * 1e9),) * 2)
    latest = replace(fresh, offset=0, travel=(0.0, travel), effort=(0.0, effort))
    return violation(latest, limits(rule), latest.time)


def test_a_number_at_its_bound_is_not_beyond_it():
    rule = replace(ANGLE, travel=0.125, at_once=0.5)
    assert found(rule, 0.1, travel=1.0) is None
    d = found(rule, 0.1, travel=1.5)
    assert (d.what, d.number, d.limit, d.unit) == ("stuck", 0.75, 0.5, "rad")
    assert found(rule, 0.3, travel=0.25) is None
    d = found(rule, 0.25, travel=0.5)
    assert (d.what, d.number, d.limit) == ("stuck", 0.25, 0.125)
    noisy = Stuck(noise_after=1.0, effort=0.5)
    assert found(noisy, 1.0, effort=0.5) is None
    d = found(noisy, 1.0, effort=0.6)
    assert (d.what, d.number, d.limit, d.unit) == ("stuck", 1.0, 1.0, "s")


def test_an_output_that_goes_to_and_fro_moves_an_angle_nowhere():
    t = np.arange(1000) / RATE
    assert verdict(ANGLE, after(np.cos(2 * np.pi * 20 * t), np.full(1000, 0.02))) == ""


def test_one_step_of_the_encoder_is_a_sign_of_life():
    theta = np.where(np.arange(1000) // 100 % 2 == 0, 0.02, 0.02004)
    assert verdict(ANGLE, after(np.full(1000, 0.09), theta)) == ""


def test_values_that_are_marked_missing_are_no_sign_of_life():
    flags = np.zeros((200, 2), np.uint8)
    flags[50::2, 1] = Quality.MISSING
    theta = np.full(200, 0.02)
    theta[50::2] = math.nan
    assert verdict(ANGLE, after(np.full(200, 0.2), theta, quality=flags)) == "stuck"


@pytest.mark.parametrize(
    ("v", "seconds", "what"), [(0.1, 0.99, ""), (0.1, 1.01, "stuck"), (0.009, 3.0, "")]
)
def test_a_noisy_sensor_that_repeats_for_a_second_of_motion_is_stuck(v, seconds, what):
    rule, n = Stuck(noise_after=1.0, effort=0.01), round(seconds * RATE) + 1
    to_and_fro = v * (-1.0) ** np.arange(n)
    assert verdict(rule, after(to_and_fro, np.full(n, 0.02))) == what


def test_the_rule_comes_from_the_rig_file():
    theta, a_0, _ = gate_limits(SAMII, "v_2", 4.0, "theta_2").sensors
    assert theta.stuck.gain == 0.5
    assert theta.stuck.travel == pytest.approx(0.0035)
    assert theta.stuck.at_once == pytest.approx(0.175)
    assert a_0.stuck.gain == 0.0
    assert a_0.stuck.noise_after == 1.0
    (angle,) = gate_limits(SFLR, "v", 163.0, "theta").sensors
    assert angle.stuck.travel == pytest.approx(16 * 2 * np.pi / 1024)
    assert angle.stuck.noise_after == math.inf, "a coarse encoder without noise may rest"
    more = (*SFLR.limit, Limit(channel="a", unit="m/s^2", max=400.0, reason="test"))
    loose = gate_limits(SFLR.model_copy(update={"limit": more}), "v", 0.0, "theta")
    assert [s.stuck.after for s in loose.sensors] == [0.25, math.inf]


class Memory:
    def __init__(self):
        self.blocks = []

    def write(self, block):
        self.blocks.append(block)

    def event(self, time, name, payload):
        pass

    def segment(self, segment):
        pass

    def column(self, name):
        i = [c.name for c in self.blocks[0].channels].index(name)
        return np.concatenate([b.values[:, i] for b in self.blocks])

    def flags(self, name):
        i = [c.name for c in self.blocks[0].channels].index(name)
        return np.concatenate([b.quality[:, i] for b in self.blocks])


def plan(rig: Rig, level: float, drive: str, kp: float, band=(0.5, 20.0)) -> Plan:
    u, f = swept_sine(rig.rate_hz, *band, 8.0, ramp=0.5, lead_in=0.3, ring_down=1.0)
    still = np.zeros_like(u)
    pair = (level * u, still) if drive == "output" else (still, level * u)
    parts = (PlannedSegment("burst", "burst", level, "V", 0, *pair, band, f),)
    assert rig.centring is not None
    return Plan("test", rig.rate_hz, rig.actuator[0].name, kp, rig.centring.sensor, parts, 0)


@pytest.mark.parametrize(
    ("rig", "level", "drive", "within"),
    [(SAMII, 0.5, "output", 0.5), (SFLR, 0.4, "reference", 0.8)],
)
@pytest.mark.parametrize("at", [2.0, 3.3, 5.0])
def test_a_frozen_centring_sensor_trips_before_the_joint_reaches_its_limit(
    rig, level, drive, within, at
):
    sensor = rig.centring.sensor
    sink = Memory()
    the_plan = plan(rig, level, drive, rig.centring.kp)
    stop = run(the_plan, rig, open_rig(rig, {"stuck": {sensor: at}}), sink)
    assert stop.status == "tripped"
    assert f"{sensor} is stuck" in stop.reason
    time = np.concatenate([b.time for b in sink.blocks]) * 1e-9
    # The tail is read for a tick or two after the trip.
    assert time[-1] < at + within + 0.1
    v, theta = sink.column(the_plan.actuator), sink.column(sensor)
    source = next(e for e in rig.element if e.kind == "angular_velocity_source")
    gone = source.K.value * np.cumsum(v[time >= at]) / rig.rate_hz
    limit = min(x.max for x in rig.limits_on(sensor))
    assert np.abs(theta[-1] + gone).max() < limit


def test_a_frozen_accelerometer_trips_by_its_missing_noise():
    the_plan = plan(SAMII, 0.5, "output", SAMII.centring.kp)
    stop = run(the_plan, SAMII, open_rig(SAMII, {"stuck": {"a_2": 3.0}}), Memory())
    assert stop.status == "tripped"
    assert "a_2 is stuck" in stop.reason


@pytest.mark.parametrize(
    ("rig", "level", "drive"), [(SAMII, 0.05, "output"), (SFLR, 0.02, "reference")]
)
def test_small_slow_motion_of_a_sound_sensor_never_trips(rig, level, drive):
    the_plan = plan(rig, level, drive, rig.centring.kp, band=(0.2, 38.0))
    assert run(the_plan, rig, open_rig(rig, {}), Memory()).status == "completed"


def test_a_stuck_sensor_holds_its_flag_too():
    """What is clipped behind a frozen converter is not known: it must not show."""
    narrow = [s.model_copy(update={"low": -0.01, "high": 0.01}) for s in SAMII.sensor]
    rig = SAMII.model_copy(update={"sensor": tuple(narrow)})
    device = open_rig(rig, {"stuck": {"a_2": 0.1}, "noise": False})
    the_plan = plan(SAMII, 0.5, "output", 0.0)
    run(the_plan, rig.model_copy(update={"limit": ()}), device, sink := Memory())
    assert (sink.flags("a_1") & Quality.CLIPPED).any()
    assert not sink.flags("a_2").any()
