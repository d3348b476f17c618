"""Natural frequencies and poles: closed forms, counts by another method, damping by energy.

Plan: the search on functions with known roots (close ones, double ones); chains against the count
of Wittrick and Williams, textbook beams and finite elements; damped poles; what is refused.
"""

import numpy as np
import pytest
from fem_kit import SOURCE, chain, samii, with_stiffness, without_springs
from hypothesis import given, settings
from hypothesis import strategies as st
from modes_kit import chains, wittrick_williams

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.fem.model import Fem
from samii_rig.model.axis import axis_zeros
from samii_rig.model.modes import natural_frequencies, poles, undamped
from samii_rig.model.shapes import mode_shape
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig

BEAM = {"EI": 2.0, "mu": 0.5, "L": 0.8}
UNIT = np.sqrt(BEAM["EI"] / BEAM["mu"]) / BEAM["L"] ** 2 / (2 * np.pi)  # Hz for beta = 1


def product(omega):
    """D(s) with zeros at +-j omega, and no other."""
    omega = np.asarray(omega)

    def D(s):
        value = np.prod(1 + (s[:, None] / omega) ** 2, axis=1)
        size = np.abs(value)
        return value / np.where(size > 0, size, 1), np.log(np.where(size > 0, size, 1))

    return D


@settings(max_examples=60)
@given(st.lists(st.floats(0.2, 150.0), max_size=9))
def test_every_root_is_found_once_and_those_below_are_counted(omega: list[float]) -> None:
    apart = [x for i, x in enumerate(omega) if all(abs(x - y) > 1e-5 * x for y in omega[:i])]
    if any(abs(x - edge) < 1e-3 * edge for x in apart for edge in (1.0, 100.0)):
        return
    found = axis_zeros(product(apart), 1.0, 100.0)
    wanted = sorted(x for x in apart if 1.0 < x < 100.0)
    assert found.count == len(wanted)
    assert found.below == sum(x < 1.0 for x in apart)
    assert found.turn == pytest.approx(found.count, abs=1e-6)
    np.testing.assert_allclose(found.omega, wanted, rtol=1e-9)


def test_two_roots_a_millionth_apart_are_two() -> None:
    found = axis_zeros(product([20.0, 30.0, 30.00003, 70.0]), 1.0, 100.0)
    np.testing.assert_allclose(found.omega, [20.0, 30.0, 30.00003, 70.0], rtol=1e-9)


def test_a_double_root_is_one_with_multiplicity_two() -> None:
    found = axis_zeros(product([20.0, 30.0, 30.0]), 1.0, 100.0)
    assert found.count == 3
    assert list(found.multiplicity) == [1, 2]
    assert found.omega[1] == pytest.approx(30.0, rel=1e-7)


def test_an_end_on_a_root_takes_it_in() -> None:
    found = axis_zeros(product([10.0, 20.0, 30.0]), 10.0, 30.0)
    np.testing.assert_allclose(found.omega, [10.0, 20.0, 30.0], rtol=1e-9)
    assert found.low < 10.0
    assert found.high > 30.0


def test_a_damped_function_is_refused() -> None:
    def D(s):
        value = s**2 + 3 * s + 900
        return value / abs(value), np.log(abs(value))

    with pytest.raises(SamiiRigError, match="damped"):
        axis_zeros(D, 1.0, 100.0)


@settings(max_examples=40)
@given(chains(), st.floats(1.0, 30.0), st.floats(1.5, 30.0))
def test_the_count_is_that_of_wittrick_and_williams(rig, low: float, factor: float) -> None:
    high = low * factor
    below, upto = (wittrick_williams(rig, 2 * np.pi * f) for f in (low, high))
    if below == upto:
        with pytest.raises(InputError, match="no natural frequency"):
            natural_frequencies(rig, low, high)
        return
    found = natural_frequencies(rig, low, high)
    assert (found.below, found.count) == (below, upto - below)
    assert list(found.number) == list(range(below + 1, upto + 1))
    assert np.all(np.diff(found.hz) > 0)
    # And at each one the other count steps.
    for f, number in zip(found.hz, found.number, strict=True):
        assert wittrick_williams(rig, 2 * np.pi * f * (1 - 1e-7)) == number - 1
        assert wittrick_williams(rig, 2 * np.pi * f * (1 + 1e-7)) == number


