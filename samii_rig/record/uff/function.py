"""Data set 58, a function of time or frequency, as text or (58b) as binary numbers.

Its fields: id1 to id5; function_type (1 time response, 2 auto spectrum, 4 frequency response, 6
coherence, 9 power spectral density, 21 partial and 26 multiple coherence), function_id, version,
load_case; response and reference: _entity, _node, _direction; data_type (2 real, 4 real double,
5 complex, 6 complex double), points, even (1: even abscissa), x_min, x_step, z; of the axes x, y,
y2 (denominator) and z: _type, _length, _force, _temperature (exponents), _label, _unit. Then x
(points,) where the abscissa is uneven, and data (points,). Text holds 6 digits, of double types
13; binary holds all.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from samii_rig.record.uff.card import card, number
from samii_rig.record.uff.sets import Fields, whole

LINES = 11  # of the head, after the line with the set's number
TIME_RESPONSE, FREQUENCY_RESPONSE, COHERENCE = 1, 4, 6
PARTIAL_COHERENCE, MULTIPLE_COHERENCE = 21, 26
REAL, REAL_DOUBLE, COMPLEX, COMPLEX_DOUBLE = 2, 4, 5, 6

_AXES = ("x", "y", "y2", "z")
_DEGREE = card(
    "function_type:I5 function_id:I10 version:I5 load_case:I10 "
    "X1 response_entity:A10 response_node:I10 response_direction:I4 "
    "X1 reference_entity:A10 reference_node:I10 reference_direction:I4"
)
_FORM = card("data_type:I10 points:I10 even:I10 x_min:E13.5 x_step:E13.5 z:E13.5")
_AXIS = {
    axis: card(
        f"{axis}_type:I10 {axis}_length:I5 {axis}_force:I5 {axis}_temperature:I5 "
        f"X1 {axis}_label:A20 X1 {axis}_unit:A20"
    )
    for axis in _AXES
}
# 58b: byte order (1 little, 2 big endian), format of numbers (2 IEEE 754), lines of the head,
# bytes after them, four zeros.
BINARY = card("order:I6 format:I6 lines:I12 bytes:I12 a:I6 b:I6 c:I12 d:I12")
_LITTLE, _IEEE = 1, 2
_DOUBLE = {REAL: False, REAL_DOUBLE: True, COMPLEX: False, COMPLEX_DOUBLE: True}
_A_LINE, _A_LINE_DOUBLE = 6, 4  # numbers a line of an even abscissa
_SINGLE, _LONG = 13, 20  # columns of a number, single and double
_ROWS = 4096  # lines that are made at a time
_AT_ONCE = 1 << 22  # bytes of text that are made into numbers at a time


def read_head(lines: list[str]) -> Fields:
    """The fields of the head; ValueError if it is none."""
    fields: Fields = {f"id{i + 1}": line.rstrip() for i, line in enumerate(lines[:5])}
    fields |= _DEGREE.parsed(lines[5])
    fields |= _FORM.parsed(lines[6])
    for axis, line in zip(_AXES, lines[7:11], strict=True):
        fields |= _AXIS[axis].parsed(line)
    if fields["data_type"] not in _DOUBLE:
        raise ValueError(f"data type {fields['data_type']}; expected 2, 4, 5 or 6")
    if whole(fields["points"], "points") < 0 or fields["even"] not in (0, 1):
        raise ValueError(f"{fields['points']} points, spacing {fields['even']}; expected 0 or 1")
    return fields


def write_head(fields: Fields) -> Iterator[str]:
    """The lines of the head."""
    yield from (str(fields[f"id{i}"])[:80] for i in range(1, 6))
    yield _DEGREE.written(fields)
    yield _FORM.written(fields)
    yield from (_AXIS[axis].written(fields) for axis in _AXES)


def read_body(fields: Fields, body: memoryview, binary: dict[str, Any] | None) -> Fields:
    """The head's fields with `x` and `data`; ValueError if the body does not hold them.

    binary : the fields of `BINARY`, None for text.
    """
    a_point = _a_point(fields)
    count = fields["points"] * a_point
    if binary is None:
        values = _from_text(body, count, fields)
    else:
        values = _from_bytes(body, count, fields, binary)
    table = values.reshape(fields["points"], a_point)
    found = dict(fields)
    if not fields["even"]:
        found["x"] = table[:, 0].copy()
        table = table[:, 1:]
    if fields["data_type"] in (COMPLEX, COMPLEX_DOUBLE):
        found["data"] = np.ascontiguousarray(table).view(np.complex128)[:, 0]
    else:
        found["data"] = table[:, 0].copy()
    return found


def text_extent(fields: Fields) -> tuple[int, int, int]:
    """Full lines of the body in text, their columns, and the columns of the one after them."""
    widths = _widths(fields)
    rows, rest = divmod(fields["points"] * _a_point(fields), len(widths))
    return rows, sum(widths), sum(widths[:rest])


def write_text(fields: Fields) -> Iterator[str]:
    """The lines of the body."""
    table = _table(fields)
    digits = [_digits(column) for column in table.T]
    forms = [
        f"%13.{digits[i % len(digits)]}E" if width == _SINGLE else "%20.12E"
        for i, width in enumerate(_widths(fields))
    ]
    flat = table.ravel()
    rows = len(flat) // len(forms)
    for i in range(0, rows, _ROWS):
        some = flat[i * len(forms) : min(i + _ROWS, rows) * len(forms)].tolist()
        made = "\n".join(["".join(forms)] * (len(some) // len(forms)))
        yield from (made % tuple(some)).split("\n")
    rest = flat[rows * len(forms) :].tolist()
    if rest:
        yield "".join(forms[: len(rest)]) % tuple(rest)


def write_bytes(fields: Fields) -> bytes:
    """The body in binary: as wide as the data's type says."""
    kind = "<f8" if _DOUBLE[fields["data_type"]] else "<f4"
    return _table(fields).astype(kind).tobytes()


