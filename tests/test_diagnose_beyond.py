"""What is in no table: a joint that changes from run to run, damping with a law of its own; and
what a class of explanations says of names and places.
"""

from dataclasses import replace

import numpy as np
import pytest
from identify_kit import noiseless, samii
from test_diagnose import ALL, FEW, LINES, concealing, effect

from samii_rig.diagnose.classes import RIVAL, Class
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.measured import measured
from samii_rig.diagnose.model import Model, grid
from samii_rig.diagnose.moebius import place_of
from samii_rig.diagnose.own_law import own_law
from samii_rig.diagnose.search import Search
from samii_rig.identify.bootstrap import redraw

POWER = 0.5
TABLE = [
    e
    for e in ALL
    if e.physics == "torsional_compliance"
    or (e.physics == "viscous_damping" and e.variant == "beside the spring")
]


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
    assert any(f"{joint} changes from run to run" in line for line in found.not_physics)


def test_runs_that_agree_have_no_joint_that_changes():
    found = diagnose([concealing(), again(concealing(seed=2))], samii(), effects=FEW)
    assert found.verdict == "no_mismatch"
    assert not any("run to run" in line for line in found.not_physics)


def best_two(response):
    """A search, and its best explanation of two effects."""
    lines = measured([response], samii())
    at = grid(samii(), lines.frequency, lines.sensor, lines.actuator)
    search = Search(samii(), lines, at, TABLE)
    search.grow(search.nominal, 8)
    search.grow(search.ranked()[0], 8)
    return search, next(e for e in search.ranked() if len(e.effects) == 2)


def test_damping_with_a_power_of_frequency_is_a_law_of_its_own():
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
    search, best = best_two(response)
    law = own_law(search, best)
    assert law is not None
    assert law.site == "joint_1"
    assert law.power == pytest.approx(POWER, abs=0.1)


def test_two_compliances_are_two():
    first, other = (effect("torsional_compliance", n) for n in ("beam", "joint_2_source"))
    search, best = best_two(concealing((first, [1e6, 0.05]), (other, [5e4, 0.05])))
    assert search.ranked()[0] is best
    assert own_law(search, best) is None


@pytest.mark.parametrize(("behind", "told"), [(RIVAL - 1, 2), (RIVAL + 1, 1)])
def test_a_name_is_one_that_the_data_leave_as_probable(behind, told):
    pendulum, brace = (
        next(e for e in ALL if e.name == (physics, "joint_3") and "w" not in e.variant[-1])
        for physics in ("gravity_stiffness", "ground_spring")
    )
    lines = measured([concealing((pendulum, [3000.0]))], samii())
    at = grid(samii(), lines.frequency, lines.sensor, lines.actuator)
    search = Search(samii(), lines, at, [pendulum, brace])
    search.grow(search.nominal, 5)
    one, other = (search.found[frozenset({e.key})] for e in (pendulum, brace))
    both = Class((one, replace(other, weight=one.weight - behind)), (0.0, 0.0), 1.0)
    parts = both.parts()
    assert len(parts) == told
    assert sum(p for _, p in parts) == pytest.approx(1)
    assert (brace.name in both.equivalents(pendulum)) == (told == 2)
