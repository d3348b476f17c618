"""The simulated rig against what physics and the transfer matrices say, through its samples."""

import numpy as np
import pytest
from sim_physics_kit import LINES, PERIOD, last_period, multisine

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.model.realise import realise
from samii_rig.model.sampled import filter_response, hold_response, sampled_response
from samii_rig.rig.load import load_rig
from sim.plant import tabulate
from sim.rig import open_rig

V = 2


def fine(rig, delay=0.0, sensor_delay=0.0):
    """The rig with an output without steps, and with delays."""
    actuator = rig.actuator[0].model_copy(update={"resolution": 0.0, "delay": delay})
    sensors = tuple(s.model_copy(update={"delay": sensor_delay}) for s in rig.sensor)
    return rig.model_copy(update={"actuator": (actuator,), "sensor": sensors})


def respond(rig, u, kp=0.0, **settings):
    """All samples of an open- or closed-loop run on the reference u."""
    device = open_rig(rig, {"noise": False, **settings})
    sensor = rig.centring.sensor
    device.actuator.configure(DeviceLoop(sensor, kp, 1e9, 1e9, 1e9))
    device.actuator.write(CommandBlock(0, u, np.zeros_like(u)))
    device.clock.sleep(len(u) / rig.rate_hz)
    return device.sensor.read()


@pytest.mark.parametrize("kp_over_rig", [0.0, 1.0])
@pytest.mark.parametrize(("name", "periods", "amplitude"), [("samii", 40, 0.5), ("sflr", 3, 20.0)])
@pytest.mark.parametrize(("delay", "sensor_delay"), [(0.0, 0.0), (0.0013, 0.0031)])
def test_its_response_is_that_of_the_transfer_matrices(
    name, periods, amplitude, kp_over_rig, delay, sensor_delay
):
    # SAMII's first mode takes 42 s to fall by e: 40 periods of 20 s leave nothing of the start.
    rig = fine(load_rig(name)[0], delay, sensor_delay)
    block = respond(rig, multisine(periods, amplitude), kp_over_rig * rig.centring.kp)
    assert not block.quality.any()
    Y = last_period(block.values)
    H = Y[:, V + 1 :] / Y[:, V : V + 1]
    exact = sampled_response(rig, LINES * rig.rate_hz / PERIOD)[:, :, 0]
    ratio = H / exact
    assert np.max(np.abs(np.abs(ratio) - 1)) < 2e-3
    assert np.max(np.abs(np.angle(ratio, deg=True))) < 0.2


def test_a_lag_is_a_negative_phase():
    prompt, late = (fine(load_rig("samii")[0], delay) for delay in (0.0, 0.002))
    u = multisine(2, 0.5)
    a, b = (last_period(respond(rig, u, band_hz=200.0).values)[:, V + 1] for rig in (prompt, late))
    f = LINES * 500.0 / PERIOD
    lag = np.unwrap(np.angle(b / a))
    np.testing.assert_allclose(lag[f > 10], -2 * np.pi * f[f > 10] * 0.002, atol=0.02)


def test_without_noise_inner_steps_change_nothing():
    rig = fine(load_rig("samii")[0], 0.0007, 0.0011)
    u = multisine(1, 0.5)[:2000]
    one, many = (respond(rig, u, 4.0, inner=n, band_hz=200.0).values for n in (1, 7))
    np.testing.assert_allclose(one, many, rtol=0, atol=1e-9)


def test_a_step_is_the_hold_equivalent_of_python_control():
    import control  # here: a fifth of a second for each process that collects the tests

    rig = fine(load_rig("samii")[0])
    made = realise(rig, 200.0)
    A, B, C, D = made.state_space()
    system = control.c2d(control.ss(A, B, C, D), 1 / rig.rate_hz, "zoh")
    u = multisine(1, 0.5)[:300]
    expected = control.forced_response(system, inputs=u).outputs.reshape(4, -1)
    # python-control reads behind the jump of its input, the device before it.
    expected -= D * (u - np.concatenate([[0.0], u[:-1]]))
    got = respond(rig, u, band_hz=200.0).values[:, V + 1 :].T
    np.testing.assert_allclose(got, expected, atol=1e-9 * np.abs(expected).max())


def test_no_mode_grows():
    for name in ("samii", "sflr"):
        decay = tabulate(load_rig(name)[0], realise(load_rig(name)[0], 200.0), 8).decay
        assert np.max(np.hypot(*decay)) <= 1.0


