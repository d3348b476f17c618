"""An input that a sensor measured: `held = false`, the key stated wrongly, and two states.

Plan: the key is the same model as the effect, and its inverse the held one; a hammer with the key
stated, with a force beside it, and two of its states without; a held command with the key stated.
"""

from __future__ import annotations

from functools import cache

import hammer_kit
import numpy as np
import pytest
import two_masses_kit
from hammer_kit import struck
from table_kit import table_of

from samii_rig.diagnose.changed import State, changed
from samii_rig.diagnose.fit.rigfile import toml
from samii_rig.diagnose.forces import laws
from samii_rig.diagnose.forces.laws import Force
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.physics.effect import Effect, Unknown
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.insert import actuator_changed
from samii_rig.diagnose.physics.model import Model
from samii_rig.model.sampled import hold_at, sampled_response
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate

LINES = np.geomspace(1.0, 450.0, 60)  # Hz, up to 0.45 of the hammer's rate
LOOKED_FOR = ("input_not_held", "input_held", "transport_delay", "sensor_delay", "joint_stiffness",
              "added_mass")  # fmt: skip


def measured(rig: Rig, name: str) -> Rig:
    return actuator_changed(rig, name, lambda _: {"held": False})


STATED = measured(hammer_kit.RIG, "F")


def effect(rig: Rig, physics: str):
    return next(e for e in table_of(rig, 1.0, 450.0) if e.physics == physics)


def at(rig: Rig):
    return grid(rig, LINES, np.array([0, 1]), np.array([0, 0]), own_aliases=True)


def test_the_key_is_what_the_effect_finds_and_is_no_hypothesis_then() -> None:
    found = Model(hammer_kit.RIG, (effect(hammer_kit.RIG, "input_not_held"),))
    stated = Model(STATED)
    x = np.zeros(stated.n)
    for one, other in zip(
        stated.gradient(x, at(STATED)), found.gradient(x, at(STATED)), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12)
    # An accelerometer where the hammer strikes, without a filter: the sum over aliases is another.
    plain = sampled_response(STATED, LINES)[:, :, 0]
    np.testing.assert_allclose(stated.response(x, at(STATED)), plain, rtol=1e-9)
    names = {e.physics for e in table_of(STATED, 1.0, 450.0)}
    assert "input_held" in names
    assert "input_not_held" not in names
    assert "input_held" not in {e.physics for e in table_of(hammer_kit.RIG, 1.0, 450.0)}


def test_what_undoes_a_wrong_key_is_the_held_model_with_all_its_aliases() -> None:
    undone = Model(STATED, (effect(STATED, "input_held"),))
    held = Model(hammer_kit.RIG)
    x = np.zeros(held.n)
    np.testing.assert_array_equal(undone.response(x, at(STATED)), held.response(x, at(STATED)))


def test_a_delay_beside_a_measured_input_has_its_slope() -> None:
    model = Model(STATED, (effect(STATED, "transport_delay"),))
    x = np.append(np.zeros(model.n - 1), np.log(3e-4))
    _, dh = model.gradient(x, at(STATED))
    h = 1e-5
    up, down = (model.response(x + step * np.eye(model.n)[-1], at(STATED)) for step in (h, -h))
    slope = (up - down) / (2 * h)
    assert np.max(np.abs(dh[:, :, -1] - slope)) < 1e-6 * np.max(np.abs(slope))


def test_a_force_follows_a_measured_input_between_its_samples() -> None:
    unknown = Unknown("k3", "N/m^3", 1.0, 1e12, (1e6,))
    law = Force(Place("joint", ("columns_2",)), laws.HARDENING)
    force = Effect("cubic_stiffness", "columns_2", (unknown,), force=law)
    s = np.asarray(2j * np.pi * LINES, np.complex128)
    held = ForceModel(hammer_kit.RIG, (force,))
    assert not held.metered("F")
    assert held.channels(np.zeros(held.n), s) is None
    unheld = effect(hammer_kit.RIG, "input_not_held")
    models = ForceModel(STATED, (force,)), ForceModel(hammer_kit.RIG, (unheld, force))
    for model in models:
        assert model.metered("F")
        channels = model.channels(np.zeros(model.n), s)
        assert channels is not None
        np.testing.assert_allclose(channels[0]["F"] * hold_at(s, STATED.rate_hz), 1.0, rtol=1e-12)


def test_with_the_key_nothing_is_missing_and_nothing_is_remarked() -> None:
    found = hammer_kit.diagnosed(struck(1), table_of(STATED, 1.0, 450.0, *LOOKED_FOR), STATED)
    assert found.verdict == "no_mismatch"
    assert 0.85 < found.chi2_per_dof < found.threshold
    assert not any("held" in words or "reference" in words for words in found.not_physics)


def test_what_is_found_without_the_key_is_written_as_the_key() -> None:
    few = table_of(hammer_kit.RIG, 1.0, 450.0, *LOOKED_FOR)
    found = hammer_kit.diagnosed(struck(1), few)
    assert found.rig is not None
    text = toml(found.rig)
    assert "held = false" in text
    assert not parse(Rig, text, "diagnosed").actuator[0].held


def test_a_command_that_was_held_though_the_key_says_measured_names_no_physics() -> None:
    run = two_masses_kit.recorded(two_masses_kit.random_command(4000, 0.5, 3), 3)
    rig = measured(two_masses_kit.RIG, "v")
    few = table_of(rig, 1.0, 50.0, *LOOKED_FOR)
    found = two_masses_kit.diagnosed(run, effects=few, rig=rig)
    assert found.verdict == "no_mismatch"
    assert found.causes == ()
    assert found.not_physics[0].startswith("v was held between samples: the rig file states")
    assert found.rig is not None
    assert found.rig.actuator[0].held


@cache
def _state(seed: int, part: float) -> State:
    run = struck(seed, k2=part * hammer_kit.K2)
    return State(estimate([run], gaps="auto"), [run])


@pytest.mark.parametrize("rig", [hammer_kit.RIG, STATED], ids=["found", "stated"])
def test_what_changed_is_named_where_the_input_was_measured_in_both_states(rig: Rig) -> None:
    few = table_of(rig, 1.0, 450.0, *LOOKED_FOR, signed=True)
    found = changed(_state(1, 1.0), _state(2, 0.85), rig, effects=few)
    (cause,) = found.causes
    assert (found.verdict, cause.physics, cause.site) == ("named", "joint_stiffness", "columns_2")
    assert cause.parameters["k ratio"].value == pytest.approx(0.85, abs=0.005)
    assert found.with_causes[1] < found.threshold
    told = [words for words in found.not_physics if "held" in words]
    assert told == (
        [
            "F was not held between samples in the state before: both states are taken so, as held "
            "= false in the rig file states it"
        ]
        if rig is hammer_kit.RIG
        else []
    )
    assert found.before is not None
    assert not any(a.held for r in (found.rig, found.before.rig) if r for a in r.actuator)
