"""Welch's estimates H1, H2 and Hv, for comparison with other tools.

Auto- and cross-spectra by averaging windowed segments (Welch, IEEE Trans. Audio 15, 1967).
All frames of a block go through one batched real FFT; blocks are small enough to stay in
the cache, and one compiled pass over the block adds up the whole spectral matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import fft

from samii_rig.errors import EstimateError, InputError
from samii_rig.signal._accumulate import accumulate
from samii_rig.types import Complex, Float

METHODS = ("h1", "h2", "hv")
# Samples of one block over all channels: 0.5 MB in and 0.5 MB out, a core's second cache.
BLOCK_SAMPLES = 65536


@dataclass(frozen=True, slots=True)
class SpectralMatrix:
    """One-sided averaged spectra.

    frequency : (n_freq,) Hz.
    S : (n_freq, c, c) with S[:, i, j] = E[X_i X_j^*] as a density, unit_i unit_j/Hz.
    dof : effective number of independent frames (overlapping windows share data).
    """

    frequency: Float
    S: Complex
    n_frames: int
    dof: float


@dataclass(frozen=True, slots=True)
class WelchResponse:
    """H (n_freq, p), covariance (n_freq, p, p), coherence (n_freq, p); see `spectra`."""

    frequency: Float
    H: Complex
    covariance: Complex
    coherence: Float
    dof: float
    n_frames: int


def spectra(
    pieces: Sequence[Float],
    rate_hz: float,
    *,
    nperseg: int,
    window: str | Float = "hann",
    overlap: float = 0.5,
    detrend: bool = True,
) -> SpectralMatrix:
    """Spectral matrix of all columns of `pieces` [(n, c), ...], averaged over all frames.

    The definition (periodic window, density scaling, mean taken out of each frame when
    `detrend`) is that of `scipy.signal.csd`, and so are the numbers, to rounding.
    Raises InputError for a window that does not fit, EstimateError when no piece is as long
    as one window.
    """
    if nperseg < 8:
        raise InputError("welch", "nperseg", nperseg, "8 or more samples")
    if not 0 <= overlap < 1:
        raise InputError("welch", "overlap", overlap, "at least 0 and below 1")
    step = nperseg - int(nperseg * overlap)
    w = _window(window, nperseg) if isinstance(window, str) else np.asarray(window, float)
    if w.shape != (nperseg,):
        raise InputError("welch", "window", w.shape, f"({nperseg},) values or a name")
    c = pieces[0].shape[1]
    n_freq = nperseg // 2 + 1
    total = np.zeros((c * c, n_freq))
    n_frames = 0
    per_block = max(1, BLOCK_SAMPLES // (nperseg * c))
    buffer = np.empty((c, per_block, nperseg))
    for piece in pieces:
        columns = [np.ascontiguousarray(piece[:, i], dtype=float) for i in range(c)]
        if piece.shape[0] < nperseg:
            continue
        frames = [np.lib.stride_tricks.sliding_window_view(x, nperseg)[::step] for x in columns]
        count = frames[0].shape[0]
        for first in range(0, count, per_block):
            m = min(per_block, count - first)
            block = buffer[:, :m]
            for i, view in enumerate(frames):
                part = view[first : first + m]
                if detrend:
                    np.subtract(part, part.mean(axis=1, keepdims=True), out=block[i])
                    block[i] *= w
                else:
                    np.multiply(part, w, out=block[i])
            accumulate(fft.rfft(block, axis=2, overwrite_x=True), total)
        n_frames += count
    if n_frames == 0:
        longest = max(p.shape[0] for p in pieces)
        raise EstimateError(
            f"no piece is as long as one window of {nperseg} samples; the longest has {longest}"
        )
    scale = np.full(n_freq, 2.0)
    scale[0] = 1.0
    if nperseg % 2 == 0:
        scale[-1] = 1.0
    S = _matrix(total, c) * (scale / (rate_hz * n_frames * float(w @ w)))[:, None, None]
    frequency = np.arange(n_freq, dtype=float) * (rate_hz / nperseg)
    return SpectralMatrix(frequency, S, n_frames, _effective(w, step, n_frames))


def frequency_response(
    pieces: Sequence[Float],
    rate_hz: float,
    *,
    nperseg: int,
    method: Literal["h1", "h2", "hv"] | str = "h1",
    window: str | Float = "hann",
    overlap: float = 0.5,
    detrend: bool = True,
) -> WelchResponse:
    """H from the first column of each piece to the others.

    H1 = S_yv/S_vv is least squares with noise on y, H2 = S_yy/S_vy with noise on v, Hv total
    least squares with noise of equal variance on both in their units (Rocklin, Crowley and Vold,
    1985). The covariance is that of H1, for an input free of noise and leakage.

    pieces : (n, 1 + n_out) each. nperseg : samples of a window. overlap : part of them that the
        next one has too.
    Raises InputError for another method.
    """
    if method not in METHODS:
        raise InputError("welch", "method", method, "one of h1, h2, hv")
    result = spectra(
        pieces, rate_hz, nperseg=nperseg, window=window, overlap=overlap, detrend=detrend
    )
    S = result.S
    S_vv, S_yv = S[:, 0, 0].real, S[:, 1:, 0]
    S_yy = np.diagonal(S, axis1=1, axis2=2)[:, 1:].real
    with np.errstate(divide="ignore", invalid="ignore"):
        H1 = S_yv / S_vv[:, None]
        if method == "h1":
            H = H1
        elif method == "h2":
            H = S_yy / S_yv.conj()
        else:
            excess = S_yy - S_vv[:, None]
            root = np.sqrt(excess**2 + 4 * np.abs(S_yv) ** 2)
            H = (excess + root) / (2 * S_yv.conj())
        coherence = np.abs(S_yv) ** 2 / (S_vv[:, None] * S_yy)
        rest = S[:, 1:, 1:] - H1[:, :, None] * S_yv.conj()[:, None, :]
        nu = max(result.dof - 1, 1.0)
        covariance = rest * (result.dof / nu) / (S_vv * result.dof)[:, None, None]
    return WelchResponse(result.frequency, H, covariance, coherence, nu, result.n_frames)


def _matrix(total: Float, c: int) -> Complex:
    """Unpack the rows of `accumulate`: c powers, then real and imaginary part of each pair."""
    S = np.empty((total.shape[1], c, c), complex)
    row = 0
    for i in range(c):
        S[:, i, i] = total[row]
        row += 1
        for j in range(i + 1, c):
            S[:, i, j] = total[row] + 1j * total[row + 1]
            S[:, j, i] = total[row] - 1j * total[row + 1]
            row += 2
    return S


def _window(name: str, n: int) -> Float:
    """The periodic window of this name, as scipy.signal.get_window gives it."""
    if name == "hann":
        return np.hanning(n + 1)[:-1]
    # It takes a second to load, which no estimate needs to wait for.
    from scipy import signal

    return np.asarray(signal.get_window(name, n), float)


def _effective(w: Float, step: int, n_frames: int) -> float:
    """Equivalent number of independent frames for white noise (Welch 1967, eq. 12)."""
    power = float(w @ w)
    spread = 1.0
    for k in range(1, min(n_frames, -(-w.size // step))):
        shared = float(w[k * step :] @ w[: w.size - k * step]) / power
        spread += 2 * (1 - k / n_frames) * shared**2
    return n_frames / spread
