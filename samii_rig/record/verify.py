"""Say what is in a recording, down to the last bit: whole, lossy or nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from isal.isal_zlib import crc32

from samii_rig.errors import RecordingError
from samii_rig.files import require_file
from samii_rig.record import layout, scan
from samii_rig.record.contents import (
    Contents,
    ExpandedError,
    ForeignError,
    Tail,
    Unpacker,
    read_contents,
    read_tail,
)
from samii_rig.record.reader import check_format, sample_channel, sample_records
from samii_rig.types import Int, StopRecord

Status = Literal["whole", "lossy", "nothing", "foreign"]
EXIT_CODES: dict[Status, int] = {"whole": 0, "lossy": 3, "nothing": 1, "foreign": 2}
_STEP = 16 << 20  # bytes of a CRC at a time: touches little of a file larger than the memory


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is in a file.

    status : `whole` if every byte is as it was written and the run was ended; `lossy` if not
        but samples or results can be had from it; `nothing` if none can; `foreign` for a file
        that is no MCAP file at all.
    samples : how many can be read from whole chunks. gaps : jumps of the sequence between them,
        missing : samples that the device took and that are not there.
    backwards : how often the time stamps step back.
    problems : one line each, with the offset of the byte where it applies.
    """

    path: str
    status: Status
    bytes: int
    samples: int = 0
    gaps: int = 0
    missing: int = 0
    backwards: int = 0
    chunks: int = 0
    responses: int = 0
    events: int = 0
    segments: int = 0
    channels: tuple[str, ...] = ()
    stop: StopRecord | None = None
    problems: tuple[str, ...] = ()

    @property
    def exit_code(self) -> int:
        """0 whole, 3 lossy, 1 nothing, 2 no MCAP file."""
        return EXIT_CODES[self.status]


def verify(path: Path) -> Verdict:
    """Check every byte of a file; never raises for what is in it, only if there is no file.

    A file whose chunks unpack to more than a run can hold is checked up to there: what it costs
    is bounded by its size.
    """
    require_file(path)
    size = path.stat().st_size
    try:
        return _verify(path, scan.mapped(path))
    except ForeignError as error:
        return Verdict(str(path), "foreign", size, problems=(str(error),))
    except RecordingError as error:
        return Verdict(str(path), "nothing", size, problems=(str(error),))


def _verify(path: Path, data: memoryview) -> Verdict:
    problems: list[str] = []
    tail: Tail | None = None
    try:
        tail = read_tail(data)
    except RecordingError as error:
        problems.append(str(error))
    contents = read_contents(data, tail.summary_start if tail else len(data), strict=False)
    problems += [str(damage) for damage in contents.damage]
    problems += _data_problems(data, contents, tail)
    stop, written = None, None
    segments = 0
    try:
        if contents.one_map(layout.RUN) is None:
            problems.append("it is not a recording of samii-rig, or its first metadata are lost")
        else:
            check_format(contents)
        contents.notes()
        contents.clock_offset()
        contents.maps(layout.RESPONSE)
        for item in contents.maps(layout.SEGMENT):
            layout.segment_from_map(item)
            segments += 1
        found = contents.one_map(layout.STOP)
        if found is None:
            problems.append("there is no stop record: the run was cut off")
        else:
            stop, written = layout.stop_from_map(found)
    except RecordingError as error:
        problems.append(str(error))
    counts, names = _count(data, contents, problems)
    if written is not None and written != counts.samples:
        problems.append(f"{counts.samples} of the {written} samples of the run are there")
    kept = counts.samples or counts.responses
    status: Status = "lossy" if kept else "nothing"
    if not problems:
        status = "whole"
    return Verdict(
        path=str(path),
        status=status,
        bytes=len(data),
        samples=counts.samples,
        gaps=counts.gaps,
        missing=counts.missing,
        backwards=counts.backwards,
        chunks=len(contents.chunks),
        responses=counts.responses,
        events=counts.events,
        segments=segments,
        channels=names,
        stop=stop,
        problems=tuple(problems),
    )


def data_whole(data: memoryview, contents: Contents) -> bool:
    """Whether the data of a finished file are as they were written, by the CRC over all of them."""
    crc = 0
    for at in range(0, contents.data_end, _STEP):
        crc = crc32(data[at : min(at + _STEP, contents.data_end)], crc)
    return crc == contents.data_crc


def _data_problems(data: memoryview, contents: Contents, tail: Tail | None) -> list[str]:
    if contents.data_crc is None:
        return ["the data end without their CRC: the file was not finished"]
    problems = []
    if not data_whole(data, contents):
        problems.append("the CRC over all data does not fit")
    if tail and contents.end != tail.summary_start:
        problems.append(f"byte {contents.end}: the summary does not follow the data")
    return problems


@dataclass(slots=True)
class _Counts:
    samples: int = 0
    gaps: int = 0
    missing: int = 0
    backwards: int = 0
    responses: int = 0
    events: int = 0
    last: tuple[int, int] | None = None  # sequence and time of the last sample

    def add(self, sequence: Int, time: Int) -> None:
        """Count the samples of one chunk."""
        if self.last is not None:
            sequence = np.concatenate(([self.last[0]], sequence))
            time = np.concatenate(([self.last[1]], time))
        else:
            self.samples += 1
        steps = np.diff(sequence)
        if (steps <= 0).any():
            raise RecordingError("samples are not in the order of their sequence")
        self.samples += len(steps)
        self.gaps += int(np.count_nonzero(steps > 1))
        self.missing += int((steps - 1).sum())
        self.backwards += int(np.count_nonzero(np.diff(time) < 0))
        self.last = (int(sequence[-1]), int(time[-1]))


def _count(
    data: memoryview, contents: Contents, problems: list[str]
) -> tuple[_Counts, tuple[str, ...]]:
    """Unpack every chunk once, one at a time; what does not fit is added to `problems`."""
    counts = _Counts()
    names: tuple[str, ...] = ()
    sample_id, dtype = None, None
    ids = {}
    try:
        ids = {t: contents.channel_id(t) for t in (layout.EVENTS, layout.RESPONSES)}
        if contents.channel_id(layout.SAMPLES) is not None:
            sample_id, sample_layout = sample_channel(contents)
            dtype = sample_layout.record
            names = tuple(c.name for c in sample_layout.channels)
    except RecordingError as error:
        problems.append(str(error))
    unpack = Unpacker(data, dtype.itemsize if dtype is not None else 0)
    for chunk in contents.chunks:
        try:
            raw = unpack(chunk.head)
            if sample_id is None or dtype is None:
                records = None
            else:
                records = sample_records(raw, sample_id, dtype)
            if records is not None:
                counts.add(records["sequence"].astype(np.int64), records["log_time"].view(np.int64))
                if chunk.counts != {sample_id: len(records)}:
                    problems.append(f"byte {chunk.head.span.end}: the index does not fit its chunk")
                continue
        except ExpandedError as error:
            problems.append(str(error))
            break
        except RecordingError as error:
            problems.append(str(error))
            continue
        counts.events += chunk.counts.get(ids.get(layout.EVENTS) or 0, 0)
        counts.responses += chunk.counts.get(ids.get(layout.RESPONSES) or 0, 0)
    return counts, names
