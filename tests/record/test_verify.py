"""`verify` calls a file whole only if every bit is as it was written; no file can hurt it."""

from __future__ import annotations

import contextlib
import json
import resource
import struct
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from record_kit import CHANNELS, RATE, STOP, block, blocks, write_run

from samii_rig.errors import RecordingError
from samii_rig.record import cdr, contents, events, layout, response, scan
from samii_rig.record.appender import Appender, Compression, build_chunk, message_chunk
from samii_rig.record.contents import read_contents
from samii_rig.record.layout import SampleLayout
from samii_rig.record.reader import read_events, read_frequency_responses, read_recording
from samii_rig.record.recover import recover
from samii_rig.record.verify import verify
from samii_rig.record.writer import RunWriter
from samii_rig.types import Channel, SampleBlock


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    write_run(path, blocks())
    return path.read_bytes()


def read_all(path: Path) -> None:
    """All that the reading side does; RecordingError is the one way to refuse."""
    for call in (
        lambda: read_recording(path),
        lambda: read_recording(path, partial=True),
        lambda: read_events(path, partial=True),
        lambda: read_frequency_responses(path, partial=True),
        lambda: recover(path, path.with_name("out.mcap")),
        lambda: verify(path),
    ):
        with contextlib.suppress(RecordingError):
            call()
        for left in path.parent.glob("out.mcap*"):
            left.unlink()


