"""Mode shapes: orthogonal by mass and by stiffness, reciprocal, and those of finite elements.

Plan: laws on random chains (mass orthogonality, Rayleigh's quotient, Betti), SAMII against finite
elements mode by mode, what a joint does to the slope, complex shapes, what is refused.
"""

import numpy as np
import pytest
from fem_kit import SOURCE, chain, samii
from hypothesis import given, settings
from hypothesis import strategies as st
from modes_kit import chains, wittrick_williams

from samii_rig.errors import InputError
from samii_rig.fem.model import Fem
from samii_rig.model.modes import natural_frequencies, poles, undamped
from samii_rig.model.shapes import ModeShape, mode_shape
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Beam, Rig, RigidLink, TorsionalSpring

NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)


def first_modes(rig: Rig, n: int) -> list[ModeShape]:
    """The first n modes at Gauss points of each beam, modal masses 1."""
    high = 1.0
    while wittrick_williams(rig, 2 * np.pi * high) < n + 2:
        high *= 1.5
    found = natural_frequencies(rig, 0.02, high)
    return [mode_shape(rig, hz, positions=points(rig), normalise="mass") for hz in found.hz[:n]]


def points(rig: Rig) -> dict[str, list[float]]:
    return {
        e.name: (e.L.value * (1 + NODES) / 2).tolist() for e in rig.element if isinstance(e, Beam)
    }


def at(mode: ModeShape, name: str) -> np.ndarray:
    """States on one element, the first that of its upstream end."""
    own = [i for i, (element, _) in enumerate(mode.place) if element == name]
    first = own[0] if own[0] == 0 else own[0] - 1
    return mode.state[[first, *[i for i in own if i != first]]].real


def mass(rig: Rig, a: ModeShape, b: ModeShape) -> float:
    """The integral of the product of two motions over all mass."""
    total = 0.0
    for e in rig.element:
        za, zb = at(a, e.name), at(b, e.name)
        if isinstance(e, Beam):
            inside = slice(1, 1 + NODES.size)
            total += e.mu.value * e.L.value / 2 * np.sum(WEIGHTS * za[inside, 0] * zb[inside, 0])
        elif isinstance(e, RigidLink):
            r = e.r.value
            total += e.m.value * (za[0, 0] + r * za[0, 1]) * (zb[0, 0] + r * zb[0, 1])
            total += e.I.value * za[0, 1] * zb[0, 1]
    return float(total)


def stiffness(rig: Rig, a: ModeShape, b: ModeShape) -> float:
    """Twice the mutual energy of deformation, from the moments."""
    total = 0.0
    for e in rig.element:
        za, zb = at(a, e.name), at(b, e.name)
        if isinstance(e, Beam):
            inside = slice(1, 1 + NODES.size)
            total += e.L.value / 2 / e.EI.value * np.sum(WEIGHTS * za[inside, 2] * zb[inside, 2])
        elif isinstance(e, TorsionalSpring):
            total += za[0, 2] * zb[0, 2] / e.k.value
    return float(total)


@settings(max_examples=25)
@given(chains())
def test_modes_are_orthogonal_by_mass_and_by_stiffness(rig: Rig) -> None:
    modes = first_modes(rig, 4)
    m = np.array([[mass(rig, a, b) for b in modes] for a in modes])
    np.testing.assert_allclose(m, np.eye(len(modes)), atol=1e-7)
    k = np.array([[stiffness(rig, a, b) for b in modes] for a in modes])
    omega = np.array([abs(mode.s) for mode in modes])
    np.testing.assert_allclose(k / np.outer(omega, omega), np.eye(len(modes)), atol=1e-6)


@settings(max_examples=15)
@given(chains(), st.floats(-0.2, 0.2))
def test_rayleighs_quotient_is_least_at_the_first_mode(rig: Rig, share: float) -> None:
    first, second = first_modes(rig, 2)
    k = stiffness(rig, first, first) + share**2 * stiffness(rig, second, second)
    m = mass(rig, first, first) + share**2 * mass(rig, second, second)
    omega = abs(first.s)
    assert k / m >= omega**2 * (1 - 1e-7)
    # And near it the quotient is off by the square of what is mixed in.
    expected = (omega**2 + share**2 * abs(second.s) ** 2) / (1 + share**2)
    assert k / m == pytest.approx(expected, rel=1e-6)


