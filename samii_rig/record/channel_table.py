"""The table of a bench's sensors: sensitivity, direction, serial number, calibration date.

A CSV file with a row for each channel; or a sheet with a row for each field and a column for each
channel, as the fields of an IEEE 1451.4 transducer's data sheet are printed. Names of fields
are taken as people and that standard's templates write them.
"""

from __future__ import annotations

import csv
import hashlib
import json
import re
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime
from pathlib import Path

from samii_rig.errors import InputError
from samii_rig.files import open_file, reason
from samii_rig.record.maps import ColumnMap, ImportMap
from samii_rig.units import factor, quantity

MAX_BYTES = 1 << 20  # a row has a hundred bytes
_FIELDS = {
    "channel": {"channel", "name", "channel_name", "field", "property"},
    "sensitivity": {
        *("sensitivity", "sens", "sens_ref", "sensitivity_ref"),
        *("sensitivity_ref_condition", "sensitivity_at_reference_condition"),
    },
    "sensitivity_unit": {"sensitivity_unit", "sensitivity_units", "unit", "units"},
    "direction": {"direction", "dir", "axis", "sensitivity_direction"},
    "polarity": {"polarity", "sign", "polarity_sign"},
    "serial_number": {"serial_number", "serial", "serial_no", "serialnum", "sn"},
    "calibration_date": {"calibration_date", "cal_date", "caldate", "calibrated"},
    "manufacturer": {"manufacturer", "manufacturer_id"},
    "model": {"model", "model_number", "model_no", "type"},
}
_NAMES = {alias: name for name, aliases in _FIELDS.items() for alias in aliases}
_TRANSPOSED = {"field", "property"}  # first cell of a sheet whose rows are fields
_EMPTY = {"", "-", "n/a", "na", "none"}
_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%d-%b-%Y", "%d %b %Y")
_SIGNS = {"": 1, "+": 1, "+1": 1, "1": 1, "positive": 1, "-": -1, "-1": -1, "negative": -1}
_DIRECTION = re.compile(r"^(?P<sign>[+-]?) ?(?P<axis>R?[XYZ])(?P<after>[+-]?)$", re.IGNORECASE)
_VALUE = re.compile(r"^(?P<number>[-+0-9.,eE]+)\s*(?P<unit>\D.*)?$")


@dataclass(frozen=True, slots=True)
class Sensor:
    """What the table says of one channel.

    sensitivity : of the signal's unit per unit of the quantity, as `sensitivity_unit` names them
        ("mV/g"); None where the table gives none. direction : "+X", "-RZ", or "".
    calibration_date : ISO 8601, "" where there is no sensitivity.
    """

    channel: str
    sensitivity: float | None = None
    sensitivity_unit: str = ""
    direction: str = ""
    serial_number: str = ""
    calibration_date: str = ""
    manufacturer: str = ""
    model: str = ""

    @property
    def sign(self) -> int:
        """-1 where a positive signal is a motion against the axis."""
        return -1 if self.direction.startswith("-") else 1


@dataclass(frozen=True, slots=True)
class ChannelTable:
    """The table at `path`, whose bytes have this SHA-256."""

    path: str
    sha256: str
    sensors: dict[str, Sensor]


def load_channels(path: Path) -> ChannelTable:
    """The channel table at `path`.

    Raises
    ------
    InputError : naming the table, the channel, the field and what would be right.
    """
    where = str(path)
    try:
        with open_file(path) as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(where, "", reason(error), "a readable channel table") from error
    if len(data) > MAX_BYTES:
        raise InputError(where, "", "over 1 MB", "a channel table under 1 MB")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    cells = _cells(where, text)
    sensors: dict[str, Sensor] = {}
    for row in cells:
        sensor = _sensor(where, row)
        if sensor.channel in sensors:
            raise InputError(where, "channel", sensor.channel, "each channel once")
        sensors[sensor.channel] = sensor
    return ChannelTable(where, hashlib.sha256(data).hexdigest(), sensors)