def test_twenty_modes_of_a_clamped_beam() -> None:
    # cos(x) cosh(x) = -1: beyond the third, x = (i - 1/2) pi to 3e-6.
    x = np.array([1.8751040687119611, 4.694091132974175, 7.854757438237613])
    x = np.append(x, (np.arange(4, 21) - 0.5) * np.pi)
    found = natural_frequencies(chain(SOURCE, ("b", "beam", BEAM)), 0.1, 1.01 * x[-1] ** 2 * UNIT)
    assert found.count == 20
    np.testing.assert_allclose(found.hz, x**2 * UNIT, rtol=7e-6)
    np.testing.assert_allclose(found.hz[:3], x[:3] ** 2 * UNIT, rtol=1e-11)


@pytest.mark.parametrize(
    ("base", "tip", "rigid", "x"),
    [
        ("free", "free", 2, 4.730040744862704),
        ("pinned", "free", 1, 3.926602312047919),
        ("pinned", "pinned", 0, np.pi),
    ],
)
def test_motions_without_stiffness_count_below_the_band(
    base: str, tip: str, rigid: int, x: float
) -> None:
    rig = chain(("b", "beam", BEAM), SOURCE, base=base, tip=tip)
    found = natural_frequencies(rig, 0.5, 1.2 * x**2 * UNIT)
    assert found.below == rigid
    assert found.number[0] == rigid + 1
    assert found.hz[0] == pytest.approx(x**2 * UNIT, rel=1e-11)


def test_samii_has_seven_natural_frequencies_up_to_200_hz_and_finite_elements_agree() -> None:
    found = natural_frequencies(samii(), 0.1, 200.0)
    assert found.count == 7
    np.testing.assert_allclose(found.hz[:2], [1.703, 7.394], rtol=2e-3)  # Table III
    fem = Fem(samii(), elements=40).modes(7).frequency_hz
    np.testing.assert_allclose(found.hz, fem, rtol=2e-6)
    assert np.all(fem > found.hz * (1 - 1e-7))
    assert "7 natural frequencies, 7 found; 0 lie below" in found.proof


def test_the_published_tables_by_a_counted_search() -> None:
    perfect = without_springs(samii(), {"clamp", "joint_1", "joint_2", "joint_3"})
    hz = natural_frequencies(perfect, 0.1, 40.0).hz
    np.testing.assert_allclose(hz, [2.299, 21.417], rtol=2e-3)  # Table I
    braced = with_stiffness(without_springs(samii(), {"clamp", "joint_3"}),
                            {"joint_1": 0.0651e5, "joint_2": 0.0713e5})  # fmt: skip
    hz = natural_frequencies(braced, 0.1, 10.0).hz
    np.testing.assert_allclose(hz, [2.2, 6.0], rtol=1.5e-2)  # Table III, method 2


def test_a_band_without_roots_says_so_and_how_many_lie_below() -> None:
    with pytest.raises(InputError, match=r"no natural frequency from 2 to 5 Hz.*1 lie below"):
        natural_frequencies(samii(), 2.0, 5.0)


@pytest.mark.parametrize("band", [(5.0, 5.0), (5.0, 2.0), (0.0, 5.0), (-1.0, 5.0), (1.0, np.nan)])
def test_a_band_that_is_none_is_refused(band: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="lower one first"):
        natural_frequencies(samii(), *band)


def test_a_damper_without_a_spring_has_no_undamped_counterpart_but_poles() -> None:
    rig = chain(SOURCE, ("damper", "torsional_spring", {"k": 0.0, "c": 0.4}), ("b", "beam", BEAM))
    with pytest.raises(InputError, match=r"damper\.k"):
        natural_frequencies(rig, 1.0, 50.0)
    assert poles(rig, 50.0).pole.size > 1


LINE = {"source": "source", "D": 1.475e-5, "A": 1e-4, "rho": 870.0, "B": 1e9}


def driven_by_oil(part: str, **values: object) -> Rig:
    link = {"L": 0.4, "r": 0.2, "m": 5.0, "I": 0.1}
    angle = {"name": "y", "kind": "absolute_angle", "after": "link", "unit": "rad"}
    return chain(SOURCE, ("oil", part, values), ("link", "rigid_link", link), sensors=[angle])


