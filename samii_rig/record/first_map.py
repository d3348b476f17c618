"""A first map of a foreign file: what its description shows, the rest with a question."""

from __future__ import annotations

import json
import re
from pathlib import Path

from samii_rig.errors import InputError
from samii_rig.record.describe import Column, Description
from samii_rig.record.maps import Format
from samii_rig.rig.schema.conversion import SENSOR_UNITS
from samii_rig.types import Role
from samii_rig.units import factor, quantity

_MAX_NAME = 40  # characters of a channel's name, as the map's schema has it
# Names that people give to what was chosen and to what went out, in lower case.
_REFERENCES = {"u", "ref", "reference", "setpoint", "excitation", "soll", "w"}
_SET_POINTS = "theta_ref"  # beside u, or one a joint: as our own recordings name them
_COMMANDS = {"v", "cmd", "command", "drive", "output", "voltage", "current"}
_LEVELS = {"level", "amp", "amplitude", "stufe"}
_NUMBERS = {"segment", "seg", "run", "test", "part", "burst"}
# The keys of [format] in the order in which a person thinks of them.
_KEYS = (
    *("kind", "under", "variable", "delimiter", "decimal", "header", "units_row"),
    *("columns", "skip_lines", "comment"),
)
_IN_NAME = re.compile(r"(?P<before>amp|level|lvl)(?P<between>[-_]?)\d+([.]\d+)?", re.IGNORECASE)


def first_map(found: Description) -> str:
    """The TOML text of a map that imports the file without an edit, where the file allows it.

    What the file does not say is guessed and marked with a comment. InputError for a file without
    a column to import.
    """
    if not found.columns:
        raise InputError(found.path, "columns", 0, "a column of numbers or a time response")
    path = Path(found.path)
    lines = [
        f"# First map of {_plain(path.name)}; check what is marked with a question.",
        "",
        f"name = {_quoted(path.stem)}",
        "",
        "[format]",
        *_format(found.format),
        "",
        "[time]",
        *_time(found),
    ]
    channels = [c for c in found.columns if c.name not in (found.time, found.sequence)]
    dividing = [c for c in channels if c.levels and c.name.lower() in _LEVELS | _NUMBERS]
    channels = [c for c in channels if c not in dividing and c.samples == found.samples]
    taken: set[str] = set()
    roles = _roles(channels)
    for column in channels:
        driven = "command" in roles.values()
        lines += ["", "[[channel]]", *_channel(column, roles[column.name], taken, driven)]
    lines += ["", "[segment]", *_segment(path, channels, dividing, roles)]
    return "\n".join(lines) + "\n"


def _format(layout: Format) -> list[str]:
    given = layout.model_dump(exclude_defaults=True)
    if layout.kind in ("csv", "text"):
        given["header"] = getattr(layout, "header", "none")
    return [f"{key} = {_value(given[key])}" for key in sorted(given, key=_KEYS.index)]


def _time(found: Description) -> list[str]:
    lines = []
    if found.time:
        lines.append(f"column = {_quoted(found.time)}")
        asked = "  # the file does not say: is it?" if found.unit_guessed else ""
        lines.append(f'unit = "{found.time_unit}"{asked}')
    if found.sequence:
        lines.append(f"sequence = {_quoted(found.sequence)}")
    if found.time and found.rate_hz:
        lines.append(f"rate_hz = {found.rate_hz!r}")
    if not found.time and found.format.kind != "uff58":
        lines.append("# rate_hz = 1000.0  # the file does not say the rate: which is it?")
    return lines


def _roles(channels: list[Column]) -> dict[str, Role]:
    """A role by column, from its name; one command at most, and one reference beside set points."""
    roles: dict[str, Role] = {
        c.name: "reference" if c.name.lower().startswith(_SET_POINTS) else "sensor"
        for c in channels
    }
    kinds: tuple[tuple[set[str], Role], ...] = ((_REFERENCES, "reference"), (_COMMANDS, "command"))
    for names, role in kinds:
        first = next((c.name for c in channels if c.name.lower() in names), "")
        if first:
            roles[first] = role
    return roles


