"""The gate's judgement as a pure function: which number trips it, and that nothing else does."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from fake_device import fake_rig
from gate_judgement_kit import COLUMNS, FINE, LIMITS, RATES, block, command, seen, with_feedback
from hypothesis import given
from hypothesis import strategies as st

from samii_rig.safety.judgement import (
    Act,
    Arm,
    Check,
    Clear,
    Fail,
    Start,
    State,
    Stop,
    Write,
    decide,
    violation,
)
from samii_rig.safety.latest import NEVER, Latest, observe
from samii_rig.safety.limits import gate_limits
from samii_rig.types import Quality, SampleBlock

NOW = 10**9
STATES = list(State)


def verdict(latest, now=None):
    return violation(latest, LIMITS, latest.time if now is None else now)


# What samples say


def test_samples_at_rest_are_fine():
    assert verdict(FINE) is None
    assert seen([[0.0, 0.0], [0.0, 0.0]]).rate == (0.0, 0.0)


def test_time_that_stands_still_counts_as_a_nanosecond():
    def rate(values, latest):
        b = block(values, first=2)
        b = replace(b, time=np.full(len(values), FINE.time))
        return observe(latest, b, COLUMNS, RATES, NOW).rate[1]

    assert rate([[0, 1e-9]], FINE) == pytest.approx(1.0)
    assert rate([[0, 1e-9], [0, 3e-9]], FINE) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("values", "what", "number"),
    [
        ([[0, 0], [0, 0.3501]], "limit", 0.3501),
        ([[0, 0], [0, -0.3501]], "limit", 0.3501),
        ([[5.01, 0], [5.01, 0]], "limit", 5.01),
        ([[0, 0], [4.1, 0]], "rate", 2050.0),
        ([[4.1, 0], [0, 0]], "rate", 2050.0),
        ([[0, 0], [0, 0], [4.1, 0]], "rate", 2050.0),
    ],
)
def test_a_number_over_its_limit_trips_and_is_named(values, what, number):
    d = verdict(seen(values))
    assert (d.state, d.act, d.accepted, d.what) == (State.FAULT, Act.ZERO, False, what)
    assert d.number == pytest.approx(number)
    assert d.limit in (0.35, 5.0, 2000.0)
    assert f"{d.limit:g}" in d.reason


@pytest.mark.parametrize("values", [[[0, 0.35]], [[5.0, 0]], [[1.0, 0], [5.0, 0]]])
def test_a_number_at_its_limit_does_not_trip(values):
    assert verdict(seen(values)) is None


def test_a_converters_rounding_over_the_output_limit_is_forgiven_but_not_more():
    limits = replace(LIMITS, output=replace(LIMITS.output, slack=0.01))
    assert violation(seen([[5.009, 0]]), limits, 0) is None
    assert violation(seen([[5.011, 0]]), limits, 0).what == "limit"
    assert violation(seen([[1.0, 0], [5.009, 0]]), limits, 2_000_000) is None
    assert violation(seen([[0.9, 0], [4.911, 0]]), limits, 2_000_000).what == "rate"


def test_the_rate_is_taken_over_the_border_of_two_blocks():
    before = seen([[0, 0]])
    assert verdict(seen([[4.1, 0]], latest=before, first=1)).what == "rate"
    assert verdict(seen([[3.9, 0]], latest=before, first=1)) is None


def test_a_rate_is_over_the_interval_that_it_changed_in():
    before = seen([[0, 2]], first=1000)
    assert seen([[0, 3]], latest=before, first=1001).rate[1] == pytest.approx(500.0)
    inside = seen([[0, 3], [0, 4], [0, 6]], latest=before, first=1001)
    assert inside.rate[1] == pytest.approx(1000.0)


def test_the_rate_over_a_gap_uses_the_time_that_passed():
    assert verdict(seen([[4.1, 0]], latest=seen([[0, 0]]), first=2)) is None
    lost = [[0, 0], [Quality.MISSING, 0], [0, 0]]
    assert verdict(seen([[0, 0], [math.nan, 0], [4.1, 0]], quality=lost)) is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("column", [0, 1])
def test_what_is_not_a_number_trips(value, column):
    row = [0.0, 0.0]
    row[column] = value
    assert verdict(seen([row, [0, 0]])).what == "not a number"


def test_a_missing_value_is_waited_for_but_not_for_ever():
    lost = [[0, Quality.MISSING]]
    latest = seen([[0.0, math.nan]], latest=seen([[0, 0.2]]), first=1, quality=lost)
    assert verdict(latest) is None
    assert latest.peak[1] == 0.2  # the value before it stands
    assert latest.rate[1] == 0.0
    assert verdict(seen([[0.0, math.nan]], latest=latest, first=40, quality=lost)).what == "stale"


def test_a_channel_that_the_device_repeats_grows_old():
    latest = seen([[0, 0.1]])
    for n in range(1, 30):
        latest = seen([[0, 0.1]], latest=latest, first=n, quality=[[0, Quality.STALE]])
    assert verdict(latest).what == "stale"


def test_a_channel_that_never_spoke_is_stale():
    latest = seen([[0.0, math.nan]], quality=[[0, Quality.MISSING]])
    assert verdict(latest).number == math.inf
    assert verdict(Latest.nothing(2)).what == "stale"


def test_silence_trips_after_stale_after_and_not_before():
    assert verdict(FINE, FINE.time + 50_000_000) is None
    assert verdict(FINE, FINE.time + 51_000_000).what == "stale"


def test_an_empty_block_changes_nothing():
    empty = block([[0, 0]])
    empty = SampleBlock(
        empty.channels,
        *(x[:0] for x in (empty.time, empty.sequence)),
        empty.values[:0],
        empty.quality[:0],
    )
    assert observe(FINE, empty, COLUMNS, RATES, NOW) is FINE


def test_a_queue_that_grows_shows_as_age():
    """The device's clock has another zero, so only growth can be seen."""
    latest = seen([[0, 0]], now=7 * NOW)
    for n in range(1, 200):
        latest = seen([[0, 0]], latest=latest, first=n, now=7 * NOW + n * 2_400_000)
    assert verdict(latest, latest.offset_at).what == "stale"


