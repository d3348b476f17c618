"""Refit a model with its effects and its nominal parameters, and weigh it by its evidence.

The cost is chi-square in noise units plus the priors of the nominal parameters. Far from the
optimum the logarithm of the response is fitted first, which has fewer wrong minima.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.diagnose.data.measured import Measured
from samii_rig.diagnose.fit import forms
from samii_rig.diagnose.fit.forms import Form
from samii_rig.diagnose.physics.model import Grid, Model
from samii_rig.errors import SamiiRigError
from samii_rig.types import Complex, Float

STEPS = 40
LOG_STEPS = 20
LOG_FLOOR = 0.1  # of the response's logarithm: see identify.likelihood
FAR = 20.0  # chi-square per degree of freedom above which the logarithm is fitted first
LONGEST = 1.2  # a step of an effect's logarithm at most
FIRST, LEAST = 10.0, 1e-2  # damping: of chi-square, for a step of the largest allowed size
CORRECTIONS = 4  # of a step that left the valley
SETTLED = 0.02  # of chi-square, improvement of a step at which a refit ends
HOPELESS = 0.05  # of the way to a chi-square that matters, gained by a step
PATIENT = 3  # steps before that is asked
SPAN = math.sqrt(12.0)  # of a uniform distribution in its standard deviations


@dataclass(frozen=True)
class Problem:
    """Data with what a refit needs of them. root : (n, q, q) with root^H root = W."""

    data: Measured
    root: Complex
    at: Grid

    @classmethod
    def of(cls, data: Measured, at: Grid) -> Problem:
        """The problem on the data's own frequencies."""
        return cls(data, data.root(), at.at(data.frequency, data.level))

    @property
    def lines(self) -> Problem:
        """Responses line by line, for what is seen better there than in the likelihood."""
        return self

    @property
    def expected(self) -> float:
        """Mean of chi-square at the truth."""
        return float(np.sum(self.data.expected))

    def toward(self, h: Complex) -> Problem:
        """The same had `h` (n, q) been measured without noise."""
        return Problem(replace(self.data, H=h), self.root, self.at)

    def forms(self, left: Float, directions: Float) -> Callable[[Complex], Form]:
        """Chi-square when a part moves the prediction by b phi, of any b (n, q).

        left : residuals of data and priors. directions : orthonormal, that are projected out; rows
        of zeros in them do not count.
        """
        directions = counted(directions)
        half = self.data.H.size
        r = (left[:half] + 1j * left[half : 2 * half]).reshape(self.data.H.shape)
        conj = (directions[:half] - 1j * directions[half : 2 * half]).reshape(*r.shape, -1)
        power, q = float(left @ left), directions.T @ left

        def form(b: Complex) -> Form:
            v = (self.root @ b[:, :, None])[:, :, 0]
            return forms.Lines(
                lin=np.sum(r.conj() * v, axis=1),
                square=np.sum(np.abs(v) ** 2, axis=1),
                P=np.einsum("nqj,nq->nj", conj, v),
                power=power,
                q=q,
            )

        return form

    def residual(self, h: Complex) -> Float:
        """Real whitened residuals (2 n q,) of a prediction."""
        r = (self.root @ (h - self.data.H)[:, :, None]).ravel()
        return np.concatenate([r.real, r.imag])

    def whiten(self, dh: Complex) -> Float:
        """(2 n q, m) whitened derivatives."""
        n, q, m = dh.shape
        J = (self.root @ dh).reshape(n * q, m)  # m = 0: a rig file without tolerances
        return np.concatenate([J.real, J.imag])


def counted(directions: Float) -> Float:
    """Directions D of which |v - Q Q'v|^2 = |v|^2 - |D'v|^2, Q orthonormal but for rows of zeros,
    which do not count."""
    R = np.linalg.cholesky(2 * np.eye(directions.shape[1]) - directions.T @ directions)
    return np.asarray(directions @ R)