def _channel(column: Column, role: Role, taken: set[str], driven: bool) -> list[str]:
    name = re.sub(r"[^A-Za-z0-9]+", "_", column.name).strip("_")[: _MAX_NAME - 4] or "channel"
    if not name[0].isalpha():
        name = f"c_{name}"
    base, n = name, 2
    while name in taken:
        name, n = f"{base}_{n}", n + 1
    taken.add(name)
    lines = [f"column = {_quoted(column.name)}", f'name = "{name}"']
    asked = "" if column.unit else "  # the file does not say: which is it?"
    unit, scale = _in_si(column, role)
    lines.append(f"unit = {_quoted(unit or '1')}{asked}")
    if unit != column.unit:
        lines.append(f"raw_unit = {_quoted(column.unit)}")
        if scale != 1.0:
            lines.append(f"scale = {scale!r}  # {_plain(unit)} in 1 {_plain(column.unit)}")
    if role == "sensor":
        asked = "" if driven else '  # one must be "command", what drives the rig: is it?'
        lines.append(f'role = "sensor"{asked}')
    else:
        lines.append(f'role = "{role}"  # by its name: is it?')
    if column.step:
        # Rounded, so that a step of 0.001 g is not one of 0.009806650000000001 m/s^2.
        lines.append(f"resolution = {float(f'{column.step * scale:.12g}')!r}")
    return lines


def _in_si(column: Column, role: Role) -> tuple[str, float]:
    """Unit of its channel, and the scale to it: a sensor in g, mm or deg becomes one in the SI unit
    that a rig file reckons in. What goes out keeps its unit, which is the actuator's own."""
    if role == "sensor":
        for unit in sorted({*SENSOR_UNITS.values()}):
            scale = factor(column.unit, unit)
            if scale is not None and quantity(column.unit) == quantity(unit):
                return unit, scale
    return column.unit, 1.0


def _segment(
    path: Path, channels: list[Column], dividing: list[Column], roles: dict[str, Role]
) -> list[str]:
    driven = next((c for c in channels if roles[c.name] != "sensor"), next(iter(channels), None))
    unit, scale = _in_si(driven, roles[driven.name]) if driven else ("", 1.0)
    unit = unit or "1"
    lines = ['kind = "single"  # or burst, periodic, transient: what was done?']
    levels = next((c for c in dividing if c.name.lower() in _LEVELS and min(c.levels) >= 0), None)
    numbers = next((c for c in dividing if c.name.lower() in _NUMBERS), None)
    if numbers:
        lines.append(f"column = {_quoted(numbers.name)}")
        if 0.0 in numbers.levels:
            lines.append("pause = 0.0  # is nothing done where it is 0?")
    if levels:
        lines.append(f"level_column = {_quoted(levels.name)}")
    else:
        peak = scale * max(abs(driven.low), abs(driven.high)) if driven else 0.0
        asked = f"  # peak of {_plain(driven.name)}: is it the level?" if driven else ""
        lines.append("# A level says which files were driven alike. Where it means nothing, as for")
        lines.append("# noise or an earthquake, write 1.0: one number for all files.")
        lines.append(f"level = {float(f'{peak:.6g}')!r}{asked}")
        hint = _IN_NAME.search(path.name)
        if hint and not numbers:
            pattern = f"{hint['before']}{hint['between']}(?P<level>\\d+(\\.\\d+)?)"
            lines.append(f"# level = '{pattern}'  # or is it in the files' names?")
    return [*lines, f"level_unit = {_quoted(unit)}"]


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(_value(v) for v in value)}]"
    return repr(value)


def _quoted(text: str) -> str:
    """A basic string of TOML, whose escapes are JSON's."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _plain(text: str) -> str:
    """Text for a comment, which ends with its line."""
    return "".join(c if c.isprintable() else "?" for c in text)
