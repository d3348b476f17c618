"""Every kind of element against a closed form, a limit or another way to build the same thing."""

import math
from typing import Any

import numpy as np
import pytest
from elements_kit import ANGLE, BEAM, SOURCE, branch, natural_frequencies, part, rig
from scipy.optimize import brentq

from samii_rig.model.tmm import Chain

# A cantilever of EI = 3, mu = 0.2, L = 0.7; UNIT in rad/s is (beta L)^2 = 1.
UNIT = math.sqrt(3.0 / 0.2) / 0.7**2


@pytest.mark.parametrize("stiffness", [0.5, 20.0, 1e5])
def test_a_cantilever_on_an_end_spring_has_its_closed_form_frequencies(stiffness: float) -> None:
    k = stiffness * 3.0 / 0.7**3
    r = rig(
        SOURCE,
        part("beam", **BEAM),
        part("translational_ground_spring", k=k),
        base="clamped",
        tip="free",
    )

    def closed(x: float) -> float:
        c, s, ch, sh = math.cos(x), math.sin(x), math.cosh(x), math.sinh(x)
        return x**3 * (1 + c * ch) + stiffness * (s * ch - c * sh)

    found = natural_frequencies(r, 0.5 * UNIT, 60 * UNIT)
    assert len(found) >= 2
    for w in found:
        x = math.sqrt(w / UNIT)
        assert brentq(closed, 0.999 * x, 1.001 * x) == pytest.approx(x, rel=1e-10)


def test_a_cantilever_with_an_end_torsion_spring_has_its_closed_form_frequencies() -> None:
    ratio = 3.0
    r = rig(
        SOURCE,
        part("beam", **BEAM),
        part("torsional_ground_spring", k=ratio * 3.0 / 0.7),
        base="clamped",
        tip="free",
    )

    def closed(x: float) -> float:
        c, s, ch, sh = math.cos(x), math.sin(x), math.cosh(x), math.sinh(x)
        return x * (1 + c * ch) + ratio * (c * sh + s * ch)

    for w in natural_frequencies(r, 0.5 * UNIT, 60 * UNIT):
        x = math.sqrt(w / UNIT)
        assert brentq(closed, 0.999 * x, 1.001 * x) == pytest.approx(x, rel=1e-10)


@pytest.mark.parametrize(
    ("kind", "end"),
    [("translational_ground_spring", "pinned"), ("torsional_ground_spring", "sliding")],
)
def test_a_spring_to_ground_that_is_infinitely_stiff_holds_its_state(kind: str, end: str) -> None:
    beam = part("beam", **BEAM)
    stiff = natural_frequencies(
        rig(SOURCE, beam, part(kind, k=1e16), base="clamped", tip="free"), UNIT, 60 * UNIT
    )
    roots = {
        "pinned": [3.926602312047919, 7.068582745628732],
        "sliding": [2.3650203724313520, 5.4978039190008],
    }
    assert stiff[:2] == pytest.approx([x**2 * UNIT for x in roots[end]], rel=1e-9)


def test_a_stiff_spring_across_the_chain_is_nothing() -> None:
    f = np.geomspace(0.1, 500, 40)
    tip = {"name": "a", "kind": "acceleration", "on": "body", "position": 0.0, "unit": "m/s^2"}
    body = part("rigid_link", "body", L=0.2, r=0.1, m=1.0, I=0.01)
    beam = part("beam", **BEAM, tau=1e-4)
    bare = Chain(rig(SOURCE, beam, body, base="clamped", tip="free", sensor=[tip])).response(f)
    for kind, k in (
        ("translational_spring", 1e13),
        ("torsional_spring", 1e12),
    ):
        with_it = rig(SOURCE, beam, part(kind, k=k), body, base="clamped", tip="free", sensor=[tip])
        np.testing.assert_allclose(Chain(with_it).response(f), bare, rtol=1e-7)


def test_a_soft_spring_across_the_chain_lets_go_of_what_hangs_on_it() -> None:
    """m on a translational spring k at a clamp swings at sqrt(k/m); theta is held by the base."""
    r = rig(
        SOURCE,
        part("translational_spring", k=80.0),
        part("lumped_mass", m=5.0),
        base="clamped",
        tip="free",
    )
    assert natural_frequencies(r, 0.1, 100) == pytest.approx([4.0], rel=1e-12)