def test_a_short_line_is_an_oil_column_and_a_long_one_has_waves_of_its_own() -> None:
    for L in (0.02, 0.05):
        line = natural_frequencies(driven_by_oil("hydraulic_line", L=L, **LINE), 1.0, 500.0)
        C_h = LINE["A"] * L / LINE["B"]
        column = natural_frequencies(driven_by_oil("oil_column", D=LINE["D"], C_h=C_h), 1.0, 500.0)
        assert line.count == column.count == 1
        assert line.hz[0] == pytest.approx(column.hz[0], rel=1e-3)
    length, c = 5.0, np.sqrt(LINE["B"] / LINE["rho"])
    found = natural_frequencies(driven_by_oil("hydraulic_line", L=length, **LINE), 1.0, 500.0)
    # The heavy link nearly closes the far end, the source closes the near one: half waves.
    assert found.count == 5
    np.testing.assert_allclose(found.hz[1:], np.arange(1, 5) * c / (2 * length), rtol=0.02)


def test_an_unstable_motion_counts_below_the_band() -> None:
    """Two links on a hinge, the lower one held up against gravity too weakly."""
    k, g1, inertia = 12.0, -3.0, 0.3
    link = {"L": 0.0, "r": 0.0, "m": 1.0, "I": inertia}
    parts = [
        ("gravity", "gravity_stiffness", {"k": g1}),
        ("lower", "rigid_link", link),
        ("joint", "torsional_spring", {"k": k}),
        ("upper", "rigid_link", link),
    ]
    found = natural_frequencies(chain(*parts, SOURCE, base="pinned"), 0.2, 20.0)
    squares = np.linalg.eigvalsh(np.array([[k + g1, -k], [-k, k]]) / inertia)
    assert squares[0] < 0
    assert (found.below, list(found.number)) == (1, [2])
    assert found.hz[0] == pytest.approx(np.sqrt(squares[1]) / (2 * np.pi), rel=1e-9)


# --- damped ---------------------------------------------------------------------------------


def test_poles_of_samii_are_those_of_finite_elements() -> None:
    ours = poles(samii(), 60.0)
    theirs = Fem(samii(), elements=40).poles()
    for p in ours.pole:
        assert np.min(np.abs(theirs - p)) < 2e-6 * abs(p)
    assert ours.found.count == np.where(ours.pole.imag > 0, 2, 1) @ ours.multiplicity
    assert np.all(ours.ratio > 0)


def test_the_proof_names_what_is_the_sources_own() -> None:
    found = poles(samii(), 60.0)
    assert found.own == {"v_2": (0j, -150 + 0j)}
    assert "driven by v_2 has poles of its own at 0, -150" in found.proof
    assert f"{found.found.count} zeros" in found.proof


def test_small_damping_is_the_energy_lost_over_the_energy_there() -> None:
    """First order perturbation: 2 zeta omega = sum c (slope change)^2 at modal mass 1."""
    rig = samii()
    c = {"clamp": 1.7, "joint_1": 0.05, "joint_2": 0.07, "joint_3": 0.09}
    base = undamped(rig)
    light = base.with_values({(name, "c"): value for name, value in c.items()})
    damped = poles(light, 60.0)
    for hz in natural_frequencies(base, 0.5, 55.0).hz:
        mode = mode_shape(base, hz, normalise="mass")
        lost = sum(value * mode.slope_changes[name].real ** 2 for name, value in c.items())
        pole = damped.pole[np.argmin(np.abs(damped.hz - hz))]
        assert -2 * pole.real == pytest.approx(lost, rel=1e-4)


def test_a_loss_factor_has_causal_poles() -> None:
    rig, _ = load_rig("sflr")
    lossy = rig.model_copy(
        update={
            "element": tuple(
                e.model_copy(update={"eta": e.eta.model_copy(update={"value": 0.02}),
                                     "tau": e.tau.model_copy(update={"value": 0.0})})
                if e.kind == "beam" else e
                for e in rig.element
            )
        }
    )  # fmt: skip
    found = poles(lossy, 60.0)
    light = found.ratio[found.oscillating & (found.hz > 15)]
    # A beam's mode with loss factor eta has damping eta/2, less what the hub takes of the energy.
    assert np.all((light > 0.003) & (light < 0.04))
    assert "squares" in found.proof


@pytest.mark.parametrize("high", [0.0, -1.0, np.inf])
def test_poles_up_to_no_frequency_are_refused(high: float) -> None:
    with pytest.raises(InputError, match="above 0 Hz"):
        poles(samii(), high)
