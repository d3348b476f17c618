"""The diagnosis on drawn frequency responses: what is concealed is found, what is not is not.

Effects are put into the rig's own sampled model, with noise of a realistic covariance that is
itself estimated. Few hypotheses compete in each test; the whole table is for the studies.
"""

import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from diagnose_kit import ALL, BAND, FEW, LINES, concealing, effect
from identify_kit import noiseless, samii

from samii_rig.diagnose.data.measured import binned, measured, usable
from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.diagnose.fit.classes import distance
from samii_rig.diagnose.fit.refit import Problem, refit
from samii_rig.diagnose.fit.rigfile import toml
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.physics import vocabulary
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.verdict.locate import locate, moebius
from samii_rig.errors import InputError
from samii_rig.identify.bootstrap import redraw
from samii_rig.identify.velocity_feedback import in_series
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig


@pytest.fixture(scope="module")
def problem():
    lines = measured([concealing()], samii())
    return Problem.of(lines, grid(samii(), lines.frequency, lines.sensor, lines.actuator))


def test_nothing_missing_is_said_so():
    found = diagnose([concealing()], samii(), effects=FEW)
    assert found.verdict == "no_mismatch"
    assert found.causes == ()
    assert found.chi2_per_dof < found.threshold
    assert "Nothing is missing" in found.lines()[0]


def test_a_late_channel_is_found_named_and_shown_to_help(tmp_path):
    late = effect("sensor_delay", "a_1")
    found = diagnose([concealing((late, [2e-3]))], samii(), effects=FEW)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("sensor_delay", "a_1")
    tau = cause.parameters["tau"]
    assert tau.value == pytest.approx(2e-3, rel=0.03)
    assert 1e-5 < tau.high - tau.low < 1e-4
    assert found.gap.value > 0.9
    assert found.with_causes[1] < 1.3 < found.nominal[1]
    text = toml(found.rig)
    assert parse(Rig, text, "new rig").sensor[2].delay == pytest.approx(tau.value)


def test_the_contract_is_plain_json_with_all_its_keys():
    found = diagnose([concealing((effect("sensor_gain", "a_2"), [1.3]))], samii(), effects=FEW)
    plain = json.loads(json.dumps(found.plain()))
    assert set(plain) == {
        "verdict", "mismatch", "sites", "causes", "alternatives", "fit", "not_physics",
        "next_experiment", "model", "moved", "could_hide", "used", "evidence",
    }  # fmt: skip
    assert plain["evidence"]["sigma"] > 10
    assert plain["used"]["lines"] <= plain["used"]["of"]
    assert set(plain["could_hide"][0]) == {"physics", "site", "parameter", "size", "unit"}
    assert set(plain["next_experiment"]) == {"why", "experiment", "gain"}
    assert plain["causes"][0]["parameters"]["gain"]["value"] == pytest.approx(1.3, rel=0.02)
    assert {"value", "low", "high", "of_noise"} == set(plain["fit"]["gap_closed"])
    assert {b["channel"] for b in plain["mismatch"]["bands"]} == {s.name for s in samii().sensor}


def test_degrees_for_radians_are_no_physics():
    wrong = effect("sensor_gain", "theta_2")
    found = diagnose([concealing((wrong, [math.degrees(1)]))], samii(), effects=FEW)
    assert found.causes == ()
    assert any("degrees for radians" in text for text in found.not_physics)


def test_all_four_joints_that_the_first_papers_perfect_joint_model_leaves_out_come_back():
    springs = ("clamp", "joint_1", "joint_2", "joint_3")

    def stiff(e):
        if e.name not in springs:
            return e
        k = e.k.model_copy(update={"value": 1e9, "tolerance": 0.0})
        return e.model_copy(
            update={"k": k, "c": e.c.model_copy(update={"value": 0.0, "tolerance": 0.0})}
        )

    nominal = samii().model_copy(update={"element": tuple(stiff(e) for e in samii().element)})
    effects = [
        e
        for e in table(nominal, *BAND)
        if e.physics in ("torsional_compliance", "velocity_feedback")
    ]
    found = diagnose([concealing()], nominal, effects=effects)
    names = [{(c.physics, c.site), *c.equivalents} for c in found.causes]
    assert len(names) == 4
    for spring in springs:
        assert any(("torsional_compliance", spring) in n for n in names)


