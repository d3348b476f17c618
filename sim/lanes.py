"""The inner loop of a rig with several outputs: one plant for each, and the sum in every sensor.

The chain is linear, so what each output moves is a plant by itself (`sim.kernel`), stepped
exactly, and a sensor reads the sum. The device's own loops are of all outputs together: what
drops one of them to zero drops all, in the same sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from samii_rig.types import Flags, Float
from sim.kernel import (
    APPLIED,
    EXTRA,
    LAST_REF,
    LIMITED,
    SAMPLE,
    TRIPPED,
    Contact,
    Control,
    Converters,
    Drive,
    Filters,
    State,
    _command,
    _convert,
    _read,
    move,
)
from sim.plant import Tables


class Lane(NamedTuple):
    """One output: its plant, its converter, its loop, and its state; see `sim.kernel`.

    The sensors' converters are those of the first lane.
    """

    tables: Tables
    converters: Converters
    control: Control
    filters: Filters
    drive: Drive
    contact: Contact
    state: State


@njit(cache=True)
def sense_all(lanes: tuple[Lane, ...], noise: Float, values: Float, quality: Flags) -> None:
    """Read all sensors into values and quality, (m,). noise : (m,)."""
    c, s = lanes[0].converters, lanes[0].state
    sample = s.flag[SAMPLE]
    for i in range(values.shape[0]):
        y = 0.0
        for lane in lanes:
            own = lane.state
            if lane.tables.ahead[i] == 0:
                y += _read(lane.tables, own, i, own.number[APPLIED], 0.0, own.number[EXTRA])
            else:
                y += own.early[sample % own.early.shape[0], i]
        y, q = _convert(c, i, sample, y, noise[i])
        if sample >= c.stuck[i]:
            y, q = s.held[i], s.held_flag[i]
        s.held[i], s.held_flag[i] = y, q
        values[i], quality[i] = y, q


@njit(cache=True)
def advance(
    lanes: tuple[Lane, ...],
    u: Float,
    theta_ref: Float,
    given: Flags,
    noise: Float,
    disturbance: Float,
    values: Float,
    quality: Flags,
) -> None:
    """Take len(u) samples: fills values and quality, (n, 3 k + m), and moves the states on.

    u, theta_ref : (n, k) of k outputs. given : (n,) 1 where the queue held a reference. noise :
    (n, m), disturbance : (k, n, inner), standard normal; empty if there is none. Columns : u and
    theta_ref of each output, then the k commands, then the sensors.
    """
    k = len(lanes)
    m = values.shape[1] - 3 * k
    none = np.zeros(max(m, lanes[0].tables.inner))
    for n in range(u.shape[0]):
        y = values[n, 3 * k :]
        sense_all(lanes, noise[n] if noise.shape[0] > 0 else none, y, quality[n, 3 * k :])
        tripped = False
        for j in range(k):
            lane = lanes[j]
            s = lane.state
            if given[n]:
                s.number[LAST_REF] = theta_ref[n, j]
            reference = u[n, j] if given[n] else 0.0
            ref = s.number[LAST_REF]
            v, limited = _command(
                lane.converters, lane.control, lane.filters, s, reference, ref, given[n] != 0, y
            )
            values[n, 2 * j], values[n, 2 * j + 1], values[n, 2 * k + j] = reference, ref, v
            quality[n, 2 * j], quality[n, 2 * j + 1], quality[n, 2 * k + j] = 0, 0, limited
            tripped = tripped or s.flag[TRIPPED] != 0
        for j in range(k):
            lane = lanes[j]
            if tripped:
                lane.state.flag[TRIPPED] = 1
                lane.filters.memory[:] = 0.0
                values[n, 2 * k + j], quality[n, 2 * k + j] = 0.0, LIMITED
            pushed = disturbance[j, n] if disturbance.shape[0] > 0 else none
            move(lane.tables, lane.drive, lane.contact, lane.state, values[n, 2 * k + j], pushed)
