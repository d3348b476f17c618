"""The shape of the noise that a disturbance at the input makes of itself.

What drives the plant beside the reference (valve noise, friction, hum on the amplifier) goes
through the same plant, so that the noise of one line is C = N + S H H^H: N the sensors' own,
diagonal, and S the spectrum of the disturbance, both nearly constant over the band. H is what
is being estimated, so the shape costs p + 1 numbers, where a resonance of 2 or 3 lines would
take an autoregressive model that these data cannot pay for.

The estimate of H at a line must not shape the covariance of that same line: the direction in
which it errs would count as noise, and what is fitted with that covariance would be biased
(by p S/|V|^2 relative; 1.2 standard deviations of a parameter were seen). So H is taken from
the lines around, by a local rational model.
"""

from __future__ import annotations

import numpy as np

from samii_rig.types import Complex, Float

HALF = 4  # lines on each side; a mode of 2 lines half-power width is fitted to 1e-3
DEGREE = 2  # of the numerators; the common denominator has 1
SMOOTHED_OVER = 2 * HALF + 1
ROUNDS = 60  # of expectation and maximisation; 20 to 30 are usual
SETTLED = 1e-3  # relative change of S and N at which they end
# Least N over an output's noise: none is left without any of its own (a Heywood case).
LEAST = 1e-6


def from_neighbours(H: Complex) -> Complex:
    """H (n_freq, p) at each line from the `HALF` lines on either side, without its own.

    H (1 + d x) = b_0 + b_1 x + b_2 x^2 by linear least squares, d common to the outputs, x the
    number of lines from the middle. At the ends of the band the windows lie to one side.
    Needs n_freq >= `SMOOTHED_OVER`.
    """
    n = len(H)
    middle = np.clip(np.arange(n), HALF, n - 1 - HALF)
    at = middle[:, None] + np.arange(-HALF, HALF + 1)
    kept = (at != np.arange(n)[:, None]).astype(float)
    x = np.arange(-HALF, HALF + 1) / HALF
    powers = x[:, None] ** np.arange(DEGREE + 1)
    inverse = np.linalg.inv(np.einsum("nw,wi,wj->nij", kept, powers, powers))
    project = np.einsum("nij,wj,nw->niw", inverse, powers, kept)
    near = H[at]
    scale = np.mean(np.abs(near) ** 2, axis=1, keepdims=True) + np.finfo(float).tiny
    fits, left = [], []
    for y in (near, x[:, None] * near):
        fits.append(project @ y)
        left.append((y - powers @ fits[-1]) * kept[:, :, None])
    size = np.sum(np.abs(left[1]) ** 2 / scale, axis=(1, 2))
    d = -np.sum(left[1].conj() * left[0] / scale, axis=(1, 2)) / np.where(size > 0, size, 1.0)
    own = (np.arange(n) - middle) / HALF
    b = fits[0] + d[:, None, None] * fits[1]
    value = np.einsum("ni,nip->np", own[:, None] ** np.arange(DEGREE + 1), b)
    return np.asarray(value / (1 + d * own)[:, None])


def shape(e: Complex, H: Complex, dof_per_line: float) -> tuple[Complex, float]:
    """L (n_freq, p, p), lower, with L L^H = N + S H H^H, and the mean of log det L L^H.

    e : (n, n_freq, p) residuals that together have `dof_per_line` degrees of freedom at each
        line, every output with noise. H : (n_freq, p), taken as known.

    Maximum likelihood by expectation (the disturbance at each line) and maximisation.
    """
    total = np.mean(np.sum(np.abs(e) ** 2, axis=0), axis=0) / dof_per_line
    N: Float = total / 2
    size = np.abs(H) ** 2
    S = float(np.mean(total) / 2 / np.mean(size))
    for _ in range(ROUNDS):
        spread = 1 / (1 / S + np.sum(size / N, axis=1))
        u = spread * np.einsum("fp,nfp->nf", H.conj() / N, e)
        left = e - u[:, :, None] * H
        before = np.append(N, S)
        S = float(np.mean(np.sum(np.abs(u) ** 2, axis=0) / dof_per_line + spread))
        own = np.sum(np.abs(left) ** 2, axis=0) / dof_per_line + size * spread[:, None]
        N = np.maximum(own.mean(axis=0), LEAST * total)
        if np.all(np.abs(np.append(N, S) / before - 1) < SETTLED):
            break
    C = np.eye(len(N)) * N + S * H[:, :, None] * H[:, None, :].conj()
    L: Complex = np.asarray(np.linalg.cholesky(C))
    roots = np.diagonal(L, axis1=1, axis2=2).real
    return L, 2 * float(np.mean(np.sum(np.log(roots), axis=1)))