def test_a_gradient_of_a_model_with_effects_is_its_derivative(problem):
    effects = (effect("torsional_compliance", "joint_1"), effect("added_mass", "link_2", "along"))
    model = Model(samii(), (*effects, effect("sensor_delay", "a_0")))
    x = np.zeros(model.n)
    x[model.n_nominal :] = np.log([3e4, 0.1, 0.5, 1.4, 1e-3])
    H, dH = model.gradient(x, problem.at)
    assert np.allclose(H, model.response(x, problem.at), rtol=1e-12)
    for j in (0, 5, *range(model.n_nominal, model.n)):
        step = np.zeros(model.n)
        step[j] = 1e-5
        ahead, behind = (model.response(x + s * step, problem.at) for s in (1, -1))
        slope = (ahead - behind) / 2e-5
        assert np.allclose(dH[:, :, j], slope, rtol=1e-4, atol=1e-6 * np.abs(slope).max())


def test_bins_lose_nothing_when_the_model_is_right():
    lines = measured([concealing(f=np.geomspace(*BAND, 1000))], samii())
    at = grid(samii(), lines.frequency, lines.sensor, lines.actuator)
    model = Model(samii())
    h = model.response(np.zeros(model.n), at)
    few = binned(lines, h, bins=150)
    assert few.n < 400
    whole = lines.chi_square(h).sum()
    apart = few.chi_square(model.response(np.zeros(model.n), at.at(few.frequency))).sum()
    assert apart + few.inside[0] == pytest.approx(whole, rel=1e-6)


def test_what_decides_and_what_shows_took_no_part_in_the_fit():
    bursts = [replace(concealing(seed=s), method="settled", level=1.0) for s in (1, 2)]
    levels = (0.5, 1.0, 2.0)
    sines = [replace(concealing(seed=9), method="periodic", level=x) for x in levels]
    single = replace(concealing(seed=5), method="local", n_averages=1)
    whole = measured(usable([*bursts, *sines, single]), samii())
    fit, decide, show = whole.splits()
    assert {whole.levels[k][0] for k in decide.level} == {0.5, 2.0}
    assert {whole.levels[k][0] for k in show.level} == {1.0}
    assert not any(whole.periodic[k] for k in fit.level)
    assert fit.n + decide.n + show.n == whole.n
    assert usable([single]) == [single]


@pytest.mark.parametrize(
    ("ringing", "more", "decides"),
    [((), set(), {0.5, 2.0}), ((2.0,), {2.0}, {0.5}), ((1.0,), set(), {0.5, 2.0}),
     ((0.5, 2.0), {0.5, 2.0}, {1.0})],
)  # fmt: skip
def test_where_bursts_ring_the_periodic_run_of_that_level_is_fitted(ringing, more, decides):
    levels = (0.5, 1.0, 2.0)
    bursts = [
        replace(concealing(), method="local" if x in ringing else "settled", level=x, n_averages=3)
        for x in levels
    ]
    sines = [replace(concealing(seed=9), method="periodic", level=x) for x in levels]
    whole = measured([*bursts, *sines], samii())
    fit, decide, show = whole.splits()
    assert {whole.levels[k][0] for k in fit.level if whole.periodic[k]} == more
    assert {whole.levels[k][0] for k in decide.level} == decides
    assert {whole.levels[k][0] for k in show.level} == {1.0}
    assert fit.n + decide.n + show.n == whole.n


def test_few_lines_leave_one_to_show_on():
    f = np.array([2.0, 5.0, 9.0, 14.0])
    fit, decide, show = measured([concealing(f=f)], samii()).splits()
    assert (fit.n, decide, show.n) == (3, None, 1)
    one = replace(concealing(f=f[1:2]), method="periodic")
    fit, decide, show = measured([concealing(f=f), one], samii()).splits()
    assert (fit.n, decide, show.n) == (4, None, 1)


def test_lines_of_few_cycles_a_record_are_left_to_the_drift():
    f = np.arange(1, 400) * 0.05
    lines = measured([replace(concealing(f=f), method="settled")], samii())
    assert lines.frequency[0] == pytest.approx(0.25)


def test_every_output_is_a_moebius_function_of_the_missing_part(problem):
    spring = effect("torsional_compliance", "joint_1")
    model = Model(samii())
    x0 = np.zeros(model.n)
    a, place = moebius(model, spring, problem, x0)
    k = 2e4
    trial = Model(samii(), (spring,))
    y = trial.response(np.append(x0, np.log([k, 1e-9])), problem.at)
    x = np.full((1, LINES.size), 1 / k)
    free = a + place.b * place.phi(x)[0][:, None]
    assert np.allclose(y, free, rtol=1e-6, atol=1e-9 * np.abs(y).max())


