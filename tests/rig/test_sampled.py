"""What the converters see, against transfer functions worked out by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from samii_rig.errors import InputError
from samii_rig.model.sampled import (
    as_sent,
    feedthrough,
    filter_poles,
    filter_residues,
    filter_response,
    given_response,
    hold_response,
    sampled_response,
)
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import AbsoluteAngle, Rig

RATE = 500.0
T = 1 / RATE
K, p = 0.5, 150.0
F = np.array([0.3, 2.0, 17.0, 50.0, 130.0, 249.0])
z = np.exp(2j * np.pi * F * T)
E = np.exp(-p * T)


def number(value, unit):
    return {"value": value, "unit": unit, "source": "test"}


def arm(sensors, delay=0.0):
    """A velocity source on a clamp that swings a rigid arm: theta = K p v/(s (s + p)), exactly."""
    return Rig.model_validate(
        {
            "name": "arm",
            "base": "clamped",
            "tip": "free",
            "rate_hz": RATE,
            "element": [
                {
                    "kind": "angular_velocity_source",
                    "name": "source",
                    "input": "v",
                    "K": number(K, "rad/(s V)"),
                    "p": number(p, "rad/s"),
                },
                {
                    "kind": "rigid_link",
                    "name": "link",
                    "L": number(0.4, "m"),
                    "r": number(0.2, "m"),
                    "m": number(3.0, "kg"),
                    "I": number(0.1, "kg m^2"),
                },
            ],
            "sensor": sensors,
            "actuator": [{"name": "v", "unit": "V", "low": -10, "high": 10, "delay": delay}],
        }
    )


def angle(**more):
    return {"kind": "absolute_angle", "name": "theta", "after": "source", "unit": "rad", **more}


def acceleration(**more):
    return {
        "kind": "acceleration",
        "name": "a",
        "on": "link",
        "position": 0.3,
        "unit": "m/s^2",
        **more,
    }


def test_the_hold_alone_lags_18_degrees_at_50_hz():
    H = hold_response(np.array([50.0]), RATE)
    assert np.angle(H[0], deg=True) == pytest.approx(-18.0)
    assert abs(H[0]) == pytest.approx(np.sin(0.1 * np.pi) / (0.1 * np.pi))


def test_held_source_has_the_z_transform_of_the_textbooks():
    H = sampled_response(arm([angle()]), F)[:, 0, 0]
    exact = K * (T / (z - 1) - (1 - E) / (p * (z - E)))
    np.testing.assert_allclose(H, exact, rtol=2e-5)


def test_an_accelerometer_on_the_source_reads_the_side_before_the_jump():
    rig = arm([acceleration()])
    direct = 0.3 * K * p
    assert feedthrough(Chain(rig))[0, 0] == pytest.approx(direct, rel=1e-6)
    H = sampled_response(rig, F)[:, 0, 0]
    np.testing.assert_allclose(H, direct * (1 / z - (1 - E) / (z - E)), rtol=2e-4)


@given(st.floats(0.0, 3 * T))
@settings(max_examples=30)
def test_a_delay_does_the_same_at_the_output_and_at_the_sensor(delay):
    late_output = sampled_response(arm([angle()], delay), F)
    late_sensor = sampled_response(arm([angle(delay=delay)]), F)
    np.testing.assert_allclose(late_output, late_sensor, rtol=2e-5)


@given(st.floats(1e-5, 3 * T))
@settings(max_examples=30)
def test_a_delay_lags(delay):
    prompt = sampled_response(arm([angle()]), F[:3])[:, 0, 0]
    late = sampled_response(arm([angle(delay=delay)]), F[:3])[:, 0, 0]
    lag = np.angle(late / prompt)
    assert np.all(lag < 0)
    # Aliases bend the line a little; at 17 Hz they are small.
    np.testing.assert_allclose(lag, -2 * np.pi * F[:3] * delay, rtol=0.02, atol=1e-6)


def test_what_was_measured_has_neither_hold_nor_aliases_but_its_delay():
    """The chain's own response, an accelerometer on the source among it, and half the rate too."""
    delay = 0.3 * T
    rig = arm([angle(), acceleration()], delay)
    measured = rig.model_copy(
        update={"actuator": (rig.actuator[0].model_copy(update={"held": False}),)}
    )
    plain = Chain(rig).response(F)[:, :, 0] * np.exp(-2j * np.pi * F * delay)[:, None]
    np.testing.assert_allclose(sampled_response(measured, F)[:, :, 0], plain, rtol=1e-12)
    given = given_response(measured.actuator[0], np.append(0.0, F), RATE)
    np.testing.assert_allclose(given[1:], np.exp(-2j * np.pi * F * delay), rtol=1e-12)
    assert given[0] == 1.0
    np.testing.assert_array_equal(
        given_response(rig.actuator[0], F, RATE), hold_response(F, RATE, delay)
    )


def test_what_is_sent_is_held_whatever_a_recording_has():
    rig = arm([angle()])
    measured = rig.model_copy(
        update={"actuator": (rig.actuator[0].model_copy(update={"held": False}),)}
    )
    assert as_sent(rig) is rig
    assert as_sent(measured) == rig


def test_a_whole_period_of_delay_is_one_sample():
    late = sampled_response(arm([angle()], T), F)
    np.testing.assert_allclose(late, sampled_response(arm([angle()]), F) / z[:, None, None], 2e-5)


@given(st.integers(1, 8), st.floats(20.0, 2000.0), st.floats(0.0, 3.0))
def test_a_sensor_filter_is_the_sum_of_its_residues(order, corner, highpass):
    sensor = AbsoluteAngle.model_validate(
        angle(antialias={"order": order, "corner_hz": corner}, highpass_hz=highpass)
    )
    s = 2j * np.pi * F
    q, r = filter_poles(sensor), filter_residues(sensor)
    total = np.sum(r / (s[:, None] - q), axis=1)
    np.testing.assert_allclose(total, filter_response(sensor, s), rtol=1e-7, atol=1e-9)
    assert np.all(q.real < 0)


def test_the_anti_alias_filter_is_3_db_down_at_its_corner():
    rig, _ = load_rig("samii")
    s = np.array([2j * np.pi * 150.0])
    assert abs(filter_response(rig.sensor[1], s)[0]) == pytest.approx(2**-0.5, rel=1e-6)


@pytest.mark.parametrize("name", ["samii", "sflr"])
def test_far_below_the_rate_the_sampled_rig_is_hold_filter_and_chain(name):
    rig, _ = load_rig(name)
    f = np.array([1.0, 3.0])
    H = sampled_response(rig, f)
    G = Chain(rig).response(f) * hold_response(f, rig.rate_hz)[:, None, None]
    F_s = np.stack([filter_response(x, 2j * np.pi * f) for x in rig.sensor], axis=1)
    np.testing.assert_allclose(H, G * F_s[:, :, None], rtol=1e-3)


@pytest.mark.parametrize("f", [0.0, -1.0, 250.1, np.nan])
def test_a_frequency_that_the_samples_cannot_carry_is_refused(f):
    with pytest.raises(InputError, match="frequency_hz"):
        sampled_response(arm([angle()]), np.array([1.0, f]))
