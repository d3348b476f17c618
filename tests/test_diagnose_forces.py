"""Forces that depend on amplitude in the likelihood of whole records."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from concealed_kit import SAMII, driven
from cut_kit import DESIGN, cut_sweeps

from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.diagnose.effect import Effect, Unknown
from samii_rig.diagnose.measured import measured
from samii_rig.diagnose.model import Model, grid
from samii_rig.diagnose.nonlinear_inner import Inner
from samii_rig.diagnose.nonlinear_laws import CUBIC, FRICTION, GAP
from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi
from samii_rig.diagnose.nonlinear_records import Chains, ForceProblem
from samii_rig.diagnose.records import RecordProblem, Whole
from samii_rig.diagnose.refit import Fitted, Problem
from samii_rig.diagnose.result import Diagnosis
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording
from sim.concealed.parts import Law, described

# One level alone, short: every response and every search is what takes the time here.
ONE = replace(DESIGN, levels=(1.0,), burst=18.0, high_hz=20.0)
FEW = ("actuator_lag", "transport_delay", "added_mass")
HARD = 3e7  # N m/rad^3 at joint_1, some 40 noise units


def found_in(runs: list[Recording]) -> Diagnosis:
    """With a table of few linear effects, and all forces."""
    few = [e for e in table(SAMII, 0.5, 20.0) if e.physics in FEW]
    return diagnose(estimate(runs), SAMII, runs=runs, effects=few)


CASES = {
    "coulomb": (Law("coulomb", "joint_2", (0.5,)), Quasi("joint", ("joint_2",), FRICTION), 0.5),
    "cubic": (Law("cubic", "joint_1", (1e8,)), Quasi("joint", ("joint_1",), CUBIC), 1e8),
    "backlash": (
        Law("backlash", "joint_1", (1e-4, 1.36e4)),
        Quasi("joint", ("joint_1",), GAP, 1.0, ("joint_1", "k")),
        1e-4,
    ),
    "flow": (
        Law("flow_saturation", "joint_2_source", (500.0,)),
        Quasi("flow", ("joint_2_source",), None),
        500.0,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_what_a_force_adds_from_rest_is_what_another_integrator_says(name: str) -> None:
    """From rest to a cut end, no loop closed, sensor by sensor."""
    law, quasi, p = CASES[name]
    t = np.arange(3000) / SAMII.rate_hz
    v = 0.5 * np.sin(2 * np.pi * (0.5 * t + 1.5 * t**2))
    plant = described(SAMII)
    plain = driven(plant, v)[1]
    plant.laws = [law]
    added = driven(plant, v, inner=16)[1] - plain
    effect = Effect("force", "here", (Unknown("p", "1", p / 10, 10 * p, (p,)),), quasi=quasi)
    model = LevelModel(SAMII, (effect,))
    x = np.append(np.zeros(model.n - 1), math.log(p))
    inner, sensed = Inner.sensed(model, x)
    ours = sensed.of(inner.from_rest(v, p))
    size = np.sqrt(np.mean(added**2, axis=0))
    off = np.sqrt(np.mean((ours - added) ** 2, axis=0))
    assert np.all(size > 0)
    assert np.all(off < 0.03 * size), off / size


def test_a_hardening_joint_is_named_from_one_sweep_that_ends_with_its_record(tmp_path: Path):
    runs = cut_sweeps(tmp_path, f"cubic_stiffness joint_1 k3={HARD:g}", design=ONE)
    found = found_in(runs)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("cubic_stiffness", "joint_1")
    k3 = cause.parameters["k3"]
    assert k3.low < k3.value < k3.high
    assert k3.value == pytest.approx(HARD, abs=1.5 * (k3.high - k3.low))
    assert found.with_causes[0] < found.threshold < found.nominal[0]


def test_a_valve_that_lags_is_no_force(tmp_path: Path):
    found = found_in(cut_sweeps(tmp_path, "actuator_lag joint_2_source p=150", design=ONE))
    assert [c.physics for c in found.causes] == ["actuator_lag"]


@pytest.fixture(scope="module")
def nothing(tmp_path_factory: pytest.TempPathFactory) -> list[Recording]:
    return cut_sweeps(tmp_path_factory.mktemp("nothing"), design=ONE)


def test_where_nothing_is_missing_no_force_is(nothing: list[Recording]):
    found = found_in(nothing)
    assert found.verdict == "no_mismatch"
    assert found.causes == ()


def test_linear_models_are_weighed_alike_with_and_without_the_lines_no_model_explains(
    nothing: list[Recording],
):
    whole = Whole.of(nothing, SAMII).by_level()
    model = Model(SAMII)
    none = Fitted(model, np.zeros(model.n), 0.0, 0.0, np.zeros((0, model.n)), np.eye(model.n))
    lines = measured(estimate(nothing), SAMII)
    by_line = Problem.of(lines, grid(SAMII, lines.frequency, lines.sensor, lines.actuator))
    few = RecordProblem.about(whole, none, by_line)
    every = ForceProblem.near(whole, none, by_line, Chains())
    chi2 = np.array(
        [
            [float(np.sum(problem.residual(h) ** 2)) for problem in (few, every)]
            for h in (model.response(x, few.at) for x in (none.x, none.x + 1e-3))
        ]
    )
    # A disturbance of less than 2 % of a block's power is left out of the quadratic form alone.
    assert chi2[0, 1] - chi2[1, 1] == pytest.approx(chi2[0, 0] - chi2[1, 0], rel=1e-3)
    assert chi2[0, 1] == pytest.approx(chi2[0, 0] + few.reduced.inside[0], rel=0.02)
