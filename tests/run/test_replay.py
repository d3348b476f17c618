"""A recording as a device: the same run gives the same samples and the same responses again."""

import time
from dataclasses import replace

import numpy as np
import pytest
from experiment_kit import SHORT

from drivers.replay import open_rig
from samii_rig.devices.opening import open_device
from samii_rig.devices.protocols import Actuator, Clock, CommandBlock, DeviceLoop, Sensor
from samii_rig.errors import DeviceError, InputError
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device
from samii_rig.run.campaign import carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.order import RunOrder

RIG = load_rig("samii")[0]
LOOP = DeviceLoop("theta_2", 4.0, 5.0, 2000.0, 0.35)


def done(rig, path, experiment=SHORT, **settings):
    plan = experiment.plan(rig)
    return carry_out(RunOrder(rig, "", "", plan, predict(plan, rig), settings), path)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    return done(RIG, tmp_path_factory.mktemp("first") / "first.mcap", seed=3)


@pytest.fixture
def rig(first):
    device = Device(driver="replay", settings={"recording": str(first.path)})
    return RIG.model_copy(update={"device": device})


def test_a_run_that_is_replayed_gives_the_same_again(first, rig, tmp_path):
    again = done(rig, tmp_path / "again.mcap")
    assert again.stop.status == "completed", again.stop.reason
    assert again.stop.missing_samples == 0
    a, b = first.recording.segments[0], again.recording.segments[0]
    assert a.stop - a.start == b.stop - b.start
    old, new = first.recording.cut(a), again.recording.cut(b)
    np.testing.assert_array_equal(old.values, new.values)
    np.testing.assert_array_equal(np.diff(old.time), np.diff(new.time))
    np.testing.assert_array_equal(first.responses[0].H, again.responses[0].H)
    np.testing.assert_array_equal(first.responses[0].covariance, again.responses[0].covariance)
    assert again.recording.metadata["device_replayed"] == str(first.path)
    # And so does the replay of a replay.
    device = Device(driver="replay", settings={"recording": str(again.path)})
    third = done(RIG.model_copy(update={"device": device}), tmp_path / "third.mcap")
    np.testing.assert_array_equal(first.responses[0].H, third.responses[0].H)


def test_a_run_of_two_outputs_is_replayed_too(tmp_path):
    rig = load_rig("samii_two_joints")[0]
    both = SHORT.model_copy(update={"beside": ("v_3",), "realisations": 2, "amplitudes": (0.2,)})
    first = done(rig, tmp_path / "first.mcap", both, seed=3)
    assert first.trouble == ""
    device = Device(driver="replay", settings={"recording": str(first.path)})
    again = done(rig.model_copy(update={"device": device}), tmp_path / "again.mcap", both)
    assert again.stop.status == "completed", again.stop.reason
    for old, new in zip(first.recording.segments, again.recording.segments, strict=True):
        np.testing.assert_array_equal(
            first.recording.cut(old).values, again.recording.cut(new).values
        )
    np.testing.assert_array_equal(first.responses[0].H, again.responses[0].H)
    # A sample of another command on the second output alone is seen.
    other = both.model_copy(update={"seed": 2})
    ended = done(rig.model_copy(update={"device": device}), tmp_path / "other.mcap", other)
    assert ended.stop.status == "tripped"


def test_another_experiment_on_it_is_ended_by_the_gate(rig, tmp_path):
    other = SHORT.model_copy(update={"seed": 2})
    ended = done(rig, tmp_path / "other.mcap", other)
    assert ended.stop.status == "tripped"
    assert "v_2" in ended.stop.reason


def test_a_longer_experiment_ends_with_the_recording(rig, tmp_path):
    longer = SHORT.model_copy(update={"periods": 9})
    ended = done(rig, tmp_path / "longer.mcap", longer)
    assert ended.stop.status in ("failed", "tripped")


