"""The papers' two models of a giving actuator, concealed, told apart by theta_2 alone.

Recordings of the concealed plant, shorter than a trial's; `benchmarks/papers_story.py` tells the
whole story. Over five seeds of each case the values lay within 2 % of the truth.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.signal.estimate import estimate
from sim.concealed.runs import Design

STORY = Path(__file__).resolve().parents[2] / "benchmarks" / "papers_story.py"
SHORT = Design(levels=(1.0,), burst=20.0, ring_down=3.0, bursts=1, period=4.0, settle=2,
               periods=3, steps=1)  # fmt: skip
CLOSE = 0.06  # relative
BAND = (0.5, 30.0)  # Hz
LAGS = ("actuator_lag", "transport_delay", "sensor_delay")  # that fall off towards high frequencies


@pytest.fixture(scope="module")
def story() -> ModuleType:
    spec = importlib.util.spec_from_file_location("papers_story", STORY)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("case", "physics", "symbol", "value", "rival"),
    [
        ("theta_spring", "torsional_compliance", "k", 1.08e4, "velocity_feedback"),
        ("theta_feedback", "velocity_feedback", "g_v", 700.0, "torsional_compliance"),
    ],
)
def test_the_encoder_alone_tells_spring_damper_from_velocity_feedback(
    story: ModuleType,
    tmp_path: Path,
    case: str,
    physics: str,
    symbol: str,
    value: float,
    rival: str,
) -> None:
    told = story.STORY[case]
    runs = story.recorded(told, tmp_path, 0, SHORT)
    rig = story.nominal(told)
    few = [e for e in table(rig, *BAND) if {physics, rival, *LAGS} & {name for name, _ in e.names}]
    found = diagnose(estimate(runs, outputs=told.outputs), rig, runs=runs, effects=few)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert cause.physics == physics
    assert "joint_2_source" in {cause.site, *(site for _, site in cause.equivalents)}
    assert rival not in {name for name, _ in cause.equivalents}
    assert cause.parameters[symbol].value == pytest.approx(value, rel=CLOSE)
    # What one curve cannot show, and what would.
    assert any("only theta_2 was recorded" in text for text in found.not_physics)
    assert "brace the rig behind link_0" in found.experiment