def _cells(where: str, text: str) -> list[dict[str, str]]:
    """The fields of each channel, by the names of `_FIELDS`; others are left out."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if len(lines) < 2:
        raise InputError(where, "", f"{len(lines)} lines", "names of fields, and a channel")
    delimiter = max(";", "\t", ",", key=lines[0].count)
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)]
    except csv.Error as error:
        raise InputError(where, "", str(error), "a table") from error
    width = len(rows[0])
    for number, row in enumerate(rows, 1):
        if len(row) != width:
            expected = f"{width}, as in the first; is a decimal comma not in quotes?"
            raise InputError(where, f"cells of row {number}", len(row), expected)
    if _plain(rows[0][0]) in _TRANSPOSED:
        rows = [list(column) for column in zip(*rows, strict=True)]
    names = []
    for label in rows[0]:
        match = re.match(r"^(?P<name>[^\[]*)\[(?P<unit>[^\]]+)\]$", label)
        name = _NAMES.get(_plain(match["name"] if match else label), "")
        if match and name == "sensitivity":
            name = f"sensitivity[{match['unit'].strip()}"
        names.append(name)
    if "channel" not in names:
        raise InputError(where, "names of fields", rows[0], "a column 'channel' among them")
    return [dict(zip(names, row, strict=True)) for row in rows[1:]]


def _plain(label: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")


def _sensor(where: str, row: dict[str, str]) -> Sensor:
    given = {k: "" if v.lower() in _EMPTY else v for k, v in row.items() if k}
    polarity = row.get("polarity", "")  # whose "-" is no empty cell
    channel = given.get("channel", "")
    if not channel:
        raise InputError(where, "channel", row.get("channel"), "the name of a channel")
    for key in [key for key in given if key.startswith("sensitivity[")]:
        given["sensitivity"] = given[key]
        given.setdefault("sensitivity_unit", key.removeprefix("sensitivity["))
    sensitivity, unit = _sensitivity(where, channel, given)
    calibrated = _date(where, channel, given.get("calibration_date", ""))
    if sensitivity is not None and not calibrated:
        expected = "the day of the calibration that gave the sensitivity, as 2026-11-23"
        raise InputError(where, f"channel {channel!r}: calibration_date", "missing", expected)
    return Sensor(
        channel,
        sensitivity,
        unit,
        _direction(where, channel, given.get("direction", ""), polarity),
        given.get("serial_number", ""),
        calibrated,
        given.get("manufacturer", ""),
        given.get("model", ""),
    )


def _sensitivity(where: str, channel: str, given: dict[str, str]) -> tuple[float | None, str]:
    text = given.get("sensitivity", "")
    if not text:
        return None, ""
    field = f"channel {channel!r}: sensitivity"
    match = _VALUE.match(text)
    try:
        value = float((match["number"] if match else text).replace(",", "."))
    except ValueError as error:
        raise InputError(
            where, field, text, "a number, as 10.2, or with its unit, 10.2 mV/g"
        ) from error
    if not (abs(value) > 0 and abs(value) < float("inf")):
        raise InputError(where, field, value, "a number other than 0")
    unit = ((match["unit"] if match else None) or given.get("sensitivity_unit", "")).strip()
    signal, _, measured = unit.partition("/")
    if not (quantity(signal) and quantity(measured)):
        expected = "a signal over a quantity, as mV/g or V/(m/s^2)"
        raise InputError(where, f"{field}_unit", unit or "missing", expected)
    return value, unit


def _date(where: str, channel: str, text: str) -> str:
    if not text:
        return ""
    field = f"channel {channel!r}: calibration_date"
    for form in _DATES:
        try:
            found = datetime.strptime(text, form).date()
        except ValueError:
            continue
        if found > date.today():
            raise InputError(where, field, text, "a day that is not in the future")
        return found.isoformat()
    raise InputError(where, field, text, "a day as 2026-11-23")


def _direction(where: str, channel: str, text: str, polarity: str) -> str:
    if polarity.lower() not in _SIGNS:
        raise InputError(where, f"channel {channel!r}: polarity", polarity, "positive or negative")
    sign = _SIGNS[polarity.lower()]
    if not text:
        return "-" if sign < 0 else ""
    match = _DIRECTION.match(text)
    if not match or (match["sign"] and match["after"]):
        expected = "+X, -X, +Y, ... or +RX, ... for an angle"
        raise InputError(where, f"channel {channel!r}: direction", text, expected)
    sign *= -1 if "-" in (match["sign"], match["after"]) else 1
    return ("-" if sign < 0 else "+") + match["axis"].upper()


def calibrated(layout: ImportMap, table: ChannelTable, units: dict[str, str]) -> ImportMap:
    """The map with the table's sensitivities and directions applied, and the table kept in its
    metadata.

    units : what the file itself states of its columns.

    Raises InputError for a sensor that the table lacks, a map that scales it itself, a unit that
    the sensitivity does not fit.
    """
    named = {c.name for c in layout.channel} | {c.column for c in layout.channel}
    for name in table.sensors:
        if name not in named:
            expected = f"one of {', '.join(c.name for c in layout.channel)}, the map's channels"
            raise InputError(table.path, "channel", name, expected)
    channels = []
    held: dict[str, dict[str, object]] = {}
    for channel in layout.channel:
        sensor = table.sensors.get(channel.name) or table.sensors.get(channel.column)
        if sensor is None:
            if channel.role == "sensor":
                expected = "a row with its sensitivity and calibration date"
                raise InputError(table.path, f"channel {channel.name!r}", "missing", expected)
            channels.append(channel)
            continue
        scale = _scale(table.path, channel, sensor, units.get(channel.column, ""))
        held[channel.name] = {**asdict(sensor), "channel": channel.name, "scale": scale}
        channels.append(channel.model_copy(update={"scale": scale}))
    about = {
        "channel_table": Path(table.path).name,
        "channel_table_sha256": table.sha256,
        "channel_table_read": datetime.now(UTC).isoformat(timespec="seconds"),
        "calibrations": json.dumps(held, ensure_ascii=False),
    }
    return layout.model_copy(
        update={"channel": tuple(channels), "metadata": layout.metadata | about}
    )


def _scale(where: str, channel: ColumnMap, sensor: Sensor, stated: str) -> float:
    """What the column is multiplied by: value = (raw - offset) * scale."""
    field = f"channel {channel.name!r}"
    raw = channel.raw_unit or stated
    already = factor(raw, channel.unit) if raw else None
    if sensor.sensitivity is None:
        if channel.scale != 1.0 or not raw:
            return channel.scale * sensor.sign
        if already is None:
            expected = f"a number, as the column is in {raw} and the channel in {channel.unit}"
            raise InputError(where, f"{field}: sensitivity", "missing", expected)
        return already * sensor.sign
    if channel.scale not in (1.0, already):  # from one unit to the other a map may convert
        expected = "no scale in the map where the table gives a sensitivity"
        raise InputError(where, f"{field}: scale in the map", channel.scale, expected)
    signal, _, measured = sensor.sensitivity_unit.partition("/")
    if not raw:
        expected = f"raw_unit in the map, the unit of its column: {signal}, or what it is"
        raise InputError(where, f"{field}: unit of the column", "missing", expected)
    to_unit = factor(measured, channel.unit)
    if to_unit is None:
        expected = f"{channel.unit} under the line, the channel's unit, or what converts to it"
        raise InputError(where, f"{field}: sensitivity_unit", sensor.sensitivity_unit, expected)
    if already is not None:
        return already * sensor.sign  # the acquisition applied the sensitivity itself
    to_signal = factor(raw, signal)
    if to_signal is None:
        expected = f"{signal}, the sensitivity's, or {measured}"
        raise InputError(where, f"{field}: unit of the column", raw, expected)
    return to_signal / sensor.sensitivity * to_unit * sensor.sign
