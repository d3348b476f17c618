"""The noise covariance, pooled over neighbouring lines in units in which it is smooth.

A few repeats of several channels give a covariance of low rank at each line. Neighbouring
lines see nearly the same noise, except where a disturbance has passed through the plant:
its spectrum then has the plant's resonances. So the residuals are first whitened by a model
of the noise over the band, the whitened residuals are pooled, and the whitening is undone. The
model is a disturbance at the input (see `disturbance`) or none, whichever is the better, and a
vector autoregressive model of what that leaves. It need not be right: the pooling measures
what it left. It is a linear map at each line, so the pooled matrix stays complex Wishart with
the degrees of freedom of the pooling.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.signal import disturbance
from samii_rig.types import Complex, Float

# Orders tried; the best by BIC. One complex pole of the band per output and order.
ORDERS = (0, 1, 2, 3, 4, 6, 8)
# Data per coefficient below which no model is tried: its own error would show.
DATA_PER_COEFFICIENT = 20


@dataclass(frozen=True, slots=True)
class Noise:
    """A pooled covariance.

    covariance : (n_freq, p, p) of one residual. dof : (n_freq,). order : of the
    autoregressive model. through_input : whether it is one of what a disturbance at the input
    leaves.
    """

    covariance: Complex
    dof: Float
    order: int
    through_input: bool

    @property
    def remark(self) -> str:
        """How it was whitened, in words; "" where it was not."""
        parts = ["a disturbance at the input"] if self.through_input else []
        parts += [f"a model of order {self.order}"] if self.order else []
        return f"noise whitened by {' and '.join(parts)}, " if parts else ""


def pooled(e: Complex, dof_per_line: float, lines: int, H: Complex | None = None) -> Noise:
    """Covariance of the residuals at each line, from `lines` neighbouring lines.

    e : (n, n_freq, p), n residuals at each line that together have `dof_per_line` degrees
        of freedom.
    H : (n_freq, p) response from the input to the outputs, through which a disturbance may
        have come, or (n_freq, p, n_in) from several; None where there is none to speak of.
    Windows keep their width at the ends of the band, where they lie to one side.
    """
    _, n_freq, p = e.shape
    lines = min(lines, n_freq)
    rms = np.sqrt(np.mean(np.abs(e) ** 2, axis=(0, 1)))
    lively = bool(np.all(rms > 0))
    rms = np.where(rms > 0, rms, 1.0)
    unit = e / rms
    score, factor, order = _shape(unit, dof_per_line)
    through_input = False
    columns = () if H is None else H.reshape(n_freq, p, -1).transpose(2, 0, 1)
    data, paid = dof_per_line * n_freq, 0.0
    taken = np.asarray(np.eye(p), complex)
    for column in columns if lively and n_freq >= disturbance.SMOOTHED_OVER else ():
        near = disturbance.from_neighbours(column) / rms
        if through_input:  # what another input's disturbance left is what this one may explain
            near = np.asarray(np.linalg.solve(taken, near[:, :, None])[:, :, 0], complex)
        left = unit if not through_input else _times_inverse(taken, unit)
        L, log_det = disturbance.shape(left, near, dof_per_line)
        left = _times_inverse(L, left)
        other, rest, rest_order = _shape(left, dof_per_line)
        # One more number, S, was fitted.
        cost = paid + data * log_det + np.log(data) / 2
        if other + cost < score:
            taken = np.asarray(taken @ L) if through_input else L
            factor, order, through_input = np.asarray(taken @ rest), rest_order, True
            score, paid = other + cost, cost
    white = np.linalg.solve(factor, unit.transpose(1, 2, 0))
    power = white @ white.conj().transpose(0, 2, 1)
    total = np.concatenate([np.zeros((1, p, p)), np.cumsum(power, axis=0)])
    start = np.clip(np.arange(n_freq) - lines // 2, 0, n_freq - lines)
    # What the model took out of the residuals, p order coefficients per channel.
    lost = p * order / n_freq
    nu = np.full(n_freq, dof_per_line * lines - lost * lines)
    mean = (total[start + lines] - total[start]) / nu[:, None, None]
    covariance = factor @ mean @ factor.conj().transpose(0, 2, 1)
    return Noise(covariance * rms[:, None] * rms[None, :], nu, order, through_input)


def _times_inverse(L: Complex, e: Complex) -> Complex:
    return np.asarray(np.linalg.solve(L, e.transpose(1, 2, 0)).transpose(2, 0, 1))


def _shape(e: Complex, dof_per_line: float) -> tuple[float, Complex, int]:
    """Score, L (n_freq, p, p) with L L^H the shape of the noise over the band, and the order.

    The lines of the band are taken as the spectrum of a complex signal sampled at the
    band's width; the Yule-Walker equations come from its circular autocovariance
    (Priestley, Spectral Analysis and Time Series, 1981, section 9.4). The score is half the
    BIC but for a constant; it is infinite where there is no shape to find.
    """
    _, n_freq, p = e.shape
    data = dof_per_line * n_freq
    periodogram = np.einsum("nfp,nfq->fpq", e, e.conj()) / dof_per_line
    gamma = np.fft.ifft(periodogram, axis=0)
    eye = np.eye(p)
    best = (np.inf, np.broadcast_to(eye, (n_freq, p, p)).astype(complex), 0)
    for order in ORDERS:
        # So many lines have as many lags, however many residuals there are at each.
        if order and (data < DATA_PER_COEFFICIENT * p * order or order >= n_freq):
            break
        A, sigma = _yule_walker(gamma, order)
        values = np.linalg.eigvalsh(sigma)
        if values[0] <= 1e-12 * values[-1]:
            break  # an output without noise, or two with the same: no shape to find
        score = data * float(np.sum(np.log(values))) + p * p * order * np.log(data)
        if score < best[0]:
            turn = np.exp(-2j * np.pi * np.outer(np.arange(n_freq), np.arange(order + 1)) / n_freq)
            response = np.einsum("fs,spq->fpq", turn, np.concatenate([eye[None], A]))
            best = (score, np.linalg.solve(response, np.linalg.cholesky(sigma)), order)
    return best


def _yule_walker(gamma: Complex, order: int) -> tuple[Complex, Complex]:
    """A (order, p, p) of e_t + A_1 e_{t-1} + ... = w_t, and the covariance of w."""
    p = gamma.shape[1]
    if order == 0:
        return np.zeros((0, p, p), complex), gamma[0]
    block = np.empty((order * p, order * p), complex)
    for s in range(order):
        for t in range(order):  # sum_s A_s Gamma_{t-s} = -Gamma_t
            block[s * p : (s + 1) * p, t * p : (t + 1) * p] = gamma[t - s]
    right = -np.concatenate(list(gamma[1 : order + 1]), axis=1)
    ridge = 1e-10 * np.trace(block).real / len(block) * np.eye(len(block))
    A = np.linalg.solve((block + ridge).T, right.T).T
    A = A.reshape(p, order, p).transpose(1, 0, 2)
    sigma = gamma[0] + sum(A[s] @ gamma[-1 - s] for s in range(order))
    return A, (sigma + sigma.conj().T) / 2