def test_two_masses_on_two_springs() -> None:
    k, m = 100.0, 2.0
    r = rig(
        SOURCE,
        part("translational_spring", "k1", k=k),
        part("lumped_mass", "m1", m=m),
        part("translational_spring", "k2", k=k),
        part("lumped_mass", "m2", m=m),
        base="clamped",
        tip="free",
    )
    golden = [(3 - math.sqrt(5)) / 2, (3 + math.sqrt(5)) / 2]
    assert natural_frequencies(r, 0.1, 100) == pytest.approx(
        [math.sqrt(x * k / m) for x in golden], rel=1e-12
    )


def test_a_pendulum_swings_at_m_g_r_over_its_inertia() -> None:
    m, r, inertia = 3.0, 0.2, 0.04
    chain = rig(
        SOURCE,
        part("gravity_stiffness", k=m * 9.80665 * r),
        part("rigid_link", L=0.5, r=r, m=m, I=inertia),
        base="pinned",
        tip="free",
    )
    expected = math.sqrt(m * 9.80665 * r / (inertia + m * r**2))
    assert natural_frequencies(chain, 0.1, 100) == pytest.approx([expected], rel=1e-12)


def test_an_oil_column_is_a_spring_of_d_squared_over_its_compliance() -> None:
    f = np.geomspace(0.1, 300, 30)
    D, C_h = 1.475e-5, 2e-14
    oil = part("oil_column", "spring", D=D, C_h=C_h)
    spring = part("torsional_spring", "spring", k=D**2 / C_h)
    both = {**ANGLE, "across": ["source", "spring"]}
    H = [
        Chain(
            rig(
                SOURCE, e, part("beam", **BEAM, tau=1e-3), base="clamped", tip="free", sensor=[both]
            )
        ).response(f)
        for e in (oil, spring)
    ]
    np.testing.assert_allclose(H[0], H[1], rtol=1e-12)


LINE = {"D": 1.475e-5, "L": 2.0, "A": 5e-5, "rho": 870.0, "B": 1.4e9, "R": 2e9}
BOTH = {**ANGLE, "across": ["source", "line"]}


def _behind(element: dict[str, Any] | None, f: Any) -> Any:
    beam = part("beam", **BEAM, tau=1e-3)
    parts = [SOURCE, beam] if element is None else [SOURCE, element, beam]
    sensor = ANGLE if element is None else BOTH
    return Chain(rig(*parts, base="clamped", tip="free", sensor=[sensor])).response(f)


def test_a_short_line_is_an_oil_column_and_a_stiff_one_is_nothing() -> None:
    f = np.geomspace(0.1, 100, 30)
    short = {**LINE, "L": 1e-5, "A": 10.0, "R": 0.0}
    oil = part("oil_column", "line", D=LINE["D"], C_h=10.0 * 1e-5 / LINE["B"])
    line = _behind(part("hydraulic_line", "line", source="source", **short), f)
    np.testing.assert_allclose(line, _behind(oil, f), rtol=1e-6)
    stiff = part("hydraulic_line", "line", source="source", **{**LINE, "B": 1e22})
    np.testing.assert_allclose(_behind(stiff, f), _behind(None, f), rtol=1e-6)


def test_a_line_is_the_telegraph_equation_solved_in_a_thousand_pieces() -> None:
    """p' = -(rho s/A + R) Q, Q' = -A s/B p; the vane takes Q = D s theta against p = -M/D."""
    p = LINE
    f = np.array([1.0, 40.0, 150.0, 700.0])
    H = _behind(part("hydraulic_line", "line", source="source", **p), f)[:, 0, 0]
    spring = _behind(part("torsional_spring", "line", k=1e30), f)
    beam = rig(
        SOURCE,
        part("beam", **BEAM, tau=1e-3),
        base="clamped",
        tip="free",
        sensor=[{"name": "M", "kind": "moment", "after": "source", "unit": "N m"}],
    )
    M_by_theta = Chain(beam).response(f)[:, 0, 0] / spring[:, 0, 0]
    for i, x in enumerate(f):
        s = 2j * np.pi * x
        n = 1000
        dx = p["L"] / n
        a = (p["rho"] * s / p["A"] + p["R"]) * dx
        b = p["A"] * s / p["B"] * dx
        half = np.array([[1.0, -a / 2], [0.0, 1.0]])
        T = np.linalg.matrix_power(half @ np.array([[1.0, 0.0], [-b, 1.0]]) @ half, n)
        # (p, Q) at the vane = T (p, Q) at the valve; p_vane = -Z theta/D with M = Z theta.
        flow = p["D"] * 0.5 * 150 / (s + 150)
        Z = M_by_theta[i]
        A = np.array([[T[0, 0], Z / p["D"]], [T[1, 0], -p["D"] * s]])
        theta = np.linalg.solve(A, -flow * T[:, 1])[1]
        assert H[i] == pytest.approx(theta, rel=1e-4)


