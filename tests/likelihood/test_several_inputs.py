"""Two inputs in one likelihood: exact predictions, chi-square at the truth, no sigma lost."""

import numpy as np
import pytest
from scipy import signal

from samii_rig.likelihood.contour import EXACT, Contour
from samii_rig.likelihood.pieces import Piece
from samii_rig.likelihood.records import Records
from samii_rig.likelihood.reduce import reduced

RATE = 200.0
# In powers of 1/z, of each sensor and input.
NUMERATORS = np.array(
    [[[0.0, 0.02, 0.015], [0.0, -0.01, 0.02]], [[0.0, -0.01, 0.03], [0.0, 0.025, 0.01]]]
)
SD = 0.02


def poles(frequency=4.0, damping=0.02):
    p = np.exp((-damping + 1j * np.sqrt(1 - damping**2)) * 2 * np.pi * frequency / RATE)
    return np.array([1.0, -2 * p.real, abs(p) ** 2])


def response(s, denominator):
    """(n, 4): both inputs to the first sensor, then to the second."""
    z = np.exp(s / RATE)
    powers = np.stack([np.ones_like(z), 1 / z, 1 / z**2])
    return (NUMERATORS.reshape(4, 3) @ powers / (denominator @ powers)).T


def from_rest(u, denominator):
    """The recursion itself; u (n, 2)."""
    each = [
        sum(signal.lfilter(b, denominator, x) for b, x in zip(row, u.T, strict=True))
        for row in NUMERATORS
    ]
    return np.column_stack(each)


def sweep(n, low=1.0, high=12.0):
    t = np.arange(n) / RATE
    return signal.chirp(t, low, t[-1], high)


def inputs(how, n=3000):
    up, down, none = sweep(n), sweep(n, 12.0, 1.0), np.zeros(n)
    pairs = {"in turn": [(up, none), (none, up)], "together": [(up, down), (up, -down)]}
    return [np.column_stack(pair) for pair in pairs[how]]


def likelihood(how, seed, denominator):
    rng = np.random.default_rng(seed)
    us = inputs(how)
    zs = [from_rest(u, poles()) + SD * rng.standard_normal((len(u), 2)) for u in us]
    pieces = tuple(
        Piece(f"run {i}", u, z, 0, ((1.0, "V"),))
        for i, (u, z) in enumerate(zip(us, zs, strict=True))
    )
    records = Records(pieces, RATE, ((0.8, 15.0),) * 2)

    def own_alone(f):
        return np.broadcast_to(np.eye(2, dtype=complex), (f.size, 2, 2))

    return reduced(records, lambda s: response(s, denominator), own_alone), us


def test_what_two_inputs_do_together_is_predicted_to_the_last_sample():
    u = inputs("together", 1500)[0]
    contour = Contour.over(len(u), RATE, EXACT)
    exact = from_rest(u, poles())
    found = contour.predicted(response(contour.s, poles()), u)
    np.testing.assert_allclose(found, exact, atol=1e-9 * np.max(np.abs(exact)))


@pytest.mark.parametrize("how", ["in turn", "together"])
def test_at_the_truth_chi_square_is_its_degrees_of_freedom(how):
    left = []
    for seed in range(8):
        found, _ = likelihood(how, seed, poles())
        left.append(float(found.target @ found.target) / found.known)
    assert np.mean(left) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("how", ["in turn", "together"])
def test_of_a_shifted_mode_nearly_all_sigma_is_kept(how):
    kept = []
    for seed in range(4):
        found, us = likelihood(how, seed, poles(4.0 * 1.0005))
        at = found.sigma + 2j * np.pi * found.frequency
        before = float(found.target @ found.target)
        after = float(np.sum(found.residual(response(at, poles())) ** 2))
        there = [from_rest(u, poles()) - from_rest(u, poles(4.0 * 1.0005)) for u in us]
        kept.append((before - after) / (sum(np.sum(x**2) for x in there) / SD**2))
    assert 0.81 < np.mean(kept) < 1.15
