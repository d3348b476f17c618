"""The simulated rig with a force/torque sensor on CAN, in its own process."""

from __future__ import annotations

from pathlib import Path

from wire_kit import Wire, until

from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device, Rig

MOMENT = """
[[sensor]]
name = "M_2"
kind = "moment"
after = "joint_2"
unit = "N m"
noise_rms = 0.02
resolution = 0.01
low = -500.0
high = 500.0
stale_after = 0.05
calibration = "force/torque sensor"

"""
LIMIT = """
[[limit]]
channel = "M_2"
unit = "N m"
max = 400.0
reason = "the end of the force/torque sensor's range is 500"

"""


def moment_rig(folder: Path, deadman: float = 0.05) -> Path:
    """The shipped rig with a moment sensor after joint 2, which the gate needs."""
    text = load_rig("samii")[1].replace("deadman = 0.05", f"deadman = {deadman}")
    text = text.replace("[[actuator]]", MOMENT.lstrip() + "[[actuator]]", 1)
    path = folder / "moment.toml"
    path.write_text(text.replace("[device]", LIMIT.lstrip() + "[device]", 1))
    return path


class CanWire(Wire):
    """`python -m sim.wire.can`, and the composite rig whose drivers lead to it."""

    program, driver = "sim.wire.can", "composite"

    def __init__(self, *options: str, rig: str) -> None:
        super().__init__(*options, rig=rig)
        names = self.settings["ft"]["sensors"]
        own = tuple(s for s in self.rig.sensor if s.name in names)
        ft = {k: v for k, v in self.settings["ft"].items() if k not in ("driver", "sensors")}
        alone = Device(driver="force_torque", settings=ft)
        self.sensor_rig: Rig = self.rig.model_copy(update={"sensor": own, "device": alone})

    def rest(self) -> None:
        """Rig, node, adapter and sensor as new."""
        self.tell("can rest")
        super().rest()


__all__ = ["CanWire", "moment_rig", "until"]
