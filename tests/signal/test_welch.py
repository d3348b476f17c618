"""Welch: the same numbers as scipy and pyFRF where the method is the same."""

import warnings

import numpy as np
import pytest
from scipy import signal

from samii_rig.errors import EstimateError, InputError
from samii_rig.signal import welch

RATE = 200.0


@pytest.fixture(scope="module")
def z() -> np.ndarray:
    rng = np.random.default_rng(3)
    v = rng.normal(size=10_000)
    y = [signal.lfilter([1.0], [1.0, -a], v) for a in (0.5, -0.3, 0.9)]
    return np.stack([v, *y], axis=1) + 0.3 * rng.normal(size=(10_000, 4)) + [0, 5, 0, -2]


@pytest.mark.parametrize("nperseg", [64, 255, 1024])
@pytest.mark.parametrize("overlap", [0.0, 0.5, 0.75])
def test_spectra_are_those_of_scipy_to_rounding(z, nperseg, overlap):
    ours = welch.spectra([z], RATE, nperseg=nperseg, overlap=overlap)
    noverlap = int(nperseg * overlap)
    for i in range(4):
        for j in range(4):
            f, theirs = signal.csd(z[:, j], z[:, i], RATE, nperseg=nperseg, noverlap=noverlap)
            np.testing.assert_allclose(ours.frequency, f)
            size = np.abs(ours.S[:, i, i] * ours.S[:, j, j]) ** 0.5
            assert np.max(np.abs(ours.S[:, i, j] - theirs) / size) < 1e-12


def test_a_record_in_blocks_is_the_record_in_one(z, monkeypatch):
    whole = welch.spectra([z], RATE, nperseg=256)
    monkeypatch.setattr(welch, "BLOCK_SAMPLES", 3 * 256 * 4)
    np.testing.assert_allclose(welch.spectra([z], RATE, nperseg=256).S, whole.S, rtol=1e-10)


@pytest.mark.parametrize("method", ["h1", "h2", "hv"])
def test_responses_are_those_of_pyfrf_to_rounding(z, method):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a peer's own warnings are not ours
        from pyFRF import FRF

        frf = FRF(
            int(RATE),
            exc=z[:, 0].copy(),
            resp=z[:, 1:].T[None].copy(),
            window="hann",
            resp_type="d",
            nperseg=512,
            fft_len=512,
        )
        theirs = {"h1": frf.get_H1, "h2": frf.get_H2, "hv": frf.get_Hv}[method]()
    # pyFRF's Hann window is the symmetric one.
    ours = welch.frequency_response([z], RATE, nperseg=512, method=method, window=np.hanning(512))
    np.testing.assert_allclose(ours.H[1:-1], theirs[:, 0, 1:-1].T, rtol=1e-9)


def test_h1_lies_under_h2_and_hv_between(z):
    h1, h2, hv = (
        np.abs(welch.frequency_response([z], RATE, nperseg=256, method=m).H[2:-2])
        for m in ("h1", "h2", "hv")
    )
    assert np.all(h1 <= hv * (1 + 1e-9))
    assert np.all(hv <= h2 * (1 + 1e-9))


def test_intervals_of_h1_hold_for_white_noise_without_leakage():
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(200):
        v = rng.normal(size=4000)
        y = 2.0 * v + rng.normal(size=4000)
        r = welch.frequency_response([np.stack([v, y], axis=1)], RATE, nperseg=256)
        error = np.abs(r.H[3:-3, 0] - 2) ** 2 / r.covariance[3:-3, 0, 0].real
        inside.append(error)
    # |dH|^2/C follows F(2, 2 nu), of mean nu/(nu - 1).
    assert np.mean(inside) == pytest.approx(r.dof / (r.dof - 1), rel=0.05)


def test_a_window_longer_than_the_record_is_refused(z):
    with pytest.raises(EstimateError, match="as long as one window"):
        welch.spectra([z[:100]], RATE, nperseg=256)
    with pytest.raises(InputError, match="nperseg"):
        welch.spectra([z], RATE, nperseg=2)
    with pytest.raises(InputError, match="h1, h2, hv"):
        welch.frequency_response([z], RATE, nperseg=256, method="h3")
