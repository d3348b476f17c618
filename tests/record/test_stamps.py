"""Stamps are the wall clock's; the device's own clock is what a recording is read in."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from fake_device import RATE as RATE_OF_FAKE
from fake_device import FakeDevice, fake_rig
from mcap.reader import make_reader
from record_kit import CHANNELS, RATE, WALL, block, blocks, joined, response, write_run

from samii_rig.devices.clock import MonotonicClock
from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import InputError, RecordingError
from samii_rig.index.entry import read_entry
from samii_rig.record.derived import save_frequency_responses
from samii_rig.record.importer import import_file
from samii_rig.record.maps import ImportMap
from samii_rig.record.reader import read_events, read_frequency_responses, read_recording
from samii_rig.record.recover import recover
from samii_rig.record.store import write_recording
from samii_rig.record.verify import verify
from samii_rig.record.writer import RunWriter
from samii_rig.rig.load import parse
from samii_rig.run.loop import run
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.run.sink import QueuedSink, Watched, recorded_channels
from samii_rig.signal.excitation import swept_sine
from samii_rig.types import StopRecord

OLD = Path(__file__).resolve().parents[1] / "data" / "stamps_of_the_device.mcap"
NS = 10**9


def stamps(path: Path, topic: str = "/samples") -> list[int]:
    """Log times, ns, as another program reads them."""
    with path.open("rb") as file:
        return [m.log_time for _, _, m in make_reader(file).iter_messages(topics=[topic])]


def test_a_recording_from_before_the_wall_clock_reads_as_it_did(tmp_path):
    recording = read_recording(OLD)
    for found, expected in zip(
        (recording.time, recording.sequence, recording.values, recording.quality),
        joined(blocks()),
        strict=True,
    ):
        np.testing.assert_array_equal(found, expected)
    assert recording.clock_offset == 0
    np.testing.assert_array_equal(recording.wall_time, recording.time)
    assert [(e.time, e.name) for e in read_events(OLD)] == [(NS, "armed")]
    assert len(read_frequency_responses(OLD)) == 2
    assert verify(OLD).status == "whole"
    given = recover(OLD, tmp_path / "again.mcap")
    assert given.problems == ()
    np.testing.assert_array_equal(read_recording(given.path).time, recording.time)
    assert stamps(given.path) == recording.time.tolist()  # nobody knows the date: none is made up


def test_the_devices_clock_is_read_and_the_wall_clock_stands_in_the_file(tmp_path):
    path = tmp_path / "run.mcap"
    write_run(path, blocks())
    recording = read_recording(path)
    device = joined(blocks())[0]
    np.testing.assert_array_equal(recording.time, device)
    np.testing.assert_array_equal(recording.wall_time, device + WALL)
    assert recording.to_xarray()["time"].attrs["wall_start_ns"] == int(device[0]) + WALL
    assert stamps(path) == (device + WALL).tolist()
    assert stamps(path, "/events") == [WALL + NS]
    assert stamps(path, "/frequency_response") == [int(device[-1]) + WALL] * 2
    assert [e.time for e in read_events(path)] == [NS]
    assert verify(path).status == "whole"


def test_without_a_word_the_first_sample_is_now(tmp_path):
    before = time.time_ns()
    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE) as writer:
        writer.write(block(0, 5))
        writer.event(NS, "armed")
        writer.close(StopRecord("completed", ""))
    recording = read_recording(writer.path)
    np.testing.assert_array_equal(recording.time, block(0, 5).time)
    assert before <= recording.wall_time[-1] <= time.time_ns()
    assert [e.time for e in read_events(writer.path)] == [NS]


def test_the_first_pair_of_clocks_counts_and_a_step_of_the_wall_clock_changes_nothing(tmp_path):
    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE) as writer:
        writer.clocks(NS, WALL)
        writer.write(block(0, 5))
        writer.clocks(2 * NS, WALL - 3600 * NS)
        writer.write(block(5, 5))
        writer.close(StopRecord("completed", ""))
    recording = read_recording(writer.path)
    assert recording.clock_offset == WALL - NS
    np.testing.assert_array_equal(np.diff(recording.wall_time), np.diff(recording.time))


def test_clocks_too_far_apart_are_refused_and_leave_nothing(tmp_path):
    with pytest.raises(RecordingError, match="ahead of the device's; expected within"):
        RunWriter(tmp_path / "run.mcap", CHANNELS, RATE, clock_offset=1 << 63)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("moved", [-1, 1 << 62])
def test_a_stamp_that_no_file_can_hold_is_refused(tmp_path, moved):
    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE, clock_offset=moved) as writer:
        late = block(0, 2)
        late.time[:] = 0 if moved < 0 else (1 << 62) + 1
        with pytest.raises(RecordingError, match="expected 0 to 2\\^63"):
            writer.write(late)


def test_a_run_that_was_cut_off_keeps_both_clocks(tmp_path):
    writer = RunWriter(tmp_path / "run.mcap", CHANNELS, RATE, clock_offset=WALL)
    writer.event(NS, "armed")
    writer.write(block(0, 50))
    writer.abort()
    given = recover(writer.partial_path)
    assert given.exit_code == 0
    recording = read_recording(given.path)
    np.testing.assert_array_equal(recording.time, block(0, 50).time)
    assert recording.clock_offset == WALL
    assert [e.time for e in read_events(given.path)] == [NS]
    copy = tmp_path / "copy.mcap"
    write_recording(copy, recording)
    assert stamps(copy) == stamps(given.path)


def test_saved_responses_are_stamped_when_they_are_saved(tmp_path):
    source, path = tmp_path / "run.mcap", tmp_path / "frf.mcap"
    write_run(source, blocks())
    before = time.time_ns()
    save_frequency_responses(path, [response()], [source])
    (stamp,) = stamps(path, "/frequency_response")
    assert before <= stamp <= time.time_ns()


def test_the_index_dates_a_recording_by_its_stamps(tmp_path):
    write_run(tmp_path / "run.mcap", blocks())
    assert read_entry(tmp_path, "run.mcap").started == "2026-11-23T14:00:01+00:00"


class Noted:
    """A sink that keeps the pairs of clocks that it is told."""

    def __init__(self) -> None:
        self.pairs: list[tuple[int, int]] = []
        self.done = threading.Event()

    def write(self, block):
        self.done.set()

    def event(self, time, name, payload): ...

    def segment(self, segment): ...

    def clocks(self, device, wall):
        self.pairs.append((device, wall))


def test_the_clocks_reach_the_recorder_through_queue_and_watch():
    noted = Noted()
    queued = QueuedSink(Watched(noted, lambda block: None))
    queued.clocks(3, 4)
    queued.write(block(0, 1))
    queued.close()
    assert noted.pairs == [(3, 4)]


class Late(FakeDevice):
    """A device on the host's time whose own clock began a day before."""

    ahead = 86_400 * NS

    def __init__(self) -> None:
        super().__init__(self.shifted)
        self.clock, self.zero_at = MonotonicClock(), time.monotonic_ns()

    def shifted(self, block):
        return replace(block, time=block.time + self.ahead)

    def read(self):
        FakeDevice.sleep(self, (self.clock.now() - self.zero_at) * 1e-9 - self.time * 1e-9)
        return super().read()

    def open(self):
        return OpenRig(self, self, self.clock, "fake in real time", {})