@settings(max_examples=25)
@given(chains(damped=True), st.floats(0.3, 60.0), st.integers(0, 7), st.integers(0, 7))
def test_what_a_force_does_elsewhere_it_suffers_from_there(
    rig: Rig, f: float, a: int, b: int
) -> None:
    """Betti: displacement and rotation at b by force and torque at a, and the other way round."""
    z = Chain(rig).field([f], jumps=[(a, "V"), (a, "M"), (b, "V"), (b, "M")])[0]
    size = np.abs(z[:, [a, b], :2]).max()
    assert abs(z[0, b, 0] - z[2, a, 0]) <= 1e-9 * size
    assert abs(z[1, b, 1] - z[3, a, 1]) <= 1e-9 * size
    # A jump of M by +1 is a torque of -1.
    assert abs(z[0, b, 1] + z[3, a, 0]) <= 1e-9 * size


def test_shapes_of_samii_are_those_of_finite_elements() -> None:
    rig, mesh = samii(), 40
    fem = Fem(rig, elements=mesh)
    modes, places = fem.modes(5), fem.mechanism.places
    L = next(e.L.value for e in rig.element if isinstance(e, Beam))
    positions = {"beam": (np.arange(1, mesh) * L / mesh).tolist()}
    for i, hz in enumerate(modes.frequency_hz):
        ours = mode_shape(rig, hz, positions=positions)
        w = places.w @ modes.shapes[:, i]
        theta = places.theta @ modes.shapes[:, i]
        scale = w[np.argmax(abs(w))]
        np.testing.assert_allclose(ours.x, places.x, atol=1e-12)
        np.testing.assert_allclose(ours.w.real, w / scale, atol=2e-5)
        np.testing.assert_allclose(
            ours.theta.real, theta / scale, atol=2e-5 * np.abs(ours.theta).max()
        )
        # FEM's modal mass is 1, so its scale gives ours.
        assert ours.modal_mass.real == pytest.approx(1 / scale**2, rel=1e-4)


def test_a_joint_bends_the_shape_by_its_moment_over_its_stiffness() -> None:
    rig = samii()
    mode = mode_shape(rig, 7.394)
    for e in rig.element:
        if isinstance(e, TorsionalSpring):
            M = mode.state[[i for i, p in enumerate(mode.place) if p[0] == e.name][-1], 2]
            assert mode.slope_changes[e.name] == pytest.approx(M / e.k.value, rel=1e-9)
    assert mode.slope_changes["joint_2_source"] == 0
    # Paper 1, Fig. 9: what sets mode 2 apart are the slopes at joints 1 and 2.
    change = {name: abs(value) for name, value in mode.slope_changes.items()}
    assert min(change["joint_1"], change["joint_2"]) > 5 * change["joint_3"]
    assert min(change["joint_1"], change["joint_2"]) > 10 * change["clamp"]


def test_normalised_by_displacement_the_largest_is_one_and_positive() -> None:
    for hz in natural_frequencies(samii(), 0.1, 120.0).hz:
        by_mass = mode_shape(samii(), hz, normalise="mass")
        shown = mode_shape(samii(), hz)
        assert shown.w.real.max() == pytest.approx(1)
        assert np.abs(shown.w).max() == pytest.approx(1)
        assert np.all(shown.state.imag == 0)
        top = by_mass.w.real.max()
        np.testing.assert_allclose(by_mass.state / top, shown.state, atol=1e-9)
        assert shown.modal_mass.real == pytest.approx(1 / top**2, rel=1e-9)


