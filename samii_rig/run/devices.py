"""Open a rig's devices by the name of their driver."""

from __future__ import annotations

from importlib import metadata

from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.schema import Rig
from samii_rig.run.protocols import OpenRig

GROUP = "samii_rig.devices"


def drivers() -> dict[str, metadata.EntryPoint]:
    """Entry points by the name that a rig file's `[device] driver` gives."""
    return {point.name: point for point in metadata.entry_points(group=GROUP)}


def open_device(rig: Rig, settings: dict[str, object]) -> OpenRig:
    """Open the rig's device; `settings` override those of the rig file.

    InputError for an unknown driver or setting, DeviceError if the device does not open.
    """
    known = drivers()
    if rig.device.driver not in known:
        expected = f"one of {', '.join(sorted(known))}"
        raise InputError("rig file", "device.driver", rig.device.driver, expected)
    opened = known[rig.device.driver].load()(rig, {**rig.device.settings, **settings})
    if not isinstance(opened, OpenRig):
        raise DeviceError(
            f"driver {rig.device.driver} returned {type(opened).__name__}, no OpenRig"
        )
    return opened
