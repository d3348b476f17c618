"""What an MCAP file contains, found in one pass over its record heads."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from heapq import merge
from typing import TypeVar

from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Footer, Header, McapRecord, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from samii_rig.errors import RecordingError
from samii_rig.record import layout, scan
from samii_rig.record.scan import ChunkHead, DamagedError, Span

_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel id, sequence, log time, publish time
_INDEX_HEAD = struct.Struct("<HI")  # channel id, bytes of entries
_INDEX_ENTRY = 16  # log time and offset, u64 each
# What the packed chunks of a file may unpack to, as a multiple of the file. A sample takes 16 bytes
# of a message index, which is not packed, so that rows of s bytes come to s/16 at most; events
# and results stay under the floor. Above the ceiling a file is made to cost time and memory,
# whatever its channels are said to be.
EXPANSION_FLOOR, EXPANSION_CEILING = 16, 100
SMALL = 64 << 20  # bytes that are never too many
# Bytes that looking for whole records may read or unpack in vain, as a multiple of the file.
# Damage by chance costs each chunk's unpacked size at most once; samples pack to more than
# 1/64 unless next to all of them are constant.
_VAIN = 64
_GIVEN_UP = "false records overlap; the search for whole ones behind is given up"

Item = TypeVar("Item")
Record = TypeVar("Record", bound=McapRecord)


@dataclass(slots=True)
class Chunk:
    """A chunk and, by channel id, how many messages its index says it has.

    `counts` is empty where the file ends before the index.
    """

    head: ChunkHead
    counts: dict[int, int] = field(default_factory=dict)


@dataclass(slots=True)
class Contents:
    """The data section of a file.

    end : where it ends: after the DataEnd record, or where the file is damaged.
    data_crc : what DataEnd says, None without one. data_end : offset of DataEnd.
    damage : what could not be read; empty in strict mode, which raises it instead.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    attachments: list[Span] = field(default_factory=list)
    chunks: list[Chunk] = field(default_factory=list)
    damage: list[DamagedError] = field(default_factory=list)
    end: int = 0
    data_end: int = 0
    data_crc: int | None = None

    def channel_id(self, topic: str) -> int | None:
        """Id of the one channel with this topic, None if there is none."""
        found = [c.id for c in self.channels.values() if c.topic == topic]
        if len(found) > 1:
            raise RecordingError(f"{topic} is registered {len(found)} times; expected once")
        return found[0] if found else None

    def maps(self, name: str) -> list[dict[str, str]]:
        """All metadata records of this name that are ours, checked."""
        return [layout.unsealed(m, f"metadata {n}") for n, m in self.metadata if n == name]

    def notes(self) -> dict[str, str]:
        """The run's notes; what was noted later stands instead of what was before."""
        return {key: text for found in self.maps(layout.NOTES) for key, text in found.items()}

    def clock_offset(self) -> int:
        """ns by which the log times are ahead of the device's clock; recordings that do not say
        are stamped with the device's clock itself."""
        found = self.one_map(layout.CLOCK)
        return 0 if found is None else layout.clock_from_map(found)

    def one_map(self, name: str) -> dict[str, str] | None:
        """The one metadata record of this name, None if there is none."""
        found = self.maps(name)
        if len(found) > 1:
            raise RecordingError(f"metadata {name} occurs {len(found)} times; expected once")
        return found[0] if found else None


class ForeignError(RecordingError):
    """A file of another kind."""


def check_start(data: memoryview) -> None:
    """ForeignError for a file that is no recording at all, RecordingError for the start of one."""
    if not scan.has_magic(data, 0):
        if MCAP0_MAGIC.startswith(data[: scan.MAGIC_SIZE]):
            raise RecordingError("it ends before the first record of an MCAP file")
        raise ForeignError("it does not begin as an MCAP file; expected a recording (.mcap)")


def read_contents(data: memoryview, stop: int, *, strict: bool) -> Contents:
    """Walk the data section, which ends before `stop`.

    strict : raise the first DamagedError; otherwise note it, look for the next record that is
        whole by its own checksum and go on there.
    """
    check_start(data)
    contents = Contents()
    search = _RecordSearch(data, stop)
    at = sure = scan.MAGIC_SIZE
    while at < stop and contents.data_crc is None:
        span = None
        try:
            span = next(scan.spans(data, at, stop))
            _take(contents, data, span)
            at = contents.end = span.end
            # A message index has no checksum: where a byte of it is gone, it ends in what follows.
            if span.opcode != Opcode.MESSAGE_INDEX:
                sure = at
        except DamagedError as damaged:
            if strict:
                raise
            contents.damage.append(damaged)
            # If its length is right the record ends where it says; if a whole one begins before
            # that, the length is what was damaged.
            whole = search.first(sure)
            ends = [x for x in (whole, span.end if span else None) if x is not None]
            if search.given_up:
                contents.damage.append(DamagedError(at, _GIVEN_UP))
            if not ends or search.given_up:
                break
            at = min(ends)
            if span:
                search.charge(span.end - at)  # read once in vain, and soon again
    return contents


