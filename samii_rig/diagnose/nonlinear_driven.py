"""What a force really does under the inputs that were recorded: no describing function.

A sweep through a lightly damped resonance is over before the motion has settled, and what rings
on is still there at the next frequency; a multisine's distortion falls on its own lines. So the
force is computed in time under each recorded input, and its lines are taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.measured import WHOLE, Measured, of_level
from samii_rig.diagnose.nonlinear_inner import Inner
from samii_rig.diagnose.nonlinear_levels import LevelGrid
from samii_rig.diagnose.nonlinear_model import LevelModel
from samii_rig.errors import SamiiRigError
from samii_rig.model.sampled import hold_response
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, FrequencyResponse, Int, Recording

MOST_PERIODS = 40  # of the lines' distance in a period of the input
NEAR = 0.02  # of a line: how near a whole number of cycles is
FAINT = 1e-4  # of the strongest line of the input: below, a ratio to it says nothing

Drives = Mapping[int, Float]


@dataclass
class Known:
    """The chain where a force was computed last, from which the next one is found sooner."""

    last: tuple[LevelModel, Float, Inner] | None = None

    def inner(self, model: LevelModel, x: Float) -> Inner:
        """Its partial fractions, which are its own whatever the force.

        Raises SamiiRigError where it has none.
        """
        own = np.delete(x, model.unknown)
        last = self.last
        if last is None or last[0] is not model or not np.array_equal(last[1], own):
            made = Inner.of(model, x, last[2].structure if last is not None else None)
            last = self.last = (model, own, made)
        return last[2]


def drives(
    rig: Rig, lines: Measured, responses: Sequence[FrequencyResponse], runs: Sequence[Recording]
) -> Drives:
    """(n_period, n) the command of each level whose input repeats itself, by its index in
    `lines.levels`; its periods but for the first."""
    name = rig.actuator[int(lines.actuator[0])].name
    found = periods(rig, lines, responses, runs, (name,))
    return {k: blocks[:, :, 0] for k, blocks in found.items()}


def timed(lines: Measured, given: Drives) -> Measured:
    """The levels whose input repeats itself, if two do: of others it cannot be known what a force
    does in time. All of them where no two do."""
    known = np.isin(lines.level, list(given))
    return lines.take(known) if np.unique(lines.level[known]).size > 1 else lines


def periods(
    rig: Rig,
    lines: Measured,
    responses: Sequence[FrequencyResponse],
    runs: Sequence[Recording],
    names: Sequence[str],
) -> dict[int, Float]:
    """(n_period, n, n_channel) of each level whose input repeats itself, but for the first. What
    local models made of bursts that still ring is no whole period of one motion."""
    out = {}
    for k, (level, periodic) in enumerate(zip(lines.levels, lines.periodic, strict=True)):
        own = of_level(responses, level, periodic)
        whole = len(own) == 1 and own[0].estimator in WHOLE
        n = _period(own[0].frequency, rig.rate_hz) if whole else 0
        blocks: list[Float] = []
        for run in runs if n else ():
            values = [
                piece.values[:, [piece.column(name) for name in names]]
                for s in run.segments
                if (s.level, s.unit) == level and (s.kind == "periodic") == periodic
                for piece in (run.cut(s),)
            ]
            parts = [v[i : i + n] for v in values for i in range(0, len(v) - n + 1, n)]
            blocks += parts[1:] or parts
        if blocks and np.all(np.isfinite(blocks)):
            out[k] = np.array(blocks)
    return out


def top_of(model: LevelModel, given: Drives, lines: Measured) -> float:
    """The largest command at the levels of these lines, for a force that it drives; else 0."""
    if model.quasi.kind != "command":
        return 0.0
    levels = set(np.unique(lines.level).tolist())
    return max((float(np.max(np.abs(v))) for k, v in given.items() if k in levels), default=0.0)


def _period(f: Float, rate_hz: float) -> int:
    """Samples of the shortest time in which all lines are whole cycles; 0 where none is."""
    if f.size < 2:
        return 0
    step = float(np.min(np.diff(f)))
    for m in range(1, MOST_PERIODS):
        cycles = f * m / step
        if np.all(np.abs(cycles - np.round(cycles)) < NEAR):
            n = m / step * rate_hz
            return round(n) if abs(n - round(n)) < NEAR * n / 100 else 0
    return 0


@dataclass(frozen=True, slots=True)
class Driven:
    """A force under one level's input: its lines and the input's, at all bins of the period.

    level : index. bins : (m,) cycles a period, of frequency Hz. V, E : (m,) sums over samples.
    """

    level: int
    bins: Int
    frequency: Float
    V: Complex
    E: Complex


def forced(
    model: LevelModel, x: Float, given: Drives, p: float, known: Known | None = None
) -> list[Driven] | None:
    """The force p under each input; None where the rig has no partial fractions."""
    rate, quasi = model.rig.rate_hz, model.quasi
    inner: Inner | None = None
    if quasi.kind != "command":
        try:
            inner = (known or Known()).inner(model, x)
        except SamiiRigError:
            return None
    out = []
    for k, blocks in given.items():
        v = blocks.mean(axis=0)
        bins = np.arange(1, v.size // 2, dtype=np.int64)
        f = np.asarray(bins * rate / v.size)
        if inner is not None:
            E = inner.lines(v, bins, p)
        else:
            assert quasi.law is not None
            # A converter's steps differ from period to period, and so does what a gap of a few
            # of them takes away.
            e = quasi.sign * model.strength(x)[1] * quasi.law.force(blocks, p).mean(axis=0)
            E = np.fft.rfft(e)[bins] * hold_response(f, rate, model.rig.actuator[0].delay)
        out.append(Driven(k, bins, f, np.fft.rfft(v)[bins], E))
    return out


def driven(
    model: LevelModel,
    x: Float,
    grid: LevelGrid,
    given: Drives,
    p: float,
    known: Known | None = None,
) -> Complex | None:
    """(n_level, n, q) what the force p adds to the response over its describing function, at
    all lines of the grid; 0 at levels without a drive. None as `forced`."""
    found = forced(model, x, given, p, known)
    if found is None:
        return None
    out = np.zeros((*grid.driven.shape, grid.sensor.size), complex)
    scale = model.strength(x)[1]
    for one in found:
        on = grid.driven[one.level] > 0
        f = grid.frequency[on]
        there = grid.at(f, np.full(f.size, one.level))
        _, loop, r = model.looped(x, there)
        t, _ = loop.force(model.quasi, p, scale)
        loud = np.abs(one.V) > FAINT * np.max(np.abs(one.V))
        ratio = np.interp(f, one.frequency[loud], one.E[loud] / one.V[loud])
        out[one.level, on] = (ratio - t)[:, None] * r * there.filter * model.factors(x, there)
    return out
