"""Write a run: one MCAP file, on the disk within a second, named `.partial` until whole."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from samii_rig.errors import RecordingError
from samii_rig.record import events, layout, response
from samii_rig.record.appender import (
    Appender,
    ChunkPieces,
    Compression,
    build_chunk,
    message_chunk,
)
from samii_rig.record.disk import Action, DiskThread
from samii_rig.types import Channel, FrequencyResponse, SampleBlock, Segment, StopRecord

CHUNK_BYTES = 1 << 20  # of message records: what viewers expect, and fits a core's cache
PARTIAL = ".partial"
COMPRESSORS = 2  # threads; the third, on the disk's side, takes about half a core

_Bytes = np.ndarray[Any, Any]


class RunWriter:
    """Records a run.

    Samples, events and results go to `path` + ".partial", synced at least once a second by a
    thread of its own whether or not samples come; `close` gives the file its name. Left by an
    exception, or without `close`, the `.partial` stays, whole up to its last chunk, for
    `recover`. Calls may come from several threads.

    Parameters
    ----------
    path : the final name; neither it nor its `.partial` may exist.
    channels : the columns of every block; empty for a file of results only.
    rate_hz : nominal samples/s of the device.
    rig_toml, experiment_toml : the files' text, kept as attachments.
    metadata : seed, versions, operator, calibration, limits, start: all that repeats the run.
    compression : "lz4", "zstd" (smaller, slower) or "" for none.

    Raises RecordingError when the file cannot be made; later calls raise it too once the
    disk refused something, so that a full disk ends the run.

    >>> with RunWriter(Path("run.mcap"), channels, 500.0, metadata={"seed": "7"}) as writer:
    ...     writer.write(block)
    ...     writer.close(StopRecord("completed", "all segments done"))
    """

    def __init__(
        self,
        path: Path,
        channels: tuple[Channel, ...],
        rate_hz: float,
        *,
        rig_toml: str = "",
        experiment_toml: str = "",
        metadata: dict[str, str] | None = None,
        compression: Compression = "lz4",
    ) -> None:
        self.path = path
        self.partial_path = path.with_name(path.name + PARTIAL)
        self.channels = channels
        self._compression = compression
        self._samples = 0
        self._responses = 0
        self._last_sequence = -1 << 63
        self._last_time = 0
        self._open = True
        self._lock = threading.RLock()
        if path.exists():
            raise RecordingError(f"{path} exists already; expected a new name")
        try:
            self._file = self.partial_path.open("xb")
        except FileExistsError as error:
            raise RecordingError(
                f"{self.partial_path} is left from a run that was cut off; recover or move it first"
            ) from error
        except OSError as error:
            raise RecordingError(f"{path} cannot be written: {error.strerror}") from error
        try:
            appender = Appender(self._file, layout.PROFILE)
            self._describe(appender, rate_hz, metadata or {})
            for name, text in (
                (layout.RIG_FILE, rig_toml),
                (layout.EXPERIMENT_FILE, experiment_toml),
            ):
                if text:
                    data = text.encode()
                    appender.add_attachment(name, "application/toml", data, time.time_ns())
            self._register(appender, rate_hz)
            appender.sync()
            _sync_directory(path.parent)
        except OSError as error:
            self._file.close()
            raise RecordingError(f"{path} cannot be written: {error.strerror}") from error
        except BaseException:
            self._file.close()
            self.partial_path.unlink()
            raise
        self._pool = ThreadPoolExecutor(COMPRESSORS, thread_name_prefix="compress")
        self._disk = DiskThread(appender, self._gathered)

    @staticmethod
    def _describe(appender: Appender, rate_hz: float, metadata: dict[str, str]) -> None:
        run = {"format": layout.FORMAT, "rate_hz": repr(float(rate_hz))}
        appender.add_metadata(layout.RUN, layout.sealed(run))
        appender.add_metadata(layout.NOTES, layout.sealed(metadata))

    def _register(self, appender: Appender, rate_hz: float) -> None:
        def add(topic: str, name: str, text: str, metadata: dict[str, str]) -> int:
            return appender.add_channel(
                topic, name, text, layout.SCHEMA_ENCODING, layout.MESSAGE_ENCODING, metadata
            )

        self._fill = 0
        if self.channels:
            self._layout = layout.SampleLayout(self.channels, float(rate_hz))
            self._id = add(
                layout.SAMPLES,
                layout.SAMPLES_SCHEMA,
                self._layout.schema_text(),
                self._layout.metadata(),
            )
            self._rows = max(1, CHUNK_BYTES // self._layout.record.itemsize)
            self._free: queue.SimpleQueue[_Bytes] = queue.SimpleQueue()
            self._buffer = self._layout.blank(self._rows, self._id)
        qos = layout.QUALITY_OF_SERVICE
        self._events_id = add(layout.EVENTS, events.SCHEMA, events.SCHEMA_TEXT, qos)
        self._responses_id = add(layout.RESPONSES, response.SCHEMA, response.SCHEMA_TEXT, qos)

    def write(self, block: SampleBlock) -> None:
        """Append a block. Gaps in `sequence` and NaN are kept as they are.

        Returns as soon as the samples are copied, unless the disk is far behind.
        RecordingError for other channels, wrong shapes, a sequence that does not rise or a
        time before 0.
        """
        n = len(block)
        if n == 0:
            return
        with self._lock:
            self._check()
            values, quality = self._checked(block)
            done = 0
            while done < n:
                take = min(n - done, self._rows - self._fill)
                part = slice(done, done + take)
                records = self._buffer[self._fill : self._fill + take]
                records["log_time"] = block.time[part]
                records["publish_time"] = block.time[part]
                records["sequence"] = block.sequence[part]
                records["values"] = values[part]
                records["quality"] = quality[part]
                self._fill += take
                done += take
                if self._fill == self._rows:
                    self._cut()
            self._samples += n
            self._last_sequence = int(block.sequence[-1])
            self._last_time = int(block.time[-1])

    def event(self, time_ns: int, name: str, payload: dict[str, Any] | None = None) -> None:
        """Log an event (a gate transition, an operator's note) at a time of the device."""
        data = events.encode(events.Event(time_ns, name, payload or {}))
        self._put_message(self._events_id, time_ns, data)

    def note(self, metadata: dict[str, str]) -> None:
        """Metadata that were not known, or were others, when the file was made."""
        data = layout.sealed(metadata)
        self._put(lambda appender: appender.add_metadata(layout.NOTES, data))

    def segment(self, segment: Segment) -> None:
        """Log that `segment` was done."""
        data = layout.sealed(layout.segment_to_map(segment))
        self._put(lambda appender: appender.add_metadata(layout.SEGMENT, data))

    def frequency_response(self, estimate: FrequencyResponse) -> None:
        """Log a result of the run beside its samples; may be called once a level."""
        data = response.encode(estimate)
        about = layout.sealed({"number": str(self._responses), **response.summary(estimate)})
        self._put_message(self._responses_id, self._last_time, data)
        self._put(lambda appender: appender.add_metadata(layout.RESPONSE, about))
        self._responses += 1

    def flush(self) -> int:
        """Put everything on the disk now; returns how many samples of the run are there.

        After it `read_recording(writer.partial_path, partial=True)` reads the run so far.
        """
        with self._lock:
            self._check()
            self._cut()
            samples = self._samples
        self._disk.barrier()
        return samples

    def close(self, stop: StopRecord) -> None:
        """Write the stop record and the summary, sync, and give the file its final name."""
        self.flush()
        data = layout.sealed(layout.stop_to_map(stop, self._samples))
        self._put(lambda appender: appender.add_metadata(layout.STOP, data))
        self._put(lambda appender: appender.finish())
        self._end()
        self._disk.check()
        if self.path.exists():
            raise RecordingError(
                f"{self.path} appeared meanwhile; the run is kept as {self.partial_path}"
            )
        try:
            self.partial_path.rename(self.path)
            _sync_directory(self.path.parent)
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be written: {error.strerror}") from error

    def abort(self) -> None:
        """Stop recording; what was given so far is synced and stays as `.partial`."""
        if self._open:
            with contextlib.suppress(RecordingError):
                self.flush()
            self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.abort()

    def _check(self) -> None:
        if not self._open:
            raise RecordingError(f"{self.path} is closed already")
        self._disk.check()

    def _checked(self, block: SampleBlock) -> tuple[_Bytes, _Bytes]:
        """Values and quality, each row as one opaque item."""
        n, columns = len(block), len(self.channels)
        if block.channels != self.channels:
            raise RecordingError(
                f"a block of channels {[c.name for c in block.channels]} does not belong to a "
                f"recording of {[c.name for c in self.channels]}"
            )
        if (
            block.sequence.shape != (n,)
            or block.values.shape != (n, columns)
            or block.quality.shape != (n, columns)
        ):
            raise RecordingError(f"a block's arrays do not have {n} rows and {columns} columns")
        rising = block.sequence[0] > self._last_sequence
        if not rising or not np.all(block.sequence[1:] > block.sequence[:-1]):
            raise RecordingError(
                f"the sequence of a block from {block.sequence[0]} to {block.sequence[-1]} does "
                f"not rise, or not above {self._last_sequence}, the last sample before it"
            )
        if block.time.min() < 0:
            raise RecordingError(f"a sample's time is {block.time.min()} ns; expected 0 or later")
        values = np.ascontiguousarray(block.values, "<f8").view(f"V{8 * columns}")[:, 0]
        quality = np.ascontiguousarray(block.quality, "u1").view(f"V{columns}")[:, 0]
        return values, quality

    def _cut(self) -> None:
        """Hand the gathered samples to the compressors and take a new buffer; lock held."""
        if self._fill:
            future = self._pool.submit(self._compress, *self._take())
            self._disk.put(lambda appender: appender.add_chunk(future.result()))

    def _gathered(self) -> Action | None:
        """The samples gathered since the last chunk, for the disk's periodic sync."""
        # A caller in the midst of a block will soon cut by itself; waiting for it here could
        # be waiting for one that waits for us.
        if not self._lock.acquire(blocking=False):
            return None
        try:
            if not self._fill or not self._disk.idle():
                return None
            buffer, rows = self._take()
        finally:
            self._lock.release()
        chunk = self._compress(buffer, rows)
        return lambda appender: appender.add_chunk(chunk)

    def _take(self) -> tuple[_Bytes, int]:
        taken, rows = self._buffer, self._fill
        try:
            self._buffer = self._free.get_nowait()
        except queue.Empty:
            self._buffer = self._layout.blank(self._rows, self._id)
        self._fill = 0
        return taken, rows

    def _compress(self, buffer: _Bytes, rows: int) -> ChunkPieces:
        records = buffer[:rows]
        offset = np.arange(rows, dtype=np.uint64) * np.uint64(records.itemsize)
        raw = records.view(np.uint8).data
        chunk = build_chunk(raw, self._id, records["log_time"], offset, self._compression)
        self._free.put(buffer)
        return chunk

    def _put_message(self, channel_id: int, time_ns: int, data: bytes) -> None:
        chunk = message_chunk(channel_id, [(time_ns, data)], self._compression)
        self._put(lambda appender: appender.add_chunk(chunk))

    def _put(self, action: Action) -> None:
        with self._lock:
            self._check()
            self._disk.put(action)

    def _end(self) -> None:
        with self._lock:
            self._open = False
        self._disk.stop()
        self._pool.shutdown()
        with contextlib.suppress(OSError):  # what matters was synced, or is reported already
            self._file.close()


def _sync_directory(folder: Path) -> None:
    """Make the names in a folder survive a power cut, where the system can."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
