"""A concealed trial on the disk: what its recordings hold, and that they are the truth's.

The trials are short here (other levels and bursts than a real one); what is checked does not
depend on the length.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from concealed_kit import SAMII_TOML
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from sim.concealed.__main__ import main
from sim.concealed.draw import draw, draw_values, trial_id
from sim.concealed.effects import ROWS
from sim.concealed.runs import Design
from sim.concealed.scales import RIGID
from sim.concealed.stated import Stated
from sim.concealed.trial import make

SHORT = Design(burst=20.0, ring_down=3.0, bursts=4, period=2.0, settle=2, periods=2, steps=2)
QUIET = Design(levels=(1.0,), burst=36.0, bursts=4, period=2.0, settle=1, periods=2, steps=1)


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trials")
    make("one", 22, out, SAMII_TOML, SHORT)  # dry friction
    make("nothing", 3, out, SAMII_TOML, QUIET)
    return out


def logs(out: Path, kind: str, seed: int) -> list[Path]:
    return sorted((out / "recordings" / trial_id(kind, seed)).glob("*.mcap"))


def truth(out: Path, kind: str, seed: int) -> bytes:
    return (out / "truth" / f"{trial_id(kind, seed)}.json").read_bytes()


def test_recordings_carry_the_hash_of_the_truth(trials: Path) -> None:
    text = truth(trials, "one", 22)
    found = logs(trials, "one", 22)
    assert [p.stem for p in found] == [
        f"{k}_{i}" for k in ("multisine", "steps", "swept_sine") for i in (1, 2, 3)
    ]
    for path in found:
        assert read_recording(path).metadata["truth_sha256"] == hashlib.sha256(text).hexdigest()
    arrays = (trials / "truth" / f"{trial_id('one', 22)}.npz").read_bytes()
    assert json.loads(text)["arrays_sha256"] == hashlib.sha256(arrays).hexdigest()


def test_recordings_say_nothing_of_the_truth(trials: Path) -> None:
    record = json.loads(truth(trials, "one", 22))
    assert record["effects"][0]["physics"] == "coulomb_friction"
    for path in logs(trials, "one", 22):
        recording = read_recording(path)
        assert recording.rig_toml == SAMII_TOML
        said = str(recording.metadata) + recording.experiment_toml + str(path)
        assert "friction" not in said
        assert "seed" not in said
        assert recording.names("reference") == ("u", "theta_ref")
        assert recording.stop.status == "completed"


def test_truth_has_the_form_that_the_score_reads(trials: Path) -> None:
    record = json.loads(truth(trials, "one", 22))
    assert record["kind"] == "one"
    assert record["seed"] == 22
    effect = record["effects"][0]
    assert effect["site"] in {e.name for e in parse(Rig, SAMII_TOML, "").element}
    assert effect["parameters"]["T_c"] > 0
    assert 0.3 < record["size"] / effect["size"] < 3


def test_same_seed_same_samples_and_a_whole_trial_is_not_made_again(
    trials: Path, tmp_path: Path
) -> None:
    name = trial_id("nothing", 3)
    before = logs(trials, "nothing", 3)[0].stat().st_mtime_ns
    make("nothing", 3, trials, SAMII_TOML, QUIET)
    assert logs(trials, "nothing", 3)[0].stat().st_mtime_ns == before
    left = tmp_path / "recordings" / f"{name}.partial"
    left.mkdir(parents=True)
    (left / "swept_sine_1.mcap.partial").write_bytes(b"cut off")
    make("nothing", 3, tmp_path, SAMII_TOML, QUIET)
    assert not left.exists()
    for a, b in zip(logs(trials, "nothing", 3), logs(tmp_path, "nothing", 3), strict=True):
        assert np.array_equal(read_recording(a).values, read_recording(b).values)


def test_estimated_response_is_the_truth_within_its_own_noise(trials: Path) -> None:
    swept = [p for p in logs(trials, "nothing", 3) if p.stem.startswith("swept")]
    (response,) = estimate([read_recording(p) for p in swept])
    assert response.method.startswith("settled")
    arrays = np.load(trials / "truth" / f"{trial_id('nothing', 3)}.npz")
    at = [int(np.argmin(np.abs(arrays["frequency"] - f))) for f in response.frequency]
    inside = np.abs(arrays["frequency"][at] - response.frequency) < 1e-9
    wrong = (response.H[:, :, 0] - arrays["linear"][at])[inside]
    C = response.covariance[inside]
    p, nu = wrong.shape[1], np.median(response.dof)
    chi2 = np.einsum("fa,fab,fb->f", wrong.conj(), np.linalg.inv(C), wrong).real / p
    assert chi2.mean() == pytest.approx(nu / (nu - p), rel=0.08)
    n = 18000
    drive = arrays["level"][0] * arrays["reference"]
    stated = n * arrays["noise"] / (3 * drive[:, None, None] ** 2)
    ratio = [np.median(stated[at][inside][:, i, i].real / C[:, i, i].real) for i in range(p)]
    assert ratio == pytest.approx([1.0] * p, rel=0.15)


def test_two_inputs_are_driven_in_turn_and_together_and_their_truth_is_that_of_all_entries(
    tmp_path: Path,
) -> None:
    text = load_rig("samii_two_joints")[1]
    late = Stated("transport_delay", "joint_3_source", {"tau": 2e-3})
    folder = make("stated", 1, tmp_path, text, QUIET, [late])
    runs = {p.stem: read_recording(p) for p in sorted(folder.glob("*.mcap"))}
    assert len(runs) == 3 * 2
    driven = {name: {s.excited for s in run.segments} for name, run in runs.items()}
    assert driven["swept_sine_1_v_2"] == driven["steps_1_v_2"] == {("v_2",)}
    assert driven["multisine_1_1"] == driven["multisine_1_2"] == {("v_2", "v_3")}
    first, second = (runs[f"multisine_1_{k}"] for k in (1, 2))
    for name, sign in (("u_v_2", 1.0), ("u_v_3", -1.0)):
        u, w = (run.values[:, run.column(name)] for run in (first, second))
        np.testing.assert_allclose(w, sign * u)
    (response, *_) = estimate([run for name, run in runs.items() if name.startswith("swept")])
    arrays = np.load(tmp_path / "truth" / f"{folder.name}.npz")
    at = [int(np.argmin(np.abs(arrays["frequency"] - f))) for f in response.frequency]
    inside = np.abs(arrays["frequency"][at] - response.frequency) < 1e-9
    wrong = (response.H.reshape(len(at), -1) - arrays["linear"][at])[inside]
    C = response.covariance[inside]
    p, nu = wrong.shape[1], np.median(response.dof)
    chi2 = np.einsum("fa,fab,fb->f", wrong.conj(), np.linalg.inv(C), wrong).real / p
    assert chi2.mean() == pytest.approx(nu / (nu - p), rel=0.1)
    drive = arrays["level"][0] * arrays["reference"]
    one = 18_000 * arrays["noise"] / drive[:, None, None] ** 2
    repeats = [np.median(one[at][inside][:, i, i].real / C[:, i, i].real) for i in range(p)]
    # Of four bursts of each input those that are settled: three, or two.
    used = np.tile(np.round(np.reshape(repeats, (-1, 2)).mean(axis=0)), p // 2)
    assert set(used) <= {2.0, 3.0}
    assert repeats == pytest.approx(used, rel=0.15)
    (effect,) = json.loads((tmp_path / "truth" / f"{folder.name}.json").read_text())["effects"]
    assert effect["size"] > 10.0


def test_noise_free_response_is_settled_where_the_rig_still_rings_after_a_burst(
    tmp_path: Path,
) -> None:
    # A dead zone of no width leaves the plant linear, and its response the linear one.
    none = Stated("valve_deadband", "joint_2_source", {"width": 1e-12})
    folder = make("stated", 1, tmp_path, SAMII_TOML, SHORT, [none])
    with np.load(tmp_path / "truth" / f"{folder.name}.npz") as arrays:
        wrong = np.abs(arrays["settled"] / arrays["linear"] - 1)
    assert wrong.max() < 1e-6


def test_frf_command_reads_a_trial(trials: Path) -> None:
    driven = [str(p) for p in logs(trials, "one", 22) if not p.stem.startswith("steps")]
    done = CliRunner().invoke(app, ["frf", *driven, "--json"])
    assert done.exit_code == 0, done.output
    responses = json.loads(done.stdout)["responses"]
    assert len(responses) == 6  # three levels, two excitations


def test_parameters_are_drawn_within_their_tolerances() -> None:
    rig = parse(Rig, SAMII_TOML, "test")
    draws = [draw_values(rig, np.random.default_rng(s))[1] for s in range(200)]
    k = np.array([d["joint_1.k"] for d in draws])
    assert np.median(k) == pytest.approx(0.136e5, rel=0.02)
    assert np.std(np.log(k)) == pytest.approx(0.1, rel=0.15)
    assert "joint_2_source.K" in draws[0]


def test_rows_and_places_follow_the_seeds() -> None:
    n = len(ROWS)
    drawn = [draw("one", s, SAMII_TOML, SHORT) for s in (10, 10 + n)]
    assert {d.effects[0].physics for d in drawn} == {"attached_oscillator"}
    assert len({d.effects[0].site for d in drawn}) == 2
    for d in drawn:
        assert 0.8 <= d.sizes[0] <= 1300
        assert d.poles.pole.real.max() <= 1e-9
    two = draw("two", 5, SAMII_TOML, SHORT)
    assert len({e.physics for e in two.effects}) == 2


def test_all_joints_give_where_the_rig_file_has_rigid_ones() -> None:
    drawn = draw("joints", 0, SAMII_TOML, SHORT)
    assert [e.site for e in drawn.effects] == ["clamp", "joint_1", "joint_2", "joint_3"]
    stiff = {e.name: e.k.value for e in drawn.nominal.element if e.kind == "torsional_spring"}
    assert set(stiff.values()) == {RIGID}
    k = {e.site: e.parameters["k"] for e in drawn.effects}
    assert k["joint_1"] == pytest.approx(0.136e5, rel=0.3)


def test_command_line_makes_and_refuses(
    trials: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(trials / "recordings", tmp_path / "recordings")
    asked = ["make", "--seed", "22", "--kind", "one", "--out", str(tmp_path)]
    assert main(asked) == 0
    assert trial_id("one", 22) in capsys.readouterr().out
    assert main([*asked[:2], "1", *asked[3:], "--rig", "no_such_rig"]) == 2
    assert "no_such_rig" in capsys.readouterr().err


def test_module_runs() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sim.concealed", "make", "--help"], capture_output=True, check=True
    )
    assert b"--kind" in done.stdout


def test_no_damper_that_a_loop_needs_is_taken_away() -> None:
    """Undamped, the spring between SFLR's motor and its encoder makes the loop unstable."""
    rig, text = load_rig("sflr")
    edits = [
        e
        for seed in range(12)
        for e in re.findall(
            r'name = "(\w+)"[^[]*\nc = \{ value = 0\.0,',
            draw("nothing", seed, text, Design.usual(rig)).nominal_toml,
        )
    ]
    assert set(edits) == set()
    assert Design.usual(rig).levels == (6.375, 12.75, 25.5)
    assert Design.usual(load_rig("samii")[0]) == Design()
