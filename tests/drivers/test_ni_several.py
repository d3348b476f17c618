"""Two outputs of an NI-DAQmx board against a stand-in for nidaqmx: what ends one ends both."""

import time

import numpy as np
import pytest
from contract_several import OutputsContract
from ni_kit import PATIENT, installed
from wire_kit import until

from drivers.ni_daq import check_rig, open_rig
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError, GateError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.run.outputs import at_rest, plan_limits
from samii_rig.run.plan import Plan
from samii_rig.safety.gate import Gate

DEADMAN = 0.2  # s; a loaded machine may feed late
NAMES = ("v_2", "v_3")
BOTH = [0, 1]
NULLS = [0.25, -0.125]  # V
CHANNELS = {
    "v_2": {"channel": "ao0", "null": NULLS[0]},
    "v_3": {"channel": "ao1", "null": NULLS[1], "volts_per_unit": -2.0},
}
INTERLOCK = {"name": "K3", "line": "port0/line0", "reason": "drops when its square wave stops"}
SETTINGS = {
    "board": "Dev1",
    "analogue": {"a_0": {"input": "ai3", "volts_per_unit": 0.1, "offset": 0.5}},
    "encoder": {
        "theta_2": {"counter": "ctr0", "pulses_per_rev": 1000},
        "theta_3": {"counter": "ctr1", "pulses_per_rev": 1000},
    },
    "output": {"channels": CHANNELS, "watchdog": "Dev1"},
}


def rig_of_two(deadman=DEADMAN):
    """Two driven joints without loops, as a board closes none."""
    whole = load_rig("samii_two_joints")[0]
    free = {"deadman": deadman, "centring": None}
    specs = tuple(a.model_copy(update=free) for a in whole.actuator)
    part = {"sensor": whole.sensor[:3], "actuator": specs, "centring": None}
    return whole.model_copy(update=part)


RIG = rig_of_two()
LOOPS = (DeviceLoop("theta_2", 0.0, 5.0, np.inf, 1.0), DeviceLoop("theta_3", 0.0, 5.0, np.inf, 1.0))


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
    """A device whose outputs are live, fed by `until`; units : what is asked of each."""

    def __init__(self, device, units=(1.0, 0.5), loops=LOOPS):
        self.actuator, self.sensor, self.units = device.actuator, device.sensor, units
        self.actuator.configure(loops)
        until(lambda: len(block := self.sensor.read()) and self.at(block))
        self.next = self.newest + 60

    def at(self, block):
        self.newest, self.block = int(block.sequence[-1]), block
        return True

    def feed(self):
        block = self.sensor.read()
        if len(block):
            self.at(block)
        n = self.newest + 75 - self.next
        if n > 0:
            blocks = (CommandBlock(self.next, np.full(n, u), np.zeros(n)) for u in self.units)
            self.actuator.write(tuple(blocks))
            self.next += n

    def until(self, what):
        until(lambda: (self.feed(), what())[1])


def live(board, device):
    """Fed until both outputs are at what they were told."""
    driven = Driven(device)
    driven.until(lambda: board.outs == [NULLS[0] + 1.0, NULLS[1] - 2.0 * 0.5])
    return driven


def ends(board, within=1.0, nulls=NULLS):
    """Both terminals come to null for good; time in s, and which were so first."""
    start = time.monotonic()
    until(lambda: (board.advance(), board.outs == nulls)[1], within)
    took = time.monotonic() - start
    time.sleep(0.05)
    board.advance()
    assert board.outs == nulls
    return took


@pytest.mark.usefixtures("installation")
class TestNiOutputs(OutputsContract):
    rig = rig_of_two(PATIENT)

    @pytest.fixture
    def installation(self, monkeypatch):
        installed(monkeypatch)

    def open(self):
        return open_rig(self.rig, SETTINGS)


def test_opening_brings_a_board_that_held_voltages_to_both_nulls(board):
    assert board.outs == [3.0, -2.0]
    device = open_rig(RIG, SETTINGS)
    assert board.outs == NULLS
    assert board.watchdog.states == dict(enumerate(NULLS))
    device.close()
    assert board.outs == NULLS
    assert not any(t.open for t in board.tasks)


def test_each_is_read_back_at_its_own_input_in_its_own_unit(board, device):
    driven = live(board, device)
    names = [c.name for c in device.sensor.channels]
    assert names[:6] == ["u_v_2", "theta_ref_v_2", "u_v_3", "theta_ref_v_3", "v_2", "v_3"]
    driven.until(lambda: driven.block.values[-1, 4:6] == pytest.approx([1.0, 0.5], abs=1e-3))
    inputs = next(t.rows for t in board.tasks if t.open and t.kind == "ai")
    assert inputs == ["Dev1/_ao0_vs_aognd", "Dev1/_ao1_vs_aognd", "Dev1/ai3"]


# Ways to null


def test_a_program_that_hangs_is_ended_by_the_watchdog_in_both(board, device, monkeypatch):
    live(board, device)
    monkeypatch.setattr(device.actuator, "look", lambda most: None)
    ends(board)
    assert board.watchdog.expired
    with pytest.raises(DeviceError, match="watchdog timer expired"):
        until(lambda: device.sensor.read() is None)


def test_a_host_that_feeds_no_more_is_ended_before_the_watchdog(board, patient):
    live(board, patient)
    ends(board)
    until(lambda: len(told := patient.sensor.read().quality) and told[-1, 4:6].all())
    assert not board.watchdog.expired
    patient.actuator.configure(LOOPS)


