"""The pole search: nothing missed, nothing invented, multiplicities right.

Plan: characteristic functions with known zeros (polynomials of random zeros, lossless beam,
spring and link), then the shipped rigs against the papers' tables, then what must be refused.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from samii_rig.errors import SamiiRigError
from samii_rig.model.poles import Region, contour_residues, find_poles
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig, TorsionalSpring

REGION = Region(left=-100.0, right=2.0, top=100.0, strip=1.0)


def product(zeros):
    """An entire function with these zeros, real on the real axis, never zero elsewhere."""
    both = np.array([y for z in zeros for y in ([z, np.conj(z)] if z.imag else [z])], dtype=complex)

    def D(s):
        value = np.prod((s[:, None] - both) / 10, axis=1) * np.exp(0.03 * s + 0.01 * np.cos(s / 50))
        size = np.abs(value)
        none = size < 1e-300
        return np.where(none, 0, value / np.where(none, 1, size)), np.log(np.where(none, 1, size))

    return D


def beam_rig(**changes):
    number = {"source": "test"}
    table = {
        "name": "beam",
        "base": "clamped",
        "tip": "free",
        "rate_hz": 500.0,
        "element": [
            {
                "kind": "beam",
                "name": "beam",
                "EI": {"value": 2.0, "unit": "N m^2"} | number,
                "mu": {"value": 0.5, "unit": "kg/m"} | number,
                "L": {"value": 0.8, "unit": "m"} | number,
            },
            {
                "kind": "angular_velocity_source",
                "name": "source",
                "input": "v",
                "K": {"value": 1.0, "unit": "rad/(s V)"} | number,
                "p": {"value": 90.0, "unit": "rad/s"} | number,
            },
        ],
        "sensor": [{"kind": "absolute_angle", "name": "theta", "after": "beam", "unit": "rad"}],
        "actuator": [{"name": "v", "unit": "V", "low": -1.0, "high": 1.0}],
    }
    return Rig.model_validate(table | changes)


imag = st.one_of(st.just(0.0), st.floats(0.5, 99.0))
zero = st.builds(complex, st.floats(-99.0, 1.0), imag)


@given(st.lists(zero, max_size=8))
@settings(max_examples=20)
def test_every_zero_of_a_known_function_is_found_and_no_other(zeros):
    far = [z for i, z in enumerate(zeros) if all(abs(z - y) > 0.01 for y in zeros[:i])]
    found = find_poles(product(far), REGION)
    inside = [z for z in far if found.region.contains(np.array([z]))[0]]
    assert found.count == sum(2 if z.imag else 1 for z in inside)
    wanted = np.array(sorted(inside, key=lambda z: (z.real, z.imag)), dtype=complex)
    got = np.array(sorted(found.poles, key=lambda z: (z.real, z.imag)), dtype=complex)
    for z in wanted:
        assert np.min(np.abs(got - z)) < 1e-9 * (1 + abs(z))


@given(st.lists(st.tuples(zero, st.floats(0.0, 3.0), st.booleans()), max_size=8))
@settings(max_examples=20)
def test_places_near_the_zeros_change_the_way_and_not_what_is_found(given):
    zeros = [z for z, _, _ in given]
    far = [z for i, z in enumerate(zeros) if all(abs(z - y) > 0.01 for y in zeros[:i])]
    near = np.array([z + off * (1 + 1j * bool(z.imag)) for z, off, known in given if known])
    plain = find_poles(product(far), REGION)
    found = find_poles(product(far), REGION, near.astype(complex))
    assert found.count == plain.count
    for z in plain.poles:
        assert np.min(np.abs(found.poles - z)) < 1e-8 * (1 + abs(z))


@pytest.mark.parametrize("near", [-45 + 9j, -46 + 3j, -52 + 1j, -60 + 0.2j])
def test_two_real_zeros_are_found_from_a_pair_that_stood_between_them(near):
    D = product([-30, -70])
    found = find_poles(D, REGION, np.array([near]))
    np.testing.assert_allclose(np.sort_complex(found.poles), [-70, -30], rtol=1e-9)


def test_poles_of_a_chain_that_has_moved_a_little_are_found_in_a_quarter_of_the_time():
    rig = load_rig("samii")[0]
    chain = Chain(rig)
    joint = next(e for e in rig.element if e.name == "joint_3")
    moved = chain.with_values({("joint_3", "k"): 1.02 * joint.k.value})
    region, asked = Region(-500.0, 10.0, 500.0, 1.0), []

    def D(s):
        asked.append(s.size)
        return moved.characteristic(s, clear=True)

    known = find_poles(lambda s: chain.characteristic(s, clear=True), region).poles
    plain, calls = find_poles(D, region), len(asked)
    found = find_poles(D, region, known)
    assert len(asked) - calls < calls / 4
    np.testing.assert_allclose(found.poles, plain.poles, rtol=1e-9, atol=1e-9)


def test_a_double_zero_counts_twice():
    found = find_poles(product([0j, 0j, -20 + 30j]), REGION)
    assert found.count == 4
    assert sorted(found.multiplicity) == [1, 2]
    assert abs(found.poles[0]) < 1e-5


def test_two_zeros_close_to_one_interval_of_the_contour_are_not_overlooked():
    pair = [1.9 + 40.0j, 1.9 + 40.7j]
    assert find_poles(product(pair), REGION).count == 4


def test_a_zero_on_the_edge_moves_the_edge():
    found = find_poles(product([-100 + 20j, 50j]), REGION)
    assert found.region.left < -100
    assert found.count == 4


def test_zeros_in_a_hole_are_left_out():
    region = Region(-100.0, 2.0, 100.0, 0.5, ((-60.0, -40.0),))
    found = find_poles(product([-50 + 0j, -45 + 3j, -50 + 20j, -30 + 0j]), region)
    assert found.count == 3
    assert not region.contains(np.array([-45 + 3j]))[0]


def test_a_function_with_a_pole_is_refused():
    zeros = product([-20 + 30j])

    def D(s):
        mantissa, scale = zeros(s)
        other, other_scale = product([-50 + 0j])(s)
        return mantissa / other, scale - other_scale

    with pytest.raises(SamiiRigError, match="pole"):
        find_poles(D, REGION)


def test_lossless_cantilever_has_its_textbook_frequencies_and_no_other_pole():
    rig = beam_rig()
    beam = rig.element[0]
    c = np.sqrt(beam.EI.value / beam.mu.value) / beam.L.value**2
    # cos(x) cosh(x) = -1
    x = np.array([1.8751040687119611, 4.694091132974175, 7.854757438237613, 10.995540734875467])
    top = 0.5 * (x[2] ** 2 + x[3] ** 2) * c
    found = find_poles(Chain(rig).characteristic, Region(-top, 0.02 * top, top, 1.0))
    assert found.count == 6
    np.testing.assert_allclose(found.poles, 1j * x[:3] ** 2 * c, rtol=1e-10)


def test_samii_with_perfect_joints_has_the_frequencies_of_table_1():
    rig, _ = load_rig("samii")
    stiff = tuple(e for e in rig.element if not isinstance(e, TorsionalSpring))
    sensor = rig.sensor[1:]
    rig = rig.model_copy(update={"element": stiff, "sensor": sensor, "centring": None})
    found = find_poles(Chain(rig).characteristic, Region(-140.0, 5.0, 140.0, 1.0))
    modes = np.abs(found.poles) / (2 * np.pi)
    np.testing.assert_allclose(modes, [2.299, 21.417], rtol=2e-3)


def test_samii_without_damping_has_the_frequencies_of_table_3():
    chain = Chain(load_rig("samii")[0])
    lossless = {key: 0.0 for key in chain.parameters if key[1] in ("c", "tau")}
    D = chain.with_values(lossless).characteristic
    found = find_poles(D, Region(-500.0, 10.0, 500.0, 1.0))
    modes = np.abs(found.poles) / (2 * np.pi)
    np.testing.assert_allclose(modes[:2], [1.703, 7.394], rtol=2e-3)
    np.testing.assert_allclose(found.poles.real, 0.0, atol=1e-9)


def test_every_damped_pole_of_samii_lies_in_the_left_half_plane():
    D = Chain(load_rig("samii")[0]).characteristic
    found = find_poles(lambda s: D(s, clear=True), Region(-500.0, 50.0, 500.0, 1.0))
    assert found.poles.size >= 4
    assert found.poles.real.max() < 0


def test_a_damper_that_is_not_cleared_is_refused():
    with pytest.raises(SamiiRigError, match="pole"):
        find_poles(Chain(load_rig("samii")[0]).characteristic, Region(-500.0, 50.0, 500.0, 1.0))


def test_residues_of_a_rational_function():
    p, r = np.array([-1 + 5j, -3 + 0j]), np.array([2 - 1j, 4.0])

    def G(s):
        pair = r[0] / (s - p[0]) + np.conj(r[0]) / (s - np.conj(p[0]))
        return (pair + r[1] / (s - p[1]) ** 2)[:, None, None]

    first, second = contour_residues(G, p, np.array([1.0, 1.0]))
    np.testing.assert_allclose(first.ravel(), [r[0], 0], atol=1e-12)
    np.testing.assert_allclose(second.ravel(), [0, r[1]], atol=1e-12)
