"""Read a recording into numpy, and the results and events that were logged with it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode

from samii_rig.errors import RecordingError
from samii_rig.record import events, layout, response, scan
from samii_rig.record.contents import (
    EXPANSION_CEILING,
    SMALL,
    Chunk,
    Contents,
    attachment,
    decoded,
    read_contents,
    read_tail,
)
from samii_rig.record.events import Event
from samii_rig.record.layout import SampleLayout
from samii_rig.record.scan import DamagedError
from samii_rig.types import Channel, FrequencyResponse, Recording, StopRecord

THREADS = min(4, os.cpu_count() or 1)
_Records = np.ndarray[Any, np.dtype[np.void]]


@dataclass(frozen=True, slots=True)
class SavedResponses:
    """Responses kept without their recordings, with all that the estimate said of them.

    source : the file. rig_toml : the rig file that the recordings carried, "" without one.
    """

    source: str
    responses: tuple[FrequencyResponse, ...]
    rig_toml: str


def read_recording(path: Path, *, partial: bool = False) -> Recording:
    """The samples of a run and all that was recorded beside them.

    Every chunk's CRC is checked, and that as many samples are there as the stop record says;
    `verify` checks the file down to its last byte.

    partial : take a file that is still being written, or was cut off, up to its last whole
        chunk; otherwise such a file is refused.

    RecordingError if the file is damaged, unfinished, or not laid out as `RunWriter` does it.
    """
    with _contents(path, partial=partial) as (data, contents):
        sample_id, sample_layout = sample_channel(contents)
        offset = contents.clock_offset()
        arrays = _read_samples(data, contents, sample_id, sample_layout, offset)
        time, sequence, values, quality = arrays
        stop = contents.one_map(layout.STOP)
        if stop is None:
            stop_record = StopRecord("unknown", "the recording holds no stop record")
        else:
            stop_record, samples = layout.stop_from_map(stop)
            if samples != len(time):
                raise RecordingError(f"it holds {len(time)} of the {samples} samples of the run")
        return Recording(
            channels=sample_layout.channels,
            rate_hz=sample_layout.rate_hz,
            time=time,
            sequence=sequence,
            values=values,
            quality=quality,
            segments=tuple(layout.segment_from_map(m) for m in contents.maps(layout.SEGMENT)),
            rig_toml=_text(data, contents, layout.RIG_FILE),
            experiment_toml=_text(data, contents, layout.EXPERIMENT_FILE),
            metadata=contents.notes(),
            stop=stop_record,
            source=str(path),
            clock_offset=offset,
        )


def read_channels(path: Path) -> tuple[Channel, ...]:
    """The channels of a recording's samples, none of a file without; no sample is read."""
    with _contents(path, partial=False) as (_, contents):
        if contents.channel_id(layout.SAMPLES) is None:
            return ()
        return sample_channel(contents)[1].channels


def read_rig_toml(path: Path) -> str:
    """The rig file that a recording carries, "" without one; its samples are not read."""
    with _contents(path, partial=False) as (data, contents):
        return _text(data, contents, layout.RIG_FILE)


def read_frequency_responses(path: Path, *, partial: bool = False) -> list[FrequencyResponse]:
    """The frequency responses logged in a recording, or in a file derived from some."""
    with _contents(path, partial=partial) as (data, contents):
        return decoded(data, contents, layout.RESPONSES, response.decode)


def read_saved_responses(path: Path) -> SavedResponses | None:
    """The responses of a file that holds nothing else (`frf --save`); None for a recording."""
    with _contents(path, partial=False) as (data, contents):
        if contents.channel_id(layout.SAMPLES) is not None:
            return None
        found = decoded(data, contents, layout.RESPONSES, response.decode)
        rig_toml = _text(data, contents, layout.RIG_FILE)
    return SavedResponses(str(path), tuple(found), rig_toml) if found else None


def read_events(path: Path, *, partial: bool = False) -> list[Event]:
    """The events logged in a recording, in the order in which they were logged."""
    with _contents(path, partial=partial) as (data, contents):
        offset = contents.clock_offset()
        found = decoded(data, contents, layout.EVENTS, events.decode)
        return [replace(event, time=event.time - offset) for event in found]


def read_notes(path: Path, *, partial: bool = False) -> dict[str, str]:
    """The metadata of a recording (seed, versions, operator, hashes of sources, ...)."""
    with _contents(path, partial=partial) as (_, contents):
        return contents.notes()


@contextmanager
def _contents(path: Path, *, partial: bool) -> Iterator[tuple[memoryview, Contents]]:
    """The file's bytes and contents; errors inside name the file."""
    data = scan.mapped(path)
    try:
        if partial:
            contents = read_contents(data, len(data), strict=False)
        else:
            tail = read_tail(data)
            contents = read_contents(data, tail.summary_start, strict=True)
            if contents.data_crc is None or contents.end != tail.summary_start:
                raise DamagedError(contents.end, "the summary does not follow the data")
        check_format(contents)
        yield data, contents
    except DamagedError as error:
        remedy = f"samii-rig recover {path} gives back what is whole"
        raise RecordingError(f"{path}: {error}; {remedy}") from error
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error


