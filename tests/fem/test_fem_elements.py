"""Every element of the transfer matrices against finite elements, which share no code with them.

One chain with each kind in it: the frequency responses of all kinds of sensors, the natural
frequencies without damping and the damped poles must agree; an element that finite elements
cannot carry is refused by both its name and its kind.
"""

from typing import Any

import numpy as np
import pytest
from fem_kit import SOURCE, Part, chain
from hypothesis import given, settings
from hypothesis import strategies as st

from samii_rig.errors import InputError
from samii_rig.fem import hermite
from samii_rig.fem.model import Fem
from samii_rig.fem.reduce import reduce
from samii_rig.model.modes import natural_frequencies, poles
from samii_rig.model.shapes import mode_shape
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig

MESH = 24  # the fourth power of the element's length, but for shear, which falls with the second
THICK_MESH = 96
BEAM = {"EI": 60.0, "mu": 0.8, "L": 0.9}
THICK = {"EI": 60.0, "mu": 0.8, "L": 0.9, "GA": 5e4, "J": 2e-3}
LINK = {"L": 0.3, "r": 0.12, "m": 0.7, "I": 0.01}
F = np.array([0.4, 2.0, 7.0, 19.0, 44.0])

SIDE = {
    "element": [
        {"name": "root", "kind": "torsional_spring",
         "k": {"value": 90.0, "unit": "N m/rad", "source": "test"},
         "c": {"value": 0.05, "unit": "N m s/rad", "source": "test"}},
        {"name": "twig", "kind": "beam",
         "EI": {"value": 20.0, "unit": "N m^2", "source": "test"},
         "mu": {"value": 0.3, "unit": "kg/m", "source": "test"},
         "L": {"value": 0.6, "unit": "m", "source": "test"}},
        {"name": "bob", "kind": "lumped_mass",
         "m": {"value": 0.2, "unit": "kg", "source": "test"}},
    ]
}  # fmt: skip

MIDDLE: dict[str, list[Part]] = {
    "torsional_spring": [("x", "torsional_spring", {"k": 150.0, "c": 0.3})],
    "torsional_damper": [("x", "torsional_spring", {"k": 0.0, "c": 2.0})],
    "translational_spring": [("x", "translational_spring", {"k": 4e3, "c": 5.0})],
    "torsional_ground_spring": [("x", "torsional_ground_spring", {"k": 120.0, "c": 0.4})],
    "torsional_ground_damper": [("x", "torsional_ground_spring", {"k": 0.0, "c": 0.4})],
    "translational_ground_spring": [("x", "translational_ground_spring", {"k": 900.0, "c": 3.0})],
    "lumped_mass": [("x", "lumped_mass", {"m": 0.9, "I": 0.02})],
    "gravity_hanging": [("x", "gravity_stiffness", {"k": 30.0})],
    "gravity_standing": [("x", "gravity_stiffness", {"k": -20.0})],
    "timoshenko_beam": [("x", "timoshenko_beam", THICK)],
    "timoshenko_damped": [("x", "timoshenko_beam", {**THICK, "tau": 2e-4})],
    "timoshenko_lossy": [("x", "timoshenko_beam", {**THICK, "eta": 0.02})],
    "oil_column": [("x", "oil_column", {"D": 1.475e-5, "C_h": 1e-12})],
    "branch": [("x", "branch", SIDE)],
    "branch_pinned": [("x", "branch", {**SIDE, "tip": "pinned"})],
    "branch_clamped": [("x", "branch", {**SIDE, "tip": "clamped"})],
    "two_in_a_row": [
        ("x", "translational_spring", {"k": 4e3}),
        ("y2", "torsional_ground_spring", {"k": 50.0, "c": 0.1}),
        ("z2", "lumped_mass", {"m": 0.3}),
        ("v2", "translational_ground_spring", {"k": 300.0}),
    ],
}
SOURCES: dict[str, list[Part]] = {
    "first_order": [SOURCE],
    "first_order_late": [
        ("source", "angular_velocity_source", {"K": 0.5, "p": 150.0, "tau": 4e-3})
    ],
    "second_order": [
        ("source", "angular_velocity_source_2", {"K": 0.5, "omega": 90.0, "zeta": 0.6})
    ],
    "torque": [("source", "torque_source", {"K": 2.0})],
    "torque_lagging": [("source", "torque_source", {"K": 2.0, "p": 60.0})],
    "force": [("source", "force_source", {"K": 3.0})],
    "force_lagging_late": [("source", "force_source", {"K": 3.0, "p": 60.0, "tau": 3e-3})],
    "motor_in_a_joint": [
        ("rotor", "lumped_mass", {"m": 0.1, "I": 1e-3}),
        ("source", "torque_source", {"K": -2.0}),
        ("motor", "torsional_spring", {"k": 40.0, "c": 0.2}),
        ("reaction", "torque_source", {"K": 2.0}),
    ],
    "two_on_one_input": [SOURCE, ("push", "force_source", {"K": 5.0, "p": 40.0})],
}
SENSORS: list[dict[str, Any]] = [
    {"name": "at_joint", "kind": "relative_angle", "across": ["joint"], "unit": "rad"},
    {"name": "after_x", "kind": "absolute_angle", "after": "x", "unit": "rad"},
    {"name": "M_before", "kind": "moment", "after": "beam", "unit": "N m"},
    {"name": "M_after", "kind": "moment", "after": "x", "unit": "N m"},
    {"name": "on_beam", "kind": "acceleration", "on": "beam", "position": 0.33, "unit": "m/s^2"},
    {"name": "on_link", "kind": "acceleration", "on": "link", "position": 0.25, "unit": "m/s^2"},
    {"name": "tilted", "kind": "acceleration", "on": "link", "position": 0.1, "tilt": 1.0,
     "unit": "m/s^2"},
    {"name": "tilted_beam", "kind": "acceleration", "on": "beam", "position": 0.5, "tilt": -1.0,
     "unit": "m/s^2"},
]  # fmt: skip


