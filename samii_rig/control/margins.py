"""Stability margins of a loop from its gain L(f): how far it stays away from -1."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from samii_rig.types import Complex, Float


@dataclass(frozen=True, slots=True)
class Margins:
    """Margins of one loop, negative feedback, each with the frequency where it is found.

    gain_db : smallest change of the loop's gain, up or down, that brings L to -1.
    phase_deg : smallest lag or lead that does. modulus : smallest |1 + L|.
    inf (at NaN Hz) where L never crosses the negative real axis, or never the unit circle.
    """

    gain_db: float
    gain_hz: float
    phase_deg: float
    phase_hz: float
    modulus: float
    modulus_hz: float


def margins(frequency_hz: Float, L: Complex) -> Margins:
    """The margins of L (n,) at increasing frequencies (n,), taken linear between them.

    They say that a loop is stable only together with a count of its poles.
    """
    f = frequency_hz
    x, hz = _where_zero(f, L, L.imag)
    beyond = x.real < 0
    gain = _least(np.abs(20 * np.log10(np.abs(x[beyond]))), hz[beyond])
    x, hz = _where_zero(f, L, np.abs(L) - 1)
    phase = _least(180 - np.abs(np.angle(x, deg=True)), hz)
    at = int(np.argmin(np.abs(1 + L)))
    return Margins(*gain, *phase, float(abs(1 + L[at])), float(f[at]))


def _where_zero(f: Float, L: Complex, mark: Float) -> tuple[Complex, Float]:
    """L and frequency where `mark` changes its sign."""
    i = np.flatnonzero((mark[:-1] < 0) != (mark[1:] < 0))
    part = mark[i] / (mark[i] - mark[i + 1])
    return L[i] + part * (L[i + 1] - L[i]), f[i] + part * (f[i + 1] - f[i])


def _least(size: Float, hz: Float) -> tuple[float, float]:
    if size.size == 0:
        return math.inf, math.nan
    at = int(np.argmin(size))
    return float(size[at]), float(hz[at])
