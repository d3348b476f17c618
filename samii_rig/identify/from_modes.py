"""Parameters from modes that were measured: poles and residues, weighted by their covariance.

    found = identify_modes(saved_modes(Path("modes.json")), rig, ["joint_1.k", "joint_2.k"])

A pole a and its residues R of the model come from a circle around the pole, by the residue theorem,

    R = mean(G z),   dR = mean(dG z),   R da = mean(dG z^2),   z = s - a,

with the chain's own derivatives dG, so that both have exact slopes. The mean over equal angles
converges as a power of how much nearer the pole is than the next one (Trefethen and Weideman, SIAM
Review 56, 2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy import linalg, special

from samii_rig.errors import EstimateError, InputError, one_of
from samii_rig.identify.identifiability import identifiability
from samii_rig.identify.parameters import Free, Space, changed, space
from samii_rig.identify.result import Identification, bounds_met
from samii_rig.levenberg import minimise
from samii_rig.modal.match import model_modes, paired
from samii_rig.modal.saved import SavedModes
from samii_rig.model.shapes import root
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.signal.whitening import Fit
from samii_rig.types import Complex, Float, Int

Use = Literal["residues", "shapes", "poles"]
CIRCLE = 0.005  # of |a|, radius around a pole: modes 1 % apart are still two
ANGLES = 16
SAME_POLE = 1e-6  # of |a|, distance of two followed poles that have become one
SUBSTEPS = 64  # into which a step is cut at most, where poles move too far to be followed
UNDIVIDED = "nothing divided out"
TESTS = 1e-9  # part of one number's chi-square that the parameters leave, from which it tests them
UNTESTED = (
    "Nothing tests the model: the modes are no more numbers than the parameters that they set."
)


@dataclass(frozen=True, slots=True)
class ModeLeft:
    """What is left of one mode.

    frequency_hz, damping : measured; model_hz, model_damping : of the model. ratio : chi-square of
    the mode's own numbers over how many they are.
    """

    level: str
    frequency_hz: float
    damping: float
    model_hz: float
    model_damping: float
    ratio: float


@dataclass(frozen=True, slots=True)
class FromModes:
    """found : parameters, with the test of the fit. use : what of the modes was fitted.
    modes : what is left of each. without : those that the model does not have, in words.
    tested : whether the modes are more numbers than the parameters need."""

    found: Identification
    use: Use
    modes: tuple[ModeLeft, ...]
    without: tuple[str, ...]
    tested: bool

    def plain(self) -> dict[str, object]:
        """Numbers and words as plain data, for machines."""
        names = ("level", "frequency_hz", "damping", "model_hz", "model_damping", "ratio")
        rows = [{name: getattr(m, name) for name in names} for m in self.modes]
        found = {**self.found.plain(), "verdict": list(self.sentences())}
        return {**found, "use": self.use, "modes": rows, "without": list(self.without)}

    def sentences(self) -> tuple[str, ...]:
        """The verdict in words, as of an identification."""
        fit, *rest = self.found.sentences()
        return UNTESTED if not self.tested else fit, *rest


def identify_modes(
    modes: Sequence[SavedModes],
    rig: Rig,
    free: Sequence[str | Free],
    *,
    prior: bool = False,
    use: Use = "residues",
) -> FromModes:
    """Maximum likelihood, or maximum posterior, estimate of `free` from measured modes.

    Parameters
    ----------
    modes : of one or several responses; the noise of different ones is independent.
    use : `residues` takes all; `shapes` residues over the one that is known best, which needs no
        calibrated input; `poles` frequencies and damping alone.
    free, prior : as of `maximum_likelihood.identify`.

    Raises
    ------
    InputError : unknown parameters, channels that the rig does not have, modes of a closed loop,
        residues from which hold and filters were not divided out, fewer numbers than parameters.
    EstimateError : no mode that the model has too, or poles that cannot be followed.
    """
    if use not in get_args(Use):
        raise InputError("identify", "use", use, one_of(use, get_args(Use)))
    if not modes:
        raise InputError("modes", "", 0, "the modes of at least one response")
    for saved in modes:
        _check(saved, rig, use)
    chosen = space(rig, free, prior)
    blocks, without = [], []
    for saved in modes:
        at, start, lost = _matched(saved, rig)
        without += lost
        if at.size:
            blocks.append(_Block.of(saved, at, rig, use, start))
    if not blocks:
        raise EstimateError(f"the model has none of these modes: {'; '.join(without)}")
    n, needed = sum(b.goal.size for b in blocks), int(np.sum(~np.isfinite(chosen.prior_sd)))
    if n < needed:
        have = f"{n} real numbers for {needed} parameters without a prior"
        raise InputError("identify", "modes", have, "more modes, fewer free parameters or priors")
    fitted = _Problem(Chain(rig), chosen, blocks)
    found = minimise(fitted.at, np.zeros(chosen.start.size), chosen.lower, chosen.upper)
    return _result(fitted, rig, found.x, use, tuple(without))


def _check(saved: SavedModes, rig: Rig, use: Use) -> None:
    if saved.closed_loop:
        what = "modes over a command: a loop is in those over a reference"
        raise InputError(saved.where, "inputs", ", ".join(saved.inputs), what)
    for word, names, have in (
        ("outputs", saved.outputs, [s.name for s in rig.sensor]),
        ("inputs", saved.inputs, [a.name for a in rig.actuator]),
    ):
        for name in names:
            if name not in have:
                raise InputError(saved.where, word, name, f"of {rig.name} {one_of(name, have)}")
    if use != "poles" and saved.divided.startswith(UNDIVIDED):
        what = "`samii-rig modes --rig` beforehand, or --use poles: a hold turns residues"
        raise InputError(saved.where, "divided", saved.divided, what)


def _matched(saved: SavedModes, rig: Rig) -> tuple[Int, Complex, list[str]]:
    """Measured modes that the model has, its poles of them, and the others in words."""
    hz = np.abs(saved.poles) / (2 * np.pi)
    known = model_modes(rig, float(np.max(hz)))
    # Of several inputs the one that drives a mode most shows its shape best.
    best = np.argmax(np.sum(np.abs(saved.residues) ** 2, axis=1), axis=1)
    shapes = [R[:, j] for R, j in zip(saved.residues, best, strict=True)]
    found = paired(hz.tolist(), shapes, saved.outputs, saved.units, known)
    held = {p.mode for p in found}
    lost = [
        f"{saved.name}: the mode at {f:.4g} Hz" for i, f in enumerate(hz.tolist()) if i not in held
    ]
    w = np.array([2 * np.pi * known[p.other].frequency_hz for p in found])
    zeta = np.array([known[p.other].damping for p in found])
    start = w * (-zeta + 1j * np.sqrt(1 - zeta**2)) if found else np.zeros(0)
    return np.array([p.mode for p in found], np.int64), np.asarray(start, np.complex128), lost


@dataclass(frozen=True)
class _Block:
    """The modes of one response. goal : (n,) numbers that are fitted; root : (n, n) with
    root C root' = 1. reference : (m,) entries that shapes are over, -1 where residues are fitted.
    start : (m,) poles of the model as the rig file has it."""

    saved: SavedModes
    at: Int
    entries: tuple[Int, Int]
    use: Use
    reference: Int
    goal: Float
    covariance: Float
    root: Float
    start: Complex

    @classmethod
    def of(cls, saved: SavedModes, at: Int, rig: Rig, use: Use, start: Complex) -> _Block:
        m, p = len(saved.poles), saved.residues[0].size
        y = np.concatenate([saved.poles[:, None], saved.residues.reshape(m, p)], axis=1)
        sd = np.sqrt(np.diag(saved.covariance).reshape(m, 1 + p, 2).sum(axis=2))
        reference = np.argmax(np.abs(y[:, 1:]) / sd[:, 1:], axis=1)[at]
        own = (np.arange(2 * (1 + p)) + 2 * (1 + p) * at[:, None]).ravel()
        C = saved.covariance[np.ix_(own, own)]
        goal, slopes = _numbers(y[at], use, reference)
        C = slopes @ C @ slopes.T
        scale = np.sqrt(np.diag(C))
        # Scaled first: poles and residues differ by many orders.
        L = np.linalg.cholesky(C / np.outer(scale, scale))
        inverse = linalg.solve_triangular(L, np.diag(1 / scale), lower=True)
        sensors, actuators = [s.name for s in rig.sensor], [a.name for a in rig.actuator]
        outs = [sensors.index(name) for name in saved.outputs]
        ins = [actuators.index(name) for name in saved.inputs]
        entries = (np.repeat(outs, len(ins)), np.tile(ins, len(outs)))
        return cls(saved, at, entries, use, reference, goal, C, inverse, start)

    def predicted(self, y: Complex, dy: Complex) -> tuple[Float, Float]:
        """(n,) numbers of the model and their slopes (n, n_free), of poles and residues (m, 1 + p)
        and theirs (m, 1 + p, n_free)."""
        z, slopes = _numbers(y, self.use, self.reference)
        flat = dy.reshape(-1, dy.shape[-1])
        real = np.stack([flat.real, flat.imag], axis=1).reshape(-1, dy.shape[-1])
        return z, np.asarray(slopes @ real)


def _numbers(y: Complex, use: Use, reference: Int) -> tuple[Float, Float]:
    """What is fitted of poles and residues (m, 1 + p), as real numbers (n,), and their slopes (n,
    2 m (1 + p)) by the real and imaginary parts."""
    m, size = y.shape
    rows, by = [], []
    for i, (one, ref) in enumerate(zip(y, reference.tolist(), strict=True)):
        unit = np.eye(m * size)[i * size : (i + 1) * size]
        rows.append(one[0])
        by.append(unit[0] + 0j)
        for k in range(1, size):
            if use == "residues":
                rows.append(one[k])
                by.append(unit[k] + 0j)
            elif use == "shapes" and k != ref + 1:
                R = one[ref + 1]
                rows.append(one[k] / R)
                by.append(unit[k] / R - unit[ref + 1] * one[k] / R**2)
    z, D = np.array(rows), np.array(by)
    slopes = np.stack([np.stack([D.real, -D.imag], -1), np.stack([D.imag, D.real], -1)], axis=1)
    return np.stack([z.real, z.imag], -1).ravel(), slopes.reshape(2 * len(z), -1)


class _Problem:
    """Residuals in noise units, then of the priors, and their slopes, by x = log(value/start)."""

    def __init__(self, chain: Chain, chosen: Space, blocks: Sequence[_Block]) -> None:
        self.chain, self.space, self.blocks = chain, chosen, blocks
        self._x = np.zeros(chosen.start.size)
        self._poles = self._roots(self._x, np.concatenate([b.start for b in blocks]))

    @property
    def n(self) -> int:
        """Numbers that are fitted."""
        return sum(b.goal.size for b in self.blocks)

    def at(self, x: Float) -> tuple[Float, Float]:
        """(n + priors,) residuals at x, and their slopes (n + priors, n_free)."""
        r, J = [], []
        for block, (y, dy) in zip(self.blocks, self.model(x), strict=True):
            have, by = block.predicted(y, dy)
            r.append(block.root @ (have - block.goal))
            J.append(block.root @ by)
        known = np.flatnonzero(np.isfinite(self.space.prior_sd))
        sd = self.space.prior_sd[known]
        r.append((x - self.space.prior_mean)[known] / sd)
        J.append(np.eye(x.size)[known] / sd[:, None])
        return np.concatenate(r), np.concatenate(J)

    def model(self, x: Float) -> list[tuple[Complex, Complex]]:
        """Of each block poles and residues (m, 1 + p) of the model, and slopes by x."""
        poles = self._followed(x)
        chain = self.chain.with_values(self.space.mapping(x))
        z: Complex = (
            CIRCLE * np.abs(poles)[:, None] * np.exp(2j * np.pi * np.arange(ANGLES) / ANGLES)
        )
        G, dG = chain.gradient_at((poles[:, None] + z).ravel(), self.space.keys)
        G = G.reshape(*z.shape, *G.shape[1:])
        dG = dG.reshape(*z.shape, *dG.shape[1:]) * self.space.values(x)
        out, first = [], 0
        for block in self.blocks:
            own = slice(first, first + block.at.size)
            first = own.stop
            sensor, actuator = block.entries
            R = np.mean(G[own][:, :, sensor, actuator] * z[own, :, None], axis=1)
            slopes = dG[own][:, :, sensor, actuator]
            dR = np.mean(slopes * z[own, :, None, None], axis=1)
            moved = np.mean(slopes * z[own, :, None, None] ** 2, axis=1)
            power = np.sum(np.abs(R) ** 2, axis=1)[:, None]
            da = np.sum(R.conj()[:, :, None] * moved, axis=1) / power
            y = np.concatenate([poles[own, None], R], axis=1)
            out.append((y, np.concatenate([da[:, None], dR], axis=1)))
        return out

    def _followed(self, x: Float) -> Complex:
        """The poles at x, followed from where they were last."""
        steps = 1
        while steps <= SUBSTEPS:
            try:
                return self._walked(x, steps)
            except InputError:
                steps *= 4
        raise EstimateError("the poles of the model cannot be followed; start nearer to the rig")

    def _walked(self, x: Float, steps: int) -> Complex:
        before = now = self._poles
        for k in range(1, steps + 1):
            there = self._x + (x - self._x) * k / steps
            before, now = now, self._roots(there, 2 * now - before)
        self._x, self._poles = x.copy(), now
        return now

    def _roots(self, x: Float, start: Complex) -> Complex:
        """The poles at x next to `start`; InputError where there is none, or one for two."""
        chain = self.chain.with_values(self.space.mapping(x))
        out = np.array([root(chain, complex(a)) for a in start], np.complex128)
        first = 0
        for block in self.blocks:
            own = out[first : first + block.at.size]
            first += block.at.size
            apart = np.abs(own[:, None] - own) + np.where(np.eye(own.size), np.inf, 0.0)
            if np.any(apart < SAME_POLE * np.abs(own)):
                raise InputError("poles", "", "one for two modes", "one of each")
        return out


def _result(fitted: _Problem, rig: Rig, x: Float, use: Use, without: tuple[str, ...]) -> FromModes:
    r, J = fitted.at(x)
    n, free = fitted.n, fitted.space
    left = _left(fitted, x)
    u, own, vt = np.linalg.svd(J, full_matrices=False)
    # A direction that nothing holds is known at least to lie within the bounds.
    s = np.maximum(own, 1 / np.max(free.upper - free.lower))
    cov = (vt.T / s**2) @ vt
    tests = np.linalg.eigvalsh(np.eye(n) - (u[:n] * (own / s) ** 2) @ u[:n].T)
    tests = np.clip(tests[tests > TESTS], 0.0, 1.0)
    start = fitted.at(np.zeros(x.size))[0]
    at_bound, on_top = bounds_met(free, x)
    outputs = [name for b in fitted.blocks for name in b.saved.outputs]
    found = Identification(
        rig=changed(rig, free.mapping(x)),
        names=free.names,
        units=free.units,
        start=free.start,
        values=free.values(x),
        log_covariance=cov,
        prior_sd=free.prior_sd,
        fit=_fit(r[:n], tests),
        start_fit=_fit(start[:n], np.ones(n)),
        residuals=(),
        identifiability=identifiability(J[:n], free.names, outputs),
        at_bound=at_bound,
        starts=1,
        reached=1,
        prediction=(),
        on_top=on_top,
    )
    return FromModes(found, use, left, without, bool(tests.size))


def _fit(r: Float, tests: Float) -> Fit:
    """Chi-square is a sum of squares of variances `tests`, 0 to 1: below 1 where a parameter with a
    prior takes part of it. Its distribution is that of a chi-square with the same mean and variance
    (Satterthwaite, Biometrics Bulletin 2, 1946). Without any of them it is 1 and holds."""
    if not tests.size:
        return Fit(1.0, 1.0, r.size)
    chi2, mean, unit = float(r @ r), float(np.sum(tests)), float(np.sum(tests**2) / np.sum(tests))
    return Fit(chi2 / mean, float(special.chdtrc(mean / unit, chi2 / unit)), r.size)


def _left(fitted: _Problem, x: Float) -> tuple[ModeLeft, ...]:
    out = []
    for block, (y, dy) in zip(fitted.blocks, fitted.model(x), strict=True):
        d = block.predicted(y, dy)[0] - block.goal
        each = d.size // block.at.size
        for i, at in enumerate(block.at.tolist()):
            own = slice(i * each, (i + 1) * each)
            ratio = float(d[own] @ np.linalg.solve(block.covariance[own, own], d[own])) / each
            measured, model = complex(block.saved.poles[at]), complex(y[i, 0])
            of = [(abs(a) / (2 * np.pi), -a.real / abs(a)) for a in (measured, model)]
            out.append(ModeLeft(block.saved.name, *of[0], *of[1], ratio))
    return tuple(out)
