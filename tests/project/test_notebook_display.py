"""Data in a notebook: a small table, a picture, and the forms that other libraries hold.

Plan: what a person sees of each kind and that names from files cannot become markup; the pictures
hold the report's curves; numpy, xarray and MATLAB have every number back by the names of channels;
nothing of it is imported before it is asked for.
"""

import re
import subprocess
import sys
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
from report_kit import measured, recorded
from scipy.io import loadmat

from samii_rig.diagnose.result import Cause, Diagnosis, Gap, Trace, Value
from samii_rig.errors import InputError
from samii_rig.record.export import export_response
from samii_rig.report.canvas import unpacked
from samii_rig.report.notebook import COLOURS
from samii_rig.types import Channel, Segment

HOSTILE = "<script>alert(1)</script>"


def found(**changes):
    cause = Cause(
        "torsional_compliance",
        "joint_1",
        0.97,
        (("velocity_feedback", "joint_1"),),
        {"k": Value(13600.0, "N m/rad", 13500.0, 13700.0)},
    )
    f = np.geomspace(1.0, 30.0, 20)
    trace = Trace("joint_1", "theta", "M", f, np.full(20, 7e-5 + 0j), np.full(20, 1e-6), 1.0)
    made = Diagnosis(
        verdict="named",
        chi2_per_dof=30.0,
        threshold=1.1,
        bands=(),
        sites=(("joint_1", 0.97), ("link_1", 0.03)),
        causes=(cause,),
        alternatives=(),
        nominal=(30.0, 31.0),
        with_causes=(1.0, 1.01),
        noise_floor=1.0,
        gap=Gap(0.99, 0.98, 1.0),
        not_physics=(),
        why="",
        experiment="",
        outside=0.0,
        rig=None,
        traces=(trace,),
    )
    return replace(made, **changes)


def test_a_recording_shows_its_channels_segments_and_losses():
    said = recorded(lost=40)._repr_html_()
    for part in ("theta_2", "reference", "500 Hz", "1 x burst at 1 V", "unknown", "run_1.mcap"):
        assert part in said
    assert said.count("<tr>") == 1 + 3


def test_a_response_shows_band_level_method_and_how_well_it_is_known():
    r = measured(relative=0.02)
    said = r._repr_html_()
    assert "500, 0.5 to 50 Hz" in said
    assert "1 V" in said
    assert r.why in said
    # 2 % is the deviation that the noise was made with, seen through one draw of H.
    assert [float(x) for x in re.findall(r">([\d.]+) %<", said)] == pytest.approx([2, 2], rel=0.05)


def test_a_diagnosis_shows_what_where_how_sure_and_what_is_not_told_apart():
    said = found()._repr_html_()
    for part in ("torsional compliance", "joint_1 97%", "1.36e+04 N m/rad", "velocity feedback"):
        assert part in said


@pytest.mark.parametrize(
    "shown",
    [
        replace(recorded(), source=HOSTILE, channels=(Channel(HOSTILE, HOSTILE),) * 3),
        replace(measured(), why=HOSTILE, level_unit=HOSTILE),
        found(sites=((HOSTILE, 1.0),), not_physics=(HOSTILE,)),
    ],
    ids=lambda x: type(x).__name__,
)
def test_a_name_from_a_file_stays_a_name(shown):
    said = shown._repr_html_()
    assert HOSTILE not in said
    assert "&lt;script&gt;" in said


def test_the_pictures_hold_the_measured_curve():
    r = measured()
    figure = r.plot("a_0")
    gain = next(t for t in figure.data if t.yaxis in (None, "y") and t.name == "1 V")
    drawn = np.asarray(gain.y) if not isinstance(gain.y, dict) else unpacked(gain.y)
    np.testing.assert_allclose(drawn, np.abs(r.H[:, 1, 0]), rtol=1e-6)
    assert "@" not in figure.to_json()


def test_a_recording_is_drawn_one_segment_at_a_time():
    r = recorded()
    halves = (Segment("a", "burst", 0, 3000, 1.0, "V"), Segment("b", "burst", 3000, 6000, 2.0, "V"))
    figure = replace(r, segments=halves).plot()
    assert [t.visible for t in figure.data] == [True] * 3 + [False] * 3
    menu = figure.layout.updatemenus[0].buttons
    assert [b.label[0] for b in menu] == ["a", "b"]
    assert menu[1].args[0]["visible"] == [False] * 3 + [True] * 3


def test_what_is_missing_at_a_place_is_drawn_without_its_law():
    figure = found().plot()
    assert {t.name for t in figure.data} == {"joint_1"}
    with pytest.raises(InputError, match="no place stands out"):
        found(traces=(), causes=(), verdict="no_mismatch").plot()


def test_an_unknown_channel_costs_one_line():
    with pytest.raises(InputError, match="theta_2, a_0"):
        measured().plot("a_7")


def test_the_colours_are_those_of_the_page():
    page = (resources.files("samii_rig.report") / "assets" / "page.js").read_text("utf-8")
    light = page[page.index("light:") : page.index("dark:")]
    assert all(colour in light for colour in COLOURS.values())


def test_columns_of_a_recording_have_the_names_of_channels():
    r = recorded(lost=40)
    held = r.to_numpy()
    assert list(held) == ["time_s", "sequence", "u", "v_2", "theta_2"]
    np.testing.assert_allclose(held["time_s"], r.sequence / 500.0, rtol=1e-12)
    np.testing.assert_array_equal(held["theta_2"], r.values[:, 2])


def test_xarray_has_every_sample_and_line_by_name():
    pytest.importorskip("xarray")
    r = recorded(lost=40)
    data = r.to_xarray()
    np.testing.assert_array_equal(data["theta_2"], r.values[:, 2])
    assert data["theta_2"].attrs == {"units": "rad", "role": "sensor"}
    assert data.sizes == {"time": 6000, "channel": 3}
    assert data.attrs["note_seed"] == "7"
    H = measured()
    lines = H.to_xarray()
    entry = lines["H"].sel(output="a_0", input="v_2")
    np.testing.assert_array_equal(entry, H.H[:, 1, 0])
    cross = lines["covariance"].sel(entry="theta_2/v_2", other_entry="a_0/v_2")
    np.testing.assert_array_equal(cross, H.covariance[:, 0, 1])
    np.testing.assert_array_equal(lines["sd"], np.sqrt(H.variance()))
    assert str(lines["output_unit"].sel(output="a_0").item()) == "m/s^2"


def test_without_xarray_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(InputError, match=r"samii-rig\[notebook\]"):
        recorded().to_xarray()


def test_matlab_reads_everything(tmp_path):
    r = measured()
    read = loadmat(export_response(tmp_path / "r.mat", r))
    np.testing.assert_array_equal(read["H"], r.H)
    np.testing.assert_array_equal(read["frequency_hz"][:, 0], r.frequency)
    np.testing.assert_array_equal(read["covariance"], r.covariance)
    assert [str(x).strip() for x in read["outputs"]] == ["theta_2", "a_0"]


def test_nothing_of_it_is_imported_before_it_is_asked_for():
    code = (
        "import sys, samii_rig.types, samii_rig.diagnose.result\n"
        "print([m for m in ('plotly', 'matplotlib', 'xarray', 'control', 'scipy', 'pandas') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
