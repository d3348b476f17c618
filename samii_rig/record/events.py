"""Events as `rcl_interfaces/msg/Log`, which viewers show in their log panels."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, cast

from samii_rig.errors import RecordingError
from samii_rig.record import cdr

SCHEMA = "rcl_interfaces/msg/Log"
SCHEMA_TEXT = """builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_KINDS: tuple[cdr.Kind, ...] = (
    "int32",
    "uint32",
    "uint8",
    "string",
    "string",
    "string",
    "string",
    "uint32",
)
_INFO = 20  # rcl_interfaces' level for what is neither warning nor error
_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened during a run: `time` in ns, on the device's clock once read; in the
    message, where it is the `stamp`, on the wall clock."""

    time: int
    name: str
    payload: dict[str, Any]


def encode(event: Event) -> bytes:
    """The message. RecordingError if the payload is not JSON or the time before 0."""
    if not 0 <= event.time < (1 << 31) * _NS:
        raise RecordingError(f"event {event.name} at {event.time} ns; expected 0 ns or later")
    try:
        text = json.dumps(event.payload)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"event {event.name}: {error}") from error
    seconds, rest = divmod(event.time, _NS)
    return cdr.encode(_KINDS, (seconds, rest, _INFO, event.name, text, "", "", 0))


def decode(data: bytes) -> Event:
    """The inverse; RecordingError on anything else."""
    seconds, rest, _, name, text, *_ = cdr.decode(_KINDS, data)
    try:
        payload = json.loads(cast(str, text))
    except (ValueError, RecursionError) as error:
        raise RecordingError("an event's payload is not JSON") from error
    if not isinstance(payload, dict):
        raise RecordingError("an event's payload is not a JSON object")
    return Event(cast(int, seconds) * _NS + cast(int, rest), cast(str, name), payload)
