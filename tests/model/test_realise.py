"""Partial fractions of a chain: exact where the chain is rational, close where it is not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from samii_rig.model.damping import CausalChain, fit_loss, relaxed_beams
from samii_rig.model.poles import find_poles
from samii_rig.model.realise import realise, search_region
from samii_rig.model.sampled import sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Beam, Rig

F = np.geomspace(0.05, 249.0, 300)


def number(value, unit):
    return {"value": value, "unit": unit, "source": "test"}


def spring_arm(k=80.0, c=0.6, p=60.0, base="clamped", **sensor):
    """Source, spring and rigid arm: rational, k + c s + (I + m r^2) s^2 below the line."""
    return Rig.model_validate(
        {
            "name": "arm",
            "base": base,
            "tip": "free",
            "rate_hz": 500.0,
            "element": [
                {
                    "kind": "angular_velocity_source",
                    "name": "source",
                    "input": "v",
                    "K": number(2.0, "rad/(s V)"),
                    "p": number(p, "rad/s"),
                },
                {
                    "kind": "torsional_spring",
                    "name": "spring",
                    "k": number(k, "N m/rad"),
                    "c": number(c, "N m s/rad"),
                },
                {
                    "kind": "rigid_link",
                    "name": "link",
                    "L": number(0.5, "m"),
                    "r": number(0.2, "m"),
                    "m": number(2.0, "kg"),
                    "I": number(0.05, "kg m^2"),
                },
            ],
            "sensor": [
                {
                    "kind": "relative_angle",
                    "name": "theta",
                    "across": ["source", "spring"],
                    "unit": "rad",
                },
                {
                    "kind": "acceleration",
                    "name": "a",
                    "on": "link",
                    "position": 0.5,
                    "unit": "m/s^2",
                    **sensor,
                },
            ],
            "actuator": [{"name": "v", "unit": "V", "low": -10, "high": 10}],
        }
    )


def lossy(name, eta):
    rig, _ = load_rig(name)
    elements = tuple(
        e.model_copy(update={"eta": e.eta.model_copy(update={"value": eta})})
        if isinstance(e, Beam)
        else e
        for e in rig.element
    )
    return rig.model_copy(update={"element": elements})


def seen(rig, chain):
    return chain.response(F) * sensor_response(rig.sensor, F)[:, :, None]


@given(
    st.floats(1.0, 1e4),
    st.floats(0.0, 3.0),
    st.floats(20.0, 500.0),
    st.integers(1, 6),
    st.floats(40.0, 300.0),
)
@settings(max_examples=15)
def test_a_rational_chain_is_realised_exactly(k, c, p, order, corner):
    rig = spring_arm(k, c, p, antialias={"order": order, "corner_hz": corner}, highpass_hz=0.1)
    made = realise(rig)
    inertia = 0.05 + 2.0 * 0.2**2
    own = np.roots([inertia, c, k])
    assert made.structure.count == np.sum(made.structure.region.contains(own))
    exact = seen(rig, Chain(rig))
    rounding = 1e-9 * np.max(np.abs(exact), axis=0).min()
    np.testing.assert_allclose(made.response(F), exact, rtol=1e-6, atol=rounding)


def test_a_rational_chain_without_filters_too():
    rig = spring_arm()
    np.testing.assert_allclose(realise(rig).response(F), seen(rig, Chain(rig)), rtol=1e-8)


@pytest.mark.parametrize("name", ["samii", "sflr"])
def test_the_shipped_rigs_are_realised_far_better_than_they_can_be_measured(name):
    rig, _ = load_rig(name)
    made = realise(rig)
    ratio = made.response(F) / seen(rig, Chain(rig))
    assert np.max(np.abs(ratio - 1)) < 1e-4
    assert np.max(made.error) < 1e-4
    assert np.max(made.poles.real) <= 0
    assert np.count_nonzero(made.poles.real == 0) == 1  # the source's integrator


def test_a_wider_band_leaves_less_out():
    rig, _ = load_rig("sflr")
    narrow, wide = (np.max(realise(rig, band).error) for band in (300.0, 2000.0))
    assert wide < 1e-3 * narrow


def test_the_real_blocks_have_the_same_response():
    import control  # here: a fifth of a second for each process that collects the tests

    made = realise(load_rig("samii")[0])
    system = control.ss(*made.state_space())
    blocks = system(2j * np.pi * F, squeeze=False).transpose(2, 0, 1)
    np.testing.assert_allclose(blocks, made.response(F), rtol=1e-7)


def test_a_base_that_turns_freely_does_not_drift_from_an_inner_source():
    # Nothing outside turns it, so the two poles at 0 of its free rotation do not answer.
    rig = spring_arm()
    base = rig.element[2].model_copy(update={"name": "hub"})
    rig = rig.model_copy(update={"base": "pinned", "element": (base, *rig.element)})
    made = realise(rig)
    assert made.structure.multiplicity[0] == 2
    assert np.count_nonzero(np.abs(made.poles) < 1e-4) == 1
    np.testing.assert_allclose(made.response(F), seen(rig, Chain(rig)), rtol=1e-5)


def test_a_source_that_nothing_holds_against_moves_nothing():
    made = realise(spring_arm(base="pinned"))
    assert np.all(np.abs(made.response(F)[:, 1]) < 1e-9)


def test_no_hole_without_viscous_beams():
    assert search_region(load_rig("sflr")[0], 2000.0).holes == ()
    assert len(search_region(load_rig("samii")[0], 2000.0).holes) == 1


@given(st.floats(1e-4, 0.1), st.floats(0.02, 1.0), st.floats(50.0, 2000.0))
@settings(max_examples=25)
def test_relaxations_hold_the_loss_factor_over_the_band(eta, low, high):
    beam = fit_loss(eta, 0.0, low, high)
    f = np.geomspace(low, high, 77)
    m = beam.modulus(2j * np.pi * f)
    # The bounds of fit_loss's docstring.
    np.testing.assert_allclose(m.imag / m.real, eta, rtol=0.004 if eta <= 0.05 else 0.013)
    assert np.all(beam.a > 0)
    # Kramers and Kronig: what loses also stiffens, 2 eta/pi for every factor e.
    assert np.all(np.diff(m.real) > 0)
    slope = np.log(m.real[-10] / m.real[10]) / np.log(f[-10] / f[10])
    assert slope == pytest.approx(2 * eta / np.pi, rel=0.15)
    assert np.allclose(beam.modulus(beam.zeros().astype(complex)), 0.0, atol=1e-6)


def test_the_causal_chain_is_the_chain_where_nothing_is_lost():
    rig, _ = load_rig("sflr")
    s = np.array([3.0j, -40 + 200j, -40 - 200j, -7.0])
    np.testing.assert_allclose(CausalChain(rig, {}).evaluate(s), Chain(rig).evaluate(s), rtol=1e-12)


def test_a_constant_loss_factor_is_simulated_by_its_causal_stand_in():
    rig = lossy("samii", 0.01)
    made = realise(rig, 250.0)
    causal = CausalChain(rig, relaxed_beams(rig, 0.1, 250.0))
    f = np.geomspace(0.05, 50.0, 60)
    exact = causal.evaluate(2j * np.pi * f) * sensor_response(rig.sensor, f)[:, :, None]
    np.testing.assert_allclose(made.response(f), exact, rtol=2e-3)
    assert np.max(made.poles.real) <= 0


def test_the_modes_of_a_lossy_beam_are_damped_by_half_its_loss_factor():
    rig = lossy("sflr", 0.02)
    beam = next(e for e in rig.element if isinstance(e, Beam))
    source = rig.element[0]
    alone = rig.model_copy(update={"element": (source, beam), "sensor": (), "centring": None})
    chain = CausalChain(alone, relaxed_beams(alone, 0.1, 250.0))
    poles = find_poles(chain.characteristic, search_region(alone, 150.0)).poles
    modes = poles[poles.imag > 0]
    assert modes.size == 4
    np.testing.assert_allclose(-modes.real / np.abs(modes), 0.01, rtol=0.01)


@pytest.mark.parametrize("coincident", ["antialias", "highpass_hz"])
def test_a_sensor_filter_may_have_its_corner_on_a_pole(coincident):
    corner = 60.0 / (2 * np.pi)
    value = {"order": 1, "corner_hz": corner} if coincident == "antialias" else corner
    rig = spring_arm(p=60.0, **{coincident: value})
    np.testing.assert_allclose(realise(rig).response(F), seen(rig, Chain(rig)), rtol=1e-4)


def test_the_two_corners_of_a_filter_may_be_the_same():
    rig = spring_arm(antialias={"order": 3, "corner_hz": 7.0}, highpass_hz=7.0)
    np.testing.assert_allclose(realise(rig).response(F), seen(rig, Chain(rig)), rtol=1e-4)