def binary_head(body: bytes) -> str:
    """What follows the number of the set in the first line of a 58b with this body."""
    about = {"order": _LITTLE, "format": _IEEE, "lines": LINES, "bytes": len(body)}
    return "b" + BINARY.written(about | dict.fromkeys("abcd", 0))


def completed(fields: Fields) -> Fields:
    """The fields with those that follow from the data: points, and the type of the data."""
    data = np.asarray(fields["data"])
    found = {"data_type": COMPLEX_DOUBLE if np.iscomplexobj(data) else REAL_DOUBLE, **fields}
    if np.iscomplexobj(data) != (found["data_type"] in (COMPLEX, COMPLEX_DOUBLE)):
        raise ValueError(f"{data.dtype} data are not of type {found['data_type']}")
    return found | {"points": len(data), "even": int("x" not in fields)}


def _a_point(fields: Fields) -> int:
    complex_data = fields["data_type"] in (COMPLEX, COMPLEX_DOUBLE)
    return (1 if fields["even"] else 2) + complex_data


def _table(fields: Fields) -> np.ndarray[Any, Any]:
    """(points, numbers a point) abscissa where it is uneven, real and imaginary part."""
    data = np.asarray(fields["data"])
    parts = [data.real, data.imag] if np.iscomplexobj(data) else [data]
    if not fields["even"]:
        parts = [np.asarray(fields["x"]), *parts]
    return np.column_stack(parts).astype(np.float64)


def _widths(fields: Fields) -> list[int]:
    """Columns of the numbers of one line."""
    double = _DOUBLE[fields["data_type"]]
    if not double:
        return [_SINGLE] * _A_LINE
    if fields["even"]:
        return [_LONG] * _A_LINE_DOUBLE
    if fields["data_type"] == COMPLEX_DOUBLE:
        return [_SINGLE, _LONG, _LONG]
    return [_SINGLE, _LONG] * 2


def _digits(column: np.ndarray[Any, Any]) -> int:
    """Digits behind the point of the numbers in 13 columns: one more where no number needs the
    columns of a sign or of a third digit of its exponent, as some programs write them."""
    size = np.abs(column[column != 0.0])
    plain = bool(np.all((size > 1e-99) & (size < 1e99)))
    return 6 if plain and bool(np.all(column >= 0.0)) else 5


def _from_text(body: memoryview, count: int, fields: Fields) -> np.ndarray[Any, Any]:
    """`count` numbers from the lines of the body, a few megabytes at a time."""
    values = np.empty(count)
    done, at = 0, 0
    while at < len(body):
        end = min(at + _AT_ONCE, len(body))
        if end < len(body):
            newline = bytes(body[at:end]).rfind(b"\n")
            end = at + newline + 1 if newline >= 0 else end
        text = bytes(body[at:end]).replace(b"D", b"E").replace(b"d", b"E")
        at = end
        try:
            found = np.array(text.split(), dtype=np.float64)
        except ValueError:
            found = _by_columns(text, _widths(fields))
        if done + len(found) > count:
            raise ValueError(f"over {count} numbers; expected {count}, as the head says")
        values[done : done + len(found)] = found
        done += len(found)
    if done < count:
        raise ValueError(f"{done} numbers; expected {count}, as the head says")
    return values


def _by_columns(text: bytes, widths: list[int]) -> np.ndarray[Any, Any]:
    """Numbers that touch each other, cut at their columns."""
    found = []
    for line in text.decode("latin-1").splitlines():
        at = 0
        for width in widths:
            part = line[at : at + width].strip()
            at += width
            if part:
                found.append(number(part))
    return np.array(found)


def _from_bytes(
    body: memoryview, count: int, fields: Fields, binary: dict[str, Any]
) -> np.ndarray[Any, Any]:
    if binary["format"] not in (_IEEE, 0, None):
        raise ValueError(f"numbers of format {binary['format']}; expected 2, IEEE 754")
    order = ">" if binary["order"] == 2 else "<"
    width = 8 if _DOUBLE[fields["data_type"]] else 4
    if len(body) >= width * count:
        return np.frombuffer(body, f"{order}f{width}", count).astype(np.float64)
    # The abscissa of a double set is single in files that follow the text's columns.
    a_point = _a_point(fields)
    kind = np.dtype([("x", f"{order}f4"), ("y", f"{order}f8", (a_point - 1,))])
    if fields["even"] or width != 8 or len(body) < kind.itemsize * fields["points"]:
        raise ValueError(f"{len(body)} bytes; expected {width * count}, as the head says")
    table = np.frombuffer(body, kind, fields["points"])
    return np.column_stack([table["x"], table["y"]]).astype(np.float64).ravel()
