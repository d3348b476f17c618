"""Foreign files as named columns of numbers; what is wrong is said with its line.

Delimited text goes through numpy's own reader (3 to 4 million values/s); only when that
refuses is the file gone through again line by line to say where and why.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.errors import InputError
from samii_rig.record import matfile
from samii_rig.record.maps import CsvFormat, MatFormat, TextFormat, UffFormat
from samii_rig.types import Float

_UNIT = re.compile(r"^(?P<name>.*\S)\s*\[(?P<unit>[^\[\]]*)\]$")
_TIME_RESPONSE = 1  # function type of a UFF 58 data set
_NONE = {"", "NONE", "-"}  # what universal files write for "no label"


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of equal length.

    units : what the file itself says, by column; most files say nothing.
    rate_hz : sample rate that the file itself states (UFF), None otherwise.
    header : comment lines before the data. text : what `place` reads again, None if no text.
    """

    where: str
    columns: dict[str, Float]
    units: dict[str, str] = field(default_factory=dict)
    rate_hz: float | None = None
    header: tuple[str, ...] = ()
    text: _Text | None = None

    def place(self, row: int, column: str) -> str:
        """Where a value stands, as an engineer finds it: line in a text, else sample."""
        at = f"sample {row}" if self.text is None else f"line {self.text.line(row)}"
        return f"{at}, column {column!r}"


@dataclass(frozen=True, slots=True)
class _Text:
    """A delimited file whose header has been read: `start` lines come before the data."""

    path: Path
    format: TextFormat | CsvFormat
    names: tuple[str, ...]
    units: dict[str, str]
    header: tuple[str, ...]
    start: int
    width: int

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
                text = _uncommented(line, self.format.comment)
                if text:
                    yield number, _fields(text, self.format.delimiter)

    def line(self, row: int) -> int:
        """Line number of a row of data."""
        return next(n for i, (n, _) in enumerate(self.rows()) if i == row)


def read_text_table(path: Path, layout: TextFormat | CsvFormat, wanted: list[str]) -> Table:
    """The columns `wanted` of a delimited text file.

    Raises
    ------
    InputError : no data, no such column, a field that is no finite number, a short line.
    """
    text = _read_header(path, layout)
    where = str(path)
    for name in wanted:
        if text.names.count(name) != 1:
            twice = "once, not twice" if name in text.names else f"one of {list(text.names)}"
            raise InputError(where, "column", name, twice)
    order = [text.names.index(name) for name in wanted]
    comma = layout.decimal == ","
    try:
        with text.open() as stream:
            lines = (line.replace(",", ".") for line in stream) if comma else stream
            values = np.loadtxt(
                lines,
                comments=layout.comment or None,
                delimiter=layout.delimiter or None,
                quotechar='"',
                usecols=order,
                ndmin=2,
                dtype=np.float64,
            )
    except (ValueError, OverflowError) as error:
        raise _fault(text, order) or InputError(where, "", str(error), "a table") from error
    if not np.isfinite(values).all():
        row, i = (int(k[0]) for k in np.nonzero(~np.isfinite(values)))
        place = Table(where, {}, text=text).place(row, wanted[i])
        raise InputError(where, place, float(values[row, i]), "a finite number")
    columns = {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(wanted)}
    return Table(where, columns, text.units, header=text.header, text=text)


def read_mat_table(path: Path, layout: MatFormat, wanted: list[str]) -> Table:
    """The columns `wanted` of a MATLAB file (version 4 to 7.2)."""
    where = str(path)
    names = [layout.variable] if layout.variable else wanted
    content = matfile.load(path, names)
    for name in names:
        if name not in content:
            raise InputError(where, "variable", name, "the name of a numeric variable in this file")
    if not layout.variable:
        return Table(where, {n: _vector(where, n, content[n]) for n in wanted})
    matrix = np.asarray(content[layout.variable])
    if matrix.ndim != 2 or matrix.shape[1] != len(layout.columns):
        expected = f"a matrix of {len(layout.columns)} columns, as the map names them"
        raise InputError(where, layout.variable, matrix.shape, expected)
    for name in wanted:
        if name not in layout.columns:
            raise InputError(where, "column", name, f"one of {list(layout.columns)}")
    return Table(where, {n: _vector(where, n, matrix[:, layout.columns.index(n)]) for n in wanted})


