"""What is in no table: a joint that changes from run to run, damping with a law of its own; and
what a class of explanations says of names and places.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnose_kit import ALL, FEW, LINES, concealing, effect
from identify_kit import noiseless, samii
from table_kit import Effects

from samii_rig.diagnose.data.measured import measured
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit.between_runs import between_runs
from samii_rig.diagnose.fit.classes import RIVAL_NAME, Class
from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.fit.moebius import place_of
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.fit.stated import Evidence, probability
from samii_rig.diagnose.forces.laws import OVERLAP, Force
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Gap
from samii_rig.diagnose.verdict.judge import (
    Judgement,
    _critical_value,
    confirmed,
    judge,
    shown,
)
from samii_rig.identify.bootstrap import redraw

COMPLIANCE = "torsional_compliance"
POWER = 0.5
STRONG = Evidence(
    odds=8.0, left=1.0, held=1.0, effects=1, forced=False, confirmed=False, gain=50.0,
    drop=1e4, names=3, pair=False, closed=1.0,
)  # fmt: skip
TABLE = Effects(
    lambda: [
        e
        for e in ALL
        if e.physics == "torsional_compliance"
        or (e.physics == "viscous_damping" and e.variant == "beside the spring")
    ]
)


def softened(name, share):
    """The rig with one joint's stiffness changed."""
    rig = samii()
    elements = tuple(
        e.model_copy(update={"k": e.k.model_copy(update={"value": e.k.value * (1 + share)})})
        if e.name == name
        else e
        for e in rig.element
    )
    return rig.model_copy(update={"element": elements})


def again(response):
    """The same as a response of a periodic excitation."""
    return replace(response, method="periodic")


@pytest.mark.parametrize("joint", ["clamp", "joint_1", "joint_2", "joint_3"])
def test_a_joint_that_changes_between_runs_is_unknown_but_its_place_is_told(joint):
    runs = [concealing(), again(concealing(rig=softened(joint, -0.06), seed=2))]
    found = diagnose(runs, samii(), effects=FEW)
    assert found.verdict == "unknown"
    assert found.sites[0][0] == joint
    assert f"{joint} changes from run to run" in found.beyond
    assert found.beyond in found.lines()[0]
    assert found.plain()["beyond"] == found.beyond


def test_runs_that_agree_have_no_joint_that_changes():
    found = diagnose([concealing(), again(concealing(seed=2))], samii(), effects=FEW)
    assert found.verdict == "no_mismatch"
    assert not any("run to run" in line for line in found.not_physics)


def best_two(response):
    """A search, and its best explanation of two effects."""
    lines = measured([response], samii())
    at = grid(samii(), lines.frequency, lines.sensor, lines.actuator)
    search = Search(samii(), lines, at, TABLE)
    search.forward(search.nominal, 8)
    search.forward(search.ranked()[0], 8)
    return search, next(e for e in search.ranked() if len(e.effects) == 2)


def test_damping_with_a_power_of_frequency_is_named_with_its_power():
    """The record is made by a part that acts through c s^alpha, without the chain that fits it."""
    rig = samii()
    damper = effect("viscous_damping", "joint_1", "beside")
    nominal, model = Model(rig), Model(rig, (damper,))
    at = grid(rig, LINES, np.arange(len(rig.sensor)), np.zeros(len(rig.sensor), dtype=np.int64))
    x = np.zeros(nominal.n)
    a = nominal.response(x, at)
    place = place_of(model, x, damper, at, a)
    s = 2j * np.pi * LINES
    h = a + place.b * place.phi(1000.0 * s[None] ** POWER)[0][:, None]
    response = redraw(noiseless(rig, LINES), h[:, :, None], np.random.default_rng(1), 10)
    lines = measured([response], rig)
    some = [*TABLE, *(e for e in ALL if e.physics == "fractional_damping")]
    search = Search(rig, lines, grid(rig, lines.frequency, lines.sensor, lines.actuator), some)
    search.forward(search.nominal, 8)
    best = search.ranked()[0]
    assert [e.name for e in best.effects] == [("fractional_damping", "joint_1")]
    c, alpha = best.effects[0].report(best.fitted.model.parts(best.fitted.x)[0])
    assert c == pytest.approx(1000.0, rel=0.2)
    assert alpha == pytest.approx(POWER, abs=0.05)


def test_an_effect_that_only_spares_the_tolerances_is_not_told_beside_another():
    spring, damper = effect("torsional_compliance", "beam"), effect("viscous_damping", "joint_2")
    lines = measured([concealing((spring, [1e6, 0.05]))], samii())
    at = grid(samii(), lines.frequency, lines.sensor, lines.actuator)
    search = Search(samii(), lines, at, [spring, damper])
    search.forward(search.nominal, 2)
    both = (spring, damper)
    search.forward(search.found[frozenset({spring.key})], 2)
    end = search.refitted(both, search.found[frozenset({spring.key})], [0.0])
    assert end is not None
    # However much more likely its nominal parameters: the data do not show the damper.
    search.found[frozenset(e.key for e in both)] = Explanation(both, end, 1e3)
    assert judge(search).best.effects == (spring,)


