"""Live samples and progress from the process that runs to those that show it.

A file in memory, mapped by both sides: one ring of samples, one place for the progress, one for
the service's sign of life. The runner only ever writes to memory, so that nobody who looks, and
nobody who dies, can make it wait. A reader that is slow finds the oldest rows overwritten, and
how many.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import struct
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.errors import RecordingError
from samii_rig.types import Channel, Float, Int, SampleBlock

MAGIC = b"SAMIILV1"
SECONDS = 8.0  # of samples in the ring: what a viewer sees who comes late
LEAST_ROWS = 1024
LARGEST_COUNT = 2**62  # of a count, so that what is reckoned with it fits numpy's integers
PAGE = 16384  # bytes for the description and for the progress, each
# Header: magic, channels, rows, rate; then counts of rows that are whole and that are begun, the
# service's sign of life in ns of the system's monotonic clock, and whether it knows enough.
_HEAD = struct.Struct("<8sIId")
_WHOLE, _BEGUN, _BEAT, _ENOUGH = 64, 72, 80, 88
_DESCRIPTION, _PROGRESS, _RING = PAGE, 2 * PAGE, 3 * PAGE
_COUNT = struct.Struct("<Q")
_TEXT = struct.Struct("<QI")  # version (odd while it is written), length


def live_folder() -> Path:
    """A folder in memory that is ours alone."""
    base = Path("/dev/shm") if os.access("/dev/shm", os.W_OK) else Path(tempfile.gettempdir())
    folder = base / f"samii-rig-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise RecordingError(f"{folder} belongs to another user; expected our own")
    return folder


class _Map:
    def __init__(self, data: mmap.mmap) -> None:
        self._data = data
        magic, self.columns, self.rows, self.rate_hz = _HEAD.unpack_from(data, 0)
        right = magic == MAGIC and self.rows > 0 and 0.0 < self.rate_hz < math.inf
        if not right or len(data) < _size(self.columns, self.rows):
            raise RecordingError("the live data are not what this version writes")
        self.sequence: Int = np.frombuffer(data, np.int64, self.rows, _RING)
        begin = _RING + 8 * self.rows
        self.values: Float = np.frombuffer(
            data, np.float64, self.rows * self.columns, begin
        ).reshape(self.rows, self.columns)

    def count(self, at: int) -> int:
        """One of the header's counts; more than any run has is what was damaged."""
        return min(int(_COUNT.unpack_from(self._data, at)[0]), LARGEST_COUNT)

    def put_count(self, at: int, value: int) -> None:
        """Write one of them, in one store."""
        _COUNT.pack_into(self._data, at, value)

    def text(self, at: int) -> str | None:
        """A text that is whole; None if it is being written all the time."""
        for _ in range(100):
            version, length = _TEXT.unpack_from(self._data, at)
            raw = bytes(self._data[at + _TEXT.size : at + _TEXT.size + length])
            if version % 2 == 0 and _TEXT.unpack_from(self._data, at)[0] == version:
                return raw.decode("utf-8", "replace")
        return None

    def put_text(self, at: int, text: str) -> None:
        """Write a text; one that does not fit is left as it was."""
        raw = text.encode()
        if len(raw) > PAGE - _TEXT.size:
            return
        version, _ = _TEXT.unpack_from(self._data, at)
        _TEXT.pack_into(self._data, at, version + 1, 0)
        self._data[at + _TEXT.size : at + _TEXT.size + len(raw)] = raw
        _TEXT.pack_into(self._data, at, version + 2, len(raw))


