"""The simulated device keeps what the Protocols promise: loop, limits, deadman, timing."""

import numpy as np
import pytest

from samii_rig.devices.protocols import Actuator, Clock, CommandBlock, DeviceLoop, OpenRig, Sensor
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.types import Quality
from sim.rig import open_rig

RATE = 500.0
BAND = 200.0  # Hz; few modes, so that opening is quick
FREE = DeviceLoop("theta_2", 0.0, 10.0, 1e9, 1e9)
U, REF, V, THETA = 0, 1, 2, 3


@pytest.fixture
def rig():
    return load_rig("samii")[0]


def opened(rig, loop=FREE, **settings) -> OpenRig:
    device = open_rig(rig, {"noise": False, "band_hz": BAND, **settings})
    device.actuator.configure(loop)
    return device


def drive(device, u, theta_ref=None, first=0, then=0.0):
    u = np.asarray(u, dtype=float)
    ref = np.zeros_like(u) if theta_ref is None else np.asarray(theta_ref, dtype=float)
    device.actuator.write(CommandBlock(first, u, ref))
    device.clock.sleep(u.size / RATE + then)
    return device.sensor.read()


def test_it_is_what_the_protocols_name(rig):
    device = opened(rig)
    assert isinstance(device.actuator, Actuator)
    assert isinstance(device.sensor, Sensor)
    assert isinstance(device.clock, Clock)
    names = [c.name for c in device.sensor.channels]
    assert names == ["u", "theta_ref", "v_2", "theta_2", "a_0", "a_1", "a_2"]
    assert [c.role for c in device.sensor.channels] == ["reference"] * 2 + ["command"] + [
        "sensor"
    ] * 4
    assert device.actuator.deadman == 0.05


def test_samples_come_one_a_period_on_the_devices_clock(rig):
    device = opened(rig)
    assert len(device.sensor.read()) == 0
    device.clock.sleep(0.0101)
    first = device.sensor.read()
    device.clock.sleep(0.0101)
    second = device.sensor.read()
    sequence = np.concatenate([first.sequence, second.sequence])
    assert list(sequence) == list(range(11))
    np.testing.assert_array_equal(np.concatenate([first.time, second.time]), sequence * 2_000_000)
    assert device.clock.now() == 20_200_000


def test_what_is_split_over_many_sleeps_is_the_same_run(rig):
    u = np.sin(0.3 * np.arange(600))
    whole = drive(opened(rig, seed=1, noise=True, disturbance_rms=0.2), u)
    device = opened(rig, seed=1, noise=True, disturbance_rms=0.2)
    device.actuator.write(CommandBlock(0, u, np.zeros(600)))
    parts = []
    for _ in range(100):
        device.clock.sleep(6 / RATE)
        parts.append(device.sensor.read().values)
    np.testing.assert_array_equal(np.concatenate(parts), whole.values)


