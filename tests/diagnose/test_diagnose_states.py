"""Two states of one rig: what changed is named, what both have is not, and nominal errors cancel.

Plan: the sum of two likelihoods against its parts; changes of a joint and of masses between short
recordings of the second plant, whose nominal parameters are drawn within their tolerances; what is
stated as known; what is wrong in what a person gives.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from states_kit import RIG, effects, late, mass, recorded, scene, stiffness
from table_kit import table_of
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.diagnose.changed import State, changed, common_rig
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit import records
from samii_rig.diagnose.fit.known import stated, with_known
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.states import Both, BothGrid, States
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.insert import inserted, oscillator
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.vocabulary import hypotheses
from samii_rig.errors import InputError
from samii_rig.report.diagnosis.page import write_diagnosis
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import parameters
from samii_rig.rig.schema.elements import flattened

STRANGE = late(2e-3)  # a dead time that is in no rig file


@pytest.fixture(scope="module")
def plain() -> State:
    return recorded(0)


def named(found, physics, site):
    names = {(c.physics, c.site) for c in found.causes}
    names |= {n for c in found.causes for n in c.equivalents}
    return found.verdict in ("named", "ambiguous") and (physics, site) in names


def test_a_joint_that_became_softer_is_named_though_nominal_parameters_are_off(plain):
    found = changed(plain, recorded(1, stiffness("joint_2", 0.995)), RIG, effects=effects())
    assert named(found, "joint_stiffness", "joint_2")
    (cause,) = found.causes
    k = cause.parameters["k ratio"]
    assert k.value == pytest.approx(0.995, abs=5e-4)
    assert k.low < k.value < k.high < 1
    assert found.lines()[0].startswith("Changed: joint stiffness at joint_2 (k ratio = 0.99")
    assert found.plain()["before"]["causes"] == []
    # A recording of the state after alone says nothing of half a per cent of a stiffness that is
    # known to ten.
    joint = next(e for e in RIG.element if e.name == "joint_2")
    assert parameters(joint)["k"].tolerance > 0.05


@pytest.mark.slow  # two whole diagnoses
def test_what_both_states_have_beside_the_rig_file_is_no_change(tmp_path):
    off = mass("link_3_6", -0.1, 0.3)
    before, after = recorded(0, STRANGE), recorded(1, STRANGE, off)
    found = changed(before, after, RIG, effects=effects())
    assert {c.physics for c in found.before.causes} == {"transport_delay"}
    (cause,) = found.causes
    assert named(found, "added_mass", "link_3_6")
    m = cause.parameters["m"]
    # Taken off, so it has a negative sign. The scale of all masses is known by tolerances alone.
    assert m.value == pytest.approx(-0.1, rel=0.05)
    assert m.low < m.value < m.high < 0
    assert "both states have, beside the rig file: transport delay" in found.lines()[2].lower()
    page = write_diagnosis(tmp_path / "d.html", found, after.responses, RIG).read_text("utf-8")
    assert "Changed: added mass at" in page
    assert "what changed between two states" in page


def test_where_nothing_changed_it_says_so(plain):
    found = changed(plain, recorded(1), RIG, effects=effects())
    assert found.verdict == "no_mismatch"
    assert found.lines()[0].startswith("Nothing changed: one set of parameters fits both states")
    assert not found.before.discrepancy
    # Nominal errors cancel: what a record alone lets hide in tolerances of kilos is seen in grams.
    alone = diagnose(plain.responses, RIG, runs=plain.runs, effects=effects("added_mass"))
    where = ("added_mass", "link_1")
    two, one = (
        next(h.size or np.inf for h in each.could_hide if (h.physics, h.site) == where)
        for each in (found, alone)
    )
    assert two < 0.2 * one


@pytest.mark.slow  # two whole diagnoses
def test_a_change_that_is_stated_is_not_looked_for(plain):
    after = recorded(1, stiffness("joint_2", 0.97))
    k = scene().setup.part("joint_2").values["k"]
    found = changed(plain, after, RIG, known={"joint_2.k": 0.97 * k}, effects=effects("added_mass"))
    assert found.verdict == "no_mismatch"


@pytest.mark.slow  # two whole diagnoses
def test_what_no_table_explains_in_both_states_is_told_and_not_named():
    """With masses alone in the table a delay in both states has no name; a change still has."""
    before, after = recorded(0, STRANGE), recorded(1, STRANGE, mass("link_1", 0.1, 0.19))
    found = changed(before, after, RIG, effects=effects("added_mass", site="link_1"))
    assert found.before.discrepancy
    assert named(found, "added_mass", "link_1")
    assert "only what their responses differ by" in found.not_physics[0]


def test_what_both_have_is_free_in_the_model_of_both():
    """It has names of its own, so that another of its kind may be what changed."""
    found = inserted(RIG, "beam", oscillator("added_oscillator_2"))
    both = common_rig(RIG, found)
    model = Model(both)
    tolerance = dict(zip(model.keys, model.prior, strict=False))
    assert tolerance["common_oscillator_2_mass", "m"] == 1.0
    assert {k: v for k, v in tolerance.items() if not k[0].startswith("common")} == dict(
        zip(Model(RIG).keys, Model(RIG).prior, strict=False)
    )
    f = np.geomspace(1.0, 30.0, 7)
    n = len(both.sensor)
    at = grid(both, f, np.arange(n), np.zeros(n, np.int64))
    h, dh = model.gradient(np.zeros(model.n), at)
    j = model.keys.index(("common_oscillator_2_spring", "k"))
    ahead = np.zeros(model.n)
    ahead[j] = 1e-6
    slope = (model.response(ahead, at) - h) / 1e-6
    assert slope == pytest.approx(dh[:, :, j], abs=1e-4 * np.max(np.abs(dh[:, :, j])))
    again = inserted(both, "beam", oscillator("added_oscillator_2"))
    assert len({e.name for e in flattened(again.element)}) == len([*flattened(again.element)])


@pytest.fixture(scope="module")
def summed(plain):
    every = table_of(RIG, 0.5, 30.0)
    wholes = [Whole.of(plain.runs, RIG, None) for _ in range(2)]
    model = States(Model(RIG), RIG, (next(e for e in every if e.physics == "added_mass"),))
    starts = [u.middle for u in model.effects[0].unknowns]
    x = np.append(np.zeros(model.n_nominal), np.log(starts))
    fitted = Fitted(model, x, 0.0, 0.0, np.zeros((0, model.n)), np.eye(model.n))
    return wholes, fitted


def test_the_likelihood_of_two_states_is_the_sum_of_theirs(summed):
    (after, before), fitted = summed
    both = Both(after, before)
    found = both.about(fitted)
    at = both.nodes(found, fitted)
    assert isinstance(at, BothGrid)
    h = fitted.model.response(fitted.x, at) * 1.001
    each = [
        float(np.sum(part.residual(own) ** 2))
        for part, own in zip(found.each, (h[at.changed], h[at.split :]), strict=True)
    ]
    assert float(np.sum(found.residual(h) ** 2)) == pytest.approx(sum(each), rel=1e-9)
    assert found.known == pytest.approx(sum(part.known for part in found.each))


def test_both_states_are_looked_at_up_to_where_the_response_of_either_shows(summed, monkeypatch):
    (after, before), fitted = summed
    both = Both(after, before)
    found = both.about(fitted)
    assert both.showing(fitted, found).lines == both.lines  # it shows at all lines
    low = Both(after.up_to(10.0), before)
    monkeypatch.setattr(records, "LOST", 1e4)  # of chi-square
    cut = low.showing(fitted, low.about(fitted))
    (top,) = {high for _, high in cut.before.records.bands}
    assert 10.0 < top < before.records.band[1]
    assert cut.after.records.band[1] == 10.0


def test_what_is_alike_in_both_states_does_not_count(summed):
    (after, before), fitted = summed
    both = Both(after, before, alike=True)
    found = both.about(fitted)
    at = both.nodes(found, fitted)
    h = fitted.model.response(fitted.x, at)
    n = at.split
    alike = 0.1 * np.exp(1j * np.arange(n))[:, None] * np.abs(h[:n])
    left = found.residual(h + np.concatenate([alike, alike]))
    assert left == pytest.approx(found.residual(h), abs=1e-4 * np.linalg.norm(found.residual(h)))
    assert np.linalg.norm(found.residual(h + np.concatenate([alike, 0 * alike]))) > 10 * np.sqrt(
        found.known
    )


def test_an_effect_changes_the_state_after_alone(summed):
    (after, before), fitted = summed
    both = Both(after, before)
    at = both.nodes(both.about(fitted), fitted)
    model, x = fitted.model, fitted.x
    _, dh = model.gradient(x, at)
    for j in (0, model.n_nominal):
        step = 1e-6 * (np.arange(x.size) == j)
        slope = (model.response(x + step, at) - model.response(x - step, at)) / 2e-6
        assert slope == pytest.approx(dh[:, :, j], abs=1e-3 * np.max(np.abs(dh[:, :, j])))
    assert np.all(dh[at.split :, :, model.n_nominal :] == 0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["joint_2"], "expected ELEMENT.PARAMETER=VALUE"),
        (["joint_2.k=soft"], "expected ELEMENT.PARAMETER=VALUE"),
        (["joint_2.k=nan"], "expected ELEMENT.PARAMETER=VALUE"),
        (["joint_2.k=1", "joint_2.k=2"], "each parameter once"),
        (["joint2.k=1"], "did you mean joint_2?"),
        (["joint_2.kk=1"], "one of k, c; did you mean k?"),
        (["joint_2.k=-1"], "element[joint_2].k: value -1 N m/rad; expected 0 or more"),
    ],
)
def test_what_is_stated_wrongly_is_answered_in_one_line(words, said):
    with pytest.raises(InputError, match=r"^--known") as error:
        with_known(RIG, stated(words))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_stated_is_exact():
    rig = with_known(RIG, stated(["joint_2.k=9000", "link_0.m=16.5"]))
    values = {(e.name, s): p for e in rig.element for s, p in parameters(e).items()}
    assert values["joint_2", "k"].value == 9000
    assert values["joint_2", "k"].tolerance == 0
    assert values["link_0", "m"].value == 16.5
    assert with_known(RIG, {}) is RIG


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "LOGS: missing; expected recordings (.mcap), or --before and --after"),
        ("a.mcap --before b.mcap --after c.mcap", "recordings of --before and --after alone"),
        ("--before a.mcap b.mcap", "--after with recordings beside it"),
        ("--after a.mcap", "--before with recordings beside it"),
        ("--before a.mcap --after a.mcap", "other recordings than --before"),
        ("--before a.mcap b.mcap --after c.mcap", "a.mcap is not there"),
        ("a.mcap --each --known joint_2.k=1", "neither --before, --after nor --known"),
    ],
)
def test_states_that_are_no_two_are_refused_in_one_line(words, said):
    done = CliRunner().invoke(app, ["diagnose", *words.split()])
    assert said in str(done.exception)


def test_the_command_line_tells_two_states_apart(tmp_path: Path):
    recorded(0, folder=tmp_path / "a")
    recorded(1, folder=tmp_path / "b")
    words = ["diagnose", "--before", *map(str, sorted((tmp_path / "a").glob("*.mcap")))]
    words += ["--after", *map(str, sorted((tmp_path / "b").glob("*.mcap")))]
    done = CliRunner().invoke(app, [*words, "--known", "joint_9.k=1"])
    assert "did you mean joint_" in str(done.exception)


def test_what_is_taken_off_may_be_all_of_it():
    """At its largest a part is gone, and no more: whatever its tolerance, nothing is below 0."""
    braced = load_rig("samii_braced")[0]
    less = [e for e in hypotheses(braced, 0.5, 30.0, signed=True) if e.variant == "less"]
    gone = [e for e in less if e.unknowns[0].unit != "1"]  # a ratio to the file's has no end
    assert {"ground_spring", "added_mass", "viscous_damping"} <= {e.physics for e in gone}
    nominal = {(e.name, s): p.value for e in braced.element for s, p in parameters(e).items()}
    for effect in gone:
        largest = np.array([u.high for u in effect.unknowns])
        left = effect.parameters(largest, nominal)
        assert all(v >= 0 for (_, symbol), v in left.items() if symbol in ("m", "k", "c", "J"))
        assert effect.report(largest)[0] < 0
    brace = next(e for e in gone if e.name == ("ground_spring", "brace"))
    assert set(brace.parameters(np.array([2.0e7]), nominal).values()) == {0.0}


def test_in_one_state_less_than_the_file_begins_where_the_refit_ends():
    """What has no tolerance may be gone by any part, what has one from six of them on."""
    braced = load_rig("samii_braced")[0]
    less = {e.name: e for e in hypotheses(braced, 0.5, 30.0) if e.variant == "less"}
    mass, m = less["added_mass", "link_0"], RIG.element[2].m
    assert mass.unknowns[0].low == pytest.approx(6 * m.tolerance * m.value)
    assert mass.report(np.array([1.0, 1.0]))[0] == -1.0
    lag = less["actuator_lag", "joint_2_source"]
    assert lag.unknowns[0].low == pytest.approx(1.6)  # p is known to 10 %
    longer = next(
        e for e in hypotheses(braced, 0.5, 30.0)
        if e.variant == "more" and e.name == ("actuator_lag", "joint_2_source")
    )  # fmt: skip
    assert longer.unknowns[0].high == pytest.approx(1 / 1.6)
    assert ("viscous_damping", "joint_1") not in less  # c is known to a half: the refit has it all


def test_a_high_pass_delay_or_lag_of_a_sensor_may_not_be_there():
    """Its factor times the sensor's own is none at the bound of the search."""
    sensor = next(s for s in RIG.sensor if s.name == "a_0")
    late = sensor.model_copy(update={"delay": 2e-3, "lag": 5e-3})
    rig = RIG.model_copy(
        update={"sensor": tuple(late if s.name == "a_0" else s for s in RIG.sensor)}
    )
    less = {e.physics: e for e in hypotheses(rig, 0.5, 30.0)
            if e.site == "a_0" and e.variant == "less"}  # fmt: skip
    s = 2j * np.pi * np.geomspace(0.5, 30.0, 20)
    w = 2 * np.pi * late.highpass_hz
    own = {
        "sensor_delay": (np.exp(-s * 2e-3), less["sensor_delay"].unknowns[0].high),
        "sensor_lag": (1 / (1 + s * 5e-3), less["sensor_lag"].unknowns[0].high),
        "sensor_highpass": (s / (s + w), less["sensor_highpass"].unknowns[0].low),
    }
    assert own.keys() == less.keys()
    for physics, (factor, end) in own.items():
        F, _ = less[physics].factor.value(s, np.array([end]))
        np.testing.assert_allclose(F * factor, 1.0, atol=1e-3)
    (longer,) = (
        e for e in hypotheses(rig, 0.5, 30.0)
        if e.name == ("sensor_lag", "a_0") and e.variant == "more"
    )  # fmt: skip
    F, _ = longer.factor.value(s, np.array([0.25]))
    np.testing.assert_allclose(F * own["sensor_lag"][0], 1 / (1 + s * 20e-3))


