"""Several devices in one rig, on one time base: that of the device that drives.

The main device paces and drives; the others only measure. Every sample of the rig is a sample of
the main device, at its time, with the others' values at that time: through the four of their
samples around it goes a cubic. Nothing is carried on past the newest, and nothing is repeated: a
sample for which the others are late is held back for a little more than the longest gap that is
bridged, and then goes out with theirs MISSING.

Each clock is held against the host's (`samii_rig.devices.timebase`); how well is in the metadata,
and from there in the covariance of every frequency response (`samii_rig.signal.skew`).
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import ConfigDict, Field

from drivers.composite.sensor import MAIN, Clocks, CompositeSensor, Side
from drivers.resampling import GAP, Track
from samii_rig.devices.opening import check_device, open_device
from samii_rig.devices.protocols import OpenRig
from samii_rig.devices.timebase import ClockModel, Timed
from samii_rig.errors import DeviceError, InputError, SamiiRigError
from samii_rig.rig.schema import Device, Name, Positive, Rig, Strict
from samii_rig.rig.settings import TABLE, checked, wrong

AGE_PART = 0.5  # of the age at which a channel is stale, that waiting may take
SETTLE = 3.0  # s within which the clocks must be known
LISTEN = 1.0  # s to listen in any case; the first tenths know the clocks half as well


class Part(Strict):
    """One device: its driver, what it measures (the main one: all that is left), its settings.

    gap : s between two of its samples that is bridged at most.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    driver: str = Field(min_length=1)
    sensors: Annotated[tuple[Name, ...], Field(min_length=1)] | None = None
    gap: Positive = GAP

    def settings(self) -> dict[str, object]:
        """Those of its driver."""
        return dict(self.model_extra or {})


@dataclass(frozen=True, slots=True)
class CompositeRig(OpenRig):
    """Closes the main device first: its output goes to zero."""

    parts: dict[str, OpenRig]

    def close(self) -> None:
        """All devices; may be called twice."""
        with contextlib.ExitStack() as stack:
            for name, part in reversed(self.parts.items()):
                stack.callback(self._close, name, part)

    def _close(self, name: str, part: OpenRig) -> None:
        part.close()
        self.metadata.update({f"{name}_{k}": v for k, v in part.metadata.items()})


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """All devices of the settings: `main`, and others by a name of their own.

    InputError for a wrong setting, DeviceError for a device that does not open or gives no time;
    what was open by then is closed.
    """
    parts = _read(rig, settings)
    opened: dict[str, OpenRig] = {}
    try:
        for name, part in parts.items():
            opened[name] = _open(rig, name, part, parts)
        return _together(rig, parts, opened)
    except BaseException:
        for part_rig in opened.values():
            with contextlib.suppress(SamiiRigError):
                part_rig.close()
        raise


def check_rig(rig: Rig, settings: Mapping[str, object]) -> None:
    """InputError for settings of devices that are none, or a main one that cannot drive it."""
    parts = _read(rig, settings)
    with _naming(MAIN):
        check_device(_sub(rig, parts[MAIN], parts))


def _together(rig: Rig, parts: dict[str, Part], opened: dict[str, OpenRig]) -> CompositeRig:
    main = opened[MAIN]
    sensor = main.sensor
    model = ClockModel(sensor.latency) if isinstance(sensor, Timed) else None
    ages = {x.name: x.stale_after for x in (*rig.sensor, *rig.monitor)}
    sides = [
        Side(
            name,
            part,
            Clocks(model, part.sensor),
            Track(part.sensor.channels, parts[name].gap),
            min(ages[n] for n in parts[name].sensors or ()),
        )
        for name, part in opened.items()
        if name != MAIN
    ]
    metadata = {
        "device": "composite",
        "clock": "device",
        **{f"{n}_{k}": v for n, part in opened.items() for k, v in part.metadata.items()},
    }
    both = CompositeSensor(main, model, sides, metadata)
    _settle(both, sides, main)
    return CompositeRig(
        main.actuator,
        both,
        main.clock,
        " with ".join(part.description for part in opened.values()),
        metadata,
        opened,
    )


