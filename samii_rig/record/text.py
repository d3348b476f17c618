"""Lines and labels as foreign programs write them."""

from __future__ import annotations

import re

_UNIT = re.compile(r"^(?P<name>.*\S)\s*\[(?P<unit>[^\[\]]*)\]$")


def decoded(raw: bytes) -> str:
    """A line without its end, in the encoding in which it makes sense."""
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    return text.removeprefix("\ufeff").strip("\r\n")


def labelled(labels: list[str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Names of columns and, by name, the units that `theta [rad]` states."""
    names, units = [], {}
    for label in labels:
        match = _UNIT.match(label)
        names.append(match["name"].strip() if match else label)
        if match:
            units[names[-1]] = match["unit"].strip()
    return tuple(names), units
