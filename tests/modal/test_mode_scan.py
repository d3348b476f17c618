"""Mode shape scan: an accelerometer that moves between runs, shapes with intervals from them."""

from __future__ import annotations

import csv
import json
import tomllib
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
from experiment_kit import shipped, simulate
from typer.testing import CliRunner

from experiments.shapes import scan_shapes
from samii_rig.cli.app import app
from samii_rig.devices import opening
from samii_rig.errors import EstimateError, InputError
from samii_rig.identify.modal import estimate_modes
from samii_rig.rig.load import load_rig
from samii_rig.run import campaign
from samii_rig.run.setups import setups_of
from samii_rig.types import StopRecord

BELOW, ABOVE = {"on": "link_0", "at": 0.3302}, {"on": "link_1", "at": 0.15}


def scan(**changes):
    return shipped("samii", "mode_scan", **changes)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scan")
    rig, text, experiment = scan(place=[BELOW, ABOVE])
    setups = setups_of(experiment, rig, text)
    outcomes = [
        simulate(s.rig, s.rig_toml, experiment, folder / f"{s.name}.mcap", seed=5 + i)
        for i, s in enumerate(setups)
    ]
    rigs = [s.rig for s in setups]
    found = experiment.conclude(rigs, outcomes, folder / "scan")
    return experiment, rigs, outcomes, found


def rows(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_each_run_has_the_rig_with_the_sensor_at_its_place():
    rig, text, experiment = scan()
    setups = setups_of(experiment, rig, text)
    assert len(setups) == len(experiment.place) == 12
    for setup, place in zip(setups, experiment.place, strict=True):
        moved = setup.rig.sensor[-1]
        assert (moved.name, moved.on, moved.position) == ("a_rove", place.on, place.at)
        assert setup.rig.sensor[:-1] == rig.sensor
        assert tomllib.loads(setup.rig_toml)["sensor"][-1]["position"] == place.at
        assert place.on in setup.instruction
        assert f"{place.at:g} m" in setup.instruction
    assert len({s.name for s in setups}) == 12


def test_shapes_are_measured_with_intervals_that_hold_the_models(done):
    """Fig. 8 and 9 of paper 1."""
    found = done[3]
    table = rows(found.written[0])
    assert {r["sensor"] for r in table} == {"a_0", "a_1", "a_2", "a_rove"}
    assert len(table) == 2 * 5
    far = [
        abs(float(r["shape"]) - float(r["model"])) / float(r["sd"])
        for r in table
        if r["sensor"] != "a_0"
    ]
    assert np.mean(np.array(far) < 1.645) > 0.5
    # The median model pole is the measured one, so this is the shape alone; 1e-4 of bias is
    # what is left of the start from rest.
    for r in table:
        close = 4.5 * float(r["sd"]) + 2e-4 * abs(float(r["shape"]))
        assert abs(float(r["shape"]) - float(r["model"])) < close
        assert float(r["sd"]) < 2e-3 * abs(float(r["shape"]))
    assert found.written[1].suffix == ".svg"
    assert found.written[1].stat().st_size > 5000
    assert sum("90 %" in line for line in found.lines) == len(found.lines)


def test_the_slope_of_mode_2_changes_at_joint_1(done):
    """Below joint 1 link 0 hardly turns, above it link 1 swings back."""
    table = rows(done[3].written[0])
    mode = {
        (r["sensor"], r["on"]): (float(r["x [m]"]), float(r["shape"]))
        for r in table
        if r["mode"] == "2"
    }
    (x0, w0), (x1, w1) = mode["a_0", "link_0"], mode["a_rove", "link_0"]
    (x2, w2), (x3, w3) = mode["a_rove", "link_1"], mode["a_1", "link_1"]
    before, after = (w1 - w0) / (x1 - x0), (w3 - w2) / (x3 - x2)
    assert abs(before) < 0.2
    assert after < -2.0


def test_a_mode_that_no_run_shows_is_said(done, tmp_path):
    experiment, rigs, outcomes, _ = done
    modes = [estimate_modes(outcomes[0].responses[0], rigs[0], n_pairs=2)]
    with pytest.raises(EstimateError, match=r"run 1: no mode within 20 % of 4 Hz; found 1\.7"):
        scan_shapes(rigs[:1], modes, (4.0,), "a_rove", "a_0")
    empty = [replace(outcomes[0], responses=(), trouble="too short"), outcomes[1]]
    with pytest.raises(EstimateError, match="too short"):
        experiment.conclude(rigs, empty, tmp_path / "scan")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"reference": "a_9"}, "a_0, a_1, a_2"),
        ({"reference": "theta_2"}, "an accelerometer"),
        ({"modes_hz": [0.3]}, "the sweep's band"),
        ({"place": [{"on": "joint_2", "at": 0.0}]}, "place 1.*no extent"),
        ({"place": [BELOW, {"on": "link_1", "at": 0.5}]}, "place 2.*beyond"),
        ({"place": [{"on": "link_9", "at": 0.5}]}, "does not exist"),
    ],
)
def test_a_scan_that_the_rig_does_not_allow_is_said_in_one_line(changes, words):
    rig, text, experiment = scan(**changes)
    with pytest.raises(InputError, match=words) as wrong:
        experiment.setups(rig, text)
    assert "\n" not in str(wrong.value)


