"""A table of sensors turns volts into what was measured, and stays with the recording, dated."""

from __future__ import annotations

import json
from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.errors import InputError
from samii_rig.record.channel_table import load_channels
from samii_rig.record.importer import import_file
from samii_rig.record.maps import ImportMap
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.units import factor

MAP = """
name = "lab"
[format]
kind = "csv"
[time]
column = "t"
[[channel]]
column = "u"
name = "u"
unit = "V"
role = "reference"
[[channel]]
column = "ch1"
name = "a_0"
unit = "m/s^2"
{a_0}
[[channel]]
column = "ch2"
name = "theta"
unit = "rad"
{theta}
[segment]
level = 1.0
level_unit = "V"
"""
DATA = "t,u,ch1,ch2\n" + "".join(f"{i / 100},0,{0.1 * i},{i}\n" for i in range(5))
TABLE = """channel,sensitivity,sensitivity_unit,direction,serial number,calibration date
a_0,10.2,mV/g,-X,LW 1234,2026-03-01
theta,,,+RZ,7,
"""
SHEET = """Field;a_0;theta
Manufacturer ID;PCB;Heidenhain
Model number;352C33;ERN
Serial number;LW 1234;7
Sensitivity @ ref. condition;10,2 mV/g;n/a
Calibration date;01.03.2026;
Polarity;negative;positive
Direction;X;RZ
"""
COUNTS = 'raw_unit = "count"\nscale = 0.5'


def lab(a_0: str = 'raw_unit = "V"', theta: str = COUNTS) -> ImportMap:
    return parse(ImportMap, MAP.format(a_0=a_0, theta=theta), "lab.toml")


def read(folder: Path, table: str, chosen: ImportMap | None = None, data: str = DATA):
    (folder / "table.csv").write_text(table, encoding="utf-8")
    (folder / "run.csv").write_text(data, encoding="utf-8")
    sensors = load_channels(folder / "table.csv")
    return import_file(folder / "run.csv", chosen or lab(), "", sensors)


@pytest.mark.parametrize("table", [TABLE, SHEET], ids=["rows", "data sheet"])
def test_sensitivity_and_direction_are_applied_and_kept_with_their_date(tmp_path, table):
    recording = read(tmp_path, table)
    volts = 0.1 * np.arange(5)
    expected = -volts * 1000 / 10.2 * 9.80665
    np.testing.assert_allclose(recording.values[:, 1], expected, rtol=1e-14)
    np.testing.assert_array_equal(recording.values[:, 2], 0.5 * np.arange(5))
    kept = json.loads(recording.metadata["calibrations"])
    assert kept["a_0"]["calibration_date"] == "2026-03-01"
    assert kept["a_0"]["serial_number"] == "LW 1234"
    assert (kept["a_0"]["sensitivity"], kept["a_0"]["sensitivity_unit"]) == (10.2, "mV/g")
    assert kept["a_0"]["direction"] == "-X"
    assert kept["theta"]["direction"] == "+RZ"
    assert recording.metadata["channel_table"] == "table.csv"
    assert len(recording.metadata["channel_table_sha256"]) == 64
    assert recording.metadata["channel_table_read"].startswith("20")


def test_a_column_that_is_scaled_already_is_converted_alone(tmp_path):
    recording = read(tmp_path, TABLE.replace("-X", "+X"), lab('raw_unit = "g"'))
    np.testing.assert_allclose(recording.values[:, 1], 0.1 * np.arange(5) * 9.80665)
    # A first map converts such a column itself, which is no other sensitivity.
    again = read(tmp_path, TABLE.replace("-X", "+X"), lab('raw_unit = "g"\nscale = 9.80665'))
    np.testing.assert_array_equal(again.values, recording.values)


def test_the_unit_of_the_column_may_stand_in_the_file(tmp_path):
    data = DATA.replace("ch1", "ch1 [mV]")
    recording = read(tmp_path, TABLE, lab(""), data)
    np.testing.assert_allclose(recording.values[:, 1], -0.1 * np.arange(5) / 10.2 * 9.80665)


def test_a_channel_may_be_called_by_its_column_and_the_unit_stand_in_the_head(tmp_path):
    table = "name,sensitivity [V/(m/s^2)],cal_date\nch1,0.01,2026-01-01\nch2,,\n"
    recording = read(tmp_path, table)
    np.testing.assert_allclose(recording.values[:, 1], 10.0 * np.arange(5))


