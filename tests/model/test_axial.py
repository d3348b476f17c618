"""Chains that move along themselves: transfer matrices against closed forms, finite elements, an
integrator written by hand, and their gradients against differences."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from axial_kit import SECOND, axial, branch, part, place
from hypothesis import given, settings
from hypothesis import strategies as st

from samii_rig.errors import InputError
from samii_rig.fem.model import Fem
from samii_rig.fem.reduce import reduce
from samii_rig.model.elements import matrix
from samii_rig.model.modes import natural_frequencies, poles
from samii_rig.model.realise import realise
from samii_rig.model.sampled import feedthrough
from samii_rig.model.shapes import mode_shape
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig

F = np.geomspace(0.3, 120.0, 30)
SOURCES = {
    "force_source": part("force_source", "drive", K=2.0, p=90.0),
    "displacement_source": part("displacement_source", "drive", K=2.0, **SECOND),
    "velocity_source": part("velocity_source", "drive", K=2.0, p=80.0),
    "acceleration_source": part("acceleration_source", "drive", K=2.0, **SECOND),
    "measured_acceleration": part("acceleration_source", "drive", K=2.0, tau=1e-3),
}
BETWEEN = {
    "nothing": (),
    "rod": (part("rod", EA=2e4, mu=0.5, L=1.2, tau=1e-4),),
    "damper": (part("damper", c=40.0),),
    "ground_spring": (part("ground_spring", k=500.0, c=2.0),),
    "ground_damper": (part("ground_damper", c=3.0),),
    "branch": (branch(part("spring", "hose", k=900.0, c=0.4), part("mass", "end", m=0.3)),),
}
SENSORS = [
    place("displacement", "two", "x"),
    place("displacement", "two", "x_between", against="one"),
    place("velocity", "two", "v_2"),
    place("acceleration", "two", "a"),
    place("force", "front", "F"),
]
SENSORS_OF_ONE = [
    place("acceleration", "one", "a"),
    place("displacement", "one", "x", against="table"),
]


def bench(kind: str, between: str, base: str = "clamped", tip: str = "free") -> Rig:
    """Two masses and springs, driven, with something between them."""
    last = [part("spring", "back", k=3e3, c=1.0)] if tip == "clamped" else []
    first = [part("spring", "front", k=1e4, c=5.0), part("mass", "one", m=1.0)]
    if kind == "force_source":
        first.append(SOURCES[kind])
    else:
        first = [part("mass", "table", m=0.2), SOURCES[kind], *first]
    return axial(
        *first, *BETWEEN[between], part("spring", "middle", k=7e3, c=2.0),
        part("mass", "two", m=0.6), *last, sensor=SENSORS, base=base, tip=tip,
    )  # fmt: skip


@pytest.mark.parametrize(("kind", "between"), [*itertools.product(SOURCES, BETWEEN)])
def test_responses_are_those_of_finite_elements(kind: str, between: str) -> None:
    for base, tip in (("clamped", "free"), ("free", "clamped")):
        rig = bench(kind, between, base, tip)
        H, expected = Chain(rig).response(F), Fem(rig, elements=20).response(F)
        size = np.maximum(np.abs(expected), 1e-9 * np.abs(expected).max(axis=0) + 1e-30)
        assert np.max(np.abs(H - expected) / size) < 1e-6


SIZE = st.floats(0.2, 5.0)
ANY = st.one_of(
    st.builds(lambda a, b: part("spring", k=2e3 * a, c=2.0 * b), SIZE, SIZE),
    st.builds(lambda a: part("mass", m=a), SIZE),
    st.builds(lambda a: part("damper", c=50.0 * a), SIZE),
    st.builds(lambda a, b: part("ground_spring", k=900.0 * a, c=b), SIZE, SIZE),
    st.builds(lambda a, b: part("rod", EA=1e5 * a, mu=b, L=0.5, tau=1e-4), SIZE, SIZE),
)


@settings(max_examples=40)
@given(st.lists(ANY, max_size=6), st.sampled_from(["clamped", "free"]))
def test_any_order_of_parts_is_that_of_finite_elements(parts: list[Any], tip: str) -> None:
    named = [{**p, "name": f"part_{i}"} for i, p in enumerate(parts)]
    rig = axial(
        part("spring", "front", k=1e4, c=5.0), part("mass", "one", m=1.0),
        part("force_source", K=2.0), *named, part("mass", "last", m=0.5),
        part("spring", "back", k=1e4, c=1.0), part("mass", "end", m=0.1),
        sensor=[place("acceleration", "last", "a"), SENSORS[4]], tip=tip,
    )  # fmt: skip
    f = np.array([0.5, 3.0, 11.0, 25.0])
    H, expected = Chain(rig).response(f), Fem(rig, elements=10).response(f)
    assert np.max(np.abs(H - expected) / np.abs(expected).max(axis=0)) < 1e-6


@pytest.mark.parametrize("between", [*BETWEEN])
def test_damped_poles_are_those_of_finite_elements(between: str) -> None:
    rig = bench("force_source", between)
    own = poles(rig, 100.0).pole
    own = own[own.imag > 0]
    others = Fem(rig, elements=20).poles()
    for p in own:
        assert np.min(np.abs(others - p)) < 1e-6 * abs(p)


@pytest.mark.parametrize(("kind", "between"), [*itertools.product(SOURCES, BETWEEN)])
def test_gradients_are_those_of_differences(kind: str, between: str) -> None:
    chain = Chain(bench(kind, between))
    _, dH = chain.gradient(F)
    for i, (key, value) in enumerate(zip(chain.parameters, chain.values(), strict=True)):
        if value == 0.0:
            continue
        step = 3e-5 * value
        more = chain.with_values({key: value + step}).response(F)
        less = chain.with_values({key: value - step}).response(F)
        by_difference = (more - less) / (2 * step)
        size = np.abs(by_difference).max(axis=0) + 1e-30
        assert np.max(np.abs(by_difference - dH[..., i]) / size) < 1e-6, key


def test_a_rod_keeps_its_gradient_where_waves_are_short_and_long() -> None:
    rod = part("rod", EA=10.0, mu=0.5, L=1.2, tau=1e-3)
    chain = Chain(
        axial(part("force_source", K=1.0), rod, part("mass", m=0.2), base="free",
              sensor=[place("acceleration", "mass")])
    )  # fmt: skip
    f = np.geomspace(0.05, 400.0, 50)
    H, dH = chain.gradient(f)
    whole = np.eye(5)
    for i, (key, value) in enumerate(zip(chain.parameters, chain.values(), strict=True)):
        step = 1e-6 * max(value, 1e-3)
        more = chain.with_values({key: value + step}).response(f)
        less = chain.with_values({key: max(value - step, 0.0)}).response(f)
        by_difference = (more - less) / (value + step - max(value - step, 0.0))
        assert np.allclose(dH[..., i], by_difference, rtol=1e-4, atol=1e-8 * np.abs(H).max()), key
    s = 2j * np.pi * f[:20]
    plain = np.broadcast_to(whole, (s.size, 5, 5))
    for e in chain.rig.element[1:]:
        plain = matrix(e, s) @ plain
    # Free at both ends: the force is V at the base, and V = 0 behind the mass.
    w = plain[:, 0, 3] - plain[:, 3, 3] / plain[:, 3, 0] * plain[:, 0, 0]
    assert np.allclose(H[:20, 0, 0], s**2 * w, rtol=1e-9)


def test_one_mass_has_the_closed_form() -> None:
    rig = axial(
        part("spring", k=900.0, c=3.0), part("mass", m=2.0), part("force_source", K=5.0),
        sensor=[place("displacement", "mass"), place("force", "spring", "F")],
    )  # fmt: skip
    s = 2j * np.pi * F
    x = 5.0 / (2.0 * s**2 + 3.0 * s + 900.0)
    H = Chain(rig).response(F)[:, :, 0]
    assert np.allclose(H[:, 0], x, rtol=1e-12)
    assert np.allclose(H[:, 1], (900.0 + 3.0 * s) * x, rtol=1e-12)
    found = natural_frequencies(rig, 0.1, 50.0).hz
    assert found == pytest.approx([math.sqrt(450.0) / (2 * math.pi)], rel=1e-9)


def test_two_and_three_masses_have_the_eigenvalues_of_their_matrices() -> None:
    m, k = np.array([1.0, 0.6, 0.4]), np.array([4e3, 3e3, 2e3])
    for n in (2, 3):
        K = np.diag(k[:n]) + np.diag(np.append(k[1:n], 0.0))
        K -= np.diag(k[1:n], 1) + np.diag(k[1:n], -1)
        omega = np.sqrt(np.linalg.eigvalsh(K / np.sqrt(np.outer(m[:n], m[:n]))))
        parts = [(part("spring", f"s{i}", k=k[i]), part("mass", f"m{i}", m=m[i])) for i in range(n)]
        rig = axial(
            *itertools.chain(*parts), part("force_source", K=1.0),
            sensor=[place("displacement", "m0")],
        )  # fmt: skip
        assert natural_frequencies(rig, 0.1, 80.0).hz == pytest.approx(
            omega / (2 * np.pi), rel=1e-8
        )
        assert Fem(rig).modes().omega == pytest.approx(omega, rel=1e-8)


def test_a_rod_has_quarter_waves_and_with_a_mass_its_transcendental_equation() -> None:
    EA, mu, L = 3e5, 0.8, 1.5
    rod, drive = part("rod", EA=EA, mu=mu, L=L), part("force_source", K=1.0)
    c = math.sqrt(EA / mu)
    rig = axial(rod, drive, sensor=[place("displacement", "rod")])
    quarter = np.array([1.0, 3.0, 5.0]) * c / (4 * L)
    assert natural_frequencies(rig, 1.0, 6 * c / (4 * L)).hz == pytest.approx(quarter, rel=1e-8)
    heavy = axial(rod, part("mass", m=2.0), drive, sensor=[place("displacement", "rod")])
    for hz in natural_frequencies(heavy, 1.0, 500.0).hz:
        b = 2 * math.pi * hz * L / c
        assert 2.0 / (mu * L) * b * math.tan(b) == pytest.approx(1.0, rel=1e-6)


def integrated_frequency(M: np.ndarray, K: np.ndarray, x: np.ndarray, omega: float) -> float:
    """Hz of the motion from rest at x: classic Runge-Kutta, the first mass's zeros counted."""
    h, inverse = 2 * math.pi / omega / 400, np.linalg.inv(M)
    v, before, crossed, n = np.zeros(len(x)), x[0], [], 0
    while len(crossed) < 6:
        a = [-inverse @ K @ x]
        a.append(-inverse @ K @ (x + h / 2 * v))
        a.append(-inverse @ K @ (x + h / 2 * v + h * h / 4 * a[0]))
        a.append(-inverse @ K @ (x + h * v + h * h / 2 * a[1]))
        x = x + h * v + h * h / 6 * (a[0] + a[1] + a[2])
        v = v + h / 6 * (a[0] + 2 * a[1] + 2 * a[2] + a[3])
        n += 1
        if before * x[0] < 0:
            # From the phase at the step next to the zero, exact for one sine.
            crossed.append(n * h - math.atan2(x[0] * omega, v[0]) / omega % (math.pi / omega))
        before = x[0]
    return 5 / 2 / (crossed[-1] - crossed[0])


