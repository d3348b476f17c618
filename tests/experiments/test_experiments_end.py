"""Shipped experiments on the simulated rig end at zero volts when stopped and when tripped."""

from __future__ import annotations

import numpy as np
import pytest
from loop_kit import Memory, after

from samii_rig.devices.opening import open_device
from samii_rig.rig.load import load_rig
from samii_rig.run.client import Client
from samii_rig.run.dryrun import predict
from samii_rig.run.experiments import load_experiment
from samii_rig.run.loop import run
from samii_rig.run.setups import setups_of

EXPERIMENTS = [
    ("samii", "stepped_sine"),
    ("samii", "mode_scan"),
    ("samii_joint_3", "swept_sine"),
    ("samii_braced", "swept_sine"),
    ("samii_torque_vertical", "torque_test"),
    ("samii_torque_horizontal", "torque_test"),
]


@pytest.fixture(scope="module", params=EXPERIMENTS, ids=lambda x: " on ".join(reversed(x)))
def planned(request):
    rig_name, name = request.param
    rig, text = load_rig(rig_name)
    experiment, _ = load_experiment(name, rig)
    rig = setups_of(experiment, rig, text)[0].rig
    return rig, experiment.plan(rig)


def go(planned, settings, **how):
    rig, plan = planned
    device, sink = open_device(rig, {"seed": 1, **settings}), Memory()
    stop = run(plan, rig, device, sink, **how)
    v = sink.column(plan.actuator)
    assert np.abs(v).max() > 0.0, "it never moved"
    assert v[-1] == 0.0
    device.clock.sleep(1.0)
    assert not device.sensor.read().values[:, 2].any()
    return stop, sink


def test_the_shipped_plan_keeps_every_limit(planned):
    rig, plan = planned
    predicted = predict(plan, rig)
    predicted.refuse()
    assert predicted.margins[0].margin > 0.1


def test_stopped_in_the_middle_it_ends_at_zero(planned):
    stop, _ = go(planned, {}, client=Client(stop=after(4.0)))
    assert (stop.status, stop.reason) == ("stopped", "stopped on request")


def test_tripped_it_ends_at_zero(planned):
    """The centring sensor stands still while the output moves: the gate sees it."""
    rig, plan = planned
    stop, sink = go(planned, {"stuck": {plan.centring_sensor: 4.0}})
    assert stop.status == "tripped"
    assert f"{plan.centring_sensor} is stuck" in stop.reason
    assert sink.column("sequence")[-1] < 8 * rig.rate_hz