def _take(contents: Contents, data: memoryview, span: Span) -> None:
    match span.opcode:
        case Opcode.HEADER:
            scan.parse(Header, data, span)
        case Opcode.SCHEMA:
            schema = scan.parse(Schema, data, span)
            contents.schemas[schema.id] = schema
        case Opcode.CHANNEL:
            channel = scan.parse(Channel, data, span)
            contents.channels[channel.id] = channel
        case Opcode.METADATA:
            record = scan.parse(Metadata, data, span)
            contents.metadata.append((record.name, record.metadata))
        case Opcode.ATTACHMENT:
            if not scan.attachment_whole(data, span):
                raise DamagedError(span.start, "an attachment's CRC does not fit")
            contents.attachments.append(span)
        case Opcode.CHUNK:
            contents.chunks.append(Chunk(scan.chunk_head(data, span)))
        case Opcode.MESSAGE_INDEX:
            _take_index(contents, data, span)
        case Opcode.DATA_END:
            contents.data_crc = scan.parse(DataEnd, data, span).data_section_crc
            contents.data_end = span.start
        case Opcode.MESSAGE:
            raise DamagedError(span.start, "a message outside of a chunk; expected all in chunks")
        case _:
            raise DamagedError(span.start, f"a record of kind {span.opcode} among the data")


def _take_index(contents: Contents, data: memoryview, span: Span) -> None:
    if span.end - span.content < _INDEX_HEAD.size:
        raise DamagedError(span.start, "a message index is shorter than its head")
    channel_id, length = _INDEX_HEAD.unpack_from(data, span.content)
    if span.content + _INDEX_HEAD.size + length != span.end or length % _INDEX_ENTRY:
        raise DamagedError(span.start, "a message index does not fit its record")
    if not contents.chunks:
        raise DamagedError(span.start, "a message index before any chunk")
    counts = contents.chunks[-1].counts
    counts[channel_id] = counts.get(channel_id, 0) + length // _INDEX_ENTRY


def _mark(name: str) -> bytes:
    """A name as MCAP writes one."""
    return struct.pack("<I", len(name)) + name.encode()


# Of a chunk before its compression's name: opcode and length, two times, size and CRC.
_BEFORE_NAME = scan.HEAD + 8 + 8 + 8 + 4
# What tells where a record may begin, and how many of its bytes stand before that.
_MARKS = (
    *((_mark(name), _BEFORE_NAME) for name in ("lz4", "zstd")),
    *((_mark(name), scan.HEAD) for name in layout.MAPS),
)


class _RecordSearch:
    """Finds chunks, and metadata of ours, that are whole down to their checksum among bytes that
    have lost their order.

    False chunks may lie inside each other and share the bytes that they make one unpack, so
    that the work could grow with the square of the file. What is read or unpacked in vain is
    therefore charged, and beyond `_VAIN` times the file and one chunk the search gives up.
    """

    def __init__(self, data: memoryview, stop: int) -> None:
        self._data = data
        self._stop = stop
        self._known: tuple[int, int | None] | None = None  # searched from, found at
        # Each mark is passed once, as nobody searches backwards.
        self._hits = merge(*(self._found(mark, before) for mark, before in _MARKS))
        self._budget = _VAIN * stop + scan.MAX_CHUNK

    def _found(self, mark: bytes, before: int) -> Iterator[int]:
        """Where records may begin, by one mark."""
        for hit in re.finditer(re.escape(mark), self._data[: self._stop]):
            if hit.start() >= before:
                yield hit.start() - before

    @property
    def given_up(self) -> bool:
        """So much was unpacked in vain that the file is made to cost time."""
        return self._budget < 0

    def charge(self, size: int) -> None:
        """Count bytes that were read or unpacked in vain."""
        self._budget -= size

    def first(self, start: int) -> int | None:
        """Offset of the first whole record at or after `start`, None if there is none."""
        if self._known is not None:
            searched, found = self._known
            if searched <= start and (found is None or start <= found):
                return found
        found = None
        for at in self._hits:
            if self.given_up:
                break
            if at >= start and self._whole(at):
                found = at
                break
        self._known = (start, found)
        return found

    def _whole(self, at: int) -> bool:
        try:
            span = next(scan.spans(self._data, at, self._stop))
            if span.opcode == Opcode.METADATA:
                return self._sealed(span)
            if span.opcode != Opcode.CHUNK:
                return False
            head = scan.chunk_head(self._data, span)
        except DamagedError:
            return False
        try:
            scan.unpack(self._data, head)
        except DamagedError:
            self.charge(head.size + span.end - span.start)
            return False
        return True

    def _sealed(self, span: Span) -> bool:
        self.charge(span.end - span.start)
        try:
            record = scan.parse(Metadata, self._data, span)
            layout.unsealed(record.metadata, record.name)
        except RecordingError:
            return False
        return True


