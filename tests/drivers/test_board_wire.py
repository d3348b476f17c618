"""The driver on a real port, with the firmware's image in the simulated node's place: some of what
pytest -m slow holds it to as a whole.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from board_kit import options
from wire_kit import Wire

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError


@pytest.fixture(scope="module")
def wire() -> Iterator[Wire]:
    w = Wire("--seed", "5", *options("image"))
    yield w
    w.close()


def test_the_driver_runs_the_image_and_its_deadman_ends_what_nobody_feeds(wire):
    wire.rest()
    device = wire.open()
    device.actuator.configure(DeviceLoop("theta_2", 4.0, 5.0, 2000.0, 0.35))
    while not len(block := device.sensor.read()):
        device.clock.sleep(0.005)
    first = int(block.sequence[-1]) + 20
    device.actuator.write(CommandBlock(first, np.full(60, 0.3), np.zeros(60)))
    device.clock.sleep(0.3)
    history = wire.history()
    device.close()
    assert history["state"] == "DEAD"
    assert history["v"] == 0
    assert history["most"] > 0
    assert history["live"] - history["fed"] < 25


def test_a_fault_of_the_processor_ends_the_run_as_a_reboot(wire):
    wire.rest()
    device = wire.open()
    wire.tell("image fault")
    device.clock.sleep(0.3)
    device.sensor.read()
    with pytest.raises(DeviceError, match="rebooted"):
        device.sensor.read()
    device.close()
    assert wire.history()["v"] == 0
