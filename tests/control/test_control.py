"""Design of a damping loop: what it promises holds on rigs that it did not look at, and a step
recorded on the simulated rig shows the damping that the model of the closed loop has."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.control.design import Draws, Goals, design, lowpass
from samii_rig.control.identified import identified
from samii_rig.control.margins import margins
from samii_rig.control.plants import corners, judge, plant, stiffnesses, uncertain, with_values
from samii_rig.control.result import distribution, lines, lowpass_numbers, plain, rig_text
from samii_rig.control.settle import settle_time, settling
from samii_rig.errors import EstimateError, InputError
from samii_rig.model.loops import loops_of, unstable_count
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.run.campaign import carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.experiments import load_experiment
from samii_rig.run.order import RunOrder

SAMII, TEXT = load_rig("samii")


@pytest.fixture(scope="module")
def made():
    return design(SAMII, poles=3, draws=Draws(4, seed=1))


def test_the_goals_are_reached_with_every_stiffness_off_by_a_fifth(made):
    assert len(made.corners) == 2 ** len(stiffnesses(SAMII)) == 32
    assert made.reached
    assert made.least("damping") >= 0.25
    assert made.least("gain_db") >= 6.0
    assert made.least("phase_deg") >= 40.0
    assert made.without.damping < 0.02 < 0.3 < made.nominal.damping
    assert all(j.outside == 0 for j in (*made.corners, *made.draws, *made.uncertain))


def test_it_holds_on_rigs_that_it_never_saw(made):
    keys = stiffnesses(SAMII)
    factors = np.random.default_rng(99).uniform(0.8, 1.2, (4, len(keys)))
    for row in factors:
        values = {
            (e, s): x * getattr(next(q for q in SAMII.element if q.name == e), s).value
            for (e, s), x in zip(keys, row, strict=True)
        }
        rig = with_values(made.rig, values)
        j = judge(plant("unseen", rig, made.loops), made.loops)
        assert made.goals.reserve(j) >= 1.0
        assert unstable_count(rig) == 0


def test_the_margins_are_where_the_loop_becomes_unstable(made):
    given_plant = made.plant
    margin = made.nominal.feedback
    for change, stable in ((0.9, True), (1.1, False)):
        factor = 10 ** (margin.gain_db * change / 20)
        (loop,) = made.rig.feedback
        louder = loop.model_copy(update={"gain": factor * loop.gain})
        rig = made.rig.model_copy(update={"feedback": (louder,)})
        assert (judge(given_plant, loops_of(rig)).outside == 0) is stable
        assert (unstable_count(rig) == 0) is stable


@given(st.floats(0.2, 5.0), st.floats(0.3, 4.0))
def test_margins_of_a_loop_known_by_heart(gain, corner):
    # L = 8 gain/(1 + s/w)^3: phase -180 at sqrt(3) w, where |L| is gain.
    f = corner * np.geomspace(0.01, 100, 4000)
    m = margins(f, 8 * gain / (1 + 1j * f / corner) ** 3)
    assert m.gain_db == pytest.approx(abs(20 * math.log10(gain)), abs=0.01)
    assert m.gain_hz == pytest.approx(math.sqrt(3) * corner, rel=1e-3)
    crossing = corner * math.sqrt((8 * gain) ** (2 / 3) - 1)
    lag = 3 * math.degrees(math.atan(crossing / corner))
    assert m.phase_deg == pytest.approx(abs(180 - lag), abs=0.05)


def test_one_pole_is_too_few(made):
    # Best of a coarse search: acceleration through one pole drives mode 2 before it damps mode 1.
    best = 0.0
    for corner in np.geomspace(0.2, 4.0, 8):
        for gain in np.concatenate([-np.geomspace(0.02, 3, 14), np.geomspace(0.02, 3, 14)]):
            loop = lowpass(SAMII, "a_0", "v_2", 1, corner, gain)
            loops = loops_of(SAMII.model_copy(update={"feedback": (loop,)}))
            best = max(best, Goals().reserve(judge(made.plant, loops)))
    assert best < 0.9


def test_the_rig_file_that_comes_out_is_the_design(made):
    rig = parse(Rig, rig_text(TEXT, made), "out")
    assert rig.feedback == made.rig.feedback
    assert rig.element == SAMII.element
    n, corner, gain = lowpass_numbers(made.feedback)
    assert n == 3
    assert gain * (2 * math.pi * corner) ** 3 == pytest.approx(made.feedback.gain)
    assert made.feedback.max == pytest.approx(0.4 * 5.0)
    assert len(lines(made)) == 3
    json.dumps(plain(made))


def test_corners_are_all_combinations_and_draws_keep_their_covariance(tmp_path):
    values = corners(SAMII, 0.2)
    assert values["-----"]["joint_2", "k"] == pytest.approx(0.8 * 10800)
    assert values["+++++"]["beam", "EI"] == pytest.approx(1.2 * 339134.5276)
    covariance = np.array([[0.04, -0.019], [-0.019, 0.01]])
    found = {
        "parameters": {"joint_1.k": {"value": 12000.0}, "joint_2.k": {"value": 11000.0}},
        "log_covariance": covariance.tolist(),
    }
    path = tmp_path / "found.json"
    path.write_text(json.dumps(found))
    got = identified(TEXT, path)
    joint = next(e for e in got.rig.element if e.name == "joint_2")
    assert joint.k.value == 11000.0
    assert joint.k.tolerance == pytest.approx(0.1)
    assert joint.c == next(e for e in SAMII.element if e.name == "joint_2").c
    drawn = uncertain(got.rig, 400, 3, got.known)
    logs = np.log([[v["joint_1", "k"] / 12000, v["joint_2", "k"] / 11000] for v in drawn.values()])
    np.testing.assert_allclose(np.cov(logs.T), covariance, rtol=0.2)


@pytest.mark.parametrize("text", ["{}", "[1]", "no", '{"parameters": {"x.k": {"value": 1}}}'])
def test_what_is_no_identification_is_one_line(tmp_path, text):
    path = tmp_path / "found.json"
    path.write_text(text)
    with pytest.raises(InputError, match="expected what `samii-rig identify --json` printed"):
        identified(TEXT, path)


def test_bad_questions_are_one_line():
    with pytest.raises(InputError, match="expected an accelerometer: a_0, a_1, a_2"):
        design(SAMII, sensor="theta_2", draws=Draws(2))
    blind = SAMII.model_copy(update={"sensor": SAMII.sensor[:1], "limit": ()})
    with pytest.raises(InputError, match="expected an accelerometer to feed back"):
        design(blind, draws=Draws(2))


def test_settle_time_is_that_of_a_decay():
    t = np.arange(5000) / 500.0
    assert settle_time(t, np.exp(-2.0 * t)) == pytest.approx(math.log(20) / 2.0, abs=0.004)
    assert settle_time(t, np.ones(5000)) == math.inf


STEP = """
experiment = "step"
name = "step"
actuator = "v_2"
unit = "rad"
drive = "reference"
amplitudes = [0.2]
lead_in = 1.0
hold = 12.0
ring_down = 12.0
"""


def stepped(text: str, folder: Path):
    rig = parse(Rig, text, "rig")
    file = folder / "step.toml"
    file.write_text(STEP)
    experiment, experiment_text = load_experiment(str(file), rig)
    plan = experiment.plan(rig)
    path = folder / "step.mcap"
    predicted = predict(plan, rig)
    order = RunOrder(rig, text, experiment_text, plan, predicted, settings={"seed": 2})
    done = carry_out(order, path)
    assert done.stop.status == "completed"
    return done.recording


def test_a_recorded_step_shows_the_damping_of_the_closed_loop(made, tmp_path):
    slow = settling(stepped(TEXT, tmp_path), "a_0")
    (tmp_path / "step.mcap").unlink()
    quick = settling(stepped(rig_text(TEXT, made), tmp_path), "a_0")
    assert slow.feedback == ()
    assert quick.feedback == ("damping",)
    assert quick.measured_s < 1.0 < 8.0 < slow.measured_s
    # Without the loop the first step still rings when the second comes, 12 s later: an eighth.
    for s, within, late in ((slow, 0.02, 0.8), (quick, 0.05, 0.02)):
        assert s.steps == 2
        assert s.measured_s == pytest.approx(s.predicted_s, abs=late)
        assert s.decay.damping == pytest.approx(s.expected[1], rel=within)
    # What is left is the accelerometer's noise, 0.003 m/s^2 over two steps.
    assert np.std(quick.response - quick.predicted) < 0.005
    with pytest.raises(EstimateError, match="no accelerometer theta_2"):
        settling(read_recording(tmp_path / "step.mcap"), "theta_2")


def test_the_command_line_judges_a_rig_that_has_a_loop_in_three_lines(made, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(rig_text(TEXT, made))
    call = ["control", "--rig", str(path), "--draws", "2", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, call)
    assert result.exit_code == 0, result.output
    said = [line for line in result.stdout.splitlines() if line.strip()]
    assert len(said) == 3
    assert "reached" in said[2]
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {"control.json", "loop.png", "root_locus.png", "margins.png"}
    data = json.loads((tmp_path / "out" / "control.json").read_text())
    assert data["reached"] is True
    assert data["nominal"]["damping"] == pytest.approx(made.nominal.damping)


@dataclass
class Judged:
    damping: float
    gain_db: float
    phase_deg: float
    outside: int = 0


def test_a_margin_without_end_is_one_in_the_percentiles() -> None:
    judged = [Judged(0.1, 6.0, phase) for phase in (40.0, math.inf, math.inf, math.inf)]
    phase = distribution(judged)["phase_deg"]  # type: ignore[arg-type]
    assert phase["95 %"] == math.inf
    assert phase["50 %"] == math.inf
    assert not any(math.isnan(x) for x in phase.values())
