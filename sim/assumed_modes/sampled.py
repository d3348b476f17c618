"""From sample to sample: the exact map of the plant between converters, delays included.

A converter holds its output from a sample to the next; its sources act `delay` later, so within
one period the old value acts first, then the new one. A sensor with a delay is read between two
samples. Each period is cut at those instants (and into equal steps where a law is not
linear); over each piece all inputs are held, so that

    x(t + h) = Phi x(t) + Gamma u,     [Phi Gamma; 0 1] = expm([A B; 0 0] h)

is exact, no matter how stiff the plant is. Signals are read just before the output changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from samii_rig.types import Float, Int
from sim.assumed_modes.parts import Setup
from sim.assumed_modes.plant import Plant, UnphysicalError

SAME = 1e-9  # of a period: instants nearer than this are one


@dataclass(frozen=True, slots=True)
class Timeline:
    """One period in pieces.

    Phi (p, n, n), Gamma (p, n, n_u) : of each piece. new : (p, n_in) 1 where the new output acts.
    read : (n_y,) the piece at whose end each sensor is read. late : (n_y,) how many samples
    later it is shown, 1 or more. wait : (n_in,) whole samples before an output acts.
    h : (p,) s, length of each piece.
    """

    Phi: Float
    Gamma: Float
    new: Int
    read: Int
    late: Int
    wait: Int
    h: Float


def held(A: Float, B: Float, h: float) -> tuple[Float, Float]:
    """Phi (n, n) and Gamma (n, n_u) over `h` seconds with inputs held."""
    n, m = B.shape
    whole = np.zeros((n + m, n + m))
    whole[:n, :n], whole[:n, n:] = A * h, B * h
    with np.errstate(over="ignore", invalid="ignore"):
        E = expm(whole)
    if not np.all(np.isfinite(E)):
        raise UnphysicalError(f"the plant runs away within {h:g} s")
    return E[:n, :n], E[:n, n:]


def timeline(setup: Setup, made: Plant, rate_hz: float, steps: int = 1) -> Timeline:
    """The pieces of one period of a loop at `rate_hz`; `steps` equal ones at least."""
    T = 1.0 / rate_hz
    lag = np.array([(d.actuator.delay + d.delay) / T for d in setup.drives], dtype=np.float64)
    wait = np.floor(lag + SAME).astype(np.int64)
    switch = np.maximum(0.0, lag - wait)
    late = np.array([math.floor(s.delay / T + SAME) + 1 for s in setup.sensors], dtype=np.int64)
    at = np.array(
        [m - s.delay / T for m, s in zip(late, setup.sensors, strict=True)], dtype=np.float64
    )
    marks = np.concatenate([np.arange(steps + 1) / steps, switch, at])
    marks = np.sort(np.clip(marks, 0.0, 1.0))
    ends = marks[np.concatenate([[True], np.diff(marks) > SAME])]
    h = np.diff(ends) * T
    pieces: dict[float, tuple[Float, Float]] = {}
    for length in h:
        key = round(length / T, 9)
        if key not in pieces:
            pieces[key] = held(made.A, made.B, float(length))
    pairs = [pieces[round(length / T, 9)] for length in h]
    return Timeline(
        np.array([p for p, _ in pairs]),
        np.array([g for _, g in pairs]),
        (ends[:-1, None] > switch - SAME).astype(np.int64),
        np.array([int(np.argmin(np.abs(ends[1:] - e))) for e in at], dtype=np.int64),
        late,
        wait,
        h,
    )


@dataclass(frozen=True, slots=True)
class Discrete:
    """The plant as a controller sees it: s' = A s + b v + E d, y = C s (y read before v acts).

    A (m, m), b (m, n_in), E (m, n_d), C (n_y, m): delays of output and sensors are states.
    """

    A: Float
    b: Float
    E: Float
    C: Float


def discrete(made: Plant, line: Timeline) -> Discrete:
    """The map of one whole period, laws of `made` at rest."""
    n, n_in = len(made.A), made.n_in
    first = n_in + made.n_law
    n_d = made.B.shape[1] - first
    n_y = len(made.C)
    # Of each v: v[n-1] ... v[n-1-wait], of which the last acts before the switch.
    n_old = line.wait + 1
    held_at = n + np.concatenate([[0], np.cumsum(n_old)])
    m = int(held_at[-1] + line.late.sum())
    start = [int(held_at[-1] + line.late[:i].sum()) for i in range(n_y)]
    # Columns of what a period's motion depends on: s, v, d.
    now = np.zeros((n, m + n_in + n_d))
    now[:, :n] = np.eye(n)
    acting = [  # old, new
        (held_at[i] + wait, m + i if wait == 0 else held_at[i] + wait - 1)
        for i, wait in enumerate(line.wait)
    ]
    u = np.zeros((made.B.shape[1], m + n_in + n_d))
    u[first:, m + n_in :] = np.eye(n_d)
    rows = np.zeros((m, m + n_in + n_d))
    for p in range(len(line.h)):
        u[:n_in] = 0.0
        for i in range(n_in):
            u[i, acting[i][line.new[p, i]]] = 1.0
        now = line.Phi[p] @ now + line.Gamma[p] @ u
        for i in range(n_y):
            if line.read[i] == p:
                rows[start[i]] = made.C[i] @ now + made.D[i] @ u
    rows[:n] = now
    for i in range(n_in):
        rows[held_at[i], m + i] = 1.0
        for k in range(1, n_old[i]):
            rows[held_at[i] + k, held_at[i] + k - 1] = 1.0
    C = np.zeros((n_y, m))
    for i in range(n_y):
        begin, last = start[i], start[i] + int(line.late[i]) - 1
        for k in range(begin, last):
            rows[k + 1, k] = 1.0
        C[i, last] = 1.0
    return Discrete(rows[:, :m], rows[:, m : m + n_in], rows[:, m + n_in :], C)


@dataclass(frozen=True, slots=True)
class Loop:
    """The loop closed at the loop's rate, s' = A s + b r + E d + f e, y = C s + e.

    r (n_in,) : what the references ask for, u + kp theta_ref each; e : what the converters add.
    f (m, n_y): the sensors' errors go round as well.
    """

    A: Float
    b: Float
    E: Float
    f: Float
    C: Float


def closed(system: Discrete, feedback: Float) -> Loop:
    """The loops v = r - feedback (y + e) around `system`; feedback (n_in, n_y), 0 where open."""
    f = -system.b @ feedback
    return Loop(system.A + f @ system.C, system.b, system.E, f, system.C)


def impulse(A: Float, B: Float, C: Float, n: int) -> Float:
    """(n, n_out, n_in) C A^k B for k = 0 ... n - 1, by blocks of about sqrt(n) powers."""
    size = max(1, math.isqrt(n))
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable loop ends in infinities
        return _blocks(A, B, C, n, size)


def _blocks(A: Float, B: Float, C: Float, n: int, size: int) -> Float:
    right = np.empty((size, *B.shape))
    right[0] = B
    for k in range(1, size):
        right[k] = A @ right[k - 1]
    big = np.linalg.matrix_power(A, size)
    rows = -(-n // size)
    left = np.empty((rows, *C.shape))
    left[0] = C
    for k in range(1, rows):
        left[k] = left[k - 1] @ big
    n_out, n_in = len(C), B.shape[1]
    flat = left.reshape(-1, len(A)) @ right.transpose(1, 0, 2).reshape(len(A), -1)
    out = flat.reshape(rows, n_out, size, n_in).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(out.reshape(-1, n_out, n_in)[:n])
