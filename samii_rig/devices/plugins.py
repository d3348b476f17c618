"""Somebody else's devices and experiments: what goes wrong in them is one line with their name.

An entry point may come from any package. What it raises, or returns in place of what it promised,
is reported as wrong input, so that a command neither ends with a traceback nor, on a SystemExit,
as if all had gone well.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint

from samii_rig.devices.protocols import Actuator, Actuators, Clock, OpenRig, Sensor
from samii_rig.errors import InputError, SamiiRigError
from samii_rig.types import Channel


def named(point: EntryPoint) -> str:
    """An entry point as its package declares it."""
    return f"entry point {point.name} = {point.value}"


@contextmanager
def asked(who: str, what: str) -> Iterator[None]:
    """Around a call of `what` in the code behind the entry point `who`: whatever that raises but
    our own errors and Ctrl-C becomes an InputError."""
    try:
        yield
    except (SamiiRigError, KeyboardInterrupt):
        raise
    except BaseException as error:
        text = " ".join(str(error).split())
        said = f"{type(error).__name__}: {text}" if text else type(error).__name__
        raise InputError.saying(who, what, f"raised {said}") from error


def wrong(who: str, what: str, value: object, expected: str) -> InputError:
    """The code behind the entry point `who` gave `value` as `what`."""
    return InputError(who, what, value, expected)


def checked_device(opened: object, who: str) -> OpenRig:
    """What a driver returned, if it is a rig whose parts are there; else InputError."""
    if not isinstance(opened, OpenRig):
        raise InputError.saying(who, "", f"returned {type(opened).__name__}; expected an OpenRig")
    if not isinstance(opened.actuator, Actuator | Actuators):
        raise wrong(who, "actuator", opened.actuator, "what has all of a Actuator")
    for part, kind in (("sensor", Sensor), ("clock", Clock)):
        found = getattr(opened, part)
        if not isinstance(found, kind):
            raise wrong(who, part, found, f"what has all of a {kind.__name__}")
    channels, metadata = opened.sensor.channels, opened.metadata
    if not (isinstance(channels, tuple) and all(isinstance(c, Channel) for c in channels)):
        raise wrong(who, "sensor.channels", channels, "a tuple of Channel")
    texts = isinstance(metadata, dict) and all(
        isinstance(x, str) for kv in metadata.items() for x in kv
    )
    if not texts:
        raise wrong(who, "metadata", metadata, "texts by name")
    return opened
