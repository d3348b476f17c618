"""The output of an NI-DAQmx board against a stand-in for nidaqmx: every way to it ends at null."""

import time

import numpy as np
import pytest
from contract import DeviceContract
from ni_kit import PATIENT, installed
from wire_kit import until

from drivers.ni_daq import open_rig
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError, GateError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.safety.gate import Gate
from samii_rig.safety.limits import gate_limits

DEADMAN = 0.2  # s; a loaded machine may feed late
INTERLOCK = {
    "name": "pressure switch K3",
    "line": "port0/line0",
    "reason": "drops when its square wave stops",
}
LOCKED = {"channel": "ao0", "interlock": INTERLOCK}
SETTINGS = {
    "board": "Dev1",
    "analogue": {"a_0": {"input": "ai3", "volts_per_unit": 0.1, "offset": 0.5}},
    "encoder": {"theta_2": {"counter": "ctr0", "pulses_per_rev": 1000}},
    "output": {"channel": "ao0", "watchdog": "Dev1"},
}


def rig_of_two(deadman=DEADMAN):
    whole = load_rig("samii")[0]
    spec = whole.actuator[0].model_copy(update={"deadman": deadman})
    part = {"sensor": whole.sensor[:2], "actuator": (spec,), "centring": None}
    return whole.model_copy(update=part)


RIG = rig_of_two()
LOOP = DeviceLoop("theta_2", 0.0, 5.0, np.inf, 1.0)


def with_output(**changes):
    return {**SETTINGS, "output": {**SETTINGS["output"], **changes}}


@pytest.fixture
def board(monkeypatch):
    return installed(monkeypatch)


@pytest.fixture
def device(board):
    opened = open_rig(RIG, SETTINGS)
    yield opened
    opened.close()


@pytest.fixture
def patient(board):
    """A device whose own end comes well before its watchdog's."""
    opened = open_rig(rig_of_two(PATIENT), SETTINGS)
    yield opened
    opened.close()


class Driven:
    """A device whose output is live: it is fed until `feeding` ends."""

    def __init__(self, device, volts=1.0):
        self.actuator, self.sensor, self.volts = device.actuator, device.sensor, volts
        self.actuator.configure(LOOP)
        until(lambda: len(block := self.sensor.read()) and self.at(block))
        self.next = self.newest + 60

    def at(self, block):
        self.newest, self.v = int(block.sequence[-1]), float(block.values[-1, 2])
        return True

    def feed(self):
        block = self.sensor.read()
        if len(block):
            self.at(block)
        n = self.newest + 75 - self.next
        if n > 0:
            self.actuator.write(CommandBlock(self.next, np.full(n, self.volts), np.zeros(n)))
            self.next += n

    def until(self, what):
        until(lambda: (self.feed(), what())[1])


def live(board, device):
    """Fed until the output is at one volt."""
    driven = Driven(device)
    driven.until(lambda: board.out == 1.0)
    return driven


def ends(board, within):
    """Time in s until the board's terminal is at zero for good."""
    start = time.monotonic()
    until(lambda: (board.advance(), board.out == 0.0)[1], within)
    took = time.monotonic() - start
    time.sleep(0.05)
    board.advance()
    assert board.out == 0.0
    return took


@pytest.mark.usefixtures("installation")
class TestNiOutput(DeviceContract):
    rig = rig_of_two(PATIENT)

    @pytest.fixture
    def installation(self, monkeypatch):
        installed(monkeypatch)

    def open(self):
        return open_rig(self.rig, SETTINGS)


def test_opening_brings_a_board_that_held_a_voltage_to_null(board):
    assert board.out == 3.0
    device = open_rig(RIG, {**SETTINGS, "output": LOCKED})
    assert board.out == 0.0
    assert device.metadata["interlock"].startswith("pressure switch K3 at port0/line0: ")
    device.close()
    assert not board.resets
    assert not any(t.open for t in board.tasks)


def test_the_watchdog_ends_the_output_of_a_program_that_hangs(board, device, monkeypatch):
    live(board, device)
    monkeypatch.setattr(device.actuator, "look", lambda angle: None)
    ends(board, 1.0)
    assert board.watchdog.expired
    with pytest.raises(DeviceError, match="watchdog timer expired"):
        until(lambda: device.sensor.read() is None)


