"""The loop in time: converters, controller and plant, sample by sample, compiled.

The linear part moves by the exact pieces of a `Timeline`. A law that is not linear is a force held
over a piece: a smooth law the mean of its values at both ends, found by iteration, so that the
error falls with the square of the piece; a stop likewise, without iteration; dry friction the value
at the end, solved for exactly (stick is an equation there, not a tolerance).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from samii_rig.types import Float, Int

# Laws by number, as the compiled loop knows them, with their numbers in order.
CUBIC, BACKLASH, FRICTION, BOUC_WEN, PARAMETRIC, FLOW, DRAG, ONE_SIDED, STOP = range(9)
ITERATIONS = 6  # of a smooth law; each gains a factor k h^2/2m, about 1 %
N_VALUES = 5


class Pieces(NamedTuple):
    """The arrays of a `Timeline` and of the plant, see there. g (p, n_law): how far a unit force
    of each law moves its own place in a piece; gv the same for its velocity."""

    Phi: Float
    Gamma: Float
    new: Int
    read: Int
    late: Int
    wait: Int
    h: Float
    C: Float
    D: Float
    Z: Float
    g: Float
    gv: Float


class Laws(NamedTuple):
    """law (n_law,) of the numbers above; value (n_law, N_VALUES). drive (n_law,) : the drive on
    whose command a law of the flow acts."""

    law: Int
    value: Float
    drive: Int


class Controller(NamedTuple):
    """The loops: v = r - feedback y, rounded to `step` and clipped to low, high. dead, clip :
    width of a dead zone, and a limit, between converter and source; 0 for none. feedback
    (n_in, n_y), the others (n_in,)."""

    feedback: Float
    step: Float
    low: Float
    high: Float
    dead: Float
    clip: Float


class Converters(NamedTuple):
    """(n_y,) each: what the converters do, in the sensors' units."""

    step: Float
    low: Float
    high: Float
    offset: Float


@njit(cache=True)
def smooth(law: int, p: Float, z: float, dz: float, t: float, memory: float, h: float) -> float:
    """The force of a smooth law at displacement z, velocity dz and time t."""
    if law == CUBIC:  # p = k3
        return float(-p[0] * z**3)
    if law == BACKLASH:  # p = k, width: takes the joint's spring away inside it
        half = 0.5 * p[1]
        return float(p[0] * min(max(z, -half), half))
    if law == BOUC_WEN:  # p = force at yield, displacement at yield, beta, (1 - beta), n
        return float(-p[0] * bouc_wen(p, dz, memory, h))
    if law == DRAG:  # a damper that grows with the speed, p = c2
        return float(-p[0] * abs(dz) * dz)
    if law == ONE_SIDED:  # stiffer to one side, p = dk
        return float(-p[0] * max(z, 0.0))
    # parametric, p = k, depth 1, w1, depth 2, w2
    return float(-p[0] * z * (p[1] * np.sin(p[2] * t) + p[3] * np.sin(p[4] * t)))


@njit(cache=True)
def stop(p: Float, z: float, g: float) -> float:
    """The force of a stop, p = k, gap and its sides above and below (1 or 0), at a place that is at
    z but for half of that force; g : how far a unit force moves it. Exact, however hard it is."""
    beyond = 0.0
    if p[2] > 0.0 and z > p[1]:
        beyond = z - p[1]
    elif p[3] > 0.0 and z < -p[1]:
        beyond = z + p[1]
    return float(-p[0] * beyond / (1.0 + 0.5 * p[0] * g))


@njit(cache=True)
def bouc_wen(p: Float, dz: float, x: float, h: float) -> float:
    """The hysteretic state after `h` at velocity dz, by the midpoint rule:
    x' = (dz - beta |dz| |x|^(n-1) x - (1 - beta) dz |x|^n)/z_y."""
    n = p[4]
    out = x
    mid = x
    for _ in range(3):
        a = abs(mid)
        rate = (dz - p[2] * abs(dz) * a ** (n - 1.0) * mid - p[3] * dz * a**n) / p[1]
        out = x + h * rate
        mid = 0.5 * (x + out)
    return out


@njit(cache=True)
def _converted(converters: Converters, i: int, value: float) -> float:
    """What the converter of sensor i shows of a value."""
    value += converters.offset[i]
    if converters.step[i] > 0.0:
        value = np.rint(value / converters.step[i]) * converters.step[i]
    return float(min(max(value, converters.low[i]), converters.high[i]))


@njit(cache=True)
def _at_source(control: Controller, i: int, out: float) -> float:
    """What of the command i reaches its source, through dead zone and limit."""
    if control.dead[i] > 0.0:
        half = 0.5 * control.dead[i]
        out = out - min(max(out, -half), half)
    if control.clip[i] > 0.0:
        out = min(max(out, -control.clip[i]), control.clip[i])
    return out


