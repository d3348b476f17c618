"""The plant in time: poles stepped exactly, laws solved with them, converters and loop between.

A sample is divided where something happens: the output changes, a sensor's instant (with its
delay) comes, and into equal inner steps where a law acts. Over each piece every input is
constant, so that each pole moves by x(h) = exp(p h) x(0) + phi(h) b u without error; only the
laws, whose force is constant over an inner step, cost accuracy: of second order in the step
(dry friction: of first).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from samii_rig.types import Complex, Float, Int
from sim.concealed.laws import KINDS, VALUES, dead_zone, keep, packed, solve
from sim.concealed.modes import Poles, phi
from sim.concealed.parts import Description

INNER = 8  # inner steps a sample where a law acts
ONE_INSTANT = 1e-9  # of a sample: instants nearer than this are one
REORDERED = {"reassoc", "contract"}  # sums may be taken in any order, which is twice as fast
MOST_SLIDING = 3  # sweeps through the laws of one step, so that they see each other


class Tables(NamedTuple):
    """Pieces of a sample, the same for every sample. S pieces, n poles, m sensors, L laws and d
    drives.

    decay, drive : (S, 2, n) real and imaginary parts of exp(p h) and phi(h). length : (S,) s.
    late : (S, d) 1 where an output has its new value. read : (S, m) 1 where the sensor is read at
    the end. behind : (m,) samples by which that is late. waits : (d,) samples a command waits
    before the change. b (n_in, 2, n), c (n_out, 2, n), D : of `Poles`, in parts. gain :
    (S, L, 2, L) of the probes at a piece's end by the laws' forces. kind, values, memory : of the
    laws.
    """

    decay: Float
    drive: Float
    length: Float
    late: Int
    read: Int
    behind: Int
    waits: Int
    b: Float
    c: Float
    D: Float
    gain: Float
    kind: Int
    values: Float
    memory: Int


class Loop(NamedTuple):
    """Converters and control: v = u + kp (theta_ref - theta) of each drive, clipped and rounded.

    (d,) each: sensor, kp of the centring; low, high, step of the output; deadband, limit hidden
    behind the output, see `parts.Drive`. bottom, top, grain : (m,) of the sensors' converters.
    """

    sensor: Int
    kp: Float
    low: Float
    high: Float
    step: Float
    bottom: Float
    top: Float
    grain: Float
    deadband: Float
    limit: Float


def tabulate(poles: Poles, plant: Description, inner: int = INNER) -> Tables:
    """The pieces of a sample."""
    T = 1.0 / poles.rate_hz
    waited = [_whole(float(delay) / T) for delay in poles.input_delay]
    change = np.array([rest for _, rest in waited])
    cuts = {0.0, 1.0, *change.tolist()}
    behind, instants = [], []
    for delay in poles.delay:
        whole, rest = _whole(delay / T)
        behind.append(whole)
        instants.append(1.0 - rest if rest > 0 else 1.0)
    cuts.update(instants)
    if plant.laws:
        cuts.update(k / inner for k in range(inner))
    edges = [0.0]
    for x in sorted(cuts):
        if x - edges[-1] > ONE_INSTANT:
            edges.append(x)
    h = np.diff(edges) * T
    p = poles.pole
    decay = np.exp(np.outer(h, p))
    drive = np.stack([phi(p, x) for x in h])
    L, m, first = len(plant.laws), poles.delay.size, poles.push + 1
    probes = poles.c[m:].reshape(L, 2, -1) if L else np.zeros((0, 2, p.size), complex)
    static = poles.D[m:, first:].reshape(L, 2, L)
    gain = np.real(np.einsum("lpk,sk,kj->slpj", probes, drive, poles.b[:, first:])) + static
    ends = np.array(edges[1:])
    return Tables(
        _parts(decay),
        _parts(drive),
        h,
        (np.array(edges[:-1])[:, None] >= change - ONE_INSTANT).astype(np.int64),
        np.array([[abs(e - x) <= 2 * ONE_INSTANT for x in instants] for e in ends]).astype(
            np.int64
        ),
        np.array(behind, dtype=np.int64),
        np.array([whole for whole, _ in waited], dtype=np.int64),
        _parts(poles.b.T),
        _parts(poles.c),
        np.ascontiguousarray(poles.D),
        np.ascontiguousarray(gain),
        np.array([KINDS.index(law.kind) for law in plant.laws], dtype=np.int64),
        np.array([packed(law.values) for law in plant.laws]).reshape(L, VALUES),
        np.array(
            [len(law.values) if law.kind == "slip" else 0 for law in plant.laws], dtype=np.int64
        ),
    )


def _parts(z: Complex) -> Float:
    """Real and imaginary parts, (n, 2, m), of (n, m)."""
    return np.ascontiguousarray(np.stack([z.real, z.imag], axis=1))


def _whole(periods: float) -> tuple[int, float]:
    whole = math.floor(periods + ONE_INSTANT)
    rest = periods - whole
    return whole, (rest if rest > ONE_INSTANT else 0.0)


def run(
    tables: Tables, loop: Loop, u: Float, theta_ref: Float, push: Float, error: Float
) -> tuple[Float, Float, Float]:
    """From rest: v (n, d), the sensors' samples (n, m) and the largest values of the probes.

    u, theta_ref : (n, d). push : (n,). error : (n, m), what adds to the sensors before they are
    rounded.
    """
    n, m = error.shape
    v, y = np.zeros(u.shape), np.zeros((n, m))
    peak = np.zeros(2 * tables.kind.size)
    _run(tables, loop, u, theta_ref, push, error, v, y, peak)
    return v, y, peak


@njit(cache=True, fastmath=REORDERED)
def _move(t: Tables, piece: int, x: Float, held: Float) -> None:
    """The state over a piece, under v of each drive and the disturbing force."""
    for q in range(x.shape[1]):
        rate = turn = 0.0
        for i in range(held.size):
            rate += t.b[i, 0, q] * held[i]
            turn += t.b[i, 1, q] * held[i]
        re, im = t.decay[piece, 0, q], t.decay[piece, 1, q]
        by, beside = t.drive[piece, 0, q], t.drive[piece, 1, q]
        a, b = x[0, q], x[1, q]
        x[0, q] = re * a - im * b + by * rate - beside * turn
        x[1, q] = re * b + im * a + by * turn + beside * rate


@njit(cache=True, fastmath=REORDERED)
def _seen(t: Tables, row: int, x: Float, held: Float) -> float:
    """An output's part that comes from the state and from what is held."""
    total = 0.0
    for i in range(held.size):
        total += t.D[row, i] * held[i]
    for q in range(x.shape[1]):
        total += t.c[row, 0, q] * x[0, q] - t.c[row, 1, q] * x[1, q]
    return total


