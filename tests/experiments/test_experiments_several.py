"""Experiments with several inputs: who is driven when, and that the inputs can be told apart."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.errors import InputError
from samii_rig.record.layout import segment_from_map, segment_to_map
from samii_rig.rig.load import load_rig
from samii_rig.run.experiments import kinds, load_experiment, plan_of
from samii_rig.run.plan import Output
from samii_rig.types import Segment

RIG = load_rig("samii_two_joints")[0]
OUTPUTS = (Output("v_2", 4.0, "theta_2"), Output("v_3", 3.0, "theta_3"))


def experiment(name, **changes):
    shipped, _ = load_experiment(name, RIG)
    return type(shipped).model_validate({**shipped.model_dump(exclude_unset=True), **changes})


def three():
    """A third output, on joint 2's spring too: enough for a plan, which asks no model."""
    third = RIG.actuator[1].model_copy(update={"name": "v_4", "centring": None})
    return RIG.model_copy(update={"actuator": (*RIG.actuator, third)})


def test_sweeps_come_one_input_after_the_other_and_the_other_rests():
    plan = plan_of(experiment("swept_sine"), RIG)
    assert plan.outputs == OUTPUTS
    assert [s.excited for s in plan.segments] == [("v_2",)] * 4 + [("v_3",)] * 4
    for s in plan.segments:
        at = 0 if s.excited == ("v_2",) else 1
        assert np.abs(s.u[:, at]).max() == pytest.approx(s.level, rel=1e-3)
        assert not s.u[:, 1 - at].any()
        assert not s.theta_ref.any()
    first, second = plan.segments[0], plan.segments[4]
    np.testing.assert_array_equal(first.u[:, 0], second.u[:, 1])
    assert len({s.name for s in plan.segments}) == len(plan.segments)
    assert plan.duration == 8 * 66.0


def test_one_input_of_two_is_driven_alone_by_any_experiment():
    plan = plan_of(experiment("swept_sine", actuator="v_3", beside=[]), RIG)
    assert plan.outputs == OUTPUTS
    for s in plan.segments:
        assert s.excited == ("v_3",)
        assert s.u[:, 1].any()
        assert not s.u[:, 0].any()


@pytest.mark.parametrize("k", [2, 3])
def test_multisines_together_are_orthogonal_over_a_block_of_experiments(k):
    """Sum over the experiments of U_p conj(U_q) is 0 for p unlike q, at every driven line, and m
    times the power of one alone for p = q: no input costs another any accuracy."""
    rig = RIG if k == 2 else three()
    beside = [a.name for a in rig.actuator[1:]]
    made = experiment("multisine", beside=beside, realisations=1, amplitudes=[0.5])
    plan = plan_of(made, rig)
    m = {2: 2, 3: 4}[k]
    assert len(plan.segments) == m
    n = round(made.period * rig.rate_hz)
    U = np.stack(
        [np.fft.rfft(s.u[s.recorded[0] : s.recorded[0] + n], axis=0) for s in plan.segments]
    )
    power = np.einsum("elp,elq->lpq", U, U.conj())
    alone = np.abs(U[0]) ** 2
    driven = alone[:, 0] > 1e-6 * alone[:, 0].max()
    assert 200 < driven.sum() < 400
    for p in range(k):
        np.testing.assert_allclose(power[driven, p, p], m * alone[driven, p], rtol=1e-9)
        for q in range(p):
            off = np.abs(power[driven, p, q]) / np.sqrt(alone[driven, p] * alone[driven, q])
            assert off.max() < 1e-9
    # Phases of their own, on the same lines; no sign changes a peak.
    turn = np.angle(U[0, driven, 0] / U[0, driven, 1])
    assert np.abs(np.mean(np.exp(1j * turn))) < 0.2
    for s in plan.segments:
        assert s.excited == made.inputs
        assert np.abs(s.u).max() <= 0.5 + 1e-12
    assert [s.repeat for s in plan.segments] == list(range(m))


def test_the_first_input_alone_has_the_same_multisine_as_before():
    both = plan_of(experiment("multisine"), RIG)
    alone = plan_of(experiment("multisine", beside=[]), RIG)
    for i, s in enumerate(alone.segments):
        np.testing.assert_array_equal(both.segments[2 * i].u[:, 0], s.u[:, 0])


def test_set_points_are_driven_together_as_well():
    made = experiment("multisine", drive="reference", unit="rad", amplitudes=[0.01])
    plan = plan_of(made, RIG)
    for s in plan.segments:
        assert not s.u.any()
        assert (np.abs(s.theta_ref).max(axis=0) > 0.005).all()


@pytest.mark.parametrize("name", ["swept_sine", "multisine"])
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"beside": ["v_9"]}, ("actuator", "v_9", "v_2, v_3")),
        ({"beside": ["v_2"]}, ("beside", "v_2")),
        ({"kp": 2.0}, ("kp", "each actuator keeps its own loop")),
        ({"unit": "rad"}, ("unit", "'V'")),
    ],
)
def test_what_does_not_fit_the_rig_is_refused_in_one_line(name, changes, words):
    with pytest.raises(InputError) as refusal:
        plan_of(experiment(name, **changes), RIG)
    text = str(refusal.value)
    assert all(word in text for word in words), text
    assert "\n" not in text


def test_a_set_point_needs_a_loop_on_every_input():
    free = RIG.actuator[1].model_copy(update={"centring": None})
    rig = RIG.model_copy(update={"actuator": (RIG.actuator[0], free)})
    made = experiment("multisine", drive="reference", unit="rad", amplitudes=[0.01])
    with pytest.raises(InputError, match="centring of v_3"):
        plan_of(made, rig)


def test_a_torque_test_drives_one_input():
    model = kinds()["torque_test"].load()
    test = model.model_validate(
        {
            **experiment("swept_sine").model_dump(exclude_unset=True),
            "experiment": "torque_test",
            "angle": "theta_2",
            "moment": "a_0",
        }
    )
    with pytest.raises(InputError, match="beside"):
        test.loop(RIG, "experiment t")


@pytest.mark.parametrize("excited", [(), ("v_2",), ("v_2", "v_3")])
def test_a_recording_keeps_what_was_excited(excited):
    segment = Segment("s", "burst", 1, 9, 0.5, "V", 2, excited)
    kept = segment_to_map(segment)
    assert segment_from_map(kept) == segment
    assert ("excited" in kept) == bool(excited)