@dataclass(frozen=True, slots=True)
class Fitted:
    """Where a refit ended.

    x : the model's vector. chi2 : of the data. penalty : of the priors.
    jacobian : (2 n q, n_x) whitened, at x; information : its square.
    """

    model: Model
    x: Float
    chi2: float
    penalty: float
    jacobian: Float
    information: Float

    @property
    def cost(self) -> float:
        """Chi-square and penalty."""
        return self.chi2 + self.penalty

    def precision(self) -> Float:
        """(n_x, n_x) information of data and priors."""
        return np.asarray(self.information + np.diag(_prior_precision(self.model)))

    def evidence(self, temperature: float = 1.0) -> float:
        """Logarithm, up to a constant of the data: -cost/2 less what the freedom of the unknowns
        costs (Laplace's approximation, each unknown no wider than its bounds allow).

        temperature : how many times a data point counts less than its noise says, because a
        model leaves more than noise.
        """
        prior = _prior_precision(self.model)
        A = self.information / temperature / np.sqrt(np.outer(prior, prior))
        log_det = float(np.linalg.slogdet(A + np.eye(self.model.n))[1])
        return -0.5 * self.chi2 / temperature - 0.5 * self.penalty - 0.5 * log_det

    def away(self, other: Fitted) -> float:
        """How far another refit of the same model ended, in standard deviations of this one."""
        d = other.x - self.x
        return math.sqrt(max(float(d @ self.precision() @ d), 0.0))

    def covariance(self) -> Float:
        """(n_x, n_x) of the logarithms."""
        return np.asarray(np.linalg.inv(self.precision()))

    def roughly(self) -> Fitted:
        """The same, the first unknown of each effect known no better than its law holds."""
        rough = np.zeros(self.x.size)
        for i, effect in enumerate(self.model.effects):
            rough[self.model.own(i)[:1]] = effect.rough**2
        if not rough.any():
            return self
        prior = self.precision() - self.information
        both = np.linalg.inv(self.covariance() + np.diag(rough))
        return replace(self, information=both - prior)


def _prior_precision(model: Model) -> Float:
    """1/sd^2; of an unknown that of its uniform distribution."""
    sd = model.prior.copy()
    free = np.arange(model.n_nominal, model.n)
    sd[free] = np.maximum(model.upper[free] - model.lower[free], 1e-6) / SPAN
    return np.asarray(1 / sd**2)


def refit(
    model: Model,
    problem: Problem,
    start: Float,
    *,
    far: bool = True,
    give_up: float = math.inf,
    steps: int = STEPS,
) -> Fitted:
    """The local optimum that `start` leads to.

    give_up : chi-square that matters; a search that hardly comes nearer to it ends.
    """
    if model.n == 0:  # a rig file without tolerances: nothing to fit
        fixed = np.zeros(0)
        chi2 = _cost(model, problem, fixed, model.response(fixed, problem.at))
        rows = problem.residual(problem.data.H).size
        return Fitted(model, fixed, chi2, 0.0, np.zeros((rows, 0)), np.zeros((0, 0)))
    x = np.clip(start, model.lower, model.upper)
    scaled = problem.expected
    h, dh = model.gradient(x, problem.at)
    cost = _cost(model, problem, x, h)
    if far and cost > FAR * scaled:
        x, h, dh, cost = _logarithm(model, problem, x, h, dh, cost)
    damping = FIRST
    for step in range(steps):
        J, r = problem.whiten(dh), problem.residual(h)
        x_new, h_new, new, damping = _step(model, problem, x, J, r, cost, damping)
        gain = cost - new
        if h_new is None:
            break
        x, cost = x_new, new
        h, dh = model.gradient(x, problem.at)
        if gain < SETTLED + 1e-9 * cost or (step >= PATIENT and gain < HOPELESS * (cost - give_up)):
            break
    J = problem.whiten(dh)
    penalty = _penalty(model, x)
    return Fitted(model, x, cost - penalty, penalty, J, J.T @ J)


def _penalty(model: Model, x: Float) -> float:
    n = model.n_nominal
    return float(np.sum((x[:n] / model.prior[:n]) ** 2))


def _cost(model: Model, problem: Problem, x: Float, h: Complex) -> float:
    r = problem.residual(h)
    return float(r @ r) + _penalty(model, x)


