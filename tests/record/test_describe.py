"""A foreign file is described as it is, and its first map imports it without an edit."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import io as scipy_io
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.errors import InputError
from samii_rig.record import maps
from samii_rig.record.channel_table import load_channels
from samii_rig.record.describe import describe
from samii_rig.record.first_map import first_map
from samii_rig.record.importer import import_file
from samii_rig.record.maps import ImportMap
from samii_rig.record.reader import read_recording
from samii_rig.record.timing import timing
from samii_rig.rig.load import parse
from samii_rig.types import Recording

N = 60


def imported(path: Path) -> Recording:
    """The file as its own first map imports it."""
    return import_file(path, parse(ImportMap, first_map(describe(path)), "first map"))


def write(folder: Path, text: str, name: str = "run.csv", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


def rows(form: str) -> str:
    return "".join(form.format(t=i / 100, ms=10 * i, u=i % 7, y=-i / 8) for i in range(N))


def german(text: str) -> str:
    return text.replace(",", ";").replace(".", ",")


TEXTS = {
    "comma": ("t,u,y\n" + rows("{t},{u},{y}\n"), ",", "."),
    "German": ("Zeit [s];u;y\n" + german(rows("{t},{u},{y}\n")), ";", ","),
    "tabs under a comment": ("# rig 3\n# t\tu\ty\n" + rows("{t}\t{u}\t{y}\n"), "\t", "."),
    "white space, no names": (rows("{t}   {u} {y}\n"), "", "."),
    "lines above the names": ("Test 3\nJohn; 2020\n\nt;u;y\n" + rows("{t};{u};{y}\n"), ";", "."),
    "a row of units": ("t,u,y\n[s],[V],[rad]\n" + rows("{t},{u},{y}\n"), ",", "."),
    "words in a column": ("t,u,y,state\n" + rows("{t},{u},{y},on\n"), ",", "."),
    "percent comments": ("% made by hand\nt,u,y\n" + rows("{t},{u},{y}\n"), ",", "."),
}


@pytest.mark.parametrize("case", TEXTS)
def test_how_a_text_is_written_is_found_and_its_first_map_reads_it(tmp_path, case):
    text, delimiter, decimal = TEXTS[case]
    path = write(tmp_path, text)
    found = describe(path)
    assert (found.format.delimiter, found.format.decimal) == (delimiter, decimal)
    assert (found.samples, found.rate_hz, found.gaps) == (N, 100.0, 0)
    recording = imported(path)
    assert recording.rate_hz == 100.0
    np.testing.assert_array_equal(recording.values, [[i % 7, -i / 8] for i in range(N)])


@pytest.mark.parametrize("digits", [4, 7])
def test_the_rate_is_as_exact_as_all_stamps_together(digits: int) -> None:
    """A step of 1/2048 s has four digits here, and all of them have the rate to five."""
    n = np.arange(4096.0)
    found = timing({"t": np.round(n / 2048.0, digits)}, {"t": "s"}, None)
    assert found.rate_hz == 2048.0


def test_a_clock_that_wanders_does_not_bring_the_last_digit_back() -> None:
    n = np.arange(40_960.0)
    t = (n + 0.5 * np.sin(2 * np.pi * n / n.size)) / 2048.0
    found = timing({"t": np.round(t, 4)}, {"t": "s"}, None)
    assert found.rate_hz == pytest.approx(2048.0, rel=2e-4)


def test_a_clock_that_jumps_beside_a_count_does_not_move_the_rate() -> None:
    n = np.arange(4000.0)
    t = n / 2048.0 + np.where(n > 2000, 0.5, 0.0)
    found = timing({"n": n, "t": t}, {"t": "s"}, None)
    assert found.rate_hz == pytest.approx(2048.0)


def test_units_gaps_levels_steps_and_missing_values_are_told(tmp_path):
    lines = [
        f"{10 * i};{0.5 * (i % 5)};{1 + (i // 20)};{i}" for i in range(N) if i not in (7, 8, 30)
    ]
    lines[3] = lines[3].rsplit(";", 1)[0] + ";NaN"
    path = write(tmp_path, "t [ms];u [V];level;y [rad]\n" + "\n".join(lines) + "\n")
    found = describe(path)
    by_name = {c.name: c for c in found.columns}
    assert (found.time, found.time_unit, found.unit_guessed) == ("t", "ms", False)
    assert (found.gaps, found.lost, found.rate_hz) == (2, 3, 100.0)
    assert found.length_s == pytest.approx((N - 1) / 100)
    assert (by_name["u"].unit, by_name["u"].step, by_name["u"].high) == ("V", 0.5, 2.0)
    assert by_name["level"].levels == (1.0, 2.0, 3.0)
    assert (by_name["y"].missing, by_name["y"].first_missing) == (1, 3)
    assert any("'y' has 1 values that are no finite number" in note for note in found.notes)
    said = "\n".join(found.lines())
    for word in ("delimiter ';'", "decimal sign '.'", "UTF-8", "100 Hz", "2, 3 samples lost"):
        assert word in said


def test_a_sensor_in_g_mm_or_deg_becomes_one_in_the_unit_of_a_rig_file(tmp_path):
    path = write(
        tmp_path, "t [s],u [mV],a [g],x [mm],q [deg],b [m/s2]\n" + rows("{t},1,{y},1,1,1\n")
    )
    text = first_map(describe(path))
    assert 'unit = "m/s^2"\nraw_unit = "g"\nscale = 9.80665  # m/s^2 in 1 g' in text
    assert "write 1.0: one number for all files" in text
    recording = imported(path)
    assert [c.unit for c in recording.channels] == ["mV", "m/s^2", "m", "rad", "m/s^2"]
    np.testing.assert_allclose(recording.values[:, 1], [-9.80665 * i / 8 for i in range(N)])
    np.testing.assert_allclose(recording.values[0, 2:], [1e-3, np.pi / 180, 1.0])


def test_a_column_of_levels_becomes_segments(tmp_path):
    path = write(
        tmp_path,
        "t,u,level\n" + "".join(f"{i / 100},{i},{(i // 20) % 2 * 0.5}\n" for i in range(80)),
    )
    segments = imported(path).segments
    assert [(s.start, s.stop, s.level, s.repeat) for s in segments] == [
        (20, 40, 0.5, 0),
        (60, 80, 0.5, 1),
    ]


def test_the_unit_of_a_time_that_is_not_stated_is_a_guess_and_marked(tmp_path):
    path = write(tmp_path, "time,y\n" + rows("{ms},{y}\n"))
    found = describe(path)
    assert (found.time_unit, found.unit_guessed, found.rate_hz) == ("ms", True, 100.0)
    assert 'unit = "ms"  # the file does not say: is it?' in first_map(found)


def test_without_a_time_the_map_asks_for_the_rate(tmp_path):
    path = write(tmp_path, "u,y\n" + rows("{u},{y}\n"))
    assert any("nothing says the rate" in note for note in describe(path).notes)
    text = first_map(describe(path))
    with pytest.raises(InputError, match="neither column nor rate_hz"):
        parse(ImportMap, text, "first map")
    chosen = parse(ImportMap, text.replace("# rate_hz = 1000.0", "rate_hz = 100.0"), "first map")
    assert import_file(path, chosen).rate_hz == 100.0


def test_where_no_column_drives_by_its_name_the_map_asks_which_does(tmp_path):
    asked = 'one must be "command", what drives the rig: is it?'
    text = first_map(describe(write(tmp_path, "time,coil,pos\n" + rows("{ms},{u},{y}\n"))))
    assert text.count(asked) == 2
    text = first_map(describe(write(tmp_path, "time,command,pos\n" + rows("{ms},{u},{y}\n"))))
    assert asked not in text


def test_set_points_of_joints_are_references_beside_the_one_of_the_output(tmp_path):
    path = write(tmp_path, "time,u,theta_ref,v,y\n" + rows("{ms},{u},0,{u},{y}\n"))
    channels = parse(ImportMap, first_map(describe(path)), "first map").channel
    roles = {c.name: c.role for c in channels}
    assert roles == {"u": "reference", "theta_ref": "reference", "v": "command", "y": "sensor"}


def test_matlab_json_and_universal_files(tmp_path, recordings):
    t, u = np.arange(N) / 100, np.arange(N) % 7.0
    mat = tmp_path / "run.mat"
    scipy_io.savemat(mat, {"t": t, "u": u, "name": "x"})
    columns = write(
        tmp_path, json.dumps({"about": {"a": 1}, "data": {"t": [*t], "u [V]": [*u]}}), "a.json"
    )
    objects = write(
        tmp_path, json.dumps([{"t": a, "u": b} for a, b in zip(t, u, strict=True)]), "b.json"
    )
    lines = write(tmp_path, "".join(f"[{a}, {b}]\n" for a, b in zip(t, u, strict=True)), "c.jsonl")
    for path in (mat, columns, objects, lines):
        np.testing.assert_array_equal(imported(path).values[:, -1], u)
    assert describe(columns).columns[1].unit == "V"
    microphone = recordings.parent / "uff_samples" / "Sample_UFF58b_bin.uff"
    assert imported(microphone).channels[0].unit == "Pa"


def test_a_universal_file_without_a_time_response_says_what_it_holds(tmp_path, recordings):
    path = recordings.parent / "uff_samples" / "simcenter_exported_result.uff"
    found = describe(path)
    assert found.sets == (
        "1 x 151, header",
        "1 x 2411, nodes",
        "1 x 2412, elements",
        "1 x 2414, not known here",
    )
    assert "nothing to import" in found.lines()[-1]
    with pytest.raises(InputError, match="expected a column of numbers or a time response"):
        first_map(found)
    microphone = describe(path.with_name("Sample_UFF58b_bin.uff"))
    assert "  sets     1 x 58, time response" in microphone.lines()


def test_parquet_with_its_units(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="the extra samii-rig[parquet]")
    parquet = pytest.importorskip("pyarrow.parquet")
    fields = [
        pyarrow.field("t", pyarrow.float64()),
        pyarrow.field("u", pyarrow.float64(), metadata={"unit": "V"}),
    ]
    table = pyarrow.table([np.arange(N) / 100, np.arange(N) % 7.0], schema=pyarrow.schema(fields))
    path = tmp_path / "run.parquet"
    parquet.write_table(table, path)
    recording = imported(path)
    assert (recording.channels[0].unit, recording.rate_hz) == ("V", 100.0)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="expected a Parquet file"):
        describe(path)


def test_parquet_without_its_library_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow.parquet", None)
    path = write(tmp_path, "PAR1", "run.parquet")
    with pytest.raises(InputError, match=r"pip install samii-rig\[parquet\]"):
        describe(path)


BAD = {
    "empty": ("", "run.csv", "utf-8", "is 'empty, no data'"),
    "a header alone": ("t,u\n", "run.csv", "utf-8", "header without data"),
    "words": ("once upon a time\nthere was\na rig\n", "run.csv", "utf-8", "no lines of numbers"),
    "UTF-16": ("t,u\n0,1\n1,2\n", "run.csv", "utf-16", "encoding is 'UTF-16'; expected UTF-8"),
    "a recording": ("MCAP", "run.mcap", "utf-8", "samii-rig verify says what is in a recording"),
    "no JSON": ("{", "run.json", "utf-8", "expected JSON"),
    "JSON of words": ('{"a": "b"}', "run.json", "utf-8", "arrays by name"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_file_that_cannot_be_described_is_one_line_and_exit_code_2(tmp_path, case):
    text, name, encoding, message = BAD[case]
    path = write(tmp_path, text, name, encoding)
    place = tmp_path / "map.toml"
    done = CliRunner().invoke(app, ["import", "--describe", str(path), "--write-map", str(place)])
    assert isinstance(done.exception, InputError)
    assert message in str(done.exception)
    assert "\n" not in str(done.exception)
    assert not place.exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
@pytest.mark.parametrize("suffix", ["csv", "uff", "json", "parquet"])
def test_a_pipe_holds_nobody_up(tmp_path, suffix):
    path = tmp_path / f"run.{suffix}"
    os.mkfifo(path)
    with pytest.raises(InputError, match="it is a pipe or a device, not a file"):
        describe(path)
    with pytest.raises(InputError, match="it is a pipe or a device, not a file"):
        load_channels(path)


def test_from_the_command_line_to_a_recording(tmp_path):
    path = write(tmp_path, TEXTS["German"][0])
    chosen = tmp_path / "map.toml"
    run = CliRunner().invoke
    assert run(app, ["import", "--describe", str(path), "--write-map", str(chosen)]).exit_code == 0
    done = run(app, ["import", str(path), "--map", str(chosen), "--out", str(tmp_path / "runs")])
    assert done.exit_code == 0, done.output
    assert len(read_recording(tmp_path / "runs" / "run.mcap")) == N
    told = json.loads(run(app, ["import", "--describe", str(path), "--json"]).output)
    assert told["files"][0]["format"]["delimiter"] == ";"
    again = run(app, ["import", str(path), "--write-map", str(chosen)])
    assert "expected the name of a new file" in str(again.exception)
    assert "--map: missing; expected a map file" in str(run(app, ["import", str(path)]).exception)
    file = write(tmp_path, "", "afile")
    blocked = run(app, ["import", str(path), "--map", str(chosen), "--out", str(file)])
    assert "expected a folder to write to" in str(blocked.exception)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.lists(
            st.one_of(st.floats().map(repr), st.sampled_from(["", "t", "u [V]", "#", '"', "1,5"])),
            max_size=4,
        ).map(",".join),
        max_size=8,
    ).map("\n".join)
)
def test_no_text_breaks_the_description(tmp_path, text):
    path = write(tmp_path, text)
    said = ""
    try:
        found = describe(path)
    except InputError as error:
        said = str(error)
    else:
        assert found.lines()
        first_map(found)
    assert "\n" not in said


def test_every_key_of_a_map_is_in_its_docs():
    docs = Path(__file__).resolve().parents[2] / "docs"
    text = (docs / "reference" / "import-map.md").read_text("utf-8")
    tables = (
        *(maps.ImportMap, maps.TimeBase, maps.ColumnMap, maps.SegmentMap, maps.PartMap),
        *(maps.TextFormat, maps.CsvFormat, maps.MatFormat, maps.JsonFormat),
    )
    keys = {key for table in tables for key in table.model_fields}
    missing = [k for k in keys if not any(f"{a}{k}{b}" in text for a in "`[." for b in "`]")]
    assert missing == []
