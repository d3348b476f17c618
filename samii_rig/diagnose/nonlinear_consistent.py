"""A force in the loop and the parameters about it, fitted to each other.

A refit knows how a force's describing function moves with the parameters, not how its part in
time does. Where both are strong, computing that anew where a refit ended, and refitting again,
creeps along valleys that the data hardly see, or runs away from them. So the slopes learn from
each step what it really changed (Broyden), and where that leads no further they are differences
of the force in time itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from samii_rig.diagnose.nonlinear_model import LevelModel
from samii_rig.diagnose.refit import FIRST, LEAST, Fitted, Problem, move
from samii_rig.errors import SamiiRigError
from samii_rig.types import Float

STEPS = 40  # at most
TRIES, SHORTER = 5, 20.0  # of a step, and how much more each is damped
DIFFERENCE = 1e-2  # of a tolerance, or of a logarithm without one, for slopes
SETTLED = 0.3  # of chi-square, gained by a step: less and it leads no further

Computed = Callable[[LevelModel, Float], Problem]


def self_consistent(
    fitted: Fitted, computed: Computed, moving: Sequence[int] | None = None
) -> Fitted:
    """The least squares that `fitted` leads to.

    computed : the problem with the force as it is in time at a vector of the model.
    moving : unknowns whose slopes are differences of the force in time; None for all that move it.
    """
    model, x = fitted.model, fitted.x
    assert isinstance(model, LevelModel)
    problem = computed(model, x)
    r = _left(model, x, problem)
    n, m = model.n_nominal, r.size - model.n_nominal  # of the priors, and of the data
    J = np.zeros((r.size, model.n))
    J[:m] = problem.whiten(model.gradient(x, problem.at)[1])
    J[m:, :n] = np.diag(1 / model.prior[:n])
    scale = np.minimum(model.prior, 1.0)  # inf of an unknown
    # What a command drives moves with its own strength alone.
    if moving is None or model.quasi.kind == "command":
        moving = [model.unknown] if model.quasi.kind == "command" else list(range(model.n))
    damping, exact = FIRST, False
    for _ in range(STEPS):
        before = float(r @ r)
        new, there, damping = _step(model, x, J, r, computed, damping)
        d, change = new - x, there - r
        x, r = new, there
        if before - float(r @ r) > SETTLED:
            by = d / scale**2
            J += np.outer(change - J @ d, by) / (d @ by)
            exact = False
        elif exact:
            break
        else:
            J[:, moving] = _slopes(model, x, r, computed, scale, moving)
            exact, damping = True, LEAST
    chi2, penalty = float(r[:m] @ r[:m]), float(r[m:] @ r[m:])
    return Fitted(model, x, chi2, penalty, J[:m], J[:m].T @ J[:m])


def _step(
    model: LevelModel, x: Float, J: Float, r: Float, computed: Computed, damping: float
) -> tuple[Float, Float, float]:
    """A damped step that lowers the cost, what is left there, and the next damping; the same x and
    r where none was found."""
    A, g = J.T @ J, J.T @ r
    for _ in range(TRIES):
        new = move(model, x, A, g, damping)
        try:
            there = r if new is None else _left(model, new, computed(model, new))
        except SamiiRigError:
            there = r
        if new is not None and float(there @ there) < float(r @ r):
            return new, there, max(damping * 0.3, LEAST)
        damping *= SHORTER
    return x, r, damping


def _left(model: LevelModel, x: Float, problem: Problem) -> Float:
    """Whitened residuals with those of the priors."""
    n = model.n_nominal
    data = problem.residual(model.response(x, problem.at))
    return np.concatenate([data, x[:n] / model.prior[:n]])


def _slopes(
    model: LevelModel, x: Float, r: Float, computed: Computed, scale: Float, moving: Sequence[int]
) -> Float:
    """(r.size, len(moving)) by differences, towards the inside of the bounds."""
    J = np.empty((r.size, len(moving)))
    for i, j in enumerate(moving):
        step = DIFFERENCE * float(scale[j])
        step = -step if x[j] + step > model.upper[j] else step
        ahead = x.copy()
        ahead[j] += step
        J[:, i] = (_left(model, ahead, computed(model, ahead)) - r) / step
    return J
