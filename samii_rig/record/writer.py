"""Write a run: one MCAP file, on the disk within a second, named `.partial` until whole."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np

from samii_rig.errors import DiskError, RecordingError
from samii_rig.files import DISK_ERRORS
from samii_rig.record import events, layout, response
from samii_rig.record.appender import (
    Appender,
    ChunkPieces,
    Compression,
    build_chunk,
    message_chunk,
)
from samii_rig.record.disk import ANSWERS_WITHIN, Action, DiskThread
from samii_rig.types import Channel, FrequencyResponse, Int, SampleBlock, Segment, StopRecord

CHUNK_BYTES = 1 << 20  # of message records: what viewers expect, and fits a core's cache
PARTIAL = ".partial"
COMPRESSORS = 2  # threads; the third, on the disk's side, takes about half a core

_Bytes = np.ndarray[Any, Any]
Times = TypeVar("Times", int, Int)  # ns


@dataclass(frozen=True, slots=True)
class Origin:
    """What a run was made from, and what repeats it.

    rig_toml, experiment_toml : the files' text, kept as attachments; "" for none.
    metadata : seed, versions, operator, calibration, limits, start, by name.
    """

    rig_toml: str = ""
    experiment_toml: str = ""
    metadata: Mapping[str, str] = field(default_factory=dict)


UNKNOWN = Origin()


class RunWriter:
    """Records a run.

    Samples, events and results go to `path` + ".partial", synced at least once a second by a
    thread of its own whether or not samples come; `close` gives the file its name. Left by an
    exception, or without `close`, the `.partial` stays, whole up to its last chunk, for
    `recover`, if `keep_partial`. Calls may come from several threads.

    Parameters
    ----------
    path : the final name; neither it nor its `.partial` may exist.
    channels : the columns of every block; empty for a file of results only.
    rate_hz : nominal samples/s of the device.
    origin : what the run was made from.
    compression : "lz4", "zstd" (smaller, slower) or "" for none.
    clock_offset : ns by which the wall clock, which stamps the messages, is ahead of the
        device's; 0 where nothing is known of it. By default the first call of `clocks` says it,
        or else the moment of the first sample or event.
    keep_partial : False for what can be written again, as a copy; it leaves no `.partial`.

    Raises RecordingError when the file cannot be made, DiskError when the disk refuses it; later
    calls raise DiskError too once the disk refused something, or the file was moved or removed
    by somebody, so that a full disk ends the run.

    >>> with RunWriter(Path("run.mcap"), channels, 500.0, Origin(text)) as writer:
    ...     writer.write(block)
    ...     writer.close(StopRecord("completed", "all segments done"))
    """

    def __init__(
        self,
        path: Path,
        channels: tuple[Channel, ...],
        rate_hz: float,
        origin: Origin = UNKNOWN,
        *,
        compression: Compression = "lz4",
        clock_offset: int | None = None,
        keep_partial: bool = True,
    ) -> None:
        self.path = path
        self._keep_partial = keep_partial
        self.partial_path = path.with_name(path.name + PARTIAL)
        self.channels = channels
        self._compression = compression
        self._samples = 0
        self._responses = 0
        self._last_sequence = -1 << 63
        self._last_time = 0
        self._offset: int | None = None
        self._open = True
        self._lock = threading.RLock()
        layout.checked_offset(clock_offset or 0)
        if path.exists():
            raise RecordingError(f"{path} exists already; expected a new name")
        try:
            self._file = self.partial_path.open("xb")
        except FileExistsError as error:
            raise RecordingError(
                f"{self.partial_path} is left from a run that was cut off; recover or move it first"
            ) from error
        except OSError as error:
            raise _refused(path, error) from error
        try:
            appender = Appender(self._file, layout.PROFILE)
            self._describe(appender, rate_hz, origin.metadata)
            for name, text in (
                (layout.RIG_FILE, origin.rig_toml),
                (layout.EXPERIMENT_FILE, origin.experiment_toml),
            ):
                if text:
                    data = text.encode()
                    appender.add_attachment(name, "application/toml", data, time.time_ns())
            self._register(appender, rate_hz)
            appender.sync()
            _sync_directory(path.parent)
        except BaseException as error:
            # There is no sample in it yet.
            self._close_file()
            self._discard()
            if isinstance(error, OSError):
                raise _refused(path, error) from error
            raise
        self._pool = _started_pool()
        self._disk = DiskThread(appender, self._gathered, self.partial_path)
        if clock_offset is not None:
            self.clocks(0, clock_offset)

    @staticmethod
    def _describe(appender: Appender, rate_hz: float, metadata: Mapping[str, str]) -> None:
        run = {"format": layout.FORMAT, "rate_hz": repr(float(rate_hz))}
        appender.add_metadata(layout.RUN, layout.sealed(run))
        appender.add_metadata(layout.NOTES, layout.sealed(dict(metadata)))

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
            stamps = self._stamped(block.time, int(block.time[-1]))
            done = 0
            while done < n:
                take = min(n - done, self._rows - self._fill)
                part = slice(done, done + take)
                records = self._buffer[self._fill : self._fill + take]
                records["log_time"] = stamps[part]
                records["publish_time"] = stamps[part]
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

    def clocks(self, device: int, wall: int) -> None:
        """The device's clock and the wall clock showed these times (ns) at one moment.

        The first pair lays down the stamps of the whole file: what lies between two of them is
        the device's time, whatever is done to the wall clock meanwhile. Later pairs do nothing.
        RecordingError where the two are further apart than stamps can say.
        """
        with self._lock:
            if self._offset is None:
                self._check()
                offset = layout.checked_offset(wall - device)
                data = layout.sealed(layout.clock_to_map(offset))
                self._put(lambda appender: appender.add_metadata(layout.CLOCK, data))
                self._offset = offset

    def event(self, time_ns: int, name: str, payload: dict[str, Any] | None = None) -> None:
        """Log an event (a gate transition, an operator's note) at a time of the device."""
        stamp = self._stamped(time_ns, time_ns)
        data = events.encode(events.Event(stamp, name, payload or {}))
        self._put_message(self._events_id, stamp, data)

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
        stamp = self._stamped(self._last_time, self._last_time)
        self._put_message(self._responses_id, stamp, data)
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
            raise _refused(self.path, error) from error

    def abort(self) -> None:
        """Stop recording; what was given so far is synced and stays as `.partial`, if it is to."""
        if self._open:
            with contextlib.suppress(RecordingError):
                self.flush()
            self._end()
        if not self._keep_partial:
            self._discard()

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

    def _stamped(self, device: Times, now: int) -> Times:
        """The device's times as stamps; `now`, by its clock, is paired with this moment if
        nobody said anything of the clocks before."""
        if self._offset is None:
            self.clocks(now, time.time_ns())
        assert self._offset is not None
        first, last = int(np.min(device)) + self._offset, int(np.max(device)) + self._offset
        if first < 0 or last >= 1 << 63:
            shown = first if first < 0 else last
            raise RecordingError(f"a stamp would be {shown} ns since 1970; expected 0 to 2^63")
        return device + self._offset

    def _cut(self) -> None:
        """Hand the gathered samples to the compressors and take a new buffer; lock held."""
        if self._fill:
            future = self._pool.submit(self._compress, *self._take())
            self._disk.put(lambda appender: appender.add_chunk(future.result(ANSWERS_WITHIN)))

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
        ended = self._disk.stop()
        # Nobody waits for them: of two of whom one was ended from outside, the other never ends.
        self._pool.shutdown(wait=False, cancel_futures=not ended)
        if ended:  # else closing would wait for the thread that hangs in the file
            self._close_file()

    def _close_file(self) -> None:
        # Closing writes what is left, which a full disk refuses again: what matters was synced, or
        # is reported already.
        with contextlib.suppress(OSError):
            self._file.close()

    def _discard(self) -> None:
        with contextlib.suppress(OSError):
            self.partial_path.unlink()


def _started_pool() -> ThreadPoolExecutor:
    """The compressors, all running: when the memory runs out no thread can be started any more."""
    pool = ThreadPoolExecutor(COMPRESSORS, thread_name_prefix="compress")
    together = threading.Barrier(COMPRESSORS + 1)
    for _ in range(COMPRESSORS):
        pool.submit(together.wait)
    together.wait()
    return pool


def _refused(path: Path, error: OSError) -> RecordingError:
    kind = DiskError if error.errno in DISK_ERRORS else RecordingError
    return kind(f"{path} cannot be written: {error.strerror}")


def _sync_directory(folder: Path) -> None:
    """Make the names in a folder survive a power cut, where the system can."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
