"""The ratio of two responses: right in the mean, and its intervals cover as often as they say."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.errors import InputError
from samii_rig.signal.ratio import ratio
from samii_rig.signal.statistics import imag_interval, model_distance, real_interval
from samii_rig.types import Channel, FrequencyResponse

NAMES = ("theta", "M", "a")
N_FREQ, NU = 4000, 12
F = np.linspace(0.5, 20.0, N_FREQ)
TRUTH = np.stack([1 / (1 + 1j * F), 2.0 * (1 + 0.3j * F), F * np.exp(1j * F)], axis=1)


def response(relative=0.03, seed=0) -> FrequencyResponse:
    """A response with correlated errors, its covariance estimated with NU degrees of freedom."""
    rng = np.random.default_rng(seed)
    mix = np.array([[1, 0, 0], [0.6 + 0.3j, 0.8, 0], [-0.2j, 0.5, 0.7]])

    def draws(n):
        white = rng.standard_normal((2, N_FREQ, 3, n)) / np.sqrt(2)
        return relative * np.abs(TRUTH)[:, :, None] * (mix @ (white[0] + 1j * white[1]))

    residuals = draws(NU)
    return FrequencyResponse(
        frequency=F,
        H=(TRUTH + draws(1)[:, :, 0])[:, :, None],
        covariance=residuals @ residuals.conj().transpose(0, 2, 1) / NU,
        dof=np.full(N_FREQ, float(NU)),
        coherence=np.ones((N_FREQ, 3)),
        inputs=(Channel("v", "V", "command"),),
        outputs=tuple(Channel(n, "1") for n in NAMES),
        level=1.0,
        level_unit="V",
        input_rms=np.full((N_FREQ, 1), 0.7),
        rate_hz=100.0,
        n_averages=NU + 1,
        method="test",
        why="test",
    )


def test_ninety_per_cent_intervals_of_a_ratio_cover_ninety_per_cent():
    q = ratio(response(), "M", ["theta", "a"])
    truth = (TRUTH[:, [0, 2]] / TRUTH[:, [1]])[:, :, None]
    for interval, part in ((real_interval(q), truth.real), (imag_interval(q), truth.imag)):
        covered = np.mean((interval.low < part) & (part < interval.high))
        assert covered == pytest.approx(0.9, abs=0.012)
    distance, p_value = model_distance(q, truth)
    assert np.all(distance >= 0)
    assert np.mean(p_value < 0.1) == pytest.approx(0.1, abs=0.015)


def test_errors_that_two_outputs_share_cancel_in_their_ratio():
    r = response()
    H = r.H.copy()
    H[:, 1] = 3.0 * H[:, 0]
    C = r.covariance.copy()
    C[:, 1, :] = 3.0 * C[:, 0, :]
    C[:, :, 1] = 3.0 * C[:, :, 0]
    C[:, 1, 1] = 9.0 * r.covariance[:, 0, 0]
    shared = FrequencyResponse(
        **{f: getattr(r, f) for f in r.__slots__} | {"H": H, "covariance": C}
    )
    q = ratio(shared, "M", ["theta"])
    np.testing.assert_allclose(q.H, 1 / 3)
    assert np.abs(q.covariance).max() < 1e-12


def test_the_ratio_is_a_response_to_the_output_below():
    q = ratio(response(), "M")
    assert [c.name for c in q.outputs] == ["theta", "a"]
    assert [c.name for c in q.inputs] == ["M"]
    np.testing.assert_allclose(q.input_rms[:, 0], 0.7 * np.abs(response().H[:, 1, 0]))


@pytest.mark.parametrize(("bottom", "tops"), [("x", None), ("M", ["x"]), ("M", ["M"]), ("M", [])])
def test_a_ratio_of_what_there_is_not_is_refused(bottom, tops):
    with pytest.raises(InputError, match="ratio"):
        ratio(response(), bottom, tops)
