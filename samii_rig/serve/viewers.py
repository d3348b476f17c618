"""Live data to those who look: each has a short queue, and loses frames rather than slow anyone.

A frame of samples is little-endian: uint8 kind (1), uint8 0, uint16 columns, uint32 rows,
uint32 step, uint32 frames lost by this viewer so far, float64 rate of the rows in Hz, int64
number of the first sample; then float32 values, row by row. With a step above 1 each pair of
rows is the smallest and the largest value of `step` samples.
"""

from __future__ import annotations

import asyncio
import json
import struct
from collections import deque
from typing import Any

import numpy as np

from samii_rig.serve.live import LiveReader
from samii_rig.types import Float

HEAD = struct.Struct("<BBHIIIdq")
SAMPLES = 1
PERIOD = 0.03  # s between frames: 33 a second, which a page smooths to its own pace
MOST_RATE = 1000.0  # rows/s and channel that a page can show
DEPTH = 32  # frames that wait for one viewer: a second
MOST_VIEWERS = 64
STATE_EVERY = 8  # periods between states that are sent although nothing changed


class Viewer:
    """One who looks. lost : frames that they were too slow for."""

    def __init__(self) -> None:
        self._frames: deque[bytes | str] = deque()
        self._there = asyncio.Event()
        self.lost = 0

    def give(self, frame: bytes | str) -> None:
        """Queue a frame; the oldest goes if there are too many."""
        if len(self._frames) >= DEPTH:
            self._frames.popleft()
            self.lost += 1
        self._frames.append(frame)
        self._there.set()

    async def next(self) -> bytes | str:
        """The next frame, with the number of those lost until now."""
        while not self._frames:
            self._there.clear()
            await self._there.wait()
        frame = self._frames.popleft()
        if isinstance(frame, str):
            return frame
        kind, zero, columns, rows, step, _, rate, first = HEAD.unpack_from(frame)
        head = HEAD.pack(kind, zero, columns, rows, step, self.lost, rate, first)
        return head + frame[HEAD.size :]


class Viewers:
    """All of them. `show` is called once a period."""

    def __init__(self) -> None:
        self._all: set[Viewer] = set()
        self._row = 0
        self._reader: LiveReader | None = None
        self._said = ""
        self._quiet = 0

    def __len__(self) -> int:
        return len(self._all)

    def add(self) -> Viewer:
        """A new one, who is told the state at once."""
        viewer = Viewer()
        self._all.add(viewer)
        if self._said:
            viewer.give(self._said)
        return viewer

    def remove(self, viewer: Viewer) -> None:
        """They are gone."""
        self._all.discard(viewer)

    def show(self, reader: LiveReader | None, state: dict[str, Any] | None) -> None:
        """Send what is new in the ring, and the state if there is one to send."""
        if reader is not self._reader:
            self._reader, self._row = reader, reader.whole if reader else 0
        if state is not None:
            channels = reader.channels if reader else []
            text = json.dumps({"kind": "state", **state, "channels": channels}, allow_nan=False)
            self._quiet += 1
            if text != self._said or self._quiet >= STATE_EVERY:
                self._said, self._quiet = text, 0
                for viewer in self._all:
                    viewer.give(text)
        if reader is None or not self._all:
            # Who comes later begins with what is new then.
            self._row = reader.whole if reader else 0
            return
        new = reader.since(self._row)
        step = step_of(reader.rate_hz)
        rows = len(new.sequence) // step * step
        self._row += new.lost + rows
        if rows:
            values = decimated(new.values[:rows], step)
            data = frame(values, step, reader.rate_hz, int(new.sequence[0]))
            for viewer in self._all:
                viewer.give(data)


def step_of(rate_hz: float) -> int:
    """Samples that a pair of rows stands for, 1 for rows that are samples."""
    return max(1, -(-round(rate_hz) // round(MOST_RATE)))


def decimated(values: Float, step: int) -> Float:
    """(n, columns) to (2 n/step, columns): smallest and largest of each step; as it is for 1."""
    if step == 1:
        return values
    bins = values.reshape(-1, step, values.shape[1])
    # A value that is missing says nothing; a step of nothing else stays missing.
    low = np.fmin.reduce(bins, axis=1)
    high = np.fmax.reduce(bins, axis=1)
    return np.stack([low, high], axis=1).reshape(-1, values.shape[1])


def frame(values: Float, step: int, rate_hz: float, first: int) -> bytes:
    """The bytes of one frame; the lost ones are filled in for each viewer."""
    rows, columns = values.shape
    rate = rate_hz if step == 1 else 2.0 * rate_hz / step
    head = HEAD.pack(SAMPLES, 0, columns, rows, step, 0, rate, first)
    return head + values.astype("<f4").tobytes()
