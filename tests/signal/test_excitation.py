"""Swept sines: the phase is the integral of the frequency, a burst starts and ends at rest."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from samii_rig.signal.excitation import (
    Interpolation,
    Profile,
    Sweep,
    cosine_ramp,
    schedule_factor,
    sweep_frequency,
    sweep_phase,
    swept_sine,
)

HZ = st.floats(0.05, 200.0)
SWEEPS: st.SearchStrategy[Sweep] = st.sampled_from(["linear", "logarithmic"])


@given(start=HZ, stop=HZ, T=st.floats(0.5, 200.0), sweep=SWEEPS)
def test_the_phase_is_the_integral_of_the_frequency(start, stop, T, sweep):
    # Gauss-Legendre over 20 panels is exact to rounding for both laws.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    edges = np.linspace(0.0, T, 21)
    half = np.diff(edges)[:, None] / 2
    t = edges[:-1, None] + half * (nodes + 1)
    integral = np.cumsum(
        (sweep_frequency(t.ravel(), start, stop, T, sweep).reshape(t.shape) * weights * half).sum(1)
    )
    phase = sweep_phase(edges, start, stop, T, sweep)
    assert phase[0] == 0.0
    np.testing.assert_allclose(phase[1:], 2 * np.pi * integral, rtol=1e-11)


@given(start=HZ, ratio=st.floats(1e-13, 1e-9), T=st.floats(1.0, 100.0))
def test_a_logarithmic_sweep_of_almost_no_width_keeps_its_digits(start, ratio, T):
    phase = sweep_phase(np.array([T]), start, start * (1 + ratio), T, "logarithmic")[0]
    assert phase == pytest.approx(2 * np.pi * start * T, rel=1e-9)


def test_one_frequency_is_a_plain_sine():
    u, f = swept_sine(100.0, 5.0, 5.0, 2.0)
    np.testing.assert_allclose(u, np.sin(2 * np.pi * 5.0 * np.arange(200) / 100), atol=1e-12)
    assert np.all(f == 5.0)


def test_a_logarithmic_sweep_spends_equal_time_in_every_octave():
    t = np.linspace(0, 60, 6001)
    f = sweep_frequency(t, 0.5, 32.0, 60.0, "logarithmic")
    inside = [np.count_nonzero((f >= lo) & (f < 2 * lo)) for lo in (0.5, 1, 2, 4, 8, 16)]
    assert max(inside) - min(inside) <= 2


def test_a_burst_is_silent_before_and_after_and_its_frequency_unknown_there():
    u, f = swept_sine(200.0, 1.0, 20.0, 3.0, ramp=0.5, lead_in=0.25, ring_down=1.0)
    assert u.shape == f.shape == (50 + 600 + 200,)
    assert not u[:51].any()
    assert not u[650:].any()
    assert np.isnan(f[:50]).all()
    assert np.isnan(f[650:]).all()
    assert np.isfinite(f[50:650]).all()


@given(ramp=st.floats(0.05, 1.0), sweep=SWEEPS)
def test_a_ramp_never_raises_the_level_nor_jumps_at_its_ends(ramp, sweep):
    hard, _ = swept_sine(500.0, 1.0, 30.0, 3.0, profile=Profile(sweep))
    soft, _ = swept_sine(500.0, 1.0, 30.0, 3.0, ramp=ramp, profile=Profile(sweep))
    assert np.all(np.abs(soft) <= np.abs(hard) + 1e-15)
    # One sample from rest the ramp is at most (pi/2 dt/ramp)^2.
    assert abs(soft[-1]) <= (np.pi / 2 / 500.0 / ramp) ** 2


def test_the_ramp_is_half_way_at_half_its_time():
    factor = cosine_ramp(1001, 1000.0, 0.2)
    assert factor[0] == 0.0
    assert factor[100] == pytest.approx(0.5)
    assert np.all(factor[200:801] == 1.0)
    assert factor[1001 - 100] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("interpolation", "halfway"),
    [("linear", np.interp(4.0, [1, 16], [0.1, 1.0])), ("logarithmic", np.sqrt(0.1))],
)
def test_a_schedule_is_interpolated_and_constant_outside(
    interpolation: Interpolation, halfway: float
):
    factor = schedule_factor(
        np.array([0.1, 1.0, 4.0, 16.0, 99.0]), [(1.0, 0.1), (16.0, 1.0)], interpolation
    )
    np.testing.assert_allclose(factor, [0.1, 0.1, halfway, 1.0, 1.0])


def test_the_schedule_is_the_envelope_of_the_burst():
    u, f = swept_sine(2000.0, 2.0, 50.0, 20.0, profile=Profile(schedule=[(2.0, 1.0), (50.0, 0.1)]))
    late = np.abs(u[f > 45.0]).max()
    assert late == pytest.approx(0.1, rel=0.1)
    assert np.abs(u[f < 3.0]).max() == pytest.approx(0.8, rel=0.3)