def built(middle: list[Part], source: list[Part], base: str = "clamped", tip: str = "free") -> Rig:
    return chain(
        ("beam", "beam", {**BEAM, "tau": 1e-4}),
        *middle,
        ("joint", "torsional_spring", {"k": 300.0, "c": 0.2}),
        *source,
        ("link", "rigid_link", LINK),
        base=base, tip=tip, sensors=SENSORS,
    )  # fmt: skip


def mesh(name: str) -> int:
    return THICK_MESH if name.startswith("timoshenko") else MESH


def agree(ours: np.ndarray, theirs: np.ndarray, rel: float) -> None:
    """Equal at each frequency, relative to that sensor's size there and elsewhere."""
    size = np.abs(theirs) + 1e-3 * np.abs(theirs).max(axis=0) + 1e-12 * np.abs(theirs).max()
    assert np.max(np.abs(ours - theirs) / size) < rel


@pytest.mark.parametrize("name", MIDDLE)
def test_an_element_answers_in_both_models_alike(name: str) -> None:
    rig = built(MIDDLE[name], [SOURCE])
    agree(Chain(rig).response(F), Fem(rig, elements=mesh(name)).response(F), 5e-4)


@settings(max_examples=25)
@given(
    st.lists(
        st.sampled_from([n for n in MIDDLE if not n.startswith("timo")]), min_size=1, max_size=5
    ),
    st.sampled_from(list(SOURCES)),
    st.sampled_from(["clamped", "pinned", "free"]),
    st.sampled_from(["clamped", "pinned", "free"]),
    st.floats(0.5, 30.0),
)
def test_any_elements_in_any_order_answer_alike(
    names: list[str], source: str, base: str, tip: str, f: float
) -> None:
    parts = [part for i, name in enumerate(names) for part in renamed(MIDDLE[name], i)]
    parts[0] = ("x", *parts[0][1:])
    rig = built(parts, SOURCES[source], base, tip)
    # Beside the axis, where no resonance magnifies what the mesh leaves.
    s = np.array([2 * np.pi * f * (0.1 + 1j)])
    ours, theirs = Chain(rig).evaluate(s), Fem(rig, elements=MESH).evaluate(s)
    size = np.abs(theirs) + 1e-6 * np.abs(theirs).max() + 1e-9
    assert np.max(np.abs(ours - theirs) / size) < 2e-4


