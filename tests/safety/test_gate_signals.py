"""No signal breaks into the gate: it sets a flag, and whoever looks at that ends the run.

Plan: the signals are sent between any two instructions of the gate and of all that it calls, in
the gate alone at every one of them, and in the loop around it at some of each tick's.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from types import FrameType
from typing import Any

import numpy as np
import pytest
from burst_kit import PLAN, RIG
from fake_device import FakeDevice
from fault_host import Nowhere

from samii_rig.devices.protocols import CommandBlock
from samii_rig.run.interrupts import PAUSE, Interrupts
from samii_rig.run.loop import run
from samii_rig.safety.gate import Gate
from samii_rig.safety.judgement import State
from samii_rig.safety.limits import gate_limits

LIMITS = gate_limits(RIG, "v", 4.0, "theta")
PRESSES = 3


def press() -> None:
    for _ in range(PRESSES):
        signal.raise_signal(signal.SIGINT)


@contextmanager
def between_instructions(inside: str, do: Callable[[], None]) -> Iterator[None]:
    """`do` between every two instructions of the modules whose names begin so, and of all that
    they call."""

    def trace(frame: FrameType, event: str, arg: object) -> Any:
        caller = frame.f_back
        named = str(frame.f_globals.get("__name__")).startswith(inside)
        if event == "call" and not named and (caller is None or not caller.f_trace_opcodes):
            return None
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        if event == "opcode":
            do()
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)


def through_all_states(signals: Callable[[], None] | None) -> tuple[Gate, FakeDevice]:
    device = FakeDevice()
    gate = Gate(device, LIMITS, device.channels, lambda event: None)

    def steps() -> None:
        device.sleep(0.02)
        gate.observe(device.read(), device.now())
        gate.arm(device.now())
        gate.start(device.now())
        first = device.taken + 5
        for i in range(3):
            u = np.full(10, 0.1 * (i + 1))
            gate.write(CommandBlock(first + 10 * i, u, np.zeros(10)), device.now())
            device.sleep(0.02)
            gate.observe(device.read(), device.now())
        assert gate.state is State.RUNNING
        gate.stop("a signal came", device.now())

    if signals is None:
        steps()
    else:
        with between_instructions("samii_rig.safety", signals):
            steps()
    return gate, device


@pytest.mark.parametrize("first", [True, False], ids=["the first press", "the second and third"])
def test_presses_between_any_two_instructions_of_the_gate_change_nothing(first: bool) -> None:
    """One that came long before would be a hang; before each of these the flag was just set."""
    _, undisturbed = through_all_states(None)
    pressed = count()
    with Interrupts() as interrupts:

        def signals() -> None:
            next(pressed)
            interrupts.reason, interrupts._deaf_until = "", 0.0
            if not first:
                signal.raise_signal(signal.SIGTERM)
            press()
            assert interrupts.reason == ("SIGINT (Ctrl-C)" if first else "SIGTERM")

        gate, device = through_all_states(signals)
    assert next(pressed) > 2000, "instructions of the gate, of which there are some thousands"
    assert gate.state is State.SAFE
    assert not gate.fault
    assert not device.live
    assert [b.u.tolist() for b in device.written] == [b.u.tolist() for b in undisturbed.written]


@pytest.mark.parametrize("at", range(0, 8000, 331))
def test_three_presses_anywhere_in_a_tick_are_a_stop_and_no_fault(at: int) -> None:
    device, seen, faults = FakeDevice(), count(), []
    ticks: list[int] = []

    def signals() -> None:
        # The run is well on its way before the instructions are counted.
        if device.written and device.time > 10**9 and next(seen) == at:
            ticks.append(device.time)
            press()

    with between_instructions("samii_rig.", signals):
        stop = run(PLAN, RIG, device.open(), Nowhere(), latch=faults.append)
    assert ticks, "the run was over before that instruction"
    assert (stop.status, stop.reason) == ("stopped", "stopped by SIGINT (Ctrl-C)")
    assert not faults
    assert not device.live


@pytest.mark.parametrize(
    ("part", "status"), [("write", "failed"), ("read", "stopped")], ids=["actuator", "sensor"]
)
def test_a_device_that_hangs_is_left_when_a_person_asks_again(
    part: str, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An actuator that keeps the gate waiting is a fault of the rig; a sensor is not waited for."""
    device, faults, begun = FakeDevice(), [], []

    def hangs(*_: object) -> Any:
        begun.append(time.monotonic())
        press()
        time.sleep(PAUSE)
        press()
        time.sleep(10.0)

    def spoil(block: Any) -> Any:
        if device.time > 10**9 and not begun:
            if part == "read":
                hangs()
            monkeypatch.setattr(device, "write", hangs)
        return block

    device.spoil = spoil
    stop = run(PLAN, RIG, device.open(), Nowhere(), latch=faults.append)
    assert time.monotonic() - begun[0] < 2 * PAUSE
    assert stop.status == status
    assert bool(faults) is (part == "write")
    assert not device.live
