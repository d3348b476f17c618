"""The finite element model against closed forms, other programs, published numbers, and the
transfer matrices, which share no code with it.

A consistent mass makes natural frequencies too high, never too low (Rayleigh-Ritz), and cubic
elements make the error fall with the fourth power of their length: both are laws here.
"""

import numpy as np
import pytest
from fem_kit import SOURCE, chain, samii, undamped, with_stiffness, without_springs
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from samii_rig.errors import InputError
from samii_rig.fem.model import Fem
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig

SPRINGS = {"clamp", "joint_1", "joint_2", "joint_3"}
METHOD_2 = {"joint_1": 0.0651e5, "joint_2": 0.0713e5}  # paper 1, Table II


def tmm_hz(rig: Rig, near: np.ndarray) -> np.ndarray:
    """The transfer matrices' natural frequency near each of these, Hz."""
    lossless = Chain(undamped(rig))

    def value(f: float) -> float:
        return float(lossless.characteristic([2j * np.pi * f])[0][0].real)

    return np.array([brentq(value, 0.99 * f, 1.005 * f, xtol=1e-13) for f in near])


# --- the beam alone and with a body ---------------------------------------------------------

BEAM = {"EI": 339137.0, "mu": 5.72815, "L": 7.2}
BODY = {"L": 0.5, "r": 0.4, "m": 20.0, "I": 0.083333}
CANTILEVER = [1.875104068711961, 4.694091132974174, 7.854757438237613, 10.995540734875467]
BEAM_RIG = chain(SOURCE, ("beam", "beam", BEAM))


def exact_cantilever() -> np.ndarray:
    return np.array(CANTILEVER) ** 2 * np.sqrt(BEAM["EI"] / BEAM["mu"]) / BEAM["L"] ** 2


def test_a_cantilever_is_approached_from_above_with_the_fourth_power_of_the_mesh() -> None:
    meshes = np.array([5, 10, 20, 40])
    errors = np.array(
        [Fem(BEAM_RIG, elements=n).modes(4).omega / exact_cantilever() - 1 for n in meshes]
    )
    assert np.all(errors > 0)
    # The last refinement of mode 1 is at 4e-9 and feels rounding.
    assert np.log2(errors[1] / errors[2]) == pytest.approx([4, 4, 4, 4], abs=0.07)
    assert np.log2(errors[2] / errors[3])[1:] == pytest.approx([4, 4, 4], abs=0.03)


@pytest.mark.parametrize(
    ("base", "tip", "roots", "rigid"),
    [
        ("pinned", "pinned", [np.pi, 2 * np.pi], 0),
        ("free", "free", [4.730040744862704, 7.853204624095838], 2),
        ("clamped", "clamped", [4.730040744862704, 7.853204624095838], 0),
        ("clamped", "pinned", [3.926602312047919, 7.068582745628732], 0),
        ("pinned", "free", [3.926602312047919, 7.068582745628732], 1),
    ],
)
def test_every_boundary_has_its_textbook_frequencies_and_its_rigid_modes(
    base: str, tip: str, roots: list[float], rigid: int
) -> None:
    rig = chain(SOURCE, ("beam", "beam", BEAM), base=base, tip=tip)
    omega = Fem(rig, elements=40).modes(rigid + 2).omega
    assert np.all(omega[:rigid] < 1e-2)
    expected = np.array(roots) ** 2 * np.sqrt(BEAM["EI"] / BEAM["mu"]) / BEAM["L"] ** 2
    assert omega[rigid:] == pytest.approx(expected, rel=2e-6)


@pytest.mark.parametrize(
    ("parts", "reference", "excess"),
    [
        # A multibody code's beam with rotary inertia, which Euler-Bernoulli has not: the excess
        # grows with the mode to half a percent.
        ([], [16.5003, 103.348, 289.087, 565.666, 933.314], [2e-4, 8e-4, 2e-3, 4e-3, 6e-3]),
        ([("body", "rigid_link", BODY)], [9.05713, 71.8944, 218.362, 447.682],
         [5e-5, 4e-4, 1e-3, 2e-3]),
    ],
)  # fmt: skip
def test_a_code_with_rotary_inertia_is_lower_by_what_theory_says(
    parts: list[tuple[str, str, dict[str, float]]], reference: list[float], excess: list[float]
) -> None:
    rig = chain(SOURCE, ("beam", "beam", BEAM), *parts)
    over = Fem(rig, elements=30).modes(len(reference)).omega / reference - 1
    assert np.all(over > 0)
    assert np.all(over < excess)
    assert over[-1] > 0.5 * excess[-1]  # it does show
    assert np.all(np.diff(over) > 0)