def test_a_part_that_the_state_before_does_not_have_is_free_after_alone():
    """A brace that only the state after has: its stiffness is a parameter there, with its own
    tolerance, and moves the response of that state alone."""
    braced = load_rig("samii_braced")[0]
    gone = {f"{e}.{s}": 0.0 for e in ("brace", "brace_moment") for s in ("k", "c")}
    before = Model(with_known(braced, gone, "--known-before"))
    both = States(before, braced)
    j = both.keys.index(("brace", "k"))
    assert j >= before.n
    assert both.prior[j] == 0.5
    f = np.geomspace(0.5, 30.0, 30)
    n = len(braced.sensor)
    at = [grid(r, f, np.arange(n), np.zeros(n, np.int64)) for r in (braced, before.rig)]
    whole = BothGrid.of(at)
    h, dh = both.gradient(np.zeros(both.n), whole)
    assert h[:30] == pytest.approx(Model(braced).response(np.zeros(both.after.n), at[0]))
    assert h[30:] == pytest.approx(before.response(np.zeros(before.n), at[1]))
    ahead = np.zeros(both.n)
    ahead[j] = 1e-4
    slope = (both.response(ahead, whole) - h) / 1e-4
    assert slope == pytest.approx(dh[:, :, j], abs=1e-3 * np.max(np.abs(dh[:, :, j])))
    assert np.all(dh[30:, :, j] == 0)
    assert np.any(dh[:30, :, j] != 0)


def test_what_is_known_of_the_state_before_needs_one():
    done = CliRunner().invoke(app, ["diagnose", "a.mcap", "--known-before", "joint_2.k=1"])
    assert "--known-before" in str(done.exception)
    assert "--before and --after beside it" in str(done.exception)