def test_the_device_ends_it_before_its_watchdog_has_to(board, patient):
    live(board, patient)
    ends(board, 1.0)
    until(lambda: patient.sensor.read().quality[-1:, 2].any())
    assert not board.watchdog.expired
    patient.actuator.configure(LOOP)


def test_the_next_program_gets_a_board_whose_watchdog_had_expired(board, device, monkeypatch):
    live(board, device)
    monkeypatch.setattr(device.actuator, "look", lambda angle: None)
    ends(board, 1.0)
    device.close()
    again = open_rig(RIG, SETTINGS)
    live(board, again)
    again.close()
    assert board.resets == 2


def test_closing_while_it_is_live_ends_at_null(board, device):
    live(board, device)
    device.close()
    assert board.out == 0.0
    assert not any(t.open for t in board.tasks)
    assert board.watchdog is None


def test_a_task_that_has_died_ends_at_null(board, device):
    driven = live(board, device)
    board.broken = {"ao"}
    with pytest.raises(DeviceError, match=r"the output has ended: -50405: No transfer"):
        driven.until(lambda: False)
    assert board.out == 0.0
    device.actuator.zero()


def test_a_board_that_does_not_take_null_is_left_to_its_watchdog(board, device):
    live(board, device)
    board.broken = {"ao", "null"}
    device.actuator.zero()
    assert board.out == 1.0
    assert "could not be set to null: -50405" in device.actuator.trouble
    assert ends(board, 1.0) > 0.5 * DEADMAN
    assert board.watchdog.expired
    with pytest.raises(DeviceError, match="Dev1: "):
        until(lambda: device.sensor.read() is None)


@pytest.fixture
def locked(board):
    opened = open_rig(RIG, {**SETTINGS, "output": LOCKED})
    yield opened
    opened.close()


def test_an_interlock_is_closed_only_while_the_output_is_fed(board, locked):
    time.sleep(0.05)
    assert not board.closed
    live(board, locked)
    assert board.closed
    locked.actuator.zero()
    assert board.out == 0.0
    until(lambda: not board.closed)


def test_a_board_that_does_not_take_null_opens_its_interlock(board, locked):
    driven = live(board, locked)
    board.broken = {"ao", "null"}
    locked.actuator.zero()
    assert board.out == 1.0
    with pytest.raises(DeviceError, match="could not be set to null: -50405"):
        driven.until(lambda: False)
    until(lambda: not board.closed, 1.0)
    with pytest.raises(DeviceError, match="could not be set to null: -50405"):
        locked.actuator.configure(LOOP)
    assert not board.closed


def test_a_program_that_hangs_opens_its_interlock(board, locked, monkeypatch):
    live(board, locked)
    monkeypatch.setattr(locked.actuator, "look", lambda angle: None)
    until(lambda: not board.closed, 1.0)
    assert board.out == 1.0, "nobody but the interlock"


def test_a_line_that_is_not_to_be_had_ends_at_null(board, locked):
    driven = live(board, locked)
    board.broken = {"do"}
    with pytest.raises(DeviceError, match="the output has ended: -50405"):
        driven.until(lambda: False)
    assert board.out == 0.0
    until(lambda: not board.closed, 1.0)
    locked.close()
    with pytest.raises(DeviceError, match="NI-DAQmx refuses: -50405"):
        open_rig(RIG, with_output(interlock=INTERLOCK))
    assert not any(t.open for t in board.tasks)
    assert board.watchdog is None


def test_inputs_that_end_take_the_output_with_them(board, device):
    live(board, device)
    board.broken = {"ai", "ci"}
    assert ends(board, 1.0) < DEADMAN
    with pytest.raises(DeviceError, match="RuntimeError: -50405"):
        until(lambda: device.sensor.read() is None)


