"""Faults on the wire, with the real driver on a real port: each ends with the output at null."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
from board_kit import NODES, options
from wire_kit import Wire, until

from samii_rig.devices.protocols import CommandBlock, DeviceLoop, OpenRig
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.schema import Feedback
from samii_rig.types import Quality
from sim.settings import SimSettings
from sim.wire.program import read_script
from sim.wire.rig import WireRig

PATIENCE = 25  # samples in the deadman's 50 ms
LOOP = DeviceLoop("theta_2", 4.0, 5.0, 2000.0, 0.35)
# A host that keeps the output live until it is stopped from outside.
HOST = """
import json, sys, time
import numpy as np
from drivers.serial_node import open_rig
from samii_rig.rig.schema import Rig
from samii_rig.devices.protocols import CommandBlock, DeviceLoop

rig = Rig.model_validate_json(sys.stdin.readline())
device = open_rig(rig, rig.device.settings)
device.actuator.configure(DeviceLoop("theta_2", 4.0, 5.0, 2000.0, 0.35))
sent = newest = -1
while True:
    time.sleep(0.005)
    block = device.sensor.read()
    if len(block):
        newest = int(block.sequence[-1])
        if sent < 0:
            sent = newest + 30
        n = newest + 35 - sent
        if n > 0:
            device.actuator.write(CommandBlock(sent, np.full(n, 0.3), np.zeros(n)))
            sent += n
"""


@pytest.fixture(scope="module", params=NODES)
def shared(request: pytest.FixtureRequest) -> Iterator[Wire]:
    w = Wire("--seed", "5", *options(request.param))
    yield w
    w.close()


@pytest.fixture
def wire(shared: Wire) -> Wire:
    for way in ("up", "down"):
        shared.tell(
            *(f"line {way} {fault} 0" for fault in ("loss", "flip", "duplicate", "reorder"))
        )
    shared.rest()
    return shared


@pytest.fixture
def device(wire: Wire) -> Iterator[OpenRig]:
    d = wire.open()
    yield d
    d.close()


@pytest.fixture
def host(wire: Wire) -> Iterator[subprocess.Popen]:
    p = subprocess.Popen([sys.executable, "-c", HOST], stdin=subprocess.PIPE, text=True)
    assert p.stdin is not None
    p.stdin.write(wire.rig.model_dump_json() + "\n")
    p.stdin.flush()
    until(lambda: wire.history()["state"] == "LIVE", 30.0)
    yield p
    p.stdin.close()
    p.kill()
    p.wait()


class Drive:
    """A reference that is sent on in time, and all that came back."""

    def __init__(self, device: OpenRig, volts: float = 0.3) -> None:
        self.device, self.volts = device, volts
        self.blocks: list = []
        self.sent = -1

    def on(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.005)
            block = self.device.sensor.read()
            if len(block):
                self.blocks.append(block)
                newest = int(block.sequence[-1])
                self.sent = newest + 30 if self.sent < 0 else self.sent
                n = newest + 35 - self.sent
                if n > 0:
                    u = np.full(n, self.volts)
                    self.device.actuator.write(CommandBlock(self.sent, u, np.zeros(n)))
                    self.sent += n

    def column(self, i: int) -> np.ndarray:
        return np.concatenate([b.values[:, i] for b in self.blocks])

    @property
    def sequence(self) -> np.ndarray:
        return np.concatenate([b.sequence for b in self.blocks])


def live(wire: Wire, device: OpenRig) -> Drive:
    """The output live; again where a loaded machine starved the deadman meanwhile."""
    for _ in range(5):
        device.actuator.configure(LOOP)
        drive = Drive(device)
        drive.on(0.15)
        if wire.history()["state"] == "LIVE":
            return drive
        device.actuator.zero()
        time.sleep(0.05)
    raise AssertionError("the output never became live")


def null(wire: Wire) -> dict:
    """The output's history once it is at null."""
    until(lambda: wire.history()["v"] == 0)
    return wire.history()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_host_that_is_killed_or_hangs_leaves_the_output_at_null_in_50_ms(wire, host, how):
    at = time.monotonic_ns()
    host.send_signal(how)
    time.sleep(0.2)
    h = wire.history()
    assert h["v"] == 0
    assert h["state"] == "DEAD"
    # By the node's own count exactly; by the clock, as late as this machine let it be.
    assert h["live"] - h["fed"] < PATIENCE
    assert h["live_ns"] - at < 100e6
    if how is signal.SIGSTOP:
        # When it goes on, its stream no longer moves anything.
        host.send_signal(signal.SIGCONT)
        time.sleep(0.1)
        after = wire.history()
        assert (after["v"], after["live"]) == (0, h["live"])


