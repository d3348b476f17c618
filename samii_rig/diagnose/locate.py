"""Where, without assuming a law: the missing part's own response x(w) at each place.

A part left out at a port turns the state i there into a jump of state j, z+ = z- + e_j x e_i'z-.
Every output is then a Moebius function of x with a common denominator,

    y_k = a_k + b_k x/(1 - c x)     =>     x (b_k + c (y_k - a_k)) = y_k - a_k,

linear in x: least squares at each frequency. b and c follow from the model itself with
the jump at two strengths. With two outputs or more, what no x can explain tells whether the
part can be there; the uncertain nominal parameters are projected out of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.judge import Judgement
from samii_rig.diagnose.model import Model
from samii_rig.diagnose.refit import Fitted, Problem
from samii_rig.diagnose.result import Trace
from samii_rig.diagnose.search import Search
from samii_rig.types import Complex, Float

ROUNDS = 4  # of nominal parameters and x in turn
SHOWN = 3  # places whose x(w) is kept

# x(s) of a part with one strength and nothing else: by its physics, and its jump in words.
PROBES: dict[str, tuple[str, str, Callable[[Complex, float], Complex]]] = {
    "torsional_compliance": ("theta", "M", lambda s, k: np.full(s.shape, 1 / k, complex)),
    "translational_compliance": ("w", "V", lambda s, k: np.full(s.shape, -1 / k, complex)),
    "added_mass": ("V", "w", lambda s, m: -m * s**2),
    "added_inertia": ("M", "theta", lambda s, J: J * s**2),
}


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
    rig_model: Model, effect: Effect, problem: Problem, x: Float
) -> tuple[Complex, Complex, Complex]:
    """a (n, q), b (n, q) and c (n,) of the effect's jump, about a model at x."""
    law = PROBES[effect.physics][2]
    s = np.asarray(2j * np.pi * problem.at.frequency, np.complex128)
    a = rig_model.response(x, problem.at)
    trial = Model(rig_model.rig, (*rig_model.effects, effect))
    middle = np.sqrt(effect.unknowns[0].low * effect.unknowns[0].high)
    g, strength = [], []
    for value in (middle, 3 * middle):
        start = [value, *(1e-9 for _ in effect.unknowns[1:])]
        y = trial.response(np.append(x, np.log(start)), problem.at)
        strength.append(law(s, value))
        g.append((y - a) / strength[-1][:, None])
    # g = b/(1 - c x): the ratio of two gives c, from the entry that moves most.
    k = np.argmax(np.abs(g[0]), axis=1)[:, None]
    R = (np.take_along_axis(g[0], k, 1) / np.take_along_axis(g[1], k, 1))[:, 0]
    c = (R - 1) / (R * strength[0] - strength[1])
    return a, g[0] * (1 - c * strength[0])[:, None], c


def locate(base: Fitted, effect: Effect, problem: Problem) -> Located:
    """The best x(w) of one place with the nominal parameters refitted in the same fit."""
    model = base.model
    a, b, c = moebius(model, effect, problem, base.x)
    d = problem.data.H
    J = base.jacobian
    n, q = d.shape
    half = n * q
    slopes = (J[:half] + 1j * J[half:]).reshape(n, q, -1)
    W = problem.root
    delta = np.zeros(J.shape[1])
    prior = np.where(np.isfinite(model.prior), model.prior, 10.0)
    x = np.zeros(n, complex)
    for _ in range(ROUNDS):
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
        delta = np.linalg.lstsq(A, r, rcond=None)[0]
    left = r - A @ delta
    weight = np.sum(problem.data.expected) / (2 * half)
    sd = np.sqrt(2 / np.maximum(np.sum(np.abs(s) ** 2, axis=(1, 2)), 1e-300))
    return Located(effect, x, sd, float(left @ left), weight * 2 * (half - n))


def traces(search: Search, judged: Judgement) -> tuple[Trace, ...]:
    """x(w) of the places that explain most, about the refitted nominal model."""
    nominal = search.nominal.fitted
    if search.problem.data.H.shape[1] < 1:
        return ()
    found = [
        locate(nominal, e, search.problem)
        for e in search.table
        if e.physics in PROBES
        and len(e.unknowns) <= 2
        and not any(u.symbol == "position" for u in e.unknowns)
    ]
    del judged
    best = sorted(found, key=lambda item: item.chi2)[:SHOWN]
    return tuple(
        Trace(
            site=item.effect.site,
            jump=PROBES[item.effect.physics][0],
            by=PROBES[item.effect.physics][1],
            frequency=search.problem.data.frequency,
            x=item.x,
            sd=item.sd,
            chi2_per_dof=item.ratio,
        )
        for item in best
    )
