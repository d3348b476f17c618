"""An MCAP file that grows record by record, every byte of it under a CRC.

The mcap library's own `Writer` takes one message a call, two orders of magnitude too slow
for a chunk that is already an array of messages. Its public record classes write every
record here but the two that are arrays: a chunk's messages and their index.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import IO, Any, Literal

import lz4.frame
import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from samii_rig.record.encoded import encoded

Compression = Literal["lz4", "zstd", ""]

# Acceleration of LZ4's fast mode. Samples of a noisy signal hardly compress; what does, the
# record heads, is found at this setting too, at about twice the default's speed.
LZ4_ACCELERATION = 8
ZSTD_LEVEL = 1  # smaller than LZ4 by a quarter, about three times slower

_FOOTER_LENGTH = 8 + 8 + 4
_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
INDEX_BYTES = _INDEX_ENTRY.itemsize  # that a message takes in the index of its chunk


@dataclass(frozen=True)
class ChunkPieces:
    """A chunk ready to be appended: the bytes of its record and what its index says."""

    pieces: tuple[bytes, ...]
    index: bytes
    channel_id: int
    messages: int
    start: int
    end: int
    compression: Compression
    compressed_size: int
    uncompressed_size: int


def build_chunk(
    raw: memoryview | bytes,
    channel_id: int,
    log_time: np.ndarray[Any, Any],
    offset: np.ndarray[Any, Any],
    compression: Compression,
) -> ChunkPieces:
    """A chunk of messages of one channel; runs in any thread.

    raw : the message records. log_time, offset : (n,) of each message, ns and bytes into `raw`.
    """
    if compression == "lz4":
        data = lz4.frame.compress(
            raw, compression_level=-LZ4_ACCELERATION, block_linked=False, store_size=True
        )
    elif compression == "zstd":
        data = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(raw)
    else:
        data = bytes(raw)
    size = len(raw)
    start, end = int(log_time.min()), int(log_time.max())
    name = compression.encode()
    head = struct.pack("<QQQII", start, end, size, crc32(raw), len(name)) + name
    head += struct.pack("<Q", len(data))
    head = struct.pack("<BQ", Opcode.CHUNK, len(head) + len(data)) + head
    entries = np.empty(len(log_time), _INDEX_ENTRY)
    entries["log_time"] = log_time
    entries["offset"] = offset
    length = entries.nbytes
    index = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + length, channel_id, length)
    return ChunkPieces(
        pieces=(head, data),
        index=index + entries.tobytes(),
        channel_id=channel_id,
        messages=len(log_time),
        start=start,
        end=end,
        compression=compression,
        compressed_size=len(data),
        uncompressed_size=size,
    )


def message_chunk(
    channel_id: int, messages: Iterable[tuple[int, bytes]], compression: Compression
) -> ChunkPieces:
    """A chunk of a few messages (log time in ns, payload), of any sizes."""
    times, records = [], []
    for time, data in messages:
        times.append(time)
        message = Message(
            channel_id=channel_id, log_time=time, data=data, publish_time=time, sequence=0
        )
        records.append(encoded(message))
    offset = np.cumsum([0, *(len(record) for record in records[:-1])])
    raw = b"".join(records)
    return build_chunk(raw, channel_id, np.array(times, np.uint64), offset, compression)


class Appender:
    """Appends MCAP records to an open binary file and writes the summary at the end.

    Not thread safe: one thread owns it. OSError passes through.
    """

    def __init__(self, file: IO[bytes], profile: str) -> None:
        self._file = file
        self._crc = 0
        self._offset = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._put(MCAP0_MAGIC)
        self._put(encoded(Header(profile, f"samii-rig {version('samii-rig')}")))

    def _put(self, *pieces: bytes) -> int:
        """Write pieces to the data section; returns the offset of the first byte."""
        start = self._offset
        for piece in pieces:
            self._crc = crc32(piece, self._crc)
            self._file.write(piece)
            self._offset += len(piece)
        return start

    def add_channel(
        self,
        topic: str,
        schema_name: str,
        schema_text: str,
        schema_encoding: str,
        message_encoding: str,
        metadata: dict[str, str],
    ) -> int:
        """Register a topic with its schema; returns its channel id."""
        number = len(self._channels) + 1
        schema = Schema(
            id=number, data=schema_text.encode(), encoding=schema_encoding, name=schema_name
        )
        channel = Channel(
            id=number,
            topic=topic,
            message_encoding=message_encoding,
            metadata=metadata,
            schema_id=number,
        )
        self._put(encoded(schema, channel))
        self._schemas.append(schema)
        self._channels.append(channel)
        return number

    def add_chunk(self, chunk: ChunkPieces) -> None:
        """Append a chunk and the index of its messages."""
        offset = self._put(*chunk.pieces)
        index_offset = self._put(chunk.index)
        self._chunks.append(
            ChunkIndex(
                message_start_time=chunk.start,
                message_end_time=chunk.end,
                chunk_start_offset=offset,
                chunk_length=index_offset - offset,
                message_index_offsets={chunk.channel_id: index_offset},
                message_index_length=len(chunk.index),
                compression=chunk.compression,
                compressed_size=chunk.compressed_size,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self._counts[chunk.channel_id] = self._counts.get(chunk.channel_id, 0) + chunk.messages

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Append a metadata record."""
        record = encoded(Metadata(name=name, metadata=data))
        self._metadata.append(MetadataIndex(self._put(record), len(record), name))

    def add_attachment(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """Append an attachment; `time` in ns."""
        attachment = Attachment(
            create_time=time, log_time=time, name=name, media_type=media_type, data=data
        )
        record = encoded(attachment)
        self._attachments.append(
            AttachmentIndex(
                offset=self._put(record),
                length=len(record),
                log_time=time,
                create_time=time,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def sync(self) -> None:
        """Everything so far is on the disk when this returns."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def finish(self) -> None:
        """End the data section; write the summary, the footer and the magic; sync."""
        self._put(encoded(DataEnd(self._crc)))
        summary_start = self._offset
        summary, offsets = self._summary(summary_start)
        offset_start = summary_start + len(summary)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, _FOOTER_LENGTH, summary_start, offset_start)
        crc = crc32(footer, crc32(summary + offsets))
        ending = encoded(Footer(summary_start, offset_start, crc))
        self._put(summary, offsets, ending, MCAP0_MAGIC)
        self.sync()

    def _summary(self, start: int) -> tuple[bytes, bytes]:
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((c.message_end_time for c in self._chunks), default=0),
            message_start_time=min((c.message_start_time for c in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        summary, offsets = bytearray(), bytearray()
        for opcode, records in groups:
            if records:
                group = encoded(*records)
                offsets += encoded(SummaryOffset(opcode, start + len(summary), len(group)))
                summary += group
        return bytes(summary), bytes(offsets)
