"""Forces in the likelihood of whole records.

A force e at its place moves the sensors of the open loop by y_e; the command v was recorded. So

    y = H_open v + y_e,   v = r - kp theta   ->   y - y_e = H (r - kp theta_e),

H the closed loop's response: less what the force does to the sensors, a record is one of the linear
rig under a slightly other input. A force on the command, v + e in the place of v, is the input
r + e. What drives the force is computed in time from the recorded command and the force itself,
from rest to the record's last sample: harmonics, start and cut end are in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from samii_rig.diagnose.model import Grid
from samii_rig.diagnose.nonlinear_inner import Inner, Sensed
from samii_rig.diagnose.nonlinear_levels import RecordGrid
from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi
from samii_rig.diagnose.records import RecordProblem, Whole
from samii_rig.diagnose.refit import Fitted, Problem
from samii_rig.likelihood.complete import Complete
from samii_rig.likelihood.pieces import Piece, Samples
from samii_rig.types import Complex, Float


@dataclass
class Chains:
    """The partial fractions through which forces act, kept where each was computed first: what the
    chain's parameters change of a force is of second order, until `renew` asks for it."""

    kept: dict[str, tuple[Inner, Sensed]] = field(default_factory=dict)
    near: Complex | None = None  # poles, which are the same wherever a force acts

    def at(self, model: LevelModel, x: Float) -> tuple[Inner, Sensed]:
        """Of a model near x, whatever the strength.

        Raises SamiiRigError where it has none.
        """
        key = " ".join((model.quasi.kind, *model.quasi.across, *(e.key for e in model.effects)))
        if key not in self.kept:
            self.kept[key] = Inner.sensed(model, x, self.near)
            self.near = self.kept[key][0].structure
        inner, sensed = self.kept[key]
        return replace(inner, scale=model.quasi.sign * model.strength(x)[1]), sensed

    def renew(self) -> None:
        """Compute all anew, where they are asked for next."""
        self.kept.clear()


@dataclass(frozen=True)
class Moved:
    """What a force does under the commands of all pieces."""

    whole: Whole
    chains: Chains

    def of(self, model: LevelModel, x: Float) -> list[Samples]:
        """Of each piece the change of its input r (history + n,) and of its sensors z (n, q)."""
        p, _ = model.strength(x)
        quasi, wired = model.quasi, self.whole.wired
        pieces = self.whole.records.pieces
        q = len(wired.sensors)
        if quasi.kind == "command":
            return [_told(piece, quasi, p, q) for piece in pieces]
        inner, sensed = self.chains.at(model, x)
        out = []
        for piece in pieces:
            v, times = _mean(piece)
            y = times * sensed.of(inner.from_rest(v, p))[:, self.whole.sensor]
            r = np.zeros(piece.r.size)
            if wired.kp:
                r -= wired.kp * y[:, wired.sensors.index(wired.centring)]
            out.append(Samples(r, y[piece.history :]))
        return out

    def without(self, fitted: Fitted) -> Whole:
        """The records as those of the linear part of a fit."""
        assert isinstance(fitted.model, LevelModel)
        moved = self.of(fitted.model, fitted.x)
        records = self.whole.records
        pieces = tuple(
            replace(piece, r=piece.r + m.r, z=piece.z - m.z)
            for piece, m in zip(records.pieces, moved, strict=True)
        )
        return replace(self.whole, records=replace(records, pieces=pieces))


def _told(piece: Piece, quasi: Quasi, p: float, q: int) -> Samples:
    """A force on the command alone, of every record by itself: a converter's steps fall differently
    each time."""
    assert quasi.law is not None
    r = np.zeros(piece.r.size)
    for command in piece.commands:
        r += command.part * quasi.sign * quasi.law.force(command.v, p)
    return Samples(r, np.zeros((len(piece.z), q)))


def _mean(piece: Piece) -> tuple[Float, float]:
    """The command of a piece's records, which repeat each other, and how many times the piece has
    what one of them does."""
    times = sum(c.part for c in piece.commands)
    return np.asarray(sum(c.part * c.v for c in piece.commands) / times), times


@dataclass(frozen=True)
class ForceProblem(RecordProblem):
    """The likelihood of whole records for models with and without a force, near a reference.

    complete : all lines. goal : of them, both parts.
    """

    complete: Complete = field(kw_only=True)
    goal: Float = field(kw_only=True)

    @classmethod
    def near(cls, whole: Whole, fitted: Fitted, by_line: Problem, chains: Chains) -> ForceProblem:
        """About a fit, with a force or without."""
        moved = Moved(whole, chains)
        about = moved.without(fitted) if isinstance(fitted.model, LevelModel) else whole
        complete = about.complete(fitted)
        exact = whole.records.exact()
        S = whole.response(fitted)(exact.s)
        order, k = complete.rows.order, [whole.records.lines(p).k for p in whole.records.pieces]

        def added(model: LevelModel, x: Float) -> Complex:
            each = [
                -whole.records.left(Samples(m.r, -m.z), k_, S, exact)
                for m, k_ in zip(moved.of(model, x), k, strict=True)
            ]
            return np.asarray(np.concatenate(each)[order])

        nodes = whole.grid(complete.reduced.frequency, complete.reduced.sigma, fitted)
        own: dict[str, Any] = {f.name: getattr(nodes, f.name) for f in fields(nodes)}
        at = RecordGrid(**own, added=added)
        e = complete.rows.e
        if isinstance(fitted.model, LevelModel):
            e = np.asarray(e + added(fitted.model, fitted.x))
        return cls(
            by_line.data, by_line.root, at, by_line=by_line, reduced=complete.reduced,
            complete=complete, goal=complete.split(e),
        )  # fmt: skip

    @property
    def expected(self) -> float:
        """As of `Problem`."""
        return self.complete.expected

    def residual(self, h: Complex) -> Float:
        """As of `Problem`."""
        b = self.reduced.reference.shape[0]
        d = (h[:b] - self.reduced.reference)[:, :, None]
        return np.asarray(self._moved(d, h[b:, :, None])[:, 0] - self.goal)

    def whiten(self, dh: Complex) -> Float:
        """As of `Problem`."""
        b = self.reduced.reference.shape[0]
        return self._moved(dh[:b], dh[b:])

    def toward(self, h: Complex) -> ForceProblem:
        """As of `Problem`."""
        return replace(self, goal=self.residual(h) + self.goal)

    def lines_of(self, model: LevelModel, x: Float) -> Complex:
        """(n, q) what the force of a model adds to the lines.

        Raises SamiiRigError where the rig has no partial fractions at x.
        """
        assert isinstance(self.at, RecordGrid)
        return self.at.added(model, x)

    def without_force(self) -> RecordProblem:
        """For linear models alone, beside the force that the reference has."""
        own = {f.name: getattr(self.at, f.name) for f in fields(Grid)}
        at = Grid(**own)
        return RecordProblem(self.data, self.root, at, by_line=self.by_line, reduced=self.reduced)

    def _moved(self, d: Complex, lines: Complex) -> Float:
        """(m + 2 n q, p) of changes on the nodes and of lines."""
        out = np.zeros((self.goal.size, d.shape[2]))
        out[: self.reduced.factor.shape[0]] = self.reduced.slopes(d)
        if lines.size:
            for j in np.flatnonzero(np.any(lines != 0, axis=(0, 1))):
                out[:, j] += self.complete.split(lines[:, :, j])
        return out
