"""Say what is in a foreign file: how it is written, its columns, its time base, its levels.

Nothing is taken from a map: `record.sniff` finds how a text is written, `record.timing` which
columns say the time. `record.first_map` makes a first map of it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from samii_rig.errors import InputError
from samii_rig.files import open_file, reason
from samii_rig.record import delimited, matfile, structured
from samii_rig.record.maps import (
    CsvFormat,
    Format,
    JsonFormat,
    MatFormat,
    ParquetFormat,
    TextFormat,
    UffFormat,
)
from samii_rig.record.sniff import text_format
from samii_rig.record.tables import uff_columns
from samii_rig.record.timing import timing
from samii_rig.record.uff.channels import inventory
from samii_rig.record.uff.file import UffFile
from samii_rig.types import Float

_MAX_LEVELS = 20  # more values are a signal
_LEVEL_RUN = 10  # samples that a level lasts at least, on average


@dataclass(frozen=True, slots=True)
class Column:
    """One column. unit : as the file states it, "" if it does not.

    samples, missing : how many values, and how many of them are no finite number; first_missing :
        where the first of those is, -1 for none. low, high : of the others.
    step : the converter's step that all values are multiples of, 0 if there is none.
    levels : the values of a column that holds few of them for long, in the order of the file.
    """

    name: str
    unit: str
    samples: int
    missing: int
    first_missing: int
    low: float
    high: float
    step: float = 0.0
    levels: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Description:
    """What is in a file.

    format : what the map's `[format]` must say. encoding : of a text, "" for others.
    time, time_unit, sequence : names of the columns of time and count, "" for none;
        unit_guessed : the file does not state the unit of time.
    rate_hz : None where neither a column nor the file says it. gaps, lost : jumps of the count,
        and samples in them. length_s : from the first sample to the last, NaN without a rate.
    sets : of a universal file, a line a kind. notes : what a person should know before the import,
        one line each.
    """

    path: str
    bytes: int
    format: Format
    encoding: str
    header: tuple[str, ...]
    columns: tuple[Column, ...]
    samples: int
    time: str = ""
    time_unit: str = "s"
    unit_guessed: bool = False
    sequence: str = ""
    rate_hz: float | None = None
    length_s: float = float("nan")
    gaps: int = 0
    lost: int = 0
    sets: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """The description for a person."""
        sets = [f"  sets     {line}" for line in self.sets]
        notes = [f"  note     {note}" for note in self.notes]
        if not self.columns:
            return [f"{self.path}: no columns", *sets, *notes]
        rate = "rate unknown" if self.rate_hz is None else f"{self.rate_hz:g} Hz"
        lasts = "" if np.isnan(self.length_s) else f", {self.length_s:.6g} s"
        said = [
            f"{self.path}: {len(self.columns)} columns, {self.samples:,} samples, {rate}{lasts}",
            f"  written  {self._written()}",
        ]
        if self.time:
            asked = " (a guess)" if self.unit_guessed else ""
            said.append(f"  time     {self.time!r} in {self.time_unit}{asked}")
        if self.sequence:
            said.append(f"  count    {self.sequence!r}")
        said.append(f"  gaps     {self.gaps}, {self.lost} samples lost")
        said += [f"  comment  {line}" for line in self.header]
        said += sets
        width = max(6, *(len(c.name) for c in self.columns))
        said.append(f"  {'column':{width}}  {'unit':8}  {'smallest':>12}  {'largest':>12}  step")
        for c in self.columns:
            row = f"  {c.name:{width}}  {c.unit or '?':8}  {c.low:12.6g}  {c.high:12.6g}"
            row += f"  {c.step:g}" if c.step else "  -"
            if c.levels:
                row += f"  levels {', '.join(f'{level:g}' for level in c.levels)}"
            said.append(row + (f"  {c.missing} missing" if c.missing else ""))
        return said + notes

    def _written(self) -> str:
        layout = self.format
        if not isinstance(layout, (CsvFormat, TextFormat)):
            return f"as {layout.kind}"
        named = {"\t": "tab", "": "white space"}.get(layout.delimiter, repr(layout.delimiter))
        head = {"row": "the first row", "comment": "the last comment", "none": "nowhere"}
        return (
            f"in {self.encoding}, delimiter {named}, decimal sign {layout.decimal!r}, "
            f"names in {head[layout.header]}"
            + (f" after {layout.skip_lines} lines" if layout.skip_lines else "")
            + (", units in the row below" if layout.units_row else "")
        )


@dataclass(slots=True)
class _Found:
    """Columns as they were read; what is no number is NaN."""

    format: Format
    columns: dict[str, Float]
    units: dict[str, str] = field(default_factory=dict)
    encoding: str = ""
    header: tuple[str, ...] = ()
    rate_hz: float | None = None
    sets: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def describe(path: Path) -> Description:
    """What is in the file at `path`, by its suffix: MAT, UFF, JSON, Parquet, any other a text.

    Raises
    ------
    InputError : it cannot be read, is empty, or holds no columns of numbers.
    """
    try:
        with open_file(path) as stream:
            size = os.fstat(stream.fileno()).st_size
    except OSError as error:
        raise InputError(str(path), "", reason(error), "a readable file") from error
    if size == 0:
        raise InputError(str(path), "", "empty, no data", "at least two samples")
    match path.suffix.lower():
        case ".mcap":
            expected = "a foreign file; samii-rig verify says what is in a recording"
            raise InputError(str(path), "", "an MCAP file", expected)
        case ".mat":
            found = _mat(path)
        case ".uff" | ".unv":
            found = _uff(path)
        case ".json" | ".jsonl" | ".ndjson":
            found = _json(path)
        case ".parquet" | ".pq":
            columns, units = structured.parquet_columns(path)
            found = _numeric(_Found(ParquetFormat(kind="parquet"), {}, units), columns)
        case _:
            found = _text(path)
    return _described(path, size, found)


def _described(path: Path, size: int, found: _Found) -> Description:
    if found.sets and not found.columns:
        found.notes.append("no real time response (58), so there is nothing to import")
        return Description(
            str(path),
            size,
            found.format,
            "",
            (),
            (),
            0,
            sets=tuple(found.sets),
            notes=tuple(found.notes),
        )
    lengths = {data.size for data in found.columns.values()}
    if not lengths or max(lengths) < 2:
        raise InputError(str(path), "", "no column of numbers", "at least two samples in one")
    if len(lengths) > 1:
        most = max(lengths)
        short = [n for n, data in found.columns.items() if data.size != most]
        found.notes.append(f"{short} are shorter than the others; leave them out of the map")
    base = timing(found.columns, found.units, found.rate_hz)
    found.notes += base.notes
    columns = tuple(
        _column(name, found.units.get(name, ""), data) for name, data in found.columns.items()
    )
    for column in columns:
        if column.missing:
            found.notes.append(
                f"column {column.name!r} has {column.missing} values that are no finite number, "
                f"first at sample {column.first_missing}; the import refuses them"
            )
    return Description(
        path=str(path),
        bytes=size,
        format=found.format,
        encoding=found.encoding,
        header=found.header,
        columns=columns,
        samples=max(lengths),
        sets=tuple(found.sets),
        **(asdict(base) | {"notes": tuple(found.notes)}),
    )


def _column(name: str, unit: str, data: Float) -> Column:
    good = data[np.isfinite(data)]
    bad = np.flatnonzero(~np.isfinite(data))
    low, high = (float(good.min()), float(good.max())) if good.size else (np.nan, np.nan)
    first = int(bad[0]) if bad.size else -1
    return Column(
        name, unit, data.size, bad.size, first, low, high, _step(good), _levels(data, good)
    )


def _step(good: Float) -> float:
    """The step that all values are multiples of, apart; 0 if there is none."""
    values = np.unique(good)
    if not 1 < values.size <= good.size // 2:
        return 0.0
    steps = np.diff(values)
    step = float(steps.min())
    # Digits cut off in the file move each value by up to half of its last one.
    whole = np.abs(steps / step - np.rint(steps / step)) < 0.05
    return float(f"{step:.6g}") if whole.all() else 0.0


def _levels(data: Float, good: Float) -> tuple[float, ...]:
    """The few values of a column that changes seldom."""
    if good.size != data.size or data.size < 2 * _LEVEL_RUN:
        return ()
    edges = np.flatnonzero(np.diff(data)) + 1
    if not 0 < edges.size < data.size / _LEVEL_RUN:
        return ()
    values = tuple(dict.fromkeys(data[[0, *edges.tolist()]].tolist()))
    return values if len(values) <= _MAX_LEVELS else ()


def _text(path: Path) -> _Found:
    encoding = delimited.encoding(path)
    layout = text_format(path)
    text = delimited.read_header(path, layout)
    order = list(range(text.width))
    notes = []
    if len(set(text.names)) < len(text.names):
        twice = sorted({n for n in text.names if text.names.count(n) > 1})
        notes.append(f"{twice} occur twice among the names; rename one of each")
    try:
        values = text.load(order)
    except (ValueError, OverflowError):
        values = _row_by_row(text, notes)
    columns = {name: values[:, i].copy() for i, name in enumerate(text.names)}
    found = _Found(layout, columns, dict(text.units), encoding, text.header, notes=notes)
    words = [name for name, data in columns.items() if not np.isfinite(data).any()]
    for name in words:
        del columns[name]
        notes.append(f"column {name!r} holds no number; it is left out")
    return found


def _row_by_row(text: delimited.Text, notes: list[str]) -> Float:
    """(n, width) values where numpy gave up; NaN for what is no number."""
    rows, ragged = [], 0
    for number, fields in text.rows():
        if len(fields) != text.width:
            ragged = ragged or number
            continue
        row = []
        for one in fields:
            try:
                row.append(text.number(one))
            except ValueError:
                row.append(np.nan)
        rows.append(row)
    if ragged:
        notes.append(f"line {ragged} has not {text.width} columns; the import refuses such lines")
    return np.array(rows, dtype=np.float64).reshape(-1, text.width)


def _uff(path: Path) -> _Found:
    columns, units, rate = uff_columns(path)
    sets = inventory(UffFile(path))
    return _Found(UffFormat(kind="uff58"), columns, units, rate_hz=rate, sets=sets)


def _mat(path: Path) -> _Found:
    content = matfile.load(path, [])
    vectors = {n: a for n, a in content.items() if a.size > 1 and a.size == max(a.shape)}
    if not vectors:
        tables = {n: a for n, a in content.items() if a.ndim == 2 and min(a.shape) > 1}
        if not tables:
            raise InputError(str(path), "variables", list(content), "vectors, or a matrix")
        name, matrix = max(tables.items(), key=lambda item: item[1].size)
        names = tuple(f"column_{i + 1}" for i in range(matrix.shape[1]))
        layout = MatFormat(kind="mat", variable=name, columns=names)
        return _numeric(_Found(layout, {}), {n: matrix[:, i] for i, n in enumerate(names)})
    return _numeric(
        _Found(MatFormat(kind="mat"), {}), {n: a.reshape(-1) for n, a in vectors.items()}
    )


def _json(path: Path) -> _Found:
    """The columns of a JSON file, from the first place that has some."""
    under, rows = next(_places(structured.parsed(path), ""), ("", []))
    lists = rows if rows and isinstance(rows[0], list) else [[]]
    names = tuple(f"column_{i + 1}" for i in range(len(lists[0])))
    layout = JsonFormat(kind="json", under=under, columns=names)
    columns, units = structured.json_columns(path, layout)
    return _numeric(_Found(layout, {}, units), columns)


def _places(value: object, under: str) -> Iterator[tuple[str, list[Any]]]:
    """Where columns may lie: keys down to it, joined by dots, and its rows if it is an array."""
    if isinstance(value, list) and value and isinstance(value[0], (dict, list)):
        yield under, value
    if isinstance(value, dict):
        if value and all(isinstance(v, list) and v for v in value.values()):
            yield under, []
        for key, deeper in value.items():
            yield from _places(deeper, f"{under}.{key}".lstrip("."))


def _numeric(found: _Found, columns: Mapping[str, Any]) -> _Found:
    """`found` with those of the columns that are real numbers."""
    for name, data in columns.items():
        array = np.asarray(data)
        if array.dtype.kind in "fiub":
            found.columns[name] = cast(Float, array.astype(np.float64))
        else:
            found.notes.append(f"column {name!r} holds no real numbers; it is left out")
    return found
