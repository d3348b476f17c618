"""Requests and replies of the sensor, by the names that the DBC file gives them.

A reply of several frames comes in the order of its messages. The values of a message are read
by cantools; what the DBC does not hold, this driver does not know.
"""

from __future__ import annotations

import logging
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import cantools.database
import numpy as np
from cantools.database.can import Message, Signal
from cantools.database.can.database import Database

from samii_rig.errors import InputError
from samii_rig.types import Float, Int

# What it has to say of a wrong file is said here as an error.
logging.getLogger("cantools").setLevel(logging.ERROR)

AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
GAUGES = 6
GAUGE_RAILS = (-32768, 32767)  # counts at which a gauge has saturated
MOST_BYTES = 1 << 16  # of a DBC file; one of this sensor has some thousand
# Strings, which stay, and what is neither message, name of a value nor type of a number: there the
# parser counts to whatever number it meets (ranges of a multiplexer, 1e999999999 of an attribute).
STRING = r'"(?:\\"|[^"])*+(?:"|\Z)'
UNREAD = re.compile(
    rf"{STRING}|//[^\n]*|\bNS_\s*:.*?(?=\b\w+\s*:)"
    r"|\b(?:BA_(?:[A-Z]+_)*|CM_|EV_|ENVVAR_DATA_|SG_MUL_VAL_|BO_TX_BU_|SIG_GROUP_|VAL_TABLE_)\s"
    rf'(?:{STRING}|[^";])*+(?:;|\Z)',
    re.DOTALL,
)
# A length in bytes, or a first bit or a length in bits, beyond any frame's: it would allocate them.
BEYOND = re.compile(r":\s*[-+]?0*[1-9]\d{3}|:\s*-|[|]\s*[-+]?0*[1-9]\d{3,}\s*@")
OPERATIONS = 16  # identifiers of one sensor: the base and an operation in four bits
# What each message must have; the status bits are whatever else Gauges_0 has.
NEEDED: dict[str, tuple[str, ...]] = {
    "Gauges_0": ("G0", "G2", "G4"),
    "Gauges_1": ("G1", "G3", "G5"),
    "Matrix_0": ("M0", "M1"),
    "Matrix_1": ("M2", "M3"),
    "Matrix_2": ("M4", "M5"),
    "SerialNumber": ("Serial",),
    "CountsPerUnit": ("PerForce", "PerTorque"),
    "Units": ("ForceUnit", "TorqueUnit"),
    "Firmware": ("Major", "Minor", "Build"),
}
MATRIX = ("Matrix_0", "Matrix_1", "Matrix_2")
SAMPLE = ("Gauges_0", "Gauges_1")
# In N and N m: 1 lbf = 0.45359237 kg x 9.80665 m/s^2, 1 in = 25.4 mm, 1 ft = 12 in.
LBF = 4.4482216152605
FORCE = {"lbf": LBF, "N": 1.0, "klbf": 1e3 * LBF, "kN": 1e3, "kgf": 9.80665, "gf": 9.80665e-3}
TORQUE = {
    "lbf in": LBF * 0.0254,
    "lbf ft": LBF * 0.3048,
    "N m": 1.0,
    "N mm": 1e-3,
    "kgf cm": 9.80665e-2,
    "kN m": 1e3,
}


@dataclass(frozen=True, slots=True)
class Gauges:
    """One sample. counts : (6,). status : names of the bits that are set."""

    counts: Int
    status: tuple[str, ...]

    @property
    def saturated(self) -> bool:
        """Whether a gauge is at an end of its range."""
        low, high = GAUGE_RAILS
        return bool((self.counts <= low).any() or (self.counts >= high).any())