@njit(cache=True, fastmath=REORDERED)
def _push(t: Tables, piece: int, source: int, f: float, x: Float) -> None:
    """What a constant force over a piece adds to the state at its end."""
    for q in range(x.shape[1]):
        by, beside = t.drive[piece, 0, q], t.drive[piece, 1, q]
        rate, turn = t.b[source, 0, q] * f, t.b[source, 1, q] * f
        x[0, q] += by * rate - beside * turn
        x[1, q] += by * turn + beside * rate


@njit(cache=True)
def _run(
    t: Tables,
    k: Loop,
    u: Float,
    theta_ref: Float,
    push: Float,
    error: Float,
    v: Float,
    y: Float,
    peak: Float,
) -> None:
    n, m = error.shape
    drives, pieces = u.shape[1], t.length.size
    laws = t.kind.size
    x = np.zeros((2, t.decay.shape[2]))
    slots = t.behind.max() + 2
    waiting = np.zeros((slots, m))
    queue = np.zeros((drives, t.waits.max() + 1))
    applied, new, held = np.zeros(drives), np.zeros(drives), np.zeros(drives + 1)
    time = 0.0
    probe, free, base = np.zeros((laws, 2)), np.zeros((laws, 2)), np.zeros(2)
    f = np.zeros(laws)
    memory = np.zeros((laws, VALUES))
    for i in range(n):
        for s in range(m):
            value = waiting[i % slots, s] + error[i, s]
            if k.grain[s] > 0.0:
                value = np.rint(value / k.grain[s]) * k.grain[s]
            y[i, s] = min(max(value, k.bottom[s]), k.top[s])
        for d in range(drives):
            out = u[i, d] + k.kp[d] * (theta_ref[i, d] - y[i, k.sensor[d]])
            out = min(max(out, k.low[d]), k.high[d])
            if k.step[d] > 0.0:
                out = min(max(np.rint(out / k.step[d]) * k.step[d], k.low[d]), k.high[d])
            v[i, d] = out
            size = queue.shape[1]
            out = dead_zone(min(max(out, -k.limit[d]), k.limit[d]), k.deadband[d])
            queue[d, i % size] = out
            new[d] = queue[d, (i - t.waits[d]) % size] if i >= t.waits[d] else 0.0
        held[drives] = push[i]
        for piece in range(pieces):
            for d in range(drives):
                held[d] = new[d] if t.late[piece, d] else applied[d]
            _move(t, piece, x, held)
            if laws > 0:
                _answer(t, piece, x, held, time, probe, free, base, f, memory, peak)
            time += t.length[piece]
            for s in range(m):
                if t.read[piece, s]:
                    total = _seen(t, s, x, held)
                    for j in range(laws):
                        total += t.D[s, drives + 1 + j] * f[j]
                    waiting[(i + 1 + t.behind[s]) % slots, s] = total
        for d in range(drives):  # no slice: numba compiles the words of its error too, 5 s
            applied[d] = new[d]


@njit(cache=True)
def _answer(
    t: Tables,
    piece: int,
    x: Float,
    held: Float,
    time: float,
    probe: Float,
    free: Float,
    base: Float,
    f: Float,
    memory: Float,
    peak: Float,
) -> None:
    """Find the laws' forces over a piece; x holds its end without them, and then with them."""
    laws, m = t.kind.size, t.behind.size
    for j in range(laws):
        for p in range(2):
            free[j, p] = _seen(t, m + 2 * j + p, x, held)
    middle = time + 0.5 * t.length[piece]
    for _ in range(1 if laws == 1 else MOST_SLIDING):
        for j in range(laws):
            for p in range(2):
                base[p] = free[j, p]
                for other in range(laws):
                    if other != j:
                        base[p] += t.gain[piece, j, p, other] * f[other]
            f[j] = solve(
                t.kind[j],
                t.values[j],
                memory[j, : t.memory[j]],
                middle,
                probe[j],
                base,
                t.gain[piece, j, :, j],
                f[j],
            )
    for j in range(laws):
        for p in range(2):
            probe[j, p] = free[j, p]
            for other in range(laws):
                probe[j, p] += t.gain[piece, j, p, other] * f[other]
            peak[2 * j + p] = max(peak[2 * j + p], abs(probe[j, p]))
        keep(t.kind[j], t.values[j], memory[j, : t.memory[j]], probe[j, 0])
        _push(t, piece, held.size + j, f[j], x)
