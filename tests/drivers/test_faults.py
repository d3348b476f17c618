"""Every fault, in each state where it can come, on the wire: the output at null, FAULT, no re-arm.

The table is in docs/reference/faults.md. Times are counted in the node's own samples (2 ms each).
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from board_kit import NODES, options
from fault_host import plan_of
from faults_kit import PATIENCE, STATES, Held, held, null_of
from wire_kit import Wire, slow_deadman

from samii_rig.devices.protocols import CommandBlock
from samii_rig.errors import DeviceError, GateError
from samii_rig.safety.judgement import State

BY_NODE = 1  # samples from the fault to null, where the node itself measures it
RUNNING = ("running",)
BOTH = ("armed", "running")


@pytest.fixture(scope="module", params=NODES)
def shared(request: pytest.FixtureRequest, tmp_path_factory) -> Iterator[Wire]:
    file = slow_deadman(tmp_path_factory.mktemp("rig"))
    w = Wire("--seed", "7", *options(request.param), rig=str(file))
    yield w
    w.close()


@pytest.fixture
def wire(shared: Wire) -> Iterator[Wire]:
    yield shared
    for way in ("up", "down"):
        shared.tell(*(f"line {way} {f} 0" for f in ("loss", "flip", "duplicate", "reorder")))


def table(*rows: tuple[str, tuple[str, ...], str, str, int]) -> list:
    return [
        pytest.param(state, *row[2:], id=f"{row[0]}-{state}") for row in rows for state in row[1]
    ]


# What is told to the rig; what the host then says; samples until null.
SEEN = table(
    ("emergency", RUNNING, "emergency 1", "the device itself changed v_2", BY_NODE),
    ("emergency", ("armed",), "emergency 1", "the device itself changed v_2", 0),
    ("encoder jumps", RUNNING, "jump 5000", "the device itself changed|theta_2", BY_NODE),
    ("angle out of range", RUNNING, "drift theta_2 4e5", "the device itself|theta_2", 14),
    ("angle out of range", ("armed",), "offset theta_2 12000", "theta_2 at 0.4", 0),
    ("input saturated", RUNNING, "rail 0 1", "a_0 |device itself", BY_NODE),
    ("input saturated", ("armed",), "rail 0 1", "a_0 at 51", 0),
    ("current out of range", BOTH, "offset a_2 26400", "a_2 at 4", PATIENCE),
    ("sensor drifts", BOTH, "drift a_0 2e5", "a_0 at 3", PATIENCE + 50),
    ("sensor stuck while moving", RUNNING, "freeze a_0 1", "a_0 is stuck", 1000),
    ("encoder stuck while moving", RUNNING, "freeze theta_2 1", "theta_2 is stuck", 1000),
    ("samples stale", BOTH, "stall 0.3", "said nothing new", PATIENCE + 1),
    ("output is not what was told", BOTH, "stray 500", "away from what was commanded", PATIENCE),
    ("node reboots", STATES, "reboot", "rebooted", 0),
    ("clock is set back", STATES, "clock -3000000", "clock jumped by -3 s", PATIENCE),
    ("clock is set on", STATES, "clock 3000000", "clock jumped by 3 s", PATIENCE),
)


def can(wire: Wire, told: str) -> None:
    """Skip what the image cannot be told."""
    if wire.image and told.startswith("stray"):
        pytest.skip("a board reads its converter back and resets: tests/drivers/test_board_chip.py")


@pytest.mark.parametrize(("state", "told", "said", "samples"), SEEN)
def test_a_fault_ends_at_null_and_is_latched(wire, state, told, said, samples):
    can(wire, told)
    with held(wire, state) as host:
        wire.tell(told)
        host.on(3.0)
        assert host.ended, "it was not seen"
        assert host.gate_state is State.FAULT
        assert _matches(said, host.fault)
        time.sleep(0.05 if told == "stray 500" else 0.0)
        h = null_of(wire) if told != "stray 500" else wire.history()
        if told == "reboot":
            assert (h["state"], h["live"]) != ("LIVE", h["sample"])
        elif told == "stray 500":
            assert h["v"] == 500, "what the converter holds by itself no program ends"
            assert h["state"] == "IDLE"
        elif state == "running":
            assert h["live"] - h["told"] <= samples, "too late"
        else:
            assert h["most"] == 0
        _no_re_arm(wire, host, h)


def _matches(said: str, fault: str) -> bool:
    assert any(part in fault for part in said.split("|")), fault
    return True


def _no_re_arm(wire: Wire, host: Held, before: dict) -> None:
    """It stays where it is, and the gate takes nothing any more."""
    gate, now = host.job.gate, host.job.clock.now()
    for ask in (gate.arm, gate.start):
        with pytest.raises(GateError, match="in state fault"):
            ask(now)
    with pytest.raises(GateError, match="in state fault"):
        gate.write(CommandBlock(before["sample"] + 60, np.ones(5), np.zeros(5)), now)
    time.sleep(0.06)
    after = wire.history()
    assert after["state"] not in ("LIVE", "DRY")
    assert after["live"] == before["live"] or before["v"] != 0


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ("offset a_2 26400", "a_2 at 4"),
        ("rail 0 1", "a_0 at 51"),
        ("stray 500", "away from what was commanded"),
        ("stall 0.5", "said nothing new"),
    ],
)
def test_in_safe_a_fault_moves_nothing_and_arming_is_refused(wire, told, said):
    can(wire, told)
    with held(wire, "safe") as host:
        wire.tell(told)
        host.on(0.3)
        assert host.ended is None
        with pytest.raises(GateError, match=said):
            host.job.gate.arm(host.job.clock.now())
        assert host.gate_state is State.SAFE
        assert wire.history()["state"] == "IDLE"


def test_in_safe_an_emergency_input_lets_nothing_arm(wire):
    with held(wire, "safe") as host:
        wire.tell("emergency 1")
        host.on(0.05)
        with pytest.raises(DeviceError, match="cause of its trip is still there"):
            host.job.gate.arm(host.job.clock.now())
        assert host.gate_state is State.FAULT
        assert wire.history()["v"] == 0


# The cable


@pytest.mark.parametrize("state", STATES)
def test_a_cable_that_is_pulled_is_a_fault_and_its_return_arms_nothing(wire, state):
    plugged = True
    try:
        with held(wire, state) as host:
            at = time.monotonic()
            wire.tell("unplug")
            plugged = False
            host.on(2.0)
            assert host.ended
            assert "port" in host.fault
            assert host.gate_state is State.FAULT
            seen = host.at - at
            h = null_of(wire)
            if state == "running":
                assert h["live"] - h["fed"] < PATIENCE
            wire.rig.device.settings["port"] = wire.plug()
            plugged = True
            time.sleep(0.1)
            assert wire.history()["v"] == 0
            with pytest.raises(GateError, match="in state fault"):
                host.job.gate.arm(host.job.clock.now())
            assert seen < 0.1
    finally:
        if not plugged:
            wire.rig.device.settings["port"] = wire.plug()


# The line


LINES = [
    ("flip 2e-3", "frames_corrupt"),
    ("loss 2e-3", "frames_lost"),
    ("duplicate 0.5", "frames_stale"),
    ("reorder 0.5", "frames_stale"),
]


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(("fault", "counted"), LINES)
def test_a_line_worse_than_the_rig_allows_is_a_fault(wire, state, fault, counted):
    with held(wire, state) as host:
        wire.tell(f"line down {fault}")
        host.on(3.0)
        wire.tell(f"line down {fault.split()[0]} 0")
        assert host.ended
        assert "frames lost or damaged within a second; allowed 5" in host.fault
        assert host.gate_state is State.FAULT
        assert null_of(wire)["v"] == 0
        host.job._tell()
        assert host.job.queued
        host.job.queued.close()
        assert host.sink.named("line")[-1][counted] > 0


@pytest.mark.parametrize(("fault", "counted"), LINES)
def test_what_a_bad_line_does_is_counted_in_the_recording_and_makes_no_wrong_sample(
    wire, fault, counted
):
    with held(wire, "running", max_bad_frames=1e6) as host:
        kind, level = fault.split()
        wire.tell(f"line down {kind} {float(level) / 4}")
        host.on(1.0)
        wire.tell(f"line down {kind} 0")
        host.on(0.4)
        assert host.ended is None, host.ended
        assert host.job.queued
        host.job._flush()
        host.job.queued.close()
        assert host.sink.named("line")[-1][counted] > 0
        sequence = np.concatenate([b.sequence for b in host.sink.blocks])
        values = np.concatenate([b.values for b in host.sink.blocks])
        assert (np.diff(sequence) >= 1).all()
        assert np.abs(values[:, 0]).max() < 0.51
        assert np.abs(values[:, 3]).max() < 0.35
        assert host.job.missing == sequence[-1] - sequence[0] + 1 - len(sequence)


def test_frames_that_the_node_does_not_get_whole_are_counted_and_a_fault(wire):
    with held(wire, "running") as host:
        wire.tell("line up flip 5e-3")
        host.on(3.0)
        wire.tell("line up flip 0")
        assert host.ended
        assert _matches("frames lost or damaged|device itself changed", host.fault)
        assert null_of(wire)["v"] == 0


# Clocks


def test_counters_that_wrap_and_a_wall_clock_that_jumps_have_no_effect(wire, monkeypatch):
    wire.tell(f"reboot {2**32 - 1500} {2**32 - 3_000_000}")
    host = Held(wire)
    try:
        host.become("running")
        monkeypatch.setattr(time, "time", lambda: 1e6)
        monkeypatch.setattr(time, "time_ns", lambda: 10**15)
        while host.job.newest < 2**32 + 100:
            host.on(0.1)
            assert host.ended is None, host.ended
        assert host.job.missing == 0
    finally:
        host.close()


# Commands


def command(host: Held, u: object, theta_ref: object = 0.0) -> CommandBlock:
    u = np.atleast_1d(np.asarray(u, dtype=float))
    first = host.job.start + host.job.sent if host.state == "running" else host.job.newest + 60
    return CommandBlock(first, u, np.broadcast_to(np.asarray(theta_ref, dtype=float), u.shape))


@pytest.mark.parametrize(
    ("u", "theta_ref", "said"),
    [
        (math.nan, 0.0, "not a number"),
        (0.0, math.inf, "not a number"),
        (np.linspace(0.0, 6.0, 60), 0.0, "v_2 at 6"),
        ([0.0, 4.5], 0.0, "over its rate of 2000 V/s"),
        (0.0, 0.4, "beyond"),
    ],
    ids=["nan", "infinite", "volts", "slew", "set point"],
)
def test_a_command_beyond_a_limit_never_reaches_the_wire(wire, u, theta_ref, said):
    with held(wire, "running") as host:
        last = wire.history()["most"]
        with pytest.raises(GateError, match=said):
            host.job.gate.write(command(host, u, theta_ref), host.job.clock.now())
        assert host.gate_state is State.FAULT
        h = null_of(wire)
        assert h["most"] <= last + 20, "it came out"


def test_a_reference_that_would_turn_the_joint_too_far_is_refused_before_it_is_there(wire):
    wire.rest()
    plan = plan_of(wire.rig, 5.0)
    (part,) = plan.segments
    u = np.minimum(3.4, 0.1 * np.arange(len(part.u)))
    host = Held(wire, replace(plan, segments=(replace(part, u=u),)))
    try:
        host.become("running").on(3.0)
        assert host.ended
        assert "would turn theta_2 to 0.42" in host.fault
        host.job._flush()
        assert host.job.queued
        host.job.queued.close()
        theta = np.concatenate([b.values[:, 3] for b in host.sink.blocks])
        assert 0.1 < theta.max() < 0.35
        assert null_of(wire)["state"] == "IDLE"
    finally:
        host.close()


@pytest.mark.parametrize("state", ["safe", "armed"])
def test_a_command_without_a_run_is_a_fault(wire, state):
    with held(wire, state) as host:
        with pytest.raises(GateError, match=f"write in state {state}"):
            host.job.gate.write(command(host, 0.1), host.job.clock.now())
        assert host.gate_state is State.FAULT
        time.sleep(0.05)
        assert wire.history()["most"] == 0


# A gate that hangs


@pytest.mark.parametrize("state", STATES)
def test_a_gate_that_hangs_while_samples_stream_leaves_null(wire, state):
    with held(wire, state) as host:
        time.sleep(0.3)
        h = wire.history()
        assert h["v"] == 0
        if state == "running":
            assert h["state"] == "DEAD"
            assert h["live"] - h["fed"] < PATIENCE
            host.on(0.3)
            assert host.gate_state is State.FAULT
            assert _matches("said nothing new|the device itself changed v_2", host.fault)
        else:
            host.on(0.1)
            assert host.ended is None, "nothing was lost, nothing moved"
