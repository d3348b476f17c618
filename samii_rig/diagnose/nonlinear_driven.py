"""What a force really does under the inputs that were recorded: no describing function.

A sweep through a lightly damped resonance is over before the motion has settled, and what rings
on is still there at the next frequency; a multisine's distortion falls on its own lines. So the
force is computed in time, from the motion that a recorded input makes, and its lines are taken:
with those of the describing functions as a start, and the harmonics' way around the loop by
successive substitution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.measured import PERIODIC, Measured
from samii_rig.diagnose.nonlinear_laws import FRICTION, GAP, Law
from samii_rig.diagnose.nonlinear_levels import LevelGrid, Loop
from samii_rig.diagnose.nonlinear_model import LevelModel
from samii_rig.model.sampled import hold_response
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, FrequencyResponse, Int, Recording

FINER = 4  # instants a sample at which a force is computed: its harmonics must not fold back
ABOVE = 1.2  # of the highest line: motion above it is left out
MOST_PERIODS = 40  # of the lines' distance in a period of the input
WHOLE = 0.02  # of a line: how near a whole number of cycles is
FAINT = 1e-4  # of the strongest line of the input: below, a ratio to it says nothing
ROUNDS, SAME = 8, 3e-3  # around the loop, at most; change of the force at which they end
SETTLED = 0.05  # the same, at most
GENTLE = 0.7  # of the loop's gain about rest

Drives = Mapping[int, Float]


def drives(
    rig: Rig, lines: Measured, responses: Sequence[FrequencyResponse], runs: Sequence[Recording]
) -> Drives:
    """(n,) one period of the command of each level whose input repeats itself, by its index in
    `lines.levels`; the mean of its periods but for the first."""
    name = rig.actuator[int(lines.actuator[0])].name
    found = periods(rig, lines, responses, runs, (name,))
    return {k: blocks[:, :, 0].mean(axis=0) for k, blocks in found.items()}


def periods(
    rig: Rig,
    lines: Measured,
    responses: Sequence[FrequencyResponse],
    runs: Sequence[Recording],
    names: Sequence[str],
) -> dict[int, Float]:
    """(n_period, n, n_channel) of each level whose input repeats itself, but for the first."""
    out = {}
    for k, (level, periodic) in enumerate(zip(lines.levels, lines.periodic, strict=True)):
        own = [
            r
            for r in responses
            if (r.level, r.level_unit) == level and (r.method.split()[0] in PERIODIC) == periodic
        ]
        n = _period(own[0].frequency, rig.rate_hz) if len(own) == 1 else 0
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


def top_of(model: LevelModel, given: Drives) -> float:
    """The largest command, for a force that it drives; else 0."""
    if model.quasi.kind != "command":
        return 0.0
    return max(float(np.max(np.abs(v))) for v in given.values())


def _period(f: Float, rate_hz: float) -> int:
    """Samples of the shortest time in which all lines are whole cycles; 0 where none is."""
    if f.size < 2:
        return 0
    step = float(np.min(np.diff(f)))
    for m in range(1, MOST_PERIODS):
        cycles = f * m / step
        if np.all(np.abs(cycles - np.round(cycles)) < WHOLE):
            n = m / step * rate_hz
            return round(n) if abs(n - round(n)) < WHOLE * n / 100 else 0
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
    model: LevelModel, x: Float, grid: LevelGrid, given: Drives, p: float
) -> list[Driven] | None:
    """The force p under each input; None where it is so strong that going around the loop does
    not settle."""
    out = []
    scale = model.strength(x)[1]
    rate = model.rig.rate_hz
    known: dict[int, tuple[Int, Loop]] = {}
    for k, v in given.items():
        f = grid.frequency[grid.driven[k] > 0]
        if not f.size:
            continue
        found = np.zeros(0)
        if model.quasi.kind not in ("command", "flow"):
            _, loop, _ = model.looped(x, grid.at(f, np.full(f.size, k)))
            _, found = loop.force(model.quasi, p, scale)
        if v.size not in known:
            top = min(v.size // 2, int(ABOVE * grid.frequency[-1] * v.size / rate))
            new = np.arange(1, top, dtype=np.int64)
            known[v.size] = new, _loop(model, x, new * rate / v.size)
        bins, wide = known[v.size]
        fb = np.asarray(bins * rate / v.size)
        start = np.interp(fb, f, found) if found.size else np.zeros(fb.size)
        V = np.fft.rfft(v)[bins]
        E = _around(model, wide, v, V, bins, p, scale, start)
        if E is None:
            return None
        out.append(Driven(k, bins, fb, V, E))
    return out


def driven(model: LevelModel, x: Float, grid: LevelGrid, given: Drives, p: float) -> Complex | None:
    """(n_level, n, q) what the force p adds to the response over its describing function, at
    all lines of the grid; 0 at levels without a drive. None as `forced`."""
    found = forced(model, x, grid, given, p)
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


def _loop(model: LevelModel, x: Float, f: Float) -> Loop:
    """The loop at any frequencies."""
    spec = model.rig.actuator[0]
    hold = hold_response(f, model.rig.rate_hz, spec.delay)
    none = np.zeros((f.size, 0), complex)
    at = LevelGrid(
        f, none, none, none[None], model.rig.rate_hz, np.zeros(0, np.int64),
        np.zeros(1, np.int64), hold, none,
        np.zeros((0, f.size)), np.zeros(0, bool),
    )  # fmt: skip
    return model.looped(x, at)[1]


def _around(
    model: LevelModel,
    loop: Loop,
    v: Float,
    V: Complex,
    bins: Int,
    p: float,
    scale: float,
    start: Float,
) -> Complex | None:
    """E at the bins."""
    quasi = model.quasi
    n = v.size
    if quasi.kind == "command":
        assert quasi.law is not None
        e = quasi.sign * scale * quasi.law.force(v, p)
        return np.asarray(np.fft.rfft(e)[bins] * loop.l0[:, 0])

    def moving(Y: Complex) -> Float:
        whole = np.zeros(FINER * n // 2 + 1, complex)
        whole[bins] = FINER * Y
        return np.fft.irfft(whole, FINER * n)

    def lines(e: Float) -> Complex:
        return np.asarray(np.fft.rfft(e)[bins] / FINER)

    if quasi.law is None:
        q, E = moving(loop.s * loop.l0[:, 0] * V), np.zeros(V.size, complex)
    else:
        l0, l1 = loop.parts(quasi.law)
        stiff = float(np.max(np.abs(l1)))
        E, rest = np.zeros(V.size, complex), np.zeros(V.size, complex)
    for _ in range(ROUNDS):
        if quasi.law is None:
            M = moving(loop.l0[:, 1] * V + loop.l1[:, 1] * E)
            new = lines(q * (np.sqrt(np.maximum(1 + np.sign(q) * M / p, 0.0)) - 1))
        else:
            # What the describing function says is solved for, only the rest goes around.
            Y = (l0 * V + l1 * rest) / (1 - start * l1)
            new = lines(quasi.sign * scale * _softly(quasi.law, moving(Y), p, scale * stiff))
            rest = new - start * Y
        moved = float(np.linalg.norm(new - E))
        E = new
        if moved < SAME * float(np.linalg.norm(E)):
            break
    return E if moved < SETTLED * float(np.linalg.norm(E)) else None


def _softly(law: Law, y: Float, p: float, loop: float) -> Float:
    """The force, its slope about rest so small that it settles in a loop of that gain: there a
    part holds still, and pushes hardly."""
    if law is FRICTION:
        return np.asarray(p * np.clip(GENTLE * y / (p * loop), -1.0, 1.0))
    if law is GAP:
        return law.force(y * min(1.0, GENTLE / loop), p)
    return law.force(y, p)
