"""The steering mirror of Floren et al. (ISMA 2024): a real rig of three inputs and outputs."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
SPEC = importlib.util.spec_from_file_location("mirror", ROOT / "benchmarks" / "mirror_study.py")
assert SPEC is not None
assert SPEC.loader is not None
study = importlib.util.module_from_spec(SPEC)
sys.modules["mirror"] = study
SPEC.loader.exec_module(study)


@pytest.fixture(scope="module")
def folder():
    parent = Path(os.environ.get("SAMII_RIG_RECORDINGS", ROOT.parent / "shared" / "recordings"))
    found = parent / "fine_steering_mirror"
    if not found.is_dir():
        pytest.skip(
            f"no recordings of the steering mirror in {parent}; set SAMII_RIG_RECORDINGS to the "
            "folder that holds fine_steering_mirror (github.com/merijnfloren/fsm-benchmark-data)"
        )
    return found


@pytest.fixture(scope="module")
def measured(folder):
    return {level: study.measured(folder, level) for level in study.LEVELS}


def test_nine_responses_are_measured_at_both_levels(measured):
    for m in measured.values():
        r = m.response
        assert r.H.shape[1:] == (3, 3)
        assert r.frequency[-1] > 2990
        # An actuator moves the point nearest to it and the others as much as the plate is stiff.
        assert np.all(np.median(np.abs(r.H), axis=0) > 1e-7)
        assert m.sd < 0.05


def test_the_noise_of_a_period_is_that_of_the_difference_of_the_periods(folder, measured):
    for level, m in measured.items():
        straight = study.by_difference(folder, level, offset=False)
        assert m.noise == pytest.approx(straight, rel=0.1)
    # The figures that came with the recordings, 3.4 % and 1.4 %, count the drift of the level too.
    assert study.by_difference(folder, 100, offset=True) == pytest.approx(0.034, abs=5e-4)
    assert study.by_difference(folder, 200, offset=True) == pytest.approx(0.014, abs=5e-4)


def test_distortion_stands_apart_from_noise_and_from_the_level(measured):
    weak, strong = measured[100], measured[200]
    assert weak.noise > 3 * strong.noise
    # Piezos' hysteresis goes with the motion: its share hardly depends on the level.
    assert 0.6 < strong.distortion / weak.distortion < 1.2
    for m in measured.values():
        said = {f.channel for f in m.response.findings if f.kind == "distortion"}
        assert said == {"y_1", "y_2", "y_3"}