@njit(cache=True)
def _put(x: Float, values: Float) -> None:
    """x[:] = values, for which numba compiles the words of its error too, 5 s."""
    for i in range(x.size):
        x[i] = values[i]


@njit(cache=True)
def run(
    pieces: Pieces,
    laws: Laws,
    control: Controller,
    converters: Converters,
    r: Float,
    noise: Float,
    push: Float,
    x: Float,
    t: float,
) -> tuple[Float, Float]:
    """Samples (n, n_y) and commands (n, n_in) of a run from the state x at time t; x moves on.

    r (n, n_in) : what the loops are asked for. noise (n, n_y), push (n, n_d) : sensors' errors and
    disturbances. A step of 0 leaves a value as it is.
    """
    n, n_in = r.shape
    n_y, n_law = pieces.C.shape[0], laws.law.size
    y, v = np.zeros((n, n_y)), np.zeros((n, n_in))
    deep = pieces.late.max()
    line = np.zeros((deep + 1, n_y))  # line[k]: what is shown k samples from now
    old = np.zeros((n_in, pieces.wait.max() + 2))  # outputs, the newest first
    u = np.zeros(pieces.Gamma.shape[2])
    f = np.zeros(n_law)
    memory = np.zeros(n_law)
    z = np.zeros(2 * n_law)
    for k in range(n):
        for i in range(n_y):
            y[k, i] = _converted(converters, i, line[0, i] + noise[k, i])
        for i in range(n_in):
            out = r[k, i]
            for j in range(n_y):
                out -= control.feedback[i, j] * y[k, j]
            if control.step[i] > 0.0:
                out = np.rint(out / control.step[i]) * control.step[i]
            out = min(max(out, control.low[i]), control.high[i])
            v[k, i] = out
            for j in range(old.shape[1] - 1, 0, -1):
                old[i, j] = old[i, j - 1]
            old[i, 0] = _at_source(control, i, out)
        for j in range(deep):
            for i in range(n_y):
                line[j, i] = line[j + 1, i]
        for j in range(push.shape[1]):
            u[n_in + n_law + j] = push[k, j]
        for p in range(pieces.h.size):
            for i in range(n_in):
                u[i] = old[i, pieces.wait[i] + 1 - pieces.new[p, i]]
            t += pieces.h[p]
            if n_law == 0:
                _put(x, np.dot(pieces.Phi[p], x) + np.dot(pieces.Gamma[p], u))
            else:
                _with_laws(pieces, laws, p, x, u, f, memory, z, t)
            for i in range(n_y):
                if pieces.read[i] == p:
                    line[pieces.late[i] - 1, i] = np.dot(pieces.C[i], x) + np.dot(pieces.D[i], u)
    return y, v


@njit(cache=True)
def _with_laws(
    pieces: Pieces,
    laws: Laws,
    p: int,
    x: Float,
    u: Float,
    f: Float,
    memory: Float,
    z: Float,
    t: float,
) -> None:
    """One piece with laws: x, the forces f at its end, the memories and z move on."""
    n_law, h = laws.law.size, pieces.h[p]
    first = pieces.wait.size  # behind the drives
    for i in range(n_law):
        u[first + i] = 0.0
        # Flow through an orifice: less under load, which is a chain's moment against v.
        if laws.law[i] == FLOW:
            d = laws.drive[i]
            u[d] *= np.sqrt(max(0.0, 1.0 + np.sign(u[d]) * z[2 * i] / laws.value[i, 0]))
        elif laws.law[i] != FRICTION:
            u[first + i] = 0.5 * f[i]
    _put(x, np.dot(pieces.Phi[p], x) + np.dot(pieces.Gamma[p], u))
    _put(z, np.dot(pieces.Z, x))
    for i in range(n_law):
        law, value = laws.law[i], laws.value[i]
        if law == FLOW:
            continue
        at, speed = z[2 * i], z[2 * i + 1]
        push = 0.0
        if law == FRICTION:
            push = -speed / pieces.gv[p, i]
            push = min(max(push, -value[0]), value[0])
            f[i] = push
        else:
            force = stop(value, at, pieces.g[p, i]) if law == STOP else f[i]
            for _ in range(0 if law == STOP else ITERATIONS):
                force = smooth(
                    law,
                    value,
                    at + pieces.g[p, i] * 0.5 * force,
                    speed + pieces.gv[p, i] * 0.5 * force,
                    t,
                    memory[i],
                    h,
                )
            push = 0.5 * force
            if law == BOUC_WEN:
                memory[i] = bouc_wen(value, speed + pieces.gv[p, i] * push, memory[i], h)
            f[i] = force
        u[first + i] += push
        for j in range(x.size):
            x[j] += pieces.Gamma[p, j, first + i] * push
        _put(z, np.dot(pieces.Z, x))
