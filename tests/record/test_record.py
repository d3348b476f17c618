"""A recording gives back what was put in: samples, gaps, marks, words and results."""

from __future__ import annotations

import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
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
    response,
    write_run,
)

from samii_rig.errors import RecordingError
from samii_rig.record import disk, layout
from samii_rig.record.derived import save_frequency_responses, sha256_of, sources_of
from samii_rig.record.reader import (
    read_events,
    read_frequency_responses,
    read_notes,
    read_recording,
)
from samii_rig.record.verify import verify
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.types import Channel, FrequencyResponse, Recording, SampleBlock, StopRecord


def assert_samples(recording: Recording, parts: list[SampleBlock]) -> None:
    expected = joined(parts)
    found = (recording.time, recording.sequence, recording.values, recording.quality)
    for got, want in zip(found, expected, strict=True):
        np.testing.assert_array_equal(got, want)
        assert got.dtype == want.dtype


def assert_responses_equal(a: FrequencyResponse, b: FrequencyResponse) -> None:
    for field in fields(FrequencyResponse):
        got, want = getattr(a, field.name), getattr(b, field.name)
        if isinstance(want, np.ndarray):
            np.testing.assert_array_equal(got, want)
        else:
            assert got == want, field.name


@pytest.mark.parametrize("compression", ["lz4", "zstd", ""])
def test_a_run_comes_back_as_it_was(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, blocks(), compression=compression)
    recording = read_recording(path)
    assert_samples(recording, blocks())
    assert recording.channels == CHANNELS
    assert recording.rate_hz == RATE
    assert recording.segments == (SEGMENT,)
    assert recording.rig_toml == RIG
    assert recording.experiment_toml == EXPERIMENT
    assert recording.metadata == NOTES
    assert recording.stop == STOP
    assert [(e.time, e.name, e.payload) for e in read_events(path)] == [
        (10**9, "armed", {"by": "test"})
    ]
    found = read_frequency_responses(path)
    assert_responses_equal(found[0], response(0.5))
    assert_responses_equal(found[1], response(1.0))
    verdict = verify(path)
    assert (verdict.status, verdict.problems) == ("whole", ())
    assert (verdict.samples, verdict.gaps, verdict.missing) == (120, 1, 10)
    assert not list(tmp_path.glob("*.partial"))


@settings(max_examples=25)
@given(
    sizes=st.lists(st.integers(0, 4000), min_size=1, max_size=4),
    columns=st.integers(1, 9),
    data=st.data(),
)
def test_any_blocks_come_back(
    tmp_path_factory: pytest.TempPathFactory, sizes: list[int], columns: int, data: st.DataObject
) -> None:
    """Whatever the sizes of the blocks and the bits of the values, chunks do not show."""
    channels = tuple(Channel(f"c{i}", "V") for i in range(columns))
    seed = data.draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    parts, start = [], data.draw(st.integers(0, 2**62))
    for size in sizes:
        sequence = start + np.cumsum(rng.integers(1, 3, size))
        start = int(sequence[-1]) if size else start
        parts.append(
            SampleBlock(
                channels,
                rng.integers(0, 2**62, size),
                sequence.astype(np.int64),
                rng.integers(0, 2**63 - 1, (size, columns)).view(np.float64),
                rng.integers(0, 16, (size, columns), dtype=np.uint8),
            )
        )
    path = tmp_path_factory.mktemp("any") / "run.mcap"
    offset = data.draw(st.integers(0, 2**62))
    with RunWriter(path, channels, 1.0, clock_offset=offset) as writer:
        for part in parts:
            writer.write(part)
        writer.close(STOP)
    recording = read_recording(path)
    values = np.concatenate([p.values for p in parts])
    np.testing.assert_array_equal(recording.values.view(np.int64), values.view(np.int64))
    np.testing.assert_array_equal(recording.sequence, np.concatenate([p.sequence for p in parts]))
    np.testing.assert_array_equal(recording.time, np.concatenate([p.time for p in parts]))
    np.testing.assert_array_equal(recording.quality, np.concatenate([p.quality for p in parts]))
    assert recording.clock_offset == offset


def test_a_run_can_be_read_before_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RunWriter(path, CHANNELS, RATE, Origin(RIG)) as writer:
        writer.write(block(0, 50))
        assert writer.flush() == 50
        so_far = read_recording(writer.partial_path, partial=True)
        assert_samples(so_far, [block(0, 50)])
        assert so_far.stop.status == "unknown"
        with pytest.raises(RecordingError, match="before it is finished"):
            read_recording(writer.partial_path)
        writer.frequency_response(response())
        writer.close(STOP)
    assert len(read_frequency_responses(path)) == 1