# --- SAMII: the published tables ------------------------------------------------------------


def test_table_1_perfect_joints() -> None:
    fem = Fem(samii(), rigid=SPRINGS)
    hz = fem.modes(2).frequency_hz
    assert hz == pytest.approx([2.298, 21.412], rel=2e-3)
    exact = tmm_hz(without_springs(samii(), SPRINGS), hz)
    assert exact == pytest.approx([2.299, 21.417], rel=2e-3)
    assert np.all(hz >= exact * (1 - 1e-9))
    assert hz == pytest.approx(exact, rel=5e-4)


def test_table_3_method_1() -> None:
    hz = Fem(samii()).modes(4).frequency_hz
    assert hz[:2] == pytest.approx([1.703, 7.394], rel=2e-3)
    exact = tmm_hz(samii(), hz)
    assert np.all(hz >= exact * (1 - 1e-9))
    assert hz == pytest.approx(exact, rel=5e-4)


def test_table_3_method_2() -> None:
    rig = with_stiffness(samii(), METHOD_2)
    hz = Fem(rig, rigid={"clamp", "joint_3"}).modes(2).frequency_hz
    assert hz == pytest.approx([2.209, 5.935], rel=5e-4)
    assert hz == pytest.approx([2.2, 6.0], rel=1.5e-2)


def test_a_locked_spring_is_one_that_is_not_there() -> None:
    locked = Fem(samii(collocated=True), rigid={"joint_1", "joint_3"})
    gone = Fem(without_springs(samii(), {"joint_1", "joint_3"}))
    f = np.geomspace(0.1, 50, 20)
    assert locked.response(f) == pytest.approx(gone.response(f), rel=1e-8)


def test_the_count_of_coordinates() -> None:
    # 16 beam nodes and 4 bodies of 2, 5 joints; 2 multipliers at each of 5 joinings, 1 source.
    assert Fem(samii()).size == (16 * 2 + 4 * 2 + 5, 5 * 2 + 1)


# --- frequency responses, states, poles -----------------------------------------------------


def test_responses_of_both_rigs_are_those_of_the_transfer_matrices_to_50_hz() -> None:
    f = np.geomspace(0.1, 50, 60)
    for name, mesh, within in [("samii", 15, 2e-5), ("samii", 60, 2e-7), ("sflr", 60, 3e-6)]:
        rig = load_rig(name)[0]
        H = Chain(rig).response(f)
        assert Fem(rig, elements=mesh).response(f) == pytest.approx(H, rel=within)


SENSORS = [
    {"name": "s1", "kind": "relative_angle", "across": ["spring", "beam", "source"], "unit": "rad"},
    {"name": "s2", "kind": "absolute_angle", "after": "link", "unit": "rad"},
    {"name": "s3", "kind": "acceleration", "on": "beam", "position": 0.317, "unit": "m/s^2"},
    {"name": "s4", "kind": "acceleration", "on": "link", "position": 0.25, "unit": "m/s^2"},
    *(
        {"name": f"m_{after}", "kind": "moment", "after": after, "unit": "N m"}
        for after in ("spring", "beam", "source", "link", "last")
    ),
]
positive = st.floats(0.5, 2.0)
ends = st.sampled_from(["clamped", "pinned", "free"])


@settings(max_examples=25)
@given(
    base=ends, tip=ends, numbers=st.tuples(*[positive] * 8), loss=st.floats(0, 0.05),
    order=st.permutations(["spring", "beam", "source", "link", "last"]),
)  # fmt: skip
def test_any_chain_with_any_ends_and_sensors_agrees_with_the_transfer_matrices(
    base: str, tip: str, numbers: tuple[float, ...], loss: float, order: list[str]
) -> None:
    a, b, c, d, e, f, g, h = numbers
    parts = {
        "spring": ("spring", "torsional_spring", {"k": 4.0 * a, "c": 0.02}),
        "beam": ("beam", "beam", {"EI": 3 * b, "mu": 0.2 * c, "L": 0.7, "eta": loss, "tau": 1e-4}),
        "source": SOURCE,
        "link": ("link", "rigid_link", {"L": 0.3, "r": 0.1 * d, "m": 0.4 * e, "I": 2e-3 * f}),
        "last": ("last", "torsional_spring", {"k": 3.0 * g, "c": 0.01 * h}),
    }
    spans = [s for s in SENSORS if s["name"] != "s1"]
    across = {"name": "s1", "kind": "relative_angle", "across": order[1:4], "unit": "rad"}
    rig = chain(*(parts[name] for name in order), base=base, tip=tip, sensors=[across, *spans])
    hz = np.array([0.7, 6.0, 31.0])
    H = Chain(rig).response(hz)[:, :, 0]
    least = 1e-3 * np.array([1, 1, *[40**2] * 2, *[100.0] * 5])  # rad, m/s^2, N m: zeros of H
    error = abs(Fem(rig, elements=60).response(hz)[:, :, 0] - H)
    assert np.all(error <= 1e-4 * (abs(H) + least))


