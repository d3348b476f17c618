"""Units as a rig file writes them, to those that the project reckons in.

Parameters of elements convert themselves (`base.Quantity`), but for the gain of a source, whose
unit depends on its input. Sensors, limits and loops are tables of several numbers in one unit:
they are converted here, before anything else is looked at. What has no factor is left for
the check that names it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

from samii_rig.rig.schema import sensors
from samii_rig.rig.schema.elements import input_unit
from samii_rig.units import convert

Table = dict[str, Any]

SENSOR_UNITS = {
    get_args(kind.model_fields["kind"].annotation)[0]: kind.si_unit
    for kind in get_args(get_args(sensors.Sensor)[0])
}
IN_SENSOR_UNIT = ("noise_rms", "resolution", "offset", "low", "high")


def in_si(data: Any) -> Any:
    """The tables of a rig file with every number in its SI unit; anything else as it came.

    Raises ValueError for a sensor of a real device in another unit than the SI one: the scales
    in the device's settings count in the sensor's unit.
    """
    if not isinstance(data, dict):
        return data
    out = dict(data)
    written = _units(data)
    if isinstance(data.get("sensor"), list | tuple):
        _refuse_scaled(data)
        out["sensor"] = [_each(x, _sensor) for x in data["sensor"]]
    units = _units(out)
    for key, change in (
        ("element", lambda t: _source(t, units)),
        ("actuator", lambda t: _actuator(t, written, units)),
        ("limit", lambda t: _limit(t, units)),
        ("agreement", lambda t: _agreement(t, written, units)),
        ("feedback", lambda t: _feedback(t, written, units)),
    ):
        if isinstance(data.get(key), list | tuple):
            out[key] = [_each(x, change) for x in data[key]]
    if isinstance(data.get("centring"), dict):
        out["centring"] = _centring(data["centring"], written, units)
    return out


def _each(item: Any, change: Callable[[Table], Table]) -> Any:
    return change(item) if isinstance(item, dict) else item


def _units(data: Table) -> dict[str, str]:
    """Units of actuators, sensors and monitors by name, as far as they are given."""
    out = {}
    for key in ("actuator", "sensor", "monitor"):
        items = data.get(key)
        for item in items if isinstance(items, list | tuple) else ():
            if isinstance(item, dict) and isinstance(item.get("unit"), str):
                out[str(item.get("name"))] = item["unit"]
    return out


def _number(table: Table, key: str) -> bool:
    value = table.get(key)
    # A whole number beyond every float is left to the check that refuses it.
    return isinstance(value, float) or (type(value) is int and abs(value) < 10**300)


def _scaled(table: Table, keys: tuple[str, ...], given: str, wanted: str) -> Table:
    """The table with the numbers of `keys` in another unit; infinite ones stay."""
    out = dict(table)
    for key in keys:
        if _number(table, key):
            value = convert(float(table[key]), given, wanted)
            out[key] = table[key] if value is None else value
    return out


def _sensor(table: Table) -> Table:
    given, wanted = table.get("unit"), SENSOR_UNITS.get(str(table.get("kind")), "")
    if not isinstance(given, str) or given == wanted or convert(1.0, given, wanted) is None:
        return table
    return {**_scaled(table, IN_SENSOR_UNIT, given, wanted), "unit": wanted}


def _refuse_scaled(data: Table) -> None:
    device = data.get("device")
    driver = device.get("driver", "simulated") if isinstance(device, dict) else "simulated"
    if driver == "simulated":
        return
    for table in data["sensor"]:
        made = _each(table, _sensor)
        if made is not table:
            raise ValueError(
                f"sensor {table.get('name')}: unit {table['unit']!r} with the driver {driver!r}, "
                f"whose scales count in the sensor's unit; expected {made['unit']!r}"
            )


def _source(table: Table, units: dict[str, str]) -> Table:
    kind, K = str(table.get("kind")), table.get("K")
    known = units.get(str(table.get("input")))
    if known is None or not isinstance(K, dict) or not _number(K, "value"):
        return table
    given, wanted = K.get("unit"), input_unit(kind, known)
    if not isinstance(given, str) or given == wanted:
        return table
    # Files of before write N m/N m for an input in N m.
    pushes = kind in ("torque_source", "force_source")
    if pushes and given == wanted.replace("(", "").replace(")", ""):
        return {**table, "K": {**K, "unit": wanted}}
    value = convert(float(K["value"]), given, wanted)
    if value is None:
        return table
    return {**table, "K": {**K, "value": value, "unit": wanted, "written": given}}


def _limit(table: Table, units: dict[str, str]) -> Table:
    given, wanted = table.get("unit"), units.get(str(table.get("channel")))
    if not isinstance(given, str) or wanted is None or convert(1.0, given, wanted) is None:
        return table
    return {**_scaled(table, ("max", "min", "max_rate"), given, wanted), "unit": wanted}


def _agreement(table: Table, written: dict[str, str], units: dict[str, str]) -> Table:
    name = str(table.get("sensor"))
    if name not in written:
        return table
    return _scaled(table, ("max",), written[name], units[name])


def _centring(table: Table, written: dict[str, str], units: dict[str, str]) -> Table:
    """kp counts in actuator units for each unit of the sensor as the file writes it."""
    name = str(table.get("sensor"))
    if name not in written:
        return table
    return _scaled(table, ("kp",), units[name], written[name])


def _actuator(table: Table, written: dict[str, str], units: dict[str, str]) -> Table:
    loop = table.get("centring")
    return (
        {**table, "centring": _centring(loop, written, units)} if isinstance(loop, dict) else table
    )


def _feedback(table: Table, written: dict[str, str], units: dict[str, str]) -> Table:
    """F(s) is of actuator units for each unit of the sensor, and says so itself."""
    sensor, actuator = str(table.get("sensor")), str(table.get("actuator"))
    given = table.get("unit")
    if sensor not in units or actuator not in units or not isinstance(given, str):
        return table
    if given != f"{units[actuator]}/({written[sensor]})" or written[sensor] == units[sensor]:
        return table
    out = _scaled(table, ("gain",), units[sensor], written[sensor])
    return {**out, "unit": f"{units[actuator]}/({units[sensor]})"}
