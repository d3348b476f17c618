"""A change of the response that no law describes, beside the noise of whole records.

H = (1 + epsilon(f)) M(f),   E epsilon(f) epsilon(f')* = s^2 exp(-(log f/f')^2 / (2 l^2)),

of each sensor by itself (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63, relative to the model).
With F d - t the likelihood on its nodes and G G' the covariance of d, noise 1 becomes
1 + F G G' F'. s and l are the most likely ones beside a fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.likelihood.form import Reduced
from samii_rig.types import Complex, Float

# Nepers of frequency, l: from what nodes resolve, a tenth apart, to half a decade and more.
LENGTHS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
MIDDLE = 2  # of them, where the most likely one is first looked for
SCALES = np.geomspace(1e-4, 0.3, 29)  # of the response, s; a larger one is another response
REGULAR = 1e-9  # of a covariance's diagonal, that keeps its root regular


@dataclass(frozen=True, slots=True)
class Discrepancy:
    """scale : rms of epsilon. length : nepers of frequency over which it is alike."""

    scale: float
    length: float

    def added_to(self, form: Reduced, M: Complex) -> Reduced:
        """The same likelihood with it beside the noise. M : (b, q) as of the module."""
        G = _directions(form, M, self.length)
        m = len(G)
        root = np.linalg.cholesky(np.eye(m) + self.scale**2 / 2 * G @ G.T)
        flat = linalg.solve_triangular(root, form.factor.reshape(m, -1), lower=True)
        Q, R = np.linalg.qr(flat)
        goal = Q.T @ linalg.solve_triangular(root, form.target, lower=True)
        factor = np.ascontiguousarray(R).reshape(-1, *form.factor.shape[1:])
        return replace(form, factor=factor, target=goal)


@dataclass(frozen=True, slots=True)
class Weighed:
    """A fit beside its most likely discrepancy. evidence : its logarithm, up to a constant of the
    data."""

    evidence: float
    discrepancy: Discrepancy


def weighed(form: Reduced, M: Complex, fit: Fitted, left: Float) -> Weighed:
    """The most likely discrepancy beside a fit, whose parameters go along to first order.

    form : of the noise alone, in whose units fit.jacobian (m + r, n) and the residual left (m + r,)
    are, r rows of which are of no response. M : (b, q) of the fit on its nodes.
    """
    each: dict[int, Weighed] = {}

    def evidence(at: int) -> float:
        if at not in each:
            each[at] = _of_length(form, M, fit, left, LENGTHS[at])
        return each[at].evidence

    at = MIDDLE
    while True:
        best = max(range(max(at - 1, 0), min(at + 2, len(LENGTHS))), key=evidence)
        if best == at:
            return each[at]
        at = best


def _of_length(form: Reduced, M: Complex, fit: Fitted, left: Float, length: float) -> Weighed:
    """With the most likely scale."""
    m, n = len(form.factor), fit.model.n_nominal
    first, rest = fit.jacobian[:m], fit.jacobian[m:]
    prior = fit.precision() - fit.information
    pull = np.zeros(fit.model.n)
    pull[:n] = (prior @ fit.x)[:n]
    size = np.sqrt(np.diagonal(prior))
    G = _directions(form, M, length)
    values, turn = np.linalg.eigh(G @ G.T)
    J, r = turn.T @ first, turn.T @ left[:m]
    found = []
    for scale in SCALES:
        counts = 1 / (1 + scale**2 / 2 * np.maximum(values, 0.0))
        A = J.T @ (counts[:, None] * J) + rest.T @ rest + prior
        g = J.T @ (counts * r) + rest.T @ left[m:] + pull
        d = -np.linalg.solve(A, g)
        cost = float(r @ (counts * r) + left[m:] @ left[m:] + fit.penalty + g @ d)
        free = float(np.linalg.slogdet(A / np.outer(size, size))[1])
        evidence = -0.5 * (cost - float(np.sum(np.log(counts))) + free)
        found.append(Weighed(evidence, Discrepancy(float(scale), length)))
    return max(found, key=lambda w: w.evidence)


def _directions(form: Reduced, M: Complex, length: float) -> Float:
    """(m, p) F G of a discrepancy of scale sqrt 2."""
    b, q = M.shape
    f = np.log(np.maximum(form.frequency, form.frequency[1]))
    alike = np.exp(-0.5 * ((f[:, None] - f) / length) ** 2)
    root = np.linalg.cholesky(alike + REGULAR * np.eye(b))
    each = []
    for i in range(q):
        (real, imag), S = form.factor[:, i].swapaxes(0, 1), M[:, i]
        each += [(real * S.real + imag * S.imag) @ root]
        each += [(imag * S.real - real * S.imag) @ root]
    return np.concatenate(each, axis=1)
