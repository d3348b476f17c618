"""A study says how modes move with parameters, point by point.

Plan: the closed form of a body on a damped spring over a grid of both, with its sensitivities; the
points that are unstable or not to be had say so; modes keep their number whatever the band; the
command writes every digit and a picture; a mistake costs one line and leaves no file.
"""

import csv
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.errors import InputError
from samii_rig.model.modes import poles
from samii_rig.model.study import Study, study, vary
from samii_rig.report.study import figure
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig

J = 0.1  # kg m^2, of the body about the joint
BODY = """
name = "body"
base = "clamped"
tip = "free"
rate_hz = 500.0
element = [
  { name = "source", kind = "angular_velocity_source", input = "v", K = { value = 1.0, unit = "rad/(s V)", source = "t" }, p = { value = 100.0, unit = "rad/s", source = "t" } },
  { name = "joint", kind = "torsional_spring", k = { value = 40.0, unit = "N m/rad", source = "t" }, c = { value = 0.2, unit = "N m s/rad", source = "t" } },
  { name = "weight", kind = "gravity_stiffness", k = { value = 0.0, unit = "N m/rad", source = "t" } },
  { name = "link", kind = "rigid_link", L = { value = 0.5, unit = "m", source = "t" }, r = { value = 0.25, unit = "m", source = "t" }, m = { value = 1.0, unit = "kg", source = "t" }, I = { value = 0.0375, unit = "kg m^2", source = "t" } },
]
sensor = [{ name = "theta", kind = "relative_angle", across = ["source"], unit = "rad" }]
actuator = [{ name = "v", unit = "V", low = -10.0, high = 10.0 }]
"""  # noqa: E501


def of(text: str, *given: str, band: tuple[float, float] = (0.0, 20.0)) -> Study:
    rig = parse(Rig, text, "test")
    with ThreadPoolExecutor(1) as executor:
        return study(text, [vary(rig, g) for g in given], band, executor)


def test_a_body_on_a_damped_spring_moves_as_the_closed_form_says() -> None:
    found = of(BODY, "joint.k=10:160:5:log", "joint.c=0.1:0.3:3")
    k, c = found.point.T
    assert k.tolist() == [x for x in np.geomspace(10, 160, 5) for _ in range(3)]
    assert found.number.tolist() == [1]
    np.testing.assert_allclose(found.hz[:, 0], np.sqrt(k / J) / (2 * np.pi), rtol=1e-9)
    np.testing.assert_allclose(found.ratio[:, 0], c / (2 * np.sqrt(k * J)), rtol=1e-9)
    np.testing.assert_allclose(found.sensitivity(found.hz), [[0.5, 0.0]], atol=1e-8)
    np.testing.assert_allclose(found.sensitivity(found.ratio), [[-0.5, 1.0]], atol=1e-8)
    assert set(found.note) == {""}


def test_a_range_that_holds_zero_has_its_sensitivity_by_the_range() -> None:
    found = of(BODY, "weight.k=-1:1:3")
    # The logarithm of sqrt(40 + k) grows by 1/80 a unit, over a range of 2.
    np.testing.assert_allclose(found.sensitivity(found.hz), [[2 / 80]], rtol=1e-3)


def test_points_that_fall_over_or_cannot_be_say_so_and_the_rest_have_their_modes() -> None:
    found = of(BODY, "weight.k=-80:0:2", "joint.c=-0.2:0.2:2")
    falls, stands = found.note[1], found.note[3]
    # J s^2 + c s - 40 = 0, far right of the band's reach.
    right = (-0.2 + np.sqrt(0.04 + 4 * J * 40)) / (2 * J)
    assert falls == f"unstable: pole at {complex(right):.6g} rad/s"
    assert stands == ""
    assert found.note[0] == "joint.c: value -0.2 N m s/rad; expected 0 or more"
    assert np.isfinite(found.hz[:, 0]).tolist() == [False, False, False, True]


def test_a_mode_keeps_its_number_whatever_the_band() -> None:
    rig, text = load_rig("samii")
    found = of(text, "joint_1.k=13600:20000:2", band=(5.0, 50.0))
    assert found.number.tolist() == [2, 3]
    np.testing.assert_allclose(found.hz[0], poles(rig, 50.0).hz[1:3], rtol=1e-9)


