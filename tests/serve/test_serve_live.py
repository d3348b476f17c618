"""Live data reach those who look, and nobody who looks can slow anyone.

Plan: the ring between runner and service (laws: what is read is what was written, or said to be
lost); frames and their decimation; a viewer that is slow; the WebSocket itself.
"""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from serve_kit import Service
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from samii_rig.devices.opening import open_device
from samii_rig.errors import RecordingError
from samii_rig.rig.load import load_rig
from samii_rig.serve.access import Tokens
from samii_rig.serve.live import LEAST_ROWS, LiveReader, LiveWriter
from samii_rig.serve.viewers import DEPTH, HEAD, Viewer, Viewers, decimated, frame
from samii_rig.types import Channel, SampleBlock

CHANNELS = (Channel("u", "V", "reference"), Channel("theta", "rad"))


def block(first: int, rows: int) -> SampleBlock:
    """Samples that say by their values where they belong."""
    sequence = np.arange(first, first + rows)
    values = np.column_stack([sequence * 1.0, -1.0 * sequence])
    quality = np.zeros((rows, 2), np.uint8)
    return SampleBlock(CHANNELS, sequence * 1000, sequence, values, quality)


@settings(max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 700), st.booleans()), max_size=12))
def test_what_is_read_was_written_and_the_rest_is_said_to_be_lost(
    steps: list[tuple[int, bool]],
) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.live"
        writer = LiveWriter(path, CHANNELS, 100.0)
        reader = LiveReader(path)
        written = row = lost = 0
        for rows, read in steps:
            writer.samples(block(written, rows))
            written += rows
            if read:
                new = reader.since(row)
                lost += new.lost
                row += new.lost + len(new.sequence)
                assert row == written
                np.testing.assert_array_equal(
                    new.sequence, np.arange(row)[row - len(new.sequence) :]
                )
                np.testing.assert_array_equal(new.values[:, 0], new.sequence)
                np.testing.assert_array_equal(new.values[:, 1], -new.sequence)
        assert lost == 0 or written > LEAST_ROWS


def test_progress_and_signs_of_life_go_both_ways(tmp_path: Path) -> None:
    writer = LiveWriter(tmp_path / "x.live", CHANNELS, 100.0)
    reader = LiveReader(tmp_path / "x.live")
    assert [c["name"] for c in reader.channels] == ["u", "theta"]
    assert reader.progress() == {}
    writer.progress({"segment": 2, "frequency": None})
    assert reader.progress() == {"segment": 2, "frequency": None}
    time.sleep(0.2)
    before = writer.silence()
    assert before >= 0.2
    reader.beat()
    assert writer.silence() < before
    writer.close()
    with pytest.raises(RecordingError, match="no live data"):
        LiveReader(tmp_path / "x.live")
    writer.samples(block(0, 5))
    assert reader.whole == 5  # who has it open keeps it


def test_a_file_that_is_none_of_ours_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"\0" * 100_000)
    with pytest.raises(RecordingError):
        LiveReader(tmp_path / "x")


def test_decimation_keeps_every_peak() -> None:
    rng = np.random.default_rng(3)
    x = rng.standard_normal((1200, 2))
    x[7, 0] = np.nan
    x[600:606, 1] = np.nan
    thin = decimated(x, 6)
    assert thin.shape == (400, 2)
    assert np.nanmax(thin) == np.nanmax(x)
    assert np.nanmin(thin) == np.nanmin(x)
    assert np.isnan(thin[200:202, 1]).all()
    assert np.isfinite(thin[:, 0]).all()
    assert decimated(x, 1) is x


def test_a_frame_says_what_is_in_it() -> None:
    data = frame(block(7, 4).values, 1, 500.0, 7)
    kind, _, columns, rows, step, lost, rate, first = HEAD.unpack_from(data)
    assert (kind, columns, rows, step, lost, rate, first) == (1, 2, 4, 1, 0, 500.0, 7)
    values = np.frombuffer(data, "<f4", offset=HEAD.size).reshape(rows, columns)
    np.testing.assert_array_equal(values[:, 0], [7, 8, 9, 10])


def test_a_viewer_that_is_slow_loses_the_oldest_frames_and_is_told_how_many() -> None:
    viewer = Viewer()
    for i in range(DEPTH + 10):
        viewer.give(frame(block(i, 1).values, 1, 500.0, i))

    async def read() -> list[bytes | str]:
        return [await viewer.next() for _ in range(DEPTH)]

    heads = [HEAD.unpack_from(f) for f in asyncio.run(read()) if isinstance(f, bytes)]
    assert [h[-1] for h in heads] == list(range(10, DEPTH + 10))
    assert {h[5] for h in heads} == {10}


def test_all_viewers_get_the_same_and_late_ones_no_old_picture(tmp_path: Path) -> None:
    writer = LiveWriter(tmp_path / "x.live", CHANNELS, 100.0)
    reader = LiveReader(tmp_path / "x.live")
    viewers = Viewers()
    viewers.show(reader, {"n": 1})
    writer.samples(block(0, 10))
    viewers.show(reader, None)
    a, b = viewers.add(), viewers.add()
    writer.samples(block(10, 10))
    viewers.show(reader, {"n": 2})

    async def read(viewer: Viewer) -> list[bytes | str]:
        return [await viewer.next() for _ in range(3)]

    for viewer in (a, b):
        first, second, third = asyncio.run(read(viewer))
        assert json.loads(first)["n"] == 1
        assert json.loads(second)["n"] == 2
        assert isinstance(third, bytes)
        assert HEAD.unpack_from(third)[-1] == 10


def test_a_simulated_rig_keeps_pace_with_real_time_if_it_is_asked_to() -> None:
    rig, _ = load_rig("samii")
    for pace, least in ((10.0, 0.05), (0.0, 0.0)):
        start = time.monotonic()  # the device paces itself from its own opening on
        device = open_device(rig, {"pace": pace, "seed": 1})
        for _ in range(10):
            device.clock.sleep(0.05)
        assert time.monotonic() - start >= 0.99 * least
        assert len(device.sensor.read()) == round(0.5 * rig.rate_hz)


def test_the_websocket_tells_the_state_and_wants_a_token_and_our_origin(tmp_path: Path) -> None:
    token = Tokens(tmp_path / "t.json").add("Ada", "viewer")
    options = ("--tokens", str(tmp_path / "t.json"))
    with Service(tmp_path / "runs", *options, token=token) as service:
        url = service.url.replace("http", "ws") + "/api/live"
        for headers in ({}, {"authorization": "Bearer wrong"}):
            with pytest.raises(InvalidStatus):
                connect(url, additional_headers=headers)
        good = {"authorization": f"Bearer {token}"}
        with pytest.raises(InvalidStatus):
            connect(url, additional_headers=good, origin="http://evil.example")  # type: ignore[arg-type]
        with connect(url, additional_headers=good) as socket:
            state = json.loads(socket.recv(timeout=30))
            assert (state["kind"], state["rig"]) == ("state", "SAMII")
            service.until(lambda: json.loads(socket.recv(timeout=30))["viewers"] == 1)
        service.until(lambda: service.state()["viewers"] == 0)
