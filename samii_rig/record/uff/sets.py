"""What the data sets hold, field by field, but functions (58), which `function` has.

15 and 2411, nodes: node, definition, displacement (coordinate systems), color: (n,) int;
    position (n, 3).
55, data at nodes: id1 to id5; model_type, analysis_type, characteristic, specific_type,
    data_type (2 real, 5 complex); integers and reals of the analysis (load case and mode,
    frequency and damping); node (n,); data (n, values a node).
82, trace lines: number, color, id; nodes (n,), 0 where the pen is lifted.
151, header: model, description, program, dates, times, versions.
164, units: code, description, temperature_mode; length, force, temperature, offset: factors to SI.
2412, elements: element, descriptor, physical, material, color: (n,) int; beam (n, 3): orientation
    node, cross sections fore and aft, 0 for other elements; nodes: a tuple of each element's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

import numpy as np

from samii_rig.record.uff.card import Card, Field, card, number, numbers, wholes

Fields = dict[str, Any]

_REAL, _COMPLEX = 2, 5  # data types of set 55
# Finite elements whose second line holds orientation and cross sections: rod and beams.
_BEAMS = {11, 21, 22, 23, 24}
_NODES_A_LINE = 8
_ID = tuple(f"id{i}" for i in range(1, 6))

_NODE_15 = card("node:I10 definition:I10 displacement:I10 color:I10 x:E13.5 y:E13.5 z:E13.5")
_NODE_2411 = card("node:I10 definition:I10 displacement:I10 color:I10")
_POSITION_2411 = card("x:E25.16 y:E25.16 z:E25.16")
_NODE_COLUMNS = ("node", "definition", "displacement", "color")
_ABOUT_55 = card(
    "model_type:I10 analysis_type:I10 characteristic:I10 specific_type:I10 data_type:I10 width:I10"
)
_ABOUT_82 = card("number:I10 count:I10 color:I10")
_HEADER_151 = (
    card("model:A80"),
    card("description:A80"),
    card("program:A80"),
    card("created_date:A10 created_time:A10 version:I10 subversion:I10 file_type:I10"),
    card("saved_date:A10 saved_time:A10"),
    card("written_by:A80"),
    card(
        "written_date:A10 written_time:A10 release:I5 written_version:I5 host:I5 test:I5 counter:I5"
    ),
)
_UNITS_164 = card("code:I10 description:A20 temperature_mode:I10")
_FACTORS_164 = ("length", "force", "temperature", "offset")
_ELEMENT_2412 = card("element:I10 descriptor:I10 physical:I10 material:I10 color:I10 count:I10")
_BEAM_2412 = card("orientation:I10 fore:I10 aft:I10")
_ELEMENT_COLUMNS = ("element", "descriptor", "physical", "material", "color")


def whole(value: object, name: str) -> int:
    """A whole number that must be there; ValueError if it is not."""
    if not isinstance(value, int):
        raise ValueError(f"{name} is empty")
    return value


def _read_15(lines: list[str]) -> Fields:
    found = [_NODE_15.parsed(line) for line in lines]
    return _columns(found, _NODE_COLUMNS) | {"position": _positions(found)}


def _write_15(fields: Fields) -> Iterator[str]:
    for row, (x, y, z) in _node_rows(fields):
        yield _NODE_15.written(row | {"x": x, "y": y, "z": z})


def _read_2411(lines: list[str]) -> Fields:
    if len(lines) % 2:
        raise ValueError(f"{len(lines)} lines; expected two a node")
    found = [_NODE_2411.parsed(line) for line in lines[::2]]
    places = [_POSITION_2411.parsed(line) for line in lines[1::2]]
    return _columns(found, _NODE_COLUMNS) | {"position": _positions(places)}


def _write_2411(fields: Fields) -> Iterator[str]:
    for row, (x, y, z) in _node_rows(fields):
        yield _NODE_2411.written(row)
        yield _POSITION_2411.written({"x": x, "y": y, "z": z})


def _columns(found: list[dict[str, Any]], names: tuple[str, ...]) -> Fields:
    """(n,) int of each of the fields."""
    return {n: np.array([whole(f[n], n) for f in found], dtype=np.int64) for n in names}


def _positions(found: list[dict[str, Any]]) -> np.ndarray[Any, Any]:
    places = [[f[axis] for axis in "xyz"] for f in found]
    if any(value is None for value in chain(*places)):
        raise ValueError("a node has fewer than three coordinates")
    return np.array(places, dtype=np.float64).reshape(-1, 3)


def _node_rows(fields: Fields) -> Iterator[tuple[dict[str, Any], list[float]]]:
    rows = zip(*(np.asarray(fields[n]).tolist() for n in _NODE_COLUMNS), strict=True)
    for row, place in zip(rows, fields["position"].tolist(), strict=True):
        yield dict(zip(_NODE_COLUMNS, row, strict=True)), place


def _read_55(lines: list[str]) -> Fields:
    fields: Fields = dict(zip(_ID, (line.rstrip() for line in lines[:5]), strict=True))
    fields |= _ABOUT_55.parsed(lines[5])
    width, kind = whole(fields.pop("width"), "values a node"), fields["data_type"]
    if kind not in (_REAL, _COMPLEX) or width < 1:
        raise ValueError(f"data type {kind} with {width} values a node; expected 2 or 5, and some")
    row = iter(lines[6:])
    counts = _whole_line(next(row))
    n_integers, n_reals = counts[:2]
    integers = counts[2:]
    while len(integers) < n_integers:
        integers += _whole_line(next(row))
    fields["integers"] = tuple(integers[:n_integers])
    fields["reals"] = tuple(_reals(row, n_reals))
    a_node = width * (2 if kind == _COMPLEX else 1)
    nodes, data = [], []
    for line in row:
        nodes.append(_whole_line(line)[0])
        data.append(_reals(row, a_node))
    values = np.array(data, dtype=np.float64).reshape(len(nodes), a_node)
    fields["node"] = np.array(nodes, dtype=np.int64)
    fields["data"] = values.view(np.complex128) if kind == _COMPLEX else values
    return fields


def _write_55(fields: Fields) -> Iterator[str]:
    data = np.ascontiguousarray(fields["data"])
    yield from (str(fields[name])[:80] for name in _ID)
    yield _ABOUT_55.written(fields | {"width": data.shape[1]})
    integers, reals = fields["integers"], fields["reals"]
    yield from wholes([len(integers), len(reals), *integers])
    yield from numbers(reals, 13, 5, 6)
    values = data.view(np.float64) if np.iscomplexobj(data) else data
    for node, row in zip(fields["node"].tolist(), values.tolist(), strict=True):
        yield f"{node:10d}"
        yield from numbers(row, 13, 5, 6)


def _whole_line(line: str) -> list[int]:
    parts = [line[i : i + 10].strip() for i in range(0, len(line.rstrip()), 10)]
    return [int(part) for part in parts]


def _reals(rows: Iterator[str], count: int) -> list[float]:
    """`count` numbers of 13 columns, from as many lines as they take."""
    found: list[float] = []
    field = Field("value", "E", 13)
    while len(found) < count:
        line = next(rows).rstrip()
        line_values = [field.parsed(line[i : i + 13]) for i in range(0, len(line), 13)]
        if None in line_values or not line_values:
            raise ValueError(f"{len(found)} of {count} numbers, then an empty field")
        found += [float(v) for v in line_values if v is not None]
    if len(found) > count:
        raise ValueError(f"{len(found)} numbers; expected {count}")
    return found


def _read_82(lines: list[str]) -> Fields:
    fields = _ABOUT_82.parsed(lines[0])
    nodes = [n for line in lines[2:] for n in _whole_line(line)]
    if len(nodes) != fields.pop("count"):
        raise ValueError(f"{len(nodes)} nodes in the trace line; expected as many as it says")
    return {**fields, "id": lines[1].rstrip(), "nodes": np.array(nodes, dtype=np.int64)}


def _write_82(fields: Fields) -> Iterator[str]:
    yield _ABOUT_82.written(fields | {"count": len(fields["nodes"])})
    yield str(fields["id"])[:80]
    yield from wholes(fields["nodes"].tolist())


def _read_cards(cards: tuple[Card, ...], lines: list[str]) -> Fields:
    given = [*lines, *[""] * (len(cards) - len(lines))]
    return {k: v for c, line in zip(cards, given, strict=False) for k, v in c.parsed(line).items()}


def _read_164(lines: list[str]) -> Fields:
    factors = [number(part) for line in lines[1:] for part in line.split()]
    if len(factors) != len(_FACTORS_164):
        raise ValueError(f"{len(factors)} factors; expected {', '.join(_FACTORS_164)}")
    return _UNITS_164.parsed(lines[0]) | dict(zip(_FACTORS_164, factors, strict=True))


def _write_164(fields: Fields) -> Iterator[str]:
    yield _UNITS_164.written(fields)
    yield from numbers([fields[name] for name in _FACTORS_164], 25, 17, 3)


def _read_2412(lines: list[str]) -> Fields:
    found, beams, nodes = [], [], []
    row = iter(lines)
    for line in row:
        about = _ELEMENT_2412.parsed(line)
        found.append(about)
        beam = _BEAM_2412.parsed(next(row)) if about["descriptor"] in _BEAMS else {}
        beams.append([beam.get(f.name) or 0 for f in _BEAM_2412.fields])
        held: list[int] = []
        while len(held) < whole(about["count"], "nodes of an element"):
            held += _whole_line(next(row))
        if len(held) > whole(about["count"], "nodes of an element"):
            raise ValueError(f"element {about['element']} has {len(held)} nodes; expected fewer")
        nodes.append(tuple(held))
    return _columns(found, _ELEMENT_COLUMNS) | {
        "beam": np.array(beams, dtype=np.int64).reshape(-1, 3),
        "nodes": tuple(nodes),
    }


def _write_2412(fields: Fields) -> Iterator[str]:
    rows = zip(*(np.asarray(fields[n]).tolist() for n in _ELEMENT_COLUMNS), strict=True)
    for row, beam, nodes in zip(rows, fields["beam"].tolist(), fields["nodes"], strict=True):
        about = dict(zip(_ELEMENT_COLUMNS, row, strict=True))
        yield _ELEMENT_2412.written(about | {"count": len(nodes)})
        if about["descriptor"] in _BEAMS:
            names = [f.name for f in _BEAM_2412.fields]
            yield _BEAM_2412.written(dict(zip(names, beam, strict=True)))
        yield from wholes(nodes, _NODES_A_LINE)


READERS: dict[int, Callable[[list[str]], Fields]] = {
    15: _read_15,
    55: _read_55,
    82: _read_82,
    151: lambda lines: _read_cards(_HEADER_151, lines),
    164: _read_164,
    2411: _read_2411,
    2412: _read_2412,
}
WRITERS: dict[int, Callable[[Fields], Iterator[str]]] = {
    15: _write_15,
    55: _write_55,
    82: _write_82,
    151: lambda fields: (c.written(fields) for c in _HEADER_151),
    164: _write_164,
    2411: _write_2411,
    2412: _write_2412,
}
