"""ROS 2 messages in CDR, as far as a recording needs them: numbers, strings, float arrays.

Little-endian plain CDR (OMG DDSI-RTPS 2.5, clause 10): four bytes of encapsulation, then
every primitive aligned to its own size, counted from the end of those four bytes. MCAP
viewers know this encoding and the `ros2msg` schema text that belongs to it, and its
messages of numbers have a fixed size, so that many can be handled at once as an array.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Literal

import numpy as np

from samii_rig.errors import RecordingError
from samii_rig.types import Float

ENCAPSULATION = b"\x00\x01\x00\x00"  # plain CDR, little-endian, no options

Kind = Literal["string", "float64", "int64", "uint32", "int32", "uint8", "float64[]"]
Value = str | float | int | Float

_PACKING: dict[str, tuple[str, int]] = {
    "float64": ("<d", 8),
    "int64": ("<q", 8),
    "uint32": ("<I", 4),
    "int32": ("<i", 4),
    "uint8": ("<B", 1),
}


def encode(kinds: Sequence[Kind], values: Sequence[Value]) -> bytes:
    """One message of these fields, in this order.

    Arrays are flattened in C order and must not be empty: encoders disagree on the
    padding after an empty sequence.
    """
    out = bytearray()

    def align(size: int) -> None:
        out.extend(b"\0" * (-len(out) % size))

    for kind, value in zip(kinds, values, strict=True):
        if kind == "string":
            text = str(value).replace("\0", " ").encode()
            align(4)
            out += struct.pack("<I", len(text) + 1) + text + b"\0"
        elif kind == "float64[]":
            array = np.ascontiguousarray(value, dtype="<f8")
            if array.size == 0:
                raise RecordingError("an array in a message is empty; expected at least one number")
            align(4)
            out += struct.pack("<I", array.size)
            align(8)
            out += array.tobytes()
        else:
            packing, size = _PACKING[kind]
            align(size)
            out += struct.pack(packing, value)
    return ENCAPSULATION + bytes(out)


def decode(kinds: Sequence[Kind], data: bytes) -> list[Value]:
    """The fields of one message; RecordingError if it does not hold exactly these."""
    if data[:4] != ENCAPSULATION:
        raise RecordingError("a message is not little-endian CDR")
    body = memoryview(data)[4:]
    at = 0

    def take(size: int, alignment: int) -> memoryview:
        nonlocal at
        start = at + (-at % alignment)
        if start + size > len(body):
            raise RecordingError("a message ends before its last field")
        at = start + size
        return body[start:at]

    values: list[Value] = []
    for kind in kinds:
        if kind == "string":
            (length,) = struct.unpack("<I", take(4, 4))
            raw = bytes(take(length, 1))
            try:
                values.append(raw.removesuffix(b"\0").decode())
            except UnicodeDecodeError as error:
                raise RecordingError("a message holds text that is not UTF-8") from error
        elif kind == "float64[]":
            (count,) = struct.unpack("<I", take(4, 4))
            values.append(np.frombuffer(take(8 * count, 8), dtype="<f8").astype(np.float64))
        else:
            packing, size = _PACKING[kind]
            values.extend(struct.unpack(packing, take(size, size)))
    if at != len(body):
        raise RecordingError("a message is longer than its fields")
    return values
