"""Foreign recordings become ours unchanged: units, time base, gaps; what is wrong is said.

First the real SFLR files, then each format, then every way in which a file can be bad.
"""

from pathlib import Path

import numpy as np
import pytest
import pyuff
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import io as scipy_io

from samii_rig.errors import InputError
from samii_rig.record.importer import import_file
from samii_rig.record.maps import ImportMap, load_map, shipped_maps
from samii_rig.rig.load import load_rig, parse

MAP = """
name = "lab"
[format]
kind = "{kind}"
{format}
[time]
{time}
[[channel]]
column = "u"
name = "u"
unit = "V"
role = "reference"
[[channel]]
column = "y"
name = "theta"
unit = "rad"
{channel}
[segment]
level = 'amp-(?P<level>[^_]+)'
level_unit = "V"
"""


def lab_map(kind: str = "csv", form: str = "", time: str = 'column = "t"', channel: str = ""):
    return parse(
        ImportMap, MAP.format(kind=kind, format=form, time=time, channel=channel), "lab.toml"
    )


def write(folder: Path, text: str, name: str = "run_amp-2_.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def refusal(path: Path, chosen: ImportMap) -> str:
    """The line of the InputError, "" when the file was read; anything else is a defect."""
    try:
        import_file(path, chosen)
    except InputError as error:
        return str(error)
    return ""


GOOD = "t,u,y\n0.00,0,1\n0.01,1,2\n0.02,0,3\n"


def test_a_real_sweep_keeps_its_loop(recordings):
    path = recordings / "2009-07-07_full-robot_swept_sine_amp-75_test_2.txt"
    recording = import_file(path, *load_map("sflr"))
    raw = np.loadtxt(path)
    ref, v, theta, a = recording.values.T
    kp = float(recording.metadata["kp"])
    # The drive's own program computed v one sample after theta: the law holds to its rounding.
    np.testing.assert_allclose(ref * kp, raw[:, 2], atol=1e-9)
    np.testing.assert_array_equal(v, raw[:, 3])
    np.testing.assert_allclose(theta * kp, raw[:, 4], atol=1e-9)
    np.testing.assert_allclose(a * 1.0802616846169428, raw[:, 5], atol=1e-9)
    assert np.median(np.abs(v - kp * (ref - theta))) <= 1.0
    (segment,) = recording.segments
    assert (segment.kind, segment.level, segment.unit, segment.repeat) == ("burst", 75, "count", 1)
    assert recording.rate_hz == 500.0
    assert recording.rig_toml == load_rig("sflr")[1]


def test_missing_samples_stay_missing(recordings):
    path = recordings / "2009-08-03_motor-only_swept_sine_amp-25_test_1.txt"
    recording = import_file(path, *load_map("sflr_motor"))
    steps = np.diff(recording.sequence)
    assert recording.stop.missing_samples == int((steps - 1).sum()) == 40
    assert len(recording) == 20_000
    np.testing.assert_array_equal(np.diff(recording.time), steps * 2_000_000)


def test_every_shipped_recording_has_its_map(recordings):
    for path in recordings.glob("*.txt"):
        said = [refusal(path, load_map(name)[0]) for name in shipped_maps()]
        assert said.count("") == 1, path.name
        assert all("the map" in line for line in said if line)


def test_scale_offset_quality_and_unit(tmp_path):
    text = 'offset = 1.0\nscale = 0.5\nlow = -10.0\nhigh = 1.0\nraw_unit = "count"'
    recording = import_file(write(tmp_path, GOOD), lab_map(channel=text))
    np.testing.assert_array_equal(recording.values[:, 1], [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(recording.quality[:, 1], [0, 0, 2])  # at the end of the range
    assert recording.rate_hz == pytest.approx(100.0)
    assert recording.segments[0].level == 2.0


def test_european_numbers_quotes_and_units_in_the_header(tmp_path):
    text = '"t [ms]";"u [V]";"y [rad]"\n0;1,5;-2e-3\n10;2,5;3\n'
    chosen = lab_map(form='delimiter = ";"\ndecimal = ","', time='column = "t"\nunit = "ms"')
    recording = import_file(write(tmp_path, text), chosen)
    np.testing.assert_array_equal(recording.values, [[1.5, -2e-3], [2.5, 3.0]])
    assert recording.rate_hz == pytest.approx(100.0)


@pytest.mark.parametrize("matrix", [False, True])
def test_mat_files(tmp_path, matrix):
    t, u, y = np.arange(5) / 100, np.arange(5.0), np.arange(5.0) ** 2
    path = tmp_path / "run_amp-1.5_.mat"
    columns = {"t": t, "u": u[:, None], "y": y[None, :]}
    scipy_io.savemat(path, {"data": np.stack([t, u, y], axis=1)} if matrix else columns)
    form = 'variable = "data"\ncolumns = ["t", "u", "y"]' if matrix else ""
    recording = import_file(path, lab_map("mat", form))
    np.testing.assert_array_equal(recording.values, np.stack([u, y], axis=1))


def uff(path: Path, unit: str = "rad") -> Path:
    x = np.arange(8) / 100
    pyuff.UFF(str(path)).write_sets(
        [
            pyuff.prepare_58(
                func_type=1,
                id1=name,
                data=np.sin(x + k),
                x=x,
                binary=0,
                abscissa_inc=0.01,
                abscissa_spacing=1,
                ord_data_type=4,
                num_pts=8,
                abscissa_min=0.0,
                ordinate_axis_units_lab=label,
                abscissa_spec_data_type=17,
                ordinate_spec_data_type=0,
                orddenom_spec_data_type=0,
                z_axis_spec_data_type=0,
                rsp_node=1,
                rsp_dir=1,
                ref_node=1,
                ref_dir=1,
            )
            for k, (name, label) in enumerate([("u", "V"), ("y", unit)])
        ],
        mode="overwrite",
    )
    return path


def test_universal_files_and_their_units(tmp_path):
    path = uff(tmp_path / "run_amp-3_.uff")
    recording = import_file(path, lab_map("uff58", time=""))
    assert recording.rate_hz == pytest.approx(100.0)
    np.testing.assert_allclose(recording.values[:, 1], np.sin(np.arange(8) / 100 + 1), rtol=1e-11)
    with pytest.raises(InputError, match="unit of column 'y' is 'deg'; expected 'rad'"):
        import_file(uff(tmp_path / "x_amp-3_.uff", "deg"), lab_map("uff58", time=""))


BAD_FILES = {
    "no such file": (None, "No such file"),
    "empty": ("", "empty, no data"),
    "a header alone": ("t,u,y\n", "header without data"),
    "one sample": ("t,u,y\n0,0,0\n", "1 samples'; expected at least two"),
    "a word": (GOOD + "0.03,zero,4\n", r"line 5, column 'u' is 'zero'; expected a number"),
    "an empty field": (GOOD + "0.03,,4\n", r"line 5, column 'u' is ''; expected a number"),
    "NaN": (GOOD + "0.03,nan,4\n", r"line 5, column 'u' is nan; expected a finite number"),
    "infinity": (GOOD + "0.03,0,inf\n", r"line 5, column 'y' is inf; expected a finite"),
    "a short line": (GOOD + "0.03,0\n", r"line 5 is '2 columns'; expected 3 columns"),
    "time backwards": (GOOD + "0.01,0,4\n", r"line 5, column 't' is 0.01; .*runs backwards"),
    "time standing": (GOOD + "0.02,0,4\n", r"line 5, column 't'"),
    "jitter": (GOOD + "0.034,0,4\n", r"line 5, column 't' is 0.034; expected a whole number"),
    "no such column": ("t,u,z\n0,0,0\n1,0,0\n", r"column is 'y'; expected one of"),
    "a column twice": ("t,u,y,y\n0,0,0,0\n1,0,0,0\n", "expected once, not twice"),
    "another unit": ("t,u [mV],y\n0,0,0\n1,0,0\n", "unit of column 'u' is 'mV'; expected 'V'"),
    "names that do not fit": ("t,u\n0,0,0\n1,0,0\n", "3 names, one a column of line 2"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_what_is_wrong_is_said_in_one_line(tmp_path, case):
    text, message = BAD_FILES[case]
    path = tmp_path / "missing_amp-1_.csv" if text is None else write(tmp_path, text)
    with pytest.raises(InputError, match=message) as caught:
        import_file(path, lab_map())
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)


def test_a_rate_that_contradicts_the_time_column(tmp_path):
    chosen = lab_map(time='column = "t"\nrate_hz = 500.0')
    with pytest.raises(InputError, match=r"rate in column 't' is 100\.0; expected 500 Hz"):
        import_file(write(tmp_path, GOOD), chosen)


def test_a_level_that_the_name_does_not_hold(tmp_path):
    with pytest.raises(InputError, match="finds the level"):
        import_file(write(tmp_path, GOOD, "run.csv"), lab_map())
    with pytest.raises(InputError, match="level in the file name is 'x'; expected a number"):
        import_file(write(tmp_path, GOOD, "amp-x_.csv"), lab_map())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "lab"', 'nome = "lab"', "nome: no such field; expected name"),
        ('unit = "rad"', 'unit = "rad"\nscale = 0.0', "scale 0"),
        ("(?P<level>", "(?P<level", "no regular expression"),
        ("(?P<level>", "(?P<height>", r"no group \(\?P<level>"),
        ('name = "theta"', 'name = "u"', "occurs twice"),
        ('column = "t"', "", "neither column nor rate_hz"),
        ('kind = "csv"', 'kind = "xls"', "expected"),
    ],
)
def test_a_bad_map_names_the_field(old, new, message):
    text = MAP.format(kind="csv", format="", time='column = "t"', channel="")
    assert old in text
    with pytest.raises(InputError, match=message):
        parse(ImportMap, text.replace(old, new), "lab.toml")


def test_a_map_whose_units_are_not_the_rigs(tmp_path):
    text = MAP.format(kind="csv", format="", time='column = "t"', channel="")
    text = text.replace('name = "lab"', 'name = "lab"\nrig = "sflr"', 1).replace('"rad"', '"deg"')
    with pytest.raises(InputError, match="channel theta: unit is 'deg'; expected 'rad'"):
        import_file(write(tmp_path, GOOD), parse(ImportMap, text, "lab.toml"))


def test_an_unknown_map():
    with pytest.raises(InputError, match="or one of sflr, sflr_motor, sflr_motor_open"):
        load_map("none")


@pytest.mark.parametrize(
    ("text", "form", "message"),
    [
        (GOOD, 'delimiter = ";"', r"is the delimiter ','\?"),
        (GOOD.replace(",", "\t"), "", r"is the delimiter a tab\?"),
        (GOOD.replace(",", " "), "", r"is the delimiter white space\?"),
        (
            GOOD.replace(",", ";").replace(".", ","),
            'delimiter = ";"',
            r"'0,00'; expected a number; is the decimal mark ','\?",
        ),
    ],
)
def test_a_wrong_delimiter_and_a_wrong_decimal_mark_are_named(tmp_path, text, form, message):
    with pytest.raises(InputError, match=message):
        import_file(write(tmp_path, text), lab_map(form=form))


def test_utf_16_is_named(tmp_path):
    path = tmp_path / "run_amp-1_.csv"
    for name in ("utf-16", "utf-16-le"):
        path.write_bytes(GOOD.encode(name))
        with pytest.raises(InputError, match="encoding is 'UTF-16'; expected UTF-8"):
            import_file(path, lab_map())


def test_names_in_latin_1_are_found(tmp_path):
    path = tmp_path / "run_amp-1_.csv"
    path.write_bytes("t,u,y [µrad]\n0,0,0\n1,0,0\n".encode("latin-1"))
    with pytest.raises(InputError, match="'y' is 'µrad'; expected 'rad'"):
        import_file(path, lab_map())


DIVIDED = "t,u,y,seg,level\n" + "".join(
    f"{i / 100},{i},0,{i // 10 % 3},{[0, 0.5, 1.0][i // 10 % 3]}\n" for i in range(60)
)


def divided(segment: str) -> ImportMap:
    text = MAP.format(kind="csv", format="", time='column = "t"', channel="")
    head = text[: text.index("[segment]")]
    return parse(ImportMap, f'{head}[segment]\nlevel_unit = "V"\n{segment}', "lab.toml")


@pytest.mark.parametrize(
    ("segment", "expected"),
    [
        ("level = 0.25", [(0, 60, 0.25, 0)]),
        (
            'level_column = "level"',
            [(10, 20, 0.5, 0), (20, 30, 1.0, 0), (40, 50, 0.5, 1), (50, 60, 1.0, 1)],
        ),
        (
            'column = "seg"\npause = 1\nlevel = 2',
            [(0, 10, 2.0, 0), (20, 30, 2.0, 1), (30, 40, 2.0, 2), (50, 60, 2.0, 3)],
        ),
        (
            'column = "seg"\nlevel_column = "level"',
            [(10, 20, 0.5, 0), (20, 30, 1.0, 0), (40, 50, 0.5, 1), (50, 60, 1.0, 1)],
        ),
        (
            "[[segment.part]]\nstart = 0.05\nstop = 0.1\nlevel = 1\n"
            '[[segment.part]]\nstart = 0.3\nstop = 9\nlevel = 2\nkind = "burst"',
            [(5, 10, 1.0, 0), (30, 60, 2.0, 0)],
        ),
    ],
)
def test_a_file_of_several_segments(tmp_path, segment, expected):
    recording = import_file(write(tmp_path, DIVIDED, "run.csv"), divided(segment))
    found = [(s.start, s.stop, s.level, s.repeat) for s in recording.segments]
    assert found == expected
    assert len({s.name for s in recording.segments}) == len(expected)


@pytest.mark.parametrize(
    ("segment", "message"),
    [
        ("", "expected one of level, level_column and part"),
        ('level = 1\nlevel_column = "level"', "expected one of level, level_column and part"),
        ("level = -1", "level is -1; expected 0 or more"),
        ("level = 1\npause = 0", "expected a column"),
        ('level = 1\ncolumn = "seg"\nrepeat = "(?P<repeat>.)"', "expected no repeat"),
        ("[[segment.part]]\nstart = 2\nstop = 1\nlevel = 1", "not before stop 1 s"),
        ("[[segment.part]]\nstart = 5\nstop = 6\nlevel = 1", "where the file ends"),
        ("[[segment.part]]\nstart = 0.001\nstop = 0.002\nlevel = 1", "expected samples in it"),
        ('level_column = "u"', "changes of column 'u' is 1999; expected under 1000"),
        ('column = "y"\npause = 0\nlevel = 1', "all of the file is pause"),
        ('column = "nope"\nlevel = 1', "column is 'nope'"),
        ('column = "y"\nlevel_column = "level"', "line 12, column 'level' is 0.5; expected 0"),
    ],
)
def test_a_file_that_is_divided_wrongly(tmp_path, segment, message):
    signal = "t,u,y\n" + "".join(f"{i / 100},{i + 1},0\n" for i in range(2000))
    text = signal if '"u"' in segment else DIVIDED
    with pytest.raises(InputError, match=message):
        import_file(write(tmp_path, text, "run.csv"), divided(segment))


LINES = st.lists(
    st.lists(
        st.one_of(
            st.floats().map(repr),
            st.integers().map(str),
            st.sampled_from(["", " ", "nan", "1e999", '"', "#", "1_0", "\u0661", "0x1"]),
            st.text(max_size=3),
        ),
        max_size=4,
    ).map(",".join),
    max_size=6,
).map("\n".join)
# Single bytes that end scipy's MATLAB reader by a segmentation fault: (place, value).
FATAL = [(176, 128), (353, 60)]
FUZZ = settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])