def test_the_seed_decides_the_noise(rig):
    u = np.zeros(100)
    one, same, other = (drive(opened(rig, noise=True, seed=s), u).values for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.all(np.std(one - other, axis=0)[THETA:] > 0)


def test_the_loop_is_u_plus_kp_times_the_measured_error(rig):
    device = opened(rig, DeviceLoop("theta_2", 4.0, 10.0, 1e9, 1e9), noise=True)
    n = np.arange(500)
    block = drive(device, np.sin(0.1 * n), 0.05 * np.sin(0.02 * n))
    v = block.values[:, U] + 4.0 * (block.values[:, REF] - block.values[:, THETA])
    step = rig.actuator[0].resolution
    np.testing.assert_allclose(block.values[:, V], v, atol=0.5001 * step)
    assert not block.quality[:, V].any()


def test_the_output_changes_after_the_sample_that_it_is_stamped_with(rig):
    u = np.zeros(20)
    u[5] = 1.0
    values = drive(opened(rig), u).values
    assert values[5, V] == pytest.approx(1.0, abs=2e-4)
    assert np.all(values[:6, THETA] == 0.0)
    assert values[6, THETA] > 0.0


def test_output_and_its_rate_keep_their_limits_and_say_so(rig):
    loop = DeviceLoop("theta_2", 0.0, 2.0, 100.0, 1e9)
    block = drive(opened(rig, loop), [3.0] * 30 + [0.5] * 30)
    v = block.values[:, V]
    assert np.max(np.abs(np.diff(v, prepend=0.0))) <= 100.0 / RATE + 1e-9
    assert np.max(v) <= 2.0
    limited = block.quality[:, V] == Quality.LIMITED
    np.testing.assert_array_equal(limited, np.abs(v - block.values[:, U]) > 2e-4)


def test_too_large_an_angle_drops_to_zero_until_configured_again(rig):
    loop = DeviceLoop("theta_2", 0.0, 5.0, 1e9, 0.02)
    device = opened(rig, loop)
    block = drive(device, np.full(200, 2.0))
    over = int(np.argmax(np.abs(block.values[:, THETA]) > 0.02))
    assert 0 < over < 199
    assert np.all(block.values[:over, V] != 0.0)
    assert np.all(block.values[over:, V] == 0.0)
    assert np.all(block.quality[over:, V] == Quality.LIMITED)
    assert np.all(drive(device, np.full(10, 2.0), first=200).values[:, V] == 0.0)
    device.actuator.configure(FREE)
    assert np.all(drive(device, np.full(10, 2.0), first=210).values[:, V] != 0.0)


def test_the_deadman_drops_to_zero_when_the_queue_stays_dry(rig):
    device = opened(rig, DeviceLoop("theta_2", 4.0, 5.0, 1e9, 1e9))
    block = drive(device, np.full(50, 1.0), np.full(50, 0.1), then=0.2)
    patience = int(0.05 * RATE)
    dry = block.values[50 : 50 + patience]
    # Centring goes on to the last theta_ref, without excitation.
    assert np.all(dry[:, U] == 0.0)
    np.testing.assert_allclose(dry[:, V], 4.0 * (0.1 - dry[:, THETA]), atol=2e-4)
    assert np.all(block.values[50 + patience :, V] == 0.0)
    assert np.all(block.quality[50 + patience :, V] == Quality.LIMITED)
    again = drive(device, np.full(5, 1.0), np.full(5, 0.1), first=len(block))
    assert np.all(again.values[:, V] != 0.0)


def test_zero_is_at_once_and_may_be_called_twice(rig):
    device = opened(rig)
    device.actuator.write(CommandBlock(0, np.full(500, 1.0), np.zeros(500)))
    device.clock.sleep(0.1)
    device.actuator.zero()
    device.actuator.zero()
    device.clock.sleep(0.1)
    block = device.sensor.read()
    assert np.all(block.values[:50, V] != 0.0)
    assert np.all(block.values[50:, V] == 0.0)
    device.close()


def test_late_samples_are_ignored_and_later_blocks_win(rig):
    device = opened(rig)
    device.clock.sleep(0.02)
    device.actuator.write(CommandBlock(5, np.full(20, 1.0), np.zeros(20)))
    device.actuator.write(CommandBlock(15, np.full(5, 0.5), np.zeros(5)))
    device.clock.sleep(0.06)
    u = device.sensor.read().values[:, U]
    expected = [0.0] * 10 + [1.0] * 5 + [0.5] * 5 + [1.0] * 5 + [0.0] * 15
    np.testing.assert_array_equal(u, expected)


def test_lost_samples_are_a_jump_in_the_sequence(rig):
    block = drive(opened(rig, drop=[3, 4, 8]), np.zeros(10))
    assert list(block.sequence) == [0, 1, 2, 5, 6, 7, 9]


def test_faults_of_a_sensor(rig):
    u = np.sin(0.2 * np.arange(100))
    block = drive(opened(rig, stuck={"a_0": 0.1}, nan={"a_1": 0.15}), u)
    a_0, a_1 = block.values[:, 4], block.values[:, 5]
    assert np.all(a_0[50:] == a_0[49])
    assert a_0[48] != a_0[49]
    assert np.isfinite(a_1[:75]).all()
    assert np.isnan(a_1[75:]).all()
    assert np.all(block.quality[75:, 5] == Quality.MISSING)


def test_losing_the_centring_sensor_drops_to_zero(rig):
    block = drive(opened(rig, nan={"theta_2": 0.1}), np.ones(100))
    assert np.all(block.values[:50, V] != 0.0)
    assert np.all(block.values[50:, V] == 0.0)


def test_values_beyond_the_converter_are_clipped_and_flagged(rig):
    small = rig.sensor[3].model_copy(update={"low": -2.0, "high": 2.0})
    rig = rig.model_copy(update={"sensor": (*rig.sensor[:3], small)})
    block = drive(opened(rig), 2.0 * np.sin(0.15 * np.arange(1000)))
    a = block.values[:, 6]
    clipped = block.quality[:, 6] == Quality.CLIPPED
    assert clipped.any()
    np.testing.assert_array_equal(clipped, np.abs(a) >= 2.0)
    assert np.max(np.abs(a)) == 2.0


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"sead": 1}, "sead"),
        ({"seed": -1}, "seed"),
        ({"inner": 0}, "inner"),
        ({"noise": "perhaps"}, "noise"),
        ({"hum": {"a_9": {"amplitude": 1.0, "frequency_hz": 50.0}}}, "a_9"),
        ({"hum": {"a_0": {"amplitude": 1.0}}}, "frequency_hz"),
        ({"stuck": {"nobody": 1.0}}, "nobody"),
        ({"disturbance_rms": float("nan")}, "disturbance_rms"),
        ({"band_hz": 0.0}, "band_hz"),
        ({"drop": [-1]}, "drop"),
    ],
)
def test_a_wrong_setting_is_named(rig, settings, named):
    with pytest.raises(InputError, match=named):
        open_rig(rig, settings)


def test_the_rig_files_own_settings_count_and_are_overridden(rig):
    device = rig.device.model_copy(update={"settings": {"seed": 7, "band_hz": BAND}})
    rig = rig.model_copy(update={"device": device})
    assert open_rig(rig, {}).metadata["seed"] == "7"
    assert open_rig(rig, {"seed": 9}).metadata["seed"] == "9"


def test_bad_use_of_the_device_is_refused(rig):
    device = opened(rig)
    with pytest.raises(DeviceError, match="length"):
        device.actuator.write(CommandBlock(0, np.zeros(3), np.zeros(4)))
    with pytest.raises(DeviceError, match="finite"):
        device.actuator.write(CommandBlock(0, np.array([np.nan]), np.zeros(1)))
    with pytest.raises(DeviceError, match="elbow"):
        device.actuator.configure(DeviceLoop("elbow", 1.0, 1.0, 1.0, 1.0))
    with pytest.raises(DeviceError, match="negative"):
        device.actuator.configure(DeviceLoop("theta_2", 1.0, -1.0, 1.0, 1.0))
    drive(device, np.ones(5))
    with pytest.raises(DeviceError, match="not zero"):
        device.actuator.configure(FREE)