def check_format(contents: Contents) -> dict[str, str]:
    """The file's first metadata; RecordingError if it is none that this version reads."""
    run = contents.one_map(layout.RUN)
    written = "" if run is None else run.get("format", "")
    kind, _, version = written.rpartition(" ")
    ours, _, known = layout.FORMAT.rpartition(" ")
    if kind == ours and version.isdecimal() and int(version) > int(known):
        raise RecordingError(
            f"it was written by a newer samii-rig ({written}); expected {layout.FORMAT}, the "
            "newest that this version reads"
        )
    if run is None or written != layout.FORMAT:
        raise RecordingError("it is an MCAP file, but not a recording of samii-rig")
    return run


def sample_channel(contents: Contents) -> tuple[int, SampleLayout]:
    """Id and layout of `/samples`; RecordingError if it is missing or not ours."""
    channel_id = contents.channel_id(layout.SAMPLES)
    if channel_id is None:
        raise RecordingError(f"there is no {layout.SAMPLES} in it")
    channel = contents.channels[channel_id]
    sample_layout = SampleLayout.from_metadata(channel.metadata)
    schema = contents.schemas.get(channel.schema_id)
    if (
        schema is None
        or schema.data != sample_layout.schema_text().encode()
        or schema.encoding != layout.SCHEMA_ENCODING
        or channel.message_encoding != layout.MESSAGE_ENCODING
    ):
        raise RecordingError(f"the schema of {layout.SAMPLES} is not the one that we write")
    return channel_id, sample_layout


def sample_records(
    raw: bytes | memoryview, channel_id: int, dtype: np.dtype[np.void]
) -> _Records | None:
    """An unpacked chunk as an array of sample messages; None if it holds none.

    RecordingError if it holds samples and something else.
    """
    if len(raw) >= dtype.itemsize and len(raw) % dtype.itemsize == 0:
        records = np.frombuffer(raw, dtype)
        ours = (
            (records["opcode"] == Opcode.MESSAGE)
            & (records["length"] == dtype.itemsize - scan.HEAD)
            & (records["channel"] == channel_id)
        )
        if ours.all():
            return records
    view = memoryview(raw)
    for span in scan.spans(view, 0, len(view)):
        number = int.from_bytes(view[span.content : span.content + 2], "little")
        if span.opcode == Opcode.MESSAGE and number == channel_id:
            raise DamagedError(span.start, "a chunk mixes samples with others, not as we write it")
    return None


def _read_samples(
    data: memoryview,
    contents: Contents,
    channel_id: int,
    sample_layout: SampleLayout,
    offset: int,
) -> tuple[np.ndarray[Any, Any], ...]:
    """time, sequence, values, quality of all samples, each chunk unpacked to its place.

    offset : ns by which the log times are ahead of the device's.
    """
    dtype = sample_layout.record
    columns = len(sample_layout.channels)
    places: list[tuple[Chunk, int, int]] = []
    rows = 0
    for chunk in contents.chunks:
        count = chunk.counts.get(channel_id, 0)
        if not chunk.counts:  # cut off before its index: only its bytes tell
            found = sample_records(scan.unpack(data, chunk.head), channel_id, dtype)
            count = 0 if found is None else len(found)
        if count:
            if chunk.head.size != count * dtype.itemsize:
                raise DamagedError(chunk.head.span.start, "a chunk's index does not fit its size")
            places.append((chunk, rows, count))
            rows += count
    size = rows * (16 + 9 * columns)
    if size > max(SMALL, EXPANSION_CEILING * len(data)):
        raise RecordingError(f"{len(data)} bytes claim {size} bytes of samples")
    time, sequence = np.empty(rows, np.int64), np.empty(rows, np.int64)
    values, quality = np.empty((rows, columns)), np.empty((rows, columns), np.uint8)
    value_rows, quality_rows = values.view(f"V{8 * columns}"), quality.view(f"V{columns}")

    def place(item: tuple[Chunk, int, int]) -> None:
        chunk, first, count = item
        records = sample_records(scan.unpack(data, chunk.head), channel_id, dtype)
        if records is None or len(records) != count:
            raise DamagedError(chunk.head.span.start, "a chunk's index does not fit its samples")
        to = slice(first, first + count)
        time[to] = records["log_time"].view(np.int64)
        sequence[to] = records["sequence"]
        value_rows[to, 0] = records["values"]
        quality_rows[to, 0] = records["quality"]

    if len(places) > 1:
        with ThreadPoolExecutor(THREADS) as pool:
            for _ in pool.map(place, places):
                pass
    else:
        for item in places:
            place(item)
    if not np.all(sequence[1:] > sequence[:-1]):
        raise RecordingError("its samples are not in the order of their sequence")
    if rows and time.min() < 0:
        raise RecordingError("a sample's time stamp is beyond 2^63 ns")
    time -= offset
    if rows and time.min() < 0:
        raise RecordingError("a sample's time stamp is before the zero of the device's clock")
    return time, sequence, values, quality


def _text(data: memoryview, contents: Contents, name: str) -> str:
    content = attachment(data, contents, name)
    if content is None:
        return ""
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise RecordingError(f"attachment {name} is not UTF-8") from error
