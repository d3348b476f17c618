"""The actuators of a board: of a rig with one output, and of a rig with several."""

from __future__ import annotations

from typing import Any

from drivers.ni_daq.output import Playout
from drivers.ni_daq.settings import NiSettings, Output
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.rig.schema import Rig


class AnalogueOutput(Playout):
    """The actuator of a rig with one output."""

    def __init__(self, ni: Any, settings: NiSettings, o: Output, rig: Rig) -> None:
        (self.name,) = (a.name for a in rig.actuator)
        super().__init__(ni, settings, o, rig)

    def configure(self, loop: DeviceLoop) -> None:
        """Set the limits, and play out null; DeviceError for a loop, or while it is live."""
        self.take_limits((loop,))

    def write(self, block: CommandBlock) -> None:
        """Queue reference samples; feeds the deadman. What comes too late is ignored."""
        self.queue((block,))


class AnalogueOutputs(Playout):
    """The actuators of a rig with several outputs, in the rig file's order."""

    def __init__(self, ni: Any, settings: NiSettings, o: Output, rig: Rig) -> None:
        self.names = tuple(a.name for a in rig.actuator)
        super().__init__(ni, settings, o, rig)

    def configure(self, loops: tuple[DeviceLoop, ...]) -> None:
        """Set each output's limits, and play out null; DeviceError for a loop, or while live."""
        self.take_limits(loops)

    def write(self, blocks: tuple[CommandBlock, ...]) -> None:
        """Queue reference samples of all; feeds the deadman. What comes too late is ignored."""
        self.queue(blocks)
