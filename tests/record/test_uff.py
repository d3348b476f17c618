"""Universal files: what was read is written again equal, by us and by others; nothing breaks it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyuff
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from report_kit import measured
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.errors import InputError
from samii_rig.record.uff import function
from samii_rig.record.uff.card import card, number
from samii_rig.record.uff.channels import function_fields, response_sets, time_responses
from samii_rig.record.uff.file import DataSet, UffFile, write_uff

RNG = np.random.default_rng(1)
NODES = {
    "node": np.array([1, 2, 30]),
    "definition": np.array([0, 0, 1]),
    "displacement": np.array([0, 1, 1]),
    "color": np.array([8, 8, 11]),
}
SHAPE = {f"id{i}": f"line {i}" for i in range(1, 6)} | {
    "model_type": 1,
    "characteristic": 2,
    "specific_type": 8,
    "node": np.array([1, 2, 30]),
}
SETS = {
    "15": DataSet(15, NODES | {"position": np.array([[0.0, 1, 2], [-1.5, 2, 3], [1e-5, 0, -4e9]])}),
    "2411": DataSet(2411, NODES | {"position": RNG.standard_normal((3, 3))}),
    "2412": DataSet(
        2412,
        {
            "element": np.array([1, 2, 3]),
            "descriptor": np.array([21, 94, 115]),
            "physical": np.array([1, 1, 2]),
            "material": np.array([1, 1, 1]),
            "color": np.array([7, 7, 7]),
            "beam": np.array([[0, 1, 1], [0, 0, 0], [0, 0, 0]]),
            "nodes": ((1, 2), (1, 2, 3, 4), (*tuple(range(1, 9)), 9, 10)),
        },
    ),
    "82": DataSet(
        82, {"number": 1, "color": 3, "id": "boom", "nodes": np.array([1, 2, 0, *range(3, 12)])}
    ),
    "151": DataSet(
        151,
        {
            "model": "samii",
            "description": "a bench",
            "program": "samii-rig",
            "created_date": "23-Nov-26",
            "created_time": "14:00:00",
            "version": 1,
            "subversion": 0,
            "file_type": 0,
            "saved_date": "23-Nov-26",
            "saved_time": "14:00:00",
            "written_by": "samii-rig",
            "written_date": "23-Nov-26",
            "written_time": "14:00:00",
            "release": 1,
            "written_version": 0,
            "host": 0,
            "test": 0,
            "counter": 0,
        },
    ),
    "164": DataSet(
        164,
        {
            "code": 1,
            "description": "SI: Meter (newton)",
            "temperature_mode": 2,
            "length": 1.0,
            "force": 1.0,
            "temperature": 1.0,
            "offset": 273.15,
        },
    ),
    "55, a normal mode": DataSet(
        55,
        SHAPE
        | {
            "analysis_type": 2,
            "data_type": 2,
            "integers": (1, 4),
            "reals": (1.69775, 1.0, 0.0125, 0.0),
            "data": np.array([[1.0, 0, -2.5]] * 3),
        },
    ),
    "55, a complex mode": DataSet(
        55,
        SHAPE
        | {
            "analysis_type": 3,
            "data_type": 5,
            "integers": (1, 1),
            "reals": (-0.5, 10.25, 1.0, 0.0, 0.0, 1.0),
            "data": np.array([[1 + 2j, -0.5j, 3, 4, 5, 6]] * 3),
        },
    ),
}


def a_function(kind: int, *, even: bool, n: int = 11) -> DataSet:
    """A function whose data the columns of its type hold."""
    digits = 5 if kind in (function.REAL, function.COMPLEX) else 12
    data = RNG.standard_normal(n)
    if kind in (function.COMPLEX, function.COMPLEX_DOUBLE):
        data = data + 1j * RNG.standard_normal(n)
        plain = [
            complex(float(f"{v.real:.{digits}E}"), float(f"{v.imag:.{digits}E}")) for v in data
        ]
    else:
        plain = [float(f"{v:.{digits}E}") for v in data]
    axis = {"x_step": 0.002} if even else {"x": np.round(np.sort(RNG.uniform(1, 9, n)), 5)}
    fields = function_fields("theta_2", data=np.array(plain), unit="rad", data_type=kind, **axis)
    return DataSet(58, function.completed(fields))


for kind_ in (2, 4, 5, 6):
    for even_ in (True, False):
        SETS[f"58, type {kind_}, {'even' if even_ else 'uneven'}"] = a_function(kind_, even=even_)


def again(folder: Path, sets: list[DataSet]) -> list[DataSet]:
    path = folder / "again.uff"
    write_uff(path, sets)
    return list(UffFile(path))


def differing(a: DataSet, b: DataSet) -> list[str]:
    """Names of the fields that are not equal."""
    names = a.fields.keys() | b.fields.keys()
    return [
        n for n in names if DataSet(0, {"": a.fields.get(n)}) != DataSet(0, {"": b.fields.get(n)})
    ]


@pytest.fixture
def samples(recordings: Path) -> list[Path]:
    folder = recordings.parent / "uff_samples"
    if not folder.is_dir():
        pytest.skip(f"no universal files of other programs in {folder}")
    return sorted(folder.glob("*.uff"))


def test_files_of_other_programs_are_read_whole_and_written_again_equal(tmp_path, samples):
    assert len(samples) == 4
    kinds = set()
    for path in samples:
        read = list(UffFile(path))
        written = again(tmp_path, read)
        kinds |= {one.kind for one in read}
        assert [differing(a, b) for a, b in zip(read, written, strict=True)] == [[]] * len(read)
        assert read == written
    assert kinds == {58, 151, 2411, 2412, 2414}


def test_what_the_samples_hold(samples):
    by_name = {path.name: UffFile(path) for path in samples}
    exported = by_name["simcenter_exported_result.uff"]
    nodes, elements = exported[1].fields, exported[2].fields
    assert len(nodes["node"]) == 11_520
    np.testing.assert_array_equal(nodes["position"][0], [500.0, 11_500.0, 10_000.0])
    assert {len(held) for held in elements["nodes"]} == {2, 3, 4}
    assert exported[0].fields["program"] == "Nastran"
    text = by_name["Sample_UFF58_ascii.uff"][0].fields
    binary = by_name["Sample_UFF58b_bin.uff"][0].fields
    np.testing.assert_allclose(text["data"], binary["data"], rtol=1e-5)
    psd = by_name["sample_dataset58_psd.uff"][0].fields
    assert psd["y_unit"] == "g²/Hz"
    np.testing.assert_array_equal(psd["x"], np.arange(3201.0))


@pytest.mark.parametrize("case", SETS)
def test_every_set_comes_back_field_by_field(tmp_path, case):
    (read,) = again(tmp_path, [SETS[case]])
    assert differing(read, SETS[case]) == []
    assert read == SETS[case]


@pytest.mark.parametrize("kind", [2, 4, 5, 6])
@pytest.mark.parametrize("even", [True, False])
def test_binary_holds_every_digit(tmp_path, kind, even):
    fields = dict(a_function(kind, even=even).fields)
    fields["data"] = fields["data"] * np.pi
    if kind in (function.REAL, function.COMPLEX):
        narrow = np.complex64 if kind == function.COMPLEX else np.float32
        fields["data"] = fields["data"].astype(narrow)
        fields |= {"x": fields["x"].astype(np.float32)} if not even else {}
    (read,) = again(tmp_path, [DataSet(58, fields, binary=True)])
    assert read == DataSet(58, fields, binary=True)


def test_binary_data_that_look_like_the_end_of_a_set(tmp_path):
    data = np.frombuffer(b"\n    -1\n\n    -1\n" * 4, "<f8")
    one = DataSet(58, function.completed(function_fields("y", data=data, unit="V")), binary=True)
    read = again(tmp_path, [one, SETS["15"], one])
    assert read == [one, SETS["15"], one]


def test_a_set_of_a_number_that_is_not_known_goes_through(tmp_path):
    raw = DataSet(2420, {"raw": b"  2420\n         1\nsomething\n"})
    assert again(tmp_path, [SETS["82"], raw, SETS["151"]]) == [SETS["82"], raw, SETS["151"]]


def test_pyuff_reads_what_we_write(tmp_path):
    path = tmp_path / "ours.uff"
    names = ["15", "2411", "82", "164", "55, a normal mode", "58, type 4, even", "58, type 6, even"]
    write_uff(path, [SETS[name] for name in names])
    read = pyuff.UFF(str(path)).read_sets()
    assert [one["type"] for one in read] == [15, 2411, 82, 164, 55, 58, 58]
    fifteen, mode = SETS["15"].fields, SETS["55, a normal mode"].fields
    np.testing.assert_allclose(np.column_stack([read[0][a] for a in "xyz"]), fifteen["position"])
    np.testing.assert_allclose(read[1]["x"], SETS["2411"].fields["position"][:, 0], rtol=1e-15)
    np.testing.assert_array_equal(read[2]["nodes"], SETS["82"].fields["nodes"])
    assert read[3]["temp_offset"] == 273.15
    assert (read[4]["freq"], read[4]["mode_n"]) == (mode["reals"][0], 4)
    np.testing.assert_array_equal(read[4]["r3"], mode["data"][:, 2])
    for ours, theirs in ((SETS[names[5]], read[5]), (SETS[names[6]], read[6])):
        np.testing.assert_array_equal(theirs["data"], ours.fields["data"])
        assert theirs["abscissa_inc"] == 0.002


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # it leaves it open
def test_we_read_what_pyuff_writes(tmp_path):
    path = tmp_path / "theirs.uff"
    n = 9
    time = {
        "func_type": 1,
        "id1": "y",
        "x": np.arange(n) / 100,
        "abscissa_inc": 0.01,
        "abscissa_spacing": 1,
        "ord_data_type": 4,
        "num_pts": n,
        "abscissa_min": 0.0,
        "rsp_node": 3,
        "rsp_dir": -2,
        "ref_node": 1,
        "ref_dir": 1,
        "abscissa_spec_data_type": 17,
        "ordinate_spec_data_type": 0,
        "orddenom_spec_data_type": 0,
        "z_axis_spec_data_type": 0,
    }
    data = RNG.standard_normal(n)
    theirs = [pyuff.prepare_58(**time, data=data, binary=binary) for binary in (0, 1)]
    pyuff.UFF(str(path)).write_sets(theirs, mode="overwrite")
    read = list(UffFile(path))
    assert [one.binary for one in read] == [False, True]
    for one, rtol in zip(read, (1e-11, 0.0), strict=True):
        np.testing.assert_allclose(one.fields["data"], data, rtol=rtol)
        assert (one.fields["response_node"], one.fields["response_direction"]) == (3, -2)
        assert one.fields["x_step"] == 0.01


def test_responses_as_sets(tmp_path):
    r = measured(n=40)
    read = again(tmp_path, list(response_sets(r)))
    assert [one.fields["function_type"] for one in read] == [4, 6, 4, 6]
    np.testing.assert_allclose(read[0].fields["data"], r.H[:, 0, 0], rtol=1e-12)
    np.testing.assert_allclose(read[0].fields["x"], r.frequency, rtol=1e-6)


def test_opening_reads_heads_alone(tmp_path):
    """Two gigabytes of binary data that are not even on the disk."""
    path = tmp_path / "large.uff"
    points = 1 << 28
    fields = function.completed(function_fields("y", data=np.zeros(1), unit="V"))
    with path.open("wb") as file:
        write_uff(path, [DataSet(58, fields, binary=True)])
        head = path.read_bytes().replace(b"           8     0", b"  2147483648     0")
        head = head.replace(b"         4         1         1", b"         4 268435456         1")
        head = head[: head.index(b"\0" * 8)]
        file.write(head)
        file.truncate(len(head) + 8 * points)
        file.seek(0, 2)
        file.write(b"\n    -1\n")
    opened = UffFile(path)
    assert opened.kinds == (58,)
    assert opened.head(0)["points"] == points
    assert time_responses(opened) == {"y": 0}


def test_numbers_as_fortran_writes_them(tmp_path):
    for text, value in {"1.5D+02": 150, "1.5-100": 1.5e-100, "-1.D0": -1, "2": 2}.items():
        assert number(text) == value
    assert card("a:I10 b:E13.5").parsed("         7") == {"a": 7, "b": None}
    assert card("a:I10 b:I10").parsed("1 2") == {"a": 1, "b": 2}  # free form is understood
    path = tmp_path / "touching.uff"
    one = a_function(2, even=True, n=6)
    write_uff(path, [one])
    lines = path.read_text().split("\n")
    lines[13] = "-1.00000E+000-2.00000E+000-3.00000E-100 4.00000D+00  5.0000E+00  6.0000E+00"
    path.write_text("\n".join(lines))
    np.testing.assert_array_equal(UffFile(path)[0].fields["data"], [-1, -2, -3e-100, 4, 5, 6])


@pytest.mark.parametrize("row", [13, 14, 15])
@pytest.mark.parametrize("more", ["   ", ""])
def test_lines_of_other_lengths_than_the_first_are_found(tmp_path, row, more):
    one = a_function(4, even=True)
    path = tmp_path / "uneven.uff"
    write_uff(path, [one, SETS["82"], one])
    lines = path.read_text().split("\n")
    lines[row] = (lines[row] + more) if more else " ".join(lines[row].split())
    path.write_text("\n".join(lines))
    assert list(UffFile(path)) == [one, SETS["82"], one]


def whole(folder: Path) -> Path:
    path = folder / "whole.uff"
    write_uff(path, [SETS["151"], SETS["58, type 4, even"], a_binary(), SETS["82"]])
    return path


def a_binary() -> DataSet:
    return DataSet(58, a_function(4, even=True).fields, binary=True)


def refused(path: Path) -> str:
    """The line of the refusal, "" where all was read; anything else is a defect."""
    try:
        list(UffFile(path))
    except InputError as error:
        return str(error)
    return ""


def test_a_file_that_is_cut_is_one_line_wherever_it_is_cut(tmp_path):
    path = whole(tmp_path)
    data = path.read_bytes()
    ends = [i + 6 for i in range(len(data)) if data[i : i + 14] == b"    -1\n    -1\n"]
    unseen = {end + more for end in ends for more in range(6)}  # a set's end, and blanks
    for at in range(1, len(data) - 1, 3):
        path.write_bytes(data[:at])
        line = refused(path)
        assert line or at in unseen, at
        assert "\n" not in line
        assert not line or str(path) in line
    path.write_bytes(data[: len(data) // 2])
    assert "is cut off" in refused(path)


def test_a_cut_file_ends_the_import_with_one_line_and_exit_code_2(tmp_path):
    path = whole(tmp_path)
    path.write_bytes(path.read_bytes()[:-40])
    for arguments in (["--describe"], ["--write-map", str(tmp_path / "map.toml")]):
        done = CliRunner().invoke(app, ["import", str(path), *arguments])
        assert isinstance(done.exception, InputError)
        assert done.exception.exit_code == 2
        assert "(82) is cut off; expected a line of -1" in str(done.exception)
    assert not (tmp_path / "map.toml").exists()


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_damaged_file_is_refused_or_read(tmp_path, data):
    path = whole(tmp_path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(content))
    assert "\n" not in refused(path)


@pytest.mark.parametrize(
    ("sets", "message"),
    [
        ([DataSet(15, NODES)], r"set 1 \(15\): field 'position' is missing"),
        ([SETS["82"], DataSet(99, {})], r"set 2 \(99\): no set that can be written"),
        ([DataSet(82, SETS["82"].fields | {"number": 10**11})], "expected 10 digits at most"),
        (
            [DataSet(58, SETS["58, type 4, even"].fields | {"data": np.array([1j])})],
            "complex128 data are not of type 4",
        ),
    ],
)
def test_a_set_that_cannot_be_written(tmp_path, sets, message):
    with pytest.raises(InputError, match=message):
        write_uff(tmp_path / "bad.uff", sets)


def test_no_universal_file(tmp_path):
    path = tmp_path / "x.uff"
    for text, message in (("", "empty"), ("t,u\n0,1\n", "without a line of -1")):
        path.write_text(text)
        assert message in refused(path)
    assert "No such file" in refused(tmp_path / "none.uff")