def test_the_command_writes_every_digit_and_a_picture(tmp_path: Path) -> None:
    (tmp_path / "body.toml").write_text(BODY)
    out, plot = tmp_path / "study.csv", tmp_path / "study.svg"
    given = ["joint.k=10:160:3:log", "joint.c=-0.1:0.3:2"]
    done = CliRunner().invoke(
        app,
        ["study", "--rig", str(tmp_path / "body.toml"), "--vary", given[0], "--vary", given[1],
         "--band", "0", "20", "--out", str(out), "--plot", str(plot), "--workers", "1"],
    )  # fmt: skip
    assert done.exit_code == 0, done.exception
    assert "1.592 to 6.366" in done.stdout
    assert "3 of 6 points are unstable or have no answer" in done.stdout
    found = of(BODY, *given)
    with out.open(newline="") as stream:
        assert stream.readline() == "# modes of body from 0 to 20 Hz\n"
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == [
        "joint.k [N m/rad]", "joint.c [N m s/rad]", "f_1 [Hz]", "zeta_1 [1]", "note",
    ]  # fmt: skip
    assert [float(r["f_1 [Hz]"] or "nan") for r in rows] == pytest.approx(
        found.hz[:, 0].tolist(), rel=0, abs=0, nan_ok=True
    )
    assert tuple(r["note"] for r in rows) == found.note
    assert "joint.k [N m/rad]" in plot.read_text()


def test_a_picture_has_a_column_a_mode_and_a_curve_for_each_second_value() -> None:
    text = load_rig("samii")[1]
    axes = figure(of(text, "joint_1.k=9e3:2e4:3", "joint_2.c=0:90:4", band=(0.0, 30.0))).axes
    assert [a.get_title() for a in axes] == ["mode 1", "mode 2", "mode 3", "", "", ""]
    assert [len(a.lines) for a in axes] == [5] * 6  # and the rig file's own value
    none = figure(of(text, "joint_1.k=9e3:2e4:2", band=(0.0, 1e-3)))
    assert "No mode in the band" in none.get_suptitle()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--vary", "joint_9.k=1:2:3"], "an element of body: source, joint, weight, link"),
        (["--vary", "joint.q=1:2:3"], "a parameter of joint: k, c"),
        (["--vary", "joint.k"], "LOW:HIGH:N or LOW:HIGH:N:log"),
        (["--vary", "joint.k=1:2:x"], "LOW:HIGH:N or LOW:HIGH:N:log"),
        (["--vary", "joint.k=2:1:3"], "LOW below HIGH"),
        (["--vary", "joint.k=1:inf:3"], "both finite"),
        (["--vary", "joint.k=0:1:3:log"], "LOW above 0"),
        (["--vary", "joint.k=1:2:1"], "2 to 100,000 values"),
        (["--vary", "joint.k=1:2:400", "--vary", "joint.c=1:2:400"], "at most 100,000"),
        (["--vary", "joint.k=1:2:2", "--vary", "joint.k=1:2:2"], "each parameter once"),
        (["--vary", "joint.k=1:2:2", "--band", "5", "1"], "the lower one first"),
        (
            ["--vary", "joint.k=1:2:2", "--out", "{}/none/study.csv"],
            "a name in a folder that exists",
        ),
        (["--vary", "joint.k=1:2:2", "--plot", "{}/study.gif"], ".svg or .pdf"),
        (
            [*(f"--vary={x}=1:2:2" for x in ("joint.k", "joint.c", "link.m")), "--plot={}/s.png"],
            "one or two --vary",
        ),
    ],
)
def test_a_mistake_costs_one_line_and_leaves_no_file(
    tmp_path: Path, options: list[str], said: str
) -> None:
    rig = tmp_path / "body.toml"
    rig.write_text(BODY)
    written = ["--out", str(tmp_path / "study.csv")] if "--out" not in options else []
    given = [option.format(tmp_path) for option in options]
    done = CliRunner().invoke(app, ["study", "--rig", str(rig), *written, *given])
    assert isinstance(done.exception, InputError), done.output
    assert said in str(done.exception)
    assert "\n" not in str(done.exception)
    assert list(tmp_path.iterdir()) == [rig]
