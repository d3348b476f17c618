"""JSON and Parquet files as named columns of numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from samii_rig.errors import InputError
from samii_rig.files import open_file, reason
from samii_rig.record.maps import JsonFormat
from samii_rig.record.tables import Table, vector
from samii_rig.record.text import labelled

# A JSON text costs up to 30 times its size in Python's objects.
MAX_JSON = 256 << 20  # bytes; more belongs into Parquet or CSV


def read_json_table(path: Path, layout: JsonFormat, wanted: list[str]) -> Table:
    """The columns `wanted` of a JSON file.

    Raises
    ------
    InputError : no JSON, no such key or column, values that are not finite numbers.
    """
    columns, units = json_columns(path, layout)
    return _chosen(str(path), columns, units, wanted)


def read_parquet_table(path: Path, wanted: list[str]) -> Table:
    """The columns `wanted` of a Parquet file; InputError without pyarrow."""
    columns, units = parquet_columns(path, wanted)
    return _chosen(str(path), columns, units, wanted)


def _chosen(
    where: str, columns: Mapping[str, object], units: dict[str, str], wanted: list[str]
) -> Table:
    for name in wanted:
        if name not in columns:
            raise InputError(where, "column", name, f"one of {list(columns)}")
    return Table(where, {name: vector(where, name, columns[name]) for name in wanted}, units)


def json_columns(path: Path, layout: JsonFormat) -> tuple[dict[str, Any], dict[str, str]]:
    """Every column of a JSON file as an array, numbers or not, and the units in their names."""
    where = str(path)
    content = parsed(path)
    for key in layout.under.split(".") if layout.under else ():
        if not isinstance(content, dict) or key not in content:
            has = list(content) if isinstance(content, dict) else type(content).__name__
            raise InputError(where, f"under {layout.under!r}", has, f"an object with {key!r}")
        content = content[key]
    if isinstance(content, list):
        content = _rows_as_columns(where, content, layout.columns)
    if not isinstance(content, dict):
        expected = "an object of arrays, or an array of rows"
        raise InputError(where, "content", type(content).__name__, expected)
    other = [key for key, v in content.items() if not isinstance(v, list)]
    if other or not content:
        deeper = [key for key, v in content.items() if isinstance(v, (dict, list))]
        hint = f"; is it under one of {deeper}?" if deeper else ""
        raise InputError(where, "content", other, f"arrays by name, or an array of rows{hint}")
    names, units = labelled(list(content))
    return dict(zip(names, (_array(v) for v in content.values()), strict=True)), units


def parsed(path: Path) -> Any:
    """A JSON text, or one JSON value a line as a list."""
    where = str(path)
    try:
        with open_file(path) as stream:
            data = stream.read(MAX_JSON + 1)
        if len(data) > MAX_JSON:
            expected = f"at most {MAX_JSON >> 20} MB; Parquet or CSV hold more"
            raise InputError(where, "bytes", path.stat().st_size, expected)
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise InputError(where, "", reason(error), "a readable file") from error
    except UnicodeDecodeError as error:
        raise InputError(where, "encoding", error.reason, "UTF-8") from error
    if not text.strip():
        raise InputError(where, "", "empty, no data", "at least two samples")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        try:
            return [json.loads(line) for line in text.splitlines() if line.strip()]
        except (ValueError, RecursionError):
            said = " ".join(str(error).split()) or "nested too deep"
            raise InputError(where, "", said, "JSON") from error


def _rows_as_columns(where: str, rows: list[Any], names: tuple[str, ...]) -> dict[str, list[Any]]:
    if rows and all(isinstance(row, dict) for row in rows):
        keys = list(rows[0])
        for i, row in enumerate(rows):
            if row.keys() != rows[0].keys():
                raise InputError(where, f"row {i}", list(row), f"the keys of row 0, {keys}")
        return {key: [row[key] for row in rows] for key in keys}
    if rows and all(isinstance(row, list) for row in rows):
        labels = names or tuple(f"#{i + 1}" for i in range(len(rows[0])))
        for i, row in enumerate(rows):
            if len(row) != len(labels):
                expected = f"{len(labels)}, one a column"
                raise InputError(where, f"values in row {i}", len(row), expected)
        return {name: [row[i] for row in rows] for i, name in enumerate(labels)}
    raise InputError(where, "", f"{len(rows)} values", "an array of objects or of arrays")


def _array(values: list[Any]) -> Any:
    """(n,) numbers, NaN for null; what is no list of numbers stays an array of objects."""
    given = [float("nan") if v is None else v for v in values]
    if all(isinstance(v, (int, float)) for v in given):
        try:
            return np.array(given, dtype=np.float64)
        except OverflowError:
            pass
    made = np.empty(len(values), dtype=object)
    made[:] = values
    return made


def parquet_columns(
    path: Path, wanted: list[str] | None = None
) -> tuple[dict[str, Any], dict[str, str]]:
    """The columns of a Parquet file that `wanted` names, by default all, and their units.

    InputError without pyarrow, and for a file that it cannot read.
    """
    where = str(path)
    parquet = arrow("parquet")
    try:
        with open_file(path) as stream:
            file = parquet.ParquetFile(stream)
            schema = file.schema_arrow
            labels = {n: label for label in schema.names for n in labelled([label])[0]}
            read = [label for name, label in labels.items() if wanted is None or name in wanted]
            table = file.read(columns=read)
    except OSError as error:
        said = error.strerror or _one_line(error)
        raise InputError(where, "", said, "a Parquet file") from error
    except Exception as error:  # its errors have many types, on a damaged file any of them
        raise InputError(where, "", _one_line(error), "a Parquet file") from error
    units = labelled(schema.names)[1]
    columns = {}
    for name, label in labels.items():
        if label not in read:
            columns[name] = np.empty(0)
            continue
        about = schema.field(label).metadata or {}
        stated = about.get(b"unit", about.get(b"units", b"")).decode("utf-8", "replace")
        if stated:
            units[name] = stated
        columns[name] = table.column(label).to_numpy()
    return columns, units


def arrow(module: str) -> ModuleType:
    """pyarrow's module of this name; InputError where it is not installed."""
    import importlib

    try:
        return importlib.import_module(f"pyarrow.{module}")
    except ModuleNotFoundError as error:
        expected = "it to be installed: pip install samii-rig[parquet]"
        raise InputError("Parquet", "", error.name, expected) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
