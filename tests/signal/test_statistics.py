"""Intervals and tests: what is stated about an error is what a simulation of it shows.

Plan: coverage of each interval for strong and weak responses, Hotelling's law, comparison of
responses, combination; laws by hypothesis.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from samii_rig.errors import EstimateError
from samii_rig.signal import statistics
from samii_rig.types import Channel, FrequencyResponse


def response(H: np.ndarray, C: np.ndarray, nu: float, **more: object) -> FrequencyResponse:
    """n_freq lines with p outputs: H (n, p), C (n, p, p)."""
    n, p = H.shape
    values: dict[str, object] = {
        "frequency": np.arange(1.0, n + 1),
        "H": H[:, :, None],
        "covariance": C,
        "dof": np.full(n, nu),
        "coherence": np.ones((n, p)),
        "inputs": (Channel("v", "V", "command"),),
        "outputs": tuple(Channel(f"y{i}", "rad") for i in range(p)),
        "level": 1.0,
        "level_unit": "V",
        "input_rms": np.ones((n, 1)),
        "rate_hz": 100.0,
        "n_averages": 2,
        "method": "burst",
        "why": "",
    }
    return FrequencyResponse(**{**values, **more})  # type: ignore[arg-type]  # a dict of all fields


def drawn(
    truth: complex, nu: int, n: int, p: int = 1, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Estimates of `truth` with unit noise, and covariances from nu further draws."""
    rng = np.random.default_rng(seed)
    z = (rng.normal(size=(n, nu + 1, p)) + 1j * rng.normal(size=(n, nu + 1, p))) / np.sqrt(2)
    C = np.einsum("nkp,nkq->npq", z[:, 1:], z[:, 1:].conj()) / nu
    return truth + z[:, 0], C


@pytest.mark.parametrize("size", [0.3, 1.0, 3.0, 30.0])
def test_intervals_hold_the_truth_in_nine_of_ten_however_weak_the_response(size):
    truth = size * np.exp(0.7j)
    H, C = drawn(truth, nu=12, n=6_000)
    r = response(H, C, 12)
    for interval, value in [
        (statistics.real_interval(r), truth.real),
        (statistics.imag_interval(r), truth.imag),
        (statistics.magnitude_interval(r), abs(truth)),
    ]:
        inside = np.mean((interval.low <= value) & (value <= interval.high))
        assert inside == pytest.approx(0.9, abs=0.012)
    turn = np.degrees(np.abs(np.angle(H[:, 0] / truth)))
    inside = np.mean(turn <= statistics.phase_half_width(r)[:, 0, 0])
    # Where noise is as large as the response, half a turn is all that can be said.
    assert inside == pytest.approx(0.9, abs=0.012) if size >= 3 else inside >= 0.89


def test_a_response_lost_in_noise_may_be_zero():
    r = response(np.array([[0.1 + 0j]]), np.ones((1, 1, 1), complex), 30)
    assert statistics.magnitude_interval(r).low[0, 0, 0] == 0
    assert statistics.decibel_interval(r).low[0, 0, 0] == -np.inf
    assert statistics.phase_half_width(r)[0, 0, 0] == 180


@pytest.mark.parametrize(("p", "nu"), [(1, 6), (4, 9), (4, 40)])
def test_joint_errors_follow_hotelling(p, nu):
    H, C = drawn(0, nu, 20_000, p)
    t2 = statistics.hotelling(H, C)
    assert np.mean(t2) == pytest.approx(statistics.hotelling_mean(p, np.array(nu)), rel=0.04)
    p_values = statistics.hotelling_p(t2, p, np.full(t2.shape, float(nu)))
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3


def test_chi_square_in_place_of_hotelling_would_be_far_off():
    H, C = drawn(0, 9, 20_000, 4)
    t2 = statistics.hotelling(H, C)
    assert np.mean(2 * t2 > stats.chi2.ppf(0.9, 8)) > 0.4


def test_too_few_degrees_of_freedom_are_refused_with_what_would_help():
    with pytest.raises(EstimateError, match="more repeats"):
        statistics.hotelling_distribution(4, np.array([3.0]))


def test_equal_responses_do_not_differ_and_changed_ones_do():
    H, C = drawn(50, 40, 400, 2, seed=1)
    other, D = drawn(50, 40, 400, 2, seed=2)
    a, b = response(H, C, 40), response(other, D, 40)
    same = statistics.difference(a, b, [(0, 500)])[0]
    assert same.p_value > 0.01
    assert same.ratio == pytest.approx(1, abs=0.15)
    changed = statistics.difference(a, response(other * 1.02, D, 40), [(0, 500)])[0]
    assert changed.p_value < 1e-6
    assert changed.change == pytest.approx(0.03, abs=0.02)


def test_p_values_of_equal_responses_are_spread_evenly():
    out = []
    for seed in range(60):
        H, C = drawn(50, 40, 50, 3, seed=2 * seed)
        G, D = drawn(50, 40, 50, 3, seed=2 * seed + 1)
        a, b = response(H, C, 40), response(G, D, 40)
        out.append(statistics.difference(a, b, [(0, 99)])[0].p_value)
    assert stats.kstest(out, "uniform").pvalue > 1e-3


def test_combining_halves_the_variance_and_adds_the_degrees_of_freedom():
    H, C = drawn(20, 30, 200, 2)
    a = response(H, C, 30)
    both = statistics.combine([a, a])
    np.testing.assert_allclose(both.H, a.H)
    np.testing.assert_allclose(both.covariance, C / 2)
    np.testing.assert_allclose(both.dof, 60)
    mixed = statistics.combine([a, response(H, C, 30, level=2.0)])
    assert np.isnan(mixed.level)


def test_responses_on_different_lines_are_not_combined():
    H, C = drawn(20, 30, 5, 1)
    with pytest.raises(EstimateError, match="differ"):
        statistics.combine([response(H, C, 30), response(H[:4], C[:4], 30)])


def test_phase_unwraps_through_a_delay_and_noise_adds_no_turns():
    f = np.arange(1, 101)
    H = np.exp(-2j * np.pi * f * 0.05)[:, None] * np.ones((1, 1))
    C = np.full((100, 1, 1), 1e-4, complex)
    noisy = H.copy()
    noisy[50] = -1e-3
    C[50] = 1.0
    turned = statistics.phase(response(noisy, C, 30))[:, 0, 0]
    good = np.arange(100) != 50
    np.testing.assert_allclose(turned[good], -18.0 * f[good], atol=1e-6)


@given(
    size=st.floats(0.01, 1e4),
    angle=st.floats(-3, 3),
    nu=st.floats(2, 200),
    level=st.floats(0.5, 0.99),
)
def test_every_interval_is_ordered_and_turning_the_phase_leaves_the_magnitude(
    size, angle, nu, level
):
    C = np.ones((1, 1, 1), complex)
    straight = statistics.magnitude_interval(response(np.array([[size + 0j]]), C, nu), level)
    turned = response(np.array([[size * np.exp(1j * angle)]]), C, nu)
    interval = statistics.magnitude_interval(turned, level)
    assert 0 <= interval.low <= interval.high
    np.testing.assert_allclose(interval.low, straight.low, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(interval.high, straight.high, rtol=1e-6)
    phase = statistics.phase_interval(turned, level)
    assert phase.low <= phase.high
