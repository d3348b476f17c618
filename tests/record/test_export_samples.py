"""The samples of a recording, as other programs read them from the files made for them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyuff
from record_kit import WALL, blocks, write_run
from scipy import io as scipy_io
from scipy.io import wavfile
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.errors import InputError
from samii_rig.record.describe import describe
from samii_rig.record.export_samples import WRITERS, export_samples
from samii_rig.record.first_map import first_map
from samii_rig.record.importer import import_file
from samii_rig.record.maps import ImportMap
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.types import Channel, Recording


@pytest.fixture
def gappy(tmp_path: Path) -> Recording:
    """120 samples of three channels with ten lost, values missing and marks."""
    path = tmp_path / "run.mcap"
    write_run(path, blocks())
    return read_recording(path)


@pytest.fixture
def even(gappy: Recording) -> Recording:
    """Its first samples, without a gap and with every value there."""
    held = gappy.values[:90].copy()
    held[~np.isfinite(held)] = 0.25
    return replace(
        gappy,
        time=gappy.time[:90],
        sequence=gappy.sequence[:90],
        values=held,
        quality=gappy.quality[:90] * 0,
    )


def test_csv_is_exact_with_units_gaps_and_marks(tmp_path, gappy):
    path = export_samples(tmp_path / "run.csv", gappy)
    lines = path.read_text("utf-8").splitlines()
    assert "# rate: 500 Hz" in lines
    assert "# start: 2026-11-23T14:00:01.000000000Z" in lines
    rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    assert rows[0][:5] == ["time [s]", "sequence", "u [V]", "v [V]", "theta [rad]"]
    assert rows[0][5:] == ["quality u", "quality theta"]
    values = np.array(rows[1:], dtype=float)
    np.testing.assert_array_equal(values[:, 0], (gappy.time - gappy.time[0]) * 1e-9)
    np.testing.assert_array_equal(values[:, 1], gappy.sequence)
    np.testing.assert_array_equal(values[:, 2:5], gappy.values)
    np.testing.assert_array_equal(values[:, 5:], gappy.quality[:, [0, 2]])


def test_matlab_variables_by_name(tmp_path, gappy):
    renamed = replace(
        gappy, channels=(Channel("sequence", "V"), Channel("2 v", "V"), Channel("θ", "rad"))
    )
    read = scipy_io.loadmat(export_samples(tmp_path / "run.mat", renamed), squeeze_me=True)
    names = [str(name) for name in read["channels"]]
    assert names == ["sequence_2", "c_2_v", "c__"]
    for i, name in enumerate(names):
        np.testing.assert_array_equal(read[name], gappy.values[:, i])
    np.testing.assert_array_equal(read["sequence"], gappy.sequence)
    np.testing.assert_array_equal(read["quality"], gappy.quality)
    assert list(read["units"]) == ["V", "V", "rad"]
    assert float(read["rate_hz"]) == 500.0
    assert json.loads(str(read["metadata"])) == gappy.metadata


def test_wav_is_a_sound_file_whose_comment_names_the_channels(tmp_path, even):
    path = export_samples(tmp_path / "run.wav", even)
    rate, samples = wavfile.read(path)
    assert rate == 500
    np.testing.assert_array_equal(samples, even.values.astype(np.float32))
    raw = path.read_bytes()
    assert b"ICMT" in raw
    assert b"channels: u [V], v [V], theta [rad]; scale: 1.0 is one unit" in raw
    assert int.from_bytes(raw[4:8], "little") == len(raw) - 8


def test_uff_is_read_by_pyuff(tmp_path, even):
    read = pyuff.UFF(str(export_samples(tmp_path / "run.uff", even))).read_sets()
    assert [one["id1"] for one in read] == ["u", "v", "theta"]
    assert [one["ordinate_axis_units_lab"].strip() for one in read] == ["V", "V", "rad"]
    for i, one in enumerate(read):
        np.testing.assert_array_equal(one["data"], even.values[:, i])
        assert one["abscissa_inc"] == 0.002


def test_parquet_with_units_and_the_wall_clock(tmp_path, gappy):
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra samii-rig[parquet]")
    table = parquet.read_table(export_samples(tmp_path / "run.parquet", gappy))
    for i, channel in enumerate(gappy.channels):
        np.testing.assert_array_equal(table.column(channel.name).to_numpy(), gappy.values[:, i])
        assert table.schema.field(channel.name).metadata[b"unit"].decode() == channel.unit
    stamps = table.column("wall_time").to_numpy().astype("datetime64[ns]").astype(np.int64)
    np.testing.assert_array_equal(stamps, gappy.time + WALL)
    assert table.schema.metadata[b"rate"] == b"500 Hz"


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".uff", ".parquet"])
def test_what_was_exported_is_imported_by_its_first_map(tmp_path, even, suffix):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow.parquet", reason="the extra samii-rig[parquet]")
    path = export_samples(tmp_path / f"run{suffix}", even)
    again = import_file(path, parse(ImportMap, first_map(describe(path)), "first map"))
    assert again.rate_hz == pytest.approx(500.0)
    for i, channel in enumerate(even.channels):
        np.testing.assert_array_equal(
            again.values[:, again.column(channel.name)], even.values[:, i]
        )
        if suffix != ".mat":
            assert again.channels[again.column(channel.name)].unit == channel.unit


@pytest.mark.parametrize("suffix", [".wav", ".uff"])
def test_a_gap_or_a_missing_value_is_refused_where_it_cannot_be_shown(
    tmp_path, gappy, even, suffix
):
    out = tmp_path / f"out{suffix}"
    with pytest.raises(InputError, match="10 samples are missing, the first after sample 89"):
        export_samples(out, gappy)
    holed = replace(even, values=gappy.values[:90])
    with pytest.raises(InputError, match="values are missing, the first in theta at 0"):
        export_samples(out, holed)
    assert not out.exists()


def test_a_rate_that_wav_cannot_hold(tmp_path, even):
    with pytest.raises(InputError, match=r"rate_hz is 0\.5; expected a whole number"):
        export_samples(tmp_path / "out.wav", replace(even, rate_hz=0.5))


def test_from_the_command_line(tmp_path, gappy):
    run = CliRunner().invoke
    source, out = str(tmp_path / "run.mcap"), tmp_path / "out.csv"
    done = run(app, ["export", source, "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "120 samples of u, v, theta" in done.output
    told = json.loads(run(app, ["export", source, "--out", str(out), "--json"]).output)
    assert told["samples"] == 120
    for name in ("out.xls", "run.mcap"):
        wrong = run(app, ["export", source, "--out", str(tmp_path / name)])
        assert isinstance(wrong.exception, InputError)
        assert ".csv, .parquet, .mat, .wav, .uff or .unv" in str(wrong.exception)
    assert set(WRITERS) == {".csv", ".parquet", ".mat", ".wav", ".uff", ".unv"}