def test_a_branch_of_a_mass_is_that_mass() -> None:
    f = np.geomspace(0.1, 300, 30)
    mass = part("lumped_mass", m=0.1, I=0.002)
    for other in (mass, part("rigid_link", L=0.0, r=0.0, m=0.1, I=0.002)):
        H = [
            Chain(rig(SOURCE, part("beam", **BEAM), e, base="clamped", tip="free")).field(f)
            for e in (mass, branch(other))
        ]
        np.testing.assert_allclose(H[0], H[1], rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("tip", ["free", "pinned", "clamped"])
def test_a_branch_at_the_free_end_is_the_rest_of_the_chain(tip: str) -> None:
    f = np.geomspace(0.1, 3000, 40)
    rest = [
        part("torsional_spring", k=2.0, c=1e-3),
        part("beam", "rest", EI=1.0, mu=0.3, L=0.9, tau=1e-6),
        part("rigid_link", L=0.1, r=0.05, m=0.2, I=0.001),
    ]
    first = part("beam", **BEAM, tau=1e-6)
    serial = rig(SOURCE, first, *rest, base="clamped", tip=tip)
    side = rig(SOURCE, first, branch(*rest, tip=tip), base="clamped", tip="free")
    a, b = Chain(serial).field(f), Chain(side).field(f)
    np.testing.assert_allclose(a[:, :, 2], b[:, :, 2], rtol=1e-9)
    s = np.array([-3 + 20j, 2 + 300j, -50 - 40j])
    D, scale = Chain(serial).characteristic(s, clear=True)
    E, more = Chain(side).characteristic(s, clear=True)
    ratio = D / E * np.exp(scale - more)
    np.testing.assert_allclose(ratio, ratio[0].real, rtol=1e-7)


MULTIBODY = {"EI": 339137.0, "mu": 5.72815, "L": 7.2}
SHEAR = {"GA": 1.3e13, "J": 0.01333}
BODY = part("rigid_link", "body", L=0.5, r=0.4, m=20.0, I=0.083333)
ALONE = [16.5003, 103.348, 289.087, 565.666, 933.314]  # rad/s, of a multibody code
WITH_BODY = [9.05713, 71.8944, 218.362, 447.682]


@pytest.mark.parametrize(("end", "published"), [([], ALONE), ([BODY], WITH_BODY)])
def test_a_beam_with_shear_and_rotary_inertia_agrees_with_a_multibody_code(
    end: list[dict[str, Any]], published: list[float]
) -> None:
    beam = part("timoshenko_beam", **MULTIBODY, **SHEAR)
    found = natural_frequencies(rig(SOURCE, beam, *end, base="clamped", tip="free"), 1, 1000)
    assert found[: len(published)] == pytest.approx(published, rel=2e-4)


def test_without_rotary_inertia_theory_is_off_by_half_a_percent_at_the_fifth_mode() -> None:
    beam = part("beam", **MULTIBODY)
    found = natural_frequencies(rig(SOURCE, beam, base="clamped", tip="free"), 1, 1000)
    off = [x / y - 1 for x, y in zip(found[:5], ALONE, strict=True)]
    assert off == sorted(off)
    assert 0.003 < off[4] < 0.0055


def test_a_timoshenko_beam_that_is_stiff_in_shear_is_the_euler_bernoulli_beam() -> None:
    """At all frequencies, the series and the waves: the two are solved by different code."""
    f = np.geomspace(0.01, 2000, 60)
    sensor = [
        {"name": "a", "kind": "acceleration", "on": "beam", "position": x, "unit": "m/s^2"}
        | {"name": f"a{i}"}
        for i, x in enumerate((0.1, 0.3, 0.7))
    ]
    thin = {**BEAM, "tau": 1e-5, "eta": 0.01}
    plain, shear = (
        Chain(rig(SOURCE, part(kind, "beam", **values), base="clamped", tip="free", sensor=sensor))
        for kind, values in (("beam", thin), ("timoshenko_beam", {**thin, "GA": 1e14, "J": 0.0}))
    )
    np.testing.assert_allclose(shear.response(f), plain.response(f), rtol=1e-8, atol=1e-300)
    keys = [("beam", x) for x in ("EI", "mu", "L", "eta", "tau")]
    dH = [chain.gradient(f, keys)[1] for chain in (shear, plain)]
    size = np.abs(dH[1]).max(axis=(0, 2), keepdims=True)
    assert np.nanmax(np.abs(dH[0] - dH[1]) / np.maximum(np.abs(dH[1]), 1e-6 * size)) < 1e-5


def test_a_torque_and_a_force_push_the_way_they_are_counted() -> None:
    """Far above its springs a free body turns by T/(I s^2) and moves by F/(m s^2)."""
    body = part("rigid_link", "body", L=0.0, r=0.0, m=2.0, I=0.1)
    turn = {"name": "y", "kind": "absolute_angle", "after": "body", "unit": "rad"}
    move = {"name": "a", "kind": "acceleration", "on": "body", "position": 0.0, "unit": "m/s^2"}
    torque = rig(part("torque_source", K=3.0), body, base="free", tip="free", sensor=[turn])
    force = rig(part("force_source", K=3.0), body, base="free", tip="free", sensor=[move])
    s = 2j * np.pi * 5.0
    assert Chain(torque).response([5.0])[0, 0, 0] == pytest.approx(3.0 / (0.1 * s**2), rel=1e-12)
    assert Chain(force).response([5.0])[0, 0, 0] == pytest.approx(3.0 / 2.0, rel=1e-12)


def test_two_torques_about_a_joint_are_a_motor_inside_it() -> None:
    """theta across the joint obeys I_1 I_2/(I_1 + I_2) s^2 + c s + k = T."""
    joint = part("torsional_spring", "joint", k=5.0, c=0.1)
    one, two = (
        part("rigid_link", n, L=0.0, r=0.0, m=1.0, I=i) for n, i in (("a", 0.2), ("b", 0.3))
    )
    across = {"name": "y", "kind": "relative_angle", "across": ["joint"], "unit": "rad"}
    r = rig(
        one,
        part("torque_source", "back", K=-1.0),
        joint,
        part("torque_source", "forth", K=1.0),
        two,
        base="free",
        tip="free",
        sensor=[across],
    )
    f = np.array([0.3, 1.0, 4.0])
    s = 2j * np.pi * f
    expected = 1 / (0.2 * 0.3 / 0.5 * s**2 + 0.1 * s + 5.0)
    # The damper makes the spring's own compliance 1/(k + c s), so M is what is left of T.
    turned = Chain(r).response(f)[:, 0, 0]
    np.testing.assert_allclose(turned, expected, rtol=1e-10)


def test_a_source_and_a_damper_are_intrinsic_velocity_feedback() -> None:
    """T = g_v (g_a v - s theta), paper 1, eq. 18; on an inertia I: g_a v/(s (1 + I s/g_v))."""
    g_v, inertia = 4.0, 0.5
    damper = part("torsional_spring", "damper", k=0.0, c=g_v)
    load = part("lumped_mass", m=0.0, I=inertia)
    sensor = {**ANGLE, "across": ["source", "damper"]}
    r = rig(SOURCE, damper, load, base="clamped", tip="free", sensor=[sensor])
    f = np.geomspace(0.05, 50, 20)
    s = 2j * np.pi * f
    expected = 0.5 * 150 / (s * (s + 150)) / (1 + inertia * s / g_v)
    np.testing.assert_allclose(Chain(r).response(f)[:, 0, 0], expected, rtol=1e-10)


def test_a_second_order_source_and_a_dead_time_are_their_formulas() -> None:
    w, zeta, tau = 90.0, 0.4, 3e-3
    source = part("angular_velocity_source_2", "source", K=0.5, omega=w, zeta=zeta, tau=tau)
    f = np.geomspace(0.1, 100, 20)
    s = 2j * np.pi * f
    H = Chain(rig(source, part("beam", **BEAM), base="clamped", tip="free")).response(f)[:, 0, 0]
    expected = 0.5 * w**2 / (s * (s**2 + 2 * zeta * w * s + w**2)) * np.exp(-s * tau)
    np.testing.assert_allclose(H, expected, rtol=1e-12)


def test_a_tilted_accelerometer_reads_gravity() -> None:
    on = {"kind": "acceleration", "on": "beam", "position": 0.7, "unit": "m/s^2"}
    sensor = [
        {**on, "name": "plain"},
        {**on, "name": "tilted", "tilt": -1.0},
        {"name": "theta", "kind": "absolute_angle", "after": "beam", "unit": "rad"},
    ]
    chain = Chain(rig(SOURCE, part("beam", **BEAM), base="clamped", tip="free", sensor=sensor))
    H = chain.response(np.geomspace(0.1, 100, 20))[..., 0]
    np.testing.assert_allclose(H[:, 1], H[:, 0] - 9.80665 * H[:, 2], rtol=1e-11)