class Frames:
    """The DBC file, for a sensor with this base identifier.

    base : the eleven bits of the identifier without the operation, 0 to 0x7F.
    """

    def __init__(self, base: int, path: str = "") -> None:
        self.where = path or "ati.dbc"
        known = _database(path)
        self._messages: dict[str, Message] = {}
        for name, signals in NEEDED.items():
            self._messages[name] = _message(known, self.where, name, signals)
        self.base = base * OPERATIONS
        taken: dict[int, str] = {}
        for name, message in self._messages.items():
            operation = message.frame_id % OPERATIONS
            if operation in taken:
                expected = f"another operation than that of {taken[operation]}"
                raise InputError(self.where, f"{name}.frame_id", message.frame_id, expected)
            taken[operation] = name

    def identifier(self, name: str) -> int:
        """On the bus, 11 bits."""
        return self.base + int(self._messages[name].frame_id) % OPERATIONS

    def length(self, name: str) -> int:
        """Bytes of the message's data."""
        return int(self._messages[name].length)

    def ours(self, identifier: int) -> bool:
        """Whether an identifier belongs to this sensor."""
        return self.base <= identifier < self.base + OPERATIONS

    def values(self, name: str, data: bytes) -> dict[str, float]:
        """Of the message's signals, as numbers."""
        found = self._messages[name].decode(data, decode_choices=False)
        assert isinstance(found, dict)
        return {str(k): float(v) for k, v in found.items() if isinstance(v, int | float)}

    def gauges(self, first: bytes, second: bytes) -> Gauges:
        """A sample from the two frames of its reply."""
        a, b = self.values("Gauges_0", first), self.values("Gauges_1", second)
        both = {**a, **b}
        counts = np.array([round(both[f"G{i}"]) for i in range(GAUGES)], dtype=np.int64)
        status = tuple(k for k, v in a.items() if k not in NEEDED["Gauges_0"] and v)
        return Gauges(counts, status)

    def row(self, replies: list[bytes]) -> Float:
        """(6,) coefficients of one axis from the three frames of its reply."""
        found: dict[str, float] = {}
        for name, data in zip(MATRIX, replies, strict=True):
            found |= self.values(name, data)
        return np.array([found[f"M{i}"] for i in range(GAUGES)])

    def units(self, data: bytes) -> tuple[float, float]:
        """N and N m in one unit of force and of torque; InputError for a unit without a factor."""
        codes = self.values("Units", data)
        factors = []
        for signal, table in (("ForceUnit", FORCE), ("TorqueUnit", TORQUE)):
            told = self._messages["Units"].get_signal_by_name(signal)
            choices: Mapping[Any, object] = told.choices or {}
            name = str(choices.get(codes[signal], f"code {codes[signal]:g}"))
            if name not in table:
                raise InputError(self.where, f"Units.{signal}", name, f"one of {', '.join(table)}")
            factors.append(table[name])
        return factors[0], factors[1]


def _database(path: str) -> Database:
    """The file, read; the shipped one without a path."""
    try:
        if path:
            with Path(path).open("rb") as file:
                data = file.read(MOST_BYTES + 1)
        else:
            data = resources.files(__package__).joinpath("ati.dbc").read_bytes()
    except OSError as error:
        expected = f"a DBC file that can be read ({error.strerror})"
        raise InputError("device.settings", "dbc", path, expected) from error
    if len(data) > MOST_BYTES:
        said = f"is too long; expected a DBC file of at most {MOST_BYTES} bytes"
        raise InputError.saying(path, "", said)
    text = _read(data.decode("cp1252", "replace"))
    if found := BEYOND.search(re.sub(STRING, '""', text)):
        line = " ".join(found[0].split())[:40]
        raise InputError.saying(path or "ati.dbc", "", f"is no DBC file: {line!r} is in no frame")
    try:
        known = cantools.database.load_string(text, database_format="dbc")
    except Exception as error:
        # The parser meets what a stranger's file holds with errors of many kinds.
        line = " ".join(str(error).split())[:200]
        raise InputError.saying(path or "ati.dbc", "", f"is no DBC file: {line}") from error
    assert isinstance(known, Database)
    for name, n in Counter(m.name for m in known.messages).items():
        if n > 1:
            raise InputError(path or "ati.dbc", "BO_", f"{name}, twice", "each message once")
    return known


def _read(text: str) -> str:
    """What the parser is to read of it."""
    return UNREAD.sub(lambda m: m[0] if m[0].startswith('"') else " ", text)


def _message(known: Database, where: str, name: str, signals: tuple[str, ...]) -> Message:
    found = {m.name: m for m in known.messages}
    if name not in found:
        expected = f"messages {', '.join(NEEDED)}"
        raise InputError(where, "BO_", sorted(found), expected)
    message = found[name]
    if message.is_extended_frame or message.is_multiplexed():
        raise InputError.saying(where, name, "is extended or multiplexed; expected a plain one")
    missing = [s for s in signals if s not in {x.name for x in message.signals}]
    if missing:
        there = [x.name for x in message.signals]
        raise InputError(where, f"{name}.SG_", there, f"{', '.join(missing)} among them")
    for signal in message.signals:
        if not (math.isfinite(signal.scale) and math.isfinite(signal.offset)):
            said = "has a factor or offset that is no number"
            raise InputError.saying(where, f"{name}.{signal.name}", said)
        if name in SAMPLE and signal.name in signals and not _counts(signal):
            said = "is not 16 bits with a sign and the factor 1, counts of a gauge"
            raise InputError.saying(where, f"{name}.{signal.name}", said)
    try:
        message.decode(bytes(message.length), decode_choices=False)
    except cantools.database.DecodeError as error:
        raise InputError.saying(where, name, f"cannot be read: {error}") from error
    return message


def _counts(signal: Signal) -> bool:
    return (
        (signal.length, signal.scale, signal.offset) == (16, 1, 0)
        and signal.is_signed
        and not signal.is_float
    )
