"""A run with two outputs: every way out of it ends at zero volts of both."""

from __future__ import annotations

import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from fake_device import RATE, FakeDevice
from fake_pair import FakePair, pair_rig
from loop_kit import Memory, after
from scipy.optimize import brentq
from scipy.signal import cont2discrete

from samii_rig.errors import DeviceError, GateError, InputError, LimitError
from samii_rig.rig.load import load_rig
from samii_rig.run.client import Client
from samii_rig.run.dryrun import predict
from samii_rig.run.loop import run
from samii_rig.run.plan import Output, Plan, PlannedSegment
from samii_rig.signal.excitation import swept_sine
from samii_rig.types import Quality
from sim.rig import open_rig

RIG = pair_rig()
BESIDE = (Output("v_b", 2.0, "theta_b"),)


def plan(level=1.0, kp=4.0):
    """v_a, then v_b, then both."""
    u, f = swept_sine(RATE, 2.0, 20.0, 0.6, ramp=0.1, lead_in=0.1, ring_down=0.3)
    both = [(u, 0 * u, ("v_a",)), (0 * u, u, ("v_b",)), (u, -u, ("v_a", "v_b"))]
    parts = tuple(
        PlannedSegment(
            f"part_{i}",
            "burst",
            level,
            "V",
            0,
            level * np.stack([a, b], axis=1),
            np.zeros((len(u), 2)),
            (2.0, 20.0),
            f,
            excited=names,
        )
        for i, (a, b, names) in enumerate(both)
    )
    return Plan("pair", RATE, "v_a", kp, "theta_a", parts, 0, BESIDE)


def go(device=None, sink=None, the_plan=None, **how):
    device, sink = device or FakePair(), sink or Memory()
    stop = run(the_plan or plan(), RIG, device.open(), sink, **how)
    assert not device.live
    assert not device.v.any()
    device.sleep(1.0)
    assert not device.rows[-1][1:3].any()
    return stop, device, sink


def test_a_plan_is_done_to_its_end_and_the_recording_says_what_was_excited():
    stop, device, sink = go()
    assert (stop.status, stop.missing_samples) == ("completed", 0)
    assert [s.excited for s in sink.segments] == [("v_a",), ("v_b",), ("v_a", "v_b")]
    names = [c.name for c in sink.blocks[0].channels]
    assert names == [
        *(c.name for c in device.channels),
        *("u_v_a", "theta_ref_v_a", "u_v_b", "theta_ref_v_b"),
    ]
    sequence = sink.column("sequence")
    for segment, planned in zip(sink.segments, plan().segments, strict=True):
        inside = (sequence >= segment.start) & (sequence < segment.stop)
        for j, name in enumerate(("a", "b")):
            u = sink.column(f"u_v_{name}")[inside]
            np.testing.assert_array_equal(u, planned.u[:, j])
            v = u - device.loops[j].kp * sink.column(f"theta_{name}")[inside]
            np.testing.assert_allclose(sink.column(f"v_{name}")[inside], v, atol=1e-15)
    tail = sequence >= sink.segments[-1].stop + 30
    assert tail.any()
    assert not sink.column("v_a")[tail].any()
    assert not sink.column("v_b")[tail].any()


def test_both_references_stay_ahead_together_and_never_break_off():
    _, device, _ = go()
    firsts = [tuple(b.first for b in blocks) for blocks in device.written]
    ends = [tuple(b.first + len(b) for b in blocks) for blocks in device.written]
    assert firsts[1:] == ends[:-1]
    assert all(a == b for a, b in firsts)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_both_at_zero(number):
    stop, _, _ = go(
        client=Client(lambda p: os.kill(os.getpid(), number) if p.segment == 3 else None)
    )
    assert stop.status == "stopped"


def test_a_stop_event_ends_both_at_zero():
    stop, _, _ = go(client=Client(stop=after(0.8)))
    assert stop.status == "stopped"


def spoil_at(at, change):
    def spoil(block):
        if len(block) and block.sequence[-1] >= at:
            values, quality = block.values.copy(), block.quality.copy()
            change(values, quality)
            return replace(block, values=values, quality=quality)
        return block

    return spoil


def setting(column, value):
    def change(values, quality):
        # What a converter puts out too much, it puts out while it puts out anything.
        values[:, column] = np.where(values[:, column] != 0.0, value, 0.0)

    return change


def flagging(column, flag):
    def change(values, quality):
        quality[:, column] = flag

    return change


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda i: setting(2 + i, 0.4), "over its limit"),
        (lambda i: setting(2 + i, np.nan), "not a number"),
        (lambda i: setting(i, 5.5), "over its limit"),
        (lambda i: setting(i, 0.9), "away from what was commanded"),
        (lambda i: flagging(i, Quality.LIMITED), "the device itself changed"),
        (lambda i: flagging(2 + i, Quality.CLIPPED), "end of its range"),
    ],
)
def test_what_the_gate_sees_of_either_joint_trips_the_run(place, change, word):
    stop, _, sink = go(FakePair(spoil_at(900, change(place))))
    assert stop.status == "tripped"
    assert word in stop.reason
    assert "ab"[place] in stop.reason.split()[0] or f"_{'ab'[place]}" in stop.reason
    assert sink.segments


@pytest.mark.parametrize("method", ["write", "read", "configure"])
def test_a_device_that_fails_ends_both_at_zero(method):
    device = FakePair()

    def broken(*_):
        raise DeviceError("cable out")

    if method == "read":
        device.spoil = spoil_at(900, broken)
    elif method == "configure":
        device.configure = broken
    else:
        whole, count = device.write, [0]

        def write(blocks):
            count[0] += 1
            if count[0] > 30:
                raise DeviceError("cable out")
            whole(blocks)

        device.write = write
    stop, _, _ = go(device)
    assert (stop.status, stop.reason) == ("failed", "cable out")