def test_an_integrator_written_by_hand_swings_at_the_models_frequencies() -> None:
    rig = axial(
        part("spring", "s1", k=4e3), part("mass", "one", m=1.0), part("spring", "s2", k=3e3),
        part("mass", "two", m=0.6), part("force_source", K=1.0),
        sensor=[place("displacement", "one"), place("displacement", "two", "x2")],
    )  # fmt: skip
    M, K = np.diag([1.0, 0.6]), np.array([[7e3, -3e3], [-3e3, 3e3]])
    for hz in natural_frequencies(rig, 0.1, 50.0).hz:
        mode = mode_shape(rig, float(hz))
        shape = np.array([mode.readings["y"], mode.readings["x2"]]).real
        found = integrated_frequency(M, K, shape, 2 * math.pi * hz)
        assert found == pytest.approx(hz, rel=1e-6)


@pytest.mark.parametrize("kind", [k for k in SOURCES if k != "measured_acceleration"])
def test_partial_fractions_and_the_reduced_finite_elements_are_the_chain(kind: str) -> None:
    rig = bench(kind, "ground_damper")
    f = np.geomspace(0.1, 200.0, 50)
    H = Chain(rig).response(f)
    made = realise(rig)
    size = np.abs(H).max(axis=0)
    assert np.max(np.abs(made.response(f) - H) / size) < 1e-6
    assert made.error.max() < 1e-6
    small = reduce(Fem(rig), flexible=2).response(f)
    assert np.max(np.abs(small - H) / size) < 1e-6