def test_a_cable_that_is_pulled_is_seen_in_100_ms_and_nothing_arms_itself(wire, device):
    drive = live(wire, device)
    at = time.monotonic()
    wire.tell("unplug")
    with pytest.raises(DeviceError, match="port"):
        drive.on(2.0)
    assert time.monotonic() - at < 0.1 + 0.1  # and what a loaded machine adds
    h = null(wire)
    assert h["live"] - h["fed"] < PATIENCE
    name = wire.plug()
    time.sleep(0.1)
    assert wire.history()["v"] == 0
    with pytest.raises(DeviceError):
        device.sensor.read()
    device.actuator.zero()
    wire.settings["port"] = name
    again = wire.open(port=name)
    time.sleep(0.1)
    assert not again.sensor.read().values[:, 2].any()
    again.close()


@pytest.fixture(autouse=True)
def port(shared: Wire) -> None:
    """The port has its newest name in the rig, too."""
    shared.rig.device.settings["port"] = shared.settings["port"]


def test_a_node_that_reboots_is_at_null_and_the_run_is_over(wire, device):
    drive = live(wire, device)
    wire.tell("reboot")
    with pytest.raises(DeviceError, match="rebooted"):
        drive.on(2.0)
    h = wire.history()
    assert (h["v"], h["state"]) == (0, "IDLE")
    # What the old run still sends is of the wrong boot.
    device.actuator.write(CommandBlock(h["sample"] + 30, np.ones(60), np.zeros(60)))
    time.sleep(0.1)
    h = wire.history()
    assert h["v"] == 0
    assert h["rejected"] >= 1


def test_counters_that_wrap_are_not_seen(wire):
    wire.tell(f"reboot {2**32 - 100} {2**32 - 150_000}")
    device = wire.open()
    device.actuator.configure(LOOP)
    drive = Drive(device)
    drive.on(0.6)
    device.close()
    sequence = drive.sequence
    assert sequence[0] < 2**32 < sequence[-1]
    assert (np.diff(sequence) == 1).all()
    clock = np.concatenate([b.time for b in drive.blocks])
    assert (np.diff(clock) == 2_000_000).all()
    assert drive.column(2).any()


def test_a_clock_that_is_set_back_ends_the_run_with_every_sample_kept(wire, device):
    drive = live(wire, device)
    wire.tell("clock -3000000")
    with pytest.raises(DeviceError, match="clock jumped by -3 s"):
        drive.on(2.0)
    assert (np.diff(drive.sequence) == 1).all()
    device.close()
    null(wire)


def test_bytes_that_are_lost_or_turned_never_make_a_wrong_sample(wire):
    for way in ("up", "down"):
        wire.tell(f"line {way} loss 2e-4", f"line {way} flip 2e-4")
        wire.tell(f"line {way} duplicate 0.02", f"line {way} reorder 0.02")
    device = wire.open(max_bad_frames=1e6)
    drive = Drive(device)
    # Requests are asked again until they are answered.
    device.actuator.configure(LOOP)
    drive.on(1.5)
    device.close()
    sequence = drive.sequence
    assert (np.diff(sequence) >= 1).all()
    assert sequence[-1] - sequence[0] + 1 > len(sequence), "nothing was lost: no test"
    u = drive.column(0)
    assert np.isin(np.round(u, 3), [0.0, 0.3]).all()
    assert np.abs(drive.column(3)).max() < 0.35
    counts = {k: int(v) for k, v in device.metadata.items() if k.startswith("frames")}
    assert counts["frames_lost"] > 0
    assert counts["frames_corrupt"] > 0
    assert counts["frames_stale"] > 0


def test_a_line_that_is_too_bad_ends_the_run(wire, device):
    live(wire, device)
    wire.tell("line down flip 0.002")
    with pytest.raises(DeviceError, match="frames lost or damaged"):
        Drive(device).on(3.0)


def test_a_line_that_stalls_leaves_the_output_at_null(wire, device):
    drive = live(wire, device)
    wire.tell("stall 0.3")
    drive.on(0.5)
    h = wire.history()
    assert (h["v"], h["state"]) == (0, "DEAD")
    assert h["live"] - h["fed"] < PATIENCE
    # All samples come, late; what was sent into the stall moves nothing.
    assert (np.diff(drive.sequence) == 1).all()


@pytest.mark.parametrize(
    ("command", "back"),
    [("emergency 1", "emergency 0"), ("jump 5000", "jump -5000"), ("rail 0 1", "rail 0 0")],
)
def test_the_node_trips_and_the_samples_say_so(wire, device, command, back):
    drive = live(wire, device)
    wire.tell(command)
    drive.on(0.2)
    h = wire.history()
    assert (h["v"], h["state"]) == (0, "TRIPPED")
    assert drive.blocks[-1].quality[-1, 2] & Quality.LIMITED
    if command == "rail 0 1":
        assert drive.blocks[-1].quality[-1, 4] & Quality.CLIPPED
    if not command.startswith("jump"):
        with pytest.raises(DeviceError, match="cause"):
            device.actuator.configure(LOOP)
        device.close()
        with pytest.raises(DeviceError, match="cause is still there"):
            wire.open()
    wire.tell(back)
    time.sleep(0.05)
    device.close()
    again = wire.open()
    assert wire.history()["state"] == "IDLE"
    again.close()


