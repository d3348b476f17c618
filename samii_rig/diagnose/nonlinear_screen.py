"""Do the levels differ as a nonlinear force would make them? Asked before anything is refitted.

Whatever is linear is one response at all levels. Taken apart by level, with a free response
common to all in each bin projected out, lines hold nothing of it, known or not: what a force does
to the rest is its `contrast`. The same force against all that a linear explanation leaves has
more power, but mimics what is left of linear physics too.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.measured import Measured, binned, combined, summed
from samii_rig.diagnose.model import Grid
from samii_rig.diagnose.nonlinear_levels import Extra, LevelGrid
from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi
from samii_rig.diagnose.refit import Fitted, Problem
from samii_rig.errors import SamiiRigError
from samii_rig.types import Complex, Float, Int

BINS = 70  # of each level
MOST = 220  # the same where a bin is divided, because what is left has structure in it
LOOSE = 1e-3  # precision of an unknown without a prior, which keeps the projection regular
CLOSER = 3  # times that the best strengths are looked at closer
APART = 2.5  # of a logarithm: strengths from which different optima may be reached
SECOND = 0.6  # of the best strength's gain: less is no start of its own
# Fields of `Measured` that are not of its lines.
WHOLE = ("levels", "periodic", "ringing", "sensor", "actuator", "outputs", "inside", "rate_hz")


@dataclass(frozen=True, slots=True)
class Bins:
    """Bins of one level each, the same for all levels.

    all : frequencies of the grid. levels : of each level its lines, the shape that is taken out
    of them, and where bins begin.
    """

    lines: Measured
    all: Float
    levels: tuple[tuple[Measured, Complex, Int], ...]

    @classmethod
    def of(cls, lines: Measured, fitted: Fitted, at: Grid, bins: int = BINS) -> Bins:
        """About a fit."""
        own = [lines.take(lines.level == k) for k in np.unique(lines.level)]
        shapes = [fitted.model.response(fitted.x, at.at(o.frequency, o.level)) for o in own]
        shapes = [np.where(s == 0, 1.0, s) for s in shapes]
        few = [binned(o, s, bins, MOST) for o, s in zip(own, shapes, strict=True)]
        # Edges half way between the bins of the level that shows most.
        f = max(few, key=lambda part: part.n).frequency
        edges = np.sqrt(f[1:] * f[:-1])
        starts = [
            np.unique(np.concatenate([[0], i[i < o.n]]))
            for o in own
            for i in (np.searchsorted(o.frequency, edges),)
        ]
        return cls(lines, at.frequency, tuple(zip(own, shapes, starts, strict=True)))

    def combined(self, H: Complex | None = None) -> Measured:
        """The lines in their bins; with H (n, q) in the place of what was measured."""
        parts = []
        for own, shape, starts in self.levels:
            if H is not None:
                own = replace(own, H=H[self.lines.level == own.level[0]])
            parts.append(combined(own, shape, starts)[0])
        order = np.argsort(np.concatenate([p.frequency for p in parts]), kind="stable")
        joined: dict[str, Any] = {
            f.name: np.concatenate([getattr(p, f.name) for p in parts])[order]
            for f in fields(self.lines)
            if f.name not in WHOLE
        }
        inside = (sum(p.inside[0] for p in parts), sum(p.inside[1] for p in parts))
        return replace(self.lines, inside=inside, **joined)

    def better(self, problem: Problem, quasi: Quasi, extra: Extra) -> Problem:
        """The problem with what `driven` found, in the place of earlier findings."""
        lines = self.lines
        at = problem.at
        assert isinstance(at, LevelGrid)
        whole = extra.at(lines.level, np.searchsorted(self.all, lines.frequency))
        more = {**at.extra, quasi: replace(whole, part=self.combined(whole.part).H)}
        return replace(problem, at=replace(at, extra=more))


@dataclass(frozen=True, slots=True)
class Promise:
    """What a force gains beside a linear explanation.

    gain : of chi-square, the explanation's own freedom projected out. contrast : the same with a
    free response common to all levels projected out; due : what it would be if the force were
    the truth. starts : of its strength.
    """

    effect: Effect
    gain: float
    contrast: float
    due: float
    starts: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Levels:
    """A linear fit on lines whose levels are apart, and both projections."""

    problem: Problem
    base: Fitted
    residual: Float
    directions: Float
    groups: Int  # (n,) bins with the same frequency
    columns: Complex  # (n, q, q) whitened response, each output by itself
    inverse: Complex  # (n_group, q, q)

    @classmethod
    def of(cls, problem: Problem, base: Fitted) -> Levels:
        """About a fit that need not be this problem's optimum."""
        model, x, at = base.model, base.x, problem.at
        h, dh = model.gradient(x, at)
        prior = model.prior
        known = np.isfinite(prior)
        rows = np.diag(np.where(known, 1 / prior, LOOSE))
        Q = np.linalg.qr(np.concatenate([problem.whiten(dh), rows]))[0]
        tail = np.where(known, x / prior, 0.0)
        residual = np.concatenate([problem.residual(h), tail])
        residual = residual - Q @ (Q.T @ residual)
        groups = _same_bin(problem.data)
        columns = np.asarray(problem.root * h[:, None, :], np.complex128)
        A = summed(columns.conj().swapaxes(1, 2) @ columns, groups, int(groups.max()) + 1)
        inverse = np.asarray(np.linalg.pinv(A, rcond=1e-12, hermitian=True), np.complex128)
        return cls(problem, base, residual, Q, groups, columns, inverse)

    def promise(self, effect: Effect, model: LevelModel) -> Promise | None:
        """What `effect`, the last of `model`, gains; None where it cannot act."""
        at = self.problem.at
        assert isinstance(at, LevelGrid)
        unknown = effect.unknowns[0]
        x = np.append(self.base.x, np.log(unknown.starts[0]))
        p = np.array(unknown.starts)
        tried: list[tuple[Float, Float, Float, Float]] = []
        for _ in range(CLOSER):
            try:
                with np.errstate(all="ignore"):
                    d = model.several(x, at, p)
            except SamiiRigError:
                return None
            d = np.einsum("nij,mnj->mni", self.problem.root, d)
            on = np.all(np.isfinite(d), axis=(1, 2))
            if not on.any():
                break
            p, d = p[on], d[on]
            gain, far = self._gain(d)
            tried.append((p, gain, *self._contrast(d)))
            # One step along the strength, from the best.
            best = np.argsort(gain)[-2:]
            p = np.clip(model.scaled(at, p[best], far[best]), unknown.low, unknown.high)
        if not tried:
            return None
        p, gain, contrast, due = (np.concatenate(column) for column in zip(*tried, strict=True))
        first = int(np.argmax(gain))
        starts = [float(p[first])]
        far_off = np.abs(np.log(p / p[first])) > APART
        if far_off.any():
            other = int(np.argmax(np.where(far_off, gain, -np.inf)))
            starts += [float(p[other])] if gain[other] > SECOND * gain[first] else []
        return Promise(
            effect, float(gain[first]), float(contrast[first]), float(due[first]), tuple(starts)
        )

    def _gain(self, d: Complex) -> tuple[Float, Float]:
        """(m,) fall of chi-square, and how many times as strong it would be at its best."""
        rows = d.reshape(len(d), -1)
        v = np.concatenate([rows.real, rows.imag], axis=1)
        Q = self.directions[: v.shape[1]]
        through = v @ Q
        left = -(v @ self.residual[: v.shape[1]])
        power = np.sum(v**2, axis=1) - np.sum(through**2, axis=1)
        with np.errstate(all="ignore"):
            return 2 * left - power, np.nan_to_num(left / power, nan=1.0)

    def _contrast(self, d: Complex) -> tuple[Float, Float]:
        """(m,) fall of chi-square, and what it should be, of levels against each other."""
        rows = self.residual[: 2 * d[0].size]
        r = (rows[: d[0].size] + 1j * rows[d[0].size :]).reshape(d.shape[1:])
        b_r, b_d = self._common(r[None]), self._common(d)
        solved = np.einsum("gij,mgj->mgi", self.inverse, b_d)
        power = np.sum(np.abs(d) ** 2, axis=(1, 2)) - np.sum(
            (b_d.conj() * solved).real, axis=(1, 2)
        )
        both = np.sum((d.conj() * r).real, axis=(1, 2)) - np.sum(
            (solved.conj() * b_r).real, axis=(1, 2)
        )
        return -2 * both - power, power

    def _common(self, d: Complex) -> Complex:
        """(m, n_group, q) the part of d along a response common to all levels."""
        part = np.einsum("nji,mnj->mni", self.columns.conj(), d)
        out = summed(np.moveaxis(part, 0, -1), self.groups, len(self.inverse))
        return np.asarray(np.moveaxis(out, -1, 0))


def _same_bin(data: Measured) -> Int:
    """(n,) which bin of the level that has most of them each line is nearest to."""
    levels, counts = np.unique(data.level, return_counts=True)
    f = data.frequency[data.level == levels[int(np.argmax(counts))]]
    return np.asarray(np.searchsorted(np.sqrt(f[1:] * f[:-1]), data.frequency), dtype=np.int64)
