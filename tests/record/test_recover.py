"""What was on the disk is given back: after a kill, a cut at any byte, or damage."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from record_kit import (
    CHANNELS,
    EXPERIMENT,
    NOTES,
    RATE,
    RIG,
    SEGMENT,
    STOP,
    block,
    blocks,
    joined,
    write_run,
)

from samii_rig.errors import RecordingError
from samii_rig.record import scan
from samii_rig.record.contents import read_contents, read_tail
from samii_rig.record.reader import read_events, read_frequency_responses, read_recording
from samii_rig.record.recover import NothingError, default_output, recover
from samii_rig.record.verify import verify
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.types import SampleBlock


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    write_run(path, blocks())
    return path.read_bytes()


def chunk_ends(path: Path) -> list[tuple[int, int]]:
    """(offset of its end, samples) of every chunk of samples."""
    data = scan.mapped(path)
    found = read_contents(data, len(data), strict=False).chunks
    return [(c.head.span.end, c.counts[1]) for c in found if 1 in c.counts]


def assert_prefix(path: Path, rows: int) -> None:
    """The recording holds exactly the first `rows` samples of `blocks()`."""
    recording = read_recording(path)
    found = (recording.time, recording.sequence, recording.values, recording.quality)
    for got, want in zip(found, joined(blocks()), strict=True):
        np.testing.assert_array_equal(got, want[:rows])


def test_a_file_cut_at_any_byte_gives_back_what_is_there(tmp_path: Path, whole: bytes) -> None:
    path, output = tmp_path / "run.mcap", tmp_path / "again.mcap"
    path.write_bytes(whole)
    ends = chunk_ends(path)
    steps = set(range(0, len(whole), 211))
    for end, _ in ends:
        steps |= set(range(end - 2, end + 3))
    for length in sorted(steps):
        path.write_bytes(whole[:length])
        rows = sum(n for end, n in ends if end <= length)
        verdict = verify(path)
        assert verdict.status == ("lossy" if rows else "nothing"), length
        assert verdict.samples == rows
        if rows:
            recovered = recover(path, output)
            assert recovered.samples == rows
            assert recovered.exit_code == 0, recovered.problems
            assert_prefix(output, rows)
            assert verify(output).status == "whole"
            output.unlink()
        elif length < ends[0][0] // 2:  # before the first event
            with pytest.raises(RecordingError):
                recover(path, output)
            assert not list(tmp_path.glob("again*"))


def test_all_but_the_samples_comes_back_too(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap.partial"
    path.write_bytes(whole[: len(whole) - 20])  # all but the end of the footer
    recovered = recover(path)
    assert recovered.path == tmp_path / "run.recovered.mcap"
    assert (recovered.events, recovered.responses, recovered.segments) == (1, 2, 1)
    recording = read_recording(recovered.path)
    assert recording.channels == CHANNELS
    assert recording.segments == (SEGMENT,)
    assert (recording.rig_toml, recording.experiment_toml) == (RIG, EXPERIMENT)
    assert recording.metadata.items() >= NOTES.items()
    assert recording.metadata["recovered_from"] == "run.mcap.partial"
    assert recording.stop.status == "completed"
    assert [e.name for e in read_events(recovered.path)] == ["armed"]
    assert len(read_frequency_responses(recovered.path)) == 2


def test_a_run_cut_off_says_so_in_its_stop_record(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "run.mcap", CHANNELS, RATE)
    writer.write(block(0, 9))
    writer.abort()
    recording = read_recording(recover(writer.partial_path).path)
    assert recording.stop.status == "unknown"
    assert "cut off" in recording.stop.reason


def test_damage_in_the_middle_costs_no_more_than_its_chunk(tmp_path: Path, whole: bytes) -> None:
    path, output = tmp_path / "run.mcap", tmp_path / "again.mcap"
    path.write_bytes(whole)
    ends = chunk_ends(path)
    sequences = [set(part.sequence.tolist()) for part in blocks()]
    truth = {s: v for part in blocks() for s, v in zip(part.sequence, part.values, strict=True)}
    rng = np.random.default_rng(2)
    for at in rng.integers(8, ends[-1][0], 60):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        recovered = recover(path, output)
        recording = read_recording(output)
        got = set(recording.sequence.tolist())
        assert sum(not chunk <= got for chunk in sequences) <= 1, at
        for sequence, row in zip(recording.sequence, recording.values, strict=True):
            np.testing.assert_array_equal(row, truth[sequence])
        assert recovered.samples == len(recording)
        assert recovered.exit_code == 3 or len(recording) == len(truth), at
        output.unlink()


def test_the_exit_code_tells_a_loss_from_a_missing_end(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(whole)
    chunks = [
        c.head.span for c in read_contents(scan.mapped(path), len(whole), strict=False).chunks
    ]
    first = chunks[1]
    segment = whole.index(SEGMENT.name.encode())
    cases = {
        "whole": (whole, 0),
        "cut": (whole[: chunks[3].end - 5], 0),
        "cut and damaged": (
            whole[: first.end - 1] + bytes([whole[first.end - 1] ^ 1]) + whole[first.end : -40],
            3,
        ),
        "a chunk taken out": (whole[: first.start] + whole[chunks[2].start :], 3),
        "a segment's checksum": (whole[:segment] + b"S" + whole[segment + 1 :], 3),
        "the end of zeros": (whole[: chunks[3].end] + bytes(100), 3),
        "an event alone": (whole[: first.start], 1),
    }
    for name, (content, code) in cases.items():
        path.write_bytes(content)
        recovered = recover(path, tmp_path / f"{name}.mcap")
        assert recovered.exit_code == code, (name, recovered.problems)
    for content in (b"", whole[:300]):
        path.write_bytes(content)
        with pytest.raises(NothingError) as refused:
            recover(path, tmp_path / "nothing.mcap")
        assert refused.value.exit_code == 1


def test_recover_overwrites_nothing(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(whole)
    recover(path)
    with pytest.raises(RecordingError, match="exists already"):
        recover(path)
    assert path.read_bytes() == whole
    assert default_output(tmp_path / "a.mcap.partial") == tmp_path / "a.recovered.mcap"


CHILD = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
from record_kit import CHANNELS, RATE, block
from samii_rig.record.writer import RunWriter
writer = RunWriter(Path({path!r}), CHANNELS, RATE)
start = 0
while True:
    for rows in (1, 700, 13, 20_000, 250):
        writer.write(block(start, rows))
        start += rows
        time.sleep({pause})
        report = writer.flush() if {flush} else start
        print(report, time.monotonic(), flush=True)
"""


