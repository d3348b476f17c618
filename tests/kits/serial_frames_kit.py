"""What tests of the serial frames share."""

import struct
import zlib

from cobs import cobs


def raw(version, kind, boot, seq, body):
    p = struct.pack("<BBHI", version, kind, boot, seq) + body
    return cobs.encode(p + struct.pack("<I", zlib.crc32(p))) + b"\0"
