"""A universal file: opened at once whatever its size, its sets read when they are asked for."""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NoReturn

import numpy as np

from samii_rig.errors import InputError
from samii_rig.files import open_file, reason
from samii_rig.record.text import decoded
from samii_rig.record.uff import function
from samii_rig.record.uff.card import card
from samii_rig.record.uff.sets import READERS, WRITERS, Fields

FUNCTION = 58
_LINE = b"    -1"  # before and after each set
# A line of -1, from the end of the line before it on: a pattern that begins with plain bytes is
# looked for at a gigabyte a second, one that looks behind itself at a thirtieth of that.
_TAG = re.compile(rb"\n    -1 *\r?(?:\n|\Z)")
_FIRST = re.compile(rb"    -1 *\r?(?:\n|\Z)")  # a file may begin with it
_CLOSING = re.compile(rb"[\r\n]*    -1 *\r?(?:\n|\Z)")  # after binary data, wherever they end
_KIND = card("kind:I6")


@dataclass(frozen=True, slots=True)
class DataSet:
    """One data set: its number, and its fields by the names that `sets` and `function` give.

    A set of a number that is not known there has the one field `raw`: its bytes.
    binary : a 58 whose numbers are binary (58b).
    """

    kind: int
    fields: Fields
    binary: bool = False

    def __eq__(self, other: object) -> bool:
        """Equal field by field, arrays by their values."""
        if not isinstance(other, DataSet):
            return NotImplemented
        return (
            (self.kind, self.binary, self.fields.keys())
            == (other.kind, other.binary, other.fields.keys())
        ) and all(_same(value, other.fields[name]) for name, value in self.fields.items())

    __hash__ = None  # type: ignore[assignment]  # arrays have none


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a set stands: its content begins after its number's line, at `start`."""

    kind: int
    start: int
    stop: int
    first: int  # of the number's line
    binary: dict[str, Any] | None = field(default=None)


class UffFile(Sequence[DataSet]):
    """The sets of a universal file, each read from the disk when it is asked for.

    Opening looks for the lines that begin and end the sets, about a gigabyte a second, and skips
    the data of functions (58), whose heads say how long they are; nothing is kept in memory.

    Raises InputError for a file that cannot be read, holds no set, or is cut off; so does
    reading a set that is damaged.

    >>> for data_set in UffFile(Path("modes.unv")):
    ...     print(data_set.kind, data_set.fields.keys())
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with open_file(path) as stream:
                self._data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            raise InputError(str(path), "", reason(error), "a readable file") from error
        except ValueError as error:  # a file of no bytes cannot be mapped
            raise InputError(str(path), "", "empty", "a universal file") from error
        self._places = list(self._scanned())
        if not self._places:
            raise InputError(str(path), "", "without a line of -1", "a universal file")

    def __len__(self) -> int:
        return len(self._places)

    @property
    def kinds(self) -> tuple[int, ...]:
        """The numbers of the sets, in order."""
        return tuple(place.kind for place in self._places)

    def __getitem__(self, index: Any) -> Any:
        """The set at an index, or a list of those of a slice."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place = self._places[index]
        try:
            return self._read(place)
        except (ValueError, IndexError, StopIteration, KeyError) as error:
            said = " ".join(str(error).split()) or "too short"
            number = self._places.index(place) + 1
            raise InputError.saying(
                str(self.path), f"set {number} ({place.kind})", f"{said}; byte {place.first}"
            ) from error

    def head(self, index: int) -> Fields:
        """The fields of a function (58) without its numbers; InputError for another set."""
        place = self._places[index]
        where = f"set {index + 1} ({place.kind})"
        if place.kind != FUNCTION:
            raise InputError(str(self.path), where, place.kind, "58, a function")
        try:
            return function.read_head(self._lines(place, function.LINES)[0])
        except (ValueError, IndexError) as error:
            said = " ".join(str(error).split())
            raise InputError.saying(str(self.path), where, f"{said}; byte {place.first}") from error

    def _read(self, place: _Place) -> DataSet:
        if place.kind == FUNCTION:
            lines, end = self._lines(place, function.LINES)
            body = memoryview(self._data)[end : place.stop]
            fields = function.read_body(function.read_head(lines), body, place.binary)
            return DataSet(place.kind, fields, place.binary is not None)
        if place.kind not in READERS:
            return DataSet(place.kind, {"raw": self._data[place.first : place.stop]})
        lines = [decoded(line) for line in self._data[place.start : place.stop].splitlines()]
        return DataSet(place.kind, READERS[place.kind](lines))

    def _lines(self, place: _Place, count: int) -> tuple[list[str], int]:
        """The first lines of a set, and the offset after them."""
        lines: list[str] = []
        at = place.start
        for _ in range(count):
            end = self._data.find(b"\n", at, place.stop)
            if end < 0:
                raise ValueError(f"{len(lines)} lines; expected a head of {count}")
            lines.append(decoded(self._data[at:end]))
            at = end + 1
        return lines, at

    def _scanned(self) -> Iterator[_Place]:
        """Where the sets are, in order."""
        at = 0
        begins = _FIRST.match(self._data) or _TAG.search(self._data)
        while begins:
            place = self._opened(begins.end())
            if place.binary is not None:
                closing = _CLOSING.match(self._data, place.stop)
            else:
                closing = self._expected(place) or _TAG.search(self._data, place.start - 1)
            if closing is None:
                self._fail(place, "is cut off", "a line of -1 where it ends")
            yield _Place(
                place.kind,
                place.start,
                place.stop if place.binary is not None else closing.start() + 1,
                place.first,
                place.binary,
            )
            at = closing.end()
            begins = _TAG.search(self._data, at - 1)
        if self._data[at:].strip() == b"-":
            self._fail(_Place(0, at, at, at), "is cut off", "its number and content")

    def _expected(self, place: _Place) -> re.Match[bytes] | None:
        """The end of a function in text, if it is where lines of one length would put it."""
        if place.kind != FUNCTION:
            return None
        try:
            lines, at = self._lines(place, function.LINES)
            rows, columns, rest = function.text_extent(function.read_head(lines))
        except (ValueError, IndexError):
            return None
        line = self._data.find(b"\n", at) + 1 - at
        newline = line - columns
        if not 1 <= newline <= 2:
            return None
        return _TAG.match(self._data, at + rows * line + (rest + newline if rest else 0) - 1)

    def _opened(self, first: int) -> _Place:
        """A set by the line with its number; of a binary one where it must end, too."""
        end = self._data.find(b"\n", first)
        line = decoded(self._data[first : end if end >= 0 else len(self._data)])
        place = _Place(0, end + 1, 0, first)
        if end < 0:
            self._fail(place, "is cut off", "its number and content")
        try:
            kind = int(line[:6])
        except ValueError:
            self._fail(place, f"begins with {line[:12]!r}", "the number of a set in six columns")
        if line[6:7].lower() != "b" or kind != FUNCTION:
            return _Place(kind, end + 1, len(self._data), first)
        place = _Place(kind, end + 1, 0, first)
        try:
            binary = function.BINARY.parsed(line[7:])
            count, size = int(binary["lines"] or function.LINES), int(binary["bytes"] or -1)
        except ValueError:
            self._fail(place, f"begins with {line[:40]!r}", "58b and whole numbers")
        at = end + 1
        for _ in range(count):
            at = self._data.find(b"\n", at) + 1
            if at == 0:
                self._fail(place, "is cut off", f"a head of {count} lines")
        if not 0 <= size <= len(self._data) - at:
            left = len(self._data) - at
            self._fail(place, f"is cut off, {left} bytes after its head", f"{size} bytes")
        return _Place(kind, end + 1, at + size, first, dict(binary))

    def _fail(self, place: _Place, what: str, expected: str) -> NoReturn:
        named = f"the set at byte {place.first}" + (f" ({place.kind})" if place.kind else "")
        raise InputError.saying(str(self.path), "", f"{named} {what}; expected {expected}")


