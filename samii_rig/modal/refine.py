"""Maximum likelihood in output error: poles and residues at once, from any start.

Least squares in noise units with the full covariance, by Levenberg-Marquardt. Residues are linear,
so each step is in the poles alone, with the residues that fit best at every trial (variable
projection: Golub and Pereyra, SIAM J. Numerical Analysis 10, 1973). While it runs a pair of poles
is a section (alpha + beta s)/(s^2 + b s + c), which has no seam where it becomes two real poles.
The normal equations are summed entry by entry: with W_ij the weight between entries i and
j, the block of their residues is F^H diag(W_ij) F. Their inverse at the optimum, in poles and
residues, is the covariance of the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.levenberg import ByGain, Normal, Progress, descend, step
from samii_rig.modal.rational import Rational, functions
from samii_rig.types import Complex, Float

STEPS = 60  # of Levenberg-Marquardt; ten are usual
ENOUGH = 0.01  # change of chi-square at which they end: a tenth of a sigma at most
TRUST = 1e-3  # first damping of the steps, over the scaled diagonal of the reduced information
RIDGE = 1e-13  # relative, added to the scaled normal equations: rounding of their digits
TWICE = 1e-6  # relative distance of two real poles that are one: a double pole is none of the model


def weights(weight: Complex) -> Complex:
    """(n, p, p) W = weight^H weight: chi-square is the sum of e^H W e."""
    return np.asarray(weight.conj().transpose(0, 2, 1) @ weight)


def refine(
    s: Complex, G: Complex, W: Complex, scale: float, pairs: Complex, real: Float
) -> Rational:
    """The maximum likelihood from a start of the poles.

    s : (n,) rad/s over scale, on the imaginary axis. G : (n, p). W : (n, p, p) `weights`.
    pairs : Im > 0. real : of the start. A pair may end as two real poles.
    """
    bc = np.stack([-2 * pairs.real, np.abs(pairs) ** 2], axis=1)

    def normal(now: _Sections) -> Normal:
        N, g = _normal(now.F, now.slopes(s), now.c, G, W)
        A, g = _reduced(N, g, now.x.size)
        return Normal(A, -g)

    def trial(now: _Sections, by: Normal, damping: float) -> _Sections:
        x = now.x + step(by.A, by.g, (damping + RIDGE) * np.diagonal(by.A))
        return _fitted(s, G, W, x[: now.bc.size].reshape(-1, 2), x[now.bc.size :])

    def settled(p: Progress) -> bool:
        return (p.gain if p.gain > 0 else p.expected) < ENOUGH

    first = _fitted(s, G, W, bc, real)
    if not first.x.size:
        return _as_poles(s, G, W, scale, first)
    end = descend(first, normal, trial, settled, ByGain(TRUST), trials=STEPS)
    return _as_poles(s, G, W, scale, end.at)


def score(model: Rational, s: Complex, G: Complex, W: Complex, pole: complex) -> float:
    """By how much chi-square would fall if a pair were added at `pole`: Rao's test.

    To second order, all other parameters free to follow; no step is made.
    """
    F = np.hstack([functions(s, np.array([pole]), np.zeros(0), extras=False),
                   functions(s, model.pairs, model.real)])  # fmt: skip
    p = G.shape[1]
    c = np.hstack([np.zeros((p, 2)), model.coefficients])
    N, g = _normal(F, model.slopes(s), c, G, W)
    n, f = model.n_poles, F.shape[1]
    new = (n + f * np.arange(p)[:, None] + np.arange(2)).ravel()
    order = np.concatenate([new, np.setdiff1d(np.arange(g.size), new)])
    inner, right = _reduced(N[np.ix_(order, order)], g[order], new.size)
    return float(right @ _solve(inner, right))


@dataclass(frozen=True, slots=True)
class _Sections:
    """(alpha + beta s)/(s^2 + b s + c) for each of `bc` (m, 2), e/(s - r) for each of `real`.

    F : (n, 2 m + n_real + EXTRAS) what the coefficients c (p, ...) stand before.
    """

    bc: Float
    real: Float
    F: Complex
    c: Float
    cost: float

    @property
    def x(self) -> Float:
        """(n_poles,) b, c of each section, then the real poles."""
        return np.concatenate([self.bc.ravel(), self.real])

    def slopes(self, s: Complex) -> Complex:
        """(n, p, n_poles) derivatives by b, c of each section and by each real pole."""
        m, F, c = self.bc.shape[0], self.F, self.c
        out = np.empty((s.size, c.shape[0], 2 * m + self.real.size), dtype=np.complex128)
        for k in range(m):
            at = slice(2 * k, 2 * k + 2)
            G = (F[:, at] @ c[:, at].T) * -F[:, 2 * k, None]
            out[:, :, 2 * k], out[:, :, 2 * k + 1] = s[:, None] * G, G
        at = slice(2 * m, 2 * m + self.real.size)
        out[:, :, at] = F[:, None, at] ** 2 * c[None, :, at]
        return out


def _fitted(s: Complex, G: Complex, W: Complex, bc: Float, real: Float) -> _Sections:
    """The coefficients that fit best for given poles."""
    q = 1 / (s[:, None] ** 2 + bc[:, 0] * s[:, None] + bc[:, 1])
    sections = np.stack([q, s[:, None] * q], axis=2).reshape(s.size, -1)
    F = np.hstack([sections, functions(s, np.zeros(0, complex), real)])
    c, chi2 = _linear(F, G, W)
    return _Sections(bc, real, F, c, chi2)


def _as_poles(s: Complex, G: Complex, W: Complex, scale: float, found: _Sections) -> Rational:
    """The same model as poles and residues, with their covariance."""
    b, c = found.bc.T
    inside = c - b**2 / 4
    pairs = np.asarray(-b / 2 + 1j * np.sqrt(np.maximum(inside, 0.0)))[inside > 0]
    half = np.sqrt(np.maximum(-inside, TWICE**2 * np.abs(c)))[inside <= 0]
    middle = -b[inside <= 0] / 2
    real = np.concatenate([middle + half, middle - half, found.real])
    F = functions(s, pairs, real)
    coefficients, chi2 = _linear(F, G, W)
    bare = Rational(scale, pairs, real, coefficients, np.zeros((0, 0)), chi2)
    N, _ = _normal(F, bare.slopes(s), coefficients, G, W)
    size = np.sqrt(np.diag(N))
    covariance = np.linalg.inv(N / np.outer(size, size) + RIDGE * np.eye(size.size))
    covariance /= np.outer(size, size)
    return Rational(scale, pairs, real, coefficients, covariance, chi2)


def _linear(F: Complex, G: Complex, W: Complex) -> tuple[Float, float]:
    """(p, f) coefficients that fit best, and chi-square."""
    right = F.conj().T @ (W @ G[:, :, None])[:, :, 0]
    c = _solve(_block(F, W), right.T.real.ravel()).reshape(G.shape[1], -1)
    e = (G - F @ c.T)[:, :, None]
    return c, float(np.sum(e.conj() * (W @ e)).real)


def _block(F: Complex, W: Complex) -> Float:
    """(p f, p f) normal matrix of the coefficients, entry by entry."""
    p, f = W.shape[1], F.shape[1]
    N = np.empty((p, f, p, f))
    adjoint = F.conj().T.copy()
    for i in range(p):
        for j in range(i, p):
            N[i, :, j] = (adjoint @ (W[:, i, j, None] * F)).real
            N[j, :, i] = N[i, :, j].T
    return N.reshape(p * f, p * f)


def _normal(F: Complex, D: Complex, c: Float, G: Complex, W: Complex) -> tuple[Float, Float]:
    """Information matrix of all parameters and the gradient; poles first.

    F : (n, f) functions. D : (n, p, n_poles) derivatives by the poles. c : (p, f).
    """
    n, (p, f) = D.shape[2], c.shape
    N, g = np.empty((n + p * f, n + p * f)), np.empty(n + p * f)
    both = W @ np.concatenate([D, (G - F @ c.T)[:, :, None]], axis=2)
    WD, v = both[:, :, :n], both[:, :, n]
    flat = D.reshape(len(F) * p, n).conj().T
    N[:n, :n] = (flat @ WD.reshape(len(F) * p, n)).real
    adjoint = F.conj().T.copy()
    cross = (adjoint @ WD.reshape(len(F), p * n)).real.reshape(f, p, n).transpose(1, 0, 2)
    N[n:, :n] = cross.reshape(p * f, n)
    N[:n, n:] = N[n:, :n].T
    N[n:, n:] = _block(F, W)
    g[:n] = (flat @ v.reshape(-1)).real
    g[n:] = (adjoint @ v).T.real.ravel()
    return N, g


def _reduced(N: Float, g: Float, n: int) -> tuple[Float, Float]:
    """Information and gradient of the first n parameters, the others at their best."""
    size = np.sqrt(np.diag(N)[n:])
    inner = N[n:, n:] / np.outer(size, size) + RIDGE * np.eye(size.size)
    cross = N[n:, :n] / size[:, None]
    both = np.linalg.solve(inner, np.column_stack([cross, g[n:] / size]))
    return N[:n, :n] - cross.T @ both[:, :-1], g[:n] - cross.T @ both[:, -1]


def _solve(N: Float, b: Float) -> Float:
    """Least squares by scaled normal equations: the columns are few and well apart."""
    size = np.sqrt(np.diag(N))
    scaled = N / np.outer(size, size) + RIDGE * np.eye(size.size)
    return np.asarray(np.linalg.solve(scaled, b / size) / size)