def renamed(parts: list[Part], i: int) -> list[Part]:
    """The same parts under names of their own, those of a branch too."""
    out = []
    for name, kind, values in parts:
        own = {**values}
        if kind == "branch":
            own["element"] = [{**e, "name": f"{e['name']}_{i}"} for e in values["element"]]
        out.append((f"{name}_{i}", kind, own))
    return out


@pytest.mark.parametrize("name", SOURCES)
def test_a_source_drives_both_models_alike(name: str) -> None:
    rig = built(MIDDLE["lumped_mass"], SOURCES[name])
    agree(Chain(rig).response(F), Fem(rig, elements=MESH).response(F), 5e-4)


@pytest.mark.parametrize("base", ["clamped", "pinned", "free"])
@pytest.mark.parametrize("tip", ["clamped", "pinned", "free"])
def test_every_pair_of_ends(base: str, tip: str) -> None:
    rig = built(MIDDLE["two_in_a_row"], SOURCES["second_order"], base, tip)
    agree(Chain(rig).response(F), Fem(rig, elements=MESH).response(F), 5e-4)


@pytest.mark.parametrize("name", [n for n in MIDDLE if n != "torsional_damper"])
def test_natural_frequencies_and_shapes_mode_by_mode(name: str) -> None:
    rig = built(MIDDLE[name], [SOURCE])
    found = natural_frequencies(rig, 0.3, 80.0)
    fem = Fem(rig, elements=mesh(name))
    modes = fem.modes(found.count + found.below)
    hz = modes.frequency_hz[found.below :]
    np.testing.assert_allclose(hz, found.hz, rtol=5e-5)
    assert np.all(hz > found.hz * (1 - 1e-6))  # Rayleigh-Ritz: never too low
    # Modal masses 1 in both: the tip moves by as much.
    tip = (fem.mechanism.places.w @ modes.shapes)[-1, found.below :]
    for i, f in enumerate(found.hz):
        w = mode_shape(rig, f, normalise="mass").w[-1].real
        assert abs(w) == pytest.approx(abs(tip[i]), rel=1e-3)


@pytest.mark.parametrize("name", [n for n in MIDDLE if n != "timoshenko_lossy"])
def test_damped_poles(name: str) -> None:
    rig = built(MIDDLE[name], [SOURCE])
    theirs = Fem(rig, elements=mesh(name)).poles()
    found = poles(rig, 50.0)
    ours = found.pole[found.oscillating]
    assert ours.size >= 2
    for p in ours:
        assert np.min(np.abs(theirs - p)) < 1e-4 * abs(p)
    inside = theirs[(theirs.imag > 1.0) & (theirs.imag < 0.98 * found.found.region.top)]
    assert inside.size == np.sum(ours.imag < 0.98 * found.found.region.top)


@pytest.mark.parametrize("name", [n for n in SOURCES if not n.endswith("late")])
def test_a_reduction_with_all_modes_is_the_whole_model(name: str) -> None:
    rig = built(MIDDLE["lumped_mass"], SOURCES[name])
    fem = Fem(rig, elements=8)
    joints = [fem.mechanism.joints[s.element] for s in fem.mechanism.sources]
    whole = reduce(fem, fem.basis(joints).modes.omega.size)
    agree(whole.response(F), fem.response(F), 1e-6)


@settings(max_examples=10)
@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1.0), st.floats(0.0, 1e-2))
def test_a_thick_beams_element_is_exact_in_statics_and_keeps_its_mass(
    phi: float, h: float, J: float
) -> None:
    k, m = hermite.stiffness(2.0, h, phi), hermite.consistent_mass(3.0, h, phi, J)
    lift, turn = np.array([1.0, 0, 1, 0]), np.array([-h / 2, 1, h / 2, 1])
    assert np.abs(k @ np.column_stack([lift, turn])).max() < 1e-9 * np.abs(k).max()
    assert lift @ m @ lift == pytest.approx(3.0 * h)
    assert turn @ m @ turn == pytest.approx(3.0 * h**3 / 12 + J * h)
    # A cantilever under a tip force: bending h^3/3EI and shear h/GA, GA = 12 EI/(phi h^2).
    tip = np.linalg.solve(k[2:, 2:], [1.0, 0.0])[0]
    assert tip == pytest.approx(h**3 / 6 + h * phi * h**2 / 24, rel=1e-9)


