"""Frames of the quadrature counter, protocol version 1 (docs/reference/quadrature.md)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

from cobs import cobs

VERSION = 1
HELLO, COUNTS, IDENTIFY = 1, 2, 16
HEAD = struct.Struct("<BBHI")  # version, type, boot, seq
TOLD = struct.Struct("<IB16s16s")  # period_us, counters, firmware, serial
SAMPLE = struct.Struct("<IB")  # clock_us, bit i: counter i has missed an edge
CRC = struct.Struct("<I")
LONGEST_FRAME = 128  # bytes of a frame before COBS
WORD, HALF = 1 << 32, 1 << 31


@dataclass(frozen=True, slots=True)
class Told:
    """What the board says of itself."""

    boot: int
    period_us: int
    counters: int
    firmware: str
    serial: str


@dataclass(frozen=True, slots=True)
class Sample:
    """seq : number of the frame and so of the sample, mod 2^32. arrived : ns of the host."""

    boot: int
    seq: int
    clock_us: int
    missed: int
    counts: tuple[int, ...]
    arrived: int = 0


@dataclass(slots=True)
class Decoder:
    """Bytes to messages; what is not whole is counted in `corrupt` and never handed on."""

    corrupt: int = 0
    received: int = 0
    version: int = VERSION
    _rx: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> Iterator[Told | Sample]:
        """The messages that these bytes complete."""
        self.received += len(data)
        *ends, rest = data.split(b"\0")
        for part in ends:
            self._rx += part
            stuffed = bytes(self._rx)
            self._rx.clear()
            if stuffed:
                message = self._message(stuffed)
                if message is None:
                    self.corrupt += 1
                else:
                    yield message
        self._rx += rest[: LONGEST_FRAME + 2 - len(self._rx)]

    def _message(self, stuffed: bytes) -> Told | Sample | None:
        try:
            p: bytes = cobs.decode(stuffed) if len(stuffed) <= LONGEST_FRAME + 1 else b""
        except cobs.DecodeError:
            return None
        if len(p) < HEAD.size + CRC.size or p[-4:] != CRC.pack(zlib.crc32(p[:-4])):
            return None
        version, kind, boot, seq = HEAD.unpack_from(p)
        body = p[HEAD.size : -CRC.size]
        if version != VERSION:
            self.version = version
            return None
        if kind == HELLO and len(body) == TOLD.size:
            period, counters, *text = TOLD.unpack(body)
            firmware, number = (t.rstrip(b"\0").decode("ascii", "replace") for t in text)
            return Told(boot, period, counters, firmware, number) if period else None
        n, rest = divmod(len(body) - SAMPLE.size, 4)
        if kind == COUNTS and n > 0 and not rest:
            clock, missed = SAMPLE.unpack_from(body)
            return Sample(boot, seq, clock, missed, struct.unpack_from(f"<{n}i", body, SAMPLE.size))
        return None


def request(seq: int) -> bytes:
    """IDENTIFY, with a delimiter before it that ends whatever was cut short."""
    payload = HEAD.pack(VERSION, IDENTIFY, 0, seq)
    stuffed: bytes = cobs.encode(payload + CRC.pack(zlib.crc32(payload)))
    return b"\0" + stuffed + b"\0"
