"""One step of each force law, found together with the motion that the force itself makes.

What drives a force is `free` at the end of a step without the force over it, and free + g f with
it. A step fills `out` with

    0: f   1: df/dbefore   2: df/dfree   3: memory after it   4: df/dmemory
    5: dm/dbefore   6: dm/dfree   7: dm/dmemory   8, 10, 12: df/dp   9, 11, 13: dm/dp

where m is the memory after the step, and p are the law's numbers. Smooth laws act on the middle of
the step, so that errors fall with the square of its length.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit, types

from samii_rig.types import Float

OUT, LAW_NUMBERS = 14, 3  # entries of `out`, and numbers of a law at most
NEWTON = 5  # steps at most to the root of a law that is monotonous
SAFE = 40  # the same of one that bends: halving alone would bring the root to 1e-12
ROOT_FOUND = 1e-8  # of the root: Newton's next step would be of the square of it, a rounding error
_f8, _row = types.float64, types.Array(types.float64, 1, "C")
SIGNATURE = types.void(_f8, _f8, _f8, _f8, _row, _f8, _row)
LAW = types.FunctionType(SIGNATURE)

Step = Callable[[float, float, float, float, Float, float, Float], None]
"""(before, free, u, g, p, memory, out); u is the command."""
After = Callable[[float, float, float, float], tuple[float, float, float, float, float]]


@njit(SIGNATURE, cache=True)
def friction(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """Dry friction: what stops the speed, within -p0 and p1 (Karnopp 1985)."""
    stops = -free / g
    out[0] = min(max(stops, -p[0]), p[1])
    if stops < -p[0]:
        out[8] = -1.0
    elif stops > p[1]:
        out[10] = 1.0
    else:
        out[2] = -1.0 / g


@njit(SIGNATURE, cache=True)
def cubic(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """p1 p0 y^3, p1 = -1 of a spring that hardens and 1 of one that softens."""
    middle, k = 0.5 * (before + free), p[0] * p[1]
    slope = 0.5 * g * k
    x = before
    for _ in range(NEWTON):
        off = (x - middle - slope * x * x * x) / (1.0 - 3.0 * slope * x * x)
        x -= off
        if abs(off) <= ROOT_FOUND * abs(x):
            break
    out[0] = k * x * x * x
    # f = k (middle + g f/2)^3, differentiated.
    held = 1.0 - 3.0 * slope * x * x
    out[1] = out[2] = 1.5 * k * x * x / held
    out[8], out[10] = p[1] * x * x * x / held, p[0] * x * x * x / held


@njit(SIGNATURE, cache=True)
def quadratic(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """-p0 |y| y of a speed y."""
    middle, share = 0.5 * (before + free), 0.5 * g * p[0]
    # y = middle + g f/2, solved.
    y = 2.0 * middle / (1.0 + np.sqrt(1.0 + 4.0 * share * abs(middle)))
    held = 1.0 + 2.0 * share * abs(y)
    out[0] = -p[0] * abs(y) * y
    out[1] = out[2] = -p[0] * abs(y) / held
    out[8] = -abs(y) * y / held


@njit(SIGNATURE, cache=True)
def play(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """What a gap of width p0 takes from a spring of stiffness p1."""
    held = 1.0 - 0.5 * g * p[1]
    inside = 0.5 * (before + free) / held
    x = min(max(inside, -0.5 * p[0]), 0.5 * p[0])
    out[0] = p[1] * x
    if x == inside:
        out[1] = out[2] = 0.5 * p[1] / held
        out[10] = x / held
    else:
        out[8] = 0.5 * p[1] * np.sign(x)
        out[10] = x


@njit(SIGNATURE, cache=True)
def slack(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """What a gap of width p0 takes from a spring of stiffness p1 and a damper of p2 times the way
    of the step: inside it nothing acts. At its edge the damper stops what nothing would."""
    middle, way = 0.5 * (before + free), free - before
    held = 1.0 - g * (0.5 * p[1] + p[2])
    f = (p[1] * middle + p[2] * way) / held
    x = middle + 0.5 * g * f
    if abs(x) <= 0.5 * p[0]:
        out[0] = f
        out[1], out[2] = (0.5 * p[1] - p[2]) / held, (0.5 * p[1] + p[2]) / held
        out[10], out[12] = x / held, (way + g * f) / held
        return
    sign = 1.0 if x > 0.0 else -1.0
    out[0] = 0.5 * sign * p[0] * p[1]
    out[8], out[10] = 0.5 * sign * p[1], 0.5 * sign * p[0]
    if sign * (middle + 0.5 * g * out[0]) < 0.5 * p[0]:
        out[0] = (sign * p[0] - 2.0 * middle) / g
        out[1] = out[2] = -1.0 / g
        out[8], out[10] = sign / g, 0.0


@njit(inline="always")
def _beyond(before: float, free: float, g: float, p: Float, side: float, out: Float) -> None:
    """-p1 (x - side p0) of a stop on one side, where x is beyond it."""
    over = 0.5 * (before + free) - side * p[0]
    if side * over > 0.0:
        held = 1.0 + 0.5 * g * p[1]
        out[0] = -p[1] * over / held
        out[1] = out[2] = -0.5 * p[1] / held
        out[8], out[10] = side * p[1] / held, -over / (held * held)


@njit(SIGNATURE, cache=True)
def stop_above(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """A stop of stiffness p1 at a way p0 from rest, above."""
    _beyond(before, free, g, p, 1.0, out)


@njit(SIGNATURE, cache=True)
def stop_below(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """A stop of stiffness p1 at a way p0 from rest, below."""
    _beyond(before, free, g, p, -1.0, out)


@njit(SIGNATURE, cache=True)
def stops(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """Stops of stiffness p1 at a way p0 from rest, on both sides."""
    _beyond(before, free, g, p, 1.0 if before + free > 0.0 else -1.0, out)


@njit(SIGNATURE, cache=True)
def orifice(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """What the load takes from the flow u: u (sqrt(1 + sign(u) M/p0) - 1)."""
    sign = 1.0 if u >= 0.0 else -1.0
    moment = 0.5 * (before + free)
    root = np.sqrt(max(1.0 + sign * moment / p[0], 0.0))
    out[0] = u * (root - 1.0)
    if root > 0.0:
        slope = 0.5 * u * sign / (p[0] * root)
        out[1] = out[2] = 0.5 * slope
        out[8] = -slope * moment / p[0]


@njit(cache=True)
def advanced(h: float, dx: float, top: float, k: float) -> tuple[float, float, float, float, float]:
    """The hysteretic force h after a motion dx, and its slopes by dx, h, top and k: exactly that of
    Bouc-Wen with n = 1 and beta = gamma, dh = k dx (1 - |h|/top) growing and k dx falling."""
    sign = 1.0 if dx >= 0.0 else -1.0
    way, held = abs(dx), h * sign
    if held < 0.0 and k * way <= -held:
        return h + k * dx, k, 1.0, 0.0, dx
    if held < 0.0:  # back to zero first
        E = np.exp(-(k * way + held) / top)
        by_top = 1.0 - E - E * (k * way + held) / top
        return sign * top * (1.0 - E), k * E, E, sign * by_top, sign * E * way
    E = np.exp(-k * way / top)
    rest = (top - held) * E
    by_top = 1.0 - E - rest * k * way / top**2
    return sign * (top - rest), k * rest / top, E, sign * by_top, sign * rest * way / top


@njit(inline="always")
def _sticking(after: After, way: float, g: float, p: Float, memory: float, out: Float) -> None:
    """Fill `out` for a force between -p0 and p0 that is its memory. after : (memory, motion, p0,
    p1) -> memory after it, and its slopes by motion, memory, p0 and p1. way : motion of the step
    without the force over it."""
    # The motion lies between these, as the force does between -top and top.
    top = max(p[0], abs(memory))
    low, high = way - 0.5 * g * (memory + top), way - 0.5 * g * (memory - top)
    dx = min(max(way - g * memory, low), high)
    off = high - low
    for _ in range(SAFE):
        h, slope, _, _, _ = after(memory, dx, p[0], p[1])
        over = dx - way + 0.5 * g * (memory + h)
        low, high = (low, dx) if over > 0.0 else (dx, high)
        new = dx - over / (1.0 + 0.5 * g * slope)
        # Halved where Newton leads out, or to and fro across the bend.
        newton = low <= new <= high and 2.0 * abs(new - dx) <= abs(off)
        off = (new if newton else 0.5 * (low + high)) - dx
        dx += off
        if abs(off) <= ROOT_FOUND * abs(dx):
            break
    h, slope, by_h, by_top, by_k = after(memory, dx, p[0], p[1])
    held = 1.0 + 0.5 * g * slope
    out[0], out[3] = -0.5 * (memory + h), h
    out[5], out[6] = -slope / held, slope / held
    out[7] = (by_h - 0.5 * g * slope) / held
    out[9], out[11] = by_top / held, by_k / held
    out[1], out[2], out[8], out[10] = -0.5 * out[5], -0.5 * out[6], -0.5 * out[9], -0.5 * out[11]
    out[4] = -0.5 * (1.0 + out[7])


@njit(SIGNATURE, cache=True)
def hysteresis(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """Bouc-Wen of height p0 and of stiffness p1 before it slips; the mean force of the step."""
    _sticking(advanced, free - before, g, p, memory, out)


@njit(cache=True)
def slid(h: float, dx: float, top: float, k: float) -> tuple[float, float, float, float, float]:
    """As `advanced`, of Dahl's friction: dh = k dx (1 - h/top) one way, k dx (1 + h/top) the other
    (Dahl 1968, Aerospace Corporation TOR-0158(3107-18)-1)."""
    end = top if dx >= 0.0 else -top
    way = abs(dx)
    E = np.exp(-k * way / top)
    rest = (end - h) * E
    sign = end / top
    by_top = sign * (1.0 - E) - rest * k * way / top**2
    return end - rest, sign * k * rest / top, E, by_top, rest * way / top


@njit(SIGNATURE, cache=True)
def presliding(
    before: float, free: float, u: float, g: float, p: Float, memory: float, out: Float
) -> None:
    """Dahl's friction of height p0 and of stiffness p1 at rest; the mean force of the step."""
    _sticking(slid, free - before, g, p, memory, out)


@njit(_row(LAW, _row, _row), cache=True)
def remembered(law: Step, x: Float, p: Float) -> Float:
    """(n,) the force of a law that has a memory under a motion x (n,) that it does not change."""
    f, out = np.zeros(x.size), np.zeros(OUT)
    before, memory = 0.0, 0.0
    for n in range(x.size):
        law(before, x[n], 0.0, 0.0, p, memory, out)
        f[n], memory, before = out[0], out[3], x[n]
    return f
