"""A whole run with a force/torque sensor on CAN: the moment's response is that of the rig itself,
and what is not known of the clocks is in its covariance."""

import json

import numpy as np
import pytest
from can_kit import CanWire, moment_rig
from experiment_kit import SHORT
from wait_kit import patient

from samii_rig.record.reader import read_events
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device
from samii_rig.run.campaign import carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.order import RunOrder

SLOW = SHORT.model_copy(update={"name": "slow", "low_hz": 3.0, "high_hz": 16.0})


def test_the_moment_over_can_is_that_of_the_rig_in_this_process(tmp_path, monkeypatch):
    file = moment_rig(tmp_path, deadman=0.4)
    rig = patient(load_rig(str(file))[0], 0.4)
    plan = SLOW.plan(rig)

    def done(own, name, settings):
        # Every try is a rig of its own: a FAULT of the last one is not cleared, but left behind.
        monkeypatch.setenv("SAMII_RIG_STATE", str(tmp_path / f"state_{name}"))
        path = tmp_path / f"{name}.mcap"
        return carry_out(RunOrder(own, "", "", plan, predict(plan, own), settings), path)

    # So long a gap that a loaded machine loses nothing; what it misses shows in the scatter.
    wire = CanWire("--seed", "3", "--drift", "80", rig=str(file))
    wire.settings["ft"]["gap"] = 0.15
    device = Device(driver="composite", settings=wire.settings)
    wired_rig = rig.model_copy(update={"device": device})
    try:
        wire.rest()
        wired = done(wired_rig, "wire", {})
    finally:
        wire.close()
    assert (wired.stop.status, wired.trouble) == ("completed", ""), wired.stop.reason
    inside = done(rig.model_copy(update={"device": Device()}), "inside", {"seed": 4})
    (a,), (b,) = wired.responses, inside.responses
    i = [c.name for c in a.outputs].index("M_2")
    ratio = a.H[:, i, 0] / b.H[:, i, 0]
    late = np.angle(ratio) / (2 * np.pi * a.frequency)
    notes = wired.recording.metadata
    ((clock, sigma),) = json.loads(notes["device_timing"]).values()
    assert clock == "ft"
    assert notes["device_ft_device"] == "force_torque"
    # What is said of the clocks holds, and the covariance has it.
    assert 2e-5 < sigma < 5e-3
    assert np.abs(np.median(late)) < 4 * sigma + 1e-3
    least = (2 * np.pi * a.frequency * sigma * np.abs(a.H[:, i, 0])) ** 2
    assert (a.variance()[:, i, 0] >= least).all()
    # In units of the standard deviation of the difference, squared.
    apart = (np.abs(a.H - b.H) ** 2 / (a.variance() + b.variance()))[:, :, 0]
    assert np.median(np.delete(apart, i, axis=1)) < 1.5
    # Of the moment, three sigma of its clock among them.
    assert np.median(apart[:, i]) < 12.0
    told = [e for e in read_events(wired.path) if e.name == "clock"]
    assert told
    assert told[0].payload["device"] == "ft"
    assert told[0].payload["sigma"] == pytest.approx(sigma, rel=0.9)
