"""The physics of the transfer matrix core: closed forms, published numbers, laws."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from samii_rig.errors import InputError
from samii_rig.model import elements
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig

UNITS = {
    "EI": "N m^2", "mu": "kg/m", "L": "m", "eta": "1", "tau": "s", "r": "m", "m": "kg",
    "I": "kg m^2", "k": "N m/rad", "c": "N m s/rad", "K": "rad/(s V)", "p": "rad/s",
}  # fmt: skip
SOURCE = ("source", "angular_velocity_source", {"K": 0.5, "p": 150.0})
ANGLE = {"name": "y", "kind": "relative_angle", "across": ["source"], "unit": "rad"}


def rig(*parts: tuple[str, str, dict[str, float]], base: str, tip: str, **sensor: Any) -> Rig:
    """A chain of (name, kind, values), by default with an encoder at its source."""
    chain = []
    for name, kind, numbers in parts:
        values = {k: {"value": x, "unit": UNITS[k], "source": "test"} for k, x in numbers.items()}
        extra = {"input": "v"} if kind == "angular_velocity_source" else {}
        chain.append({"name": name, "kind": kind, **values, **extra})
    return Rig.model_validate(
        {
            "name": "test", "base": base, "tip": tip, "rate_hz": 500.0, "element": chain,
            "sensor": [{**ANGLE, **sensor}],
            "actuator": [{"name": "v", "unit": "V", "low": -1.0, "high": 1.0}],
        }
    )  # fmt: skip


def natural_frequencies(r: Rig, low: float, high: float, n: int = 2000) -> list[float]:
    """Hz where the characteristic function of a chain without damping changes its sign."""
    chain = Chain(r)
    f = np.linspace(low, high, n)
    D, _ = chain.characteristic(2j * np.pi * f)
    assert np.abs(D.imag).max() < 1e-6
    at = np.flatnonzero(np.diff(np.sign(D.real)))

    def value(x: float) -> float:
        D, scale = chain.characteristic([2j * np.pi * x])
        return float(D[0].real * np.exp(min(scale[0], 0.0)))

    return [float(brentq(value, f[i], f[i + 1], xtol=1e-13)) for i in at]


BEAM = {"EI": 3.0, "mu": 0.2, "L": 0.7}
UNIT = math.sqrt(3.0 / 0.2) / 0.7**2 / (2 * math.pi)  # Hz of (beta L)^2 = 1


@pytest.mark.parametrize(
    ("base", "tip", "roots"),
    [
        ("clamped", "free", [1.875104068711961, 4.694091132974174, 7.854757438237613]),
        ("pinned", "pinned", [math.pi, 2 * math.pi, 3 * math.pi]),
        ("free", "free", [4.730040744862704, 7.853204624095838, 10.995607838001671]),
        ("clamped", "clamped", [4.730040744862704, 7.853204624095838, 10.995607838001671]),
        ("clamped", "pinned", [3.926602312047919, 7.068582745628732, 10.210176122813031]),
        ("pinned", "free", [3.926602312047919, 7.068582745628732, 10.210176122813031]),
    ],
)
def test_a_beam_alone_has_the_textbook_frequencies(base: str, tip: str, roots: list[float]) -> None:
    r = rig(SOURCE, ("beam", "beam", BEAM), base=base, tip=tip)
    found = natural_frequencies(r, 0.1 * UNIT, 1.1 * roots[-1] ** 2 * UNIT)
    assert found == pytest.approx([x**2 * UNIT for x in roots], rel=1e-11)


def test_a_link_on_a_spring_swings_at_k_over_its_inertia() -> None:
    link = {"L": 0.5, "r": 0.2, "m": 3.0, "I": 0.04}
    r = rig(
        SOURCE, ("spring", "torsional_spring", {"k": 80.0}), ("link", "rigid_link", link),
        base="clamped", tip="free",
    )  # fmt: skip
    expected = math.sqrt(80.0 / (0.04 + 3.0 * 0.2**2)) / (2 * math.pi)
    assert natural_frequencies(r, 0.1, 10) == pytest.approx([expected], rel=1e-12)


def test_a_mass_at_the_end_of_a_light_beam_is_a_mass_on_a_spring() -> None:
    light = {"EI": 3.0, "mu": 1e-9, "L": 0.7}
    mass = {"L": 0.0, "r": 0.0, "m": 2.0, "I": 0.0}
    r = rig(
        SOURCE, ("beam", "beam", light), ("mass", "rigid_link", mass), base="clamped", tip="free"
    )
    expected = math.sqrt(3 * 3.0 / 0.7**3 / 2.0) / (2 * math.pi)
    assert natural_frequencies(r, 0.05, 5) == pytest.approx([expected], rel=1e-8)


def test_a_stiff_heavy_beam_is_a_rigid_link() -> None:
    spring = ("spring", "torsional_spring", {"k": 80.0, "c": 0.1})
    beam = ("body", "beam", {"EI": 1e9, "mu": 4.0, "L": 0.5})
    link = ("body", "rigid_link", {"L": 0.5, "r": 0.25, "m": 2.0, "I": 2.0 * 0.5**2 / 12})
    f = np.geomspace(0.1, 50, 40)
    H = [
        Chain(_with_sensor(rig(SOURCE, spring, body, base="clamped", tip="free"))).response(f)
        for body in (beam, link)
    ]
    np.testing.assert_allclose(H[0], H[1], rtol=1e-5)


def _with_sensor(r: Rig, on: str = "body", position: float = 0.5) -> Rig:
    sensor = {"name": "y", "kind": "acceleration", "on": on, "position": position, "unit": "m/s^2"}
    return Rig.model_validate({**r.model_dump(), "sensor": [sensor]})


def test_a_perfect_collocated_encoder_sees_the_source_alone() -> None:
    samii, _ = load_rig("samii")
    data = samii.model_dump()
    data["sensor"][0]["across"] = ["joint_2_source"]
    f = np.geomspace(0.01, 10000, 300)
    s = 2j * np.pi * f
    H = Chain(Rig.model_validate(data)).response(f)[:, 0, 0]
    np.testing.assert_allclose(H, 0.5 * 150 / (s * (s + 150)), rtol=1e-15)


def perfect_joints() -> Rig:
    samii, _ = load_rig("samii")
    data = samii.model_dump()
    data["element"] = [e for e in data["element"] if e["kind"] != "torsional_spring"]
    data["sensor"][0]["across"] = ["joint_2_source"]
    return Rig.model_validate(data)


def _undamped(r: Rig) -> Rig:
    data = r.model_dump()
    for e in data["element"]:
        for symbol in ("c", "eta", "tau"):
            if symbol in e:
                e[symbol]["value"] = 0.0
    return Rig.model_validate(data)


def test_perfect_joints_give_table_i_of_paper_1() -> None:
    found = natural_frequencies(_undamped(perfect_joints()), 0.5, 30)
    assert found == pytest.approx([2.299, 21.417], rel=0.002)


def test_flexible_joints_give_table_iii_of_paper_1() -> None:
    found = natural_frequencies(_undamped(load_rig("samii")[0]), 0.5, 10)
    assert found == pytest.approx([1.703, 7.394], rel=0.002)


def test_a_stiffer_clamp_raises_mode_1() -> None:
    r = _undamped(load_rig("samii")[0])
    soft, stiff = (Chain(r).with_values({("clamp", "k"): k}).rig for k in (2.674e5, 3.0e5))
    assert natural_frequencies(stiff, 1, 3)[0] > natural_frequencies(soft, 1, 3)[0]


def test_a_lag_is_a_negative_phase() -> None:
    """The source alone: 0.5 * 150 / (s (s + 150)) at s = 150 j is -90 - 45 degrees."""
    r = rig(SOURCE, ("beam", "beam", BEAM), base="clamped", tip="free")
    H = Chain(r).response([150 / (2 * math.pi)])[0, 0, 0]
    assert math.degrees(np.angle(H)) == pytest.approx(-135, abs=1e-9)


def test_the_response_is_conjugate_symmetric() -> None:
    chain = Chain(load_rig("samii")[0])
    s = np.array([3 + 20j, -1 + 300j, 0.1 + 5000j])
    np.testing.assert_allclose(chain.evaluate(np.conj(s)), np.conj(chain.evaluate(s)), rtol=1e-13)
    D, scale = chain.characteristic(s)
    mirrored, same = chain.characteristic(np.conj(s))
    np.testing.assert_allclose(mirrored, np.conj(D), rtol=1e-12)
    np.testing.assert_allclose(same, scale, rtol=1e-12)


def test_the_characteristic_function_is_that_of_the_plain_product() -> None:
    """Phase and modulus, at low frequency where the plain product still holds digits."""
    for name in ("samii", "sflr"):
        r, _ = load_rig(name)
        s = np.array([0.3 + 2j, -4 + 40j, 20 - 90j, -30 + 0j, 500 + 300j])
        U = np.broadcast_to(np.eye(5, dtype=complex), (s.size, 5, 5))
        for e in r.element:
            U = elements.matrix(e, s) @ U
        plain = np.linalg.det(U[:, 2:4, 2:4])
        D, scale = Chain(r).characteristic(s)
        np.testing.assert_allclose(D * np.exp(scale), plain, rtol=1e-7)
        cleared, more = Chain(r).characteristic(s, clear=True)
        factor = np.prod(
            [1 + s * e.c.value / e.k.value for e in r.element if e.kind == "torsional_spring"],
            axis=0,
        )
        np.testing.assert_allclose(cleared * np.exp(more), plain * factor, rtol=1e-7)


def test_the_characteristic_function_is_analytic_across_the_beams_threshold() -> None:
    """Around a circle that crosses from the series to the waves, Cauchy's integral vanishes."""
    chain = Chain(rig(SOURCE, ("beam", "beam", {**BEAM, "tau": 1e-3}), base="free", tip="free"))
    n = 256
    turn = np.exp(2j * np.pi * np.arange(n) / n)
    centre = 2j * np.pi * UNIT * 1.5**2
    D, scale = chain.characteristic(centre + 10 * turn)
    D = D * np.exp(scale - scale[0])
    assert abs((D * turn).mean()) < 1e-11 * np.abs(D).max()