def test_samples_scatter_as_the_rig_file_says():
    rig, _ = load_rig("samii")
    block = respond(rig, np.zeros(60_000), noise=True, seed=3, band_hz=200.0)
    for i, sensor in enumerate(rig.sensor):
        variance = sensor.noise_rms**2 + sensor.resolution**2 / 12
        y = block.values[:, V + 1 + i]
        # 60,000 samples give the variance to 0.6 %.
        assert np.var(y) == pytest.approx(variance, rel=0.03)
        assert abs(np.mean(y)) < 5 * np.sqrt(variance / y.size)
        np.testing.assert_allclose(y / sensor.resolution, np.rint(y / sensor.resolution), atol=1e-6)
    white = np.corrcoef(block.values[1:, V + 1 :].T, block.values[:-1, V + 1 :].T)
    assert np.max(np.abs(white - np.eye(8))) < 0.02


def test_an_offset_is_seen():
    rig, _ = load_rig("samii")
    shifted = rig.sensor[1].model_copy(update={"offset": 0.3})
    rig = rig.model_copy(update={"sensor": (rig.sensor[0], shifted, *rig.sensor[2:])})
    values = respond(rig, np.zeros(2000), noise=True, band_hz=200.0).values
    assert np.mean(values[:, V + 2]) == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize(("tone", "folded"), [(60.0, 60.0), (430.0, 70.0), (1010.0, 10.0)])
def test_a_tone_above_half_the_rate_folds_with_its_own_amplitude(tone, folded):
    rig, _ = load_rig("sflr")
    hum = {"a": {"amplitude": 2.0, "frequency_hz": tone}}
    values = respond(rig, np.zeros(5000), hum=hum, band_hz=200.0).values[:, V + 2]
    spectrum = np.abs(np.fft.rfft(values)) * 2 / values.size
    line = round(folded * values.size / rig.rate_hz)
    assert spectrum[line] == pytest.approx(2.0, rel=1e-6)
    spectrum[line] = 0.0
    assert np.max(spectrum) < 1e-6


def test_an_anti_alias_filter_keeps_a_tone_out():
    rig, _ = load_rig("samii")
    hum = {"a_0": {"amplitude": 2.0, "frequency_hz": 430.0}}
    values = respond(rig, np.zeros(5000), hum=hum, band_hz=200.0).values[:, V + 2]
    passed = abs(filter_response(rig.sensor[1], np.array([2j * np.pi * 430.0]))[0])
    spectrum = np.abs(np.fft.rfft(values)) * 2 / values.size
    assert spectrum[700] == pytest.approx(2.0 * passed, rel=1e-6)
    assert passed < 0.02


def test_the_disturbance_reaches_the_sensors_as_the_command_does():
    rig = fine(load_rig("sflr")[0])
    n = 200_000
    block = respond(rig, np.zeros(n), kp=0.0, disturbance_rms=5.0, seed=2, band_hz=200.0)
    assert np.all(block.values[:, V] == 0.0)
    a = block.values[:, V + 2].reshape(-1, 1000)
    power = np.mean(np.abs(np.fft.rfft(a * np.hanning(1000), axis=1)) ** 2, axis=0)
    f = np.fft.rfftfreq(1000, 1 / rig.rate_hz)
    band = (f >= 8) & (f <= 40)
    # White over a sample: the hold shapes v but not a disturbance of many steps a sample.
    H = sampled_response(rig, f[band])[:, 1, 0] / hold_response(f[band], rig.rate_hz)
    expected = 25.0 * np.abs(H) ** 2 * np.sum(np.hanning(1000) ** 2)
    assert np.mean(power[band] / expected) == pytest.approx(1.0, abs=0.05)


def test_dry_friction_holds_the_drive_still_below_its_level():
    rig = fine(load_rig("samii")[0])
    u = np.sin(2 * np.pi * 2.0 * np.arange(4000) / 500.0)
    still = respond(rig, 0.2 * u, coulomb_friction=0.25, band_hz=200.0)
    assert np.all(still.values[:, V + 1 :] == 0.0)


def test_dry_friction_matters_less_at_a_higher_level():
    rig = fine(load_rig("samii")[0])
    n = np.arange(10_000)
    gains = []
    for level in (0.5, 1.0, 2.0, 4.0):
        u = level * np.sin(2 * np.pi * 2.0 * n / 500.0)
        theta = respond(rig, u, coulomb_friction=0.25, band_hz=200.0).values[-5000:, V + 1]
        line = np.fft.rfft(theta)[20] / np.fft.rfft(u[-5000:])[20]
        gains.append(abs(line / sampled_response(rig, np.array([2.0]))[0, 0, 0]))
    assert np.all(np.diff(gains) > 0)
    assert gains[0] < 0.7
    assert gains[-1] > 0.9


def test_half_an_hour_of_rest_stays_at_rest():
    values = respond(load_rig("samii")[0], np.zeros(900_000), band_hz=200.0, inner=1).values
    assert np.all(values == 0.0)