BAD = {
    "no calibration date": (
        TABLE.replace("2026-03-01", ""),
        "'a_0': calibration_date is 'missing'",
    ),
    "no sensitivity where the column has another unit": (
        TABLE.replace("10.2", ""),
        r"'a_0': sensitivity is 'missing'; expected a number, as the column is in V and the",
    ),
    "a sensor without a row": (
        TABLE.replace("theta,,,+RZ,7,\n", ""),
        "channel 'theta' is 'missing'",
    ),
    "no sensor of the map": (TABLE + "b,,,,,\n", "channel is 'b'; expected one of u, a_0, theta"),
    "a channel twice": (TABLE + "theta,,,,,\n", "expected each channel once"),
    "the future": (
        TABLE.replace("2026-03-01", (date.today() + timedelta(days=2)).isoformat()),
        "not in the future",
    ),
    "no date": (TABLE.replace("2026-03-01", "3/1/26"), "expected a day as 2026-11-23"),
    "no number": (TABLE.replace("10.2", "ten"), "sensitivity is 'ten'; expected a number"),
    "zero": (TABLE.replace("10.2", "0"), "expected a number other than 0"),
    "no unit": (TABLE.replace("mV/g", ""), "sensitivity_unit is 'missing'; expected a signal over"),
    "another quantity": (TABLE.replace("mV/g", "mV/N"), r"expected m/s\^2 under the line"),
    "another signal": (TABLE.replace("mV/g", "pC/g"), "unit of the column is 'V'; expected pC"),
    "no direction": (TABLE.replace("-X", "up"), "direction is 'up'; expected \\+X"),
    "no polarity": (SHEET.replace("negative", "maybe"), "expected positive or negative"),
    "no channels": ("serial,sensitivity\n1,2\n", "expected a column 'channel'"),
    "a short row": (TABLE + "b,1\n", "cells of row 4 is 2; expected 6"),
    "empty": ("", "expected names of fields, and a channel"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_table_is_one_line_with_channel_and_field(tmp_path, case):
    table, message = BAD[case]
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, table)
    assert "\n" not in str(caught.value)
    assert "table.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("a_0", "message"),
    [
        ("", "expected raw_unit in the map"),
        ('raw_unit = "V"\nscale = 2.0', "expected no scale in the map"),
    ],
)
def test_a_map_that_does_not_go_with_the_table(tmp_path, a_0, message):
    with pytest.raises(InputError, match=message):
        read(tmp_path, TABLE, lab(a_0))


def test_from_the_command_line(tmp_path):
    (tmp_path / "table.csv").write_text(TABLE)
    (tmp_path / "run.csv").write_text(DATA)
    (tmp_path / "map.toml").write_text(MAP.format(a_0='raw_unit = "V"', theta=COUNTS))
    arguments = ["import", str(tmp_path / "run.csv"), "--map", str(tmp_path / "map.toml")]
    arguments += ["--channels", str(tmp_path / "table.csv"), "--out", str(tmp_path / "runs")]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    kept = read_recording(tmp_path / "runs" / "run.mcap").metadata
    assert json.loads(kept["calibrations"])["a_0"]["calibration_date"] == "2026-03-01"
    (tmp_path / "table.csv").write_text(TABLE.replace("2026-03-01", ""))
    arguments[-1] = str(tmp_path / "other")
    again = CliRunner().invoke(app, arguments)
    assert isinstance(again.exception, InputError)
    assert not (tmp_path / "other").exists()
    arguments[-1] = str(tmp_path / "runs")
    with pytest.raises(
        InputError,
        match=r"run.csv: there is a recording of that name already, .*"
        r"run.mcap; delete it, or name another folder with --out$",
    ):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


@pytest.mark.parametrize(
    ("given", "wanted", "expected"),
    [
        ("g", "m/s^2", 9.80665),
        ("bar", "Pa", 1e5),
        ("mm", "m", 1e-3),
        ("µV", "mV", 1e-3),
        ("m/s²", "g", 1 / 9.80665),
        ("rpm", "rad/s", np.pi / 30),
        ("°", "rad", np.pi / 180),
        ("(m/s^2)", "m/s^2", 1.0),
        ("furlong", "furlong", 1.0),
        ("furlong", "m", None),
        ("V", "m", None),
    ],
)
def test_factors_between_units(given, wanted, expected):
    found = factor(given, wanted)
    assert found is None if expected is None else found == pytest.approx(expected, rel=1e-15)
