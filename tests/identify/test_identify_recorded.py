"""The papers' questions, asked of whole simulated recordings: sweep, converters, loop."""

import json
from pathlib import Path

import pytest
from identify_kit import STIFFNESSES, samii
from sweep_kit import swept
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.identify.actuator import choice, compare_variants, with_encoder
from samii_rig.identify.velocity_feedback import in_series
from samii_rig.record.store import write_recording
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate

SOURCE = "joint_2_source"


def recorded(rig, level):
    """Three sweeps, each from rest to rest."""
    return swept(rig, level, repeats=3, duration=15.0, ring_down=11.0)


@pytest.mark.parametrize("outputs", [None, ("theta_2",)])
def test_the_collocated_encoder_is_chosen_by_itself(outputs):
    # Paper 1, section IV-C: in the other case "good agreement could not be obtained".
    at_actuator = with_encoder(samii(), "theta_2", (SOURCE,))
    rigs = {
        "non-collocated": in_series(samii(), SOURCE, 500.0),
        "collocated": in_series(at_actuator, SOURCE, 500.0),
    }
    response = estimate([recorded(rigs["collocated"], 0.5)])
    free = (*STIFFNESSES, "joint_2.c", f"{SOURCE}_feedback.c")
    done = compare_variants(response, rigs, free, outputs=outputs, starts=1)
    assert choice(done).startswith("collocated fits")
    assert done[0].ratio < 1.3
    assert done[1].ratio > 5 * done[0].ratio
    assert not done[1].found.fit.holds


@pytest.fixture(scope="module")
def braced_log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("braced") / "braced.mcap"
    write_recording(path, recorded(load_rig("samii_braced")[0], 0.2))
    return path


def call(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    return result.exit_code, result.output or str(result.exception)


def test_method_2_identifies_joints_1_and_2_of_the_braced_rig(braced_log, tmp_path):
    # The rig file of the search starts a third away; clamp and joint 3 are not looked for.
    text = (
        Path(__file__).resolve().parents[2] / "samii_rig/rig/data/samii_braced.toml"
    ).read_text()
    off = text.replace("value = 0.136e5", "value = 0.19e5").replace(
        "value = 0.108e5", "value = 8e3"
    )
    rig = tmp_path / "off.toml"
    rig.write_text(off)
    free = ("--free", "joint_1.k", "--free", "joint_2.k")
    common = ("identify", braced_log, "--rig", rig, "--method", "2", *free, "--band", 0.9, 34)
    code, said = call(*common, "--json")
    assert code == 0, said
    found = json.loads(said)
    assert found["parameters"]["joint_1.k"] == pytest.approx(0.136e5, rel=0.02)
    assert found["parameters"]["joint_2.k"] == pytest.approx(0.108e5, rel=0.03)
    assert found["measured"]["f_1, Hz"]["value"] == pytest.approx(6.42, abs=0.03)
    assert found["error"] < 1e-6


def test_a_method_that_is_asked_for_wrongly_costs_one_line(braced_log):
    for option, words in (
        (("--method", "3"), "one of likelihood, 1, 2"),
        (("--method", "2"), "what to identify"),
    ):
        code, said = call("identify", braced_log, *option)
        assert code != 0
        assert words in said
