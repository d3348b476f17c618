"""A disk that is full, or goes away: one line, the output at zero, and all that was flushed kept.

Plan: no room is said before anything moves; a disk that is full when the file is made leaves
no file; one that fills in the run ends it with all that was flushed; a folder that is taken away
ends it soon; what can be made again leaves no half of itself.
"""

from __future__ import annotations

import resource
import shutil
from collections import namedtuple
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from burst_kit import PLAN, PREDICTED, RIG
from fake_device import RATE, FakeDevice
from record_kit import CHANNELS, block, blocks, response, write_run

from samii_rig.errors import DiskError, RecordingError
from samii_rig.record.derived import save_frequency_responses
from samii_rig.record.reader import read_recording
from samii_rig.record.recover import recover
from samii_rig.record.store import write_recording
from samii_rig.record.writer import RunWriter
from samii_rig.run import campaign, space
from samii_rig.run.ending import finish
from samii_rig.run.order import RunOrder
from samii_rig.types import StopRecord

HEAD = 20_000  # bytes: more than what stands before the samples, less than a run


@contextmanager
def full_at(size: int) -> Iterator[None]:
    """No file can grow beyond `size` bytes: the system refuses as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> FakeDevice:
    device = FakeDevice()
    monkeypatch.setattr(campaign, "open_device", lambda rig, settings: device.open())
    return device


@pytest.mark.parametrize("size", [0, 100])
def test_a_disk_that_is_full_at_the_start_leaves_no_file(tmp_path: Path, size: int) -> None:
    with full_at(size), pytest.raises(DiskError, match=r"run\.mcap cannot be written: ") as full:
        RunWriter(tmp_path / "run.mcap", CHANNELS, RATE)
    assert full.value.exit_code == 6
    assert not list(tmp_path.iterdir())


def test_a_run_on_a_disk_that_fills_ends_at_zero_and_says_what_is_left(
    tmp_path: Path, device: FakeDevice
) -> None:
    path = tmp_path / "run.mcap"
    with full_at(HEAD), pytest.raises(DiskError) as full:
        campaign.carry_out(RunOrder(RIG, "", "", PLAN, PREDICTED), path)
    assert device.v == 0.0
    assert not device.live
    said = str(full.value)
    assert "\n" not in said
    assert "the output is at zero" in said
    assert f"samii-rig recover {path}.partial gives back the " in said
    assert not path.exists()


def test_all_that_was_flushed_before_the_disk_was_full_comes_back(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE) as writer:
        writer.write(block(0, 500))
        writer.flush()
        with full_at(writer.partial_path.stat().st_size + 10):
            writer.write(block(500, 5000))
            with pytest.raises(DiskError, match="gives back the 500 samples"):
                finish(writer, StopRecord("completed", "all done"))
    assert recover(writer.partial_path).samples == 500


def test_an_output_that_is_not_at_zero_is_not_said_to_be(tmp_path: Path) -> None:
    stop = StopRecord("failed", "THE OUTPUT IS NOT AT ZERO: v read 1 V after zero")
    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE) as writer:
        writer.write(block(0, 5000))
        with full_at(0), pytest.raises(DiskError, match="THE OUTPUT IS NOT AT ZERO") as full:
            finish(writer, stop)
    assert "the output is at zero" not in str(full.value)


@pytest.mark.parametrize("gone", [shutil.rmtree, lambda folder: folder.rename(f"{folder}_2")])
def test_a_folder_that_is_taken_away_ends_the_run(tmp_path: Path, gone) -> None:  # type: ignore[no-untyped-def]
    folder = tmp_path / "runs"
    folder.mkdir()
    with RunWriter(folder / "run.mcap", CHANNELS, RATE) as writer:
        writer.write(block(0, 50))
        gone(folder)
        with pytest.raises(DiskError, match="moved or removed"):
            writer.flush()
        with pytest.raises(DiskError, match="moved or removed"):
            writer.write(block(50, 50))


def test_a_copy_that_does_not_fit_leaves_nothing_of_itself(tmp_path: Path) -> None:
    source = tmp_path / "run.mcap"
    write_run(source, blocks())
    recording = read_recording(source)
    target = tmp_path / "copy.mcap"
    for size in (0, source.stat().st_size // 2):
        with full_at(size):
            with pytest.raises(DiskError, match=r"copy\.mcap.* cannot be written"):
                recover(source, target)
            with pytest.raises(DiskError):
                write_recording(target, recording)
            with pytest.raises(DiskError):
                save_frequency_responses(target, [response(float(i)) for i in range(100)], [source])
        assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


Disk = namedtuple("Disk", "total used free")


def test_a_plan_without_room_is_refused_before_anything_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: FakeDevice
) -> None:
    path = tmp_path / "not yet" / "run.mcap"
    need = space.recording_bytes(PLAN, RIG)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: Disk(10 * need, 0, need - 1))
    with pytest.raises(DiskError, match=f"{tmp_path} has .* MB free; expected "):
        campaign.carry_out(RunOrder(RIG, "", "", PLAN, PREDICTED), path)
    assert not device.written
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: Disk(10 * need, 0, need))
    space.room_for(path, [PLAN], [RIG])
    with pytest.raises(DiskError):
        space.room_for(path, [PLAN, PLAN], [RIG, RIG])
    # A file system that does not say its size.
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: Disk(0, 0, 0))
    space.room_for(path, [PLAN], [RIG])


@pytest.mark.usefixtures("device")
def test_a_recording_takes_no_more_than_is_asked_for(tmp_path: Path) -> None:
    outcome = campaign.carry_out(RunOrder(RIG, "", "", PLAN, PREDICTED), tmp_path / "run.mcap")
    assert outcome.path.stat().st_size < space.recording_bytes(PLAN, RIG)


def test_a_name_that_cannot_be_is_no_fault_of_the_disk(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file") as wrong:
        RunWriter(tmp_path / "nowhere" / "run.mcap", CHANNELS, RATE)
    assert wrong.value.exit_code == 2