class LiveWriter:
    """The runner's side. Made once the channels are known; `close` takes the name away."""

    def __init__(self, path: Path, channels: tuple[Channel, ...], rate_hz: float) -> None:
        rows = max(LEAST_ROWS, round(SECONDS * rate_hz))
        self.path = path
        with path.open("x+b") as file:
            path.chmod(0o600)
            # Reserved, not only promised: a memory that is full must not kill the run later.
            os.posix_fallocate(file.fileno(), 0, _size(len(channels), rows))
            data = mmap.mmap(file.fileno(), 0)
        _HEAD.pack_into(data, 0, MAGIC, len(channels), rows, rate_hz)
        self._map = _Map(data)
        about = [{"name": c.name, "unit": c.unit, "role": c.role} for c in channels]
        self._map.put_text(_DESCRIPTION, json.dumps(about))
        self._map.put_text(_PROGRESS, "{}")
        self._map.put_count(_BEAT, time.monotonic_ns())

    def samples(self, block: SampleBlock) -> None:
        """Show these samples."""
        m = self._map
        n = min(len(block), m.rows)
        whole = m.count(_WHOLE)
        m.put_count(_BEGUN, whole + n)
        at = (whole + np.arange(n)) % m.rows
        m.sequence[at] = block.sequence[-n:] if n else block.sequence[:0]
        m.values[at] = block.values[-n:] if n else block.values[:0]
        m.put_count(_WHOLE, whole + n)

    def progress(self, data: dict[str, Any]) -> None:
        """Show how far the run is."""
        self._map.put_text(_PROGRESS, json.dumps(data))

    def silence(self) -> float:
        """Seconds since the service's last sign of life."""
        return (time.monotonic_ns() - self._map.count(_BEAT)) * 1e-9

    @property
    def enough(self) -> bool:
        """Whether the service asks for no more: the run may end where it next rests."""
        return self._map.count(_ENOUGH) > 0

    def close(self) -> None:
        """Those who have it open keep it; nobody opens it any more."""
        self.path.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class Rows:
    """Samples from the ring. lost : rows that were overwritten before they were read."""

    sequence: Int
    values: Float
    lost: int


class LiveReader:
    """The service's side; RecordingError if there are no live data at `path`."""

    def __init__(self, path: Path) -> None:
        try:
            with path.open("r+b") as file:
                self._map = _Map(mmap.mmap(file.fileno(), 0))
        except (OSError, ValueError, struct.error) as error:
            raise RecordingError(f"there are no live data at {path}") from error
        self.rate_hz = float(self._map.rate_hz)
        self.channels: list[dict[str, str]] = self._described(path)
        self._progress: dict[str, Any] = {}

    def _described(self, path: Path) -> list[dict[str, str]]:
        """The channels, as they were told when it was made."""
        with suppress(ValueError, TypeError, KeyError, RecursionError):
            found = json.loads(self._map.text(_DESCRIPTION) or "[]")
            told = [{key: str(c[key]) for key in ("name", "unit", "role")} for c in found]
            if len(told) == self._map.columns:
                return told
        raise RecordingError(f"{path} does not tell its channels")

    @property
    def whole(self) -> int:
        """Rows written so far."""
        return self._map.count(_WHOLE)

    def since(self, row: int) -> Rows:
        """The rows from number `row` on, as far as they are still there."""
        m = self._map
        end = self.whole
        first = max(row, end - m.rows, 0)
        at = np.arange(first, end) % m.rows
        sequence, values = m.sequence[at], m.values[at]
        # What was overwritten while it was copied is not shown.
        kept = max(first, min(end, m.count(_BEGUN) - m.rows))
        return Rows(sequence[kept - first :], values[kept - first :], max(0, kept - row))

    def progress(self) -> dict[str, Any]:
        """How far the run is."""
        text = self._map.text(_PROGRESS)
        if text is not None:
            with suppress(ValueError, RecursionError):
                found = json.loads(text)
                self._progress = found if isinstance(found, dict) else self._progress
        return self._progress

    def enough(self) -> None:
        """Ask for no more."""
        self._map.put_count(_ENOUGH, 1)

    def beat(self) -> None:
        """Say that the service is there."""
        self._map.put_count(_BEAT, time.monotonic_ns())


def _size(columns: int, rows: int) -> int:
    return _RING + rows * (8 + 8 * columns)
