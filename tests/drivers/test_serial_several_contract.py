"""The driver of a serial node with two outputs does all that a device with several must, over a
real port in real time; and a host that is killed leaves both at null.

With the simulated node, and with the firmware's image in its place.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
from board_kit import NODES, options
from contract_several import OutputsContract
from wait_kit import WITHIN
from wire_kit import Wire, slow_deadman, until

from samii_rig.devices.protocols import OpenRig

TWO = "samii_two_joints"
DEADMAN = 0.05  # s
# A host that keeps both outputs live until it is stopped from outside.
HOST = """
import sys, time
import numpy as np
from drivers.serial_node import open_rig
from samii_rig.rig.schema import Rig
from samii_rig.devices.protocols import CommandBlock, DeviceLoop

rig = Rig.model_validate_json(sys.stdin.readline())
device = open_rig(rig, rig.device.settings)
kept = 5.0, 2000.0, 0.35
device.actuator.configure((DeviceLoop("theta_2", 4.0, *kept), DeviceLoop("theta_3", 3.0, *kept)))
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
            blocks = tuple(CommandBlock(sent, np.full(n, u), np.zeros(n)) for u in (0.3, -0.2))
            device.actuator.write(blocks)
            sent += n
"""


@pytest.fixture(scope="class", params=NODES)
def wire(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Wire]:
    # A slow machine may feed late; how soon the deadman acts is tested below.
    file = slow_deadman(tmp_path_factory.mktemp("rig"), TWO)
    w = Wire(*options(request.param), rig=str(file))
    request.cls.wire, request.cls.rig = w, w.rig
    yield w
    w.close()


@pytest.mark.usefixtures("wire")
class TestSerialJoints(OutputsContract):
    wire: Wire

    def open(self) -> OpenRig:
        self.wire.rest()
        return self.wire.open()


def in_time(wire: Wire) -> bool:
    """Whether the rig's process, which compiles and boots at first, keeps up by now."""
    wire.rest()
    time.sleep(0.2)
    return wire.history()["late"] < 0.02e9


@pytest.mark.parametrize("node", NODES)
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_host_that_is_killed_or_hangs_leaves_both_at_null_in_one_sample(how, node):
    wire = Wire(*options(node), rig=TWO)
    until(lambda: in_time(wire), WITHIN)
    host = subprocess.Popen([sys.executable, "-c", HOST], stdin=subprocess.PIPE, text=True)
    try:
        assert host.stdin is not None
        host.stdin.write(wire.rig.model_dump_json() + "\n")
        host.stdin.flush()
        until(lambda: wire.history()["state"] == "LIVE", 30.0)
        host.send_signal(how)
        time.sleep(4 * DEADMAN)
        h = wire.history()
        assert (h["v"], h["state"]) == (0, "DEAD")
        assert h["ended"][0] == h["ended"][1] == h["live"]
        assert h["live"] - h["fed"] < DEADMAN * wire.rig.rate_hz
        if how is signal.SIGSTOP:
            # When it goes on, its stream no longer moves anything.
            host.send_signal(signal.SIGCONT)
            time.sleep(2 * DEADMAN)
            assert wire.history()["live"] == h["live"]
    finally:
        assert host.stdin is not None
        host.kill()
        host.stdin.close()
        host.wait()
        wire.close()
