"""Noise that came in at the actuator: its shape is the plant's own."""

import numpy as np
import pytest

from samii_rig.signal import disturbance, noise
from samii_rig.signal.groups import Piece
from samii_rig.signal.repeats import over_repeats
from samii_rig.signal.spectra import settled_spectra

LINES = 300
N, S = np.array([1e-4, 4e-4, 1e-4]), 0.3


def plant():
    """Three outputs with a mode of 2 lines half-power width at line 90."""
    k = np.arange(LINES)
    mode = 1 / (1 + 1j * (k - 90.3))
    return 0.1 + np.stack([mode, 0.4 * mode, -0.7 * mode], axis=1) * [1, 1j, 1 + 1j]


def residuals(rng, n=2):
    def normal(*size):
        return (rng.normal(size=size) + 1j * rng.normal(size=size)) / np.sqrt(2)

    driven = np.sqrt(S) * normal(n, LINES)[:, :, None] * plant()
    return driven + np.sqrt(N) * normal(n, LINES, 3)


def test_a_response_is_found_from_its_neighbours_even_at_a_resonance():
    H = plant()
    np.testing.assert_allclose(disturbance.from_neighbours(H), H, rtol=1e-9)


def test_a_line_has_no_say_in_what_its_neighbours_say_of_it():
    H = plant()
    for line in (0, 3, 90, LINES - 1):
        other = H.copy()
        other[line] += 0.5
        same = disturbance.from_neighbours(other)[line]
        np.testing.assert_allclose(same, disturbance.from_neighbours(H)[line], rtol=1e-9)


def test_the_disturbance_and_the_sensors_own_noise_are_told_apart():
    L, log_det = disturbance.shape(residuals(np.random.default_rng(0), 20), plant(), 20)
    C = L @ L.conj().swapaxes(1, 2)
    H = plant()
    exact = np.eye(3) * N + S * H[:, :, None] * H[:, None, :].conj()
    np.testing.assert_allclose(C[90], exact[90], rtol=0.05, atol=1e-3 * np.abs(exact[90]).max())
    assert log_det == pytest.approx(np.mean(np.log(np.linalg.det(exact).real)), abs=0.05)


def test_the_pooled_covariance_follows_the_resonance_of_the_plant():
    rng, H = np.random.default_rng(1), plant()
    exact = np.eye(3) * N + S * H[:, :, None] * H[:, None, :].conj()
    ends = {}
    for known in (H, None):
        mean = np.zeros((LINES, 3, 3), complex)
        for _ in range(30):
            found = noise.pooled(residuals(rng), 2, 15, known)
            assert found.through_input == (known is not None)
            mean += found.covariance / 30
        ratio = np.linalg.eigvals(np.linalg.solve(exact, mean)).real
        ends[known is not None] = ratio[85:96].min(), ratio[85:96].max()
    assert ends[True] == pytest.approx((1, 1), abs=0.25)
    assert ends[False][1] > 2  # without it the quiet directions are drowned


def test_noise_that_did_not_come_through_the_input_is_not_said_to():
    rng = np.random.default_rng(2)
    e = rng.normal(size=(2, LINES, 3)) + 1j * rng.normal(size=(2, LINES, 3))
    found = noise.pooled(e, 2, 15, plant())
    assert not found.through_input
    assert found.remark == ""


def test_bursts_that_share_a_faded_tail_share_their_noise():
    rng, n, rest = np.random.default_rng(3), 2000, 600
    r = np.zeros(n)
    r[: n - rest] = 1.0
    seen = []
    for _ in range(150):
        pieces = [Piece(f"{i}", r, rng.normal(size=(n, 2))) for i in range(3)]
        (one, two), correlation = settled_spectra(pieces, 100.0)
        seen.append([np.mean((one.Z * two.Z.conj()).real), np.mean(np.abs(one.Z) ** 2)])
    both, alone = np.mean(seen, axis=0)
    assert both / alone == pytest.approx(correlation, abs=0.003)
    assert correlation > 0.01
    # So the mean of the two varies more than their difference says, and that is put right.
    R, Z = np.ones((2, 50)) + 0j, rng.normal(size=(2, 50, 3)) + 1j * rng.normal(size=(2, 50, 3))
    Z[:, :, 0] = 1.0
    plain, right = (over_repeats(R, Z, 25, np.zeros(2), 1.0, c) for c in (0.0, correlation))
    ratio = (right.covariance / plain.covariance).real
    np.testing.assert_allclose(ratio, (1 + correlation) / (1 - correlation), rtol=1e-9)


@pytest.mark.parametrize("lines", [1, 2, 5, 9])
def test_many_residuals_at_few_lines_have_no_more_lags_than_lines(lines):
    """A level that was repeated a hundred times."""
    rng = np.random.default_rng(0)
    size = (100, lines, 2)
    e = rng.normal(size=size) + 1j * rng.normal(size=size)
    found = noise.pooled(e, 99, lines)
    assert found.order < lines
    # Of 99 degrees of freedom it is known to 10 %; 4 such deviations about the 2 of both parts.
    variances = np.diagonal(found.covariance, axis1=1, axis2=2).real
    np.testing.assert_allclose(variances, 2.0, rtol=0.4)