def test_a_jump_answers_reciprocally() -> None:
    """Rotation at port 9 by a moment at port 3 is the rotation at 3 by the moment at 9."""
    chain = Chain(load_rig("samii")[0])
    z = chain.field([0.3, 7.0, 90.0, 3000.0], jumps=[(3, "M"), (9, "M"), (3, "V")])
    np.testing.assert_allclose(z[:, 0, 9, 1], z[:, 1, 3, 1], rtol=1e-11)
    np.testing.assert_allclose(z[:, 2, 9, 1], -z[:, 1, 3, 0], rtol=1e-11)


def test_fields_obey_every_element_and_both_ends() -> None:
    r, _ = load_rig("samii")
    chain = Chain(r)
    f = np.array([0.5, 7.4, 60.0])
    z = chain.field(f)[:, 0]
    port = [name for name, _ in chain.places()].index("joint_2_source")
    np.testing.assert_allclose(z[:, 0, :2], 0, atol=0)
    np.testing.assert_allclose(z[:, -1, 2:], 0, atol=0)
    for i, e in enumerate(r.element):
        U = elements.matrix(e, 2j * np.pi * f)
        ahead = np.concatenate([z[:, i], np.ones((3, 1))], axis=1)
        expected = (U @ ahead[..., None])[:, :4, 0]
        assert np.abs(z[:, i + 1] - expected).max() < 1e-9 * np.abs(z[:, i : i + 2]).max()
    assert port == 6
    H = chain.response(f)
    np.testing.assert_allclose(-((2 * np.pi * f) ** 2) * z[:, -1, 0], H[:, 3, 0], rtol=1e-12)


