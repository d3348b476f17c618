"""Local models: frequency responses of a single sweep, leakage and transients removed.

Around each frequency f0, with x = (f - f0)/W in [-1, 1] over the lines of a window,

    Z(f) = ( B(x) R(f) + T_i(x) ) / D(x) + noise,        Z = [V; Y],

B a vector of polynomials (the response from the reference to input and outputs), T_i one
for each transient i, times exp(-j w t_i): the state that a piece starts and ends with
(t = 0), and the one that it has after a gap, where the samples before do not explain what
follows; so lost samples cost a few degrees of freedom and none is made up. D is one
polynomial for all of them: poles are common to every response and every transient. D = 1 is
the local polynomial method (LPM; Schoukens, Vandersteen, Barbe and Pintelon, 2009), D of
degree 1 or 2 the local rational method (LRM; McKelvey and Guerin, 2012), which follows a
resonance narrower than the window. Then H = B_y(0)/B_v(0), which has no bias in closed loop.

LRM starts from Sanathanan-Koerner's iteration and ends with Gauss-Newton on the output
error, because the former is biased where there is noise. Linear parameters are eliminated
by QR at each step (variable projection). The covariance of H is that of the linearised
estimate under the full noise covariance across channels (a sandwich: the loop makes the
noise of V and Y dependent, so that covariance is singular).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from samii_rig.signal.spectra import Spectrum
from samii_rig.types import Complex, Float, Int

DEGREE_B = 2
DEGREE_T = 2
MERGE = 0.5  # of 1/W: a polynomial of degree 2 over the window turns by as much
PLAN_STEPS = 12
KOERNER_STEPS = 3
NEWTON_STEPS = 6
# A channel without noise (the input of an open loop) is given this part of its size.
FAINT = 1e-6
# Of the reference's largest line, what is none: a transform rounds to 1e-13 of it.
NOTHING = 1e-10
CHUNK = 512  # windows at a time: some MB of matrices


Transients = tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class Windows:
    """Rows of all windows: x, R (n_freq, rows), Z (n_freq, rows, c), piece of each row.

    turn (n_freq, rows) : 2 pi (f - f0), rad/s.
    transients : (piece, seconds after its start) of each.
    """

    x: Float
    R: Complex
    Z: Complex
    piece: Int
    turn: Float
    transients: Transients

    def part(self, a: int, b: int) -> Windows:
        """Windows a to b, half open."""
        rows = slice(a, b)
        return Windows(
            self.x[rows], self.R[rows], self.Z[rows], self.piece, self.turn[rows], self.transients
        )

    def determined(self) -> NDArray[np.bool_]:
        """(n_freq,) whether the reference has enough lines in the window to tell a response there:
        one that repeats itself has none between its own."""
        size = np.abs(np.diagonal(np.linalg.qr(_references(self), "r"), axis1=1, axis2=2))
        return np.asarray(np.min(size, axis=1) > NOTHING * np.max(np.abs(self.R)))

    def distinct(self) -> Float:
        """(n_freq,) 1 - rho^2, rho the largest canonical correlation between what the
        reference and what a transient can look like in the window.

        A sweep that passes f0 close to the time of a transient, within about 1/W, looks there
        like that transient; then nothing distinguishes the two.
        """
        if not self.transients:
            return np.ones(len(self.x))
        by_transient, _ = np.linalg.qr(_transients(self))
        by_reference, _ = np.linalg.qr(_references(self))
        cosines = np.linalg.svd(
            by_transient.conj().transpose(0, 2, 1) @ by_reference, compute_uv=False
        )
        return np.asarray(1 - np.minimum(cosines[:, 0], 1.0) ** 2)


@dataclass(frozen=True, slots=True)
class Fit:
    """One local model on all windows.

    H (n_freq, p); covariance (n_freq, p, p); noise (n_freq, p, p) covariance of
    e = Y - H V at one line; gain (n_freq,) V/R; press (n_freq,) mean over the outputs of the
    log of the leave-one-out power of e; dof of the residual.
    """

    H: Complex
    covariance: Complex
    noise: Complex
    gain: Complex
    press: Float
    dof: float


def plan(
    breaks: Sequence[Sequence[float]], p: int, longest: float, *, at_rest: bool
) -> tuple[float, Transients]:
    """Width of the windows in Hz and the transients to be distinguished in them.

    breaks : for each piece that counts, the times in s at which samples are missing.
    longest : s. The windows hold enough lines for a residual covariance of p outputs.
    Transients closer than a part of 1/width are one: its polynomial covers them.
    """
    target = max(16, 4 * p)
    lines = 2 * DEGREE_T + 3
    found: Transients = ()
    for _ in range(PLAN_STEPS):
        near = MERGE * longest / lines
        found = tuple(
            (i, t)
            for i, times in enumerate(breaks)
            for t in _merged([*([] if at_rest else [0.0]), *times], near)
        )
        unknown = DEGREE_B + 1 + len(found) * (DEGREE_T + 1) + 2
        needed = int(np.ceil((target + unknown) / len(breaks)))
        # Three times as many lines as a piece has coefficients of its own, or its transients
        # could take any shape.
        most = max((sum(i == j for j, _ in found) for i in range(len(breaks))), default=0)
        needed = max(needed, 3 * most * (DEGREE_T + 1))
        if needed <= lines:
            break
        lines = needed
    return lines / longest, found


def _merged(times: Sequence[float], near: float) -> list[float]:
    """Centres of the clusters in which neighbours of a chain span at most `near`."""
    clusters: list[list[float]] = []
    for t in sorted(times):
        if clusters and t - clusters[-1][0] <= near:
            clusters[-1].append(t)
        else:
            clusters.append([t])
    return [(c[0] + c[-1]) / 2 for c in clusters]


def windows(
    spectra: Sequence[Spectrum], f0: Float, width_hz: float, transients: Transients
) -> Windows:
    """The lines within `width_hz` (full width) of each f0, of all pieces.

    A piece gives the same number of lines to every window; at the ends of its axis the
    window lies to one side.
    """
    x, R, Z, piece, turn = [], [], [], [], []
    for i, s in enumerate(spectra):
        step = s.frequency[0]  # the first line is 1/T
        m = min(round(width_hz / step), s.frequency.size)
        start = np.clip(np.round(f0 / step).astype(int) - 1 - m // 2, 0, s.frequency.size - m)
        index = start[:, None] + np.arange(m)
        offset = s.frequency[index] - f0[:, None]
        x.append(offset * (2 / width_hz))
        turn.append(2 * np.pi * offset)
        R.append(s.R[index])
        Z.append(s.Z[index])
        piece.append(np.full(m, i))
    return Windows(
        np.concatenate(x, axis=1),
        np.concatenate(R, axis=1),
        np.concatenate(Z, axis=1),
        np.concatenate(piece).astype(np.int64),
        np.concatenate(turn, axis=1),
        transients,
    )


def fit(data: Windows, degree_d: int) -> Fit:
    """Fit all windows with a denominator of this degree (0: LPM), chunk by chunk."""
    parts = [_fit(data.part(a, a + CHUNK), degree_d) for a in range(0, len(data.x), CHUNK)]
    return Fit(
        H=np.concatenate([part.H for part in parts]),
        covariance=np.concatenate([part.covariance for part in parts]),
        noise=np.concatenate([part.noise for part in parts]),
        gain=np.concatenate([part.gain for part in parts]),
        press=np.concatenate([part.press for part in parts]),
        dof=parts[0].dof,
    )


def _fit(data: Windows, degree_d: int) -> Fit:
    n_freq, rows, c = data.Z.shape
    basis = _regressors(data)
    q = basis.shape[2]
    powers = data.x[:, :, None] ** np.arange(1, degree_d + 1)
    # One scale per channel, the same for all windows of a chunk, balances the units; the
    # second, by the noise, is put in once the noise is known.
    scale = np.sqrt(np.mean(np.abs(data.Z) ** 2, axis=1, keepdims=True))
    scale = np.where(scale > 0, scale, 1.0)
    d = np.zeros((n_freq, degree_d), complex)
    if degree_d:
        linear, _ = _solve(basis, data.Z)
        noise = np.sqrt(np.mean(np.abs(data.Z - linear) ** 2, axis=1, keepdims=True))
        d = _koerner(data.Z, basis, powers, np.maximum(noise, FAINT * scale))
        _, model = _model(data.Z, basis, powers, d)
        noise = np.sqrt(np.mean(np.abs(data.Z - model) ** 2, axis=1, keepdims=True))
        scale = np.maximum(noise, FAINT * scale)
        d = _newton(data.Z, basis, powers, d, scale)
    D = 1 + np.einsum("fms,fs->fm", powers, d)
    weighted = basis / D[:, :, None]
    Q, T = np.linalg.qr(weighted)
    b = np.linalg.solve(T, Q.conj().transpose(0, 2, 1) @ data.Z)
    model = weighted @ b
    residual = data.Z - model
    # A pole takes a degree of freedom from every channel, not its share of one: where there
    # is nothing but noise to follow it follows the noise (simulated: variances 15 % too small
    # with the share, right with this).
    dof = rows - q - degree_d
    noise_c = np.einsum("fmi,fmj->fij", residual, residual.conj()) / dof
    # b_0 = k n: the row of the pseudo-inverse that belongs to B(0).
    first = np.zeros((n_freq, q, 1), complex)
    first[:, 0] = 1
    k = (Q @ np.linalg.solve(T.conj().transpose(0, 2, 1), first))[:, :, 0].conj()
    factor = np.zeros((n_freq, c, c, rows), complex)
    factor[:, np.arange(c), np.arange(c)] = k[:, None]
    leverage = np.sum(np.abs(Q) ** 2, axis=2)
    if degree_d:
        full = -(powers / D[:, :, None])[:, None] * model.transpose(0, 2, 1)[:, :, :, None]
        J = full - Q[:, None] @ (Q.conj().transpose(0, 2, 1)[:, None] @ full)
        J /= scale.transpose(0, 2, 1)[:, :, :, None]
        G = np.linalg.inv(_gram(J))
        step = G[:, None] @ J.conj().transpose(0, 1, 3, 2)  # (n_freq, c, s, rows)
        step /= scale.transpose(0, 2, 1)[:, :, :, None]
        direct = np.einsum("fm,fims->fis", k, full)
        factor -= np.einsum("fis,fjsm->fijm", direct, step)
        leverage = leverage + np.einsum("fims,fst,fimt->fm", J, G, J.conj()).real / c
    H = b[:, 0, 1:] / b[:, 0, :1]
    towards = factor[:, 1:] - H[:, :, None, None] * factor[:, :1]
    towards /= b[:, 0, 0][:, None, None, None]
    covariance = _sandwich(towards, noise_c)
    outside = residual / np.maximum(1 - leverage, 1e-3)[:, :, None]
    # In units of the output error e: the noise of V is not one of its own.
    error = outside[:, :, 1:] - H[:, None] * outside[:, :, :1]
    with np.errstate(divide="ignore"):
        press = np.log(np.mean(np.abs(error) ** 2, axis=1)).mean(axis=1)
    e = residual[:, :, 1:] - H[:, None] * residual[:, :, :1]
    noise_e = np.einsum("fmi,fmj->fij", e, e.conj()) / dof
    return Fit(H, covariance, noise_e, np.asarray(b[:, 0, 0], complex), press, dof)


def _regressors(data: Windows) -> Complex:
    """(n_freq, rows, q): R x^s, then x^s exp(-j w t) on the rows of each transient."""
    columns = _references(data)
    if not data.transients:
        return columns
    return np.concatenate([columns, _transients(data)], axis=2)


def _references(data: Windows) -> Complex:
    return np.stack([data.R * data.x**s for s in range(DEGREE_B + 1)], axis=2)


def _transients(data: Windows) -> Complex:
    columns = [
        (data.piece == i) * data.x**s * np.exp(-1j * data.turn * t)
        for i, t in data.transients
        for s in range(DEGREE_T + 1)
    ]
    return np.stack(columns, axis=2)


def _solve(basis: Complex, target: Complex) -> tuple[Complex, Complex]:
    """(fitted, Q) of the least squares of `target` on `basis`."""
    Q, _ = np.linalg.qr(basis)
    return Q @ (Q.conj().transpose(0, 2, 1) @ target), Q


def _model(Z: Complex, basis: Complex, powers: Float, d: Complex) -> tuple[Complex, Complex]:
    D = 1 + np.einsum("fms,fs->fm", powers, d)
    fitted, Q = _solve(basis / D[:, :, None], Z)
    return Q, fitted


def _gram(J: Complex) -> Complex:
    """sum over channels and rows of J^H J, (n_freq, s, s), with a trace of ridge."""
    gram: Complex = np.einsum("fims,fimt->fst", J.conj(), J)
    ridge = 1e-12 * np.trace(gram, axis1=1, axis2=2).real + 1e-300
    return np.asarray(gram + ridge[:, None, None] * np.eye(gram.shape[1]), complex)


def _koerner(Z: Complex, basis: Complex, powers: Float, sigma: Float) -> Complex:
    """Denominator by Sanathanan and Koerner: |D Z - B R - T|^2 / |D_before|^2."""
    n_freq, rows, c = Z.shape
    s = powers.shape[2]
    d = np.zeros((n_freq, s), complex)
    columns = (powers[:, :, None, :] * Z[:, :, :, None]).reshape(n_freq, rows, c * s)
    for _ in range(KOERNER_STEPS):
        w = 1 / (1 + np.einsum("fms,fs->fm", powers, d))[:, :, None]
        both = np.concatenate([columns, Z], axis=2) * w
        fitted, _ = _solve(basis * w, both)
        rest = both - fitted
        a = rest[:, :, : c * s].reshape(n_freq, rows, c, s).transpose(0, 2, 1, 3)
        t = rest[:, :, c * s :].transpose(0, 2, 1)
        weight = sigma.transpose(0, 2, 1)
        a, t = a / weight[:, :, :, None], t / weight
        d = -np.linalg.solve(_gram(a), np.einsum("fims,fim->fs", a.conj(), t)[:, :, None])[:, :, 0]
    return d


def _newton(Z: Complex, basis: Complex, powers: Float, d: Complex, sigma: Float) -> Complex:
    """Minimise |Z - (B R + T)/D|^2/sigma^2 over D; a step that does not help is halved."""
    weight = sigma.transpose(0, 2, 1)
    Q, model = _model(Z, basis, powers, d)
    cost = np.sum(np.abs((Z - model) / sigma) ** 2, axis=(1, 2))
    damping = np.ones(len(d))
    for _ in range(NEWTON_STEPS):
        D = 1 + np.einsum("fms,fs->fm", powers, d)
        full = -(powers / D[:, :, None])[:, None] * model.transpose(0, 2, 1)[:, :, :, None]
        J = full - Q[:, None] @ (Q.conj().transpose(0, 2, 1)[:, None] @ full)
        J /= weight[:, :, :, None]
        residual = (Z - model).transpose(0, 2, 1) / weight
        right = np.einsum("fims,fim->fs", J.conj(), residual)[:, :, None]
        step = np.linalg.solve(_gram(J), right)[:, :, 0]
        trial = d + damping[:, None] * step
        Q_new, model_new = _model(Z, basis, powers, trial)
        cost_new = np.sum(np.abs((Z - model_new) / sigma) ** 2, axis=(1, 2))
        better = cost_new <= cost
        damping = np.where(better, 1.0, damping / 4)
        pick = better[:, None]
        d = np.where(pick, trial, d)
        Q = np.where(pick[:, :, None], Q_new, Q)
        model = np.where(pick[:, :, None], model_new, model)
        cost = np.where(better, cost_new, cost)
    return d


def _sandwich(factor: Complex, noise: Complex) -> Complex:
    """E[dH dH^H] = sum_m factor C factor^H, (n_freq, p, p)."""
    inner = np.einsum("fyim,fzjm->fyizj", factor, factor.conj(), optimize=True)
    return np.asarray(np.einsum("fyizj,fij->fyz", inner, noise, optimize=True), complex)
