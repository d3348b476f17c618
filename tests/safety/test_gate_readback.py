"""What the device reads back is held against what it was told, sample by sample."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from fake_device import FakeDevice, fake_rig
from gate_kit import LIMITS, Bench

from samii_rig.devices.protocols import CommandBlock
from samii_rig.errors import GateError, InputError
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.safety.judgement import State, violation
from samii_rig.safety.latest import Latest, observe
from samii_rig.safety.limits import gate_limits
from samii_rig.safety.readback import Places, Sent, stray
from samii_rig.types import Channel, Quality, SampleBlock

KP = 4.0
ECHOING = (
    Channel("v", "V", "command"),
    Channel("theta", "rad"),
    Channel("u", "V", "reference"),
    Channel("theta_ref", "rad", "reference"),
)
PLAIN, ECHO = Places(0, 1, None, None), Places(0, 1, 2, 3)
SENT = Sent(10, np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.1, 0.2]))


def block(rows, first=10, quality=None):
    values = np.atleast_2d(np.array(rows, dtype=float))
    n, m = values.shape
    sequence = np.arange(first, first + n)
    flags = np.zeros((n, m), np.uint8) if quality is None else np.array(quality, np.uint8)
    return SampleBlock(ECHOING[:m], sequence * 2_000_000, sequence, values, flags)


def test_an_output_that_is_what_was_told_is_no_distance_away():
    rows = [[1.0 - KP * 0.05, 0.05], [2.4, 0.0], [3.8 + KP * 0.1, -0.1]]
    assert stray(SENT, block(rows), PLAIN, KP) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("off", [0.3, -0.3])
@pytest.mark.parametrize("row", [0, 1, 2])
def test_the_largest_distance_of_all_samples_is_told(off, row):
    rows = [[1.0, 0.0], [2.4, 0.0], [3.8, 0.0]]
    rows[row][0] += off
    assert stray(SENT, block(rows), PLAIN, KP) == pytest.approx(0.3)


def test_samples_before_and_after_what_was_sent_are_not_judged():
    rows = [[9.0, 0.0], [1.0, 0.0], [2.4, 0.0], [3.8, 0.0], [9.0, 0.0]]
    assert stray(SENT, block(rows, first=9), PLAIN, KP) == pytest.approx(0.0, abs=1e-12)
    assert stray(SENT, block([[9.0, 0.0]], first=9), PLAIN, KP) == 0.0
    assert stray(SENT, block([[9.0, 0.0]], first=13), PLAIN, KP) == 0.0
    assert stray(Sent(0, np.ones(1), np.zeros(1)), block([[1.0, 0.0]], first=0), PLAIN, KP) == 0.0


def test_before_anything_is_sent_the_output_must_be_zero():
    assert stray(Sent(), block([[0.0, 0.3], [-0.2, 0.0], [0.1, 0.0]], first=0), PLAIN, KP) == 0.2
    flags = [[Quality.LIMITED, 0], [0, Quality.MISSING]]
    assert stray(Sent(), block([[0.2, 0.0], [0.1, 0.0]], 0, flags), PLAIN, KP) == 0.1
    bench = Bench()
    bench.device.spoil = lambda b: replace(b, values=b.values + np.array([0.1, 0.0]))
    bench.ticks(2)
    with pytest.raises(GateError, match="away from what was commanded"):
        bench.gate.arm(bench.device.now())
    assert bench.gate.state is State.SAFE


def test_an_output_that_the_device_changes_while_armed_is_a_fault():
    bench = Bench()
    bench.tick()
    bench.gate.arm(bench.device.now())
    taken = bench.device.taken

    def limited(b):
        b.quality[:, 0] |= np.uint8(Quality.LIMITED)
        return b

    bench.device.spoil = limited
    while bench.device.taken < taken + 25:
        bench.device.sleep(0.002)
        bench.gate.observe(bench.device.read(), bench.device.now())
    assert bench.gate.state is State.ARMED, "these may have been under way"
    with pytest.raises(GateError, match="the device itself changed v"):
        bench.tick(0.002)


@pytest.mark.parametrize("flag", [Quality.MISSING, Quality.STALE, Quality.CLIPPED, Quality.LIMITED])
@pytest.mark.parametrize("column", [0, 1])
def test_a_value_that_says_nothing_of_the_loop_is_not_judged(flag, column):
    flags = [[0, 0], [0, 0]]
    flags[0][column] = flag
    assert stray(SENT, block([[9.0, 0.0], [2.4, 0.0]], quality=flags), PLAIN, KP) == 0.0
    assert stray(SENT, block([[9.0, 0.0], [2.9, 0.0]], quality=flags), PLAIN, KP) > 0.4
    assert stray(SENT, block([[9.0, 0.0]], quality=flags[:1]), PLAIN, KP) == 0.0


def test_an_angle_that_is_not_known_judges_an_open_loop_only():
    blind = Places(0, None, None, None)
    assert stray(SENT, block([[9.0, 0.0]]), blind, KP) == 0.0
    assert stray(SENT, block([[1.5, 0.0]]), blind, 0.0) == pytest.approx(0.5)
    assert stray(SENT, block([[1.5, 7.0]]), PLAIN, 0.0) == pytest.approx(0.5)
    assert stray(SENT, block([[1.5, math.nan]]), PLAIN, 0.0) == pytest.approx(0.5)
    assert stray(SENT, block([[0.7, 0.3]]), PLAIN, 1.0) == pytest.approx(0.0, abs=1e-12)


def test_a_reference_that_was_lost_on_its_way_is_no_difference_but_another_one_is():
    lost = [[-KP * 0.05, 0.05, 0.0, 0.0]]
    assert stray(SENT, block(lost), ECHO, KP) == pytest.approx(0.0, abs=1e-12)
    other = [[1.5, 0.0, 1.5, 0.0]]
    assert stray(SENT, block(other), ECHO, KP) == pytest.approx(0.5)
    turned = [[1.0 + KP * 0.1, 0.0, 1.0, 0.1]]
    assert stray(SENT, block(turned), ECHO, KP) == pytest.approx(KP * 0.1)
    output = [[1.7, 0.0, 1.0, 0.0]]
    assert stray(SENT, block(output), ECHO, KP) == pytest.approx(0.7)


def test_references_follow_each_other_and_go_when_they_have_come_back():
    sent = Sent().then(CommandBlock(5, np.array([1.0, 2.0]), np.zeros(2)))
    sent = sent.then(CommandBlock(7, np.array([3.0]), np.array([0.5])))
    assert (sent.first, sent.u.tolist(), sent.theta_ref.tolist()) == (5, [1, 2, 3], [0, 0, 0.5])
    assert sent.after(4) is sent
    later = sent.after(5)
    assert (later.first, later.u.tolist(), later.theta_ref.tolist()) == (6, [2, 3], [0, 0.5])
    gone = sent.after(9)
    assert (gone.first >= 0, len(gone.u)) == (True, 0)
    assert gone.after(20) is gone
    assert Sent().after(7).first == -1
    again = gone.then(CommandBlock(20, np.array([4.0]), np.zeros(1)))
    assert (again.first, again.u.tolist()) == (20, [4.0])


def test_places_are_found_by_name_and_role():
    assert Places.among(ECHOING, "v", "theta") == ECHO
    assert Places.among(ECHOING[:2], "v", "theta") == PLAIN
    assert Places.among(ECHOING[:1], "v", "theta") == Places(0, None, None, None)
    third = (*ECHOING, Channel("more", "1", "reference"))
    assert Places.among(third, "v", "theta") == ECHO
    two = (*ECHOING, *(Channel(f"ref_{i}", "1", "reference") for i in range(4)))
    n = len(ECHOING)
    for place, echo in ((0, ECHO), (1, replace(ECHO, u=n, theta_ref=n + 1))):
        assert Places.among(two, "v", "theta", place) == echo
    one = (Channel("ref", "V", "reference"), *ECHOING[:2])
    assert Places.among(one, "v", "theta") == Places(1, 2, None, None)
    with pytest.raises(ValueError, match="w"):
        Places.among(ECHOING, "w", "theta")


def test_the_tolerance_is_steps_of_the_converter_or_a_part_of_the_limit():
    assert LIMITS.readback == pytest.approx(0.01 * 5.0)
    coarse = fake_rig().actuator[0].model_copy(update={"resolution": 0.1})
    limits = gate_limits(fake_rig().model_copy(update={"actuator": (coarse,)}), "v", 4.0, "theta")
    assert limits.readback == pytest.approx(0.4)


def test_an_output_that_strays_trips_with_both_numbers():
    fine = replace(Latest.nothing(2), good=(0, 0), offset=0)
    assert violation(replace(fine, stray=LIMITS.readback), LIMITS, 0) is None
    d = violation(replace(fine, stray=0.06), LIMITS, 0)
    assert (d.what, d.number, d.limit, d.unit) == ("readback", 0.06, pytest.approx(0.05), "V")
    assert "0.06 V away from what was commanded; allowed 0.05" in d.reason


def test_a_converter_that_holds_more_than_it_was_told_ends_the_run():
    bench = Bench().running()
    bench.write()
    bench.tick()
    bench.device.spoil = lambda b: replace(b, values=b.values + np.array([0.1, 0.0]))
    with pytest.raises(GateError, match="away from what was commanded"):
        bench.ticks(2)
    assert bench.gate.state is State.FAULT
    assert not bench.device.live


def test_a_read_without_samples_does_not_make_a_stray_output_good():
    bench = Bench()
    bench.device.spoil = lambda b: replace(b, values=b.values + np.array([0.1, 0.0]))
    bench.tick()
    bench.tick(0.0)
    with pytest.raises(GateError, match="away from what was commanded"):
        bench.gate.arm(bench.device.now())


def test_after_a_stop_nothing_is_expected_any_more():
    bench = Bench().running()
    bench.write(1.0, 30)
    bench.gate.stop("enough", bench.device.now())
    bench.ticks(3)
    bench.next = None
    bench.running()
    bench.ticks(2)
    assert bench.gate.state is State.RUNNING


# Monitors: what has limits and no place in the chain

MONITORED = """
[[monitor]]
name = "p_supply"
unit = "bar"
usual = 70.0
low = 0.0
high = 160.0