def test_the_rovers_name_must_be_its_own():
    rig, text, experiment = scan()
    roving = experiment.roving.model_copy(update={"name": "a_0"})
    with pytest.raises(InputError, match="twice"):
        experiment.model_copy(update={"roving": roving}).setups(rig, text)


def short(folder, places):
    """The shipped file with its first places alone."""
    head, *each = (files("experiments") / "data" / "mode_scan.toml").read_text().split("[[place]]")
    path = folder / "short.toml"
    path.write_text("[[place]]".join([head, *each[:places]]))
    return path


def test_the_dry_run_predicts_every_place(tmp_path):
    scan_file = str(short(tmp_path, 3))
    result = CliRunner().invoke(app, ["run", scan_file, "--dry-run", "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.output)
    assert len(said["dry_runs"]) == 3
    assert {m["channel"] for m in said["dry_runs"][0]["margins"]} >= {"a_rove"}


@pytest.mark.parametrize(
    ("name", "words"), [("stepped_sine", "most : s at most"), ("mode_scan", "roving : the sensor")]
)
def test_an_experiment_says_what_its_file_can_hold(name, words):
    result = CliRunner().invoke(app, ["run", name, "--describe"])
    assert result.exit_code == 0
    assert words in result.output
    assert f'experiment = "{name}"' in result.output


def test_a_run_that_is_stopped_ends_the_scan(done, tmp_path, monkeypatch):
    outcomes = done[2]
    calls = []

    def stopped(*args, **how):
        calls.append(args)
        if len(calls) == 1:
            return outcomes[0]
        return replace(outcomes[1], stop=StopRecord("stopped", "stopped by SIGINT"))

    monkeypatch.setattr(campaign, "carry_out", stopped)
    result = CliRunner().invoke(
        app, ["run", str(short(tmp_path, 3)), "--no-report", "--out", str(tmp_path / "scan.mcap")]
    )
    assert result.exit_code == 130
    assert len(calls) == 2
    assert [args[1].name for args in calls] == ["scan_01.mcap", "scan_02.mcap"]
    assert "mode 1: " not in result.output  # of the scan; each run has its own modes


def test_on_a_real_rig_a_person_is_asked_before_each_run(tmp_path, monkeypatch):
    text = load_rig("samii")[1]
    path = tmp_path / "real.toml"
    path.write_text(text.replace('driver = "simulated"', 'driver = "valve"'))

    def never(*args, **how):
        raise AssertionError("it moved without an answer")

    monkeypatch.setattr(campaign, "carry_out", never)
    # No package brings a driver of that name, so nobody can be asked what it could run.
    monkeypatch.setattr(opening, "check_device", lambda rig: None)
    result = CliRunner().invoke(
        app,
        ["run", str(short(tmp_path, 1)), "--rig", str(path), "--out", str(tmp_path / "x.mcap")],
        input="n\n",
    )
    assert result.exit_code != 0
    assert not isinstance(result.exception, AssertionError)
    assert "put a_rove on beam, 1.2 m from its upstream end" in result.output