@pytest.mark.parametrize("delay", [0.0, 0.003, 0.02, 0.05, 0.13, 0.31])
def test_a_killed_run_gives_back_all_that_was_flushed(tmp_path: Path, delay: float) -> None:
    samples, _ = _killed(tmp_path, flush=True, pause=0.0, delay=delay)
    partial = tmp_path / "run.mcap.partial"
    assert verify(partial).exit_code == 3
    recovered = recover(partial)
    assert recovered.samples >= samples
    assert_continuous(recovered.path)
    assert verify(recovered.path).status == "whole"


def test_a_killed_run_loses_no_more_than_a_second(tmp_path: Path) -> None:
    """Nobody flushed: what was written more than a second before the kill is there."""
    samples, _ = _killed(tmp_path, flush=False, pause=0.01, delay=1.6)
    recovered = recover(tmp_path / "run.mcap.partial")
    assert 0 < samples <= recovered.samples
    assert_continuous(recovered.path)


def _killed(folder: Path, *, flush: bool, pause: float, delay: float) -> tuple[int, float]:
    """Run the child, kill it `delay` s after its first report.

    Returns what it had reported: at all if it flushes, else a second before the kill.
    """
    tests = str(Path(__file__).resolve().parents[1] / "kits")
    code = CHILD.format(tests=tests, path=str(folder / "run.mcap"), flush=flush, pause=pause)
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        reports = [child.stdout.readline()]
        time.sleep(delay)
        killed = time.monotonic()
        child.send_signal(signal.SIGKILL)
        reports += child.stdout.readlines()
    before = killed if flush else killed - 1.0
    counted = [0]
    for line in reports:
        count, _, moment = line.strip().partition(" ")
        if line.endswith("\n") and float(moment) <= before:
            counted.append(int(count))
    return counted[-1], killed


