"""The plugin's marker knows a pose: the simulated rig stands in it, its recording is held in it."""

from __future__ import annotations

from arm_kit import files
from plugin_kit import passed, pytest_in

TEST = """
import math
import pytest
from samii_rig.pytest_plugin import assert_no_mismatch
from samii_rig.rig.load import load_rig

@pytest.mark.samii_rig(rig="arm.toml", experiment="sweep.toml", pose="120 deg")
def test_it_stands_in_the_pose(rig, recording):
    assert math.degrees(rig.pose.value) == pytest.approx(120.0)
    assert "120.0" in recording.rig_toml or "2.094" in recording.rig_toml
    assert_no_mismatch(recording, "arm.toml")
    assert math.degrees(load_rig("arm.toml")[0].pose.value) == 0.0
"""
WRONG = """
import pytest

@pytest.mark.samii_rig(pose="30 deg")
def test_it_has_no_gravity(rig):
    pass
"""


def test_a_marker_with_a_pose_is_recorded_and_held_in_it(tmp_path):
    files(tmp_path)
    (tmp_path / "test_arm.py").write_text(TEST)
    passed(pytest_in(tmp_path), 1)


def test_a_pose_of_a_rig_without_gravity_fails_the_test_in_one_line(tmp_path):
    (tmp_path / "test_wrong.py").write_text(WRONG)
    done = pytest_in(tmp_path)
    assert done.returncode == 1
    assert (
        "marker samii_rig, pose is '30 deg'; expected none, as SAMII has no gravity" in done.stdout
    )