def test_a_compliance_fits_its_own_place_without_a_law_and_no_other():
    spring = effect("translational_compliance", "joint_1")
    lines = measured([concealing((spring, [1e6, 0.1]))], samii())
    problem = Problem.of(lines, grid(samii(), lines.frequency, lines.sensor, lines.actuator))
    nominal = Model(samii())
    base = refit(nominal, problem, np.zeros(nominal.n))
    here = locate(base, spring, problem)
    there = locate(base, effect("translational_compliance", "clamp"), problem)
    assert here.ratio < 1.2
    assert there.chi2 > here.chi2 + 30


def test_a_rotational_spring_to_ground_and_the_pendulum_are_one(problem):
    pendulum = effect("gravity_stiffness", "joint_3")
    brace = next(
        e
        for e in ALL
        if e.physics == "ground_spring" and e.site == "joint_3" and "w" not in e.variant[-1]
    )
    lines = measured([concealing((pendulum, [3000.0]))], samii())
    at = grid(samii(), lines.frequency, lines.sensor, lines.actuator)
    search = Search(samii(), lines, at, [pendulum, brace])
    search.forward(search.nominal, 5)
    one, other = (e for e in search.ranked() if e.effects)
    assert distance(one, other, search.problem) < 1.0


def test_structural_twins_are_one_effect_with_two_names():
    names = [n for e in ALL if e.physics == "torsional_compliance" for n in e.names]
    assert ("torsional_compliance", "joint_1") in names
    keys = [e.key for e in ALL]
    assert len(keys) == len(set(keys))
    mass = [e for e in ALL if e.physics == "added_mass" and "w" in e.variant[-1]]
    # A mass moves with either side of a joint.
    assert any({"link_2", "link_3_6"} <= {s for _, s in e.names} for e in mass)


def test_a_rig_file_survives_being_written():
    for name in ("samii", "sflr"):
        rig = load_rig(name)[0]
        assert parse(Rig, toml(rig), name) == rig


def installed(folder: Path, code: str) -> None:
    """A package `our_lab` in a folder, as pip would leave it, its effects in the module `hose`."""
    (folder / "our_lab").mkdir()
    (folder / "our_lab" / "__init__.py").touch()
    (folder / "our_lab" / "hose.py").write_text(code, encoding="utf-8")
    info = folder / "our_lab-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: our-lab\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[{vocabulary.GROUP}]\nhose = our_lab.hose:hose\n")


@pytest.fixture
def a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in ("our_lab", "our_lab.hose"):
        sys.modules.pop(name, None)


def test_effects_that_another_package_gets_wrong_are_one_line_with_its_name(a_package):
    installed(a_package, "def hose(rig, low, high):\n    yield 'a hose'\n")
    with pytest.raises(InputError, match=r"entry point hose = our_lab\.hose:hose.*an Effect"):
        table(samii(), *BAND)


def test_the_page_on_adding_physics_adds_it(a_package):
    page = (ROOT / "docs" / "guide" / "add-physics.md").read_text(encoding="utf-8")
    assert f'entry-points."{vocabulary.GROUP}"]\nhose = "our_lab.hose:hose"' in page
    installed(a_package, page.split("```python")[1].split("```")[0])
    own = [e for e in table(samii(), *BAND) if "hose" in {p for p, _ in e.names}]
    assert len(own) == 1
    found = diagnose([concealing((own[0], [3e4, 20.0]))], samii(), effects=[own[0], *FEW])
    assert [c.physics for c in found.causes] == ["hose"]
    assert found.causes[0].parameters["k"].value == pytest.approx(3e4, rel=0.1)


def test_a_gross_effect_brings_no_small_one_with_it():
    """The aliases are those of the actuator that gives, not of the perfect one in the rig file: the
    difference, 1e-4 of a response, once came back as a second effect of a microsecond."""
    data = samii().model_dump()
    data["element"] = [e for e in data["element"] if e["name"] != "joint_2"]
    for sensor in data["sensor"]:
        if "across" in sensor:
            sensor["across"] = [name for name in sensor["across"] if name != "joint_2"]
    perfect = Rig.model_validate(data)
    f = np.arange(0.5, 40, 1 / 36)
    gives = noiseless(in_series(perfect, "joint_2_source", 700.0), f, relative=3.7e-4)
    small = ("transport_delay", "sensor_delay", "time_offset", "actuator_lag")
    some = [e for e in table(perfect, *BAND) if e.physics in ("velocity_feedback", *small)]
    found = diagnose([redraw(gives, gives.H, np.random.default_rng(1))], perfect, effects=some)
    assert [c.physics for c in found.causes] == ["velocity_feedback"]
