"""A simulated quadrature counter: the bytes of its board, from docs/reference/quadrature.md."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

from cobs import cobs

WORD = 1 << 32


def framed(payload: bytes) -> bytes:
    """With its checksum, stuffed and delimited."""
    stuffed: bytes = cobs.encode(payload + struct.pack("<I", zlib.crc32(payload)))
    return stuffed + b"\0"


@dataclass(slots=True)
class Counter:
    """One board since its boot. seq : of the next sample. clock_us : its time, mod 2^32."""

    period_us: int = 2000
    n: int = 2
    boot: int = 1
    seq: int = 0
    clock_us: int = 0
    version: int = 1
    _rx: bytes = b""

    def sample(self, counts: tuple[int, ...], missed: int = 0) -> bytes:
        """The frame of the sample that is taken now; the clock goes on by a period."""
        body = struct.pack(f"<IB{self.n}i", self.clock_us, missed, *counts)
        out = self._frame(2, self.seq, body)
        self.seq = (self.seq + 1) % WORD
        self.clock_us = (self.clock_us + self.period_us) % WORD
        return out

    def receive(self, data: bytes) -> bytes:
        """What it answers."""
        *frames, self._rx = (self._rx + data).split(b"\0")
        out = b""
        for stuffed in frames:
            try:
                p: bytes = cobs.decode(stuffed)
            except cobs.DecodeError:
                continue
            if len(p) == 12 and p[:2] == b"\x01\x10" and framed(p[:-4]) == stuffed + b"\0":
                text = b"counter 1".ljust(16, b"\0") + b"QC-0003".ljust(16, b"\0")
                out += self._frame(1, 0, struct.pack("<IB", self.period_us, self.n) + text)
        return out

    def _frame(self, kind: int, seq: int, body: bytes) -> bytes:
        return framed(struct.pack("<BBHI", self.version, kind, self.boot, seq) + body)
