"""Refit a model with its effects and its nominal parameters, and weigh it by its evidence.

The cost is chi-square in noise units plus the priors of the nominal parameters. Far from the
optimum the logarithm of the response is fitted first, which has fewer wrong minima.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from samii_rig.diagnose.data.measured import Measured
from samii_rig.diagnose.fit import forms
from samii_rig.diagnose.fit.forms import Form
from samii_rig.diagnose.physics.grid import Grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import SamiiRigError
from samii_rig.identify.likelihood import LOG_FLOOR
from samii_rig.levenberg import ByFactor, Normal, Point, Progress, descend, step
from samii_rig.types import Complex, Float

STEPS, LOG_STEPS = 40, 20  # of a refit at most, and of one of the response's logarithm
LOGARITHM_FIRST = 20.0  # chi-square per degree of freedom above which the logarithm is fitted first
LONGEST_LOGARITHM = 1.2  # a step of an effect's logarithm at most
# Of chi-square, for a step of the largest allowed size.
DAMPING = ByFactor(10.0, shrink=0.3, grow=5.0, least=1e-2)
LOG_DAMPING = ByFactor(1e-2, shrink=1.0, grow=1.0)  # the same of a logarithm, at every step
LOG_SETTLED = 1e-3  # of the logarithm's cost, gained by a step: less and they end
DAMPINGS = 7  # dampings of one step
CORRECTIONS = 4  # of a step that left the valley
RETURNS = 0.9  # of the cost before, at which a correction leads nowhere
NO_STEP = 1e-7  # of a logarithm: no step
REFIT_ENDS = 0.02  # of chi-square, improvement of a step at which a refit ends
HOPELESS_STEP = 0.05  # of the way to a chi-square that matters, gained by a step
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

    @cached_property
    def log_weight(self) -> Float:
        """(n, q) of the logarithms of the responses: the same for all that are fitted to them."""
        precision = np.diagonal(self.data.W, axis1=1, axis2=2).real * np.abs(self.data.H) ** 2
        # An entry that was not measured has none, and no weight.
        return np.asarray(np.sqrt(precision / (LOG_FLOOR**2 * precision + 2)))

    def toward(self, h: Complex) -> Problem:
        """The same had `h` (n, q) been measured without noise."""
        return Problem(replace(self.data, H=h), self.root, self.at)

    def forms(self, left: Float, directions: Float) -> Callable[[Complex], Form]:
        """Chi-square when a part moves the prediction by b phi, of any b (n, q).

        residual : residuals of data and priors. directions : orthonormal, that are projected out;
        rows of zeros in them do not count.
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

    def __post_init__(self) -> None:
        self.x.setflags(write=False)  # what is kept of a fit belongs to it

    @property
    def cost(self) -> float:
        """Chi-square and penalty."""
        return self.chi2 + self.penalty

    def precision(self) -> Float:
        """(n_x, n_x) information of data and priors."""
        return np.asarray(self.information + np.diag(_prior_precision(self.model)))

    def evidence(self, overdispersion: float = 1.0) -> float:
        """Logarithm, up to a constant of the data: -cost/2 less what the freedom of the unknowns
        costs (Laplace's approximation, each unknown no wider than its bounds allow).

        overdispersion : how many times a data point counts less than its noise says, because a
        model leaves more than noise.
        """
        prior = _prior_precision(self.model)
        A = self.information / overdispersion / np.sqrt(np.outer(prior, prior))
        log_det = float(np.linalg.slogdet(A + np.eye(self.model.n))[1])
        return -0.5 * self.chi2 / overdispersion - 0.5 * self.penalty - 0.5 * log_det

    def away(self, other: Fitted) -> float:
        """How far another refit of the same model ended, in standard deviations of this one."""
        d = other.x - self.x
        return math.sqrt(max(float(d @ self.precision() @ d), 0.0))

    def covariance(self) -> Float:
        """(n_x, n_x) of the logarithms."""
        return np.asarray(np.linalg.inv(self.precision()))

    def with_model_error(self) -> Fitted:
        """The same, the first unknown of each effect, all of a force's, known no better than its
        law holds."""
        rough = np.zeros(self.x.size)
        for i, effect in enumerate(self.model.effects):
            own = list(self.model.own(i))
            rough[own if effect.force is not None else own[:1]] = effect.rough**2
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
        r = problem.residual(model.response(fixed, problem.at))
        return Fitted(model, fixed, float(r @ r), 0.0, np.zeros((r.size, 0)), np.zeros((0, 0)))
    first = _Point.of(model, problem, np.clip(start, model.lower, model.upper))
    if far and first.cost > LOGARITHM_FIRST * problem.expected:
        first = _logarithm(model, problem, first)

    def settled(p: Progress) -> bool:
        hopeless = p.steps > PATIENT and p.gain < HOPELESS_STEP * (p.cost - give_up)
        return p.gain > 0 and (p.gain < REFIT_ENDS + 1e-9 * p.cost or hopeless or p.steps >= steps)

    end = descend(
        first,
        lambda at: _normal(model, problem, at),
        lambda at, by, damping: _trial(model, problem, at, by, damping),
        settled,
        DAMPING,
        trials=DAMPINGS * steps,
        tries=DAMPINGS,
    )
    x, J, penalty = end.at.x, end.normal.J, penalty_of(model, end.at.x)
    return Fitted(model, x, end.at.cost - penalty, penalty, J, J.T @ J)


