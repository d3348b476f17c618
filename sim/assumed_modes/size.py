"""Sizes: the strength of an effect at which a refit leaves the sigma that was drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sim.assumed_modes.effects import Draft
from sim.assumed_modes.parts import Setup
from sim.assumed_modes.sigma import Bench, Left, Records, Refit
from sim.assumed_modes.simulate import Control, clean

LEAST, MOST = 3.0, 300.0  # sigma of an effect, drawn evenly in the logarithm between them
SIZE_CLOSE = 1.25  # ratio to the drawn sigma that is near enough; the truth says what it is
NEAR = 1.0  # tolerance; a refit that moves nothing by more has one minimum
UNLIKELY = 3.0  # tolerances; a refit that moves one by more may have been led astray
GROWN = 16  # steps in which an effect grows; with 8 a joint six tolerances stiffer is not followed
TRIES = 9  # strengths tried for one effect
RAW = 3.0  # sigma before any refit at which the derivatives foretell what is left
FIRST_JUMP = 0.01  # of RAW: what shows less than that grows by its inverse
# Of the strength, with which sigma grows: 1 for what is linear, more for a limit just touched.
POWERS = (0.3, 4.0)
JUMP = 8.0  # largest ratio of two strengths tried one after the other


def records_by_run(bench: Bench, setups: Sequence[Setup]) -> Records:
    """The same for an effect that is another one in each run: a setup a waveform, no laws."""
    each = [replace(bench, waveforms=(w,)) for w in bench.waveforms]
    units = [one.linear(setup)[0] for one, setup in zip(each, setups, strict=True)]
    return [[level * y for level in w.levels] for w, y in zip(bench.waveforms, units, strict=True)]


def records(bench: Bench, control: Control, setup: Setup) -> Records:
    """What the bench's waveforms and levels record of `setup`, without noise, laws included."""
    if not setup.forces:
        unit = bench.linear(setup)
        return [
            [level * y for level in w.levels] for w, y in zip(bench.waveforms, unit, strict=True)
        ]
    return [
        [clean(setup, control, level * w.r)[:: bench.every] for level in w.levels]
        for w in bench.waveforms
    ]


def grown(refit: Refit, of: Callable[[float], Records], strength: float) -> Left:
    """What a refit leaves of an effect that grows from nothing to `strength`, each refit from where
    the last ended."""
    at = np.zeros(refit.n)
    for k in range(1, GROWN + 1):
        left = refit.left(of(strength * k / GROWN), at * k / max(k - 1, 1))
        at = left.moved
    return left


def solve(
    refit: Refit,
    draft: Draft,
    of: Callable[[float], Records],
    target: float,
    close: float = SIZE_CLOSE,
) -> tuple[float, Left] | None:
    """The strength that leaves about `target` sigma, with what it leaves; None if none does.

    of : records with the effect at a strength. close : ratio to the target that is near enough.
    """
    if draft.fixed:
        left = refit.left(of(1.0))
        return (1.0, left) if left.sigma >= LEAST else None
    x = draft.start
    for _ in range(8):
        rows = of(x)
        raw = refit.raw(rows)
        if RAW / 10 <= raw <= RAW * 10 or (x == draft.most and raw < RAW):
            break
        # A force that nothing reaches yet shows nothing: then in steps.
        x = min(x * RAW / max(raw, FIRST_JUMP * RAW), draft.most)
    first = refit.tangent(rows)
    way, last, power = first.moved / x, (x, max(first.sigma, 1e-9)), 1.0
    x = min(target * x / last[1], draft.most)
    low, high = 0.0, np.inf
    best: tuple[float, Left] | None = None
    for _ in range(TRIES):
        left = refit.left(of(x), way * x)
        ratio = left.sigma / target
        if best is None or abs(np.log(ratio)) < abs(np.log(best[1].sigma / target)):
            best = (x, left)
        if 1 / close < ratio < close or (x == draft.most and ratio < 1):
            break
        if abs(np.log(x / last[0])) > 1e-6:
            slope = np.log(left.sigma / last[1]) / np.log(x / last[0])
            power = float(np.clip(slope, *POWERS))
        way, last = left.moved / x, (x, left.sigma)
        low, high = (max(low, x), high) if ratio < 1 else (low, min(high, x))
        x = min(x * float(np.clip(ratio ** (-1 / power), 1 / JUMP, JUMP)), draft.most)
        if not low < x < high:
            x = float(np.sqrt(low * high)) if low > 0 and np.isfinite(high) else draft.most
    if best is None or not LEAST * 0.8 <= best[1].sigma <= MOST * SIZE_CLOSE:
        return None
    strength, left = best
    if _farthest(left) < NEAR:
        return best
    # From the nominal parameters themselves there may be a lower minimum.
    rows = of(strength)
    left = min(left, refit.left(rows), key=lambda x: x.sigma)
    if _farthest(left) > UNLIKELY:
        left = min(left, refit.cooled(rows), key=lambda x: x.sigma)
    if _farthest(left) > UNLIKELY:
        left = min(left, grown(refit, of, strength), key=lambda x: x.sigma)
    return (strength, left) if left.sigma >= LEAST * 0.8 else None


def _farthest(left: Left) -> float:
    """Tolerances by which a refit moved an unknown at most."""
    return float(np.abs(left.moved).max(initial=0.0))