def _step(
    model: Model, problem: Problem, x: Float, J: Float, r: Float, cost: float, damping: float
) -> tuple[Float, Complex | None, float, float]:
    """A Levenberg-Marquardt step that lowers the cost; None where there is none."""
    n = model.n_nominal
    A = J.T @ J
    downhill = J.T @ r
    A[np.arange(n), np.arange(n)] += 1 / model.prior[:n] ** 2
    downhill[:n] += x[:n] / model.prior[:n] ** 2
    for _ in range(7):
        new = move(model, x, A, downhill, damping)
        if new is None:
            damping = max(damping * 5, LEAST)
            continue
        try:
            h = model.response(new, problem.at)
        except SamiiRigError:
            damping = max(damping * 5, LEAST)
            continue
        there = _cost(model, problem, new, h)
        for _ in range(CORRECTIONS):
            if there < cost:
                break
            # Back into the curved valley along which the step went, by the same derivatives.
            g = J.T @ problem.residual(h)
            g[:n] += new[:n] / model.prior[:n] ** 2
            back = move(model, new, A, g, damping)
            if back is None:
                break
            try:
                h = model.response(back, problem.at)
            except SamiiRigError:
                break
            new, before, there = back, there, _cost(model, problem, back, h)
            if there > 0.9 * before and there >= cost:
                break
        if there < cost:
            return new, h, there, max(damping * 0.3, LEAST)
        if np.max(np.abs(new - x)) < 1e-7:
            break
        damping = max(damping * 5, LEAST)
    return x, None, cost, damping


def move(model: Model, x: Float, A: Float, g: Float, damping: float) -> Float | None:
    """x after a damped step within the bounds; unknowns held at a bound do not take part.

    A, g : half of the cost's second and first derivatives. None where there is no step.
    """
    scale = np.sqrt(np.maximum(np.diag(A), 1e-12 * np.max(np.diag(A)) + 1e-30))
    held = ((x <= model.lower) & (g > 0)) | ((x >= model.upper) & (g < 0))
    on = np.flatnonzero(~held)
    if on.size == 0:
        return None
    limit = np.where(on < model.n_nominal, 4 * np.minimum(model.prior[on], 1e3), LONGEST)
    S = A[np.ix_(on, on)] / np.outer(scale[on], scale[on])
    # Damped by what a parameter may move, not by what the data say of it: parameters that
    # the data hardly tell apart would otherwise creep along their common valley.
    S[np.diag_indices(on.size)] += damping / (limit * scale[on]) ** 2 + 1e-12
    try:
        d = -np.linalg.solve(S, g[on] / scale[on]) / scale[on]
    except np.linalg.LinAlgError:
        return None
    d *= min(1.0, float(1 / np.max(np.abs(d) / limit)) if np.any(d) else 1.0)
    new = x.copy()
    new[on] += d
    return np.asarray(np.clip(new, model.lower, model.upper))


def _logarithm(
    model: Model, problem: Problem, x: Float, h: Complex, dh: Complex, cost: float
) -> tuple[Float, Complex, Complex, float]:
    """A few steps on log(model/measurement), line by line; kept only if chi-square fell too."""
    lines = problem.lines
    d = lines.data.H
    precision = np.diagonal(lines.data.W, axis1=1, axis2=2).real * np.abs(d) ** 2
    # An entry that was not measured has none, and no weight.
    weight = np.sqrt(precision / (LOG_FLOOR**2 * precision + 2))
    n = model.n_nominal
    best = (x, h, dh, cost)
    damping, current = 1e-2, math.inf
    same = lines is problem
    y, (hy, dhy), moved = x, (h, dh) if same else model.gradient(x, lines.at), False
    for _ in range(LOG_STEPS):
        left = weight * np.log(hy / np.where(d == 0, hy, d))
        slope = (weight / hy)[:, :, None] * dhy
        r = np.concatenate([left.real.ravel(), left.imag.ravel()])
        J = np.concatenate([slope.real.reshape(-1, model.n), slope.imag.reshape(-1, model.n)])
        here = float(r @ r) + _penalty(model, y)
        if here >= current * 0.999:
            break
        current = here
        A, g = J.T @ J, J.T @ r
        A[np.arange(n), np.arange(n)] += 1 / model.prior[:n] ** 2
        g[:n] += y[:n] / model.prior[:n] ** 2
        new = move(model, y, A, g, damping)
        if new is None:
            break
        try:
            hy, dhy = model.gradient(new, lines.at)
            at = hy if same else model.response(new, problem.at)
        except SamiiRigError:
            break
        y = new
        there = _cost(model, problem, y, at)
        if there < best[3]:
            best, moved = (y, at, dhy, there), True
    if moved and not same:
        h, dh = model.gradient(best[0], problem.at)
        best = (best[0], h, dh, best[3])
    return best
