"""What was done in a foreign file, as segments: all of it, its parts, or what a column says."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from samii_rig.errors import InputError
from samii_rig.record.maps import SegmentMap
from samii_rig.record.tables import Table
from samii_rig.types import Int, Kind, Segment

# A column that changes more often does not number segments: it is a signal.
MAX_SEGMENTS = 1000


def segments_of(
    path: Path, layout: SegmentMap, table: Table, sequence: Int, time: Int
) -> tuple[Segment, ...]:
    """The segments of the file at `path`, whose samples have these numbers and times (ns).

    Raises
    ------
    InputError : a name without its level, a level that is none or that changes inside a
        segment, a part beyond the file, no segment at all.
    """
    kind = next(
        (named for pattern, named in layout.kind_by_name.items() if re.search(pattern, path.name)),
        layout.kind,
    )
    if not layout.divided:
        level, repeat = _whole(path, layout)
        start, stop = int(sequence[0]), int(sequence[-1]) + 1
        return (Segment(path.stem, kind, start, stop, level, layout.level_unit, repeat),)
    found = _parts(path, layout, kind, sequence, time)
    if not layout.part:
        found = _stretches(path, layout, kind, table, sequence)
    if not found:
        raise InputError(str(path), "segments", 0, "at least one; all of the file is pause")
    counted: Counter[tuple[str, float]] = Counter()
    numbered = []
    for number, segment in enumerate(found, 1):
        key = (segment.kind, segment.level)
        name = f"{path.stem}_{number}"
        numbered.append(replace(segment, name=name, repeat=counted[key]))
        counted[key] += 1
    return tuple(numbered)


def _whole(path: Path, layout: SegmentMap) -> tuple[float, int]:
    """Level and repeat of a file that is one segment."""
    level = _level(path, layout)
    if not layout.repeat:
        return level, 0
    number = _number(path, layout.repeat, "repeat")
    if number != int(number) or number < layout.first_repeat:
        expected = f"a whole number from {layout.first_repeat}"
        raise InputError(str(path), "repeat in the file name", number, expected)
    return level, int(number) - layout.first_repeat


def _level(path: Path, layout: SegmentMap) -> float:
    """The level that the map states or the file's name holds."""
    level = layout.level
    if isinstance(level, str):
        level = _number(path, level, "level")
        if level < 0:
            raise InputError(str(path), "level in the file name", level, "0 or more")
    assert level is not None  # a map without it has another source of the level
    return level


def _parts(path: Path, layout: SegmentMap, kind: Kind, sequence: Int, time: Int) -> list[Segment]:
    """The stretches that the map itself states."""
    found = []
    end = int(time[-1] - time[0])
    for part in layout.part:
        if round(part.start * 1e9) > end:
            expected = f"at most {end * 1e-9:g} s, where the file ends"
            raise InputError(str(path), "start of a part", part.start, expected)
        edges = [int(time[0]) + round(edge * 1e9) for edge in (part.start, part.stop)]
        a, b = (int(k) for k in np.searchsorted(time, edges))
        if a == b:
            stretch = f"{part.start:g} to {part.stop:g} s"
            raise InputError(str(path), "part", stretch, "samples in it")
        found.append(
            Segment(
                "",
                part.kind or kind,
                int(sequence[a]),
                int(sequence[b - 1]) + 1,
                part.level,
                layout.level_unit,
            )
        )
    return found


def _stretches(
    path: Path, layout: SegmentMap, kind: Kind, table: Table, sequence: Int
) -> list[Segment]:
    """The stretches in which the dividing column does not change."""
    column = layout.column or layout.level_column
    number = table.columns[column]
    edges = np.flatnonzero(np.diff(number)) + 1
    if len(edges) >= MAX_SEGMENTS:
        expected = f"under {MAX_SEGMENTS}, of a column that numbers segments or holds their level"
        raise InputError(str(path), f"changes of column {column!r}", len(edges), expected)
    found = []
    for a, b in zip([0, *edges.tolist()], [*edges.tolist(), len(number)], strict=True):
        if layout.column and layout.pause is not None and number[a] == layout.pause:
            continue
        level = _level_there(path, layout, table, a, b) if layout.level_column else None
        if level == 0:
            continue
        if level is None:
            level = _level(path, layout)
        found.append(
            Segment("", kind, int(sequence[a]), int(sequence[b - 1]) + 1, level, layout.level_unit)
        )
    return found


def _level_there(path: Path, layout: SegmentMap, table: Table, a: int, b: int) -> float:
    """The level in its column, which must hold from row `a` up to row `b`."""
    levels = table.columns[layout.level_column][a:b]
    level = float(levels[0])
    other = np.flatnonzero(levels != level)
    if other.size:
        place = table.place(a + int(other[0]), layout.level_column)
        expected = f"{level:g} throughout the segment"
        raise InputError(str(path), place, float(levels[other[0]]), expected)
    if level < 0:
        place = table.place(a, layout.level_column)
        raise InputError(str(path), place, level, "a level, 0 or more")
    return level


def _number(path: Path, pattern: str, group: str) -> float:
    match = re.search(pattern, path.name)
    if match is None or match[group] is None:
        expected = f"a name in which {pattern!r} finds the {group}"
        raise InputError(str(path), "file name", path.name, expected)
    try:
        number = float(match[group].replace(",", "."))
    except ValueError as error:
        place = f"{group} in the file name"
        raise InputError(str(path), place, match[group], "a number") from error
    if not np.isfinite(number):
        raise InputError(str(path), f"{group} in the file name", number, "a finite number")
    return number