def test_a_chain_is_seen_at_its_sensors_as_its_response_is() -> None:
    """Near a pole all sensors move as the mode does."""
    rig = samii()
    chain_ = Chain(rig)
    for p in poles(rig, 30.0).pole[:2]:
        mode = mode_shape(rig, p)
        H = chain_.evaluate(p + np.array([1e-7, -1e-7]))[:, :, 0]
        residue = H[0] - H[1]
        # theta_2 spans the source, whose own jump the mode has not but a response has.
        reading = np.array([mode.readings[s.name] for s in rig.sensor])
        np.testing.assert_allclose(residue / residue[-1], reading / reading[-1], rtol=1e-5)


def test_with_little_damping_a_complex_shape_becomes_the_real_one() -> None:
    base = undamped(samii())
    light = base.with_values({("joint_1", "c"): 1e-5})
    hz = natural_frequencies(base, 5.0, 10.0).hz[0]
    pole = poles(light, 12.0).pole[-1]
    real, almost = mode_shape(base, hz), mode_shape(light, complex(pole))
    np.testing.assert_allclose(almost.state, real.state, atol=1e-5 * np.abs(real.state).max())
    assert almost.modal_mass == pytest.approx(real.modal_mass, rel=1e-5)


def test_damping_lets_parts_of_a_mode_move_out_of_step() -> None:
    mode = mode_shape(samii(), complex(poles(samii(), 10.0).pole[1]))
    assert mode.hz == pytest.approx(7.425, rel=1e-3)
    assert mode.ratio == pytest.approx(0.108, rel=0.01)
    moving = np.abs(mode.w) > 0.1
    assert np.ptp(np.degrees(np.angle(mode.w[moving] ** 2)) / 2) > 2


def test_every_kind_of_sensor_reads_the_shape() -> None:
    sensors = [
        {"name": "across", "kind": "relative_angle", "across": ["j"], "unit": "rad"},
        {"name": "after", "kind": "absolute_angle", "after": "b", "unit": "rad"},
        {"name": "M", "kind": "moment", "after": "b", "unit": "N m"},
        {"name": "a", "kind": "acceleration", "on": "b", "position": 0.3, "unit": "m/s^2"},
        {"name": "a0", "kind": "acceleration", "on": "b", "position": 0.0, "unit": "m/s^2"},
        {"name": "al", "kind": "acceleration", "on": "l", "position": 0.2, "unit": "m/s^2"},
    ]
    rig = chain(
        SOURCE, ("j", "torsional_spring", {"k": 50.0}),
        ("b", "beam", {"EI": 2.0, "mu": 0.5, "L": 0.8}),
        ("l", "rigid_link", {"L": 0.4, "r": 0.2, "m": 0.3, "I": 0.01}),
        sensors=sensors,
    )  # fmt: skip
    hz = natural_frequencies(rig, 0.1, 20.0).hz[1]
    mode = mode_shape(rig, hz)
    fem = Fem(rig, elements=40)  # nodes where the shape is drawn
    modes = fem.modes(2)
    q = modes.shapes[:, 1]
    w = fem.mechanism.places.w @ q
    scale = w[np.argmax(np.abs(w))]
    omega = 2 * np.pi * hz
    shown = [mode.readings[s["name"]].real for s in sensors]
    seen = (fem.mechanism.angle @ q - omega**2 * (fem.mechanism.acceleration @ q)) / scale
    at_moment = 2
    for i, (ours, theirs) in enumerate(zip(shown, seen, strict=True)):
        if i != at_moment:
            assert ours == pytest.approx(theirs, rel=1e-4, abs=1e-9)
    port = [i for i, p in enumerate(mode.place) if p[0] == "b"][-1]
    assert shown[at_moment] == mode.state[port, 2].real


@pytest.mark.parametrize("bad", [3.0, 0.0, -2.0, np.nan, complex(-3.0, 0.0), complex(-1.0, 30.0)])
def test_what_is_no_mode_is_refused(bad: complex) -> None:
    with pytest.raises(InputError, match="mode shape"):
        mode_shape(samii(), bad)


def test_a_position_off_its_beam_is_refused() -> None:
    with pytest.raises(InputError, match="between 0 and L"):
        mode_shape(samii(), 1.7, positions={"beam": [9.0]})