def test_every_single_bit_flip_is_detected(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(1)
    # Beside a random sample: all of the header, of the data's end and of the footer.
    data_end = whole.rindex(struct.pack("<BQ", Opcode.DATA_END, 4))
    bits = [*range(8 * 12), *range(8 * data_end, 8 * (data_end + 13))]
    bits += [*range(8 * (len(whole) - 37), 8 * len(whole))]
    bits += rng.integers(0, 8 * len(whole), 250).tolist()
    for bit in bits:
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        verdict = verify(path)
        assert verdict.status != "whole", bit
        assert verdict.problems, bit


def test_anything_added_or_missing_is_detected(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    middle = len(whole) // 2
    for damaged in (
        whole + b"\0",
        whole + whole,
        whole[:-1],
        whole[1:],
        whole[:middle] + whole[middle + 1 :],
        whole[:middle] + b"\0" + whole[middle:],
    ):
        path.write_bytes(damaged)
        assert verify(path).status != "whole"


def test_what_holds_no_sample_is_nothing(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    for content in (b"", whole[:3], whole[:8], whole[:400]):
        path.write_bytes(content)
        verdict = verify(path)
        assert (verdict.status, verdict.exit_code) == ("nothing", 1)
    for content in (b"hello", bytes(10_000)):
        path.write_bytes(content)
        verdict = verify(path)
        assert (verdict.status, verdict.exit_code) == ("foreign", 2)
    with pytest.raises(RecordingError, match="not there"):
        verify(tmp_path / "missing.mcap")
    with pytest.raises(RecordingError, match="is a folder; expected a recording"):
        verify(tmp_path)


def test_two_runs_in_one_file_are_not_one_recording(tmp_path: Path) -> None:
    """Samples whose sequence falls back are refused, not sorted."""
    path = tmp_path / "run.mcap"
    raws = [_raw(block(0, 5)), _raw(block(0, 5))]
    _craft(path, raws)
    with pytest.raises(RecordingError, match="order of their sequence"):
        read_recording(path)
    assert verify(path).status == "lossy"


def test_a_foreign_mcap_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        appender = Appender(file, "")
        number = appender.add_channel("/imu", "imu", "{}", "jsonschema", "json", {})
        appender.add_chunk(message_chunk(number, [(1, b"{}")], "lz4"))
        appender.finish()
    with pytest.raises(RecordingError, match="not a recording of samii-rig"):
        read_recording(path)
    assert verify(path).status == "nothing"


def _raw(part: SampleBlock, channel_id: int = 1) -> bytes:
    records = layout.SampleLayout(CHANNELS, RATE).blank(len(part), channel_id)
    records["log_time"] = records["publish_time"] = part.time
    records["sequence"] = part.sequence
    return records.tobytes()


def _craft(path: Path, raws: list[bytes], metadata: dict[str, str] | None = None) -> None:
    """A file whose CRCs are all right, with any bytes in its chunks."""
    size = layout.SampleLayout(CHANNELS, RATE).record.itemsize
    with path.open("wb") as file:
        appender = Appender(file, layout.PROFILE)
        run = {"format": layout.FORMAT, "rate_hz": "500.0"}
        appender.add_metadata(layout.RUN, layout.sealed(run))
        of_samples = layout.SampleLayout(CHANNELS, RATE)
        described = of_samples.metadata() if metadata is None else metadata
        text = of_samples.schema_text()
        appender.add_channel("/samples", "samii_rig/msg/Samples", text, "ros2msg", "cdr", described)
        log = (events.SCHEMA, events.SCHEMA_TEXT, "ros2msg", "cdr", {})
        appender.add_channel("/events", *log)
        frf = (response.SCHEMA, response.SCHEMA_TEXT, "ros2msg", "cdr", {})
        appender.add_channel("/frequency_response", *frf)
        for raw in raws:
            n = max(1, len(raw) // size)
            appender.add_chunk(build_chunk(raw, 1, np.arange(n), np.arange(n) * size, "lz4"))
        appender.finish()


@settings(max_examples=60)
@given(data=st.data())
def test_nothing_but_a_recording_error_comes_of_hostile_chunks(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Chunks with right CRCs and wrong content get past the first line of defence."""
    path = tmp_path_factory.mktemp("hostile") / "run.mcap"
    raw = bytearray(_raw(block(0, 4), data.draw(st.integers(1, 3))))
    for _ in range(data.draw(st.integers(0, 6))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(raw)))
    _craft(path, [bytes(raw[:cut]), data.draw(st.binary(max_size=60))])
    read_all(path)


@settings(max_examples=80)
@given(data=st.data())
def test_nothing_but_a_recording_error_comes_of_mutations(
    tmp_path_factory: pytest.TempPathFactory, whole: bytes, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("mutated") / "run.mcap"
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 8))):
        at = data.draw(st.integers(0, len(content) - 1))
        kind = data.draw(st.sampled_from(["set", "cut", "insert", "huge"]))
        if kind == "set":
            content[at] = data.draw(st.integers(0, 255))
        elif kind == "cut":
            del content[at : at + data.draw(st.integers(1, 40))]
        elif kind == "insert":
            content[at:at] = data.draw(st.binary(min_size=1, max_size=20))
        else:
            content[at : at + 8] = struct.pack("<Q", data.draw(st.integers(0, 2**64 - 1)))
    path.write_bytes(content)
    read_all(path)


@given(st.binary(max_size=300))
def test_any_bytes_as_a_message_decode_or_are_refused(data: bytes) -> None:
    for decode in (events.decode, response.decode):
        for payload in (data, cdr.ENCAPSULATION + data):
            with contextlib.suppress(RecordingError):
                decode(payload)


JSONISH = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


@settings(max_examples=60)
@given(item=JSONISH, rate=st.sampled_from(["500.0", "nan", "-1", "x", "1e999"]))
def test_any_description_of_the_channels_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, item: object, rate: str
) -> None:
    path = tmp_path_factory.mktemp("described") / "run.mcap"
    described = layout.sealed({"rate_hz": rate, "channels": json.dumps(item)})
    _craft(path, [_raw(block(0, 4))], described)
    read_all(path)


def _bomb(compression: str, claimed: int | None) -> bytes:
    """A file of 4 MB or less with one chunk, which unpacks to far more than that."""
    gigabytes = 3 << 30
    if compression == "lz4":
        # A frame of blocks, each 4 MB of zeros in 16 kB.
        piece = lz4.frame.compress(bytes(4 << 20), block_size=7, store_size=False)
        head = lz4.frame.LZ4FrameCompressor(block_size=7).begin()
        packed = head + piece[len(head) : -4] * 240 + bytes(4)
    else:
        compressor = zstandard.ZstdCompressor().compressobj()
        packed = b"".join(compressor.compress(bytes(4 << 20)) for _ in range(240))
        packed += compressor.flush()
    size = gigabytes if claimed is None else claimed
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", Opcode.CHUNK, len(body)) + body


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
@pytest.mark.parametrize("claimed", [None, 10_000, 60 << 20], ids=["3 GB", "small", "60 MB"])
def test_a_chunk_that_would_fill_the_memory_is_refused(
    tmp_path: Path, whole: bytes, compression: str, claimed: int | None
) -> None:
    """Whether it claims 3 GB or hides them behind a small claim."""
    bomb = _bomb(compression, claimed)
    assert len(bomb) < 4.2e6
    path = tmp_path / "run.mcap"
    at = whole.index(struct.pack("<BQ", Opcode.DATA_END, 4))
    path.write_bytes(whole[:at] + bomb + whole[at:])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert verify(path).status == "lossy"
    read_all(path)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert grown < 3 * scan.MAX_CHUNK


@pytest.mark.parametrize(
    "make",
    [
        lambda n: struct.pack("<BQ", Opcode.ATTACHMENT, n),
        lambda n: struct.pack("<BQ", Opcode.METADATA, 40) + struct.pack("<I", n % 2**32) * 10,
        lambda n: struct.pack("<BQ", Opcode.MESSAGE_INDEX, n),
        lambda n: struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6, 1, n % 2**32),
        lambda n: struct.pack("<BQ", Opcode.CHUNK, 44) + struct.pack("<Q", n) * 5 + bytes(4),
    ],
)
@pytest.mark.parametrize("length", [2**31, 2**63, 2**64 - 1])
def test_lengths_beyond_the_file_are_refused(
    tmp_path: Path, whole: bytes, make: Callable[[int], bytes], length: int
) -> None:
    path = tmp_path / "run.mcap"
    at = whole.index(struct.pack("<BQ", Opcode.DATA_END, 4))
    path.write_bytes(whole[:at] + make(length) + whole[at:])
    assert verify(path).status == "lossy"
    with pytest.raises(RecordingError, match="byte"):
        read_recording(path)
    read_all(path)


def _chunk_head(claimed: int, packed: int) -> bytes:
    """A chunk up to its packed bytes, `packed` in number."""
    body = struct.pack("<QQQII", 0, 0, claimed, 0, 3) + b"lz4" + struct.pack("<Q", packed)
    return struct.pack("<BQ", Opcode.CHUNK, len(body) + packed) + body


def _false_chunks(count: int) -> bytes:
    """Chunks inside each other, all of which reach to the end and unpack to its 60 MB of zeros.

    Each is a plain LZ4 block around the head of the next.
    """
    claimed = 60 << 20
    packed = lz4.frame.compress(bytes(claimed), store_size=False)
    begin = packed[:7]
    found = _chunk_head(claimed, len(packed)) + packed
    around = struct.pack("<I", 1 << 31 | len(found) - len(packed) + len(begin))
    for _ in range(count):
        packed = begin + around + found
        found = _chunk_head(claimed, len(packed)) + packed
    return found


def _false_attachments(count: int) -> bytes:
    """Attachments that reach to the end, each with an empty whole chunk behind its head."""
    packed = lz4.frame.compress(b"")
    chunk = _chunk_head(0, len(packed)) + packed
    found = bytes(1_000_000)
    for _ in range(count):
        found = struct.pack("<BQ", Opcode.ATTACHMENT, len(chunk) + len(found)) + chunk + found
    return found


@pytest.mark.parametrize("make", [lambda: _false_chunks(40), lambda: _false_attachments(1000)])
def test_the_work_grows_no_faster_than_the_file(
    tmp_path: Path, whole: bytes, make: Callable[[], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What lies inside each other could make the same bytes be unpacked or read again and again."""
    path = tmp_path / "run.mcap"
    at = whole.index(struct.pack("<BQ", Opcode.DATA_END, 4))
    path.write_bytes(whole[:at] + bytes(1) + make())
    work = [0]
    unpack, attachment_whole = scan.unpack, scan.attachment_whole

    def unpack_counted(data: memoryview, head: scan.ChunkHead) -> bytes | memoryview:
        work[0] += head.size
        return unpack(data, head)

    def attachment_counted(data: memoryview, span: scan.Span) -> bool:
        work[0] += span.end - span.start
        return attachment_whole(data, span)

    monkeypatch.setattr(scan, "unpack", unpack_counted)
    monkeypatch.setattr(scan, "attachment_whole", attachment_counted)
    verdict = verify(path)
    assert work[0] < 70 * path.stat().st_size + 2 * scan.MAX_CHUNK
    assert verdict.status == "lossy"
    assert verdict.samples == 120
    assert any("given up" in problem for problem in verdict.problems)
    assert recover(path).samples == 120


def test_a_damaged_length_is_no_reason_to_give_up(tmp_path: Path) -> None:
    """Every chunk but the last claims to reach far into those behind it."""
    path = tmp_path / "run.mcap"
    write_run(path, blocks(40))
    content = bytearray(path.read_bytes())
    data = scan.mapped(path)
    chunks = read_contents(data, len(data), strict=False).chunks
    for chunk in chunks[1:-1:2]:
        content[chunk.head.span.start + 2] ^= 0x10
    path.write_bytes(content)
    verdict = verify(path)
    assert verdict.chunks >= len(chunks) // 2
    assert not any("given up" in problem for problem in verdict.problems)


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
@pytest.mark.parametrize("rows", [True, False], ids=["samples", "zeros"])
def test_what_a_file_costs_is_bounded_by_its_size(
    tmp_path: Path, compression: Compression, rows: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few chunks of 60 MB that pack to next to nothing, written a hundred times."""
    path = tmp_path / "run.mcap"
    with RunWriter(path, CHANNELS, RATE) as writer:
        record = SampleLayout(CHANNELS, RATE).blank(50_000_000 // 70, 1)
        raw = record.view(np.uint8).data if rows else bytes(50_000_000)
        time, offset = np.zeros(1, np.uint64), np.zeros(1, np.uint64)
        chunk = build_chunk(raw, 1, time, offset, compression)
        for _ in range(100):
            writer._put(lambda appender: appender.add_chunk(chunk))
        writer.close(STOP)
    work = [0]
    unpack = scan.unpack

    def counted(data: memoryview, head: scan.ChunkHead) -> bytes | memoryview:
        work[0] += head.size
        return unpack(data, head)

    monkeypatch.setattr(scan, "unpack", counted)
    bound = max(contents.SMALL, contents.EXPANSION_FLOOR * path.stat().st_size)
    verdict = verify(path)
    assert work[0] <= bound
    assert verdict.exit_code in (1, 3)
    assert any("what follows is not looked at" in problem for problem in verdict.problems)
    work[0] = 0
    with contextlib.suppress(RecordingError):
        recover(path)
    assert work[0] <= 2 * bound


def test_a_run_in_which_nothing_changes_is_not_too_small_for_what_it_holds(tmp_path: Path) -> None:
    """Of many channels that stand still: no recording packs better."""
    channels = tuple(Channel(f"x_{i}", "V") for i in range(160))
    n = 60_000
    still = SampleBlock(
        channels,
        np.arange(n) * 2_000_000,
        np.arange(n),
        np.zeros((n, 160)),
        np.zeros((n, 160), np.uint8),
    )
    path = tmp_path / "run.mcap"
    with RunWriter(path, channels, RATE, compression="zstd") as writer:
        writer.write(still)
        writer.close(STOP)
    assert SampleLayout(channels, RATE).record.itemsize * n > contents.SMALL
    assert verify(path).status == "whole"
    assert recover(path).exit_code == 0
