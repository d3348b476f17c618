"""Take an MCAP file apart without trusting a byte of it.

Every length is held against the file before anything is read, every size that a chunk
claims against `MAX_CHUNK` before anything is unpacked. Only RecordingError leaves here.
"""

from __future__ import annotations

import io
import mmap
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import lz4.frame
import zstandard
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Attachment, McapRecord
from mcap.writer import MCAP0_MAGIC

from samii_rig.errors import RecordingError
from samii_rig.files import open_file, reason
from samii_rig.record.encoded import encoded

# Viewers' chunks are 1 to 4 MB, ours 1 MB. A chunk that claims more than this is hostile or
# so badly made that unpacking it would do harm.
MAX_CHUNK = 64 << 20
MAX_SMALL = 64 << 20  # the same for any other record that is read as a whole
HEAD = 9  # opcode u8, length u64
FOOTER_SIZE = HEAD + 20
MAGIC_SIZE = len(MCAP0_MAGIC)
_CHUNK_HEAD = struct.Struct("<QQQII")

# glibc gives a block above a threshold back to the system when it is freed, and every chunk
# would then touch fresh pages, at a fifth of the time to read it. The threshold rises to the
# largest block freed so far (mallopt(3), M_MMAP_THRESHOLD); this one is never touched.
bytes(16 << 20)

Record = TypeVar("Record", bound=McapRecord)


class DamagedError(RecordingError):
    """The bytes from `offset` on are no record."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(f"byte {offset}: {reason}")
        self.offset = offset
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Span:
    """Where a record stands: its opcode, the offset of its head, of its content, of its end."""

    opcode: int
    start: int
    end: int

    @property
    def content(self) -> int:
        """Offset of the first byte after the head."""
        return self.start + HEAD


class CutError(DamagedError):
    """The bytes end before the record at `offset` does."""


def mapped(path: Path) -> memoryview:
    """The bytes of a file, mapped, not read; the mapping ends with the last view of it.

    RecordingError if the file cannot be read or is empty.
    """
    try:
        with open_file(path) as file:
            if os.fstat(file.fileno()).st_size == 0:
                raise RecordingError(f"{path} is empty; expected an MCAP file")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except (OSError, ValueError) as error:
        why = reason(error) if isinstance(error, OSError) else error
        raise RecordingError(f"{path} cannot be read: {why}") from error


def spans(data: memoryview, start: int, stop: int) -> Iterator[Span]:
    """The records between two offsets, in order; DamagedError where one does not fit."""
    at = start
    while at < stop:
        if at + HEAD > stop:
            raise CutError(at, "the file ends in the head of a record")
        opcode, length = struct.unpack_from("<BQ", data, at)
        end = at + HEAD + length
        if opcode == 0:
            raise DamagedError(at, "opcode 0 is not a record")
        if end > stop:
            raise CutError(at, f"a record of {length} bytes does not fit into the file")
        yield Span(opcode, at, end)
        at = end


def parse(kind: type[Record], data: memoryview, span: Span) -> Record:
    """One record, read by the mcap library; DamagedError unless it writes back to the same bytes.

    The library takes what it gets when a string is cut short; writing back tells.
    """
    if span.end - span.start > MAX_SMALL:
        raise DamagedError(
            span.start, f"a {kind.__name__} of {span.end - span.start} bytes is too big"
        )
    raw = bytes(data[span.start : span.end])
    try:
        record = cast(Any, kind).read(ReadDataStream(io.BytesIO(raw[HEAD:])))
        again = encoded(record)
    except (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError) as error:
        raise DamagedError(span.start, f"a {kind.__name__} record cannot be read") from error
    if again != raw:
        what = "its CRC does not fit" if kind is Attachment else "it is not well formed"
        raise DamagedError(span.start, f"a {kind.__name__} record is damaged: {what}")
    return cast(Record, record)


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """What a chunk says of itself, and where its packed bytes are."""

    span: Span
    start_time: int
    end_time: int
    size: int
    crc: int
    compression: str
    data_start: int


def chunk_head(data: memoryview, span: Span) -> ChunkHead:
    """Read a chunk's head; DamagedError if it does not fit its record or claims too much."""
    at = span.content
    if at + _CHUNK_HEAD.size > span.end:
        raise DamagedError(span.start, "a chunk is shorter than its head")
    start_time, end_time, size, crc, length = _CHUNK_HEAD.unpack_from(data, at)
    at += _CHUNK_HEAD.size
    if at + length + 8 > span.end:
        raise DamagedError(span.start, "a chunk's compression does not fit")
    compression = bytes(data[at : at + length]).decode("ascii", "replace")
    at += length
    (packed,) = struct.unpack_from("<Q", data, at)
    at += 8
    if at + packed != span.end:
        raise DamagedError(span.start, "a chunk's data does not end where the chunk does")
    if compression not in ("", "lz4", "zstd"):
        raise DamagedError(span.start, f"compression {compression[:20]!r} is not lz4, zstd or none")
    if size > MAX_CHUNK:
        raise DamagedError(
            span.start, f"a chunk claims {size} bytes unpacked; expected at most {MAX_CHUNK}"
        )
    return ChunkHead(span, start_time, end_time, size, crc, compression, at)


def unpack(data: memoryview, head: ChunkHead) -> bytes | memoryview:
    """The chunk's records, at most `head.size` bytes ever in memory; DamagedError if not whole."""
    packed = data[head.data_start : head.span.end]
    try:
        if head.compression == "lz4":
            raw: bytes | memoryview = _unpack_lz4(packed, head.size)
        elif head.compression == "zstd":
            raw = _unpack_zstd(packed, head.size)
        else:
            raw = packed
    except (RuntimeError, ValueError, EOFError, MemoryError, zstandard.ZstdError) as error:
        # What the libraries say of it is for who knows their insides.
        own = str(error) if type(error) is ValueError else f"its {head.compression} is damaged"
        raise DamagedError(head.span.start, f"a chunk cannot be unpacked: {own}") from error
    if len(raw) != head.size:
        raise DamagedError(head.span.start, f"a chunk holds {len(raw)} bytes, not {head.size}")
    if crc32(raw) != head.crc:
        raise DamagedError(head.span.start, "a chunk's CRC does not fit")
    return raw


def _unpack_lz4(packed: memoryview, size: int) -> bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    # One byte more than claimed, so that too much shows and the end mark is read.
    raw = cast(bytes, decompressor.decompress(packed, max_length=size + 1))
    if not decompressor.eof or decompressor.unused_data:
        del raw  # what is known of the error holds this frame, and with it all that was unpacked
        raise ValueError("the LZ4 frame does not end with the chunk")
    return raw


def _unpack_zstd(packed: memoryview, size: int) -> bytes:
    claimed = zstandard.frame_content_size(packed)
    if claimed not in (-1, size):
        raise ValueError(f"its frame claims {claimed} bytes")
    return zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK).decompress(
        packed, max_output_size=max(size, 1), allow_extra_data=False
    )


def attachment_whole(data: memoryview, span: Span) -> bool:
    """An attachment's CRC fits; it may be large and is not copied."""
    if span.end - span.content < 4:
        return False
    (crc,) = struct.unpack_from("<I", data, span.end - 4)
    return bool(crc32(data[span.content : span.end - 4]) == crc)


def has_magic(data: memoryview, at: int) -> bool:
    """MCAP's magic stands at this offset."""
    return at >= 0 and bytes(data[at : at + MAGIC_SIZE]) == MCAP0_MAGIC
