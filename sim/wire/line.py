"""A serial line that is not perfect: bytes lost, bits turned, frames doubled, swapped, held."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

FAULTS = ("loss", "flip", "duplicate", "reorder")


@dataclass(slots=True)
class Line:
    """One direction.

    loss, flip : probability for each byte that it is lost, or one of its bits turned.
    duplicate, reorder : for each frame that it comes twice, or after the next one.
    """

    rng: np.random.Generator
    loss: float = 0.0
    flip: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    _open: bytes = b""
    _late: bytes = b""
    _held: bytearray = field(default_factory=bytearray)

    def pass_on(self, data: bytes, *, held: bool) -> bytes:
        """What comes out at the other end now; while `held`, nothing does, and later all."""
        self._held += self._bytes(self._frames(data))
        if held:
            return b""
        out = bytes(self._held)
        self._held.clear()
        return out

    def drop(self) -> None:
        """What is on its way is gone."""
        self._open = self._late = b""
        self._held.clear()

    def _frames(self, data: bytes) -> bytes:
        if not (self.duplicate or self.reorder or self._open or self._late):
            return data
        *ends, self._open = (self._open + data).split(b"\0")
        out = b""
        for end in ends:
            frame = end + b"\0"
            if self.rng.random() < self.duplicate:
                frame += frame
            if not self._late and self.rng.random() < self.reorder:
                self._late = frame
                continue
            out += frame + self._late
            self._late = b""
        return out

    def _bytes(self, data: bytes) -> bytes:
        if not data or not (self.loss or self.flip):
            return data
        x = np.frombuffer(data, dtype=np.uint8)
        turned = self.rng.random(x.size) < self.flip
        bits = (1 << self.rng.integers(0, 8, x.size)).astype(np.uint8)
        x = np.where(turned, x ^ bits, x)
        return bytes(x[self.rng.random(x.size) >= self.loss])
