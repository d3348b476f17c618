"""What the index keeps of one recording, read from the heads of its records, not its samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from hashlib import blake2b
from pathlib import Path

from samii_rig.errors import InputError, RecordingError
from samii_rig.index.remarks import Remarks, read_remarks
from samii_rig.record import layout, scan
from samii_rig.record.contents import Contents, attachment, read_contents, read_tail
from samii_rig.record.reader import check_format, sample_channel
from samii_rig.record.verify import data_whole
from samii_rig.record.writer import PARTIAL
from samii_rig.rig.load import tables

SUFFIX = ".mcap"
ID_BYTES = 8  # 10,000 recordings share one by chance once in 10^11 folders


@dataclass(frozen=True, slots=True)
class Entry:
    """One recording in a list of them.

    id : of its place in the folder; the same as long as it lies there under this name.
    path : below the folder, with `/`.
    started : UTC, ISO 8601; where the recording does not say, the time of the file.
    status : of its stop record; `unfinished` for a file that is being written or was cut off,
        `damaged` for one whose bytes are not as they were written, `unreadable` for one that is
        none of ours, or too damaged to tell. problem : why.
    verdict, tags, notes : from its remarks; notes are joined line by line.
    """

    id: str
    path: str
    started: str = ""
    rig: str = ""
    experiment: str = ""
    operator: str = ""
    status: str = ""
    reason: str = ""
    verdict: str = ""
    tags: tuple[str, ...] = ()
    notes: str = ""
    duration_s: float = 0.0
    rate_hz: float = 0.0
    samples: int = 0
    responses: int = 0
    channels: tuple[str, ...] = ()
    bytes: int = 0
    problem: str = ""


def identity(path: str) -> str:
    """The id of a recording by its place below the folder."""
    return blake2b(path.encode(), digest_size=ID_BYTES).hexdigest()


def is_recording(name: str) -> bool:
    """Whether a file of this name belongs into the index."""
    if not name.endswith((SUFFIX, SUFFIX + PARTIAL)) or name.startswith("."):
        return False
    return name.isprintable()  # neither bytes that are no text, nor what would break a line


def read_entry(folder: Path, path: str) -> Entry:
    """What the index keeps of the recording at `path` below `folder`.

    Never raises for what is in the file or its remarks: that is a problem of the entry. OSError
    if the file went away.
    """
    file = folder / path
    stat = file.stat()
    made = datetime.fromtimestamp(stat.st_mtime, UTC).isoformat(timespec="seconds")
    entry = Entry(identity(path), path, started=made, bytes=stat.st_size)
    try:
        entry = _read(file, entry)
    except scan.DamagedError as error:
        remedy = "samii-rig recover gives back what is whole"
        entry = replace(entry, status="damaged", problem=f"{_without(file, error)}; {remedy}")
    except RecordingError as error:
        entry = replace(entry, status="unreadable", problem=_without(file, error))
    try:
        remarks = read_remarks(file)
    except RecordingError as error:
        remarks = Remarks()
        problem = "; ".join(p for p in (entry.problem, _without(file, error)) if p)
        entry = replace(entry, problem=problem)
    return replace(
        entry,
        verdict=remarks.verdict,
        tags=remarks.tags,
        notes="\n".join(f"{n.author}: {n.text}" if n.author else n.text for n in remarks.notes),
    )


def _read(file: Path, entry: Entry) -> Entry:
    data = scan.mapped(file)
    unfinished = file.name.endswith(PARTIAL)
    if unfinished:
        contents = read_contents(data, len(data), strict=False)
    else:
        tail = read_tail(data)
        contents = read_contents(data, tail.summary_start, strict=True)
    run = check_format(contents)
    notes = contents.notes()
    stop = contents.one_map(layout.STOP)
    channels: tuple[str, ...] = ()
    if contents.channel_id(layout.SAMPLES) is not None:
        channels = tuple(c.name for c in sample_channel(contents)[1].channels)
    rate = _number(run.get("rate_hz", ""))
    status, reason, samples = "unknown", "the recording holds no stop record", 0
    if stop is not None:
        record, samples = layout.stop_from_map(stop)
        status, reason = record.status, record.reason
    problem = ""
    if unfinished:
        status, reason = "unfinished", ""
        problem = "not closed: it is being written, or was cut off; samii-rig recover closes it"
        samples = _counted(contents)
    elif not data_whole(data, contents):
        status, problem = "damaged", "some of its bytes changed; samii-rig verify says which"
    return replace(
        entry,
        started=_time(notes.get("started", "")) or _stamp(contents) or entry.started,
        rig=_named(data, contents, layout.RIG_FILE),
        experiment=notes.get("experiment") or _named(data, contents, layout.EXPERIMENT_FILE),
        operator=notes.get("operator", ""),
        status=status,
        reason=reason,
        duration_s=samples / rate if rate > 0 else 0.0,
        rate_hz=rate,
        samples=samples,
        responses=len(contents.maps(layout.RESPONSE)),
        channels=channels,
        problem=problem,
    )


def _counted(contents: Contents) -> int:
    number = contents.channel_id(layout.SAMPLES)
    return 0 if number is None else sum(c.counts.get(number, 0) for c in contents.chunks)


def _named(data: memoryview, contents: Contents, name: str) -> str:
    """The name that an attached file gives itself; "" where it has none."""
    try:
        found = tables((attachment(data, contents, name) or b"").decode(), name)
    except (UnicodeDecodeError, InputError):
        return ""
    named = found.get("name", "")
    return named if isinstance(named, str) else ""


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        return 0.0
    return value if 0.0 < value < float("inf") else 0.0


def _time(text: str) -> str:
    """A time in UTC as ISO 8601, so that times sort as text; "" if it is none."""
    try:
        found = datetime.fromisoformat(text)
        return found.astimezone(UTC).isoformat(timespec="seconds")
    except (ValueError, OverflowError):
        return ""


def _stamp(contents: Contents) -> str:
    """The stamp of the first sample or event, "" where stamps are not the wall clock's."""
    if not contents.clock_offset() or not contents.chunks:
        return ""
    seconds = contents.chunks[0].head.start_time * 1e-9
    try:
        return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")
    except (ValueError, OverflowError, OSError):
        return ""


def _without(file: Path, error: Exception) -> str:
    """The error's line without the folder, which the entry's path stands for."""
    return str(error).replace(f"{file.parent}/", "")