def test_the_response_of_a_real_input_is_real() -> None:
    rig = chain(SOURCE, ("beam", "beam", {**BEAM, "eta": 0.02}))
    fem = Fem(rig)
    s = np.array([3 + 20j])
    assert fem.evaluate(s.conj()) == pytest.approx(fem.evaluate(s).conj(), rel=1e-12)


def test_poles_are_those_of_the_response() -> None:
    fem = Fem(samii())
    for pole in fem.poles()[:3]:
        assert (
            abs(fem.evaluate([pole * (1 + 1e-7)])).max()
            > 1e4 * abs(fem.evaluate([1.1 * pole])).max()
        )


def test_rayleigh_damping_gives_each_mode_its_share() -> None:
    alpha, beta = 2e-4, 0.05
    fem = Fem(samii(), rayleigh=(alpha, beta))
    poles, omega = fem.poles()[:5], fem.modes(5).omega
    assert abs(poles) == pytest.approx(omega, rel=1e-7)
    assert -2 * poles.real == pytest.approx(alpha * omega**2 + beta, rel=1e-6)


def test_two_springs_in_a_row_are_one_with_a_part_between_that_has_no_mass() -> None:
    link = ("link", "rigid_link", {"L": 0.3, "r": 0.1, "m": 0.4, "I": 2e-3})
    two = [("a", "torsional_spring", {"k": 30.0, "c": 0.3}),
           ("b", "torsional_spring", {"k": 60.0, "c": 0.1})]  # fmt: skip
    fem = Fem(chain(SOURCE, *two, link))
    inertia = 2e-3 + 0.4 * 0.1**2
    assert fem.modes().omega == pytest.approx([np.sqrt(20.0 / inertia)], rel=1e-12)
    # inertia s^2 (1/(k1 + c1 s) + 1/(k2 + c2 s)) + 1 = 0
    roots = np.roots(np.polyadd(inertia * np.array([0.4, 90.0, 0, 0]), [0.03, 21.0, 1800.0]))
    expected = roots[roots.imag >= 0]
    assert np.sort_complex(fem.poles()) == pytest.approx(np.sort_complex(expected), rel=1e-9)


def test_the_mode_shapes_bend_where_the_joints_are() -> None:
    fem = Fem(samii())
    shapes, places = fem.modes(2).shapes, fem.mechanism.places
    theta = places.theta @ shapes
    soft = [places.element.index(name) for name in ("clamp", "joint_1", "joint_2", "joint_3")]
    kink = abs(theta[soft] - theta[np.array(soft) - 1])
    assert np.all(kink > 0)
    held = places.element.index("joint_2_source")
    assert theta[held] == pytest.approx(theta[held - 1], abs=1e-12)
    w = places.w @ shapes
    assert np.all(w.max(axis=0) == abs(w).max(axis=0))
    assert shapes.T @ fem.mechanism.M @ shapes == pytest.approx(np.eye(2), abs=1e-9)
    assert places.x[-1] == pytest.approx(4.6482 + 0.3302 + 0.1969 + 0.4001 + 0.5)


# --- velocity feedback (paper 1, eq. 18) ----------------------------------------------------


def test_velocity_feedback_without_end_is_the_velocity_source() -> None:
    f = np.geomspace(0.3, 30, 40)
    source = Fem(samii()).response(f)
    lag = 1 / (1 + 2j * np.pi * f / 150.0)[:, None, None]  # eq. 15 has none, the rig's source has
    off = []
    for g_v in (1e5, 1e6, 1e7):
        H = Fem(samii(), feedback={"joint_2_source": (g_v, 0.5)}).response(f) * lag
        off.append(np.max(abs(H / source - 1)))
    assert off[0] < 1e-2
    assert np.array(off[1:]) * 10 == pytest.approx(off[:-1], rel=0.05)


