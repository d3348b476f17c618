"""A rig that only turns: what hangs on it turns with it."""

from __future__ import annotations

import numpy as np
import pytest
from table_kit import table_of

from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Cause, Value
from samii_rig.model.tmm import Chain
from samii_rig.report.diagnosis.laws import jump_curve
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig

JOINT = load_rig("flexible_joint")
F = np.geomspace(0.5, 60.0, 80)
HANGING = """
[[element]]
name = "hung"
kind = "branch"

[[element.element]]
name = "hung_spring"
kind = "torsional_spring"
k = { value = 3.0, unit = "N m/rad", source = "test" }
c = { value = 1e-3, unit = "N m s/rad", source = "test" }

[[element.element]]
name = "hung_disc"
kind = "inertia"
I = { value = 4e-4, unit = "kg m^2", source = "test" }
"""


@pytest.fixture(scope="module")
def rig() -> Rig:
    return JOINT[0]


def test_an_oscillator_that_turns_is_the_branch_that_a_rig_file_would_have(rig: Rig) -> None:
    few = table_of(rig, 0.5, 60.0, "attached_oscillator")
    at = next(e for e in few if e.site == rig.element[-1].name)
    assert [u.symbol for u in at.unknowns] == ["J", "k", "c"]
    assert [u.unit for u in at.unknowns] == ["kg m^2", "N m/rad", "N m s/rad"]
    J, k, c = 4e-4, 3.0, 1e-3
    w = np.sqrt(k / J)
    model = Model(rig, [at])
    x = np.concatenate([np.zeros(model.n_nominal), np.log([J, w, c / (2 * J * w)])])
    n = len(rig.sensor)
    here = grid(rig, F, np.arange(n), np.zeros(n, dtype=np.int64))
    by_effect = model.response(x, here)
    own = parse(Rig, JOINT[1].replace("\n[[sensor]]", f"{HANGING}\n[[sensor]]", 1), "hung")
    plain = Model(own, [])
    by_file = plain.response(
        np.zeros(plain.n_nominal), grid(own, F, np.arange(n), np.zeros(n, int))
    )
    np.testing.assert_allclose(by_effect, by_file, rtol=1e-8)
    assert np.max(np.abs(Chain(own).response(F) / Chain(rig).response(F) - 1)) > 0.05
    np.testing.assert_allclose(at.report(np.array([J, w, c / (2 * J * w)])), [J, k, c])


def test_no_mass_hangs_on_what_does_not_shift_and_no_inertia_on_what_does(rig: Rig) -> None:
    turning = table_of(rig, 0.5, 60.0, "attached_oscillator")
    assert {e.jump.states for e in turning if e.jump} == {("M", "theta")}
    beam = load_rig("beam_on_shaker")[0]
    shifting = table_of(beam, 2.0, 200.0, "attached_oscillator")
    assert {e.jump.states for e in shifting if e.jump} == {("V", "w")}


def test_its_curve_on_the_page_is_that_of_an_inertia_on_a_spring() -> None:
    parameters = {
        "J": Value(4e-4, "kg m^2", 3e-4, 5e-4),
        "k": Value(3.0, "N m/rad", 2.0, 4.0),
        "c": Value(1e-3, "N m s/rad", 0.0, 2e-3),
    }
    curve = jump_curve(Cause("attached_oscillator", "load", 0.9, (), parameters), F)
    s = 2j * np.pi * F
    spring = 3.0 + 1e-3 * s
    assert curve is not None
    np.testing.assert_allclose(curve, 4e-4 * s**2 * spring / (4e-4 * s**2 + spring))
