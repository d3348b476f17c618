"""What each force may explain, to first order: the force of the motion that it does not change.

A weak force acts on the linear rig's own motion, and what it adds to the lines follows by one
product (Born's approximation). How far it lies along what a fit leaves, over its length, bounds
what it explains: no multiple of it explains more. Only forces whose bound may matter are computed
in time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.screen import Screen
from samii_rig.diagnose.forces.laws import (
    CLIPPED,
    HYSTERESIS,
    ORIFICE,
    OVERLAP,
    PLAY,
    SLACK,
    STOPS,
    Force,
    Law,
)
from samii_rig.diagnose.forces.paths import Ports, TransferPaths
from samii_rig.diagnose.forces.problem import ForceProblem
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.likelihood.algebra import by_input
from samii_rig.types import Complex, Float

# Widths of a gap over the largest motion at which it is tried: what it does to the rest has its
# largest part where both are alike, and falls slowly.
GAPS = (3e-4, 2e-3, 1e-2, 4e-2, 0.15, 0.5)
# Limits over the largest amplitude: one just below it cuts only a little.
LIMITS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)
SLIPS = (0.03, 0.15, 0.6)  # motion at which a part slips over the largest motion
REACHED = (0.02, 0.15, 0.4, 0.6, 0.75, 0.87, 0.95)  # ways to a stop over the largest motion
WEAK_START = 1e-3  # of the upper end of a supply's range
CAP = 1.5  # power of its height, that what a limit cuts off a sine grows with
AT_ONCE = 8  # changes of all lines that are whitened together
WEAK_BELOW = 0.03  # of the motion that drives it, that a force may change to count as weak


@dataclass(frozen=True, slots=True)
class Score:
    """What a force should gain of chi-square beside each base, and at which strengths.

    own : (n_look,) gain at `strengths`. may : (n_look,) the gain of its best multiple, `times` as
    strong. weak : whether the first order is enough.
    """

    effect: Effect
    strengths: Float
    own: Float
    may: Float
    times: float
    weak: bool = True


@dataclass(frozen=True)
class ForceScreen:
    """Fits, and what they leave, against which changes of the lines are held.

    sides : of each fit (2 n q, 1 + m) what it leaves of the whitened lines, and the directions that
    it may still move in for nothing.
    """

    problem: ForceProblem
    sides: tuple[Float, ...]

    @classmethod
    def of(cls, problem: ForceProblem, fits: Sequence[Fitted]) -> ForceScreen:
        """About some fits."""
        complete, sides = problem.complete, []
        rows = complete.rows.e.size * 2 + len(complete.factor)
        for fitted in fits:
            base = Screen.of(problem, fitted)
            parts = base.residual()[:rows, None], base.directions[:rows]
            sides.append(np.concatenate([_real(complete.joined(x)) for x in parts], axis=1))
        return cls(problem, tuple(sides))

    def gains(self, changes: Sequence[Complex]) -> list[tuple[Float, Float, Float]]:
        """Of each of some changes of the lines (n, q), each (n_look,): the fall of chi-square with
        it, with its best multiple, and how many times it is that."""
        G = _real(self.problem.complete.white(np.stack(changes, axis=2)))
        power = np.sum(G**2, axis=0)
        along, free = [], []
        for side in self.sides:
            own = side.T @ G
            along.append(-own[0])
            free.append(power - np.sum(own[1:] ** 2, axis=0))
        return [_gains(*both) for both in zip(np.transpose(along), np.transpose(free), strict=True)]


def _real(x: Complex) -> Float:
    """(2 n q, k) of x (n, q, k)."""
    flat = x.reshape(-1, x.shape[2])
    return np.concatenate([flat.real, flat.imag])


def _gains(along: Float, power: Float) -> tuple[Float, Float, Float]:
    known = (power > 0) & np.isfinite(power)
    power = np.where(known, power, 1.0)
    times = np.where(known, along / power, 0.0)
    own = np.where(known, 2 * along - power, -np.inf)
    return own, np.maximum(along, 0.0) * np.maximum(times, 0.0) * known, times


def trial_strengths(effect: Effect, paths: TransferPaths) -> list[Float]:
    """Strengths at which the shape of a force differs."""
    assert effect.force is not None
    law, high = effect.force.law, effect.unknowns[0].high
    if law is CLIPPED:
        return [np.array([high * x]) for x in LIMITS]
    if law in (OVERLAP, PLAY, SLACK):
        return [np.array([high / 2 * x]) for x in GAPS]
    if law.physics == STOPS.physics:
        k = effect.unknowns[1].high * WEAK_START**2  # a thousandth of what halves the motion
        return [np.array([high / 2 * x, k]) for x in REACHED]
    if law is ORIFICE:
        return [np.array([high * WEAK_START])]
    if law is HYSTERESIS:
        motion = paths.motion(effect.force.place, of_speed=False)
        top = max(float(np.max(np.abs(y))) for y in motion)
        k = effect.unknowns[1].high * WEAK_START
        return [np.array([k * top * x, k]) for x in SLIPS]
    return [np.array([high * WEAK_START])]


def scaled(law: Law, strengths: Float, times: float, largest: float) -> Float:
    """The strengths at which a weak force is about so many times as strong. largest : command."""
    if law is CLIPPED:
        cut = np.maximum(largest - strengths, 0.0)
        return np.asarray(largest - cut * times ** (1 / CAP))
    if law.physics == STOPS.physics:
        return np.asarray(strengths * np.array([1.0, times]))
    return np.asarray(strengths / times if law is ORIFICE else strengths * times)


def first_order(
    effects: Sequence[Effect], paths: TransferPaths, screen: ForceScreen
) -> list[Score]:
    """Of each force its best try, to first order."""
    tried = [
        (effect, strengths)
        for effect in effects
        if _ports(effect, paths) is not None
        for strengths in trial_strengths(effect, paths)
    ]
    best: dict[str, Score] = {}
    # Of some at once: the lines of all forces are many times the records.
    for first in range(0, len(tried), AT_ONCE):
        some = tried[first : first + AT_ONCE]
        changes, shares = zip(*(_lines(*one, paths, screen) for one in some), strict=True)
        gains = screen.gains(changes)
        for (effect, strengths), share, (own, may, times) in zip(some, shares, gains, strict=True):
            at = int(np.argmax(may))
            weak = share * max(float(times[at]), 0.0) < WEAK_BELOW
            score = Score(effect, strengths, own, may, float(times[at]), weak)
            old = best.get(effect.key)
            if old is None or may[at] > np.max(old.may):
                best[effect.key] = score
    return sorted(best.values(), key=lambda h: -float(np.max(h.may)))


def _ports(effect: Effect, paths: TransferPaths) -> Ports | None:
    force = effect.force
    assert force is not None
    return paths.ports(force.place, of_speed=force.law.of_speed)


def _lines(
    effect: Effect, strengths: Float, paths: TransferPaths, screen: ForceScreen
) -> tuple[Complex, float]:
    """(n, q) what a force of such strengths adds to the lines, to first order; its share, as of
    `_forces`."""
    force, ports, records = effect.force, _ports(effect, paths), paths.whole.records
    assert force is not None
    assert ports is not None
    p = force.law.numbers(strengths, [paths.scale(key) for key in force.keys])
    spectra, share = _forces(force, p, paths)
    each = [
        span.lines(E, sensors, records.lines(piece).k)
        for span, E, sensors, piece in zip(
            paths.spans, spectra, ports.sensors, records.pieces, strict=True
        )
    ]
    return np.concatenate(each)[screen.problem.complete.rows.order], share


def _summed(each: Sequence[Float]) -> Float:
    return np.asarray(np.sum(each, axis=0))


def _forces(force: Force, p: Float, paths: TransferPaths) -> tuple[list[Complex], float]:
    """Of each piece the damped spectrum of a force under the motion that it does not change, and
    the share by which it would change that, at the worst lines."""
    if force.law.of_command is not None:
        of_command, on = force.law.of_command, paths.column(force.place)
        each = [
            s.spectrum(_summed([c.part * of_command(by_input(c.v)[on], p)[0] for c in commands]))
            / s.times
            for s, commands in zip(paths.spans, paths.driven, strict=True)
        ]
        return each, 0.0
    assert force.law.weak is not None
    motion = paths.motion(force.place, of_speed=force.law.of_speed)
    commands = paths.commands(force.place)
    e = [force.law.weak(y, v, p) for y, v in zip(motion, commands, strict=True)]
    ports = paths.ports(force.place, of_speed=force.law.of_speed)
    assert ports is not None
    moved = max(float(np.sqrt(np.mean(x**2))) for x in e) * math.sqrt(np.mean(ports.y1**2))
    moves = max(float(np.sqrt(np.mean(y**2))) for y in motion)
    return [s.damped(x) for s, x in zip(paths.spans, e, strict=True)], float(moved / moves)
