"""Welch's H1 with several inputs, for comparison with other tools.

H = S_yr S_vr^-1 through as many references as inputs; r = v where none is recorded, which is H1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import EstimateError
from samii_rig.signal import welch
from samii_rig.types import Complex, Float


@dataclass(frozen=True, slots=True)
class Response:
    """H (n_freq, n_out, n_in), covariance (n_freq, p, p), coherence (n_freq, n_out) (multiple);
    dof of a column, n_frames."""

    frequency: Float
    H: Complex
    covariance: Complex
    coherence: Float
    dof: float
    n_frames: int


def response(records: Sequence[Float], rate_hz: float, n_in: int, nperseg: int) -> Response:
    """From records (n, q): n_in references, n_in inputs, and the outputs.

    nperseg : samples of a window.

    Raises EstimateError if there are too few windows to distinguish the inputs.
    """
    found = welch.spectra(records, rate_hz, nperseg=nperseg)
    r, v, y = slice(0, n_in), slice(n_in, 2 * n_in), slice(2 * n_in, None)
    S = found.S[1:]
    size = np.sqrt(np.diagonal(S, axis1=1, axis2=2).real)
    if not np.all(size[:, : 2 * n_in] > 0) or found.n_frames <= n_in:
        raise EstimateError(
            f"{found.n_frames} windows of {nperseg} samples do not tell {n_in} inputs apart; "
            "shorter windows or longer records would"
        )
    unit = S / (size[:, :, None] * size[:, None, :])
    A = np.linalg.inv(unit[:, v, r])
    H = unit[:, y, r] @ A
    back = H.conj().transpose(0, 2, 1)
    rest = unit[:, y, y] - H @ unit[:, v, y] - unit[:, y, v] @ back + H @ unit[:, v, v] @ back
    nu = max(found.dof - n_in, 1.0)
    # dH = S_er A, and E[S_er,k S_er,l^*] = N S_rr[l, k]/n.
    K = np.einsum("fki,flj,flk->fij", A, A.conj(), unit[:, r, r]) / found.dof
    scale = size[:, y][:, :, None] / size[:, v][:, None, :]
    C = np.einsum("fab,fij->faibj", rest * (found.dof / nu), K)
    C *= scale[:, :, :, None, None] * scale[:, None, None]
    p = scale.shape[1] * n_in
    coherence = 1 - np.clip(np.diagonal(rest, axis1=1, axis2=2).real, 0.0, 1.0)
    return Response(
        found.frequency[1:], H * scale, C.reshape(len(C), p, p), coherence, nu, found.n_frames
    )