@FUZZ
@given(LINES, st.booleans())
def test_no_text_gets_past_the_importer_or_breaks_it(tmp_path, text, headed):
    path = tmp_path / "fuzz_amp-1_.csv"
    path.write_bytes((("t,u,y\n" if headed else "") + text).encode("utf-8", "surrogatepass"))
    line = refusal(path, lab_map())
    assert "\n" not in line
    if not line:
        recording = import_file(path, lab_map())
        assert np.isfinite(recording.values).all()
        assert (np.diff(recording.sequence) > 0).all()
        assert (np.diff(recording.time) >= 0).all()


@FUZZ
@given(st.data())
def test_damaged_universal_files_are_refused_not_crashed_on(tmp_path, data):
    path = uff(tmp_path / "fuzz_amp-1_.uff")
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    assert "\n" not in refusal(path, lab_map("uff58", time=""))


def test_a_damaged_mat_file_does_not_take_the_program_down(tmp_path):
    path = tmp_path / "run_amp-1_.mat"
    scipy_io.savemat(path, {"t": np.arange(4) / 100, "u": np.arange(4.0), "y": np.arange(4.0)})
    whole = path.read_bytes()
    assert refusal(path, lab_map("mat")) == ""
    for at, value in FATAL:
        path.write_bytes(whole[:at] + bytes([value]) + whole[at + 1 :])
        assert "expected a MATLAB file" in refusal(path, lab_map("mat"))
    path.write_bytes(whole[:200])
    assert "\n" not in refusal(path, lab_map("mat"))
