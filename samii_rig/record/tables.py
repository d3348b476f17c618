"""Foreign files as named columns of numbers; what is wrong is said with its place."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from samii_rig.errors import InputError
from samii_rig.record import matfile
from samii_rig.record.maps import MatFormat
from samii_rig.record.uff.channels import NO_LABEL, time_responses
from samii_rig.record.uff.file import UffFile
from samii_rig.record.uff.sets import Fields
from samii_rig.types import Float


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of equal length.

    units : what the file itself says, by column; most files say nothing.
    rate_hz : sample rate that the file itself states (UFF), None otherwise.
    header : comment lines before the data. line : the line number of a row, None if no text.
    """

    where: str
    columns: dict[str, Float]
    units: dict[str, str] = field(default_factory=dict)
    rate_hz: float | None = None
    header: tuple[str, ...] = ()
    line: Callable[[int], int] | None = None

    def place(self, row: int, column: str) -> str:
        """Where a value stands, as an engineer finds it: line in a text, else sample."""
        at = f"sample {row}" if self.line is None else f"line {self.line(row)}"
        return f"{at}, column {column!r}"


def read_mat_table(path: Path, layout: MatFormat, wanted: list[str]) -> Table:
    """The columns `wanted` of a MATLAB file (version 4 to 7.2)."""
    where = str(path)
    names = [layout.variable] if layout.variable else wanted
    content = matfile.load(path, names)
    for name in names:
        if name not in content:
            raise InputError(where, "variable", name, "the name of a numeric variable in this file")
    if not layout.variable:
        return Table(where, {n: vector(where, n, content[n]) for n in wanted})
    matrix = np.asarray(content[layout.variable])
    if matrix.ndim != 2 or matrix.shape[1] != len(layout.columns):
        expected = f"a matrix of {len(layout.columns)} columns, as the map names them"
        raise InputError(where, layout.variable, matrix.shape, expected)
    for name in wanted:
        if name not in layout.columns:
            raise InputError(where, "column", name, f"one of {list(layout.columns)}")
    return Table(where, {n: vector(where, n, matrix[:, layout.columns.index(n)]) for n in wanted})


def read_uff_table(path: Path, wanted: list[str]) -> Table:
    """The data sets 58 `wanted` of a universal file: evenly spaced, real time responses.

    A set is called by its first ID line, or "#2" by its place among the time responses.
    """
    where = str(path)
    file = UffFile(path)
    found = time_responses(file)
    places = list(found.values())
    columns: dict[str, Float] = {}
    units: dict[str, str] = {}
    steps: set[float] = set()
    for name in wanted:
        numbered = re.fullmatch(r"#[0-9]{1,6}", name) and 0 < int(name[1:]) <= len(places)
        if name not in found and not numbered:
            held = f"one of {list(found)}, or #1 to #{len(places)}"
            raise InputError(where, "set", name, held if places else "a time response")
        one = file[found[name] if name in found else places[int(name[1:]) - 1]].fields
        if not one["even"]:
            raise InputError(where, f"set {name}", "uneven abscissa", "even spacing in time")
        columns[name] = vector(where, name, one["data"])
        units[name] = _unit(one)
        steps.add(one["x_step"] or 0.0)
    step = steps.pop() if len(steps) == 1 else 0.0
    if not (np.isfinite(step) and step > 0):
        raise InputError(where, "abscissa_inc", step, "one step above 0 s, the same in all sets")
    return Table(where, columns, units, rate_hz=1.0 / step)


def uff_columns(path: Path) -> tuple[dict[str, Float], dict[str, str], float | None]:
    """All real time responses of a universal file by the names that a map gives them, their
    units, and their rate in Hz, None unless they have one."""
    file = UffFile(path)
    sets = {name: file[i].fields for name, i in time_responses(file).items()}
    sets = {name: one for name, one in sets.items() if not np.iscomplexobj(one["data"])}
    steps = {one["x_step"] if one["even"] else 0.0 for one in sets.values()}
    step = steps.pop() if len(steps) == 1 else 0.0
    units = {name: _unit(one) for name, one in sets.items()}
    data = {name: one["data"] for name, one in sets.items()}
    return data, units, 1.0 / step if step else None


def _unit(one: Fields) -> str:
    return "" if one["y_unit"].upper() in NO_LABEL else str(one["y_unit"])


def vector(where: str, name: str, value: object) -> Float:
    """A column of finite numbers, (n,); InputError for anything else."""
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
