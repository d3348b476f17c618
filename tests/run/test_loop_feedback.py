"""Feedback loops and what goes wrong with them: a device that has no filters, a sensor that is
lost, clipped or late, loops that together ask for too much. All of it ends at zero volts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contract import DeviceContract
from fake_device import FakeDevice, fake_rig
from feedback_kit import BAND, LOOP, Memory, V, plan_for, rig_with
from loop_kit import plan as fake_plan

from samii_rig.devices.protocols import DeviceLoop, OpenRig
from samii_rig.errors import DeviceError, LimitError
from samii_rig.rig.schema import Feedback
from samii_rig.run.dryrun import predict
from samii_rig.run.loop import run
from samii_rig.safety.judgement import violation
from samii_rig.safety.latest import Latest
from samii_rig.safety.limits import gate_limits
from samii_rig.types import Quality
from sim.rig import open_rig

FAKE = fake_rig()
FROM_THETA = Feedback(
    name="lag", sensor="theta", actuator="v", gain=1.0, unit="V/(rad)", poles=(-5.0,), max=0.5
)


class Plain(FakeDevice):
    """A device without filters, which says so."""

    def configure(self, loop: DeviceLoop) -> None:
        if loop.feedback:
            raise DeviceError("v: no feedback filters in this device")
        if loop.sensor != "theta":
            raise DeviceError(f"v: no sensor {loop.sensor}")
        super().configure(loop)


def test_a_device_without_filters_ends_a_run_that_asks_for_them_before_it_moves():
    rig = FAKE.model_copy(update={"feedback": (FROM_THETA,)})
    device, sink = Plain(), Memory()
    stop = run(fake_plan(), rig, device.open(), sink)
    assert stop.status in ("failed", "tripped")
    assert "no feedback filters" in stop.reason
    assert device.written == []
    assert not device.live
    assert run(fake_plan(), FAKE, Plain().open(), Memory()).status == "completed"


OF_A_REFUSAL = (
    "test_it_runs_a_feedback_or_refuses_it",
    "test_it_refuses_a_feedback_of_a_sensor_that_it_does_not_have",
)


class Kit(DeviceContract):
    """The kit on a fake device; not collected."""

    rig = FAKE
    __test__ = False

    def __init__(self, device: FakeDevice) -> None:
        self.device = device

    def open(self) -> OpenRig:
        return self.device.open()


def kit(device: FakeDevice, test: str) -> None:
    from contract import Bench

    kit_ = Kit(device)
    getattr(kit_, test)(Bench(FAKE, kit_.open(), kit_.level))


@pytest.mark.parametrize("test", OF_A_REFUSAL)
def test_the_kit_takes_a_device_that_refuses_feedback(test):
    kit(Plain(), test)


@pytest.mark.parametrize("test", OF_A_REFUSAL)
def test_the_kit_finds_a_device_that_takes_a_feedback_and_does_not_run_it(test):
    class Deaf(FakeDevice):
        def configure(self, loop: DeviceLoop) -> None:
            super().configure(replace(loop, feedback=()))

    with pytest.raises(AssertionError):
        kit(Deaf(), test)


# The sensor


def go(rig, device, level=0.5, **how):
    sink = Memory()
    stop = run(plan_for(level), rig, device, sink, **how)
    assert np.abs(sink.values()[:, V]).max() > 0.0, "it never moved"
    assert sink.values()[-1, V] == 0.0
    device.clock.sleep(1.0)
    assert not device.sensor.read().values[:, V].any()
    return stop, sink


def spoiled(rig, change, at=600):
    """The simulated rig whose samples from number `at` on are changed on their way."""
    device = open_rig(rig, {"seed": 1, "band_hz": BAND})
    inner = device.sensor

    class Sensor:
        channels = inner.channels

        def read(self):
            block = inner.read()
            rows = np.flatnonzero(block.sequence >= at)
            return change(block, rows) if len(rows) else block

    return replace(device, sensor=Sensor())


A_0 = 4


def flagged(flag, value=None):
    def change(block, rows):
        block.quality[rows, A_0] = flag
        if value is not None:
            block.values[rows, A_0] = value
        return block

    return change


def nan(block, rows):
    block.values[rows[:1], A_0] = np.nan
    return block


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (flagged(Quality.CLIPPED), "a_0 is at the end of its range"),
        (flagged(Quality.STALE), "a_0 said nothing new"),
        (flagged(Quality.MISSING, np.nan), "a_0 said nothing new"),
        (nan, "a_0 gave a value that is not a number"),
    ],
)
def test_a_feedbacks_sensor_that_is_lost_on_the_way_trips_the_run(change, said):
    rig = rig_with().model_copy(
        update={"limit": tuple(x for x in rig_with().limit if x.channel != "a_0")}
    )
    stop, sink = go(rig, spoiled(rig, change))
    assert stop.status == "tripped"
    assert said in stop.reason
    within = rig.sensor[1].stale_after + 0.15
    assert sink.blocks[-1].sequence[-1] < 600 + within * 500 + 60
    # Without the feedback nothing reads it, and nobody minds.
    bare = rig.model_copy(update={"feedback": ()})
    assert go(bare, spoiled(bare, change))[0].status == "completed"


def test_a_feedbacks_sensor_at_the_end_of_its_range_trips_the_run():
    """The converter itself clips: until the gate sees the flag the loop keeps its `max`."""
    narrow = [
        s.model_copy(update={"low": -0.3, "high": 0.3}) if s.name == "a_0" else s
        for s in rig_with().sensor
    ]
    rig = rig_with().model_copy(update={"sensor": tuple(narrow)})
    with pytest.raises(LimitError, match="a_0 would reach"):
        predict(plan_for(), rig).refuse()
    stop, sink = go(rig, open_rig(rig, {"seed": 1, "band_hz": BAND}))
    assert stop.status == "tripped"
    assert "a_0 is at the end of its range" in stop.reason
    assert np.abs(sink.values()[:, V]).max() < 5.0


def test_the_gate_asks_for_a_fresh_feedback_sensor_before_it_arms():
    limits = gate_limits(rig_with(LOOP.replace('"a_0"', '"a_1"')), "v_2", 4.0, "theta_2")
    n = len(limits.channels)
    i = [c.channel for c in limits.channels].index("a_1")
    fine = replace(Latest.nothing(n), good=(0,) * n, time=0, offset=0, last=(0.0,) * n)
    assert violation(fine, limits, 10_000_000) is None
    late = replace(fine, good=tuple(-(10**9) if k == i else 0 for k in range(n)))
    found = violation(late, limits, 10_000_000)
    assert found is not None
    assert (found.what, found.reason[:3]) == ("stale", "a_1")


# Several loops


def several(n, most):
    one = LOOP.replace("max = 2.0", f"max = {most}").replace("1296.0", f"{1296.0 / n}")
    text = "".join(one.replace('"damping"', f'"damping_{i}"') for i in range(n))
    return rig_with(text)


def test_loops_that_may_together_ask_for_more_than_the_limit_are_never_sent_anything():
    """Three of 2 V each over 5 V: each in bounds, the sum not, and no level would do."""
    rig = several(3, 2.0)
    with pytest.raises(LimitError, match=r"v_2 would reach 6.* no level would not"):
        predict(plan_for(level=0.01), rig).refuse()
    device, sink = open_rig(rig, {"seed": 1, "band_hz": BAND}), Memory()
    stop = run(plan_for(level=0.01), rig, device, sink)
    assert stop.status == "tripped"
    assert "v_2 at 6" in stop.reason
    assert not sink.values()[:, V].any()


def test_loops_that_share_the_limit_run_and_add_up():
    both, one = several(2, 1.0), several(1, 2.0)
    predicted = [predict(plan_for(), r) for r in (both, one)]
    np.testing.assert_allclose(predicted[0].peaks, predicted[1].peaks, rtol=1e-6)
    assert {m.channel for m in predicted[0].margins} >= {"damping_0", "damping_1"}
    values = [
        go(r, open_rig(r, {"noise": False, "band_hz": BAND}))[1].values() for r in (both, one)
    ]
    np.testing.assert_allclose(values[0][:, V], values[1][:, V], atol=1e-3)