def test_a_program_that_dies_opens_the_interlock_of_both(board, monkeypatch):
    device = open_rig(RIG, {**SETTINGS, "output": {"channels": CHANNELS, "interlock": INTERLOCK}})
    live(board, device)
    assert board.closed
    monkeypatch.setattr(device.actuator, "look", lambda most: None)
    until(lambda: not board.closed, 1.0)
    device.close()


@pytest.mark.parametrize("far", BOTH)
def test_an_angle_of_either_joint_ends_both(board, device, far):
    driven = live(board, device)
    board.theta[far] = 1.5
    driven.until(lambda: (board.advance(), board.outs == NULLS)[1])
    end = time.monotonic() + 0.2
    driven.until(lambda: time.monotonic() > end)  # what is fed to it moves nothing any more
    assert board.outs == NULLS


def test_a_task_that_has_died_ends_both(board, device):
    driven = live(board, device)
    board.broken = {"ao"}
    with pytest.raises(DeviceError, match=r"the output has ended: -50405: No transfer"):
        driven.until(lambda: False)
    assert board.outs == NULLS


@pytest.mark.parametrize("refused", BOTH)
def test_a_null_that_one_channel_refuses_is_still_put_out_of_the_other(board, device, refused):
    live(board, device)
    before = board.outs[refused]
    board.broken = {f"Dev1/ao{refused}"}
    device.actuator.zero()
    assert board.outs[1 - refused] == NULLS[1 - refused]
    assert board.outs[refused] == before
    with pytest.raises(DeviceError, match="of v_2, v_3 could not be set to null: -50405"):
        until(lambda: device.sensor.read() is None)
    ends(board)
    assert board.watchdog.expired, "nobody but the watchdog puts the other to null"


def test_inputs_that_end_take_both_with_them(board, device):
    live(board, device)
    board.broken = {"ai", "ci"}
    assert ends(board) < DEADMAN


def test_closing_while_they_are_live_ends_both(board, device):
    live(board, device)
    device.close()
    assert board.outs == NULLS
    assert board.watchdog is None


@pytest.mark.parametrize("strayed", BOTH)
def test_an_output_that_is_not_what_it_was_told_ends_both_by_the_gate(board, device, strayed):
    plan = Plan("p", RIG.rate_hz, "v_2", 0.0, "theta_2", (), 0, (at_rest(RIG, "v_3"),))
    channels, clock = device.sensor.channels, device.clock
    gate = Gate(device.actuator, plan_limits(plan, RIG), channels, lambda event: None)
    until(lambda: (gate.observe(device.sensor.read(), clock.now()), gate._latest.sequence > 5)[1])
    gate.arm(clock.now())
    gate.observe(device.sensor.read(), clock.now())
    gate.start(clock.now())
    first = gate._latest.sequence + 60
    u = 0.1 * (1.0 - np.cos(2 * np.pi * np.arange(100_000) / RIG.rate_hz))
    at = first

    def tick():
        nonlocal at
        gate.observe(device.sensor.read(), clock.now())
        n = gate._latest.sequence + 75 - at
        if n > 0:
            part = u[at - first : at - first + n]
            blocks = tuple(CommandBlock(at, sign * part, 0.0 * part) for sign in (1.0, -0.5))
            gate.write(blocks, clock.now())
            at += n
        return board.outs[0] > NULLS[0] + 0.02

    until(tick)
    board.strays[strayed] = 0.5
    with pytest.raises(GateError, match=rf"{NAMES[strayed]} read back is 0\.[2-5]\d* V away"):
        until(lambda: (tick(), False)[1])
    assert board.outs == NULLS


# What is refused


def test_without_watchdog_and_interlock_no_gate_arms_them(board):
    device = open_rig(RIG, {**SETTINGS, "output": {"channels": CHANNELS}})
    assert device.actuator.deadman is None
    device.close()


@pytest.mark.parametrize("closed", BOTH)
def test_a_loop_of_either_is_refused_and_leaves_both_at_null(board, device, closed):
    loops = list(LOOPS)
    loops[closed] = DeviceLoop("theta_2", 1.0, 5.0, np.inf, 1.0)
    with pytest.raises(DeviceError, match=f"{NAMES[closed]}: a board .* closes no loop"):
        device.actuator.configure(tuple(loops))
    assert board.outs == NULLS
    assert board.player is None


@pytest.mark.parametrize(
    ("output", "said"),
    [
        ({"channel": "ao0"}, r"output.channels is \[\]; expected v_2, v_3, each with its channel"),
        ({"channels": {"v_2": CHANNELS["v_2"]}}, r"channels is \['v_2'\]; expected v_2, v_3"),
        ({"channels": CHANNELS, "null": 0.1}, r"output.null is 0.1; expected left out"),
        (
            {"channels": {**CHANNELS, "v_3": {"channel": "ao0"}}},
            r"channels, channel is .*; expected one of its own for each",
        ),
        (
            {"channels": {**CHANNELS, "v_3": {"channel": "ao1", "readback": "_ao0_vs_aognd"}}},
            r"channels, readback is .*; expected one of its own",
        ),
        (
            {"channels": {**CHANNELS, "v_3": {"channel": "ao1", "null": 12.0}}},
            r"output.channels.v_3.null is 12.0; expected between low, -10, and high, 10",
        ),
        (
            {"channels": {**CHANNELS, "v_3": {"channel": "ao1", "volts_per_unit": 0.0}}},
            r"channels.v_3.volts_per_unit is 0.0",
        ),
    ],
)
def test_wrong_outputs_are_one_line_before_the_board_is_asked(board, output, said):
    given = {**SETTINGS, "output": output}
    for ask in (check_rig, open_rig):
        with pytest.raises(InputError, match=said) as caught:
            ask(RIG, given)
        assert "\n" not in str(caught.value)
    assert not board.tasks