class Unpacker:
    """Unpacks the chunks of a file, and no more in all than a run with its channels can hold, so
    that what a file costs is bounded by its size on the disk."""

    def __init__(self, data: memoryview, row: int) -> None:
        """row : bytes of a sample's record, 0 for a file without samples."""
        self._data = data
        most = min(max(row / _INDEX_ENTRY, EXPANSION_FLOOR), EXPANSION_CEILING)
        self._most = self._left = max(SMALL, round(most * len(data)))

    def __call__(self, head: ChunkHead) -> bytes | memoryview:
        """The chunk's records; DamagedError if it is not whole, ExpandedError if it is too much."""
        if head.compression:
            self._left -= head.size
        if self._left < 0:
            raise ExpandedError(
                f"byte {head.span.start}: the chunks up to here claim more than "
                f"{self._most / 1e6:.0f} MB unpacked, and a run in a file of "
                f"{len(self._data) / 1e6:.1f} MB has no more; what follows is not looked at"
            )
        return scan.unpack(self._data, head)


class ExpandedError(RecordingError):
    """A file that is made to cost time and memory."""


@dataclass(frozen=True, slots=True)
class Tail:
    """The end of a finished file, its CRC checked. summary_start : where the summary begins."""

    summary_start: int
    footer: Span


def read_tail(data: memoryview) -> Tail:
    """Footer and summary; DamagedError unless every byte of them is as it was written,
    RecordingError as `check_start`."""
    check_start(data)
    size = len(data)
    at = size - scan.MAGIC_SIZE - scan.FOOTER_SIZE
    if at < scan.MAGIC_SIZE or not scan.has_magic(data, size - scan.MAGIC_SIZE):
        raise DamagedError(size, "the file ends before it is finished")
    span = next(scan.spans(data, at, size - scan.MAGIC_SIZE))
    if span.opcode != Opcode.FOOTER or span.end != size - scan.MAGIC_SIZE:
        raise DamagedError(at, "the footer is damaged")
    footer = scan.parse(Footer, data, span)
    if not scan.MAGIC_SIZE < footer.summary_start <= at:
        raise DamagedError(at, "the footer does not say where the summary begins")
    if crc32(data[footer.summary_start : span.end - 4]) != footer.summary_crc:
        raise DamagedError(footer.summary_start, "the summary's CRC does not fit")
    return Tail(footer.summary_start, span)


def summary_channels(data: memoryview, tail: Tail) -> tuple[dict[int, Schema], dict[int, Channel]]:
    """Schemas and channels as the summary repeats them."""
    schemas, channels = {}, {}
    for span in scan.spans(data, tail.summary_start, tail.footer.start):
        if span.opcode == Opcode.SCHEMA:
            schema = scan.parse(Schema, data, span)
            schemas[schema.id] = schema
        elif span.opcode == Opcode.CHANNEL:
            channel = scan.parse(Channel, data, span)
            channels[channel.id] = channel
    return schemas, channels


def messages(raw: bytes | memoryview, channel_id: int) -> Iterator[tuple[int, bytes]]:
    """(log time in ns, payload) of one channel's messages in an unpacked chunk."""
    view = memoryview(raw)
    for span in scan.spans(view, 0, len(view)):
        if span.opcode != Opcode.MESSAGE:
            continue
        if span.end - span.content < _MESSAGE_HEAD.size:
            raise DamagedError(span.start, "a message is shorter than its head")
        number, _, log_time, _ = _MESSAGE_HEAD.unpack_from(view, span.content)
        if number == channel_id:
            yield log_time, bytes(view[span.content + _MESSAGE_HEAD.size : span.end])


def decoded(
    data: memoryview, contents: Contents, topic: str, decode: Callable[[bytes], Item]
) -> list[Item]:
    """All messages of a topic of ours, decoded, in the order of the file."""
    channel_id = contents.channel_id(topic)
    if channel_id is None:
        return []
    found: list[Item] = []
    for chunk in contents.chunks:
        if not chunk.counts or channel_id in chunk.counts:
            raw = scan.unpack(data, chunk.head)
            found.extend(decode(payload) for _, payload in messages(raw, channel_id))
    return found


def attachment(data: memoryview, contents: Contents, name: str) -> bytes | None:
    """The attachment of this name, None if there is none."""
    for span in contents.attachments:
        record = scan.parse(Attachment, data, span)
        if record.name == name:
            return record.data
    return None
