"""Transmission zeros and Bode diagrams.

A relative angle across a source and its spring is zero where the joint stands still: its zeros are
the natural frequencies of the chain with that joint rigid. That, and counts, are the laws here.
"""

import numpy as np
import pytest
from fem_kit import chain, samii, without_springs
from hypothesis import given, settings
from modes_kit import chains

from samii_rig.errors import InputError
from samii_rig.model.bode import bode
from samii_rig.model.modes import natural_frequencies, poles, undamped
from samii_rig.model.tmm import Chain
from samii_rig.model.zeros import zeros
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig


def test_zeros_of_theta_2_are_the_natural_frequencies_with_joint_2_rigid() -> None:
    found = zeros(undamped(samii()), "theta_2", "v_2", 50.0)
    rigid = natural_frequencies(without_springs(samii(), {"joint_2"}), 0.1, 50.0)
    np.testing.assert_allclose(found.hz, rigid.hz, rtol=1e-9)
    np.testing.assert_allclose(found.ratio, 0, atol=1e-9)


def test_resonances_of_theta_2_to_a_0_are_the_zeros_of_theta_2() -> None:
    """Both answers share all poles of the chain, so that the ratio has others (paper 1, Fig. 6)."""
    chain_ = Chain(samii())
    for z in zeros(samii(), "theta_2", "v_2", 12.0).zero[:2]:
        near = chain_.evaluate([z * (1 + 1e-6)])[0, :, 0]
        far = chain_.evaluate([z * 1.05])[0, :, 0]
        assert abs(near[1] / near[0]) > 1e3 * abs(far[1] / far[0])


def test_the_first_zero_from_theta_2_to_a_0() -> None:
    """z_1 of method 1's cost function (paper 1, section IV-C), of the model with Table II."""
    found = zeros(undamped(samii()), "a_0", "theta_2", 30.0)
    on_axis = found.hz[np.abs(found.ratio) < 1e-6]
    assert on_axis[0] == pytest.approx(19.0775, rel=1e-4)
    # s^2 of the acceleration, and s^2 as the beam's end is moved by inertia alone.
    assert found.at_origin == 4
    f = np.linspace(15.0, 23.0, 4001)
    ratio = bode(undamped(samii()), f).over("theta_2").H[:, 0, 0]
    assert f[np.argmin(np.abs(ratio))] == pytest.approx(on_axis[0], abs=2e-3)


def test_zeros_left_and_right_of_the_axis_come_in_mirrored_pairs_without_damping() -> None:
    found = zeros(undamped(samii()), "a_0", "v_2", 30.0)
    real = found.zero[found.zero.imag == 0].real
    assert sorted(np.round(-real, 9)) == sorted(np.round(real, 9))


@pytest.mark.parametrize("name", ["samii", "sflr"])
def test_the_response_vanishes_at_each_zero_and_nowhere_else(name: str) -> None:
    rig, _ = load_rig(name)
    chain_, u = Chain(rig), rig.actuator[0].name
    for i, sensor in enumerate(rig.sensor):
        found = zeros(rig, sensor.name, u, 40.0)
        # A circle around each zero: the phase of H turns once.
        for z in found.zero:
            turn = z + 1e-3 * abs(z) * np.exp(2j * np.pi * np.arange(33) / 32)
            H = chain_.evaluate(turn)[:, i, 0]
            assert np.sum(np.angle(H[1:] / H[:-1])) == pytest.approx(2 * np.pi, abs=1e-6)


@settings(max_examples=6)
@given(chains(damped=True))
def test_an_encoder_at_a_perfect_source_has_no_zero(rig: Rig) -> None:
    """theta/v is K p/(s (s + p)): every zero of the numerator is a pole as well."""
    free = poles(rig, 30.0) if rig.base != "free" and rig.tip != "free" else None
    found = zeros(rig, "y", "v", 30.0)
    assert found.zero.size == 0
    assert found.cancelled == found.found.count
    if free is not None:
        assert found.cancelled >= free.found.count


def test_names_and_bands_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="a sensor of"):
        zeros(samii(), "a_9", "v_2", 30.0)
    with pytest.raises(InputError, match="an actuator or another sensor"):
        zeros(samii(), "a_0", "a_0", 30.0)
    with pytest.raises(InputError, match="above 0 Hz"):
        zeros(samii(), "a_0", "v_2", 0.0)
    with pytest.raises(InputError, match="one of"):
        zeros(samii(), "a_0", "theta_2", 30.0, actuator="v_9")


def test_a_sensor_that_nothing_moves_has_no_zeros() -> None:
    rig = chain(
        ("source", "angular_velocity_source", {"K": 0.5, "p": 150.0}),
        ("l", "rigid_link", {"L": 0.4, "r": 0.2, "m": 0.3, "I": 0.01}),
        sensors=[{"name": "a", "kind": "acceleration", "on": "l", "position": 0.0,
                  "unit": "m/s^2"}],
    )  # fmt: skip
    with pytest.raises(InputError, match="answers to v"):
        zeros(rig, "a", "v", 30.0)


# --- Bode -----------------------------------------------------------------------------------


def test_a_source_is_an_integrator_and_then_a_lag() -> None:
    rig = samii(collocated=True)
    shown = bode(rig, np.geomspace(0.05, 200.0, 300))
    K, p = 0.5, 150.0
    s = 2j * np.pi * shown.frequency_hz
    expected = np.abs(K * p / (s * (s + p)))
    np.testing.assert_allclose(shown.magnitude_db[:, 0, 0], 20 * np.log10(expected), atol=1e-9)
    assert shown.phase_deg[0, 0, 0] == pytest.approx(-90, abs=0.2)
    np.testing.assert_allclose(
        shown.phase_deg[:, 0, 0], -90 - np.degrees(np.arctan(np.abs(s) / p)), atol=1e-9
    )


def test_the_phase_has_no_jump_of_a_turn() -> None:
    shown = bode(samii(), np.linspace(0.3, 150.0, 6000))
    assert np.abs(np.diff(shown.phase_deg, axis=0)).max() < 60
    assert np.abs(shown.phase_deg).max() > 180  # it would have wrapped


def test_a_ratio_of_outputs_and_the_export_keep_names_and_values() -> None:
    shown = bode(samii(), np.linspace(1.0, 10.0, 20))
    over = shown.over("theta_2")
    assert over.outputs == ("a_0", "a_1", "a_2")
    np.testing.assert_allclose(over.H[:, 0, 0], shown.H[:, 1, 0] / shown.H[:, 0, 0])
    frd = shown.to_frd()
    assert list(frd.output_labels) == list(shown.outputs)
    np.testing.assert_allclose(frd(2j * np.pi * 1.0), shown.H[0], rtol=1e-12)
    with pytest.raises(InputError, match="one of"):
        shown.over("a_9")
    with pytest.raises(InputError, match="increasing"):
        bode(samii(), [2.0, 1.0])