def test_velocity_feedback_is_a_damper_in_series_with_a_velocity_source() -> None:
    # Section V-A: what the transfer matrices can do instead, 1e-6 N m/rad for no stiffness.
    rig, g_v = samii(), 500.0
    i = [e.name for e in rig.element].index("joint_2_source")
    damper = {"k": 1e-6, "c": g_v}
    spring = chain(SOURCE, ("damper", "torsional_spring", damper)).element[1]
    series = rig.model_copy(update={
        "element": (*rig.element[: i + 1], spring, *rig.element[i + 1 :]),
        "sensor": (rig.sensor[0].model_copy(
            update={"across": ("joint_2_source", "damper", "joint_2")}), *rig.sensor[1:]),
    })  # fmt: skip
    f = np.geomspace(0.5, 30, 40)
    lag = 1 / (1 + 2j * np.pi * f / 150.0)[:, None, None]
    H = Fem(rig, elements=40, feedback={"joint_2_source": (g_v, 0.5)}).response(f) * lag
    assert Chain(series).response(f) == pytest.approx(H, rel=1e-6)


@pytest.mark.parametrize("rayleigh", [None, (2e-3, 0.0)])
def test_a_collocated_encoder_dips_and_then_rises_with_velocity_feedback(
    rayleigh: tuple[float, float] | None,
) -> None:
    f = np.linspace(4, 14, 200)

    def phase(**given: object) -> np.ndarray:
        H = Fem(samii(collocated=True), rayleigh=rayleigh, **given).response(f)[:, 0, 0]
        return np.degrees(np.unwrap(np.angle(H))) + 90

    feedback = phase(feedback={"joint_2_source": (500.0, 0.5)})
    assert -35 < feedback.min() < -20  # paper 2, Fig. 5: 20 to 30 degrees each
    assert 10 < feedback.max() < 30
    assert feedback.argmin() < feedback.argmax()
    assert np.all(np.diff(phase()) < 0)  # a prescribed rotation only lags


def test_velocity_feedback_sets_the_damping_and_hardly_the_frequencies() -> None:
    def pair(g_v: float) -> np.ndarray:
        poles = Fem(samii(), feedback={"joint_2_source": (g_v, 0.5)}).poles()
        return poles[poles.imag > 1][:2]

    strong, papers, weak = pair(1e6), pair(500.0), pair(100.0)
    assert abs(papers) == pytest.approx(abs(strong), rel=0.025)
    assert -papers[1].real > 1.5 * -strong[1].real
    assert abs(weak[1]) < 0.93 * abs(strong[1])  # and here it is no longer so


# --- what is refused ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"rigid": {"joint_9"}}, "joint_9"),
        ({"rigid": {"joint_2_source"}}, "torsional springs"),
        ({"feedback": {"joint_2": (1.0, 1.0)}}, "sources"),
        ({"feedback": {"joint_2_source": (0.0, 1.0)}}, "above 0"),
        ({"elements": 0}, "1 beam element"),
    ],
)
def test_a_wrong_argument_is_one_clear_line(arguments: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Fem(samii(), **arguments)


@pytest.mark.parametrize("f", [0.0, -1.0, np.nan, np.inf])
def test_frequencies_are_above_zero(f: float) -> None:
    with pytest.raises(InputError, match="frequency_hz"):
        Fem(samii()).response([1.0, f])


def test_a_loss_factor_has_no_poles() -> None:
    rig = chain(SOURCE, ("beam", "beam", {**BEAM, "eta": 0.02}))
    with pytest.raises(InputError, match=r"beam.eta is 0\.02; expected 0"):
        Fem(rig).poles()
    assert Fem(rig, rayleigh=(1e-4, 0.0)).poles().size


def test_a_body_that_both_ends_hold_is_refused_and_one_that_hangs_has_no_modes() -> None:
    link = ("link", "rigid_link", {"L": 0.3, "r": 0.1, "m": 0.4, "I": 2e-3})
    assert Fem(chain(SOURCE, link)).modes().omega.size == 0
    with pytest.raises(InputError, match="held twice"):
        Fem(chain(SOURCE, link, tip="clamped")).modes()


def test_a_part_with_neither_mass_nor_stiffness_is_refused() -> None:
    bare = {"L": 0.3, "r": 0.0, "m": 0.0, "I": 0.0}
    fem = Fem(chain(SOURCE, ("bare", "rigid_link", bare), base="pinned"))
    with pytest.raises(InputError, match="neither mass nor stiffness"):
        fem.modes()
    with pytest.raises(InputError, match="without mass"):
        fem.response(1.0)
