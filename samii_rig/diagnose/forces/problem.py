"""Forces in the likelihood of whole records.

A force e at its place moves the sensors of the open loop by y_e; the command v was recorded. So

    y = H_open v + y_e,   v = r - kp theta   ->   y - y_e = H (r - kp theta_e),

H the closed loop's response: less what the force does to the sensors, a record is one of the linear
rig under a slightly other input. A force on the command, v + e in the place of v, is the input
r + e. What drives the force is computed in time from the recorded command and the force itself,
from rest to the record's last sample: harmonics, start and cut end are in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import signal

from samii_rig.diagnose.fit.record_search import RecordProblem
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted, Problem
from samii_rig.diagnose.forces.model import ForceModel, RecordGrid
from samii_rig.diagnose.forces.way import Ways
from samii_rig.diagnose.physics.grid import Grid
from samii_rig.likelihood.algebra import by_input
from samii_rig.likelihood.complete import Complete
from samii_rig.likelihood.inputs import rest_of
from samii_rig.likelihood.pieces import Command, Piece, Samples
from samii_rig.types import Complex, Float

# Of a command between the samples that were recorded, what its interpolation is off by, and the
# samples on either side that this takes (Kaiser): of a limit, a thousandth showed.
STRAY, REACH = 1e-5, 32
# Instants of a command that was measured, not held, for each that was recorded: a law bends it
# between them. Sixteen move a limit by no more than a twentieth of what one did.
STEPS_A_SAMPLE = 8


@dataclass(frozen=True)
class Moved:
    """What a force does under the commands of all pieces."""

    whole: Whole
    ways: Ways

    def of(self, model: ForceModel, x: Float, moving: Sequence[int] = ()) -> list[list[Samples]]:
        """Of each piece the change of its input r (history + n,) and of its sensors z (n, q), then
        the slopes of both by the entries `moving` of x."""
        p, seeds = model.numbers(x), model.seeds(x, moving)
        wired = self.whole.wired
        metered = self.whole.metered(model)
        if model.force.law.of_command is not None:
            pieces = self.whole.records.pieces
            name = model.force.place.command(model.built)
            on = wired.column(name)
            every = self.whole.every * (STEPS_A_SAMPLE if model.metered(name) else 1)
            return [
                _lines_of_command(piece, as_driven(piece, metered), model, p, seeds, every, on)
                for piece in pieces
            ]
        way = self.ways.at(model, x)
        contour = self.whole.records.exact()
        channels = model.channels(x, contour.s)
        every = self.whole.every
        out = []
        for piece in self.whole.records.pieces:
            v, times = mean_command(as_driven(piece, metered))
            for name, F in channels[0].items() if channels is not None else ():
                each, j = v.reshape(len(v), -1), wired.column(name)
                each[:, j] = contour.record(contour.damped(each[:, j]) * F, len(v))
            own = []
            self.ways.marched += (1 + len(seeds)) * len(v) * every
            for e in way.force(model, between(v, every), p, seeds):
                y = times * way.sensed.of(e)[::every, self.whole.sensor]
                for name, F in channels[1].items() if channels is not None else ():
                    j = wired.sensors.index(name)
                    y[:, j] = contour.record(contour.damped(y[:, j]) * F, len(y))
                r = np.zeros_like(piece.r)
                for kp, sensor, of in wired.loops:
                    r.reshape(len(r), -1)[:, of] -= kp * y[:, sensor]
                own.append(Samples(r, y[piece.history :]))
            out.append(own)
        return out

    def without(self, fitted: Fitted) -> Whole:
        """The records as those of the linear part of a fit."""
        assert isinstance(fitted.model, ForceModel)
        moved = self.of(fitted.model, fitted.x)
        records = self.whole.records
        pieces = tuple(
            replace(piece, r=piece.r + m.r, z=piece.z - m.z)
            for piece, (m,) in zip(records.pieces, moved, strict=True)
        )
        return replace(self.whole, records=replace(records, pieces=pieces))


def _lines_of_command(
    piece: Piece,
    commands: Sequence[Command],
    model: ForceModel,
    p: Float,
    seeds: Float,
    every: int,
    on: int,
) -> list[Samples]:
    """A force on the command of input `on` alone, of every record by itself: a converter's steps
    fall differently each time."""
    of_command = model.force.law.of_command
    assert of_command is not None
    r = np.zeros((1 + len(seeds), *piece.r.shape))
    for command in commands:
        e, slopes = of_command(between(by_input(command.v)[on], every), p)
        all_ = np.concatenate([e[None], (slopes @ seeds[:, : slopes.shape[1]].T).T])
        r.reshape(*r.shape[:2], -1)[:, :, on] += command.part * _recorded(all_, every)
    still = np.zeros_like(piece.z)
    return [Samples(own, still) for own in r]


def between(v: Float, every: int) -> Float:
    """(n every, ...) commands of which every so-manieth sample was recorded: what the band up to
    half the record's rate makes of it."""
    if every == 1:
        return v
    late = REACH * every
    passed = signal.upfirdn(every * _passing(every), v, every, axis=0)
    return np.asarray(passed[late : late + every * len(v)])