def write_uff(path: Path, data_sets: Iterable[DataSet]) -> None:
    """Write sets to `path`, over what is there; from a generator, one at a time in memory.

    Raises
    ------
    InputError : a field that is missing, or does not fit into its columns.
    """
    with path.open("wb") as stream:
        for number, one in enumerate(data_sets, 1):
            try:
                _write(stream, one)
            except (KeyError, ValueError, TypeError) as error:
                said = f"field {error} is missing" if isinstance(error, KeyError) else str(error)
                where = f"set {number} ({one.kind})"
                raise InputError.saying(str(path), where, " ".join(said.split())) from error


def _write(stream: IO[bytes], one: DataSet) -> None:
    stream.write(_LINE + b"\n")
    if "raw" in one.fields:
        stream.write(one.fields["raw"])
    elif one.kind == FUNCTION:
        _write_function(stream, function.completed(one.fields), binary=one.binary)
    elif one.kind in WRITERS:
        _put(stream, [f"{one.kind:6d}"])
        _put(stream, WRITERS[one.kind](one.fields))
    else:
        raise ValueError(f"no set that can be written; expected 58 or one of {sorted(WRITERS)}")
    stream.write(_LINE + b"\n")


def _write_function(stream: IO[bytes], fields: Fields, *, binary: bool) -> None:
    body = function.write_bytes(fields) if binary else b""
    _put(stream, [f"{FUNCTION:6d}" + (function.binary_head(body) if binary else "")])
    _put(stream, function.write_head(fields))
    if binary:
        stream.write(body + b"\n")
    else:
        _put(stream, function.write_text(fields))


def _put(stream: IO[bytes], lines: Iterable[str]) -> None:
    for line in lines:
        # A line break in a text would move all lines behind it.
        plain = " ".join(line.splitlines()) if not line.isprintable() else line
        stream.write(plain.encode("latin-1", "replace") + b"\n")


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return bool(np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True))
    return bool(a == b)