def test_a_mode_shape_does_not_depend_on_where_the_beam_is_looked_at() -> None:
    chain = Chain(load_rig("samii")[0])
    coarse = chain.field([1.7])
    fine = chain.field([1.7], positions={"beam": [1.0, 2.0, 3.0]})
    names = chain.places({"beam": [1.0, 2.0, 3.0]})
    assert names[2:5] == (("beam", 1.0), ("beam", 2.0), ("beam", 3.0))
    keep = [i for i in range(len(names)) if i not in (2, 3, 4)]
    np.testing.assert_allclose(fine[:, :, keep], coarse, rtol=1e-11)
    w = np.abs(fine[0, 0, 1:6, 0])
    assert (np.diff(w) > 0).all()  # the first mode of a cantilever grows to its end


positive = st.floats(0.1, 10.0)


@settings(max_examples=60)
@given(
    s=st.complex_numbers(min_magnitude=0.1, max_magnitude=20.0, allow_nan=False),
    a=positive, b=positive, c=positive, d=positive,
)  # fmt: skip
def test_every_element_keeps_the_symplectic_product(
    s: complex, a: float, b: float, c: float, d: float
) -> None:
    at = np.array([s])
    for U in (
        elements.beam_matrix(at, a, b, 1.0, 0.01, 1e-3),
        elements.rigid_link_matrix(at, a, b, c, d),
        elements.torsional_spring_matrix(at, a, 0.0),
    ):
        T = U[0, :4, :4]
        size = np.abs(T).max() ** 2
        assert np.abs(T.T @ elements.J @ T - elements.J).max() < 1e-12 * max(size, 1.0)