@given(ppm=st.floats(-200, 200), zero=st.integers(-(10**15), 10**15))
def test_clocks_that_drift_apart_are_not_staleness(ppm, zero):
    latest = Latest.nothing(2)
    for n in range(0, 300_000, 10_000):  # ten minutes
        host = zero + round(n * 2_000_000 * (1 + ppm * 1e-6))
        latest = seen([[0, 0]], latest=latest, first=n, now=host)
        assert latest.age(1, host) < 0.002


@pytest.mark.parametrize("first", [0, -3])
def test_samples_that_go_back_trip_for_good(first):
    latest = seen([[0, 0]], latest=seen([[0, 0]]), first=first)
    assert verdict(latest).what == "order"
    assert verdict(seen([[0, 0]], latest=latest, first=5)).what == "order"


@pytest.mark.parametrize("what", ["time", "sequence"])
@pytest.mark.parametrize("n", [2, 3])
def test_order_inside_a_block_is_checked(what, n):
    b = block([[0, 0]] * n)
    wrong = getattr(b, what).copy()
    wrong[-2] = wrong[-1]
    latest = observe(Latest.nothing(2), replace(b, **{what: wrong}), COLUMNS, RATES, NOW)
    assert verdict(latest, NOW).what == "order"


@pytest.mark.parametrize("what", ["time", "sequence"])
@pytest.mark.parametrize("back", [0, 1])
def test_order_is_checked_over_the_border_of_two_blocks(what, back):
    b = block([[0, 0]], first=2)
    wrong = getattr(b, what).copy()
    wrong[0] = getattr(FINE, what) - back
    latest = observe(FINE, replace(b, **{what: wrong}), COLUMNS, RATES, NOW)
    assert verdict(latest, NOW).what == "order"


def test_a_converter_at_its_end_is_blind_and_trips():
    assert verdict(seen([[0, 0.1]], quality=[[0, Quality.CLIPPED]])).what == "clipped"
    flags = [[0, 0], [0, Quality.CLIPPED], [0, 0]]
    assert verdict(seen([[0, 0.1]] * 3, quality=flags)).what == "clipped"


