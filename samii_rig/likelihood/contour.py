"""From a transfer function to the samples of a record that starts from rest, exactly.

A response at real frequencies predicts a record that repeats itself. On a line beside the
imaginary axis, s = sigma + j w, it predicts one that starts from rest and may end anywhere: with
the input x_n damped by e^{-sigma n T} and padded to M samples,

    y_n = e^{sigma n T} IDFT_n{ H(sigma + j w_k) DFT_k{ x_n e^{-sigma n T} } },  w_k = 2 pi k/(M T),

in which the response behind sample M, which wraps around, is damped by e^{-sigma M T}. No pole
has to be known: dead times, loops and fractional laws are as good as any other H.
(Numerical inversion of the Laplace transform; Wilcox 1978, IEEE Trans. Power App. Syst. 97.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from samii_rig.types import Complex, Float

PADDED = 2.0  # length of the padded record over that of the longest record, at least
# -log of what is left of a response that wraps around. Rounding, and what is not exact along the
# contour, grows to the end of a record by half of it.
EXACT = 24.0  # of a prediction: 4e-11 wraps around, rounding grows to 4e-11
SMOOTH = 6.0  # of changes that are interpolated: 0.2 % of a change wraps, errors grow 20 times


@dataclass(frozen=True, slots=True)
class Contour:
    """A line beside the imaginary axis, sampled.

    samples : M of the padded record. rate_hz : of the samples. damping : sigma M T.
    """

    samples: int
    rate_hz: float
    damping: float

    @classmethod
    def over(cls, longest: int, rate_hz: float, damping: float) -> Contour:
        """The contour for records of up to `longest` samples."""
        return cls(int(fft.next_fast_len(int(PADDED * longest), real=True)), rate_hz, damping)

    @property
    def sigma(self) -> float:
        """1/s."""
        return self.damping * self.rate_hz / self.samples

    @property
    def frequency(self) -> Float:
        """(M//2 + 1,) Hz from 0 to half the rate."""
        return np.arange(self.samples // 2 + 1, dtype=np.float64) * (self.rate_hz / self.samples)

    @property
    def s(self) -> Complex:
        """(M//2 + 1,) rad/s."""
        return np.asarray(self.sigma + 2j * np.pi * self.frequency, np.complex128)

    def damped(self, x: Float) -> Complex:
        """(M//2 + 1, ...) spectrum of x (n, ...), from rest, damped."""
        return np.asarray(fft.rfft(self._decay(len(x), x.ndim) * x, self.samples, axis=0))

    def record(self, Y: Complex, n: int) -> Float:
        """(n, ...) the first samples of a damped spectrum Y (M//2 + 1, ...)."""
        y = fft.irfft(Y, self.samples, axis=0)[:n]
        return np.asarray(y / self._decay(n, y.ndim))

    def predicted(self, H: Complex, r: Float) -> Float:
        """(n, q) what H (M//2 + 1, q) answers to an input r (n,); or H (M//2 + 1, q m), all inputs
        of the first sensor first, to m inputs r (n, m)."""
        if r.ndim == 1:
            return self.record(H * self.damped(r)[:, None], r.size)
        by_input = H.reshape(len(H), -1, r.shape[1]) @ self.damped(r)[:, :, None]
        return self.record(by_input[:, :, 0], len(r))

    def rounding(self, n: int) -> float:
        """Of the largest, what double precision is off at the n-th sample."""
        return float(np.finfo(np.float64).eps * np.exp(self.sigma / self.rate_hz * n))

    def _decay(self, n: int, axes: int) -> Float:
        decay = np.exp(-self.sigma / self.rate_hz * np.arange(n))
        return np.asarray(decay.reshape((n,) + (1,) * (axes - 1)), np.float64)
