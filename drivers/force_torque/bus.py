"""A CAN bus by python-can: opened with one clear line when it does not, never shared."""

from __future__ import annotations

import contextlib
import errno
import warnings
from pathlib import Path

import can
import can.interfaces.slcan
import serial

from drivers.force_torque.settings import CanSettings
from drivers.ports import open_port
from samii_rig.errors import DeviceError

NETWORK = Path("/sys/class/net")
# s; far longer than a busy machine may keep this thread waiting, as silence is seen without it.
SEND_WITHIN = 0.25
ENDS = b"\r\a"  # of a line of slcan: done, and refused
LONGEST_LINE = 64  # bytes of a line; an extended frame with a time stamp has 30


class Slcan(can.interfaces.slcan.slcanBus):
    """python-can's, but it reads what waits at once: byte by byte it takes a third of a core at
    a thousand frames a second."""

    def _read(self, timeout: float | None) -> str | None:
        until = serial.Timeout(timeout)
        while True:
            for i, byte in enumerate(self._buffer):
                if byte in ENDS:
                    line = self._buffer[: i + 1].decode("ascii", "replace")
                    del self._buffer[: i + 1]
                    return line
            if len(self._buffer) > LONGEST_LINE:
                self._buffer.clear()
            came = self.serialPortOrig.read(max(1, self.serialPortOrig.in_waiting))
            self._buffer += came
            if not came and until.expired():
                return None


def open_bus(s: CanSettings) -> can.BusABC:
    """The bus of the settings; DeviceError with the remedy."""
    match s.interface:
        case "slcan":
            return _slcan(s)
        case "socketcan":
            return _socketcan(s)
        case _:
            return can.Bus(interface="virtual", channel=s.channel)


def send(bus: can.BusABC, identifier: int, data: bytes = b"") -> None:
    """One frame with an 11 bit identifier; DeviceError if the bus does not take it."""
    frame = can.Message(arbitration_id=identifier, is_extended_id=False, data=data)
    try:
        bus.send(frame, timeout=SEND_WITHIN)
    except (can.CanError, OSError, serial.SerialException) as error:
        raise DeviceError(f"{bus.channel_info}: the bus takes nothing: {error}") from error


def shut(bus: can.BusABC) -> None:
    """Give the bus back, also where it is gone already."""
    with contextlib.suppress(can.CanError, OSError, serial.SerialException):
        bus.shutdown()
    if isinstance(bus, can.interfaces.slcan.slcanBus):
        # Its own shutdown gives up at a port that is gone, and leaves it open.
        bus.serialPortOrig.close()
        bus.shutdown = lambda: None  # type: ignore[method-assign]


def _slcan(s: CanSettings) -> can.BusABC:
    known = can.interfaces.slcan.slcanBus._BITRATES
    if s.bitrate not in known:
        rates = ", ".join(str(b) for b in sorted(known))
        raise DeviceError(
            f"{s.channel}: device.settings.bitrate = {s.bitrate} is none of slcan's: {rates}"
        )
    # python-can does not lock the port, and writes to it at once.
    open_port(s.channel, s.tty_baud, "tty_baud").close()
    try:
        bus = Slcan(
            s.channel, tty_baudrate=s.tty_baud, bitrate=s.bitrate, sleep_after_open=s.settle
        )
        bus.serialPortOrig.exclusive = True
        bus.flush()
    except (can.CanError, OSError, ValueError, serial.SerialException) as error:
        raise DeviceError(f"{s.channel}: the CAN adapter does not open: {error}") from error
    bus.channel_info = s.channel
    return bus


def _socketcan(s: CanSettings) -> can.BusABC:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            bus = can.Bus(interface="socketcan", channel=s.channel)
    except (OSError, can.CanError) as error:
        raise DeviceError(_why(s, error)) from error
    bus.channel_info = s.channel
    return bus


def _why(s: CanSettings, error: Exception) -> str:
    number = getattr(error, "errno", None) or getattr(error, "error_code", None)
    if number in (errno.ENODEV, errno.ENXIO, errno.ENOENT):
        names = sorted(p.name for p in NETWORK.glob("*can*")) if NETWORK.exists() else []
        found = ", ".join(names) or "none"
        return f"{s.channel}: no such CAN interface; those of this machine: {found}"
    if number in (errno.EACCES, errno.EPERM):
        return f"{s.channel}: no permission to open a CAN socket; run as a user who may"
    if number == errno.ENETDOWN:
        return (
            f"{s.channel}: the interface is down; sudo ip link set {s.channel} up type can "
            f"bitrate {s.bitrate}"
        )
    if number == errno.EAFNOSUPPORT:
        return f"{s.channel}: this system has no CAN sockets; load the kernel modules can, can_raw"
    return f"{s.channel}: {error}"
