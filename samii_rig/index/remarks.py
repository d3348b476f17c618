"""What is said of a recording after it was made: tags, notes, and the diagnosis.

They stand in a file of JSON beside it, `run.mcap.remarks.json`. The recording itself is never
touched again once it is closed, so that its checksums hold for ever; see decision 8.
"""

from __future__ import annotations

import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from samii_rig.errors import InputError, RecordingError
from samii_rig.files import SpecialFileError, open_file, reason
from samii_rig.plain import plain

if sys.platform != "win32":
    import fcntl

SUFFIX = ".remarks.json"
FORMAT = "samii-rig remarks 1"
MAX_BYTES = 4 << 20  # a diagnosis is some 10 kB; more is not such a file
MAX_TEXT = 4000  # characters of one note
MAX_NOTES = 1000
MAX_TAGS = 50
TAG = re.compile(r"[\w][\w .+-]{0,39}")


@dataclass(frozen=True, slots=True)
class Note:
    """What a person wrote. time : UTC, ISO 8601."""

    time: str
    author: str
    text: str


@dataclass(frozen=True, slots=True)
class Remarks:
    """All that is said of one recording. diagnosis : as `Diagnosis.plain` gives it."""

    tags: tuple[str, ...] = ()
    notes: tuple[Note, ...] = ()
    diagnosis: dict[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """The diagnosis in a word, "" without one."""
        verdict = self.diagnosis.get("verdict", "")
        return verdict if isinstance(verdict, str) else ""


def remarks_path(recording: Path) -> Path:
    """Where the remarks of a recording stand."""
    return recording.with_name(recording.name + SUFFIX)


def read_remarks(recording: Path) -> Remarks:
    """What is said of a recording, nothing if there is no such file.

    RecordingError if there is one that cannot be read.
    """
    path = remarks_path(recording)
    try:
        with open_file(path) as file:
            raw = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        return Remarks()
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {reason(error)}") from error
    try:
        if len(raw) > MAX_BYTES:
            raise ValueError("too large")
        found = json.loads(raw)
        json.dumps(found, ensure_ascii=False).encode()  # what is no text cannot be searched
        if found["format"] != FORMAT or not isinstance(found["diagnosis"], dict):
            raise ValueError("another format")
        notes = tuple(
            Note(str(n["time"]), str(n["author"]), str(n["text"])) for n in found["notes"]
        )
        return Remarks(tuple(map(str, found["tags"])), notes, found["diagnosis"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise RecordingError(f"{path} is damaged; expected {FORMAT} in JSON") from error


def add_note(recording: Path, author: str, text: str) -> Remarks:
    """Add a note; InputError if it is empty or too long."""
    text = text.strip()
    if not 0 < len(text) <= MAX_TEXT:
        raise InputError("note", "", text, f"1 to {MAX_TEXT} characters")
    note = Note(datetime.now(UTC).isoformat(timespec="seconds"), author, text)

    def change(old: Remarks) -> Remarks:
        if len(old.notes) >= MAX_NOTES:
            raise InputError("note", "", text, f"at most {MAX_NOTES} notes on a recording")
        return replace(old, notes=(*old.notes, note))

    return _change(recording, change)


def set_tags(recording: Path, tags: list[str]) -> Remarks:
    """Give a recording these tags in place of those that it has; InputError names a wrong one."""
    for tag in tags:
        if not TAG.fullmatch(tag):
            expected = "a letter or digit, then letters, digits, space . + - _, up to 40 in all"
            raise InputError("tag", "", tag, expected)
    if len(tags) > MAX_TAGS:
        raise InputError("tags", "", len(tags), f"at most {MAX_TAGS}")
    unique = tuple(sorted(set(tags)))
    return _change(recording, lambda old: replace(old, tags=unique))


def set_diagnosis(recording: Path, diagnosis: dict[str, Any]) -> Remarks:
    """Keep what a diagnosis found (`Diagnosis.plain`) in place of an earlier one."""
    return _change(recording, lambda old: replace(old, diagnosis=diagnosis))


def _change(recording: Path, change: Callable[[Remarks], Remarks]) -> Remarks:
    """Read, change and write back, alone; RecordingError if that does not go."""
    path = remarks_path(recording)
    with _alone(recording):
        new = change(read_remarks(recording))
        data = {"format": FORMAT, **plain(asdict(new))}
        handle, name = -1, ""
        try:
            handle, name = tempfile.mkstemp(dir=path.parent, prefix=".remarks-")
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                json.dump(data, file, indent=1, ensure_ascii=False, allow_nan=False)
                file.flush()
                os.fsync(file.fileno())
            Path(name).chmod(0o644)
            Path(name).replace(path)
        except OSError as error:
            if name:
                Path(name).unlink(missing_ok=True)
            raise RecordingError(f"{path} cannot be written: {error.strerror}") from error
    return new


@contextmanager
def _alone(recording: Path) -> Iterator[None]:
    """Nobody else changes the remarks of this recording meanwhile."""
    try:
        with open_file(recording) as file:
            if sys.platform != "win32":
                fcntl.flock(file, fcntl.LOCK_EX)
            yield
    except FileNotFoundError as error:
        raise RecordingError(f"{recording} is not there; expected a recording") from error
    except SpecialFileError as error:
        raise RecordingError(f"{recording} cannot be read: {reason(error)}") from error
