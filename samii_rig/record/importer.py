"""Recordings that others made, as recordings of ours.

Nothing is repaired: a sample that the file does not hold is a jump in the sequence
numbers, as it is in a recording of our own, and the estimators decide what to do about it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from samii_rig.errors import InputError
from samii_rig.files import open_file, reason
from samii_rig.record.channel_table import ChannelTable, calibrated
from samii_rig.record.delimited import read_text_table
from samii_rig.record.maps import (
    ColumnMap,
    CsvFormat,
    ImportMap,
    JsonFormat,
    MatFormat,
    ParquetFormat,
    TextFormat,
    UffFormat,
)
from samii_rig.record.segmenting import segments_of
from samii_rig.record.structured import read_json_table, read_parquet_table
from samii_rig.record.tables import Table, read_mat_table, read_uff_table
from samii_rig.rig.load import load_rig
from samii_rig.types import Channel, Flags, Float, Int, Quality, Recording, StopRecord

_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_LAST_SECOND = 9.2e9  # s, int64 nanoseconds end a little later
_LAST_COUNT = 2.0**53  # beyond it a float64 column cannot count samples
# A step of a time column may be off a whole number of periods by this many periods: a
# column rounded to its last digit is, and beyond it gap and jitter cannot be distinguished.
_JITTER = 0.25
# ns, 30 years: no device has run for so long, so that a time beyond it counts from 1970.
_COUNTS_FROM_1970 = 30 * 365 * 86_400 * 1_000_000_000


def import_file(
    path: Path | str,
    layout: ImportMap,
    map_text: str = "",
    sensors: ChannelTable | None = None,
) -> Recording:
    """The file at `path` as a recording, as the map `layout` says.

    map_text : the map file as it is, kept in the recording's metadata. sensors : the table of the
        bench's sensors, whose sensitivities are applied; it is kept in the metadata, too.

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
    if sensors is not None:
        layout = calibrated(layout, sensors, table.units)
    _check_units(table, layout)
    first = next(iter(table.columns.values()))
    for column, data in table.columns.items():
        if data.size != first.size:
            raise InputError(where, column, f"{data.size} samples", f"{first.size} samples")
    if first.size < 2:
        raise InputError(where, "", f"{first.size} samples", "at least two")
    rate_hz, time, sequence = _time_base(table, layout)
    offset, dated = _date(layout, time)
    values = np.stack([_scaled(table, c) for c in layout.channel], axis=1)
    channels = tuple(_channel(c) for c in layout.channel)
    lost = int(sequence[-1] - sequence[0]) + 1 - len(sequence)
    return Recording(
        channels=channels,
        rate_hz=rate_hz,
        time=time,
        sequence=sequence,
        values=values,
        quality=_quality(values, channels),
        segments=segments_of(path, layout.segment, table, sequence, time),
        rig_toml=_rig_text(layout),
        metadata={
            **dated,
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
        clock_offset=offset,
    )


def _date(layout: ImportMap, time: Int) -> tuple[int, dict[str, str]]:
    """ns by which the wall clock was ahead of the file's, and when it began, where known."""
    offset = 0
    if layout.time.start is not None:
        seconds = int(layout.time.start.timestamp())
        begin = seconds * 1_000_000_000 + layout.time.start.microsecond * 1000
        offset = begin - int(time[0])
    elif time[0] < _COUNTS_FROM_1970:
        return 0, {}
    first = datetime.fromtimestamp((int(time[0]) + offset) * 1e-9, UTC)
    return offset, {"started": first.isoformat(timespec="seconds")}


def _digest(path: Path) -> str:
    try:
        with open_file(path) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        said = f"cannot be read: {reason(error)}; expected a file to import"
        raise InputError.saying(str(path), "", said) from error


def _read(path: Path, layout: ImportMap) -> Table:
    wanted = [c.column for c in layout.channel]
    wanted += [name for name in (layout.time.column, layout.time.sequence) if name]
    wanted += layout.segment.columns
    wanted = list(dict.fromkeys(wanted))
    match layout.format:
        case TextFormat() | CsvFormat():
            table = read_text_table(path, layout.format, wanted)
        case MatFormat():
            table = read_mat_table(path, layout.format, wanted)
        case UffFormat():
            table = read_uff_table(path, wanted)
        case JsonFormat():
            table = read_json_table(path, layout.format, wanted)
        case ParquetFormat():
            table = read_parquet_table(path, wanted)
    return table


def _check_units(table: Table, layout: ImportMap) -> None:
    """InputError where the file states another unit than the map."""
    for channel in layout.channel:
        stated, expected = table.units.get(channel.column, ""), channel.unit_in_file()
        if stated and expected and stated != expected:
            raise InputError(
                table.where, f"unit of column {channel.column!r}", stated, f"{expected!r}"
            )
    stated = table.units.get(layout.time.column, "")
    if stated and stated != layout.time.unit:
        raise InputError(table.where, "unit of time", stated, f"{layout.time.unit!r}")


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
            expected = (
                f"a whole number of periods at {rate:g} Hz after the sample before; "
                "where the clock that stamped them was unsteady, a map without time.column"
            )
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


def _quality(values: Float, channels: Sequence[Channel]) -> Flags:
    """Samples at the end of a converter's range, but of no column that reads more than that."""
    low = np.array([c.low for c in channels])
    high = np.array([c.high for c in channels])
    clipped = (values <= low) | (values >= high)
    clipped[:, [bool(c.beyond(x)) for c, x in zip(channels, values.T, strict=True)]] = False
    return np.where(clipped, Quality.CLIPPED, Quality.GOOD).astype(np.uint8)


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