U, F = swept_sine(RATE_OF_FAKE, 2.0, 20.0, 0.2, ramp=0.05, lead_in=0.05, ring_down=0.1)
PLAN = Plan(
    "sweep",
    RATE_OF_FAKE,
    "v",
    4.0,
    "theta",
    (PlannedSegment("burst", "burst", 1.0, "V", 0, U, np.zeros_like(U), (2.0, 20.0), F),),
    0,
)


@pytest.mark.parametrize("device", [FakeDevice, Late], ids=["simulated", "in real time"])
def test_a_run_is_stamped_when_it_was_whatever_its_device_thinks(tmp_path, device):
    path = tmp_path / "run.mcap"
    before = time.time_ns()
    given = device()
    with RunWriter(path, recorded_channels(fake_rig(), PLAN, given.channels), RATE) as writer:
        stop = run(PLAN, fake_rig(), given.open(), writer)
        writer.close(stop)
    after = time.time_ns()
    assert stop.status == "completed", stop.reason
    recording = read_recording(path)
    assert recording.time[0] == getattr(given, "ahead", 0)
    # The newest sample of the first block is paired with its arrival, at most a tick later.
    assert before - NS <= recording.wall_time[0] <= after
    noted = read_events(path)
    assert all(recording.time[0] <= e.time <= recording.time[-1] + NS for e in noted)
    (end,) = (e for e in noted if e.name == "stop")
    if device is Late:
        assert before <= end.payload["wall_ns"] <= after
        assert abs(end.payload["wall_ns"] - (end.time + recording.clock_offset)) < 5 * NS
    else:
        assert "wall_ns" not in end.payload


MAP = """
name = "lab"
[format]
kind = "csv"
[time]
column = "t"
{start}
[[channel]]
column = "y"
name = "theta"
unit = "rad"
[segment]
level = 1.0
level_unit = "V"
"""


@pytest.mark.parametrize(
    ("start", "first"),
    [("start = 2026-11-23T15:00:00+01:00", 0.25), ("", 1_795_442_400.0)],
    ids=["the map says it", "time counts from 1970"],
)
def test_an_imported_recording_has_its_date_where_it_is_known(tmp_path, start, first):
    path = tmp_path / "run.csv"
    path.write_text("t,y\n" + "".join(f"{first + i / 4},{i}\n" for i in range(8)))
    recording = import_file(path, parse(ImportMap, MAP.format(start=start), "lab.toml"))
    assert recording.wall_time[0] == WALL
    assert recording.time[0] == round(first * NS)
    write_recording(tmp_path / "run.mcap", recording)
    assert stamps(tmp_path / "run.mcap")[0] == WALL
    assert read_entry(tmp_path, "run.mcap").started == "2026-11-23T14:00:00+00:00"


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ("start = 2026-11-23T15:00:00", "timezone"),
        ("start = 2400-01-01T00:00:00Z", "start is in 2400; expected 1970 to 2100"),
        ("start = 1960-01-01T00:00:00Z", "start is in 1960; expected 1970 to 2100"),
    ],
)
def test_a_date_that_makes_no_stamp_is_refused(start, message):
    with pytest.raises(InputError, match=message):
        parse(ImportMap, MAP.format(start=start), "lab.toml")


def test_a_file_without_a_date_has_none(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,y\n0,0\n1,1\n")
    recording = import_file(path, parse(ImportMap, MAP.format(start=""), "lab.toml"))
    assert (recording.clock_offset, "started" in recording.metadata) == (0, False)
    assert datetime.fromtimestamp(recording.wall_time[0] / NS, UTC).year == 1970