def test_an_output_that_the_device_changed_trips_once_commands_are_under_way():
    limited = [[Quality.LIMITED, 0]]
    assert verdict(seen([[0, 0]], quality=limited)) is None
    running = replace(FINE, first=10)
    assert verdict(seen([[0, 0]], latest=running, first=9, quality=limited)) is None
    assert verdict(seen([[0, 0]], latest=running, first=10, quality=limited)).what == "device"
    begun = replace(Latest.nothing(2), first=0)
    assert seen([[0, 0]], latest=begun, quality=limited).limited


@pytest.mark.parametrize("flags", [[0, Quality.MISSING], [Quality.STALE, 0], [0, Quality.LIMITED]])
def test_another_flag_or_another_channels_is_no_output_that_the_device_changed(flags):
    running = replace(FINE, first=2)
    assert not seen([[0, 0], [0, 0]], latest=running, first=2, quality=[flags, flags]).limited


def test_a_flag_on_one_sample_does_not_hide_the_next_value():
    latest = seen([[0, 0], [0, 0.4]], quality=[[0, Quality.MISSING], [0, 0]])
    assert verdict(latest).what == "limit"


def test_the_newest_good_value_of_each_channel_is_kept():
    flags = [[Quality.MISSING, 0], [0, Quality.MISSING], [Quality.MISSING, Quality.MISSING]]
    latest = seen([[0.1, 0.01], [0.2, 0.02], [0.3, 0.03]], quality=flags)
    assert (latest.last, latest.good) == ((0.2, 0.01), (2_000_000, 0))
    later = seen([[0.4, 0.04]], latest=latest, first=3, quality=flags[2:])
    assert (later.last, later.good) == (latest.last, latest.good)


def test_a_rate_that_nothing_limits_is_not_taken():
    b = block([[0, 0], [1, 1]])
    assert observe(Latest.nothing(2), b, COLUMNS, (1,), 0).rate == (0.0, 500.0)


def test_the_heartbeat_counts_only_where_a_client_is_needed():
    needed = replace(LIMITS, heartbeat_age=0.5)
    beat = replace(FINE, heartbeat=0)
    assert violation(replace(FINE, heartbeat=NEVER), LIMITS, FINE.time) is None
    assert violation(FINE, needed, FINE.time).what == "heartbeat"
    late = seen([[0, 0]], latest=beat, first=251)
    assert violation(beat, needed, FINE.time) is None
    assert violation(late, needed, late.time).what == "heartbeat"


# States


WRITE = Write(command([0.1]))
BAD = seen([[0, 9.0]])


def decided(state, request, latest=FINE):
    return decide(state, request, latest, LIMITS, latest.time)


def test_the_way_through_a_run():
    armed = decided(State.SAFE, Arm(0.05))
    assert (armed.state, armed.act) == (State.ARMED, Act.CONFIGURE)
    assert decided(State.ARMED, Start()).state is State.RUNNING
    assert decided(State.RUNNING, WRITE).act is Act.WRITE
    assert decided(State.RUNNING, Stop("done")).state is State.SAFE


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(
    "request_",
    [
        Arm(0.05),
        Arm(None),
        Start(),
        Check(),
        WRITE,
        Stop("x"),
        Fail("x"),
        Clear("Ada", "looked"),
        Clear(" ", "looked"),
        Clear("Ada", ""),
    ],
    ids=lambda r: type(r).__name__,
)
@pytest.mark.parametrize("latest", [FINE, BAD, Latest.nothing(2)], ids=["fine", "bad", "nothing"])
def test_only_running_on_good_samples_lets_a_command_through(state, request_, latest):
    d = decided(state, request_, latest)
    if d.act is Act.WRITE:
        assert state is State.RUNNING
        assert latest is FINE
        assert request_ is WRITE
    if d.state is State.RUNNING:
        assert d.act in (Act.WRITE, Act.NOTHING)
        assert latest is FINE
    if not d.accepted:
        assert d.act is Act.ZERO
        assert d.reason
    if state is State.FAULT and d.state is not State.FAULT:
        assert request_ == Clear("Ada", "looked")
    if d.state in (State.SAFE, State.FAULT) and state in (State.ARMED, State.RUNNING):
        assert d.act is Act.ZERO


@pytest.mark.parametrize("request_", [Start(), WRITE, Clear("Ada", "looked")])
def test_a_request_in_the_wrong_state_is_a_fault(request_):
    assert decided(State.SAFE, request_).state is State.FAULT


