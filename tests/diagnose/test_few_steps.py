"""SFLR's encoder moves by few steps in most of a sweep: what shows in it alone is found where it
moves by more, and what its loop makes of its rounding is no mismatch."""

from __future__ import annotations

from pathlib import Path

import few_kit
import pytest

from samii_rig.diagnose.batch import How, together
from samii_rig.diagnose.result import Diagnosis
from samii_rig.rig.load import load_rig
from sim.concealed.runs import Design
from sim.concealed.stated import Stated
from sim.concealed.trial import make

SHORT = Design(
    levels=(6.0, 24.0),
    bursts=2,
    burst=20.0,
    ring_down=3.0,
    period=4.0,
    settle=2,
    periods=2,
    steps=2,
)
LAG = Stated("sensor_lag", "theta", {"p": 40.0})
TRIED = ("sensor_lag", "theta"), ("added_mass", "beam"), ("actuator_lag", "motor")


def diagnosed(folder: Path, kind: str, *stated: Stated) -> Diagnosis:
    _, text = load_rig("sflr")
    logs = make(kind, 3, folder, text, SHORT, stated)  # type: ignore[arg-type]
    return together(sorted(logs.glob("*.mcap")), How())


def test_nothing_is_missing_where_a_loop_follows_its_rounding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few_kit.only(monkeypatch, *TRIED, forced=False)
    found = diagnosed(tmp_path, "nothing")
    assert found.verdict == "no_mismatch"
    assert 0.7 < found.chi2_per_dof < found.threshold
    said = dict(found.used.left_out)
    assert "3 of its steps or less" in said["theta"]
    assert "times as hard" in found.experiment


def test_a_lag_that_the_coarse_encoder_alone_shows_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few_kit.only(monkeypatch, *TRIED, forced=False)
    found = diagnosed(tmp_path, "stated", LAG)
    assert [(c.physics, c.site) for c in found.causes] == [("sensor_lag", "theta")]
    p = found.causes[0].parameters["p"]
    assert p.low is not None
    assert p.high is not None
    assert p.low < LAG.parameters["p"] < p.high
