"""SAMII with joints 2 and 3 driven, over a serial node: run, recording, frequency responses of two
inputs; in real time, and the same as of the rig in this process."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.model.sampled import sampled_response
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate

pytestmark = pytest.mark.real_time
INPUTS = ("v_2", "v_3")
EXPERIMENT = """
experiment = "multisine"
name = "both"
actuator = "v_2"
beside = ["v_3"]
unit = "V"
drive = "output"
period = 1.0
low_hz = 4.0
high_hz = 30.0
realisations = 1
periods = 5
ramp = 0.2
amplitudes = [0.4]
seed = 1
"""


def ran(folder: Path, driver: str, *settings: str) -> Path:
    """The recording of one `samii-rig run`."""
    # A loaded machine may be late with either way.
    text = load_rig("samii_two_joints")[1].replace("deadman = 0.05", "deadman = 0.2")
    text = text.replace("stale_after = 0.05\n", "")
    text = text.replace("[[sensor]]\n", "[[sensor]]\nstale_after = 0.5\n")
    head = text[: text.index("[device]")]
    rig, experiment, out = folder / "rig.toml", folder / "both.toml", folder / "run.mcap"
    rows = "".join(f"{s}\n" for s in settings)
    rig.write_text(f'{head}[device]\ndriver = "{driver}"\n\n[device.settings]\n{rows}')
    experiment.write_text(EXPERIMENT)
    asked = ["run", str(experiment), "--rig", str(rig), "--out", str(out)]
    told = CliRunner().invoke(app, [*asked, "--no-report", "--no-diagnosis"])
    assert told.exit_code == 0, told.output
    return out


@pytest.fixture(scope="module")
def wired(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wired")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SAMII_RIG_STATE", str(folder / "state"))
        return ran(folder, "simulated_node", "seed = 3")


def test_the_recording_is_whole_and_of_the_node(wired):
    r = read_recording(wired)
    assert r.metadata["device_device"] == "serial_node"
    assert r.metadata["device_null_counts"] == "37, -12"
    assert (np.diff(r.sequence) == 1).all()
    assert [s.excited for s in r.segments] == [INPUTS] * 2
    commands = [c.name for c in r.channels if c.role == "command"]
    assert commands == list(INPUTS)
    end = r.values[-5:, [r.column(n) for n in INPUTS]]
    assert not end.any(), "both outputs end at zero"


def test_each_output_was_its_own_loop_around_its_own_reference(wired):
    r = read_recording(wired)
    rig = load_rig("samii_two_joints")[0]
    live = slice(r.segments[0].start, r.segments[0].stop)
    for name in INPUTS:
        loop = rig.centring_of(name)
        columns = name, f"u_{name}", f"theta_ref_{name}", loop.sensor
        v, u, ref, theta = (r.values[live, r.column(c)] for c in columns)
        np.testing.assert_allclose(v, u + loop.kp * (ref - theta), atol=4e-4)


def test_the_responses_of_both_inputs_are_those_of_the_rig_in_this_process(wired, tmp_path):
    (a,) = estimate([read_recording(wired)])
    (b,) = estimate([read_recording(ran(tmp_path, "simulated", "seed = 4"))])
    for r in (a, b):
        assert tuple(c.name for c in r.inputs) == INPUTS
        assert tuple(c.name for c in r.outputs) == ("theta_2", "theta_3", "a_0", "a_1", "a_2")
    assert a.H.shape == (10, 5, 2)
    np.testing.assert_array_equal(a.frequency, b.frequency)
    # In units of the standard deviation of the difference, squared.
    apart = np.abs(a.H - b.H) ** 2 / (a.variance() + b.variance())
    assert 0.05 < np.median(apart) < 1.5
    assert np.mean(apart < 16.0) > 0.9


def test_the_responses_are_those_of_the_transfer_matrices(wired):
    (a,) = estimate([read_recording(wired)])
    model = sampled_response(load_rig("samii_two_joints")[0], a.frequency)
    apart = np.abs(a.H - model) ** 2 / a.variance()
    assert 0.05 < np.median(apart) < 3.0
    assert np.mean(apart < 16.0) > 0.9


def test_the_command_line_names_both_inputs(wired, tmp_path):
    csv = tmp_path / "frf.csv"
    told = CliRunner().invoke(app, ["frf", str(wired), "--export", str(csv), "--json"])
    assert told.exit_code == 0, told.output
    (said,) = json.loads(told.output)["responses"]
    assert said["inputs"] == list(INPUTS)
    for name in INPUTS:
        assert f"a_2/{name}" in csv.read_text()
