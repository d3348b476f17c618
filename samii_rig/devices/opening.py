"""Open a rig's devices by the name of their driver."""

from __future__ import annotations

from importlib import import_module, metadata

from samii_rig.devices.plugins import asked, checked_device, named
from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import DeviceError, InputError, SamiiRigError, one_of
from samii_rig.installed import points
from samii_rig.rig.schema import Rig

GROUP = "samii_rig.devices"


def drivers() -> dict[str, metadata.EntryPoint]:
    """Entry points by the name that a rig file's `[device] driver` gives."""
    return {point.name: point for point in points(GROUP)}


def known_driver(rig: Rig) -> metadata.EntryPoint:
    """The rig's driver; InputError if there is none of that name."""
    known = drivers()
    if rig.device.driver not in known:
        expected = one_of(rig.device.driver, sorted(known))
        raise InputError("rig file", "device.driver", rig.device.driver, expected)
    return known[rig.device.driver]


def open_device(rig: Rig, settings: dict[str, object]) -> OpenRig:
    """Open the rig's device; `settings` override those of the rig file.

    InputError for an unknown driver or setting, or for a driver that does not do what it promises;
    DeviceError if the device does not open.
    """
    point = known_driver(rig)
    with asked(named(point), ""):
        opened = point.load()(rig, {**rig.device.settings, **settings})
        return checked_device(opened, named(point))


def check_device(rig: Rig) -> None:
    """What the rig's driver says of the rig file before it reaches for any device.

    A driver's module may have `check_rig(rig, settings)` beside its entry point. InputError for
    an unknown driver, and for whatever the driver could not run: so a dry run refuses it too.
    """
    point = known_driver(rig)
    with asked(named(point), ""):
        point.load()
        check = getattr(import_module(point.module), "check_rig", None)
        if check is not None:
            check(rig, dict(rig.device.settings))


def close_device(device: OpenRig) -> None:
    """Close a device; DeviceError if it does not do so."""
    try:
        device.close()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a driver's SystemExit must not end this as if all were well
        text = " ".join(str(error).split())
        known = isinstance(error, SamiiRigError)
        said = text if known else f"{type(error).__name__}: {text}"
        raise DeviceError(f"the device did not close: {said}") from error
