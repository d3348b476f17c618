"""What was exported is read back by the programs that it was exported for."""

import csv

import numpy as np
import pytest
import pyuff
from report_kit import measured

from samii_rig.errors import InputError
from samii_rig.record.export import export_response, replacing
from samii_rig.report.page import Subject, write_report


def test_npz_holds_everything_without_pickle(tmp_path):
    r = measured()
    with np.load(export_response(tmp_path / "r.npz", r), allow_pickle=False) as read:
        for name, array in {
            "frequency_hz": r.frequency,
            "H": r.H,
            "covariance": r.covariance,
            "dof": r.dof,
            "coherence": r.coherence,
            "input_rms": r.input_rms,
        }.items():
            np.testing.assert_array_equal(read[name], array)
        assert list(read["outputs"]) == ["theta_2", "a_0"]
        assert list(read["output_units"]) == ["rad", "m/s^2"]
        assert float(read["level"]) == r.level
        assert str(read["why"]) == r.why


def test_csv_is_exact_and_carries_units_and_the_covariance(tmp_path):
    r = measured()
    with export_response(tmp_path / "r.csv", r).open(encoding="utf-8", newline="") as stream:
        rows = list(csv.reader(line for line in stream if not line.startswith("#")))
    names, values = rows[0], np.array(rows[1:], dtype=float)
    column = dict(zip(names, values.T, strict=True))
    np.testing.assert_array_equal(column["frequency [Hz]"], r.frequency)
    a = "a_0/v_2 [m/s^2/V]"
    np.testing.assert_array_equal(column[f"Re H {a}"] + 1j * column[f"Im H {a}"], r.H[:, 1, 0])
    cross = "C theta_2/v_2, a_0/v_2 [(rad/V) (m/s^2/V)]"
    read = column[f"Re {cross}"] + 1j * column[f"Im {cross}"]
    np.testing.assert_array_equal(read, r.covariance[:, 0, 1])
    np.testing.assert_array_equal(column["coherence a_0 [1]"], r.coherence[:, 1])


def test_csv_ends_with_gain_and_phase_for_a_spreadsheet(tmp_path):
    r = measured()
    with export_response(tmp_path / "r.csv", r).open(encoding="utf-8", newline="") as stream:
        rows = list(csv.reader(line for line in stream if not line.startswith("#")))
    values = np.array(rows[1:], dtype=float)
    a = "a_0/v_2"
    assert rows[0][-4:] == [
        f"gain {a} [m/s^2/V]",
        f"sd gain {a} [m/s^2/V]",
        f"phase {a} [deg]",
        f"sd phase {a} [deg]",
    ]
    gain, sd_gain, phase, sd_phase = values[:, -4:].T
    np.testing.assert_allclose(gain * np.exp(1j * np.deg2rad(phase)), r.H[:, 1, 0], rtol=1e-12)
    sd = np.sqrt(r.variance()[:, 1, 0] / 2)
    np.testing.assert_allclose(sd_gain, sd, rtol=1e-12)
    np.testing.assert_allclose(np.deg2rad(sd_phase), sd / gain, rtol=1e-12)


@pytest.mark.parametrize("even", [False, True])
def test_uff_is_read_by_pyuff(tmp_path, even):
    r = measured(n=200)
    if even:
        r.frequency[:] = 0.25 * np.arange(1, 201)
    file = pyuff.UFF(str(export_response(tmp_path / "r.uff", r)))
    assert list(file.get_set_types()) == [58] * 4
    for i, name in enumerate(["theta_2/v_2", "a_0/v_2"]):
        response, coherence = file.read_sets(2 * i), file.read_sets(2 * i + 1)
        assert response["id1"] == f"FRF {name}"
        assert response["func_type"] == 4
        assert response["abscissa_spacing"] == int(even)
        np.testing.assert_allclose(response["data"], r.H[:, i, 0], rtol=1e-10)
        np.testing.assert_allclose(response["x"], r.frequency, rtol=1e-12 if even else 1e-5)
        assert coherence["func_type"] == 6
        np.testing.assert_allclose(coherence["data"], r.coherence[:, i], rtol=1e-10)


def test_python_control_evaluates_it():
    import control  # here: a fifth of a second for each process that collects the tests

    r = measured()
    system = r.to_control()
    assert system.output_labels == ["theta_2", "a_0"]
    assert system.input_labels == ["v_2"]
    k = 123
    np.testing.assert_allclose(system(2j * np.pi * r.frequency[k]).reshape(2, 1), r.H[k])
    doubled = control.append(system, system)
    assert doubled.noutputs == 4


def test_an_unknown_format_and_a_missing_folder(tmp_path):
    with pytest.raises(InputError, match=r"suffix is '\.xls'; expected one of \.csv"):
        export_response(tmp_path / "r.xls", measured())
    with pytest.raises(InputError, match="expected a folder that can be written"):
        export_response(tmp_path / "none" / "r.csv", measured())


def test_a_failure_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text("old", encoding="utf-8")

    def fail():
        with replacing(path) as part:
            part.write_text("half", encoding="utf-8")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_is_not_replaced(tmp_path):
    (tmp_path / "r.csv").mkdir()
    with pytest.raises(InputError, match="expected the path of a file"):
        export_response(tmp_path / "r.csv", measured(n=5))


def test_a_page_is_written_to_no_name_but_a_pages(tmp_path):
    with pytest.raises(InputError, match=r"suffix is '\.mcap'; expected \.html"):
        write_report(tmp_path / "run.mcap", Subject([], [measured()]))
    assert list(tmp_path.iterdir()) == []