def test_a_refusal_says_the_state_and_the_one_that_is_needed():
    for request_, needed in [(Start(), "armed"), (WRITE, "running"), (Clear("A", "b"), "fault")]:
        reason = decided(State.SAFE, request_).reason
        assert reason.endswith(f"in state safe; possible only in {needed}")
    assert decided(State.FAULT, Arm(0.05)).reason.endswith("possible only in safe")


@pytest.mark.parametrize("state", [State.ARMED, State.RUNNING, State.FAULT])
def test_arming_twice_is_a_fault(state):
    assert decided(state, Arm(0.05)).state is State.FAULT


def test_arming_refused_for_a_cause_that_can_be_mended_stays_safe():
    assert decided(State.SAFE, Arm(None)).what == "deadman"
    for d in (decided(State.SAFE, Arm(None)), decided(State.SAFE, Arm(0.05), BAD)):
        assert (d.state, d.accepted) == (State.SAFE, False)


@pytest.mark.parametrize("state", [State.ARMED, State.RUNNING])
def test_a_check_on_bad_samples_ends_in_fault(state):
    assert decided(state, Check(), BAD).state is State.FAULT
    assert decided(state, Check()).state is state


@pytest.mark.parametrize("state", [State.SAFE, State.FAULT])
def test_a_check_at_rest_judges_nothing(state):
    d = decided(state, Check(), BAD)
    assert (d.state, d.act, d.accepted) == (state, Act.NOTHING, True)


@pytest.mark.parametrize("state", STATES)
def test_stop_and_fail_are_always_granted(state):
    assert decided(state, Stop("x")).act is Act.ZERO
    stopped = State.FAULT if state is State.FAULT else State.SAFE
    assert decided(state, Stop("x")).state is stopped
    assert decided(state, Fail("x")).state is State.FAULT


# The limits themselves


def test_the_tightest_of_several_limits_holds():
    rig = fake_rig()
    second = rig.limit[1].model_copy(update={"max": 0.2, "reason": "softer", "max_rate": 3.0})
    tight = gate_limits(rig.model_copy(update={"limit": (*rig.limit, second)}), "v", 4.0, "theta")
    assert (tight.sensors[0].max, tight.sensors[0].max_rate) == (0.2, 3.0)
    assert tight.sensors[0].reason == "softer"


def test_without_a_limit_the_converters_range_is_one():
    rig = fake_rig().model_copy(update={"limit": ()})
    limits = gate_limits(rig, "v", 4.0, "theta")
    assert (limits.output.max, limits.output.max_rate) == (10.0, math.inf)
    assert [c.channel for c in limits.channels] == ["v", "theta"]
    assert limits.device_loop().max_angle == math.inf
    assert [c.channel for c in gate_limits(rig, "v", 0.0, "theta").channels] == ["v"]


def test_the_device_gets_the_same_limits():
    loop = LIMITS.device_loop()
    assert (loop.sensor, loop.kp) == ("theta", 4.0)
    assert (loop.max_output, loop.max_rate, loop.max_angle) == (5.0, 2000.0, 0.35)


def test_clearing_a_fault_zeroes_once_more_and_names_the_person():
    d = decided(State.FAULT, Clear("Ada", "looked"))
    assert (d.state, d.act, d.accepted) == (State.SAFE, Act.ZERO, True)
    assert (d.what, d.reason) == ("clear", "Ada: looked")


def test_an_age_and_a_silence_that_are_just_allowed_do_not_trip():
    at = 50_000_000
    old = replace(FINE, good=(0, 0), offset=0, offset_at=at)
    assert old.age(0, at) == 0.05
    assert violation(old, LIMITS, at) is None
    quiet = replace(LIMITS, heartbeat_age=0.05)
    assert violation(replace(old, heartbeat=0), quiet, at) is None


def test_what_a_feedback_may_add_is_no_stray_output():
    limits = with_feedback()
    assert violation(replace(FINE, stray=0.54), limits, FINE.time) is None
    d = violation(replace(FINE, stray=0.56), limits, FINE.time)
    assert (d.what, d.limit) == ("readback", pytest.approx(0.55))