def test_an_exception_leaves_a_partial_and_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def run_that_fails() -> None:
        with RunWriter(path, CHANNELS, RATE) as writer:
            writer.write(block(0, 50))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_that_fails()
    assert not path.exists()
    partial = tmp_path / "run.mcap.partial"
    assert_samples(read_recording(partial, partial=True), [block(0, 50)])
    assert verify(partial).exit_code == 3


def test_samples_reach_the_disk_within_a_second_without_a_flush(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE) as writer:
        writer.write(block(0, 5))
        time.sleep(1.0)
        assert len(read_recording(writer.partial_path, partial=True)) == 5


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, blocks())
    with pytest.raises(RecordingError, match="exists already"):
        RunWriter(path, CHANNELS, RATE)
    other = tmp_path / "other.mcap"
    RunWriter(other, CHANNELS, RATE).abort()
    with pytest.raises(RecordingError, match="recover or move"):
        RunWriter(other, CHANNELS, RATE)
    with pytest.raises(RecordingError, match="cannot be written"):
        RunWriter(tmp_path / "no such folder" / "run.mcap", CHANNELS, RATE)


def test_blocks_that_do_not_belong_are_refused(tmp_path: Path) -> None:
    good = block(10, 5)
    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE) as writer:
        writer.write(good)
        with pytest.raises(RecordingError, match="does not rise"):
            writer.write(block(12, 5))
        with pytest.raises(RecordingError, match="does not rise"):
            writer.write(replace(block(20, 5), sequence=np.array([20, 21, 21, 22, 23])))
        with pytest.raises(RecordingError, match="do not have 5 rows"):
            writer.write(replace(block(20, 5), values=np.zeros((4, 3))))
        with pytest.raises(RecordingError, match="0 or later"):
            writer.write(replace(block(20, 5), time=np.arange(-1, 4)))
        with pytest.raises(RecordingError, match="does not belong"):
            writer.write(block(20, 5, CHANNELS[:2]))
        writer.close(STOP)
        with pytest.raises(RecordingError, match="closed already"):
            writer.write(block(20, 5))
    assert_samples(read_recording(writer.path), [good])


def test_a_clock_that_steps_back_is_recorded_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    stepped = replace(block(0, 10), time=np.r_[np.arange(100, 105), np.arange(50, 55)])
    write_run(path, [stepped])
    assert_samples(read_recording(path), [stepped])
    assert verify(path).backwards == 1


def test_a_full_disk_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: object, chunk: object) -> None:
        raise OSError(28, "No space left on device")

    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE) as writer:
        writer.write(block(0, 5))
        writer.flush()
        monkeypatch.setattr(disk.Appender, "add_chunk", full)
        writer.write(block(5, 5))
        with pytest.raises(RecordingError, match="No space left"):
            writer.flush()
        with pytest.raises(RecordingError, match="No space left"):
            writer.write(block(10, 5))
        with pytest.raises(RecordingError, match="No space left"):
            writer.close(STOP)
    assert not writer.path.exists()
    assert len(read_recording(writer.partial_path, partial=True)) == 5


def test_results_of_old_logs_name_their_sources_by_hash(tmp_path: Path) -> None:
    path, derived = tmp_path / "run.mcap", tmp_path / "frf.mcap"
    write_run(path, blocks())
    save_frequency_responses(derived, [response(0.5), response(1.0)], [path])
    assert sources_of(read_notes(derived)) == {"run.mcap": sha256_of(path)}
    assert [r.level for r in read_frequency_responses(derived)] == [0.5, 1.0]
    assert verify(derived).status == "whole"
    with pytest.raises(RecordingError, match="no /samples"):
        read_recording(derived)


def test_a_result_of_wrong_shape_is_refused(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE) as writer:
        with pytest.raises(RecordingError, match=r"dof of a response is \(3,\)"):
            writer.frequency_response(replace(response(), dof=np.zeros(3)))
        with pytest.raises(RecordingError, match="names 1 outputs"):
            writer.frequency_response(replace(response(), outputs=CHANNELS[:1]))


@given(st.lists(st.text(max_size=8), min_size=1, max_size=8, unique=True))
def test_every_channel_has_a_field_of_its_own(names: list[str]) -> None:
    fields_ = layout.field_names(tuple(Channel(name, "V") for name in names))
    assert len(set(fields_)) == len(names)
    for field in fields_:
        assert field.isascii()
        assert field == field.lower()
        assert field[0].isalpha()
        assert "__" not in field
        assert not field.endswith("_")


def test_a_run_without_samples_is_a_recording_too(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_run(path, [])
    recording = read_recording(path)
    assert recording.values.shape == (0, 3)
    assert recording.stop == STOP
    assert StopRecord("unknown", "x") != recording.stop
