"""The gate's limits from the rig file, and what the gate itself remembers between two commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_device import fake_rig
from gate_kit import LIMITS, Bench

from samii_rig.devices.protocols import CommandBlock
from samii_rig.errors import GateError, LimitError
from samii_rig.rig.schema import Feedback, Limit
from samii_rig.run import campaign
from samii_rig.run.dryrun import predict
from samii_rig.run.order import RunOrder
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.safety.limits import gate_limits
from samii_rig.types import Quality

RIG = fake_rig()


def loop(**changes) -> Feedback:
    values = {"name": "f", "sensor": "theta", "actuator": "v", "gain": 1.0, "unit": "V/(rad)"}
    return Feedback(**{**values, "poles": (-5.0,), "max": 0.5, **changes})


# From the rig file


@pytest.mark.parametrize(("low", "high", "most"), [(-3.0, 10.0, 3.0), (-10.0, 2.0, 2.0)])
def test_the_nearer_end_of_the_converter_limits_the_output(low, high, most):
    actuator = RIG.actuator[0].model_copy(update={"low": low, "high": high})
    limits = gate_limits(RIG.model_copy(update={"actuator": (actuator,)}), "v", 4.0, "theta")
    assert limits.output.max == limits.device_loop().max_output == most


def test_the_read_back_must_be_as_fresh_as_the_deadman_is_quick():
    assert LIMITS.output.stale_after == RIG.actuator[0].deadman


@pytest.mark.parametrize("turn", [1, -1])
def test_the_smallest_of_several_rates_holds_in_any_order(turn):
    more = tuple(
        Limit(channel="theta", unit="rad", max=1.0, max_rate=rate, reason="r")
        for rate in (3.0, 7.0)
    )[::turn]
    rig = RIG.model_copy(update={"limit": (*RIG.limit, *more)})
    assert gate_limits(rig, "v", 4.0, "theta").sensors[0].max_rate == 3.0


def test_what_belongs_to_another_actuator_is_not_this_ones():
    """Two joints: a feedback and a source of the other one say nothing of this one's angle."""
    other = RIG.actuator[0].model_copy(update={"name": "w"})
    source, link = RIG.element
    second = source.model_copy(update={"name": "second", "input": "w"})
    both = RIG.sensor[0].model_copy(update={"across": ("source", "second")})
    rig = RIG.model_copy(
        update={
            "actuator": (*RIG.actuator, other),
            "element": (source, second, link),
            "sensor": (both,),
            "feedback": (loop(), loop(name="g", actuator="w")),
        }
    )
    limits = gate_limits(rig, "v", 4.0, "theta")
    assert [a.loop.name for a in limits.feedback] == ["f"]
    assert limits.sensors[0].stuck.gain == 0.5
    assert [f.name for f in gate_limits(rig, "w", 4.0, "theta").device_loop().feedback] == ["g"]


# Between two commands


def bench_after(value: float, theta_ref: float = 0.0) -> Bench:
    """Running, ten samples of this reference sent."""
    bench = Bench().running()
    first = bench.device.taken + 5
    block = CommandBlock(first, np.full(10, value), np.full(10, theta_ref))
    bench.gate.write(block, bench.device.now())
    bench.next = first + 10
    return bench


def refused(bench: Bench, u: float, theta_ref: float = 0.0, first: int = 0) -> bool:
    block = CommandBlock(bench.next + first, np.full(5, u), np.full(5, theta_ref))
    try:
        bench.gate.write(block, bench.device.now())
    except GateError:
        assert not bench.device.live
        return True
    return False


def test_a_step_counts_from_the_last_sample_sent():
    """2000 V/s at 500 Hz are 4 V a sample; kp = 4 V/rad."""
    assert not refused(bench_after(3.0), -0.9)
    assert refused(bench_after(3.0), -1.1)
    assert not refused(bench_after(2.6, 0.3), 0.0, -0.0)
    assert refused(bench_after(2.6, 0.3), 0.0, -0.3)


def test_after_a_stop_a_step_counts_from_zero():
    bench = bench_after(3.0)
    bench.gate.stop("enough", bench.device.now())
    bench.ticks(2)
    bench.running()
    bench.next = bench.device.taken + 5
    assert not refused(bench, -1.1)


@pytest.mark.parametrize("first", [1, -1])
def test_a_reference_that_leaves_a_gap_or_overlaps_is_refused(first):
    assert refused(bench_after(0.0), 0.0, first=first)
    assert not refused(bench_after(0.0), 0.0)