[[limit]]
channel = "p_supply"
unit = "bar"
min = 50.0
max = 100.0
max_rate = 400.0
reason = "the pump's relief valve opens at 105 bar; below 50 bar the valve is slow"
"""


def monitored(text: str = MONITORED) -> Rig:
    from fake_device import RIG

    return parse(Rig, RIG + text, "fake rig")


CHANNELS = (*FakeDevice.channels, Channel("p_supply", "bar", "monitor"))


def with_pressure(*bar):
    limits = gate_limits(monitored(), "v", 4.0, "theta")
    n = len(bar)
    values = np.column_stack([np.zeros((n, 2)), bar])
    sequence = np.arange(n)
    flags = np.zeros((n, 3), np.uint8)
    flags[np.isnan(values)] = Quality.MISSING
    b = SampleBlock(CHANNELS, sequence * 100_000_000, sequence, values, flags)
    latest = observe(Latest.nothing(3), b, np.arange(3), (0, 1, 2), 0)
    latest = replace(latest, good=(0, 0, 0), offset=0)
    return violation(latest, limits, 0)


def test_a_monitors_limits_are_judged_with_unit_and_reason():
    assert with_pressure(70.0) is None
    assert with_pressure(50.0, 100.0, 60.0).what == "rate"
    assert with_pressure(50.0) is None
    assert with_pressure(100.0) is None
    d = with_pressure(70.0, 49.0)
    assert (d.what, d.number, d.limit, d.unit) == ("least", 49.0, 50.0, "bar")
    assert "p_supply at 49 bar is under 50 bar (the pump's relief valve" in d.reason
    assert with_pressure(101.0).what == "limit"
    assert with_pressure(70.0, math.nan) is None


def test_a_rig_with_monitors_holds_its_devices_to_them():
    limits = gate_limits(monitored(), "v", 4.0, "theta")
    assert [c.channel for c in limits.channels] == ["v", "theta", "p_supply"]
    assert (limits.channels[2].min, limits.channels[2].max) == (50.0, 100.0)
    assert limits.channels[1].min == -math.inf
    unlimited = monitored(MONITORED[: MONITORED.index("[[limit]]")])
    assert len(gate_limits(unlimited, "v", 4.0, "theta").channels) == 2


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("usual = 70.0", "usual = 200.0", "expected them to rise"),
        ("min = 50.0", "min = 120.0", "expected min below max"),
        ('name = "p_supply"', 'name = "theta"', "has that name"),
        ('unit = "bar"\nmin', 'unit = "mm"\nmin', "expected 'bar'"),
        ('channel = "p_supply"\nunit = "bar"', 'channel = "theta"\nunit = "rad"', "only a monitor"),
    ],
)
def test_limits_that_contradict_are_one_line(old, new, said):
    assert old in MONITORED
    with pytest.raises(InputError, match=said) as caught:
        monitored(MONITORED.replace(old, new))
    assert "\n" not in str(caught.value)


def test_the_simulated_rig_shows_a_monitors_usual_value():
    from samii_rig.devices.opening import open_device

    device = open_device(monitored(), {"seed": 1})
    device.clock.sleep(0.1)
    block = device.sensor.read()
    assert [c.role for c in block.channels][-1] == "monitor"
    assert (block.values[:, -1] == 70.0).all()
    assert not block.quality[:, -1].any()
