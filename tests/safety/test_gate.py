"""The gate holding a device: every way out ends at zero, and only a person clears a fault."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from fake_device import FakeDevice
from gate_kit import LIMITS, Bench
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from samii_rig.devices.protocols import CommandBlock
from samii_rig.errors import GateError
from samii_rig.run import interrupts
from samii_rig.safety.gate import Gate
from samii_rig.safety.judgement import State
from samii_rig.types import Channel, Quality


def test_a_new_gate_has_no_fault():
    assert Bench().gate.fault == ""


def test_what_has_come_back_is_not_sent_any_more():
    bench = Bench().running()
    for _ in range(20):
        bench.write(0.1)
        bench.tick()
    sent = bench.gate._sent
    assert sent.first == bench.gate._latest.sequence + 1
    assert len(sent.u) == bench.next - sent.first


def test_a_run_goes_through_all_states_and_moves():
    bench = Bench()
    bench.tick()
    assert bench.gate.state is State.SAFE
    bench.gate.arm(bench.device.now())
    assert bench.gate.state is State.ARMED
    assert bench.device.loop == LIMITS.device_loop()
    bench.gate.start(bench.device.now())
    bench.write()
    bench.tick()
    assert bench.device.v != 0.0
    bench.gate.stop("done", bench.device.now())
    assert bench.gate.state is State.SAFE
    assert not bench.device.live


def test_every_change_of_state_and_every_refusal_is_logged_after_it_was_done():
    bench = Bench().running()
    bench.write()
    bench.tick()
    with pytest.raises(GateError):
        bench.write(6.0)
    events = [(e.request, e.decision.state, e.decision.accepted) for e in bench.log]
    assert events == [
        ("arm", State.ARMED, True),
        ("start", State.RUNNING, True),
        ("write", State.FAULT, False),
    ]
    last = bench.log[-1]
    assert last.time == bench.device.now()
    assert (last.decision.limit, last.decision.unit) == (5.0, "V")
    assert last.decision.number > 6.0


def test_a_refused_command_never_reaches_the_wire():
    bench = Bench().running()
    with pytest.raises(GateError, match=r"v at 6 V is over its limit of 5 V \(half of the range\)"):
        bench.write(6.0)
    assert bench.device.written == []
    assert bench.gate.state is State.FAULT
    assert "5 V" in bench.gate.fault


def test_an_actuator_without_a_deadman_is_never_armed():
    bench = Bench()
    bench.device.deadman = None
    bench.tick()
    with pytest.raises(GateError, match="declares no deadman"):
        bench.gate.arm(bench.device.now())
    assert bench.gate.state is State.SAFE


def test_arming_needs_fresh_samples():
    bench = Bench()
    with pytest.raises(GateError, match="nothing new"):
        bench.gate.arm(bench.device.now())
    bench.tick()
    bench.device.sleep(0.06)
    with pytest.raises(GateError, match="nothing new"):
        bench.gate.arm(bench.device.now())
    bench.tick()
    bench.gate.arm(bench.device.now())
    assert bench.gate.state is State.ARMED


def test_silence_ends_a_run_at_zero():
    bench = Bench().running()
    bench.write()
    bench.tick()
    bench.device.silent = True
    with pytest.raises(GateError, match="nothing new"):
        bench.ticks(4)
    assert bench.gate.state is State.FAULT
    assert not bench.device.live


def test_a_fault_stays_until_a_person_clears_it():
    bench = Bench().running()
    bench.gate.fail("smoke", bench.device.now())
    now = bench.device.now()
    for ask in (bench.gate.arm, bench.gate.start, lambda t: bench.gate.clear("", "fine", t)):
        with pytest.raises(GateError):
            ask(now)
        assert bench.gate.state is State.FAULT
        assert bench.gate.fault == "smoke"
    bench.gate.stop("end", now)
    assert bench.gate.state is State.FAULT
    bench.gate.clear("Ada", "valve replaced", now)
    assert bench.gate.state is State.SAFE
    assert bench.gate.fault == ""
    assert bench.log[-1].decision.reason == "Ada: valve replaced"


def test_after_a_clear_arming_waits_for_new_samples():
    bench = Bench().running()
    bench.gate.fail("smoke", bench.device.now())
    bench.gate.clear("Ada", "aired", bench.device.now())
    with pytest.raises(GateError, match="nothing new"):
        bench.gate.arm(bench.device.now())
    bench.tick()
    bench.gate.arm(bench.device.now())
    assert bench.gate.state is State.ARMED


def test_a_new_run_after_a_stop_may_begin_at_any_sample():
    bench = Bench().running()
    bench.write()
    bench.gate.stop("enough", bench.device.now())
    bench.next = None
    bench.running()
    bench.write()
    assert bench.gate.state is State.RUNNING


def test_a_new_run_after_a_stop_begins_at_zero():
    bench = Bench().running()
    bench.write(4.0)
    bench.gate.stop("enough", bench.device.now())
    bench.next = None
    bench.running()
    bench.write(-4.0)  # the largest step from zero
    assert bench.gate.state is State.RUNNING


def test_after_a_stop_an_output_that_the_device_holds_at_zero_is_no_reason_to_refuse():
    bench = Bench().running()
    bench.write()
    bench.gate.stop("enough", bench.device.now())

    def limited(b):
        b.quality[:, 0] |= np.uint8(Quality.LIMITED)
        return b

    bench.device.spoil = limited
    bench.tick()
    bench.gate.arm(bench.device.now())
    assert bench.gate.state is State.ARMED


def test_the_slew_counts_from_the_last_sample_of_the_block_before():
    bench = Bench().running()
    first, now = bench.device.taken + 5, bench.device.now()
    bench.gate.write(CommandBlock(first, np.array([-2.0, -2.0, 0.0, 2.5]), np.zeros(4)), now)
    bench.gate.write(CommandBlock(first + 4, np.array([2.5, 0.0]), np.zeros(2)), now)
    ref = np.array([-0.3, -0.3, 0.0, 0.3])
    bench.gate.write(CommandBlock(first + 6, np.zeros(4), ref), now)
    bench.gate.write(CommandBlock(first + 10, np.array([-3.0]), np.array([0.3])), now)
    assert bench.gate.state is State.RUNNING


def test_stop_twice_is_harmless():
    bench = Bench().running()
    bench.write()
    bench.gate.stop("once", bench.device.now())
    bench.gate.stop("twice", bench.device.now())
    assert bench.gate.state is State.SAFE
    assert not bench.device.live


@pytest.mark.parametrize("error", [OSError("cable"), KeyboardInterrupt()])
@pytest.mark.parametrize("call", ["write", "configure"])
def test_a_device_that_raises_leaves_zero_and_a_fault(monkeypatch, error, call):
    bench = Bench()
    bench.tick()

    def broken(*_):
        raise error

    monkeypatch.setattr(bench.device, call, broken)
    with pytest.raises(type(error)):
        bench.run_and_write()
    assert bench.gate.state is State.FAULT
    assert bench.device.zeros >= 2
    assert "actuator failed" in bench.gate.fault


def test_a_zero_that_is_interrupted_is_sent_again(monkeypatch):
    bench = Bench().running()
    bench.write()
    sent = []

    def zero():
        sent.append(1)
        if len(sent) == 1:
            raise KeyboardInterrupt
        bench.device.queue.clear()
        bench.device.v = 0.0

    monkeypatch.setattr(bench.device, "zero", zero)
    with pytest.raises(KeyboardInterrupt):
        bench.gate.stop("end", bench.device.now())
    assert bench.gate.state is State.FAULT
    assert not bench.device.live


def test_samples_that_cannot_be_judged_end_at_zero():
    bench = Bench().running()
    bench.write()
    bench.tick()
    bench.device.spoil = lambda b: replace(b, values=b.values[:, :1])
    with pytest.raises(IndexError):
        bench.tick()
    assert bench.gate.state is State.FAULT
    assert not bench.device.live


def test_a_log_that_fails_does_so_after_the_output_is_zero():
    bench = Bench().running()
    bench.write()
    bench.tick()

    def full(_):
        assert not bench.device.live
        raise OSError("disk full")

    bench.gate._log = full
    with pytest.raises(OSError, match="disk full"):
        bench.gate.stop("end", bench.device.now())
    assert bench.gate.state is State.SAFE


def test_a_device_without_a_needed_channel_is_refused():
    with pytest.raises(GateError, match="no channel theta"):
        Gate(FakeDevice(), LIMITS, (Channel("v", "V", "command"),), print)


def test_a_client_that_falls_silent_ends_the_run():
    bench = Bench(replace(LIMITS, heartbeat_age=0.1))
    bench.gate.beat(bench.device.now())
    bench.running()
    bench.write()
    with pytest.raises(GateError, match="operator's client"):
        bench.ticks(7)
    assert not bench.device.live


def test_the_margin_names_the_channel_nearest_to_its_limit():
    assert Bench().gate.margin()[1] == 1.0
    bench = Bench().running()
    bench.device.theta = 0.28
    bench.tick()
    assert bench.gate.margin() == ("theta", pytest.approx(0.2))


class AnyOrder(RuleBasedStateMachine):
    """Whatever is asked of the gate in whatever order: after each answer of the gate the
    output is zero and stays so, unless it is RUNNING on samples that are fresh."""

    def __init__(self):
        super().__init__()
        self.bench = Bench(replace(LIMITS, heartbeat_age=1.0))
        self.asked = True

    def ask(self, call, *args):
        self.asked = True
        try:
            call(*args, self.bench.device.now())
        except GateError:
            assert not self.bench.device.live

    @rule(ticks=st.integers(1, 4))
    def pass_time(self, ticks):
        for _ in range(ticks):
            self.bench.device.sleep(0.02)
            self.ask(self.bench.gate.observe, self.bench.device.read())

    @rule()
    def ready(self):
        self.bench.device.silent, self.bench.device.deadman = False, 0.05
        self.pass_time(1)
        self.ask(self.bench.gate.beat)
        self.ask(self.bench.gate.arm)
        self.ask(self.bench.gate.start)

    @rule()
    def arm(self):
        self.ask(self.bench.gate.arm)

    @rule()
    def start(self):
        self.ask(self.bench.gate.start)

    @rule(value=st.sampled_from([0.0, 0.5, 1.0, 3.0, 6.0, math.nan]), n=st.integers(0, 30))
    def write(self, value, n):
        first = self.bench.device.taken + 5 if self.bench.next is None else self.bench.next
        before = len(self.bench.device.written)
        block = CommandBlock(first, np.full(n, value), np.zeros(n))
        self.ask(self.bench.gate.write, block)
        sent = len(self.bench.device.written) > before
        self.bench.next = first + n if sent else None

    @rule(angle=st.sampled_from([0.0, 0.2, 0.5, math.nan]))
    def push(self, angle):
        self.bench.device.theta = angle

    @rule(silent=st.booleans())
    def unplug(self, silent):
        self.bench.device.silent = silent

    @rule(deadman=st.sampled_from([None, 0.05]))
    def change_device(self, deadman):
        # A device says what it has when it is asked; nothing is out when it changes.
        if self.bench.gate.state in (State.SAFE, State.FAULT):
            self.bench.device.deadman = deadman

    @rule()
    def beat(self):
        self.ask(self.bench.gate.beat)

    @rule()
    def stop(self):
        self.ask(self.bench.gate.stop, "asked")
        assert not self.bench.device.live

    @rule()
    def fail(self):
        self.ask(self.bench.gate.fail, "broke")
        assert not self.bench.device.live

    @precondition(lambda self: self.bench.gate.state is State.FAULT)
    @rule(person=st.sampled_from(["Ada", ""]))
    def clear(self, person):
        self.bench.device.theta = 0.0
        self.ask(self.bench.gate.clear, person, "looked")
        assert (self.bench.gate.state is State.SAFE) == bool(person)

    @invariant()
    def output_only_while_running_on_fresh_samples(self):
        gate, device = self.bench.gate, self.bench.device
        if device.live:
            assert gate.state is State.RUNNING
            latest = gate._latest
            assert all(latest.age(i, device.now()) <= 0.05 for i in range(2))
            assert latest.peak[1] <= 0.35
            assert device.deadman is not None


AnyOrder.TestCase.settings = settings(max_examples=150, stateful_step_count=30)
TestAnyOrder = AnyOrder.TestCase


def test_the_gate_is_where_signals_look_for_it():
    assert Gate.__module__ == interrupts.GATE
