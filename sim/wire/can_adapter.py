"""A simulated slcan adapter: a pseudo-terminal on one side, a CAN bus on the other."""

from __future__ import annotations

import contextlib
import errno
import os
import time
import tty
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sim.wire.can_sensor import Frame, Sensor

BITRATES = (10, 20, 50, 100, 125, 250, 500, 750, 1000)  # kbit/s of S0 to S8
READ = 4096  # bytes
DONE, REFUSED = b"\r", b"\a"
FOREIGN = 0x123  # an identifier that is not the sensor's


@dataclass(slots=True)
class Adapter:
    """The adapter, and the bus with one sensor.

    bitrate : kbit/s of the sensor's side. loss : probability that a frame to the host is lost.
    delay : s that replies take. foreign, other : frames a second of another sender on the
    sensor's identifier, and on another. bus_off : the controller has left the bus.
    """

    sensor: Sensor
    rng: np.random.Generator
    link: Path | None = None
    bitrate: int = 1000
    loss: float = 0.0
    delay: float = 0.0
    foreign: float = 0.0
    other: float = 0.0
    bus_off: bool = False
    port: str = ""
    fd: int = -1
    _slave: int = -1
    _host_rate: int = 0
    _open: bool = False
    _text: bytes = b""
    _waiting: deque[tuple[float, Frame]] = field(default_factory=deque)
    _sent: dict[str, float] = field(default_factory=dict)

    def plug(self) -> None:
        """A port, under a name that the system chooses; `link` leads to it."""
        if self.fd >= 0:
            return
        self.fd, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.fd, False)
        self.port = os.ttyname(self._slave)
        self._open, self._text = False, b""
        if self.link is not None:
            self.link.unlink(missing_ok=True)
            self.link.symlink_to(self.port)

    def unplug(self) -> None:
        """The port vanishes."""
        if self.fd >= 0:
            os.close(self._slave)
            os.close(self.fd)
            self.fd = self._slave = -1
        if self.link is not None:
            self.link.unlink(missing_ok=True)

    def serve(self) -> None:
        """Take what the host sent, and send what is due."""
        now = time.monotonic()
        out = b""
        if self.fd >= 0:
            with contextlib.suppress(BlockingIOError):
                out += self._commands(self._read(), now)
        out += self._traffic(now)
        while self._waiting and self._waiting[0][0] <= now:
            out += self._frame(self._waiting.popleft()[1])
        if out and self.fd >= 0:
            # Nobody reads: the bytes are gone, as on a real line.
            with contextlib.suppress(BlockingIOError):
                os.write(self.fd, out)

    def _read(self) -> bytes:
        try:
            return os.read(self.fd, READ)
        except OSError as error:
            if error.errno not in (errno.EIO, errno.EAGAIN):
                raise
            return b""

    def _commands(self, data: bytes, now: float) -> bytes:
        *lines, self._text = (self._text + data).split(b"\r")
        return b"".join(self._command(line, now) for line in lines)

    def _command(self, line: bytes, now: float) -> bytes:
        kind, rest = line[:1], line[1:]
        if kind == b"S" and rest.isdigit() and int(rest) < len(BITRATES):
            self._host_rate = BITRATES[int(rest)]
        elif kind == b"O":
            self._open = True
        elif kind == b"C":
            self._open = False
            self._waiting.clear()
        elif kind == b"t":
            if not self._open or self.bus_off:
                return REFUSED
            self._transmit(int(rest[:3], 16), bytes.fromhex(rest[4:].decode()), now)
            return b"z" + DONE
        elif line:
            return REFUSED
        return DONE

    def _transmit(self, identifier: int, data: bytes, now: float) -> None:
        # With another bit rate nobody on the bus understands it.
        if self._host_rate == self.bitrate:
            for frame in self.sensor.answer(identifier, data):
                self._waiting.append((now + self.delay, frame))

    def _traffic(self, now: float) -> bytes:
        """Frames of other senders that are due."""
        out = b""
        fake = 16 * self.sensor.base, bytes(8)
        for name, rate, frame in (
            ("foreign", self.foreign, fake),
            ("other", self.other, (FOREIGN, b"hello")),
        ):
            if rate and now >= self._sent.get(name, 0.0) + 1.0 / rate:
                self._sent[name] = now
                out += self._frame(frame)
        return out

    def _frame(self, frame: Frame) -> bytes:
        lost = self.loss and self.rng.random() < self.loss
        if lost or self.bus_off or not self._open or self._host_rate != self.bitrate:
            return b""
        identifier, data = frame
        return f"t{identifier:03X}{len(data)}{data.hex().upper()}\r".encode()