@settings(max_examples=25)
@given(
    numbers=st.lists(st.floats(0.2, 5.0), min_size=8, max_size=8),
    f=st.floats(0.05, 3.0),
    base=st.sampled_from(["clamped", "pinned", "free"]),
    tip=st.sampled_from(["clamped", "pinned", "free"]),
)
def test_any_chain_agrees_with_the_plain_product_where_that_holds(
    numbers: list[float], f: float, base: str, tip: str
) -> None:
    r = _chain(numbers, base, tip)
    s = np.array([2j * np.pi * f])
    z = Chain(r).field([f])[0, 0]
    zero = {"clamped": [0, 1], "pinned": [0, 2], "free": [2, 3]}
    free = [k for k in range(4) if k not in zero[base]]
    U = np.eye(5, dtype=complex)
    for element in r.element:
        U = elements.matrix(element, s)[0] @ U
    start = np.zeros(5, complex)
    start[4] = 1
    A = U[np.ix_(zero[tip], free)]
    start[free] = np.linalg.solve(A, -U[zero[tip], 4])
    tolerance = 1e-12 * np.linalg.cond(A)
    assert np.abs(z[-1] - (U @ start)[:4]).max() < tolerance * np.abs(U).max() * np.abs(z).max()


def _chain(numbers: list[float], base: str, tip: str) -> Rig:
    a, b, c, d, e, g, h, i = numbers
    return rig(
        ("beam", "beam", {"EI": a, "mu": b, "L": c / 4, "tau": 0.01}),
        ("joint", "torsional_spring", {"k": d, "c": 0.1}),
        SOURCE,
        ("link", "rigid_link", {"L": e / 4, "r": e / 9, "m": g, "I": h}),
        ("end", "beam", {"EI": i, "mu": a, "L": b / 4, "eta": 0.02}),
        base=base,
        tip=tip,
    )


def test_sixty_joints_neither_overflow_nor_lose_the_response() -> None:
    """At 10 kHz each link and spring multiplies the plain product by 1e5."""
    parts = [SOURCE]
    for n in range(60):
        parts.append((f"spring_{n}", "torsional_spring", {"k": 1e3, "c": 0.1}))
        parts.append((f"link_{n}", "rigid_link", {"L": 0.1, "r": 0.05, "m": 1.0, "I": 0.01}))
    chain = Chain(rig(*parts, base="clamped", tip="free"))
    H, dH = chain.gradient([0.01, 1.0, 100.0, 1e4])
    assert np.isfinite(H).all()
    assert np.isfinite(dH).all()
    D, scale = chain.characteristic(2j * np.pi * np.array([100.0, 1e4]))
    assert np.abs(D) == pytest.approx(1)
    assert np.isfinite(scale).all()


def test_a_chain_without_support_answers_at_every_frequency_above_zero() -> None:
    link = ("link", "rigid_link", {"L": 0.5, "r": 0.2, "m": 3.0, "I": 0.04})
    last = ("last", "rigid_link", {"L": 0.5, "r": 0.2, "m": 3.0, "I": 0.04})
    chain = Chain(rig(link, SOURCE, last, base="free", tip="free"))
    z = chain.field(np.geomspace(1e-3, 1e4, 50))
    assert np.isfinite(z).all()


@pytest.mark.parametrize("f", [0.0, -1.0, math.nan, math.inf])
def test_a_frequency_that_is_none_is_refused(f: float) -> None:
    chain = Chain(load_rig("sflr")[0])
    for ask in (chain.response, chain.gradient, chain.field):
        with pytest.raises(InputError, match="above 0 Hz"):
            ask([1.0, f])


def test_unknown_names_and_impossible_values_are_refused() -> None:
    chain = Chain(load_rig("sflr")[0])
    with pytest.raises(InputError, match=r"clamp\.x.*known parameter"):
        chain.with_values({("clamp", "x"): 1.0})
    with pytest.raises(InputError, match=r"clamp\.k.*-1 N m/rad; expected 0 or more"):
        chain.with_values({("clamp", "k"): -1.0})
    with pytest.raises(InputError, match=r"clamp\.k"):
        chain.with_values({("clamp", "k"): math.nan})
    with pytest.raises(InputError, match="once"):
        chain.gradient([1.0], wrt=[("clamp", "k"), ("clamp", "k")])
    with pytest.raises(InputError, match="port"):
        chain.field([1.0], jumps=[(99, "w")])
    with pytest.raises(InputError, match="between 0 and L"):
        chain.places({"beam": [7.0]})
    with pytest.raises(InputError, match="a beam of"):
        chain.places({"clamp": [0.0]})


