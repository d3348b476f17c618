"""The simulated rig with two driven joints does all that a device with several outputs must."""

from contract_several import OutputsContract

from samii_rig.devices.opening import open_device
from samii_rig.devices.protocols import OpenRig
from samii_rig.rig.load import load_rig


class TestSimulatedJoints(OutputsContract):
    rig = load_rig("samii_two_joints")[0]

    def open(self) -> OpenRig:
        return open_device(self.rig, {})
