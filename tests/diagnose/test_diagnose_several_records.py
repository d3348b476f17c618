"""Whole records of a rig with two inputs: SAMII's joints 2 and 3, in turn and together."""

from dataclasses import replace

import numpy as np
import pytest
from table_kit import Effects, table_of
from two_joints_kit import BAND, RIG, in_turn, late, recorded, together

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.physics.loops import JointLoops, Loop
from samii_rig.errors import EstimateError
from samii_rig.likelihood.pieces import wiring
from samii_rig.signal.estimate import estimate

# A dead time of either input, and a joint that gives there: what takes the time are the refits.
INPUTS = ("joint_2_source", "joint_3_source")
FEW = Effects(
    lambda: [
        e
        for e in table_of(RIG, *BAND, "transport_delay", "torsional_compliance")
        if e.site in INPUTS
    ]
)
HOW = {"in turn": in_turn, "together": together}


def found_in(runs):
    return diagnose(estimate(runs), RIG, runs=runs, effects=FEW)


IN_TURN = pytest.param("in turn", marks=pytest.mark.slow)  # half a minute each


@pytest.mark.parametrize("how", [IN_TURN, "together"])
def test_where_nothing_is_missing_two_inputs_say_so(how):
    found = found_in(recorded(RIG, HOW[how]()))
    assert found.verdict == "no_mismatch"
    assert 0.8 < found.chi2_per_dof < found.threshold < 1.2
    assert found.used.lines == found.used.of > 1000
    assert found.causes == ()  # of forces neither


@pytest.mark.slow  # half a minute each
@pytest.mark.parametrize("how", list(HOW))
def test_a_dead_time_of_one_input_is_named_there_and_not_at_the_other(how):
    found = found_in(recorded(late("v_3", 1e-3), HOW[how]()))
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("transport_delay", "joint_3_source")
    assert cause.parameters["tau"].value == pytest.approx(1e-3, rel=0.01)
    assert found.with_causes[0] < found.threshold


def test_a_record_in_which_one_input_rests_tells_of_the_other_alone():
    whole = Whole.of(recorded(RIG, in_turn()), RIG)
    assert [x.command for x in whole.wired.inputs] == ["v_2", "v_3"]
    assert whole.wired.loops == ((4.0, 0, 0), (3.0, 1, 1))
    for piece, driven in zip(whole.records.pieces, (0, 1), strict=True):
        power = np.mean(piece.r**2, axis=0)
        # The rounding of the command, half a step at most, is all that drives the joint that rests.
        step = RIG.actuator[1 - driven].resolution
        assert step**2 / 12 / 2 < power[1 - driven] < step**2 / 4
        assert power[driven] > 1e5 * power[1 - driven]


def one_joint(hidden):
    """Two sweeps of joint 2 alone; the loop of joint 3 moves within some steps of its command."""
    runs = recorded(hidden, in_turn()[:1] * 2)
    moved = [run.values[:, run.column("v_3")] for run in runs]
    assert all(0 < np.abs(v).max() < 20 * RIG.actuator[1].resolution for v in moved)
    return runs


@pytest.mark.slow  # half a minute on a loaded machine
def test_of_one_joint_driven_nothing_is_missing_where_nothing_is():
    """What the other's loop does follows the noise of its encoder: no change of its response is
    free, which would fit that noise."""
    runs = one_joint(RIG)
    whole = Whole.of(runs, RIG)
    assert [x.driven for x in whole.wired.inputs] == [True, False]
    assert whole.records.undriven == (1,)
    found = found_in(runs)
    assert found.verdict == "no_mismatch"
    assert 0.8 < found.chi2_per_dof < found.threshold < 1.2


@pytest.mark.slow  # half a minute; what names it is that of both inputs, above
def test_of_one_joint_driven_a_dead_time_of_it_is_named():
    found = found_in(one_joint(late("v_2", 1e-3)))
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("transport_delay", "joint_2_source")
    assert cause.parameters["tau"].value == pytest.approx(1e-3, rel=0.01)


def test_a_loop_around_an_input_without_a_column_is_told_in_one_line():
    run, other = recorded(RIG, in_turn())
    keep = [i for i, c in enumerate(other.channels) if c.name != "v_3"]
    other = columns_of(other, keep)
    with pytest.raises(EstimateError, match=r"run_1\.mcap has no column v_3; expected one") as no:
        wiring([run, other], RIG)
    assert "\n" not in str(no.value)


def columns_of(run, keep):
    channels = tuple(run.channels[i] for i in keep)
    return replace(run, channels=channels, values=run.values[:, keep], quality=run.quality[:, keep])


# The loops


RNG = np.random.default_rng(3)


def drawn(*shape):
    return RNG.standard_normal(shape) + 1j * RNG.standard_normal(shape)


def test_one_of_several_loops_is_the_loop_of_one_input():
    H, dH, b = drawn(6, 3), drawn(6, 3, 4), drawn(6, 3)
    one, joint = Loop(2.0, 1), JointLoops(np.array([[0.0, 2.0, 0.0]]))
    np.testing.assert_allclose(joint.closed(H), one.closed(H), rtol=1e-12)
    np.testing.assert_allclose(joint.slopes(H, dH), one.slopes(H, dH), rtol=1e-11)
    for a, c in zip(joint.part(H, b), one.part(H, b), strict=True):
        np.testing.assert_allclose(a, c, rtol=1e-11)
    np.testing.assert_allclose(joint.around(H, dH), one.around(H, dH), rtol=1e-12)


def test_two_loops_close_as_the_matrices_say_and_a_part_moves_them_by_one_rank():
    K = np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 3.0]])
    loops, H = JointLoops(K), drawn(5, 6)
    G = H.reshape(5, 3, 2)
    exact = G @ np.linalg.inv(np.eye(2) + K @ G)
    np.testing.assert_allclose(loops.closed(H).reshape(5, 3, 2), exact, rtol=1e-12)
    # What each sensor shows of its own noise.
    every = np.broadcast_to(np.eye(3, dtype=complex), (5, 3, 3))
    np.testing.assert_allclose(
        loops.around(loops.closed(H), every), np.linalg.inv(np.eye(3) + G @ K), atol=1e-11
    )
    b = (drawn(5, 3)[:, :, None] * drawn(5, 2)[:, None, :]).reshape(5, 6)
    x = drawn(5)
    turned, c = loops.part(H, b)
    moved = loops.closed(H) + turned * (x / (1 - c * x))[:, None]
    np.testing.assert_allclose(loops.closed(H + b * x[:, None]), moved, rtol=1e-10)
    dH, step = drawn(5, 6, 2), 1e-6
    by_step = (loops.closed(H + step * dH[:, :, 0]) - loops.closed(H - step * dH[:, :, 0])) / (
        2 * step
    )
    np.testing.assert_allclose(loops.slopes(H, dH)[:, :, 0], by_step, rtol=1e-6, atol=1e-8)
