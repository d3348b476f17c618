"""Forces that are not linear, each a function of two probes of the plant.

Every law gives the mean force over one inner step from the probes' values: it is found together
with the motion it causes (`solve`), so that stiff laws and dry friction need no small steps.

| kind | acts | probes | values |
|---|---|---|---|
| coulomb | on a joint, beside its spring, or on a body | motion, rate | T_c |
| drive_friction | on the source, in command units | rate, rate | F_c |
| cubic | on a joint | angle, rate | k3 |
| backlash | on a joint, in series with its spring; its damper stays | angle, rate | width, k |
| drift | on a joint: stiffness k (1 + share (1 - exp(-t/tau))) | angle, rate | k, share, tau |
| slip | on a joint: elements (k, T) that stick and slide | angle, rate | k1, T1, ... |
| drag | on a joint: c2 abs(rate) rate | angle, rate | c2 |
| one_sided | on a joint, stiffer where its angle is positive | angle, rate | k |
| stop | on a joint or a body; its sides are 1 or 0 | motion, rate | k, gap, above, below |
| flow_saturation | on the source: v sqrt(1 + sign(v) M/T_s) | M, v | T_s |
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from samii_rig.types import Float

KINDS = (
    "coulomb", "drive_friction", "cubic", "backlash", "drift", "slip", "flow_saturation", "drag",
    "one_sided", "stop",
)  # fmt: skip
COULOMB, DRIVE_FRICTION, CUBIC, BACKLASH, DRIFT, SLIP, FLOW, DRAG, ONE_SIDED, STOP = range(
    len(KINDS)
)
NEWTON_STEPS = 30  # Newton steps; three are usual
WHOLE = 1e-10  # relative change of the force at which the solution stands
VALUES = 16  # numbers a law may have


@njit(cache=True)
def dead_zone(x: float, width: float) -> float:
    """0 within +-width/2, beyond it what exceeds it."""
    half = 0.5 * width
    if x > half:
        return x - half
    if x < -half:
        return x + half
    return 0.0


@njit(cache=True)
def force(kind: int, q: Float, memory: Float, t: float, a: float, b: float) -> float:
    """The force at probe values a, b; what `slip` remembers stays as it is."""
    if kind == CUBIC:
        return float(-q[0] * a * a * a)
    if kind == BACKLASH:
        return float(q[1] * (a - dead_zone(a, q[0])))
    if kind == DRIFT:
        return float(-q[0] * q[1] * (1.0 - math.exp(-t / q[2])) * a)
    if kind == SLIP:
        total = 0.0
        for i in range(memory.size // 2):
            limit = q[2 * i + 1]
            if limit > 0.0:
                stretch = memory[2 * i] + q[2 * i] * (a - memory[2 * i + 1])
                total -= min(max(stretch, -limit), limit)
        return total
    if kind == DRAG:
        return float(-q[0] * abs(b) * b)
    if kind == ONE_SIDED:
        return float(-q[0] * max(a, 0.0))
    if kind == STOP:
        beyond = max(a - q[1], 0.0) * q[2] - max(-q[1] - a, 0.0) * q[3]
        return float(-q[0] * beyond)
    if kind == FLOW:
        side = 1.0 if b > 0.0 else -1.0
        return b * (math.sqrt(max(1.0 + side * a / q[0], 0.0)) - 1.0)
    return 0.0


@njit(cache=True)
def keep(kind: int, q: Float, memory: Float, a: float) -> None:
    """Let `slip` remember its elements' forces and the angle at which they had them."""
    if kind == SLIP:
        for i in range(memory.size // 2):
            limit = q[2 * i + 1]
            stretch = memory[2 * i] + q[2 * i] * (a - memory[2 * i + 1])
            memory[2 * i] = min(max(stretch, -limit), limit)
            memory[2 * i + 1] = a


@njit(cache=True)
def solve(
    kind: int,
    q: Float,
    memory: Float,
    t: float,
    before: Float,
    free: Float,
    gain: Float,
    guess: float,
) -> float:
    """The mean force f over a step with the probes at its end free + gain f.

    Dry friction: what stops the motion within the step, if that is less than it can hold.
    Slip: with the angle at the end. All others: from the probes' means over the step.
    """
    if kind in (COULOMB, DRIVE_FRICTION):
        if gain[1] <= 0.0:
            return 0.0
        return float(min(max(-free[1] / gain[1], -q[0]), q[0]))
    share = 1.0 if kind == SLIP else 0.5
    a0 = share * free[0] + (1.0 - share) * before[0]
    b0 = share * free[1] + (1.0 - share) * before[1]
    f = guess
    for _ in range(NEWTON_STEPS):
        a, b = a0 + share * gain[0] * f, b0 + share * gain[1] * f
        here = force(kind, q, memory, t, a, b)
        wrong = f - here
        small = 1e-6 * (abs(f) + abs(here)) + 1e-12
        there = force(kind, q, memory, t, a + share * gain[0] * small, b + share * gain[1] * small)
        slope = 1.0 - (there - here) / small
        step = wrong / (slope if slope > 0.1 else 1.0)
        f -= step
        if abs(step) <= WHOLE * abs(f) + 1e-15:
            break
    return f


def packed(values: tuple[float, ...]) -> Float:
    """A law's values, filled up."""
    out = np.zeros(VALUES)
    out[: len(values)] = values
    return out