def test_a_buffer_that_runs_dry_ends_at_null(board, device):
    device.actuator.configure(LOOP)
    player = board.player
    with device.actuator._lock:  # nobody looks
        time.sleep(0.2)
        board.advance()
    assert player.error
    until(lambda: device.actuator.trouble != "")
    assert board.out == 0.0
    with pytest.raises(DeviceError, match="-200290"):
        until(lambda: device.sensor.read() is None)


def gate(device, settings=SETTINGS):
    limits = gate_limits(RIG, "v_2", 0.0, "theta_2")
    return Gate(device.actuator, limits, device.sensor.channels, lambda event: None)


def running(device):
    g, clock = gate(device), device.clock
    until(lambda: (g.observe(device.sensor.read(), clock.now()), g._latest.sequence > 5)[1])
    g.arm(clock.now())
    g.observe(device.sensor.read(), clock.now())
    g.start(clock.now())
    return g


@pytest.mark.parametrize("end", ["readback", "stop", "error"])
def test_whatever_ends_the_gate_ends_the_output(board, device, end, monkeypatch):
    g, clock = running(device), device.clock
    first = g._latest.sequence + 60
    t = np.arange(100_000) / RIG.rate_hz
    u = 0.2 * (1.0 - np.cos(2 * np.pi * t))

    def tick():
        nonlocal first
        g.observe(device.sensor.read(), clock.now())
        n = g._latest.sequence + 75 - first
        if n > 0:
            start = first - 60
            g.write(CommandBlock(first, u[start : start + n], np.zeros(n)), clock.now())
            first += n
        return board.out > 0.02

    until(tick)
    if end == "stop":
        g.stop("enough", clock.now())
    elif end == "readback":
        board.stray = 0.5
        with pytest.raises(GateError, match=r"v_2 read back is 0\.[45]\d* V away"):
            until(lambda: (tick(), False)[1])
    else:
        monkeypatch.setattr("samii_rig.safety.lane.observe", lambda *a: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            tick()
    assert board.out == 0.0


def test_without_watchdog_and_interlock_no_gate_arms_it(board):
    device = open_rig(RIG, {**SETTINGS, "output": {"channel": "ao0"}})
    g, clock = gate(device), device.clock
    until(lambda: (g.observe(device.sensor.read(), clock.now()), g._latest.sequence > 5)[1])
    with pytest.raises(GateError, match="declares no deadman"):
        g.arm(clock.now())
    assert board.out == 0.0
    device.close()


def test_its_null_is_what_zero_and_the_watchdog_mean(board, monkeypatch):
    device = open_rig(RIG, with_output(null=0.25, volts_per_unit=-2.0))
    assert board.out == board.watchdog.volts == 0.25
    driven = Driven(device)
    driven.until(lambda: board.out == -1.75)
    driven.until(lambda: driven.v == pytest.approx(1.0, abs=RIG.actuator[0].resolution))
    device.close()
    assert board.out == 0.25


def test_a_loop_is_refused_and_leaves_it_at_null(board, device):
    with pytest.raises(DeviceError, match="closes no loop"):
        device.actuator.configure(DeviceLoop("theta_2", 1.0, 5.0, np.inf, 1.0))
    assert board.out == 0.0
    assert board.player is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"volts_per_unit": 0.0}, "output.volts_per_unit is 0.0"),
        ({"null": 10.0}, r"output.null is 10.0; expected between low, -10, and high, 10"),
        ({"interlock": {**INTERLOCK, "line": ""}}, "output.interlock.line is ''"),
        ({"interlock": {"name": "K3", "reason": "fast"}}, "output.interlock.line: is missing"),
        ({"interlock": {**INTERLOCK, "reason": ""}}, "output.interlock.reason is ''"),
    ],
)
def test_a_wrong_output_is_one_line(board, changes, said):
    with pytest.raises(InputError, match=said) as caught:
        open_rig(RIG, with_output(**changes))
    assert "\n" not in str(caught.value)
    assert not board.tasks


def test_a_rig_whose_time_to_zero_is_not_said_is_refused(board):
    spec = RIG.actuator[0].model_copy(update={"deadman": None})
    with pytest.raises(InputError, match=r"actuator\[v_2\].deadman is None; expected the time of"):
        open_rig(RIG.model_copy(update={"actuator": (spec,)}), SETTINGS)
