"""The one integrator of all laws: a rig's partial fractions by exact steps, the force in the loop.

The force is held over each step and found together with the motion that it makes. The slopes of
the force by its strengths are led along with it (tangent-linear), through the same step.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types

from samii_rig.diagnose.forces.steps import LAW, LAW_NUMBERS, OUT, Step
from samii_rig.types import Float, Int

_f8, _i8 = types.float64, types.int64
_row, _rows, _cube = (types.Array(_f8, n, "C") for n in (1, 2, 3))
_FAST = {"reassoc", "contract", "nsz"}


@njit(inline="always", fastmath=_FAST)
def _stepped(wr: Float, wi: Float, tr: Float, ti: Float, er: Float, ei: Float, e: float) -> float:
    """Take all states a step on, a force e held over it, by rows of `march`; the sum of the real
    parts."""
    total = 0.0
    for k in range(wr.size):
        real, imag = wr[k] + er[k] * e, wi[k] + ei[k] * e
        now = tr[k] * real - ti[k] * imag
        wi[k] = tr[k] * imag + ti[k] * real
        wr[k] = now
        total += now
    return total


@njit(_rows(LAW, _rows, _rows, _rows, _f8, _f8, _row, _row, _i8, _i8, _row, _rows), cache=True,
      fastmath=_FAST)  # fmt: skip
def march(
    law: Step,
    transition: Float,
    by_v: Float,
    by_e: Float,
    direct: float,
    g: float,
    v: Float,
    others: Float,
    late: int,
    inner: int,
    p: Float,
    seeds: Float,
) -> Float:
    """(1 + m, n inner) the force under a command v (n,) from rest, and its slopes along m changes
    of its numbers.

    transition, by_v, by_e : (2, n_pole) real and imaginary parts. What drives the force is the sum
    of all real parts, and direct and g per unit of command and of force. others : (n inner,) what
    other commands do to it, as `moved`, or none. late : steps of dead time.
    seeds : (m, 3) each change of the numbers p (3,).
    """
    m, n_pole = seeds.shape[0], transition.shape[1]
    tr, ti, er, ei = transition[0], transition[1], by_e[0], by_e[1]
    vr, vi = by_v[0], by_v[1]
    wr, wi = np.zeros((1 + m, n_pole)), np.zeros((1 + m, n_pole))
    f = np.zeros((1 + m, v.size * inner))
    out = np.zeros(OUT)
    y, before, held, memory = np.zeros(1 + m), np.zeros(1 + m), np.zeros(1 + m), np.zeros(1 + m)
    at_once = direct + np.sum(vr)
    for step in range(v.size * inner):
        u = v[(step - late) // inner] if step >= late else 0.0
        for i in range(1 + m):
            y[i] = _stepped(wr[i], wi[i], tr, ti, er, ei, held[i])
        for k in range(n_pole):
            wr[0, k] += vr[k] * u
            wi[0, k] += vi[k] * u
        y[0] += at_once * u + (others[step] if others.size else 0.0)
        out[:] = 0.0
        law(before[0], y[0], u, g, p, memory[0], out)
        f[0, step] = held[0] = out[0]
        for i in range(1, 1 + m):
            along = out[1] * before[i] + out[2] * y[i] + out[4] * memory[i]
            keeps = out[5] * before[i] + out[6] * y[i] + out[7] * memory[i]
            for j in range(LAW_NUMBERS):
                along += out[8 + 2 * j] * seeds[i - 1, j]
                keeps += out[9 + 2 * j] * seeds[i - 1, j]
            f[i, step] = held[i] = along
            memory[i] = keeps
        memory[0] = out[3]
        for i in range(1 + m):
            before[i] = y[i] + g * held[i]
    return f


@njit(_row(_row, _rows, _rows, _f8, _i8, _i8), cache=True, fastmath=_FAST)
def moved(v: Float, transition: Float, by_v: Float, direct: float, late: int, inner: int) -> Float:
    """(n inner,) what a command v (n,) alone does from rest; as `march` has it."""
    n_pole = transition.shape[1]
    wr, wi = np.zeros(n_pole), np.zeros(n_pole)
    out = np.zeros(v.size * inner)
    for step in range(v.size * inner):
        u = v[(step - late) // inner] if step >= late else 0.0
        total = direct * u
        for k in range(n_pole):
            real = transition[0, k] * wr[k] - transition[1, k] * wi[k] + by_v[0, k] * u
            wi[k] = transition[0, k] * wi[k] + transition[1, k] * wr[k] + by_v[1, k] * u
            wr[k] = real
            total += real
        out[step] = total
    return out


@njit(_rows(_row, _rows, _cube, _row, _i8, types.Array(_i8, 1, "C")), cache=True, fastmath=_FAST)
def read(e: Float, transition: Float, by_e: Float, direct: Float, inner: int, late: Int) -> Float:
    """(n, q) what sensors show of a force e (n inner,), before each sample's steps.

    transition : (2, n_pole); by_e : (2, q, n_pole) what a force held over a step makes of each
    sensor's state. late : (q,) steps of each sensor's delay.
    """
    q, n_pole = by_e.shape[1], by_e.shape[2]
    n = e.size // inner
    out = np.zeros((n, q))
    wr, wi = np.zeros(n_pole), np.zeros(n_pole)
    before = 0.0
    for step in range(e.size):
        for i in range(q):
            if (step + late[i]) % inner == 0 and (step + late[i]) // inner < n:
                y = direct[i] * before
                for k in range(n_pole):
                    y += by_e[0, i, k] * wr[k] - by_e[1, i, k] * wi[k]
                out[(step + late[i]) // inner, i] = y
        before = e[step]
        for k in range(n_pole):
            real = transition[0, k] * wr[k] - transition[1, k] * wi[k] + before
            wi[k] = transition[0, k] * wi[k] + transition[1, k] * wr[k]
            wr[k] = real
    return out