def read_uff_table(path: Path, layout: UffFormat, wanted: list[str]) -> Table:
    """The data sets 58 `wanted` of a universal file: evenly spaced, real time responses."""
    import pyuff

    where = str(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            file = pyuff.UFF(str(path))
            kinds = np.atleast_1d(file.get_set_types())
            found: list[Any] = [file.read_sets(int(i)) for i in np.flatnonzero(kinds == 58)]
    except Exception as error:  # pyuff's parser raises anything on a damaged file
        raise InputError(where, "", _short(error), "a universal file with sets 58") from error
    sets = [s for s in found if isinstance(s, dict) and s.get("func_type") == _TIME_RESPONSE]
    columns: dict[str, Float] = {}
    units: dict[str, str] = {}
    steps: set[float] = set()
    for name in wanted:
        one = _find_set(where, sets, name)
        columns[name] = _vector(where, name, one.get("data"))
        label = str(one.get("ordinate_axis_units_lab", "")).strip()
        units[name] = "" if label.upper() in _NONE else label
        if one.get("abscissa_spacing") != 1:
            raise InputError(where, f"set {name}", "uneven abscissa", "even spacing in time")
        steps.add(float(one.get("abscissa_inc", 0.0)))
    step = steps.pop() if len(steps) == 1 else 0.0
    if not (np.isfinite(step) and step > 0):
        raise InputError(where, "abscissa_inc", step, "one step above 0 s, the same in all sets")
    return Table(where, columns, units, rate_hz=1.0 / step)


def _find_set(where: str, sets: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """The time response called `name`: "#2" by its place, anything else by its first ID line."""
    labels = [str(s.get("id1", "")).strip() for s in sets]
    if re.fullmatch(r"#[0-9]{1,6}", name) and 0 < int(name[1:]) <= len(sets):
        return sets[int(name[1:]) - 1]
    if labels.count(name) == 1:
        return sets[labels.index(name)]
    expected = f"one of {labels} once, or #1 to #{len(sets)}" if sets else "a time response"
    raise InputError(where, "set", name, expected)


def _read_header(path: Path, layout: TextFormat | CsvFormat) -> _Text:
    """Read up to the first row of data and find the columns' names and units."""
    where = str(path)
    comments: list[str] = []
    row: list[str] = []
    start = 0
    with path.open("rb") as stream:
        for number, raw in enumerate(stream):
            line = raw.decode("utf-8", errors="replace").removeprefix("\ufeff").strip("\r\n")
            if number < layout.skip_lines:
                start = number + 1
                continue
            text = _uncommented(line, layout.comment)
            if not text:
                if line.strip():
                    comments.append(line.strip().removeprefix(layout.comment).strip())
                start = number + 1
                continue
            if layout.header == "row" and not row:
                row = _fields(text, layout.delimiter)
                start = number + 1
                continue
            width = len(_fields(text, layout.delimiter))
            break
        else:
            raise InputError(where, "", "no data", "at least two samples")
    if layout.header == "none":
        labels = list(layout.columns)
    elif layout.header == "row":
        labels = row
    else:
        labels = _fields(comments[-1], layout.delimiter) if comments else []
    if len(labels) != width:
        expected = f"{width} names, one a column of line {start + 1}"
        raise InputError(where, "header", labels, expected)
    names, units = [], {}
    for label in labels:
        match = _UNIT.match(label)
        names.append(match["name"].strip() if match else label)
        if match:
            units[names[-1]] = match["unit"].strip()
    return _Text(path, layout, tuple(names), units, tuple(comments), start, width)


def _fault(text: _Text, order: list[int]) -> InputError | None:
    """The first line that cannot be read, None if Python can read them all."""
    where = str(text.path)
    for number, fields in text.rows():
        if len(fields) != text.width:
            expected = f"{text.width} columns as in the first line of data"
            return InputError(where, f"line {number}", f"{len(fields)} columns", expected)
        for i in order:
            value = fields[i].replace(",", ".") if text.format.decimal == "," else fields[i]
            try:
                float(value)
            except ValueError:
                place = f"line {number}, column {text.names[i]!r}"
                return InputError(where, place, fields[i], "a number")
    return None


def _uncommented(line: str, comment: str) -> str:
    """The line without its comment; "" if nothing is left. A tab may be an empty column."""
    text = (line.split(comment, 1)[0] if comment else line).rstrip("\r\n")
    return text if text.strip() else ""


def _fields(text: str, delimiter: str) -> list[str]:
    parts = text.split(delimiter or None)
    return [part.strip().strip('"').strip() for part in parts]


def _vector(where: str, name: str, value: object) -> Float:
    array = np.asarray(value)
    if array.dtype.kind not in "fiub" or array.size != max(array.shape, default=0):
        expected = "a vector of real numbers"
        raise InputError(where, name, f"{array.dtype} of shape {array.shape}", expected)
    vector = np.ascontiguousarray(array.reshape(-1), dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(vector))
    if bad.size:
        at = f"sample {bad[0]}, column {name!r}"
        raise InputError(where, at, float(vector[bad[0]]), "a finite number")
    return vector


def _short(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
