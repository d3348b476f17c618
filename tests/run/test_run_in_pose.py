"""A run in a pose: the simulated rig stands in it, and the recording says so."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from arm_kit import arm_text, files
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.errors import InputError
from samii_rig.identify.poses import poses_of
from samii_rig.model.sampled import sampled_response
from samii_rig.pytest_plugin import assert_no_mismatch
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.pose import posed
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate

POSES = ("0 deg", "120 deg")
QUICK = ("--no-report", "--no-diagnosis")


def said(*words: str) -> str:
    result = CliRunner().invoke(app, words)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files and a recording of each pose."""
    folder = tmp_path_factory.mktemp("lab")
    rig, sweep = files(folder)
    for i, pose in enumerate(POSES):
        out = str(folder / f"{i}.mcap")
        said("run", sweep, "--rig", rig, "--pose", pose, "--seed", str(i + 1), "--out", out, *QUICK)
    return folder


def recordings(lab: Path):
    return [read_recording(lab / f"{i}.mcap") for i in range(len(POSES))]


def test_a_recording_carries_the_pose_it_was_made_in(lab):
    rig = parse(Rig, arm_text(), "arm")
    both = recordings(lab)
    assert [round(math.degrees(p.value)) for p in poses_of(both, rig, ())] == [0, 120]
    for recording, pose in zip(both, POSES, strict=True):
        assert parse(Rig, recording.rig_toml, "recorded") == posed(rig, pose)


@pytest.mark.parametrize("i", range(len(POSES)))
def test_the_simulated_rig_stands_in_the_pose(lab, i):
    (a,) = estimate([recordings(lab)[i]])
    rig = parse(Rig, arm_text(), "arm")

    def apart(pose: str) -> float:
        model = sampled_response(posed(rig, pose), a.frequency)
        # Weight is felt below the first mode: one line there tells the poses apart.
        return float(np.max(np.abs(a.H - model) ** 2 / a.variance()))

    assert apart(POSES[i]) < 30.0
    assert apart(POSES[1 - i]) > 300.0


def test_the_rig_file_explains_both_without_a_word_of_their_poses(lab):
    found = assert_no_mismatch(recordings(lab), lab / "arm.toml")
    assert found.verdict == "no_mismatch"
    assert_no_mismatch(recordings(lab)[1], lab / "arm.toml")


def test_identify_takes_the_poses_from_the_recordings(lab):
    logs = [str(lab / f"{i}.mcap") for i in range(len(POSES))]
    plain = json.loads(said("identify", *logs, "--rig", str(lab / "arm.toml"), "--json"))
    told = [word for pose in POSES for word in ("--pose", pose)]
    named = json.loads(said("identify", *logs, "--rig", str(lab / "arm.toml"), *told, "--json"))
    assert plain == named


@pytest.mark.parametrize(
    ("rig", "pose", "words"),
    [("samii", "30 deg", "no gravity"), ("arm", "30", "an angle with its unit")],
)
def test_a_pose_that_cannot_be_is_refused_before_anything_is_written(tmp_path, rig, pose, words):
    own, sweep = files(tmp_path)
    out = tmp_path / "out" / "run.mcap"
    asked = ("run", sweep, "--rig", own if rig == "arm" else rig, "--pose", pose, "--out", str(out))
    with pytest.raises(InputError, match=words):
        said(*asked)
    assert not out.parent.exists()


def test_a_dry_run_is_of_the_pose(tmp_path):
    rig, sweep = files(tmp_path)
    each = [said("run", sweep, "--rig", rig, "--pose", p, "--dry-run", "--json") for p in POSES]
    assert each[0] != each[1]
    assert load_rig(rig)[0].pose is not None
