"""A sensor that drifts away from what else is known of it ends the run within its own limit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from fake_device import FakeDevice
from gate_agreement_kit import ONE, SAMII, TWO
from hypothesis import given
from hypothesis import strategies as st

from samii_rig.errors import GateError, InputError
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.safety.agreement import Agreement, Followed, apart
from samii_rig.safety.gate import Gate
from samii_rig.safety.judgement import State, violation
from samii_rig.safety.latest import Latest
from samii_rig.safety.limits import GateLimits, gate_limits
from samii_rig.types import Channel, Quality, SampleBlock

RATE = 500.0
CHANNELS = (Channel("v", "V", "command"), Channel("theta", "rad"), Channel("pot", "rad"))
POT = Agreement("theta", "pot", "rad", 0.02, "both are on the shaft")
DRIVEN = Agreement("theta", "v", "rad", 0.02, "the source turns it", gain=0.5, over=2.0)


def block(v, theta, pot=0.0, *, first=0, flags=None) -> SampleBlock:
    values = np.column_stack(np.broadcast_arrays(np.atleast_1d(v), theta, pot)).astype(float)
    sequence = np.arange(first, first + len(values))
    quality = np.zeros(values.shape, np.uint8) if flags is None else flags
    return SampleBlock(CHANNELS, sequence * 2_000_000, sequence, values, quality)


def test_two_sensors_are_as_far_apart_as_their_furthest_values():
    _, way = apart(POT, (1, 2), Followed(), block(0.0, [0.0, 0.1, 0.2], [0.0, 0.13, 0.19]))
    assert way == pytest.approx(0.03)


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_a_drift_comes_to_its_rate_times_the_time_that_is_remembered(chunk):
    t = np.arange(1000) / RATE
    v = np.cos(2 * np.pi * t)
    turned = np.concatenate([[0.0], np.cumsum(0.5 * v[:-1] / RATE)])
    for rate in (0.0, 0.03, -0.03):
        followed, most = Followed(), 0.0
        for n in range(0, 1000, chunk):
            part = slice(n, n + chunk)
            b = block(v[part], (7.0 + turned + rate * t)[part], first=n)
            followed, way = apart(DRIVEN, (1, 0), followed, b)
            most = max(most, way)
        end = abs(rate) * 2.0 * (1.0 - math.exp(-t[-1] / 2.0))
        assert most == pytest.approx(end, rel=2e-3, abs=1e-12)


@given(st.floats(-1e3, 1e3), st.floats(-1.0, 1.0), st.integers(1, 50))
def test_a_joint_that_its_source_turns_agrees_wherever_it_stands(at, v, n):
    theta = at + 0.5 * v * np.arange(n) / RATE
    _, way = apart(DRIVEN, (1, 0), Followed(), block(np.full(n, v), theta))
    assert way < 1e-9


@pytest.mark.parametrize("flag", [Quality.MISSING, Quality.STALE])
@pytest.mark.parametrize("column", [1, 2])
def test_what_was_not_told_says_nothing(flag, column):
    flags = np.zeros((3, 3), np.uint8)
    flags[1, column] = flag
    b = block(0.0, [0.0, 9.0, 0.0], flags=flags)
    assert apart(POT, (1, 2), Followed(), b)[1] == 0.0
    untold = block(0.0, [0.0, math.nan, 0.0])
    assert apart(POT, (1, 2), Followed(), untold)[1] == 0.0
    assert apart(DRIVEN, (1, 0), Followed(), untold)[1] == 0.0
    nothing = block(0.0, [math.nan])
    before = Followed(5, 1.0, 2.0, 0.5)
    assert apart(DRIVEN, (1, 0), before, nothing) == (before, 0.0)


def limits_of(*agreements: Agreement) -> GateLimits:
    whole = gate_limits(load_rig("samii")[0], "v_2", 4.0, "theta_2")
    output = replace(whole.output, channel="v")
    theta = replace(whole.sensors[0], channel="theta")
    return replace(whole, output=output, sensors=(theta,), agreements=agreements)


@pytest.mark.parametrize(("way", "what"), [(0.02, ""), (0.0201, "apart")])
def test_more_than_is_allowed_is_a_fault_with_both_names_and_the_reason(way, what):
    fine = replace(Latest.nothing(2), good=(0, 0), offset=0, heartbeat=0, last=(0.0, 0.0))
    found = violation(replace(fine, apart=(0.0, way)), limits_of(DRIVEN, POT), 0)
    assert (found.what if found else "") == what
    if found:
        assert found.reason == (
            "theta and pot are 0.0201 rad apart: one of them drifts; allowed 0.02 (both are on "
            "the shaft)"
        )
        assert (found.number, found.limit, found.unit) == (0.0201, 0.02, "rad")


def test_the_gate_follows_from_block_to_block_and_begins_anew_after_a_clear():
    gate = Gate(FakeDevice(), limits_of(DRIVEN), CHANNELS, lambda event: None)
    gate.observe(block(0.0, [0.0]), 0)
    gate.arm(0)
    with pytest.raises(GateError, match=r"theta and v are 0\.03 rad apart"):
        gate.observe(block(0.0, [0.03], first=1), 2_000_000)
    assert gate.state is State.FAULT
    gate.clear("Ada", "encoder replaced", 3_000_000)
    gate.observe(block(0.0, [0.1], first=2), 4_000_000)
    gate.arm(4_000_000)
    assert gate.state is State.ARMED


# From the rig file


def test_the_rig_file_says_what_agrees():
    rig = parse(Rig, SAMII + TWO + ONE, "rig")
    found = gate_limits(rig, "v_2", 4.0, "theta_2")
    pot, driven = found.agreements
    assert (pot.sensor, pot.other, pot.max, pot.gain) == ("theta_2", "pot_2", 0.02, 0.0)
    assert (driven.other, driven.gain, driven.over) == ("v_2", 0.5, 2.0)
    assert "pot_2" in [c.channel for c in found.sensors], "its silence would not be seen"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('other = "v_2"', 'other = "v_3"', "expected a sensor, one of"),
        ('other = "v_2"', 'other = "theta_2"', "expected a sensor, one of"),
        ("over = 2.0", "", "expected over, s, with an actuator"),
        ('other = "v_2"\nover = 2.0', 'other = "a_0"\nover = 2.0', "expected over, s, with an"),
        ('other = "v_2"\nover = 2.0', 'other = "a_0"', "units 'rad' and 'm/s.2'; expected one"),
        ("max = 0.03", "max = -1.0", "agreement"),
    ],
)
def test_an_agreement_that_makes_no_sense_is_one_line(old, new, said):
    assert old in ONE
    with pytest.raises(InputError, match=said) as caught:
        parse(Rig, SAMII + ONE.replace(old, new), "rig")
    assert "\n" not in str(caught.value)


def test_a_sensor_that_its_actuator_turns_at_no_known_speed_cannot_be_compared_with_it():
    rig = parse(Rig, SAMII + ONE.replace("theta_2", "a_0"), "rig")
    with pytest.raises(InputError, match="an angle that v_2 turns"):
        gate_limits(rig, "v_2", 4.0, "theta_2")


def test_monitors_are_compared_too():
    monitor = TWO[: TWO.index("[[agreement]]")]
    made = '[[monitor]]\nname = "pot_2"\nunit = "rad"\nusual = 0.0\n\n'
    rig = parse(Rig, SAMII + TWO.replace(monitor, made), "rig")
    assert "pot_2" in [c.channel for c in gate_limits(rig, "v_2", 4.0, "theta_2").sensors]
