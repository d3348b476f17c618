"""Foxglove sees a run live: what its protocol announces, and what a client of it receives.

The client here is a bare WebSocket that follows the protocol's description; samples are decoded by
an MCAP viewer's ROS 2 decoder, which knows nothing of ours.
"""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from report_kit import measured
from serve_kit import Service, settings, sweep
from wait_kit import WITHIN, found

pytest.importorskip("foxglove")

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from websockets.exceptions import ConnectionClosedOK
from websockets.sync.client import ClientConnection, connect

from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig
from samii_rig.serve.access import Tokens
from samii_rig.serve.drawn import curves
from samii_rig.serve.foxglove import BODE, Foxglove, usual_channels
from samii_rig.serve.live import LiveReader, LiveWriter
from samii_rig.serve.rooms import Rooms
from samii_rig.types import Channel, SampleBlock
from sim.base import device_channels

CHANNELS = (Channel("u", "V", "reference"), Channel("Theta_2", "rad"))
SAMII = load_rig("samii")[0]
MESSAGE = struct.Struct("<BIQ")  # what it is, subscription, ns


def client(port: int) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"])  # type: ignore[list-item]


def advertised(ws: ClientConnection, topic: str) -> dict[str, Any]:
    """The announcement of a topic; others before it are passed over."""
    while True:
        said = json.loads(ws.recv(WITHIN))
        for channel in said.get("channels", ()):
            if channel["topic"] == topic:
                return dict(channel)


def subscribe(ws: ClientConnection, channel: dict[str, Any]) -> None:
    wanted = [{"id": 7, "channelId": channel["id"]}]
    ws.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def received(ws: ClientConnection, timeout: float = WITHIN) -> tuple[int, bytes]:
    """Time and payload of the next message."""
    while True:
        said = ws.recv(timeout)
        if isinstance(said, bytes):
            kind, subscription, when = MESSAGE.unpack_from(said)
            assert (kind, subscription) == (1, 7)
            return when, said[MESSAGE.size :]


def listening(server: Foxglove, reader: LiveReader) -> None:
    """The run is shown, with its own channels."""

    def shown() -> bool:
        server.show(reader, None)
        return server._server is not None

    found(shown, WITHIN)


def decoder(channel: dict[str, Any]) -> Any:
    text = channel["schema"].encode()
    schema = Schema(id=1, name=channel["schemaName"], encoding=channel["schemaEncoding"], data=text)
    return DecoderFactory().decoder_for(channel["encoding"], schema)


def block(first: int, n: int) -> SampleBlock:
    sequence = np.arange(first, first + n)
    values = np.stack([np.sin(sequence), 0.1 * sequence], axis=1)
    values[sequence % 5 == 3, 1] = np.nan
    return SampleBlock(CHANNELS, sequence * 2_000_000, sequence, values, np.zeros((n, 2), np.uint8))


@pytest.fixture
def shown(tmp_path: Path) -> Iterator[tuple[Foxglove, LiveWriter, LiveReader]]:
    writer = LiveWriter(tmp_path / "run.live", CHANNELS, 500.0)
    server = Foxglove(0, SAMII)
    yield server, writer, LiveReader(writer.path)
    server.close()
    writer.close()


def test_every_sample_arrives_by_name_in_order_and_in_time(
    shown: tuple[Foxglove, LiveWriter, LiveReader],
) -> None:
    server, writer, reader = shown
    listening(server, reader)
    with client(server.port) as ws:
        info = json.loads(ws.recv(WITHIN))
        assert (info["op"], info["name"], info["capabilities"]) == ("serverInfo", "SAMII", [])
        channel = advertised(ws, "/samples")
        assert channel["metadata"] == {"unit.u": "V", "unit.theta_2": "rad"}
        subscribe(ws, channel)
        found(server._samples.has_sinks, WITHIN)
        for first in (0, 20, 40):
            writer.samples(block(first, 20))
            server.show(reader, None)
        read = decoder(channel)
        got = [received(ws) for _ in range(60)]
    messages = [read(data) for _, data in got]
    assert [m.sequence for m in messages] == list(range(60))
    np.testing.assert_array_equal([m.u for m in messages], np.sin(np.arange(60)))
    missing = np.arange(60) % 5 == 3
    np.testing.assert_array_equal(np.isnan([m.theta_2 for m in messages]), missing)
    assert [bytes(m.quality) for m in messages] == [bytes([0, bool(x)]) for x in missing]
    np.testing.assert_allclose(np.diff([when for when, _ in got]), 2e6, atol=1)


