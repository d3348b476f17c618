"""Readers that we did not write read a recording by name, with the right values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from record_kit import CHANNELS, EXPERIMENT, NOTES, RIG, WALL, blocks, joined, response, write_run

from samii_rig.record import layout
from samii_rig.types import Channel


@pytest.fixture(scope="module", params=["lz4", "zstd", ""])
def path(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    path = tmp_path_factory.mktemp("mcap") / "run.mcap"
    write_run(path, blocks(), compression=request.param)
    return path


def test_every_signal_is_a_named_field(path: Path) -> None:
    time, sequence, values, quality = joined(blocks())
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        seen = list(reader.iter_decoded_messages(topics=["/samples"]))
    assert [m.message.log_time for m in seen] == (time + WALL).tolist()
    assert [m.message.publish_time for m in seen] == (time + WALL).tolist()
    assert [m.decoded_message.sequence for m in seen] == sequence.tolist()
    for column, channel in enumerate(CHANNELS):
        found = [getattr(m.decoded_message, channel.name) for m in seen]
        np.testing.assert_array_equal(found, values[:, column])
    assert [list(m.decoded_message.quality) for m in seen] == quality.tolist()


def test_units_stand_in_the_channel_metadata_and_the_schema(path: Path) -> None:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    channel = next(c for c in summary.channels.values() if c.topic == "/samples")
    assert channel.metadata["unit.theta"] == "rad"
    assert "float64 theta  # rad, sensor theta" in summary.schemas[channel.schema_id].data.decode()


def test_the_index_and_the_statistics_agree_with_the_data(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.channel_message_counts == {1: 120, 2: 1, 3: 2}
        in_order = list(reader.iter_messages(topics=["/samples"], log_time_order=True))
        one = list(
            reader.iter_messages(
                topics=["/samples"],
                starting_at=WALL + 1_002_000_000,
                ending_before=WALL + 1_004_000_000,
            )
        )
        attached = {a.name: a.data.decode() for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert len(in_order) == 120
    assert [m.log_time for _, _, m in one] == [WALL + 1_002_000_000]
    assert attached == {"rig.toml": RIG, "experiment.toml": EXPERIMENT}
    assert layout.unsealed(metadata[layout.NOTES], "notes") == NOTES
    assert metadata[layout.STOP]["status"] == "completed"
    assert metadata[layout.RESPONSE]["method"] == "periodic"
    with path.open("rb") as file:
        streamed = NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        assert sum(1 for _ in streamed) == 123


def test_the_library_finds_every_crc_right(path: Path) -> None:
    with path.open("rb") as file:
        assert list(StreamReader(file, validate_crcs=True).records)


def test_a_result_decodes_without_us(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        seen = [m.decoded_message for m in reader.iter_decoded_messages(["/frequency_response"])]
    want = response(0.5)
    np.testing.assert_array_equal(seen[0].frequency, want.frequency)
    H = np.array(seen[0].h_real) + 1j * np.array(seen[0].h_imag)
    np.testing.assert_array_equal(H, want.H.ravel())
    assert seen[0].why == want.why
    assert [m.level for m in seen] == [0.5, 1.0]


def test_an_event_is_a_log_message(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        (seen,) = reader.iter_decoded_messages(["/events"])
    assert seen.schema is not None
    assert seen.schema.name == "rcl_interfaces/msg/Log"
    assert (seen.decoded_message.name, seen.decoded_message.stamp.sec) == (
        "armed",
        WALL // 10**9 + 1,
    )


def test_awkward_names_still_make_a_schema_that_others_parse() -> None:
    names = ("Theta_2__x_", "2nd accelerometer", "sequence", "°", "A", "a")
    text = layout.SampleLayout(tuple(Channel(n, "m/s^2\nx") for n in names), 1.0).schema_text()
    schema = Schema(id=1, data=text.encode(), encoding="ros2msg", name=layout.SAMPLES_SCHEMA)
    assert DecoderFactory().decoder_for("cdr", schema) is not None
    assert "float64 theta_2_x " in text
