"""Give back what is left of a run that was cut off, or of a file that was damaged."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from samii_rig.errors import RecordingError
from samii_rig.files import require_file
from samii_rig.record import events, layout, response, scan
from samii_rig.record.contents import (
    Chunk,
    Contents,
    ExpandedError,
    Unpacker,
    attachment,
    messages,
    read_contents,
    read_tail,
    summary_channels,
)
from samii_rig.record.layout import SampleLayout
from samii_rig.record.reader import sample_channel, sample_records
from samii_rig.record.writer import PARTIAL, Origin, RunWriter
from samii_rig.types import Channel, SampleBlock, Segment, StopRecord

Item = TypeVar("Item")
_BEFORE_ALL = -1 << 63  # a sequence number before every other


@dataclass(frozen=True, slots=True)
class Recovered:
    """What was given back.

    problems : what was found damaged or lost, one line each; `cut` : they are no more than a
        missing end, as a killed process or a full disk leaves it, behind records all whole.
    """

    path: Path
    samples: int
    events: int
    responses: int
    segments: int
    problems: tuple[str, ...]
    cut: bool

    @property
    def exit_code(self) -> int:
        """0 all that the file held, 3 something was damaged or lost, 1 no sample and no result."""
        if not (self.samples or self.responses):
            return 1
        return 3 if self.problems and not self.cut else 0


class NothingError(RecordingError):
    """There is a file, but nothing can be had from it."""

    exit_code = 1


def default_output(path: Path) -> Path:
    """NAME.mcap.partial and NAME.mcap both become NAME.recovered.mcap."""
    name = path.name.removesuffix(PARTIAL).removesuffix(".mcap")
    return path.with_name(f"{name}.recovered.mcap")


def recover(path: Path, output: Path | None = None) -> Recovered:
    """Write every sample, event and result of `path` that is whole into a new file.

    What counts as whole is a chunk whose CRC fits: nothing is guessed. Samples come in the order
    of their sequence, events in that of their time, wherever their chunks stood. The new file
    names its source and the source's SHA-256 in its metadata; the source is left alone.

    NothingError if nothing can be had; RecordingError if there is no file or the new one cannot
    be written.
    """
    require_file(path)
    try:
        data = scan.mapped(path)
        contents = _contents(data)
        problems = [str(damage) for damage in contents.damage]
        channels, rate_hz, sample_id = _samples_of(contents)
    except RecordingError as error:
        raise NothingError(f"{path}: nothing can be recovered: {error}") from error
    row = SampleLayout(channels, rate_hz).record if sample_id is not None else None
    good = _whole(data, contents, sample_id, row, problems)
    said = _metadata(contents, problems)
    notes = {**said.notes, **_source(path, data, problems)}
    if not (good.samples or good.others):
        raise NothingError(f"{path}: nothing can be recovered: no whole chunk is in it")
    files = layout.RIG_FILE, layout.EXPERIMENT_FILE
    rig, experiment = (_text(data, contents, name) for name in files)
    target = output or default_output(path)
    with RunWriter(
        target,
        channels,
        rate_hz,
        Origin(rig, experiment, notes),
        clock_offset=said.offset,
        keep_partial=False,
    ) as writer:
        samples = 0
        if sample_id is not None and row is not None:
            samples = _copy(data, good.samples, sample_id, row, said.offset, writer, problems)
        happened = _decoded(data, contents, good.others, layout.EVENTS, events.decode)
        happened.sort(key=lambda event: event.time)
        for event in happened:
            writer.event(event.time - said.offset, event.name, event.payload)
        for segment in said.segments:
            writer.segment(segment)
        results = _decoded(data, contents, good.others, layout.RESPONSES, response.decode)
        for result in results:
            writer.frequency_response(result)
        lost = max(0, said.stops[0][1] - samples) if said.stops else 0
        if lost:
            problems.append(f"{lost} samples of the run are lost")
        writer.close(_stop(said.stops, lost))
    return Recovered(
        path=target,
        samples=samples,
        events=len(happened),
        responses=len(results),
        segments=len(said.segments),
        problems=tuple(problems),
        cut=len(problems) == 1 and _cut(data, contents),
    )


def _cut(data: memoryview, contents: Contents) -> bool:
    """The file ends in the middle of a record, and all records before it are whole."""
    end = contents.damage[-1] if contents.damage else None
    return (
        isinstance(end, scan.CutError)
        and end.offset == contents.end
        and not scan.has_magic(data, len(data) - scan.MAGIC_SIZE)
    )


def _contents(data: memoryview) -> Contents:
    """The contents, with the summary's copies of schemas and channels where it is whole."""
    try:
        tail = read_tail(data)
    except RecordingError:
        return read_contents(data, len(data), strict=False)
    contents = read_contents(data, tail.summary_start, strict=False)
    schemas, channels = summary_channels(data, tail)
    contents.schemas.update(schemas)
    contents.channels.update(channels)
    return contents


def _samples_of(contents: Contents) -> tuple[tuple[Channel, ...], float, int | None]:
    """Channels, rate and id of `/samples`; of a file of results only, none of them."""
    if contents.channel_id(layout.SAMPLES) is None:
        if contents.channel_id(layout.RESPONSES) is None:
            raise RecordingError(f"neither {layout.SAMPLES} nor {layout.RESPONSES} is in it")
        return (), 1.0, None
    sample_id, sample_layout = sample_channel(contents)
    return sample_layout.channels, sample_layout.rate_hz, sample_id