def shaken(sensor: list[dict[str, Any]], **suspension: float) -> Rig:
    return axial(
        part("acceleration_source", "drive", K=2.0, **suspension), part("mass", "table", m=0.4),
        part("spring", k=900.0, c=3.0), part("mass", "one", m=1.0), sensor=sensor,
    )  # fmt: skip


def test_a_measured_acceleration_is_that_of_the_table_and_the_limit_of_a_soft_suspension() -> None:
    ideal = shaken([place("acceleration", "drive", "a_0"), *SENSORS_OF_ONE])
    H = Chain(ideal).response(F)[:, :, 0]
    assert H[:, 0] == pytest.approx(2.0, rel=1e-12)
    s = 2j * np.pi * F
    assert np.allclose(H[:, 1], 2.0 * (3.0 * s + 900.0) / (s**2 + 3.0 * s + 900.0), rtol=1e-9)
    soft = shaken(
        [place("acceleration", "drive", "a_0"), *SENSORS_OF_ONE], omega=1e-6, zeta=1.0
    )  # fmt: skip
    assert np.allclose(H, Chain(soft).response(F)[:, :, 0], rtol=1e-5)
    seen = np.einsum("...ij,...jk->...ik", matrix(ideal.element[1], s), matrix(ideal.element[0], s))
    assert np.allclose(s**2 * seen[:, 0, 4], 2.0, rtol=1e-12)


