"""Parameters from measured modes: poles and residues with the covariance of all of them.

Plan: pole and residue of a mass on a spring in closed form; stiffnesses from the modes of SAMII;
intervals that hold what they say; a model that is wrong; the file that is kept, and a damaged one.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from identify_kit import drawn, samii
from poses_kit import recorded, two_links
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.diagnose.fit.rigfile import toml
from samii_rig.errors import EstimateError, InputError
from samii_rig.identify.from_modes import identify_modes
from samii_rig.identify.parameters import changed
from samii_rig.modal.modes import ModalModel, find_modes
from samii_rig.modal.saved import SavedModes, numbers, of_model, saved_modes
from samii_rig.model.modes import poles
from samii_rig.model.tmm import Chain
from samii_rig.record.store import write_recording
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import parameters

FREE = ["joint_1.k", "joint_2.k", "joint_1.c", "joint_2.c"]
OFF = {"joint_1.k": 0.9, "joint_2.k": 1.1, "joint_1.c": 1.0, "joint_2.c": 1.0}


def off(rig, ratios):
    """The rig with parameters times these."""
    known = {(e.name, s): p.value for e in rig.element for s, p in parameters(e).items()}
    keys = {tuple(name.split(".")): ratio for name, ratio in ratios.items()}
    return changed(rig, {key: known[key] * ratio for key, ratio in keys.items()})


@cache
def measured() -> ModalModel:
    return find_modes(drawn(samii(), 1, truth=off(samii(), OFF), n=200), samii())


def exact(rig, of: SavedModes) -> SavedModes:
    """The modes that a rig has, as if they had been measured without noise."""
    first = next(f"{e.name}.{s}" for e in rig.element for s in parameters(e))
    fitted = identify_modes([of], rig, [first]).modes
    found = poles(rig, 60.0).pole
    a = np.array([found[np.argmin(abs(found - 2 * np.pi * m.model_hz * 1j))] for m in fitted])
    z = 0.01 * np.abs(a)[:, None] * np.exp(2j * np.pi * np.arange(32) / 32)
    G = Chain(rig).evaluate((a[:, None] + z).ravel())
    R = np.mean(G.reshape(*z.shape, *G.shape[1:]) * z[:, :, None, None], axis=1)
    return replace(of, poles=a, residues=R)


def test_a_mass_on_a_spring_has_the_residue_of_the_closed_form():
    rig = load_rig("one_mass")[0]
    value = {(e.name, s): p.value for e in rig.element for s, p in parameters(e).items()}
    m, k, c = value["mass", "m"], value["spring", "k"], value["spring", "c"]
    K, p = value["coil", "K"], value["coil", "p"]
    w = np.sqrt(k / m - (c / (2 * m)) ** 2)
    a = -c / (2 * m) + 1j * w
    R = K * p / (a + p) / (m * 2j * w)
    made = SavedModes(
        "m", 1.0, "V", ("x",), (rig.units()["x"],), ("v",), False, "", np.array([a]),
        np.array([[[R]]]), np.diag([1e-2, 1e-2, *[1e-6 * abs(R) ** 2] * 2]),
    )  # fmt: skip
    start = off(rig, {"spring.k": 1.1, "spring.c": 0.7, "coil.K": 1.2})
    found = identify_modes([made], start, ["spring.k", "spring.c", "coil.K"]).found
    assert found.values == pytest.approx([k, c, K], rel=1e-6)
    # The gain K is in the residue alone.
    with pytest.raises(InputError, match="2 real numbers for 3 parameters"):
        identify_modes([made], start, ["spring.k", "spring.c", "coil.K"], use="poles")


@pytest.mark.parametrize("use", ["residues", "shapes", "poles"])
def test_stiffnesses_come_back_from_the_modes_of_a_response(use):
    found = identify_modes([of_model(measured())], samii(), FREE, use=use)
    assert found.found.fit.holds
    assert not found.without
    hz = [m.frequency_hz.value for m in measured().modes]
    assert [m.frequency_hz for m in found.modes] == pytest.approx(hz)
    ratio = found.found.values / found.found.start
    sd = np.sqrt(np.diag(found.found.log_covariance))
    assert np.all(np.abs(np.log(ratio / np.array([OFF[n] for n in FREE]))) < 4 * sd)
    assert sd[0] < {"residues": 0.002, "shapes": 0.002, "poles": 0.05}[use]


def test_residues_tell_stiffnesses_apart_that_poles_alone_hardly_do():
    by = {
        u: identify_modes([of_model(measured())], samii(), FREE, use=u)
        for u in ("residues", "poles")
    }
    sd = {u: np.sqrt(np.diag(found.found.log_covariance)) for u, found in by.items()}
    assert np.all(sd["poles"] > 3 * sd["residues"])
    assert any("tied" in words for words in by["poles"].found.sentences())


def test_intervals_hold_the_truth_as_often_as_they_say():
    saved = exact(samii(), of_model(measured()))
    y, L = saved.numbers(), np.linalg.cholesky(saved.covariance)
    rng, m, p = np.random.default_rng(3), len(saved.poles), saved.residues[0].size
    inside, ratio = [], []
    for _ in range(60):
        drawn_ = (y + L @ rng.standard_normal(y.size)).reshape(m, 1 + p, 2)
        each = drawn_[..., 0] + 1j * drawn_[..., 1]
        one = replace(saved, poles=each[:, 0], residues=each[:, 1:].reshape(saved.residues.shape))
        found = identify_modes([one], samii(), FREE).found
        low, high = found.interval()
        inside.append((low < found.start) & (found.start < high))
        ratio.append(found.fit.ratio)
    # 240 intervals of 90 %: 83 to 96 % with 3 standard deviations.
    assert 0.83 < np.mean(inside) < 0.96
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.1)


def test_as_many_parameters_as_numbers_are_found_but_test_nothing():
    rig = load_rig("one_mass")[0]
    saved = of_model(find_modes(drawn(rig, 3, band=(1.0, 60.0)), rig))
    found = identify_modes([saved], rig, ["spring.k", "spring.c"], use="poles")
    assert [m.model_hz for m in found.modes] == pytest.approx([m.frequency_hz for m in found.modes])
    assert found.found.fit.holds
    assert not found.tested
    assert found.sentences()[0].startswith("Nothing tests the model")
    assert found.plain()["verdict"] == list(found.sentences())
    more = identify_modes([saved], rig, ["spring.k"], use="poles")
    assert more.tested
    assert more.sentences()[0].startswith("The model fits")


def test_the_test_of_the_fit_holds_with_priors_that_take_part_of_it():
    """The truth drawn from the tolerances, the modes from their covariance: p is even in 0 to 1."""
    rig, rng, names = load_rig("one_mass")[0], np.random.default_rng(8), ["spring.k", "spring.c"]
    saved = of_model(find_modes(drawn(rig, 3, band=(1.0, 60.0)), rig))
    tolerance = {(e.name, s): p.tolerance for e in rig.element for s, p in parameters(e).items()}
    # A noise as large as the tolerances, so that both count.
    sd = [0.02, 0.3]
    C = np.diag(np.array([sd[1] * abs(saved.poles[0].real), sd[0] * abs(saved.poles[0])]) ** 2)
    C = np.pad(C, (0, 2)) + np.diag([0, 0, *np.diag(saved.covariance)[2:]])
    p = []
    for _ in range(60):
        true = off(
            rig, {n: np.exp(tolerance[tuple(n.split("."))] * rng.standard_normal()) for n in names}
        )
        a = poles(true, 60.0).pole
        pole = a[a.imag > 0][:1] + np.sqrt(C[0, 0]) * rng.standard_normal()
        pole = pole + 1j * np.sqrt(C[1, 1]) * rng.standard_normal()
        one = replace(saved, poles=pole, covariance=C)
        p.append(identify_modes([one], rig, names, use="poles", prior=True).found.fit.p_value)
    # The mean of 60 even numbers: 0.5 +- 0.037; three of these, and the law is approximate.
    assert np.mean(p) == pytest.approx(0.5, abs=0.12)
    assert np.mean(np.array(p) < 0.1) < 0.25


@pytest.mark.parametrize("seed", [3010, 3019, 3024, 3039])
def test_residues_hold_their_covariance_where_no_pole_above_the_band_is_proven(seed):
    """The coil's lag at 120 Hz lies above a band that ends at 60 Hz. In these draws it is less
    than the noise of any line; without poles up there chi-square of residues was 2.2 to 4.1."""
    rig = load_rig("two_masses")[0]
    model = find_modes(drawn(rig, seed, band=(1.0, 60.0)), rig)
    assert model.model.n_poles == 4
    saved = of_model(model)
    d = saved.numbers() - exact(rig, saved).numbers()
    # 12 numbers of variance 1: 2.2 at one in a hundred.
    assert d @ np.linalg.solve(saved.covariance, d) / d.size < 2.2


def test_two_levels_know_more_than_one():
    saved = of_model(measured())
    one, two = (identify_modes([saved] * n, samii(), FREE).found for n in (1, 2))
    sd = [np.sqrt(np.diag(found.log_covariance)) for found in (one, two)]
    assert sd[1] == pytest.approx(sd[0] / np.sqrt(2), rel=1e-3)
    assert two.values == pytest.approx(one.values, rel=1e-3)


def test_a_tolerance_is_a_prior_of_what_the_modes_do_not_know():
    found = identify_modes([of_model(measured())], samii(), ["joint_1.k", "link_0.m"], prior=True)
    known = dict(zip(found.found.names, found.found.prior_sd, strict=True))
    assert np.all(np.isfinite(list(known.values())))
    assert np.sqrt(found.found.log_covariance[1, 1]) <= known["link_0.m"] * (1 + 1e-6)


def test_a_model_that_cannot_have_these_modes_is_said_not_to_fit():
    found = identify_modes([of_model(measured())], samii(), ["joint_3.k"])
    assert not found.found.fit.holds
    assert max(m.ratio for m in found.modes) > 10
    assert "does not fit" in found.found.sentences()[0]


def test_a_mode_that_the_model_does_not_have_is_left_out_and_told():
    saved = of_model(measured())
    more = replace(saved, poles=saved.poles * np.array([1, 1, 12.0]))
    found = identify_modes([more], samii(), ["joint_1.k", "joint_2.k"])
    assert len(found.modes) == 2
    (words,) = found.without
    assert words.startswith("1 V: the mode at 2")
    with pytest.raises(EstimateError, match="the model has none of these modes"):
        identify_modes([replace(saved, poles=saved.poles * 200)], samii(), ["joint_1.k"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"closed_loop": True}, "expected modes over a command"),
        ({"divided": "nothing divided out: no rig file"}, "a hold turns residues"),
        ({"outputs": ("theta_2", "a_0", "a_1", "a_9")}, "outputs is 'a_9'"),
        ({"inputs": ("v_9",)}, "inputs is 'v_9'"),
    ],
)
def test_modes_that_the_model_cannot_be_held_against_are_refused_in_one_line(change, said):
    with pytest.raises(InputError) as error:
        identify_modes([replace(of_model(measured()), **change)], samii(), ["joint_1.k"])
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    path = tmp_path / "modes.json"
    path.write_text(json.dumps({"modes": [measured().plain()]}))
    return path


def test_a_file_of_modes_is_read_to_the_last_digit(kept):
    (read,), saved = saved_modes(kept), of_model(measured())
    assert np.array_equal(read.numbers(), saved.numbers())
    assert np.array_equal(read.covariance, saved.covariance)
    assert read.outputs == saved.outputs
    assert np.array_equal(numbers(read.poles, read.residues), read.numbers())
    # The residues are what shape and participation say, and the poles have the intervals' widths.
    for i, mode in enumerate(measured().modes):
        size = 2 + 2 * saved.residues[i].size
        C = saved.covariance[i * size : i * size + 2, i * size : i * size + 2]
        along = np.array([mode.pole.real, mode.pole.imag]) / abs(mode.pole)
        assert np.sqrt(along @ C @ along) / (2 * np.pi) == pytest.approx(mode.frequency_hz.sd)
        outer = np.outer(mode.shape, mode.participation)
        assert saved.residues[i] == pytest.approx(outer, rel=1e-6)


def damaged(path: Path, change) -> None:
    data = json.loads(path.read_text())
    change(data["modes"][0])
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda row: row.pop("covariance"), "KeyError 'covariance'"),
        (lambda row: row["covariance"].pop(), "covariance"),
        (lambda row: row.pop("residues"), "KeyError 'residues'"),
        (lambda row: row["residues"][0].pop(), "expected poles, residues and covariance"),
        (lambda row: row.__setitem__("poles", 3.0), "expected poles, residues and covariance"),
        (lambda row: row["covariance"][0].__setitem__(0, -1.0), "positive definite"),
        (lambda row: row["poles"][1].__setitem__(1, -3.0), "an imaginary part above 0"),
        (lambda row: row["covariance"][0].__setitem__(3, 1e9), "not symmetric"),
        (lambda row: row.__setitem__("poles", []), "one mode or more"),
        (lambda row: row.__setitem__("units", ["rad"]), "the shape (3, 4, 1)"),
    ],
)
def test_a_damaged_file_of_modes_is_refused_in_one_line(kept, change, said):
    damaged(kept, change)
    with pytest.raises(InputError) as error:
        saved_modes(kept)
    assert str(error.value).startswith(str(kept))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_level_that_shows_no_mode_is_left_out_of_a_file(kept):
    data = json.loads(kept.read_text())
    data["modes"].insert(0, {**data["modes"][0], "poles": [], "residues": [], "covariance": []})
    kept.write_text(json.dumps(data))
    (read,) = saved_modes(kept)
    assert len(read.poles) == 3


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"modes": []}', "\x00"])
def test_what_is_no_file_of_modes_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "modes.json"
    path.write_text(text)
    with pytest.raises(InputError, match="samii-rig modes --save"):
        saved_modes(path)


def test_the_command_line_identifies_from_modes(kept):
    words = ["identify", "--modes", str(kept), "--rig", "samii", "--free", "joint_1.k"]
    words += ["--free", "joint_2.k"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0
    assert "The model fits" in done.output
    assert "left, in units of the noise" in done.output
    said = json.loads(CliRunner().invoke(app, [*words, "--json", "--use", "shapes"]).output)
    assert said["use"] == "shapes"
    assert len(said["modes"]) == 3
    value = said["parameters"]["joint_1.k"]
    assert value["value"] / value["start"] == pytest.approx(0.9, rel=0.01)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "LOGS: missing; expected recordings (.mcap) or --modes FILE"),
        ("--modes {0}", "a rig: saved modes carry none"),
        ("a.mcap --modes {0} --rig samii", "none beside --modes"),
        ("--modes {0} --rig samii --pose 30deg", "none beside --modes"),
        ("--modes {0} --rig samii --band 1 20", "none beside --modes"),
        ("--modes {0} --rig samii --method 2", "none beside --modes"),
        ("--modes {0} --rig samii --gaps exclude", "none beside --modes"),
        ("--modes {0} --modes {0} --rig samii", "each file once"),
        ("a.mcap --use poles", "--modes FILE beside it"),
        ("--modes {0} --rig samii --use shape", "did you mean shapes?"),
        ("--modes {0}x --rig samii", "a file of `samii-rig modes --save`"),
    ],
)
def test_what_is_asked_wrongly_is_answered_in_one_line(kept, words, said):
    done = CliRunner().invoke(app, ["identify", *words.format(kept).split()])
    assert isinstance(done.exception, InputError)
    assert said in str(done.exception)
    assert "\n" not in str(done.exception)


def test_modes_of_recordings_are_kept_and_identified_from(tmp_path: Path):
    rig = two_links()
    stiff = changed(rig, {("elbow", "k"): 44.0})
    logs = []
    for seed in range(3):
        logs.append(tmp_path / f"run_{seed}.mcap")
        write_recording(logs[-1], replace(recorded(stiff, seed), rig_toml=toml(rig)))
    (tmp_path / "arm.toml").write_text(toml(rig))
    kept = tmp_path / "modes.json"
    words = ["modes", *map(str, logs), "--save", str(kept)]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "modes.json" in done.output
    words = ["identify", "--modes", str(kept), "--rig", str(tmp_path / "arm.toml"), "--json"]
    done = CliRunner().invoke(app, [*words, "--free", "elbow.k"], catch_exceptions=False)
    said = json.loads(done.output)
    # The one near 1.8 Hz lies below the first line of so short a sweep.
    assert [m["frequency_hz"] for m in said["modes"]] == pytest.approx([9.12], rel=1e-3)
    k = said["parameters"]["elbow.k"]
    assert k["low_90"] < k["value"] < k["high_90"]
    assert k["value"] == pytest.approx(44.0, rel=0.01)
    refused = CliRunner().invoke(app, ["modes", str(logs[0]), "--save", str(tmp_path / "m.txt")])
    assert ".json" in str(refused.exception)