def test_shear_and_rotary_inertia_lower_every_frequency_and_converge_from_above() -> None:
    thin = chain(SOURCE, ("x", "beam", BEAM))
    thick = chain(SOURCE, ("x", "timoshenko_beam", THICK))
    exact = natural_frequencies(thick, 0.3, 600.0).hz[:4]
    assert np.all(exact < natural_frequencies(thin, 0.3, 900.0).hz[:4])
    errors = [Fem(thick, elements=n).modes(4).frequency_hz / exact - 1 for n in (10, 20)]
    assert np.all(errors[1] > 0)
    # Within an element the shear force of the functions is constant: second power.
    assert np.log2(errors[0] / errors[1]) == pytest.approx([2, 2, 2, 2], abs=0.2)


def test_a_stiff_beam_in_shear_is_an_euler_bernoulli_beam() -> None:
    stiff = chain(SOURCE, ("x", "timoshenko_beam", {**BEAM, "GA": 1e12, "J": 0.0}))
    thin = chain(SOURCE, ("x", "beam", BEAM))
    a, b = (Fem(rig, elements=10).modes(4).omega for rig in (stiff, thin))
    np.testing.assert_allclose(a, b, rtol=1e-7)


REFERENCE = {"EI": 339137.0, "mu": 5.72815, "L": 7.2, "GA": 1.3e13, "J": 0.01333}
BODY = {"L": 0.5, "r": 0.4, "m": 20.0, "I": 0.083333}


@pytest.mark.parametrize(
    ("body", "omega"),
    [
        ([], [16.5003, 103.348, 289.087, 565.666, 933.314]),
        ([("body", "rigid_link", BODY)], [9.05713, 71.8944, 218.362, 447.682]),
    ],
)
def test_a_multibody_codes_beam_to_two_hundredths_of_a_percent(
    body: list[Part], omega: list[float]
) -> None:
    """Values of a code that nobody tuned to, with its shear stiffness and rotary inertia."""
    rig = chain(SOURCE, ("x", "timoshenko_beam", REFERENCE), *body)
    tmm = 2 * np.pi * natural_frequencies(rig, 0.3, 160.0).hz[: len(omega)]
    np.testing.assert_allclose(tmm, omega, rtol=2e-4)
    np.testing.assert_allclose(Fem(rig, elements=30).modes(len(omega)).omega, tmm, rtol=5e-5)


def test_a_line_with_waves_is_refused_by_name() -> None:
    line = {"source": "source", "D": 1.475e-5, "L": 2.0, "A": 1e-4, "rho": 870.0, "B": 1e9}
    rig = chain(
        SOURCE, ("hose", "hydraulic_line", line), ("link", "rigid_link", LINK),
        sensors=[{"name": "y", "kind": "absolute_angle", "after": "link", "unit": "rad"}],
    )  # fmt: skip
    with pytest.raises(InputError, match=r"hose is 'hydraulic_line'; expected an element with a"):
        Fem(rig)


def test_a_torque_on_a_part_without_mass_has_no_reduction() -> None:
    parts = SOURCES["motor_in_a_joint"][1:]
    with pytest.raises(InputError, match="source: acts on a part without mass"):
        reduce(Fem(built(MIDDLE["lumped_mass"], parts)))


def test_a_dead_time_has_a_response_but_no_equation_in_time() -> None:
    rig = built(MIDDLE["lumped_mass"], SOURCES["first_order_late"])
    with pytest.raises(InputError, match=r"source\.tau is 0\.004; expected 0"):
        reduce(Fem(rig))
