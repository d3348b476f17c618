"""A node that drives and a sensor on CAN, as one device, do all that a device must."""

from collections.abc import Iterator

import pytest
from can_kit import CanWire, moment_rig
from contract import DeviceContract
from wait_kit import patient

import drivers.composite.rig as composite
from samii_rig.devices.opening import open_device
from samii_rig.devices.protocols import OpenRig


@pytest.fixture(scope="class")
def wire(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[CanWire]:
    w = CanWire(rig=str(moment_rig(tmp_path_factory.mktemp("rig"), deadman=0.2)))
    # Nothing waits long for the moment, which is not what is tried here.
    w.settings["ft"]["gap"] = 0.004
    request.cls.wire, request.cls.rig = w, patient(w.rig, 1.0)
    with pytest.MonkeyPatch.context() as patch:
        # Nor how well the clocks are known, which takes a second each time it is opened.
        patch.setattr(composite, "LISTEN", 0.3)
        yield w
    w.close()


@pytest.mark.usefixtures("wire")
class TestComposite(DeviceContract):
    wire: CanWire

    def open(self) -> OpenRig:
        self.wire.rest()
        return open_device(self.rig, {})