def test_a_measured_acceleration_is_simulated_as_far_as_nothing_drifts() -> None:
    rig = shaken([place("acceleration", "drive", "a_0"), *SENSORS_OF_ONE])
    f = np.geomspace(0.3, 200.0, 50)
    H = Chain(rig).response(f)
    made = realise(rig)
    assert np.max(np.abs(made.response(f) - H) / np.abs(H).max(axis=0)) < 1e-6
    drifts = shaken([place("displacement", "one", "x")])
    with pytest.raises(InputError, match=r"element\[drive\].omega: missing; expected omega and"):
        realise(drifts)
    with pytest.raises(ValueError, match="omega without zeta; expected both, or neither"):
        shaken([place("displacement", "one", "x")], omega=3.0)


def test_only_what_is_fixed_to_a_displaced_table_answers_at_once() -> None:
    rig = axial(
        SOURCES["displacement_source"], part("mass", "table", m=0.4),
        part("spring", k=900.0, c=3.0), part("mass", "one", m=1.0),
        sensor=[place("acceleration", "drive", "a_0"), place("acceleration", "one", "a_1")],
    )  # fmt: skip
    assert feedthrough(Chain(rig))[:, 0] == pytest.approx([2.0 * 60.0**2, 0.0])


RIG = """
name = "bench"
motion = "axial"
base = "clamped"
tip = "free"
rate_hz = 500.0
element = [
    {name = "front", kind = "spring", k = {value = 12.5, unit = "N/mm", source = "sheet"}},
    {name = "one", kind = "mass", m = {value = 850, unit = "g", source = "weighed"}},
    {name = "push", kind = "force_source", input = "v", K = {value = 2, unit = "N/V", source="-"}},
]
sensor = [{name = "x", kind = "displacement", after = "one", unit = "mm"}]
actuator = [{name = "v", unit = "V", low = -1.0, high = 1.0}]
"""
TABLE = (
    '{name = "t", kind = "displacement_source", input = "v", K = {value = 1, unit = "mm/V", '
    'source = "x"}, omega = {value = 9, unit = "Hz", source = "x"}, zeta = {value = 0.7, '
    'unit = "1", source = "x"}},'
)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('kind = "mass"', 'kind = "beam"', "bench.toml: element[one].m: no such field"),
        ('base = "clamped"', 'base = "pinned"', "bench.toml: base: 'pinned' of a chain with"),
        ('motion = "axial"', 'motion = "along"', "motion is 'along'; expected one of lateral, ax"),
        (
            'kind = "displacement", after = "one", unit = "mm"',
            'kind = "absolute_angle", after = "one", unit = "rad"',
            "sensor x: kind 'absolute_angle' of a chain with motion 'axial', which does not turn",
        ),
        ('"g"', '"mm"', "bench.toml: element[one].m: unit 'mm'; expected 'kg'"),
        ('"N/V"', '"N m/V"', "bench.toml: element push: K has unit 'N m/V'; expected 'N/V'"),
        ('input = "v"', 'input = "u"', "element push: input 'u' is no actuator; expected one of"),
        (
            "actuator = [",
            'actuator = [{name = "u", unit = "V", low = -1.0, high = 1.0},',
            "bench.toml: actuator u: drives no element; expected one with this input",
        ),
        (
            '{name = "push"',
            '{name = "pull", kind = "force_source", input = "v", K = {value = -2, unit = "N/V", '
            'source = "x"}}, {name = "push"',
            "element push: drives the same point as pull with the same input 'v'; expected one",
        ),
        (
            '{name = "front"',
            TABLE + TABLE.replace('"t"', '"s"') + '{name = "front"',
            "element s: drives the same point as t with the same input 'v'; expected one of them",
        ),
        (
            'element = [\n    {name = "front", kind = "spring", k = '
            '{value = 12.5, unit = "N/mm", source = "sheet"}},',
            'tip = "clamped"\nelement = [' + TABLE,
            "element push: drives the same point as t",
        ),
        (
            '"one", kind = "mass", m',
            '"one", kind = "mass", I = {value = 1, unit = "kg m^2", source = "x"}, m',
            "element one: I 1 kg m^2 of a chain with motion 'axial', which does not turn",
        ),
        ('after = "one"', 'after = "two"', "sensor x: element 'two' does not exist; expected one"),
    ],
)
def test_a_mistake_is_one_line_that_says_what_would_be_right(old: str, new: str, says: str) -> None:
    assert RIG.count(old) == 1
    text = RIG.replace(old, new)
    if "tip = " in new:
        text = text.replace('tip = "free"\n', "", 1)
    with pytest.raises(InputError) as caught:
        parse(Rig, text, "bench.toml")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_table_between_two_clamps_moves_nothing() -> None:
    with pytest.raises(ValueError, match="drive: moves what is clamped at both ends; expected a"):
        axial(SOURCES["displacement_source"], part("mass", m=1.0), tip="clamped",
              sensor=[place("force", "mass")])  # fmt: skip


def test_a_rod_is_stretched_by_an_axial_chain_alone() -> None:
    text = RIG.replace('motion = "axial"\n', "").replace(
        '"mass", m = {value = 850, unit = "g", source = "weighed"}',
        '"rod", EA = {value = 1, unit = "kN", source = "x"}, '
        'mu = {value = 1, unit = "g/cm", source = "x"}, L = {value = 1, unit = "cm", source = "x"}',
    )
    with pytest.raises(
        InputError, match=r"kind 'rod' moves along the chain; expected motion = \"axial\""
    ):
        parse(Rig, text, "bench.toml")