def test_a_script_of_faults_is_carried_out_or_refused(wire, tmp_path):
    script = tmp_path / "faults.txt"
    script.write_text("# s  what\n0.5 emergency 1\n\n1 stall 0.2\n")
    assert read_script(script) == [(0.5, "emergency 1"), (1.0, "stall 0.2")]
    script.write_text("soon emergency 1\n")
    with pytest.raises(InputError, match="SECONDS COMMAND"):
        read_script(script)
    with pytest.raises(InputError, match="explode"):
        WireRig(wire.rig, SimSettings(seed=1), None).obey("explode")


def test_a_line_that_stalled_passes_again_when_the_rig_is_as_new(wire):
    wire.tell("stall 60")
    wire.rest()
    device = wire.open()  # the node answers
    try:
        until(lambda: device.sensor.read() is not None)
    finally:
        device.close()


# What is said when it does not open


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc/locks tells who it is")
def test_a_second_program_is_told_who_has_the_port(wire, device):
    with pytest.raises(DeviceError, match=rf"in use by process {os.getpid()} \(.*py"):
        wire.open()
    # And the first goes on.
    live(wire, device)


def test_the_port_is_free_after_close(wire):
    for _ in range(2):
        wire.open().close()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"port": "/dev/no_such_port"}, "no such port"),
        ({"baud": 9600}, "baud"),
        ({"null": 3}, r"null is 3; expected 37"),
        ({"colour": "red"}, "one of port, baud"),
        ({"output_counts_per_unit": 0.0}, "output_counts_per_unit"),
        ({"encoder": {}}, "encoder and adc"),
        ({"encoder": {"theta_2": {"index": 7, "counts_per_unit": 9.0}}}, "index is 7"),
        ({"encoder": {"theta_2": {"index": 0, "counts_per_unit": 0.0}}}, "counts_per_unit is 0"),
        ({"encoder": {"nothing": {"index": 0, "counts_per_unit": 9.0}}}, "one of a_0"),
        ({"port": 5}, "port is 5"),
    ],
)
def test_a_wrong_setting_is_one_line(wire, changes, said):
    with pytest.raises((InputError, DeviceError), match=said) as caught:
        wire.open(**changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("field", "value"), [("rate_hz", 1000.0), ("deadman", 0.1)])
def test_a_node_that_is_not_the_rigs_is_refused(wire, field, value):
    rig = wire.rig
    if field == "deadman":
        changed = rig.actuator[0].model_copy(update={"deadman": value})
        update: dict = {"actuator": (changed,)}
    else:
        update = {field: value}
    plain, wire.rig = rig, rig.model_copy(update=update)
    try:
        with pytest.raises(InputError, match=field):
            wire.open()
    finally:
        wire.rig = plain


@pytest.mark.parametrize(
    ("answer", "said"),
    [(b"", "nothing answers"), (b"\x55\xaa\x00\x80" * 9, "baud"), ("version", "version 3")],
)
def test_what_is_no_node_of_this_version_is_named(wire, monkeypatch, answer, said):
    from serial_frames_kit import raw

    monkeypatch.setattr("drivers.serial_node.link.HELLO_WITHIN", 0.4)
    master, slave = os.openpty()
    if answer == "version":
        answer = raw(3, 1, 1, 0, b"a hello of the future")
    monkeypatch.setattr("serial.Serial.reset_input_buffer", lambda _: os.write(master, answer))
    import tty

    tty.setraw(slave)
    try:
        with pytest.raises(DeviceError, match=said):
            wire.open(port=os.ttyname(slave))
    finally:
        os.close(master)
        os.close(slave)


def test_a_feedback_is_refused(device):
    loop = Feedback(
        name="damper", sensor="a_0", actuator="v_2", gain=1.0, unit="V/(m/s^2)", max=1.0
    )
    with pytest.raises(DeviceError, match="no filters"):
        device.actuator.configure(DeviceLoop("theta_2", 4.0, 5.0, 2000.0, 0.35, (loop,)))


def test_a_limit_beyond_the_nodes_own_is_refused(device):
    with pytest.raises(DeviceError, match="hard limit"):
        device.actuator.configure(DeviceLoop("theta_2", 4.0, 11.0, 2000.0, 0.35))


def test_the_line_can_be_described_in_a_rig_file(wire, tmp_path):
    from samii_rig.rig.load import load_rig
    from sim.wire.plant import board

    path = wire.rig_file(tmp_path)
    made = board(load_rig(str(path))[0]).settings(wire.settings["port"])
    assert json.dumps(made, sort_keys=True) == json.dumps(wire.settings, sort_keys=True)