def profiled(
    model: Model, problem: Problem, base: Fitted, starts: Iterable[Float]
) -> Sequence[Point]:
    """Of vectors of `model`, which is that of `base` and more: each with the nominal parameters
    brought to where they do best beside its other entries, by the derivatives at `base` alone; the
    best first.

    That follows a curved valley as no step of both together does. Vectors that are no rig are left
    out.
    """
    more = np.zeros((len(base.jacobian), model.n - base.model.n))
    J = np.concatenate([base.jacobian, more], axis=1)
    by = _Normal.of(model, np.zeros(model.n), J, np.zeros(len(J)))
    out = []
    for x in starts:
        try:
            at = _Point.at(model, problem, x, model.response(x, problem.at))
        except SamiiRigError:
            continue
        for _ in range(CORRECTIONS if model.n_nominal else 0):
            new = _back(model, problem, at, by)
            if new is None or not new.cost < at.cost:
                break
            at = new
        if math.isfinite(at.cost):
            out.append(at)
    return sorted(out, key=lambda p: p.cost)


@dataclass(frozen=True, slots=True)
class _Point:
    """x, the cost there, the response h, the residuals r, and the derivative dh of the response,
    where it was computed."""

    x: Float
    cost: float
    h: Complex
    r: Float
    dh: Complex | None = None

    @classmethod
    def at(
        cls, model: Model, problem: Problem, x: Float, h: Complex, dh: Complex | None = None
    ) -> _Point:
        """Where the response is h."""
        r = problem.residual(h)
        return cls(x, float(r @ r) + penalty_of(model, x), h, r, dh)

    @classmethod
    def of(cls, model: Model, problem: Problem, x: Float) -> _Point:
        """With the derivative."""
        return cls.at(model, problem, x, *model.gradient(x, problem.at))


@dataclass(frozen=True, slots=True)
class _Normal(Normal):
    """Normal equations with the priors in them, and the Jacobian J of the data alone."""

    J: Float

    @classmethod
    def of(cls, model: Model, x: Float, J: Float, r: Float) -> _Normal:
        """From residuals and their Jacobian."""
        n = np.arange(model.n_nominal)
        A = J.T @ J
        A[n, n] += 1 / model.prior[n] ** 2
        return cls(A, _gradient(model, x, J, r), J)


def _gradient(model: Model, x: Float, J: Float, r: Float) -> Float:
    n = model.n_nominal
    g = J.T @ r
    g[:n] += x[:n] / model.prior[:n] ** 2
    return np.asarray(g)


def _normal(model: Model, problem: Problem, at: _Point) -> _Normal:
    dh = model.gradient(at.x, problem.at)[1] if at.dh is None else at.dh
    return _Normal.of(model, at.x, problem.whiten(dh), at.r)


def penalty_of(model: Model, x: Float) -> float:
    """What the tolerances charge for the nominal parameters of x."""
    n = model.n_nominal
    return float(np.sum((x[:n] / model.prior[:n]) ** 2))


def _trial(
    model: Model, problem: Problem, at: _Point, by: _Normal, damping: float
) -> _Point | None:
    """The point after a step, brought back into the valley that it left."""
    new = _moved(model, problem, at.x, by, damping)
    if new is None:
        return None
    for _ in range(CORRECTIONS):
        if new.cost < at.cost:
            return new
        back = _back(model, problem, new, by)
        if back is None:
            break
        new, before = back, new.cost
        if new.cost > RETURNS * before and new.cost >= at.cost:
            break
    nothing = new.cost >= at.cost and np.max(np.abs(new.x - at.x)) < NO_STEP
    return at if nothing else new


