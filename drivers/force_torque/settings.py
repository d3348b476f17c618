"""Settings of a force/torque sensor: its table in a rig file's [device.settings]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from drivers.force_torque.frames import AXES
from samii_rig.rig.schema import Finite, Name, NonNegative, Positive, Rig, Strict
from samii_rig.rig.settings import checked, wrong

UNITS = {"F": "N", "T": "N m"}  # of an axis, by its first letter
Row = Annotated[tuple[Finite, ...], Field(min_length=6, max_length=6)]


class Axis(Strict):
    """What a sensor of the rig reads: an axis of the device, perhaps with the other sign."""

    axis: Literal["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"]
    sign: Literal[1, -1] = 1


class CanSettings(Strict):
    """Settings of the driver; an unknown one is an error.

    interface, channel, bitrate : of python-can: an adapter's serial port for slcan, can0 for
        socketcan. tty_baud : of the adapter's port, for slcan; USB does not care. settle : s that
        an slcan adapter needs after its port opens.
    base_id : the sensor's base identifier. dbc : of its messages, "" for the shipped one.
    rate_hz : samples that are asked for; left out, the rig's.
    axes : by the name of a sensor or monitor; each of the rig's has one.
    calibration : 6x6 in counts per count, rows Fx to Tz, in place of the sensor's own.
    bias : s at the start over which the mean is taken as zero; 0 for none.
    """

    interface: Literal["slcan", "socketcan", "virtual"]
    channel: str = Field(min_length=1)
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    tty_baud: Annotated[int, Field(ge=9600, le=12_000_000)] = 115_200
    settle: NonNegative = 0.1
    base_id: Annotated[int, Field(ge=0, le=0x7F)] = 0x20
    dbc: str = ""
    rate_hz: Positive | None = None
    axes: dict[Name, Axis]
    calibration: Annotated[tuple[Row, ...], Field(min_length=6, max_length=6)] | None = None
    bias: NonNegative = 0.0


def read_settings(rig: Rig, given: Mapping[str, object]) -> CanSettings:
    """The settings, checked against the rig; InputError names the first wrong one."""
    s = checked(CanSettings, rig, given, page="docs/reference/force-torque.md")
    sensors = {x.name: x for x in (*rig.sensor, *rig.monitor)}
    for name, axis in s.axes.items():
        if name not in sensors:
            raise wrong(rig, "axes", name, f"one of {', '.join(sorted(sensors))}")
        unit = UNITS[axis.axis[0]]
        if sensors[name].unit != unit:
            expected = f"an axis in {sensors[name].unit}"
            raise wrong(rig, f"axes.{name}.axis", f"{axis.axis} in {unit}", expected)
    for name in sensors:
        if name not in s.axes:
            expected = f"{name} among them, with one of {', '.join(AXES)}"
            raise wrong(rig, "axes", sorted(s.axes), expected)
    return s