def assert_continuous(path: Path) -> None:
    """Every sample from the first on, with the value that it was given."""
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.sequence, np.arange(len(recording)))
    start = 0
    sizes = (1, 700, 13, 20_000, 250)
    for i in range(len(recording)):
        rows = sizes[i % len(sizes)]
        part: SampleBlock = block(start, rows)
        rest = recording.values[start : start + rows]
        np.testing.assert_array_equal(rest, part.values[: len(rest)])
        start += rows
        if start >= len(recording):
            break


def test_what_was_noted_later_stands_in_place_of_what_was_before(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RunWriter(path, CHANNELS, RATE, Origin(metadata={"seed": "7", "clock": "1 ms"}))
    writer.write(block(0, 10))
    writer.flush()
    writer.note({"clock": "2 ms"})
    writer.flush()
    cut = tmp_path / "cut.mcap"
    recover(writer.partial_path, cut)
    writer.close(STOP)
    assert read_recording(path).metadata == {"seed": "7", "clock": "2 ms"}
    assert verify(path).status == "whole"
    notes = read_recording(cut).metadata
    assert (notes["seed"], notes["clock"]) == ("7", "2 ms")


def spans_of(whole: bytes, opcode: int) -> list[scan.Span]:
    """The records of one kind in the data."""
    data = memoryview(whole)
    end = read_tail(data).summary_start
    return [s for s in scan.spans(data, scan.MAGIC_SIZE, end) if s.opcode == opcode]


def assert_all_back(path: Path, output: Path, code: int = 3) -> None:
    """All samples, events, segments and results of `write_run`, in their order."""
    recovered = recover(path, output)
    assert recovered.exit_code == code, recovered.problems
    assert_prefix(output, len(joined(blocks())[0]))
    source = path.with_name("source.mcap")
    assert read_events(output) == read_events(source)
    assert read_recording(output).segments == read_recording(source).segments
    assert len(read_frequency_responses(output)) == len(read_frequency_responses(source))
    assert read_recording(output).stop == read_recording(source).stop
    output.unlink()


def test_chunks_that_changed_places_come_back_in_order(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    (tmp_path / "source.mcap").write_bytes(whole)
    chunks = spans_of(whole, Opcode.CHUNK)
    indices = spans_of(whole, Opcode.MESSAGE_INDEX)
    # The first holds an event, whose place among the samples tells nothing.
    for i, j, code in ((0, 1, 0), (1, 3, 3), (0, 4, 3)):
        a, b = ((chunks[k].start, indices[k].end) for k in (i, j))
        path.write_bytes(
            whole[: a[0]]
            + whole[b[0] : b[1]]
            + whole[a[1] : b[0]]
            + whole[a[0] : a[1]]
            + whole[b[1] :]
        )
        assert_all_back(path, tmp_path / "again.mcap", code)


def test_a_byte_that_is_gone_from_an_index_costs_nothing(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    (tmp_path / "source.mcap").write_bytes(whole)
    rng = np.random.default_rng(5)
    for index in spans_of(whole, Opcode.MESSAGE_INDEX):
        for at in {index.start, index.start + 1, int(rng.integers(index.start, index.end))}:
            path.write_bytes(whole[:at] + whole[at + 1 :])
            assert_all_back(path, tmp_path / "again.mcap")


def test_a_chunk_that_is_there_twice_comes_back_once(tmp_path: Path, whole: bytes) -> None:
    path, output = tmp_path / "run.mcap", tmp_path / "again.mcap"
    chunk, index = spans_of(whole, Opcode.CHUNK)[1], spans_of(whole, Opcode.MESSAGE_INDEX)[1]
    path.write_bytes(whole[: index.end] + whole[chunk.start : index.end] + whole[index.end :])
    recovered = recover(path, output)
    assert recovered.exit_code == 3
    assert any("already" in problem for problem in recovered.problems)
    assert_prefix(output, len(joined(blocks())[0]))