def _back(model: Model, problem: Problem, at: _Point, by: _Normal) -> _Point | None:
    """The point to which the derivatives of another lead back from one that left its curved
    valley: by the nominal parameters alone where there are others. None as of `_moved`."""
    g = _gradient(model, at.x, by.J, at.r)
    nominal = 0 < model.n_nominal < model.n
    return _moved(model, problem, at.x, replace(by, g=g), DAMPING.least, nominal=nominal)


def _moved(
    model: Model, problem: Problem, x: Float, by: Normal, damping: float, *, nominal: bool = False
) -> _Point | None:
    """The point after a damped step from x; None where there is none, or no model there. nominal :
    whether the nominal parameters alone move."""
    new = move(model, x, by, damping, nominal=nominal)
    if new is None:
        return None
    try:
        return _Point.at(model, problem, new, model.response(new, problem.at))
    except SamiiRigError:
        return None


def move(
    model: Model, x: Float, by: Normal, damping: float, *, nominal: bool = False
) -> Float | None:
    """x after a damped step within the bounds; unknowns held at a bound do not take part. nominal :
    whether the nominal parameters alone do.

    None where there is no step.
    """
    diagonal = np.diag(by.A)
    floor = 1e-12 * np.maximum(diagonal, 1e-12 * np.max(diagonal) + 1e-30)
    on = np.flatnonzero(~by.held(x, model.lower, model.upper))
    on = on[on < model.n_nominal] if nominal else on
    if on.size == 0:
        return None
    limit = np.where(on < model.n_nominal, 4 * np.minimum(model.prior[on], 1e3), LONGEST_LOGARITHM)
    # Damped by what a parameter may move, not by what the data say of it: parameters that
    # the data hardly distinguish would otherwise creep along their ill-conditioned direction.
    try:
        d = step(by.A[np.ix_(on, on)], by.g[on], damping / limit**2 + floor[on])
    except np.linalg.LinAlgError:
        return None
    d *= min(1.0, float(1 / np.max(np.abs(d) / limit)) if np.any(d) else 1.0)
    new = x.copy()
    new[on] += d
    return np.asarray(np.clip(new, model.lower, model.upper))


def _logarithm(model: Model, problem: Problem, first: _Point) -> _Point:
    """A few steps on log(model/measurement), line by line; kept only if chi-square fell too."""
    lines = problem.lines
    same, best = lines is problem, first

    def residual(h: Complex) -> Float:
        r = _residual_of_logarithms(lines, h)
        return np.concatenate([r.real.ravel(), r.imag.ravel()])

    def point(x: Float, h: Complex, dh: Complex | None) -> _Point:
        r = residual(h)
        return _Point(x, float(r @ r) + penalty_of(model, x), h, r, dh)

    def normal(now: _Point) -> _Normal:
        dh = model.gradient(now.x, lines.at)[1] if now.dh is None else now.dh
        slope = (lines.log_weight / now.h)[:, :, None] * dh
        J = np.concatenate([slope.real.reshape(-1, model.n), slope.imag.reshape(-1, model.n)])
        return _Normal.of(model, now.x, J, now.r)

    def trial(now: _Point, by: _Normal, damping: float) -> _Point | None:
        nonlocal best
        x = move(model, now.x, by, damping)
        if x is None:
            return now
        try:
            h, dh = model.gradient(x, lines.at)
            at = h if same else model.response(x, problem.at)
        except SamiiRigError:
            return None
        there = _Point.at(model, problem, x, at, dh if same else None)
        if there.cost < best.cost:
            best = there
        return point(x, h, dh)

    def settled(p: Progress) -> bool:
        return not p.gain > LOG_SETTLED * (p.cost + max(p.gain, 0.0))

    if same:
        start = point(first.x, first.h, first.dh)
    else:
        start = point(first.x, *model.gradient(first.x, lines.at))
    descend(start, normal, trial, settled, LOG_DAMPING, trials=LOG_STEPS)
    return best


def far_off(model: Model, problem: Problem, x: Float) -> float:
    """How far the logarithm of a model is off the measurement's, line by line, in the weights in
    which it is fitted far from the optimum; infinite where there is no rig."""
    lines = problem.lines
    try:
        h = model.response(x, lines.at)
    except SamiiRigError:
        return math.inf
    off = float(np.sum(np.abs(_residual_of_logarithms(lines, h)) ** 2))
    return off if math.isfinite(off) else math.inf


def _residual_of_logarithms(lines: Problem, h: Complex) -> Complex:
    """(n, q) what a response leaves of the logarithms."""
    d = lines.data.H
    return np.asarray(lines.log_weight * np.log(h / np.where(d == 0, h, d)))
