"""What the gate says of a reference before it reaches the wire."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from gate_judgement_kit import FINE, LIMITS, command, seen, with_feedback
from hypothesis import given
from hypothesis import strategies as st

from samii_rig.devices.protocols import CommandBlock
from samii_rig.safety.judgement import command_violation
from samii_rig.safety.latest import Latest
from samii_rig.safety.readback import Sent, travel

NOTHING = Sent()
# A joint that may turn as far as it likes: what is left are the limits on the output.
ROOMY = replace(LIMITS, sensors=(replace(LIMITS.sensors[0], max=9.0),))


def wrong(block, latest=FINE, limits=ROOMY, sent=NOTHING):
    return command_violation(block, latest, limits, sent)


def test_what_a_feedback_may_add_counts_for_the_bound_and_for_the_slew():
    limits = replace(with_feedback(), sensors=ROOMY.sensors)
    assert wrong(command([2.0, 4.4]), limits=limits) is None
    d = wrong(command([2.0, 4.6]), limits=limits)
    assert (d.what, d.number) == ("limit", pytest.approx(5.1))
    (addition,) = limits.feedback
    still = replace(seen([[0, 0.2], [0, 0.2]]), u=-2.0)
    tight = replace(limits, output=replace(limits.output, max_rate=1000.0))
    d = wrong(command([0.1]), still, tight)
    assert (d.what, d.number) == ("rate", pytest.approx(2.1 * 500 + 0.2 * addition.slew))


def test_only_the_centring_sensors_angle_is_part_of_the_bound():
    other = replace(LIMITS.sensors[0], channel="a", max=99.0)
    limits = replace(ROOMY, sensors=(*ROOMY.sensors, other))
    both = {k: (*getattr(FINE, k), 70.0) for k in ("peak", "rate", "last")}
    assert wrong(command([4.0]), replace(FINE, **both), limits) is None


def test_a_small_reference_passes():
    assert wrong(command([0.0, 1.0, 2.0])) is None
    assert wrong(command([0.0, 0.0], [0.1, 0.2])) is None


def test_the_bound_adds_the_loops_own_share():
    moved = seen([[0, -0.3], [0, -0.3]])
    assert wrong(command([2.0, 3.7]), moved) is None
    d = wrong(command([2.0, 3.9]), moved)
    assert (d.what, d.number) == ("limit", pytest.approx(3.9 + 4 * 0.3))
    d = wrong(command([0.0, 0.0, 0.0], [0.5, 1.0, 1.3]))
    assert (d.what, d.number) == ("limit", pytest.approx(5.2))


def test_a_reference_at_its_limits_passes():
    assert wrong(command([2.0, 4.0, 5.0])) is None
    assert wrong(command([4.0])) is None


@pytest.mark.parametrize("u", [[4.1], [0.0, 4.1], [0.0, 2.0, -2.1]])
def test_a_step_is_refused_over_the_border_and_inside(u):
    assert wrong(command(u)).what == "rate"


def test_the_slew_counts_from_the_last_sample_sent():
    sent = replace(FINE, u=3.0, theta_ref=0.2)
    assert wrong(command([4.0], [0.2]), sent) is None
    assert wrong(command([-1.1], [0.2]), sent).what == "rate"
    assert wrong(command([1.0], [-0.4]), sent).what == "rate"


def test_the_slew_inside_a_block_counts_the_set_point_too():
    assert wrong(command([0.0, 0.0], [-0.5, 0.4])) is None
    assert wrong(command([0.0, 0.0], [-0.6, 0.6])).what == "rate"
    assert wrong(command([0.0, 1.0], [-0.4, 0.3])) is None
    assert wrong(command([0.0, 1.0], [-0.4, 0.4])).what == "rate"
    assert wrong(command([0.0, 0.0, 0.0], [-0.6, 0.0, 0.6])) is None


def test_a_turning_joint_uses_up_slew():
    turning = seen([[0, 0], [0, 0.3]])  # 150 rad/s, 600 V/s through kp
    assert wrong(command([2.9]), FINE) is None
    assert wrong(command([2.9]), turning).what == "rate"


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_reference_that_is_not_a_number_is_refused(value):
    assert wrong(command([value])).what == "not a number"
    assert wrong(command([0.0], [value])).what == "not a number"
    assert wrong(command([0.0, value])).what == "not a number"
    assert wrong(command([0.0, 0.0], [value, 0.0])).what == "not a number"


def test_a_reference_of_wrong_shape_is_refused():
    assert wrong(CommandBlock(100, np.zeros(0), np.zeros(0))).what == "shape"
    assert wrong(CommandBlock(100, np.zeros(2), np.zeros(3))).what == "shape"
    assert wrong(CommandBlock(100, np.zeros((2, 2)), np.zeros(2))).what == "shape"


def test_a_set_point_beyond_the_sensors_limit_is_refused():
    assert wrong(command([0.0], [0.35]), limits=LIMITS) is None
    for angle in (0.351, -0.351):
        d = wrong(command([0.0, 0.0], [0.0, angle]), limits=LIMITS)
        assert (d.what, d.number, d.limit, d.unit) == ("set point", 0.351, 0.35, "rad")
        assert "theta's limit of 0.35 rad (the frame)" in d.reason


def turned(u, theta_ref, angle, kp, rate=0.001):
    """Sample by sample what `travel` has in closed form."""
    furthest = 0.0
    for a, b in zip(u, theta_ref, strict=True):
        angle += rate * (a + kp * (b - angle))
        furthest = max(furthest, abs(angle))
    return furthest


@given(
    u=st.lists(st.floats(-5, 5), min_size=1, max_size=120),
    ref=st.floats(-0.3, 0.3),
    angle=st.floats(-0.3, 0.3),
    kp=st.floats(0, 10),
    cut=st.integers(0, 119),
)
def test_the_travel_of_a_reference_is_that_of_the_source_alone(u, ref, angle, kp, cut):
    refs = np.full(len(u), ref)
    cut = min(cut, len(u) - 1)
    sent = Sent(0, np.array(u[:cut]), refs[:cut])
    got = travel(sent, CommandBlock(cut, np.array(u[cut:]), refs[cut:]), angle, 0.001, kp)
    assert got == pytest.approx(turned(u, refs, angle, kp), rel=1e-9, abs=1e-12)


def test_a_reference_that_would_turn_the_joint_too_far_is_refused():
    """K = 0.5 rad/(s V) at 500 Hz: 1 mrad a sample and volt; 0.42 rad are 1.2 of the limit."""
    far = seen([[0, 0.34], [0, 0.34]])
    assert wrong(command([3.4] * 23), far, replace(LIMITS, kp=0.0)) is None
    d = wrong(command([3.4] * 24), far, replace(LIMITS, kp=0.0))
    assert (d.what, d.unit) == ("travel", "rad")
    assert (d.number, d.limit) == (pytest.approx(0.4216), pytest.approx(0.42))
    assert "would turn theta to 0.4216 rad; allowed 0.42 rad (the frame)" in d.reason
    under_way = Sent(90, np.full(10, 3.4), np.zeros(10))
    d = wrong(command([3.4] * 15), replace(far, u=3.4), replace(LIMITS, kp=0.0), under_way)
    assert d.what == "travel"
    back = seen([[0, -0.34], [0, -0.34]])
    assert wrong(command([-3.4] * 25), back, replace(LIMITS, kp=0.0)).what == "travel"
    assert wrong(command([3.4] * 24), back, replace(LIMITS, kp=0.0)) is None
    assert wrong(command([0.0]), seen([[0, 1.2 * 0.35]]), replace(LIMITS, kp=0.0)) is None
    unknown = replace(LIMITS, kp=0.0, turning=0.0)
    assert wrong(command([3.4] * 100, first=2), far, unknown) is None


def test_the_centring_holds_a_joint_that_the_source_alone_would_turn_too_far():
    far = seen([[0, 0.34], [0, 0.34]])
    assert wrong(command([2.0] * 60, first=2), far, replace(LIMITS, kp=0.0)).what == "travel"
    assert wrong(command([2.0] * 60, first=2), far, LIMITS) is None


def test_a_reference_must_continue_and_must_not_be_late():
    sent = replace(FINE, next=100)
    assert wrong(command([0.0], first=100), sent) is None
    assert wrong(command([0.0], first=101), sent).what == "order"
    assert wrong(command([0.0], first=99), sent).what == "order"
    begun = replace(Latest.nothing(2), next=0)
    assert wrong(command([0.0], first=1), begun).what == "order"
    assert wrong(command([0.0], first=1)).what == "late"
    assert wrong(command([0.0], first=2)) is None


def test_a_reference_must_not_reach_far_ahead_of_the_samples():
    # The newest sample is number 1; a quarter of a second is 125 samples.
    assert wrong(command([0.0] * 25, first=102)) is None
    assert wrong(command([0.0] * 26, first=102)).what == "ahead"