@dataclass(frozen=True, slots=True)
class _Metadata:
    """What the metadata records say: notes by name, segments, stop records each with the samples
    that the run had, ns by which the wall clock was ahead."""

    notes: dict[str, str]
    segments: list[Segment]
    stops: list[tuple[StopRecord, int]]
    offset: int


def _source(path: Path, data: memoryview, problems: list[str]) -> dict[str, str]:
    """What the new file says of the one that it comes from."""
    notes = {
        "recovered_from": path.name,
        "recovered_from_sha256": hashlib.sha256(data).hexdigest(),
    }
    if problems:
        notes["recovered_problems"] = "; ".join(problems[:20])
    return notes


def _metadata(contents: Contents, problems: list[str]) -> _Metadata:
    notes = {k: v for m in _maps(contents, layout.NOTES, problems) for k, v in m.items()}
    segments = [layout.segment_from_map(item) for item in _maps(contents, layout.SEGMENT, problems)]
    stops = [layout.stop_from_map(item) for item in _maps(contents, layout.STOP, problems)]
    clocks = [layout.clock_from_map(item) for item in _maps(contents, layout.CLOCK, problems)]
    return _Metadata(notes, segments, stops, clocks[0] if clocks else 0)


@dataclass(frozen=True, slots=True)
class _Good:
    """The whole chunks: those of samples, by their first sequence number, and the others."""

    samples: list[Chunk]
    others: list[Chunk]


def _whole(
    data: memoryview,
    contents: Contents,
    sample_id: int | None,
    row: np.dtype[np.void] | None,
    problems: list[str],
) -> _Good:
    """Unpack every chunk once; what does not fit is added to `problems`.

    What is in a chunk is read from the chunk itself: its index has no checksum.
    """
    unpack = Unpacker(data, row.itemsize if row is not None else 0)
    samples: list[tuple[int, Chunk]] = []
    others = []
    for chunk in contents.chunks:
        try:
            raw = unpack(chunk.head)
            records = sample_records(raw, sample_id, row) if sample_id and row is not None else None
        except ExpandedError as error:
            problems.append(str(error))
            break
        except RecordingError as error:
            problems.append(str(error))
            continue
        if records is None:
            others.append(chunk)
        else:
            samples.append((int(records["sequence"][0]), chunk))
    in_order = sorted(samples, key=lambda found: found[0])
    if in_order != samples:
        problems.append("chunks of samples had changed places; they are back in order")
    return _Good([chunk for _, chunk in in_order], others)


def _copy(
    data: memoryview,
    chunks: list[Chunk],
    sample_id: int,
    row: np.dtype[np.void],
    offset: int,
    writer: RunWriter,
    problems: list[str],
) -> int:
    """Copy the samples of whole chunks, in their order; returns how many."""
    columns = len(writer.channels)
    copied, last = 0, _BEFORE_ALL
    for chunk in chunks:
        records = sample_records(scan.unpack(data, chunk.head), sample_id, row)
        assert records is not None  # it was looked at before
        sequence, stamp = records["sequence"].astype(np.int64), records["log_time"].astype(np.int64)
        time = stamp - offset
        before = np.maximum.accumulate(np.concatenate(([last], sequence[:-1])))
        new = (sequence > before) & (stamp >= 0) & (time >= 0)
        if not new.all():
            what = f"{np.count_nonzero(~new)} samples are there already, or have no time"
            problems.append(f"byte {chunk.head.span.start}: {what}")
        if not new.any():
            continue
        values, quality = records["values"][new], records["quality"][new]
        writer.write(
            SampleBlock(
                channels=writer.channels,
                time=time[new],
                sequence=sequence[new],
                values=np.ascontiguousarray(values).view("<f8").reshape(-1, columns),
                quality=np.ascontiguousarray(quality).view("u1").reshape(-1, columns),
            )
        )
        copied, last = copied + int(np.count_nonzero(new)), int(sequence[new][-1])
    return copied


def _decoded(
    data: memoryview,
    contents: Contents,
    chunks: list[Chunk],
    topic: str,
    decode: Callable[[bytes], Item],
) -> list[Item]:
    """The messages of a topic in the whole chunks."""
    channel_id = contents.channel_id(topic)
    if channel_id is None:
        return []
    found: list[Item] = []
    for chunk in chunks:
        raw = scan.unpack(data, chunk.head)
        found.extend(decode(payload) for _, payload in messages(raw, channel_id))
    return found


def _maps(contents: Contents, name: str, problems: list[str]) -> list[dict[str, str]]:
    """The metadata records of this name whose checksum fits; the others go to `problems`."""
    found = []
    for key, item in contents.metadata:
        if key == name:
            try:
                found.append(layout.unsealed(item, name))
            except RecordingError as error:
                problems.append(str(error))
    return found


def _stop(stops: list[tuple[StopRecord, int]], lost: int) -> StopRecord:
    """The run's own stop record if it has one, with what is lost since in the reason."""
    for stop, _ in stops:
        if lost:
            return replace(stop, reason=f"{stop.reason} (recovered: {lost} samples lost)")
        return stop
    return StopRecord("unknown", "recovered: the recording was cut off before the run's end")


def _text(data: memoryview, contents: Contents, name: str) -> str:
    try:
        return (attachment(data, contents, name) or b"").decode()
    except (RecordingError, UnicodeDecodeError):
        return ""
