"""Loops closed inside the model: two independent counts of what is unstable agree, and the
closed response is that of the simulated device."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.model.feedback import state_space
from samii_rig.model.loops import (
    closed_loop_poles,
    closed_poles,
    closed_response,
    continuous_closed_response,
    loop_gain,
    loops_of,
    sampled_system,
    unstable_count,
)
from samii_rig.model.realise import realise
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Feedback
from sim.rig import open_rig

SAMII = load_rig("samii")[0]
BAND = 200.0
MADE = realise(SAMII, BAND)
W = 2 * np.pi * 0.9


def lowpass(gain, poles=3, sensor="a_0", corner=W):
    return Feedback(
        name="damping",
        sensor=sensor,
        actuator="v_2",
        gain=gain * corner**poles,
        unit="V/(m/s^2)",
        poles=(-corner,) * poles,
        max=4.0,
    )


def with_loop(*feedback, kp=4.0, delay=0.0, sensor_delay=0.0):
    actuator = SAMII.actuator[0].model_copy(update={"delay": delay, "resolution": 0.0})
    sensors = tuple(s.model_copy(update={"delay": sensor_delay}) for s in SAMII.sensor)
    return SAMII.model_copy(
        update={
            "feedback": feedback,
            "centring": SAMII.centring.model_copy(update={"kp": kp}),
            "actuator": (actuator,),
            "sensor": sensors,
        }
    )


@pytest.mark.parametrize(
    ("kp", "gain", "poles"),
    [
        (4.0, 0.0, 1),
        (4.0, 7.4, 3),
        (4.0, -7.4, 3),
        (4.0, 60.0, 3),
        (4.0, -0.6, 1),
        (4.0, -3.0, 1),
        (80.0, 0.0, 1),
        (0.5, 7.4, 2),
        (200.0, 20.0, 2),
    ],
)
@pytest.mark.parametrize("delay", [0.0, 0.0137])
def test_nyquists_count_is_that_of_the_eigenvalues(kp, gain, poles, delay):
    rig = with_loop(lowpass(gain, poles), kp=kp, delay=delay)
    eigenvalues = closed_poles(sampled_system(rig, MADE), loops_of(rig))
    assert unstable_count(rig) == eigenvalues.outside


@pytest.mark.parametrize(
    ("delay", "sensor_delay"), [(0.0, 0.0), (0.0013, 0.0031), (0.002, 0.004), (0.0, 0.0007)]
)
def test_the_sampled_state_space_is_the_sum_over_aliases_with_any_delay(delay, sensor_delay):
    rig = with_loop(delay=delay, sensor_delay=sensor_delay)
    f = np.array([0.03, 0.4, 1.69, 1.71, 7.4, 30.0])
    system = sampled_system(rig, realise(rig))
    exact = sampled_response(rig, f)[:, :, 0]
    np.testing.assert_allclose(system.response(f), exact, rtol=2e-4)


def test_the_closed_response_is_what_the_device_does():
    rig = with_loop(lowpass(7.4))
    device = open_rig(rig, {"noise": False, "band_hz": BAND})
    device.actuator.configure(DeviceLoop("theta_2", 4.0, 10, 1e9, 9, rig.feedback))
    n, lines = 5000, np.arange(3, 300, 9)
    X = np.zeros(n // 2 + 1, complex)
    X[lines] = np.exp(2j * np.pi * np.random.default_rng(1).random(lines.size))
    one = np.fft.irfft(X)
    u = np.tile(one / np.abs(one).max() * 0.5, 6)
    device.actuator.write(CommandBlock(0, u, np.zeros_like(u)))
    device.clock.sleep(u.size / 500.0)
    values = device.sensor.read().values[-n:]
    Y = np.fft.rfft(values, axis=0)[lines]
    H = closed_response(rig, lines * 500.0 / n)[:, :, 0]
    np.testing.assert_allclose(Y[:, 3:] / Y[:, :1], H, rtol=5e-3)


def test_slow_loops_are_the_same_continuous_and_sampled():
    rig = with_loop(lowpass(7.4))
    f = np.array([0.5, 1.0, 1.7, 3.0])
    np.testing.assert_allclose(
        continuous_closed_response(rig, f), closed_response(rig, f), rtol=0.03
    )
    # With the loops open the lag of the hold is the whole difference.
    rig = with_loop(kp=0.0)
    lag = np.exp(-1j * np.pi * f / 500.0)[:, None, None]
    np.testing.assert_allclose(
        continuous_closed_response(rig, f) * lag, closed_response(rig, f), rtol=5e-4
    )


def test_without_loops_nothing_changes():
    rig = with_loop(kp=0.0)
    f = np.array([0.5, 1.7, 7.4])
    np.testing.assert_array_equal(closed_response(rig, f), sampled_response(rig, f))
    assert np.all(loop_gain(rig, f) == 0.0)
    poles = closed_poles(sampled_system(rig, MADE), loops_of(rig))
    mode_1 = MADE.structure.poles[MADE.structure.poles.imag > 0][0]
    assert np.min(np.abs(poles.s - mode_1)) < 1e-6 * abs(mode_1)


def test_a_pole_of_the_closed_loop_makes_its_response_infinite():
    rig = with_loop(lowpass(7.4))
    poles = closed_loop_poles(rig)
    slow = poles.oscillating(15.0)
    assert slow.size >= 2
    system, loops = sampled_system(rig, realise(rig)), loops_of(rig)
    A, B, C, D = state_space(rig.feedback[0], 500.0)
    for s in slow:
        z = np.exp(s / 500.0)
        H = (system.C @ np.linalg.solve(z * np.eye(len(system.A)) - system.A, system.B))[:, 0]
        F = (C @ np.linalg.solve(z * np.eye(len(A)) - A, B) + D)[0, 0]
        assert abs(1 + 4.0 * H[loops.theta] - F * H[1]) < 1e-6


@pytest.mark.parametrize("kp", [0.5, 2.0, 6.0])
def test_centring_alone_puts_a_pole_near_k_kp(kp):
    poles = closed_loop_poles(with_loop(kp=kp), band_hz=BAND)
    real = poles.s[poles.s.imag == 0].real
    assert np.min(np.abs(real + 0.5 * kp)) < 0.05 * kp


def test_a_loop_is_closed_around_what_is_sent_out_which_is_held():
    """Whatever the rig file says of what was recorded."""
    rig = with_loop(lowpass(0.5))
    unheld = {"actuator": (rig.actuator[0].model_copy(update={"held": False}),)}
    f = np.array([0.5, 5.0, 40.0])
    for of in (loop_gain, closed_response):
        np.testing.assert_array_equal(of(rig.model_copy(update=unheld), f), of(rig, f))