def test_a_turning_joint_uses_up_slew_although_its_rate_has_no_limit():
    bench = Bench().running()
    bench.device.theta = 0.3  # 150 rad/s from one sample to the next, 600 V/s through kp
    bench.device.sleep(0.002)
    bench.gate.observe(bench.device.read(), bench.device.now())
    bench.next = bench.device.taken + 5
    assert refused(bench, 3.0), "3 V are 1500 V/s"
    still = Bench().running()
    still.next = still.device.taken + 5
    assert not refused(still, 3.0)


def test_a_limited_output_trips_however_many_blocks_were_sent_since():
    bench = bench_after(0.1)
    for _ in range(3):
        bench.write(0.1)

    def spoil(block):
        block.quality[:, 0] = Quality.LIMITED
        return block

    bench.device.spoil = spoil
    with pytest.raises(GateError, match="the device itself changed v"):
        bench.tick()


# Before anything is opened


def plan_of(level: float, kp: float = 4.0) -> Plan:
    u = level * np.sin(2 * np.pi * np.arange(1000) / 100)
    segment = PlannedSegment("s", "burst", level, "V", 0, u, 0 * u, (5.0, 5.0), 0 * u)
    return Plan("test", 500.0, "v", kp, "theta", (segment,), 0)


def test_a_plan_that_breaks_a_limit_opens_no_device(tmp_path, monkeypatch):
    def never(rig, settings):
        raise AssertionError("a device was opened")

    monkeypatch.setattr(campaign, "open_device", never)
    plan = plan_of(9.0)
    with pytest.raises(LimitError, match="over its limit of 5 V"):
        campaign.carry_out(RunOrder(RIG, "", "", plan, predict(plan, RIG)), tmp_path / "run.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_feedback_alone_that_is_unstable_is_refused():
    """theta' = K v with v = +10 theta, and nothing that centres."""
    rig = RIG.model_copy(update={"feedback": (loop(gain=200.0, max=4.0),)})
    with pytest.raises(LimitError, match="feedback f on theta would be unstable"):
        predict(plan_of(0.01, kp=0.0), rig)
    damped = RIG.model_copy(update={"feedback": (loop(gain=-20.0, max=4.0),)})
    predict(plan_of(0.01, kp=0.0), damped).refuse()


def test_the_slew_of_a_feedback_is_in_the_dry_run_as_it_is_in_the_gate():
    """Its largest slew for the sensor's largest value, and for its noise and steps."""

    def slew(**changes) -> float:
        sensor = RIG.sensor[0].model_copy(update=changes)
        rig = RIG.model_copy(update={"sensor": (sensor,), "feedback": (loop(gain=-20.0),)})
        predicted = predict(plan_of(0.5), rig)
        return next(m.predicted for m in predicted.margins if (m.channel, m.what) == ("v", "rate"))

    (addition,) = gate_limits(
        RIG.model_copy(update={"feedback": (loop(gain=-20.0),)}), "v", 4.0, "theta"
    ).feedback
    bare = predict(plan_of(0.5), RIG)
    theta = predict(plan_of(0.5), RIG.model_copy(update={"feedback": (loop(gain=-20.0),)})).peaks[
        0, 1
    ]
    alone = next(m.predicted for m in bare.margins if (m.channel, m.what) == ("v", "rate"))
    assert slew() - alone == pytest.approx(addition.slew * theta, rel=0.1)
    # An offset changes nothing at rest but what it may add to each of the two bounds.
    more = slew(offset=0.01) - slew()
    assert more == pytest.approx(addition.slew * 0.01 + 2 * 4.0 * 0.01 * 500.0, rel=1e-6)


def test_the_bound_counts_the_angle_of_the_samples_that_are_still_under_way():
    """The gate judges a reference by angles of up to `max_ahead` before it."""
    first, second = np.r_[np.ones(500), -np.ones(100)], np.full(10, -2.0)
    whole = plan_of(1.0)
    parts = [
        replace(whole.segments[0], name=name, u=u, theta_ref=0 * u, frequency=0 * u)
        for name, u in (("there", first), ("back", second))
    ]
    predicted = predict(replace(whole, segments=tuple(parts)), RIG)
    bound = next(m for m in predicted.margins if (m.channel, m.what) == ("v", "limit"))
    there, back = predicted.peaks[:, predicted.channels.index("theta")]
    assert back < 0.5 * there
    assert bound.segment == "back"
    assert bound.predicted == pytest.approx(2.0 + 4.0 * there, rel=1e-6)
