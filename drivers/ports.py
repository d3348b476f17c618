"""Serial ports: opened for one program alone, and what is said when that fails."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import serial
from serial.tools import list_ports

from samii_rig.errors import DeviceError

READ_WAIT = 0.05  # s between looks at whether to go on
WRITE_WITHIN = 0.1  # s; a port that takes no bytes for two deadman times is as good as gone


def open_port(port: str, baud: int, setting: str = "baud") -> serial.Serial:
    """The port, empty and locked; DeviceError in one line, with the remedy.

    setting : name of the baud rate in device.settings, for the message.
    """
    try:
        opened = serial.Serial(
            port, baud, timeout=READ_WAIT, write_timeout=WRITE_WITHIN, exclusive=True
        )
        opened.reset_input_buffer()
        return opened
    except (OSError, ValueError, serial.SerialException) as error:
        raise DeviceError(_why(port, baud, setting, error)) from error


def _why(port: str, baud: int, setting: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number is None and isinstance(error.__context__, OSError):
        number = error.__context__.errno
    if number in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY):
        return f"{port}: in use by {_holder(port)}; end that program first"
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        found = ", ".join(sorted(p.device for p in list_ports.comports())) or "none"
        return f"{port}: no such port; ports of this machine: {found}"
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"{port}: no permission; put this user into the group that owns the port (on Linux "
            "often dialout: sudo usermod -aG dialout $USER) and log in again"
        )
    if isinstance(error, ValueError):
        return f"{port}: device.settings.{setting} = {baud} is no rate that this port can do"
    return f"{port}: {error}"


def _holder(port: str) -> str:
    """The program that has locked the port, by number and name where the system tells."""
    try:
        stat = Path(port).stat()
        place = f"{os.major(stat.st_dev):02x}:{os.minor(stat.st_dev):02x}:{stat.st_ino}"
        for line in Path("/proc/locks").read_text().splitlines():
            fields = line.split()
            if len(fields) > 5 and fields[5] == place:
                pid = fields[4]
                name = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
                words = b" ".join(name).decode("utf-8", "replace").strip()
                return f"process {pid} ({words[:60]})"
    except OSError:
        pass
    return "another program"
