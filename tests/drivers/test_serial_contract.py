"""The driver of the serial node does all that a device must, over a real port in real time.

With the simulated node, and with the firmware's image in its place.
"""

from collections.abc import Iterator

import pytest
from board_kit import NODES, options
from contract import DeviceContract
from wire_kit import Wire, slow_deadman

from samii_rig.devices.protocols import OpenRig


@pytest.fixture(scope="class", params=NODES)
def wire(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Wire]:
    # A slow machine may feed late; how soon the deadman acts is tested in test_wire_faults.py.
    file = slow_deadman(tmp_path_factory.mktemp("rig"))
    w = Wire(*options(request.param), rig=str(file))
    request.cls.wire, request.cls.rig = w, w.rig
    yield w
    w.close()


@pytest.mark.usefixtures("wire")
class TestSerialSamii(DeviceContract):
    wire: Wire

    def open(self) -> OpenRig:
        self.wire.rest()
        return self.wire.open()
