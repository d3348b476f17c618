"""Calibration of a driver's inputs and of the valve's null, written into a copy of the rig file."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.schema import Rig

TABLES = ("encoder", "adc")  # of [device.settings], where inputs are wired
SAME = 1e-9  # of a gain: two readings that differ by less are one


@dataclass(frozen=True, slots=True)
class Wiring:
    """value = (counts - offset)/counts_per_unit of one input."""

    counts_per_unit: float
    offset: int

    def counts(self, value: float) -> float:
        """Of a value in the sensor's unit."""
        return value * self.counts_per_unit + self.offset


def wiring(rig: Rig, sensor: str) -> Wiring:
    """As the rig file has it; InputError if its driver has no such input."""
    for table in TABLES:
        inputs = rig.device.settings.get(table, {})
        if isinstance(inputs, dict) and sensor in inputs:
            found = inputs[sensor]
            return Wiring(float(found["counts_per_unit"]), int(found.get("offset", 0)))
    names = [n for t in TABLES for n in rig.device.settings.get(t, {})]
    expected = f"an input of [device.settings]: {', '.join(names) or 'it has none'}"
    raise InputError(rig.name, "calibrate", sensor, expected)


def one_point(old: Wiring, read: float, known: float) -> Wiring:
    """The offset from one known value: what was read as `read` is `known`."""
    return Wiring(old.counts_per_unit, round(old.counts(read) - known * old.counts_per_unit))


def two_points(old: Wiring, read: tuple[float, float], known: tuple[float, float]) -> Wiring:
    """Gain and offset from two known values; InputError if they are the same."""
    (a, b), (x, y) = (old.counts(r) for r in read), known
    if abs(y - x) == 0.0 or abs(b - a) <= SAME * max(abs(a), abs(b), 1.0):
        expected = "two different values, and a sensor that follows them"
        raise InputError("calibrate", "--reads", known, expected)
    gain = (b - a) / (y - x)
    return Wiring(gain, round(a - gain * x))


def null_volts(theta: np.ndarray, rate_hz: float, turning: float) -> float:
    """The output at which the joint stands still, from its drift at zero output.

    theta : (n,) at `rate_hz`, the loop open. turning : its rate for one unit of the output.
    """
    slope = float(np.polyfit(np.arange(len(theta)) / rate_hz, theta, 1)[0])
    return -slope / turning


def rewritten(text: str, where: str, sensor: str, new: Wiring) -> str:
    """The rig file's text with one input's numbers replaced.

    InputError if the input does not stand on one line `NAME = { ... }`.
    """
    found = _row(text, where, sensor)
    inside = found[2]
    inside = re.sub(
        r"counts_per_unit\s*=\s*[^,}]+?(\s*)(,|$)",
        lambda m: f"counts_per_unit = {new.counts_per_unit!r}{m[1]}{m[2]}",
        inside,
    )
    if re.search(r"offset\s*=", inside):
        inside = re.sub(r"offset\s*=\s*[-\d_]+", f"offset = {new.offset}", inside)
    else:
        inside = f"{inside.rstrip()}, offset = {new.offset} "
    return _checked(text[: found.start(2)] + inside + text[found.end(2) :], where)


def _row(text: str, where: str, name: str) -> re.Match[str]:
    """The one line `NAME = { ... }` of an input or an output; its inside is group 2."""
    row = re.compile(rf"^({re.escape(name)}\s*=\s*\{{)(.*)(\}}[^}}]*)$", re.MULTILINE)
    found = [m for m in row.finditer(text) if "counts_per_unit" in m[2]]
    if len(found) != 1:
        expected = f"one line {name} = {{ index = ..., counts_per_unit = ... }}"
        raise InputError(where, f"device.settings, {name}", len(found), expected)
    return found[0]


def rewritten_null(text: str, where: str, null: int, actuator: str = "") -> str:
    """The rig file's text with `null` of [device.settings] replaced or added; of an `actuator` with
    a line of its own in the table of outputs, there.

    InputError if there is no such table, or no such line.
    """
    if actuator:
        found = _row(text, where, actuator)
        inside, n = re.subn(r"\bnull\s*=\s*-?\d+", f"null = {null}", found[2])
        inside = inside if n else f"{inside.rstrip()}, null = {null} "
        return _checked(text[: found.start(2)] + inside + text[found.end(2) :], where)
    head = "[device.settings]"
    if text.count(head) != 1:
        raise InputError(where, head, text.count(head), "one such table to hold null")
    start = text.index(head) + len(head)
    following = re.search(r"^\[", text[start:], re.MULTILINE)
    end = start + following.start() if following else len(text)
    table, n = re.subn(r"^null\s*=\s*-?\d+", f"null = {null}", text[start:end], flags=re.MULTILINE)
    if not n:
        table = f"\nnull = {null}{table}"
    return _checked(text[:start] + table + text[end:], where)


def _checked(text: str, where: str) -> str:
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(where, "", str(error), "valid TOML after the change") from error
    return text