def test_two_compliances_are_two():
    first, other = (effect("torsional_compliance", n) for n in ("beam", "joint_2_source"))
    search, best = best_two(concealing((first, [1e6, 0.05]), (other, [5e4, 0.05])))
    assert search.ranked()[0] is best


@pytest.mark.parametrize(("behind", "told"), [(RIVAL_NAME - 1, 2), (RIVAL_NAME + 1, 1)])
def test_a_name_is_one_that_the_data_leave_as_probable(behind, told):
    pendulum, brace = (
        next(e for e in ALL if e.name == (physics, "joint_3") and "w" not in e.variant[-1])
        for physics in ("gravity_stiffness", "ground_spring")
    )
    lines = measured([concealing((pendulum, [3000.0]))], samii())
    at = grid(samii(), lines.frequency, lines.sensor, lines.actuator)
    search = Search(samii(), lines, at, [pendulum, brace])
    search.forward(search.nominal, 5)
    one, other = (search.found[frozenset({e.key})] for e in (pendulum, brace))
    both = Class((one, replace(other, weight=one.weight - behind)), (0.0, 0.0), 1.0)
    parts = both.parts()
    assert len(parts) == told
    assert sum(p for _, p in parts) == pytest.approx(1)
    assert (brace.name in both.equivalents(pendulum)) == (told == 2)


def test_a_joint_without_a_tolerance_may_change_between_runs_too():
    def known(e):
        return e.model_copy(update={"k": e.k.model_copy(update={"tolerance": 0.0})})

    rig = samii()
    rig = rig.model_copy(
        update={"element": tuple(known(e) if e.name == "joint_1" else e for e in rig.element)}
    )
    lines = measured([concealing()], rig)
    at = grid(rig, lines.frequency, lines.sensor, lines.actuator)
    other = measured([concealing(rig=softened("joint_1", -0.06), seed=2)], rig)
    search = Search(rig, lines, at, [])
    changing = between_runs(search, search.nominal.fitted, other)
    assert changing is not None
    assert changing.sites[0][0] == "joint_1"


def test_a_probability_is_never_more_than_the_evidence_leaves_it():
    assert probability(STRONG) > 0.9
    assert probability(replace(STRONG, odds=0.5)) < 1 / (1 + np.exp(-0.5)) + 1e-9


def test_what_should_show_may_not_make_worse_what_it_was_not_fitted_to():
    judged = Judgement("named", (), 0.0, 0.95, STRONG, 1.0)
    worse = Gap(-0.05, -0.7, 0.4)
    assert shown(judged, worse, due=1.0).verdict == "named"
    assert shown(judged, worse, due=100.0).verdict == "unknown"
    small = replace(judged, evidence=replace(STRONG, drop=400.0))
    assert shown(small, worse, due=100.0).verdict == "named"
    assert shown(small, Gap(-0.5, -0.7, -0.1), due=1.0).verdict == "unknown"


@pytest.mark.parametrize(
    ("physics", "left", "needed"),
    [
        ("valve_deadband", 1.005, 1e-4 * 4.5e6),
        ("valve_deadband", 1.3, 30.0),  # it leaves more than noise: something stands beside it
        ("added_mass", 1.005, 30.0),
    ],
)
def test_what_stands_beside_a_force_must_do_a_hundredth_of_it(physics, left, needed):
    force = Force(Place("command", ("valve",)), OVERLAP) if physics == "valve_deadband" else None
    one = Effect(physics, "valve", force=force)
    fits = {"nominal": 4_536_000.0, "force": 36_000.0}
    nominal, less = (
        SimpleNamespace(effects=effects, fitted=SimpleNamespace(chi2=fits[name]))
        for name, effects in (("nominal", ()), ("force", (one,)))
    )
    search = SimpleNamespace(
        nominal=nominal, critical_value_of=lambda _: 30.0, overdispersion=1.0, spread=1e-4,
        ratio=lambda _: left,
    )  # fmt: skip
    assert _critical_value(search, less, less) == pytest.approx(needed)


def test_several_effects_that_leave_much_are_no_answer_whatever_a_force_is_confirmed_to_be():
    sure = replace(STRONG, effects=2, forced=True)
    judged = Judgement("unknown", (), 0.0, 0.95, sure, 1.0, partly=True)
    assert confirmed(judged).verdict == "unknown"
    assert confirmed(replace(judged, partly=False)).verdict != "unknown"


def test_a_damper_may_be_as_weak_as_the_data_can_see():
    damper = effect("viscous_damping", "joint_1", "beside")
    k = next(e.k.value for e in samii().element if e.name == "joint_1")
    assert damper.unknowns[0].low * 2 * np.pi * LINES[-1] / k < 1e-5