def _recorded(v: Float, every: int) -> Float:
    """(k, n, ...) what of commands (k, n every, ...) a record of every so-manieth sample has."""
    if every == 1:
        return v
    passed = signal.upfirdn(_passing(every), v, 1, every, axis=1)
    return np.asarray(passed[:, REACH : REACH + v.shape[1] // every])


@lru_cache(maxsize=8)
def _passing(every: int) -> Float:
    """Taps of a low-pass up to half a rate, at `every` times that rate: flat to `STRAY` up to 0.45
    of it, from 0.55 on the same is left."""
    beta = signal.kaiser_beta(-20 * np.log10(STRAY))
    return np.asarray(signal.firwin(2 * REACH * every + 1, 1 / every, window=("kaiser", beta)))


def mean_command(commands: Sequence[Command]) -> tuple[Float, float]:
    """The command of a piece's records, which repeat each other, and how many times the piece has
    what one of them does."""
    times = sum(c.part for c in commands)
    return np.asarray(sum(c.part * c.v for c in commands) / times), times


def as_driven(piece: Piece, metered: Sequence[bool]) -> list[Command]:
    """The commands of a piece's records without what a meter shows of each input that rests: that
    is the meter's own, no line that is fitted has it, and a force would. metered : of each input,
    whether the model has it as recorded by a meter, beside those that show a meter's noise."""
    return [_at_rest(c, metered, moving=piece.moving) for c in piece.commands]


def _at_rest(c: Command, metered: Sequence[bool], *, moving: bool) -> Command:
    shown = [on or meter.shown > 0 for on, meter in zip(metered, c.meter, strict=True)]
    if not any(shown):
        return c
    v = np.array(c.v, np.float64)
    for column, meter, on in zip(by_input(v), c.meter, shown, strict=True):
        if on:
            column -= rest_of(column, meter.shown, moving=moving)
    return replace(c, v=v)


@dataclass(frozen=True)
class ForceProblem(RecordProblem):
    """The likelihood of whole records for models with and without a force, near a reference.

    complete : all lines. goal : of them, both parts.
    """

    complete: Complete = field(kw_only=True)
    goal: Float = field(kw_only=True)

    @classmethod
    def near(
        cls,
        whole: Whole,
        fitted: Fitted,
        by_line: Problem,
        ways: Ways,
        own_power: Float | None = None,
    ) -> ForceProblem:
        """About a fit, with a force or without. own_power : as of `Complete.about`."""
        moved = Moved(whole, ways)
        about = moved.without(fitted) if isinstance(fitted.model, ForceModel) else whole
        complete = about.complete(fitted, own_power)
        records, exact = whole.records, whole.records.exact()
        S = whole.response(fitted)(exact.s)
        order, k = complete.rows.order, [records.lines(p).k for p in records.pieces]

        def added(model: ForceModel, x: Float, moving: Sequence[int]) -> Complex:
            each = [
                np.stack([-records.residual(Samples(m.r, -m.z), k_, S, exact) for m in own], axis=2)
                for own, k_ in zip(moved.of(model, x, moving), k, strict=True)
            ]
            return np.asarray(np.concatenate(each)[order])

        nodes = whole.grid(complete.reduced.frequency, complete.reduced.sigma, fitted)
        same: dict[str, Any] = {f.name: getattr(nodes, f.name) for f in fields(nodes)}
        at = RecordGrid(**same, added=added)
        e = complete.rows.e
        if isinstance(fitted.model, ForceModel):
            e = np.asarray(e + added(fitted.model, fitted.x, ())[:, :, 0])
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

    def added(self, model: ForceModel, x: Float) -> Complex:
        """(n, q) what the force of a model adds to the lines.

        Raises SamiiRigError where the rig has no partial fractions at x.
        """
        assert isinstance(self.at, RecordGrid)
        return np.asarray(self.at.added(model, x, ())[:, :, 0])

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
            lines = lines[:, : self.complete.rows.e.shape[1]]  # one row for all inputs
            moving = np.flatnonzero(np.any(lines != 0, axis=(0, 1)))
            if moving.size:
                out[:, moving] += self.complete.split(lines[:, :, moving])
        return out