def _settle(both: CompositeSensor, sides: list[Side], main: OpenRig) -> None:
    """Listen until the clocks are known; what was measured by then is nobody's."""
    begun = time.monotonic()
    ready = False
    while (since := time.monotonic() - begun) < LISTEN or (not ready and since < SETTLE):
        time.sleep(0.005)
        main.sensor.read()
        both.listen()
        for side in sides:
            side.opened.sensor.read()
            side.clocks.listen()
        ready = all(s.clocks.ready for s in sides)
    if not ready:
        slow = ", ".join(s.name for s in sides if not s.clocks.ready)
        raise DeviceError(
            f"{slow}: the clocks could not be held against each other in {SETTLE:g} s; does the "
            "device send samples with their times?"
        )
    now = time.monotonic_ns()
    for side in sides:
        side.opened.sensor.read()
        side.track.heard = now
    both.state()


def _open(rig: Rig, name: str, part: Part, parts: dict[str, Part]) -> OpenRig:
    """One device, with the part of the rig that it measures."""
    with _naming(name):
        opened = open_device(_sub(rig, part, parts), {})
    if opened.metadata.get("clock") == "simulated":
        opened.close()
        where = f"{name}.driver"
        raise wrong(rig, where, part.driver, "one in real time, not a model or replay")
    return opened


@contextlib.contextmanager
def _naming(name: str) -> Iterator[None]:
    """An InputError of the device `name` says which settings it means."""
    try:
        yield
    except InputError as error:
        text = str(error).replace("device.settings.", f"device.settings.{name}.")
        raise InputError.saying("", "", text) from error


def _sub(rig: Rig, part: Part, parts: dict[str, Part]) -> Rig:
    """The rig as one of its devices sees it: with what it measures."""
    elsewhere = {n for p in parts.values() for n in p.sensors or ()}
    own = set(part.sensors or ())

    def mine(sensor: str) -> bool:
        return sensor in own if own else sensor not in elsewhere

    device = Device(driver=part.driver, settings=part.settings())
    return rig.model_copy(
        update={
            "sensor": tuple(s for s in rig.sensor if mine(s.name)),
            "monitor": tuple(m for m in rig.monitor if mine(m.name)),
            "device": device,
        }
    )


def _read(rig: Rig, settings: Mapping[str, object]) -> dict[str, Part]:
    """The devices, the main one first."""
    expected = "a device: driver, sensors and its settings; see docs/reference/composite.md"
    parts = {
        name: checked(Part, rig, given, table=f"{TABLE}.{name}", expected=expected)
        for name, given in settings.items()
    }
    if MAIN not in parts:
        expected = f"{MAIN} among them, the device that drives"
        raise InputError(rig.name, TABLE, sorted(parts), expected)
    channels = [x.name for x in (*rig.sensor, *rig.monitor)]
    owner: dict[str, str] = {}
    least = min(x.stale_after for x in (*rig.sensor, *rig.monitor))
    for name, part in parts.items():
        # What waits for a gap to close is old when it comes: the node's own samples too.
        if part.gap > AGE_PART * least:
            expected = f"at most {AGE_PART * least:g}, half of the least stale_after"
            raise wrong(rig, f"{name}.gap", part.gap, expected)
        where = f"{name}.sensors"
        if (part.sensors is None) != (name == MAIN):
            expected = "left out" if name == MAIN else "the sensors that it measures"
            raise wrong(rig, where, part.sensors, expected)
        for sensor in part.sensors or ():
            if sensor not in channels:
                raise wrong(rig, where, sensor, f"one of {', '.join(channels)}")
            if sensor in owner:
                raise wrong(rig, where, sensor, f"none that {owner[sensor]} measures")
            owner[sensor] = name
    loops = [loop for a in rig.actuator if (loop := rig.centring_of(a.name))]
    for centring in [loop.sensor for loop in loops] or [rig.sensor[0].name]:
        if centring not in owner:
            continue
        where = f"{owner[centring]}.sensors"
        expected = f"no {centring}, on which {MAIN} closes its loop"
        raise wrong(rig, where, centring, expected)
    return {MAIN: parts[MAIN], **parts}
