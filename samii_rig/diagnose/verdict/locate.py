"""Where, without assuming a law: the missing part's own response x(w) at each place.

A part left out at a port turns the state i there into a jump of state j, z+ = z- + e_j x e_i'z-.
Every output is then a Moebius function of x with a common denominator (`moebius`),

    y_k = a_k + b_k x/(1 - c x)     =>     x (b_k + c (y_k - a_k)) = y_k - a_k,

linear in x: least squares at each frequency. With two outputs or more, what no x can explain
tells whether the part can be there; the uncertain nominal parameters are projected out of it.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.fit.moebius import Place, place_of
from samii_rig.diagnose.fit.refit import Fitted, Problem
from samii_rig.diagnose.fit.screen import Start
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Trace
from samii_rig.diagnose.verdict.judge import Judgement
from samii_rig.errors import SamiiRigError
from samii_rig.types import Complex, Float

ROUNDS = 4  # of nominal parameters and x in turn
PLACES_KEPT = 3  # places whose x(w) is kept

PROBES = ("torsional_compliance", "translational_compliance", "added_mass", "added_inertia")
# Jumps that a part makes downwards: z+ = z- - e_j x e_i'z- for its x.
DOWN = (("w", "V"), ("V", "w"))


@dataclass(frozen=True, slots=True)
class Located:
    """A place held against the data, free of any law.

    x : (n,) by frequency. sd : (n,). chi2 : of what no x explains, with the nominal parameters
        refitted; dof : its mean if the part is there.
    """

    effect: Effect
    x: Complex
    sd: Float
    chi2: float
    dof: float

    @property
    def ratio(self) -> float:
        """Chi-square per degree of freedom."""
        return self.chi2 / max(self.dof, 1.0)


def moebius(
    rig_model: Model, effect: Effect, problem: Problem, x: Float, own: Start = ()
) -> tuple[Complex, Place]:
    """a (n, q), and the place of an effect with a jump, about a model at x. own : the effect's
    unknowns, of which the last may belong to the place; where not given, those of a start."""
    assert effect.jump is not None
    a = rig_model.response(x, problem.at)
    trial = rig_model.having((*rig_model.effects, effect))
    values = own or tuple(u.starts[0] for u in effect.unknowns)
    return a, place_of(trial, x, effect, problem.at, a, values[len(values) - effect.jump.fixed :])


def locate(
    base: Fitted, effect: Effect, problem: Problem, *, held: bool = False, own: Start = ()
) -> Located:
    """The best x(w) of one place with the nominal parameters refitted in the same fit, or `held`
    where the base has them. own : as of `moebius`."""
    model = base.model
    a, place = moebius(model, effect, problem, base.x, own)
    b, c = place.b, place.c
    d = problem.data.H
    J = base.jacobian
    n, q = d.shape
    half = n * q
    slopes = (J[:half] + 1j * J[half:]).reshape(n, q, -1)
    W = problem.root
    delta = np.zeros(J.shape[1])
    prior = np.where(np.isfinite(model.prior), model.prior, 10.0)
    x = np.zeros(n, complex)
    for _ in range(1 if held else ROUNDS):
        shift = (slopes @ delta)[:, :, None]
        u = W @ (d - a)[:, :, None] - shift
        v = W @ (b + c[:, None] * (d - a))[:, :, None]
        power = np.sum(np.abs(v) ** 2, axis=(1, 2))
        x = np.sum(v.conj() * u, axis=(1, 2)) / np.maximum(power, 1e-300)
        s = W @ (b / (1 - c * x)[:, None] ** 2)[:, :, None]
        y = W @ (b * (x / (1 - c * x))[:, None])[:, :, None]
        e = u - y + shift
        norm = np.maximum(np.sum(np.abs(s) ** 2, axis=1, keepdims=True), 1e-300)
        P = np.eye(q)[None] - s @ s.conj().swapaxes(1, 2) / norm
        Je = (P @ slopes).reshape(half, -1)
        ee = (P @ e).reshape(half)
        A = np.concatenate([Je.real, Je.imag, np.diag(1 / prior)])
        r = np.concatenate([ee.real, ee.imag, -base.x / prior * np.isfinite(model.prior)])
        if not held:
            delta = np.linalg.lstsq(A, r, rcond=None)[0]
    left = np.concatenate([ee.real, ee.imag]) if held else r - A @ delta
    weight = np.sum(problem.data.expected) / (2 * half)
    sd = np.sqrt(2 / np.maximum(np.sum(np.abs(s) ** 2, axis=(1, 2)), 1e-300))
    return Located(effect, x, sd, float(left @ left), weight * 2 * (half - n))


def traces(search: Search, judged: Judgement) -> tuple[Trace, ...]:
    """x(w) of the places that explain most.

    Each effect that is said to be missing and acts through one number comes first, at its own
    place, about the rig with all the others in it and the nominal parameters as they were
    found; then the places that explain most about the rig without the first. Where nothing is
    said to be missing, all are about the refitted nominal model.
    """
    best, problem = judged.best, search.problem.lines
    shown: list[Located] = []
    for i, effect in enumerate(best.effects):
        base = _without(search, best, i)
        if base is not None and effect.jump is not None and effect.jump.states is not None:
            own = tuple(best.fitted.model.parts(best.fitted.x)[i].tolist())
            about = at_lines(base.fitted, search)
            with suppress(SamiiRigError):  # as below
                shown.append(locate(about, effect, problem, held=True, own=own))
    base = _without(search, best, 0) if best.effects else search.nominal
    if base is not None:
        taken = {i.effect.jump.place for i in shown if i.effect.jump is not None}
        mine = {e.key for e in base.effects}
        fitted = at_lines(base.fitted, search)
        probes = (
            e
            for e in search.table
            if e.physics in PROBES
            and e.jump is not None
            and e.jump.fixed == 0
            and e.jump.place not in taken
            and e.key not in mine
        )
        found = []
        for probe in probes:
            # With some of the strengths that it is probed with there may be no rig: a mass taken
            # off a link that has less.
            with suppress(SamiiRigError):
                found.append(locate(fitted, probe, problem))
        shown += sorted(found, key=lambda item: item.chi2)
    return tuple(_trace(item, search) for item in shown[:PLACES_KEPT])


def at_lines(fitted: Fitted, search: Search) -> Fitted:
    """A fit with the derivatives of responses line by line."""
    problem = search.problem.lines
    if problem is search.problem:
        return fitted
    _, dh = fitted.model.gradient(fitted.x, problem.at)
    J = problem.whiten(dh)
    return replace(fitted, jacobian=J, information=J.T @ J)


def _without(search: Search, best: Explanation, i: int) -> Explanation | None:
    """The explanation without one effect; None where a force of its own is left in it."""
    base = search.without_refit(best, i)
    return None if base is None or any(e.force for e in base.effects) else base


def _trace(item: Located, search: Search) -> Trace:
    assert item.effect.jump is not None
    assert item.effect.jump.states is not None
    jump, by = item.effect.jump.states
    return Trace(
        site=item.effect.site,
        jump=jump,
        by=by,
        frequency=search.problem.data.frequency,
        x=-item.x if (jump, by) in DOWN else item.x,
        sd=item.sd,
        chi2_per_dof=item.ratio,
    )
