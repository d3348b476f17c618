"""Delimited text as named columns of numbers; what is wrong is said with its line.

It goes through numpy's own reader (3 to 4 million values/s); only when that refuses is the
file gone through again line by line to say where and why.
"""

from __future__ import annotations

import codecs
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from samii_rig.errors import InputError
from samii_rig.files import open_file, reason
from samii_rig.record.maps import CsvFormat, TextFormat
from samii_rig.record.tables import Table
from samii_rig.record.text import decoded, labelled
from samii_rig.types import Float

DELIMITERS = (",", ";", "\t", "|", "")  # those that programs write; "" is any white space
_SPOKEN = {"\t": "a tab", "": "white space"}
# A text of another encoding than one of bytes shows by these; without a mark, by its zeros.
_MARKS = {
    codecs.BOM_UTF32_LE: "UTF-32",
    codecs.BOM_UTF32_BE: "UTF-32",
    codecs.BOM_UTF16_LE: "UTF-16",
    codecs.BOM_UTF16_BE: "UTF-16",
}
_LOOKED_AT = 4096  # bytes in which text of two bytes a letter shows


@dataclass(frozen=True, slots=True)
class Text:
    """A delimited file whose header has been read: `start` lines come before the data.

    head : the line that the names were taken from, "" where the map gives them.
    """

    path: Path
    format: TextFormat | CsvFormat
    names: tuple[str, ...]
    units: dict[str, str]
    header: tuple[str, ...]
    start: int
    width: int
    head: str = ""

    def open(self) -> io.TextIOBase:
        """The rest of the file. Latin-1 never fails; numbers are ASCII in any case."""
        stream = self.path.open(encoding="latin-1", newline=None)
        for _ in range(self.start):
            stream.readline()
        return stream

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line number and fields of each row of data."""
        with self.open() as stream:
            for number, line in enumerate(stream, self.start + 1):
                text = uncommented(line, self.format.comment)
                if text:
                    yield number, fields(text, self.format.delimiter)

    def line(self, row: int) -> int:
        """Line number of a row of data."""
        return next(n for i, (n, _) in enumerate(self.rows()) if i == row)

    def load(self, order: list[int]) -> Float:
        """(n, len(order)) values of these columns; ValueError or OverflowError if numpy refuses."""
        comma = self.format.decimal == ","
        with self.open() as stream:
            return np.loadtxt(
                (line.replace(",", ".") for line in stream) if comma else stream,
                comments=self.format.comment or None,
                delimiter=self.format.delimiter or None,
                quotechar='"',
                usecols=order,
                ndmin=2,
                dtype=np.float64,
            )

    def number(self, field: str) -> float:
        """A field as the number it stands for; ValueError if it is none."""
        return float(field.replace(",", ".") if self.format.decimal == "," else field)


def read_text_table(path: Path, layout: TextFormat | CsvFormat, wanted: list[str]) -> Table:
    """The columns `wanted` of a delimited text file.

    Raises
    ------
    InputError : no data, no such column, a field that is no finite number, a short line.
    """
    text = read_header(path, layout, wanted)
    where = str(path)
    for name in wanted:
        if text.names.count(name) != 1:
            twice = "once, not twice" if name in text.names else f"one of {list(text.names)}"
            raise InputError(where, "column", name, twice + _hint(text.head, layout, wanted))
    order = [text.names.index(name) for name in wanted]
    try:
        values = text.load(order)
    except (ValueError, OverflowError) as error:
        raise _fault(text, order) or InputError(where, "", str(error), "a table") from error
    if not np.isfinite(values).all():
        row, i = (int(k[0]) for k in np.nonzero(~np.isfinite(values)))
        place = f"line {text.line(row)}, column {wanted[i]!r}"
        raise InputError(where, place, float(values[row, i]), "a finite number")
    columns = {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(wanted)}
    return Table(where, columns, text.units, header=text.header, line=text.line)


def encoding(path: Path) -> str:
    """How the text's letters are written: "UTF-8", "UTF-8 with BOM" or "Latin-1".

    InputError for letters of two bytes or more, and for a file that cannot be read.
    """
    try:
        with open_file(path) as stream:
            data = stream.read(_LOOKED_AT)
    except OSError as error:
        raise InputError(str(path), "", reason(error), "a readable file") from error
    found = next((name for mark, name in _MARKS.items() if data.startswith(mark)), "")
    even, odd = data[::2].count(0), data[1::2].count(0)
    if not found and max(even, odd) > len(data) // 4 and min(even, odd) < len(data) // 64:
        found = "UTF-16"
    if found:
        expected = f"UTF-8; save it so, or convert it: iconv -f {found} -t UTF-8"
        raise InputError(str(path), "encoding", found, expected)
    if data.startswith(codecs.BOM_UTF8):
        return "UTF-8 with BOM"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(data)
    except UnicodeDecodeError:
        return "Latin-1"
    return "UTF-8"


def read_header(
    path: Path, layout: TextFormat | CsvFormat, wanted: list[str] | None = None
) -> Text:
    """Read up to the first row of data and find the columns' names and units.

    wanted : columns by which a wrong delimiter is detected.
    """
    where = str(path)
    encoding(path)
    comments: list[str] = []
    rows: list[str] = []  # of names, and of units
    before = 0 if layout.header != "row" else 2 if layout.units_row else 1
    start = 0
    first = ""
    with path.open("rb") as stream:
        for number, raw in enumerate(stream):
            line = decoded(raw)
            text = "" if number < layout.skip_lines else uncommented(line, layout.comment)
            if text and len(rows) == before:
                first = text
                break
            if text:
                rows.append(text)
            elif line.strip() and number >= layout.skip_lines:
                comments.append(line.strip().removeprefix(layout.comment).strip())
            start = number + 1
    if not first:
        said = "header without data" if rows or comments or start else "empty, no data"
        raise InputError(where, "", said, "at least two samples")
    head = {"none": "", "row": rows[0] if rows else "", "comment": (comments or [""])[-1]}
    labels = list(layout.columns) or fields(head[layout.header], layout.delimiter)
    width = len(fields(first, layout.delimiter))
    if len(labels) != width:
        hint = _hint(head[layout.header] or first, layout, wanted or [])
        expected = f"{width} names, one a column of line {start + 1}{hint}"
        raise InputError(where, "header", labels, expected)
    names, units = labelled(labels)
    if layout.units_row:
        stated = [unit.strip("[]()") for unit in fields(rows[1], layout.delimiter)]
        if len(stated) != width:
            raise InputError(where, "row of units", stated, f"{width} units, one a column")
        units |= dict(zip(names, stated, strict=True))
    return Text(
        path, layout, names, units, tuple(comments), start, width, head[layout.header] or first
    )


def _hint(line: str, layout: TextFormat | CsvFormat, wanted: list[str]) -> str:
    """A question for a person whose map has another delimiter than the file."""
    columns = layout.columns
    for delimiter in DELIMITERS:
        if delimiter == layout.delimiter:
            continue
        found = fields(line, delimiter)
        names, _ = labelled(found)
        fits = len(found) == len(columns) if columns else bool(wanted) and set(wanted) <= {*names}
        if fits and len(found) > 1:
            return f"; is the delimiter {_SPOKEN.get(delimiter, repr(delimiter))}?"
    return ""


def _fault(text: Text, order: list[int]) -> InputError | None:
    """The first line that cannot be read, None if Python can read them all."""
    where = str(text.path)
    for number, found in text.rows():
        if len(found) != text.width:
            expected = f"{text.width} columns as in the first line of data"
            return InputError(where, f"line {number}", f"{len(found)} columns", expected)
        for i in order:
            try:
                text.number(found[i])
            except ValueError:
                place = f"line {number}, column {text.names[i]!r}"
                return InputError(where, place, found[i], f"a number{_mark(text, found[i])}")
    return None


def _mark(text: Text, field: str) -> str:
    """A question for a person whose map has another decimal mark than the file."""
    try:
        float(field.replace(",", "."))
    except ValueError:
        return ""
    return "; is the decimal mark ','?" if text.format.decimal == "." else ""


def uncommented(line: str, comment: str) -> str:
    """The line without its comment; "" if nothing is left. A tab may be an empty column."""
    text = (line.split(comment, 1)[0] if comment else line).rstrip("\r\n")
    return text if text.strip() else ""


def fields(text: str, delimiter: str) -> list[str]:
    """The fields of a line, without quotes; `delimiter` "" is any white space."""
    parts = text.split(delimiter or None)
    return [part.strip().strip('"').strip() for part in parts]