def test_it_keeps_the_protocols_and_what_it_is_told_goes_nowhere(first, rig):
    device = open_device(rig, {})
    assert isinstance(device.actuator, Actuator)
    assert isinstance(device.sensor, Sensor)
    assert isinstance(device.clock, Clock)
    assert device.actuator.deadman == RIG.actuator[0].deadman
    device.actuator.configure(LOOP)
    device.clock.sleep(0.1)
    block = device.sensor.read()
    assert 40 < len(block) < 60
    newest = int(block.sequence[-1])
    device.actuator.write(CommandBlock(newest + 11, np.full(5, 3.0), np.zeros(5)))
    with pytest.raises(DeviceError, match="during the replay"):
        device.actuator.configure(LOOP)
    device.clock.sleep(0.04)
    more = device.sensor.read()
    # The ten samples before the plan, then the plan: its first sample is the one that was told.
    assert more.sequence[0] == newest + 1
    assert (np.diff(more.time) == 2_000_000).all()
    assert more.time[0] - block.time[-1] == 2_000_000
    u = more.values[:, 0]
    start = int(np.flatnonzero(more.sequence == newest + 11)[0])
    recorded = first.recording
    plan = recorded.segments[0].start - (SHORT.plan(RIG).segments[0].recorded or (0, 0))[0]
    at = int(np.searchsorted(recorded.sequence, plan))
    np.testing.assert_array_equal(u[start:], recorded.values[at : at + len(u) - start, 0])
    device.actuator.zero()
    device.actuator.zero()
    device.clock.sleep(0.1)
    after = device.sensor.read()
    assert not after.values[:, 2].any()
    assert after.sequence[0] > more.sequence[-1] + 1
    assert after.time[0] - more.time[-1] == 2_000_000
    device.close()


def test_after_its_last_sample_it_says_so(rig):
    device = open_device(rig, {})
    device.clock.sleep(0.1)
    newest = int(device.sensor.read().sequence[-1])
    device.actuator.write(CommandBlock(newest + 11, np.zeros(5), np.zeros(5)))
    device.clock.sleep(100.0)
    assert len(device.sensor.read())
    with pytest.raises(DeviceError, match="the recording has ended"):
        device.sensor.read()


def test_at_real_pace_it_takes_its_time(rig):
    start = time.monotonic()
    device = open_device(rig, {"pace": "real"})
    device.clock.sleep(0.2)
    n = len(device.sensor.read())
    passed = time.monotonic() - start
    assert 0.2 * 500 - 1 <= n <= passed * 500 + 1


def test_a_run_that_waits_longer_than_the_recorded_one_is_told(rig):
    device = open_device(rig, {})
    newest = int(device.sensor.read().sequence[-1])
    with pytest.raises(DeviceError, match="samples too late before its plan"):
        device.actuator.write(CommandBlock(newest + 5000, np.zeros(5), np.zeros(5)))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"recording": "nowhere.mcap"}, "recording is 'nowhere.mcap'; expected the path"),
        ({"recording": ""}, "recording is ''"),
        ({"pace": "slow"}, "pace is 'slow'; expected recording, a path, and pace, real or fast"),
        ({"colour": 1}, "colour is 1"),
    ],
)
def test_a_wrong_setting_is_one_line(rig, changes, said):
    with pytest.raises(InputError, match=said) as caught:
        open_device(rig, changes)
    assert "\n" not in str(caught.value)


def test_a_recording_of_another_rig_is_refused(first, rig, tmp_path):
    with pytest.raises(InputError, match=r"rate_hz is 500\.0; expected 400"):
        open_device(rig.model_copy(update={"rate_hz": 400.0}), {})
    other = rig.sensor[0].model_copy(update={"name": "theta_9"})
    with pytest.raises(InputError, match="expected theta_9 in rad, a channel of SAMII"):
        open_device(rig.model_copy(update={"sensor": (other, *rig.sensor[1:])}), {})
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(first.path.read_bytes()[:5000])
    with pytest.raises(InputError, match=r"device\.settings\.recording"):
        open_device(rig, {"recording": str(bad)})


def test_a_recording_without_a_plan_is_refused(first, rig, monkeypatch):
    monkeypatch.setattr("drivers.replay.read_events", lambda _: [])
    with pytest.raises(InputError, match="holds no plan"):
        open_rig(rig, rig.device.settings)


def test_what_the_recording_says_of_its_clocks_goes_on(first, rig, monkeypatch):
    told = replace(first.recording, metadata={"device_timing": '{"a_0": ["ft", 1e-3]}'})
    assert read_recording(first.path).metadata.get("device_timing") is None
    monkeypatch.setattr("drivers.replay.read_recording", lambda _: told)
    assert open_rig(rig, rig.device.settings).metadata["timing"] == '{"a_0": ["ft", 1e-3]}'