def test_a_part_of_the_gradient_is_that_part() -> None:
    chain = Chain(load_rig("samii")[0])
    keys = [("joint_2", "c"), ("beam", "mu"), ("joint_2_source", "p")]
    _, all_ = chain.gradient([1.0, 20.0])
    _, some = chain.gradient([1.0, 20.0], wrt=keys)
    at = [chain.parameters.index(key) for key in keys]
    np.testing.assert_allclose(some, all_[..., at], rtol=1e-12)


def test_two_sources_of_one_input_add_up() -> None:
    second = ("second", "angular_velocity_source", {"K": 0.5, "p": 150.0})
    beam = ("beam", "beam", BEAM)
    one = Chain(rig(SOURCE, beam, base="clamped", tip="free")).field([2.0])
    two = Chain(rig(SOURCE, second, beam, base="clamped", tip="free"))
    np.testing.assert_allclose(two.field([2.0])[:, :, -1], 2 * one[:, :, -1], rtol=1e-13)
    np.testing.assert_allclose(2 * two.response([2.0])[0, 0], two.field([2.0])[0, :, 2, 1])


def test_no_frequency_gives_no_rows() -> None:
    chain = Chain(load_rig("samii")[0])
    assert chain.response([]).shape == (0, 4, 1)
    assert chain.gradient([])[1].shape == (0, 4, 1, len(chain.parameters))
    assert chain.field([]).shape == (0, 1, 11, 4)


def test_values_given_are_values_used() -> None:
    chain = Chain(load_rig("samii")[0])
    changed = chain.with_values({("joint_2", "k"): 2e4})
    at = chain.parameters.index(("joint_2", "k"))
    assert changed.values()[at] == 2e4
    assert chain.values()[at] == 0.108e5
    h = 1e-4
    up, down = (chain.with_values({("joint_2", "k"): 0.108e5 * (1 + x)}) for x in (h, -h))
    slope = (up.response([5.0]) - down.response([5.0])) / (2 * h * 0.108e5)
    np.testing.assert_allclose(chain.gradient([5.0])[1][..., at], slope, rtol=1e-6)


def accelerometer_on_the_beam(length: float) -> Rig:
    """A clamped beam of some length, 0.3 m from whose root an accelerometer stands."""
    beam = ("beam", "beam", {**BEAM, "L": length})
    last = ("last", "rigid_link", {"L": 0.5, "r": 0.2, "m": 3.0, "I": 0.04})
    return _with_sensor(rig(beam, SOURCE, last, base="clamped", tip="free"), "beam", 0.3)


@pytest.mark.parametrize("L", [0.35, 0.70001, 0.9])
def test_a_beam_that_a_sensor_divides_is_as_long_as_it_is_said_to_be(L: float) -> None:
    s = 1.0 + 2j * math.pi * np.geomspace(0.5, 300.0, 60)
    plain = Chain(accelerometer_on_the_beam(0.7))
    longer, built = plain.with_values({("beam", "L"): L}), Chain(accelerometer_on_the_beam(L))
    assert np.max(np.abs(longer.evaluate(s) / plain.evaluate(s) - 1)) > 1e-6
    np.testing.assert_allclose(longer.evaluate(s), built.evaluate(s), rtol=1e-9)
    np.testing.assert_allclose(longer.gradient_at(s)[1], built.gradient_at(s)[1], rtol=1e-7)
    for one, other in zip(longer.characteristic(s), built.characteristic(s), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)
    again = longer.with_values({("beam", "L"): 0.7})
    np.testing.assert_allclose(again.evaluate(s), plain.evaluate(s), rtol=1e-9)


def test_a_beam_ends_behind_the_sensor_on_it() -> None:
    chain = Chain(accelerometer_on_the_beam(0.7))
    with pytest.raises(InputError, match=r"beam\.L.*0\.3"):
        chain.with_values({("beam", "L"): 0.29})
    last = chain.with_values({("beam", "L"): 0.3})  # where the sensor is its end
    built = Chain(accelerometer_on_the_beam(0.3))
    np.testing.assert_allclose(last.response([1.0, 30.0]), built.response([1.0, 30.0]), rtol=1e-12)