def test_who_is_there_before_a_run_sees_it_and_the_next_by_one_subscription(tmp_path: Path) -> None:
    server = Foxglove(0, SAMII)
    channels = usual_channels(SAMII)
    with client(server.port) as ws:
        subscribe(ws, advertised(ws, "/samples"))
        found(server._samples.has_sinks, WITHIN)
        for run in range(2):
            writer = LiveWriter(tmp_path / f"{run}.live", channels, SAMII.rate_hz)
            reader = LiveReader(writer.path)
            server.show(reader, None)
            n = np.zeros((5, len(channels)))
            sequence = np.arange(5)
            writer.samples(SampleBlock(channels, sequence, sequence, n, n.astype(np.uint8)))
            server.show(reader, None)
            for _ in range(5):
                received(ws)
            server.show(None, None)
            writer.close()
    server.close()


@pytest.mark.parametrize("name", ["samii", "sflr"])
def test_a_simulated_rig_reports_what_is_announced_before_its_run(name: str) -> None:
    rig = load_rig(name)[0]
    told = [(c.name, c.unit, c.role) for c in device_channels(rig)]
    assert [(c.name, c.unit, c.role) for c in usual_channels(rig)] == told


def test_a_run_with_other_channels_is_announced_whole_at_the_same_port(
    shown: tuple[Foxglove, LiveWriter, LiveReader],
) -> None:
    server, _, reader = shown
    port = server.port
    with client(port) as ws:
        advertised(ws, "/samples")
        listening(server, reader)
        with suppress(ConnectionClosedOK):
            advertised(ws, "/no such topic")
    assert server.port == port
    with client(port) as ws:
        assert advertised(ws, "/samples")["metadata"] == {"unit.u": "V", "unit.theta_2": "rad"}


def test_frequency_responses_come_as_curves_by_output(
    shown: tuple[Foxglove, LiveWriter, LiveReader], tmp_path: Path
) -> None:
    server, _, _ = shown
    r = measured()
    told = {"responses": [{"level": 1.0, "unit": "V", **curves(r)}]}
    file = tmp_path / "responses.json"
    file.write_text(json.dumps(told))
    with client(server.port) as ws:
        channel = advertised(ws, BODE)
        assert channel["encoding"] == "json"
        subscribe(ws, channel)
        found(server._bode.has_sinks, WITHIN)
        server.show(None, file)
        (one,) = json.loads(received(ws)[1])["responses"]
        gain = np.interp(one["frequency"], r.frequency, np.abs(r.H[:, 1, 0]))
        # Four digits of a frequency, on the flanks of a resonance.
        np.testing.assert_allclose(one["a_0"]["gain"], gain, rtol=0.05)
        # The same once more is not sent at once.
        server.show(None, file)
        with pytest.raises(TimeoutError):
            received(ws, timeout=0.3)


def test_a_port_that_is_taken_costs_one_line(
    shown: tuple[Foxglove, LiveWriter, LiveReader],
) -> None:
    with pytest.raises(InputError, match="a free port"):
        Foxglove(shown[0].port, SAMII)


def test_a_failing_foxglove_takes_nothing_down(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rooms = Rooms(settings(tmp_path, foxglove=0))
    broken = rooms.foxglove
    assert broken is not None
    viewer = rooms.viewers.add()

    async def work() -> None:
        with (
            patch.object(broken, "show", side_effect=RuntimeError("a display that breaks")),
            patch.object(rooms, "_refresh") as refreshed,
            suppress(TimeoutError),
        ):
            await asyncio.wait_for(rooms.work(), 1.0)
        # What comes after it is done as ever.
        assert refreshed.called

    asyncio.run(work())
    assert json.loads(asyncio.run(viewer.next()))["rig"] == "SAMII"
    assert rooms.foxglove is None
    with pytest.raises(OSError, match="refused"):
        client(broken.port)
    (said,) = [r for r in caplog.records if r.name == "samii_rig.serve"]
    assert "Foxglove failed and is off" in said.message


def test_where_others_show_a_token_an_open_port_is_asked_for_by_name(tmp_path: Path) -> None:
    kept = Tokens(tmp_path / "tokens.json")
    kept.add("Ada", "operator")
    with pytest.raises(InputError, match="--foxglove is 0; expected --foxglove-open"):
        settings(tmp_path, kept, foxglove=0).check()
    settings(tmp_path, kept, foxglove=0, foxglove_open=True).check()
    settings(tmp_path, foxglove=0).check()


def test_a_run_of_the_service_is_seen(tmp_path: Path) -> None:
    with Service(tmp_path, "--rig", "samii", "--foxglove", "0", "--pace", "2") as service:
        assert service.process.stdout is not None
        line = service.process.stdout.readline()
        with client(int(line.rpartition(":")[2])) as ws, service.lease() as lease:
            service.start(lease, sweep(120.0))  # longer than a busy machine may take to subscribe
            channel = advertised(ws, "/samples")
            subscribe(ws, channel)
            read = decoder(channel)
            messages = [read(received(ws)[1]) for _ in range(200)]
            service.http.post("/api/stop")
        sequence = [m.sequence for m in messages]
        assert sequence == list(range(sequence[0], sequence[0] + 200))
        assert hasattr(messages[0], "theta_2")
