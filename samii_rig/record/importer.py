"""Recordings that others made, as recordings of ours.

Nothing is repaired: a sample that the file does not hold is a jump in the sequence
numbers, as it is in a recording of our own, and the estimators decide what to do about it.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np

from samii_rig.errors import InputError
from samii_rig.record.maps import (
    ColumnMap,
    CsvFormat,
    ImportMap,
    MatFormat,
    TextFormat,
    UffFormat,
)
from samii_rig.record.tables import Table, read_mat_table, read_text_table, read_uff_table
from samii_rig.rig.load import load_rig
from samii_rig.types import Channel, Flags, Float, Int, Quality, Recording, Segment, StopRecord

_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_LAST_SECOND = 9.2e9  # s, int64 nanoseconds end a little later
_LAST_COUNT = 2.0**53  # beyond it a float64 column cannot count samples
# A step of a time column may be off a whole number of periods by this many periods: a
# column rounded to its last digit is, and beyond it gap and jitter cannot be told apart.
_JITTER = 0.25


def import_file(path: Path | str, layout: ImportMap, map_text: str = "") -> Recording:
    """The file at `path` as a recording of one segment, as the map `layout` says.

    map_text : the map file as it is, kept in the recording's metadata.

    Raises
    ------
    InputError : naming the file, the line, the column and what would be right.
    """
    path = Path(path)
    where = str(path)
    digest = _digest(path)
    if layout.file_name and not re.search(layout.file_name, path.name):
        expected = f"a name with {layout.file_name!r} (the map {layout.name!r} is for those)"
        raise InputError(where, "file name", path.name, expected)
    table = _read(path, layout)
    first = next(iter(table.columns.values()))
    for column, data in table.columns.items():
        if data.size != first.size:
            raise InputError(where, column, f"{data.size} samples", f"{first.size} samples")
    if first.size < 2:
        raise InputError(where, "", f"{first.size} samples", "at least two")
    rate_hz, time, sequence = _time_base(table, layout)
    values = np.stack([_scaled(table, c) for c in layout.channel], axis=1)
    lost = int(sequence[-1] - sequence[0]) + 1 - len(sequence)
    return Recording(
        channels=tuple(_channel(c) for c in layout.channel),
        rate_hz=rate_hz,
        time=time,
        sequence=sequence,
        values=values,
        quality=_quality(values, layout),
        segments=(_segment(path, layout, int(sequence[0]), int(sequence[-1]) + 1),),
        rig_toml=_rig_text(layout),
        metadata={
            **layout.metadata,
            "import_file": path.name,
            "import_sha256": digest,
            "import_map_name": layout.name,
            "description": layout.description,
            "import_map": map_text,
            "import_header": "\n".join(table.header),
        },
        stop=StopRecord("unknown", "imported; the file does not say how it ended", 0, lost),
        source=where,
    )


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(str(path), "", error.strerror, "a readable file") from error


def _read(path: Path, layout: ImportMap) -> Table:
    wanted = [c.column for c in layout.channel]
    wanted += [name for name in (layout.time.column, layout.time.sequence) if name]
    wanted = list(dict.fromkeys(wanted))
    match layout.format:
        case TextFormat() | CsvFormat():
            table = read_text_table(path, layout.format, wanted)
        case MatFormat():
            table = read_mat_table(path, layout.format, wanted)
        case UffFormat():
            table = read_uff_table(path, layout.format, wanted)
    for channel in layout.channel:
        stated, expected = table.units.get(channel.column, ""), channel.unit_in_file()
        if stated and expected and stated != expected:
            raise InputError(
                table.where, f"unit of column {channel.column!r}", stated, f"{expected!r}"
            )
    stated = table.units.get(layout.time.column, "")
    if stated and stated != layout.time.unit:
        raise InputError(table.where, "unit of time", stated, f"{layout.time.unit!r}")
    return table


def _time_base(table: Table, layout: ImportMap) -> tuple[float, Int, Int]:
    """Rate, ns and sequence numbers of the samples; the last two strictly increasing."""
    base = layout.time
    seconds: Float | None = None
    if base.column:
        seconds = table.columns[base.column] / _PER_SECOND[base.unit]
        _increasing(table, base.column, seconds, "time runs backwards", _LAST_SECOND)
    count: Float | None = None
    if base.sequence:
        count = table.columns[base.sequence]
        bad = np.flatnonzero(count != np.rint(count))
        if bad.size:
            place = table.place(int(bad[0]), base.sequence)
            raise InputError(table.where, place, float(count[bad[0]]), "a whole number")
        _increasing(table, base.sequence, count, "the count runs backwards", _LAST_COUNT)
    rate = base.rate_hz or table.rate_hz
    if seconds is not None:
        per_sample = np.diff(seconds) / (1.0 if count is None else np.diff(count))
        found = 1.0 / float(np.median(per_sample))
        if rate is None:
            rate = found
        elif abs(found / rate - 1.0) > 0.01:
            raise InputError(
                table.where,
                f"rate in column {base.column!r}",
                round(found, 3),
                f"{rate:g} Hz within 1 %, as the map says; check the unit of time",
            )
    elif base.rate_hz and table.rate_hz and abs(table.rate_hz / base.rate_hz - 1.0) > 0.01:
        raise InputError(table.where, "rate", table.rate_hz, f"{base.rate_hz:g} Hz within 1 %")
    if rate is None or not np.isfinite(rate):
        raise InputError(table.where, "rate_hz", rate, "a rate in the map or a time column")
    if count is None and seconds is not None:
        steps = np.diff(seconds) * rate
        off = np.flatnonzero((np.abs(steps - np.rint(steps)) > _JITTER) | (steps < 0.5))
        if off.size:
            place = table.place(int(off[0]) + 1, base.column)
            expected = f"a whole number of periods at {rate:g} Hz after the sample before"
            raise InputError(table.where, place, float(seconds[off[0] + 1]), expected)
        count = np.concatenate([[0.0], np.cumsum(np.rint(steps))])
    if count is None:
        count = np.arange(next(iter(table.columns.values())).size, dtype=np.float64)
    sequence = count.astype(np.int64)
    if seconds is None:
        seconds = sequence / rate
    if not abs(seconds[-1]) < _LAST_SECOND:
        raise InputError(table.where, "time", float(seconds[-1]), f"less than {_LAST_SECOND:g} s")
    return float(rate), np.rint(seconds * 1e9).astype(np.int64), sequence


def _increasing(table: Table, column: str, values: Float, what: str, end: float) -> None:
    big = np.flatnonzero(np.abs(values) >= end)
    if big.size:
        place = table.place(int(big[0]), column)
        raise InputError(table.where, place, float(values[big[0]]), f"less than {end:g}")
    back = np.flatnonzero(np.diff(values) <= 0)
    if back.size:
        place = table.place(int(back[0]) + 1, column)
        expected = f"more than {values[back[0]]:.15g} in the sample before ({what})"
        raise InputError(table.where, place, float(values[back[0] + 1]), expected)


def _scaled(table: Table, channel: ColumnMap) -> Float:
    with np.errstate(over="ignore"):
        values = (table.columns[channel.column] - channel.offset) * channel.scale
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raw = float(table.columns[channel.column][bad[0]])
        place = table.place(int(bad[0]), channel.column)
        raise InputError(table.where, place, raw, "a number that stays finite when scaled")
    return values


def _channel(channel: ColumnMap) -> Channel:
    return Channel(
        channel.name,
        channel.unit,
        channel.role,
        channel.low,
        channel.high,
        channel.resolution,
        channel.description,
    )


def _quality(values: Float, layout: ImportMap) -> Flags:
    low = np.array([c.low for c in layout.channel])
    high = np.array([c.high for c in layout.channel])
    clipped = (values <= low) | (values >= high)
    return np.where(clipped, Quality.CLIPPED, Quality.GOOD).astype(np.uint8)


def _segment(path: Path, layout: ImportMap, start: int, stop: int) -> Segment:
    name = path.name
    kind = layout.segment.kind
    for pattern, named in layout.segment.kind_by_name.items():
        if re.search(pattern, name):
            kind = named
            break
    level = _number(path, layout.segment.level, "level")
    if not (0 <= level < np.inf):
        raise InputError(str(path), "level in the file name", level, "0 or more")
    repeat = 0
    if layout.segment.repeat:
        number = _number(path, layout.segment.repeat, "repeat")
        if number != int(number) or number < layout.segment.first_repeat:
            expected = f"a whole number from {layout.segment.first_repeat}"
            raise InputError(str(path), "repeat in the file name", number, expected)
        repeat = int(number) - layout.segment.first_repeat
    return Segment(path.stem, kind, start, stop, level, layout.segment.level_unit, repeat)


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


def _rig_text(layout: ImportMap) -> str:
    """The rig file that the map names, "" for none; its units must be the map's."""
    if not layout.rig:
        return ""
    rig, text = load_rig(layout.rig)
    units = rig.units()
    for channel in layout.channel:
        if units.get(channel.name, channel.unit) != channel.unit:
            raise InputError(
                f"map {layout.name}",
                f"channel {channel.name}: unit",
                channel.unit,
                f"{units[channel.name]!r}, as in the rig {layout.rig!r}",
            )
    return text