@pytest.mark.parametrize("place", [0, 1])
def test_a_plan_over_the_limit_of_one_output_trips_before_the_wire(place):
    over = plan()
    segments = list(over.segments)
    u = segments[1].u.copy()
    u[150:, place] = 5.2
    segments[1] = replace(segments[1], u=u)
    stop, device, _ = go(the_plan=replace(over, segments=tuple(segments)))
    assert stop.status == "tripped"
    assert f"v_{'ab'[place]}" in stop.reason
    assert max(np.abs(b.u).max() for blocks in device.written for b in blocks) < 5.0


@pytest.mark.parametrize("place", [0, 1])
def test_one_output_that_does_not_obey_zero_is_a_failure_that_names_it(place):
    device = FakePair()
    whole = device.read

    def read():
        block = whole()
        if device.written and not device.queue and not device.v.any():
            values = block.values.copy()
            values[:, place] = 0.5
            return replace(block, values=values)
        return block

    device.read = read
    stop, _, _ = go(device)
    assert stop.status == "failed"
    assert f"THE OUTPUT IS NOT AT ZERO: v_{'ab'[place]} read 0.5 V" in stop.reason


def test_a_client_that_falls_silent_trips_the_run():
    from samii_rig.run.pace import LoopSettings

    beats = iter([True] * 30)
    stop, _, _ = go(
        client=Client(alive=lambda: next(beats, False)), settings=LoopSettings(heartbeat_age=0.3)
    )
    assert stop.status == "tripped"
    assert "no sign of the operator's client" in stop.reason


def test_a_device_with_one_output_is_not_driven_by_a_rig_with_two():
    with pytest.raises(GateError, match="no channel v_a"):
        run(plan(), RIG, FakeDevice().open(), Memory())


# What a run would refuse, a dry run refuses


def test_the_simulated_joints_reach_the_predicted_peaks():
    """Each loop feels what the other joint does to its encoder, one at a time and together."""
    rig, _ = load_rig("samii_two_joints")
    u, f = swept_sine(RATE, 1.0, 30.0, 4.0, ramp=0.4, lead_in=0.2, ring_down=0.5)
    pairs = [(u, 0 * u), (0 * u, u), (u, -0.5 * u)]
    parts = tuple(
        PlannedSegment(
            f"s{i}",
            "burst",
            0.2,
            "V",
            0,
            0.2 * np.stack(x, axis=1),
            np.zeros((len(u), 2)),
            (1.0, 30.0),
            f,
        )
        for i, x in enumerate(pairs)
    )
    both = Plan("p", RATE, "v_2", 4.0, "theta_2", parts, 0, (Output("v_3", 3.0, "theta_3"),))
    predicted, sink = predict(both, rig), Memory()
    predicted.refuse()
    stop = run(both, rig, open_rig(rig, {"noise": False, "band_hz": 500.0}), sink)
    assert stop.status == "completed"
    sequence = sink.column("sequence")
    for segment, peaks in zip(sink.segments, predicted.peaks, strict=True):
        inside = (sequence >= segment.start) & (sequence < segment.stop)
        for name in ("v_2", "v_3", "theta_2", "theta_3", "a_0", "a_1", "a_2"):
            peak = np.abs(sink.column(name)[inside]).max()
            slack = 0.5 * rig.actuator[0].resolution if name[0] == "v" else 0.0
            expected = peaks[predicted.channels.index(name)]
            assert expected == pytest.approx(peak, rel=0.01, abs=slack), name


@pytest.mark.parametrize("place", [0, 1])
def test_a_dry_run_names_the_output_that_would_break_its_limit(place):
    over = plan()
    segments = tuple(
        replace(s, u=s.u * np.where(np.arange(2) == place, 6.0, 0.1), level=6.0)
        for s in over.segments
    )
    with pytest.raises(LimitError, match=f"v_{'ab'[place]} would reach"):
        predict(replace(over, segments=segments), RIG).refuse()


@pytest.mark.parametrize("place", [0, 1])
def test_a_dry_run_refuses_a_rig_that_could_not_be_armed(place):
    bare = tuple(
        a.model_copy(update={"deadman": None}) if i == place else a
        for i, a in enumerate(RIG.actuator)
    )
    with pytest.raises(InputError, match=rf"actuator\[v_{'ab'[place]}\].deadman"):
        predict(plan(), RIG.model_copy(update={"actuator": bare}))


def critical():
    """kp at which K p/(s (s + p)), held from sample to sample, begins to swing up."""
    K, p = 0.5, 100.0
    num, den, _ = cont2discrete(([K * p], [1.0, p, 0.0]), 1 / RATE)

    def grows(kp):
        return np.abs(np.roots(np.polyadd(den, kp * num[0]))).max() - 1.0

    return brentq(grows, 10.0, 1e5)


@pytest.mark.parametrize("place", [0, 1])
def test_a_dry_run_refuses_either_loop_that_would_be_unstable(place):
    def with_kp(part):
        kp = [4.0, 2.0]
        kp[place] = part * critical()
        one = plan(1e-4, kp=kp[0])
        return replace(one, beside=(Output("v_b", kp[1], "theta_b"),))

    predict(with_kp(0.9), RIG)
    with pytest.raises(LimitError, match="unstable"):
        predict(with_kp(1.1), RIG)
