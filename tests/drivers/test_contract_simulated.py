"""The simulated rig does all that a device must."""

from contract import DeviceContract

from samii_rig.devices.opening import open_device
from samii_rig.devices.protocols import OpenRig
from samii_rig.rig.load import load_rig


class TestSimulatedSamii(DeviceContract):
    rig = load_rig("samii")[0]

    def open(self) -> OpenRig:
        return open_device(self.rig, {})


class TestSimulatedSflr(DeviceContract):
    rig = load_rig("sflr")[0]
    level = 0.2

    def open(self) -> OpenRig:
        return open_device(self.rig, {})
