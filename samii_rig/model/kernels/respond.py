"""The loop over blocks of s, and what is asked of it.

There is one compiled entry, `_run`, for all of it: each further one would compile the
sweeps again. It is told what to do as `_blocks` is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from samii_rig.model.kernels.adjoint import (
    element_parameters,
    element_states,
    keep_waves,
    source_parameters,
)
from samii_rig.model.kernels.block import block, recall_beam
from samii_rig.model.kernels.lanes import LANES, conj, get, kernel, norm2, part, put, scaled
from samii_rig.model.kernels.registers import (
    BEAM_KIND,
    CLAMPED,
    DECAY,
    FACTOR,
    GUIDED,
    IDENTITY,
    PHASE,
    PINNED,
    SCALE,
    SPRING,
    B,
    Factors,
    Flag,
    System,
    Work,
    Z,
    workspace,
)
from samii_rig.model.kernels.solve import (
    port_state,
    read_sensors,
    set_factor,
    set_term_factor,
    solve,
)
from samii_rig.types import Complex, Float, Int

RESPOND, FIELD, CHARACTERISTIC = 0, 1, 2
_NO_FLOAT = np.zeros(0)
_NO_COMPLEX = np.zeros(0, complex)
_NO_STATES = np.zeros((0, 0, 0, 0), complex)
_NO_INT = np.zeros((0, 0), np.int64)


def gradient(
    x: System, f: Factors, s: Complex, slots: Int, source_slots: Int, H: Complex, dH: Complex
) -> tuple[Complex, Complex]:
    """Add the response of all sensors to all actuators to H (n, n_sensor, n_actuator), and
    its derivatives to dH (n, n_sensor, n_actuator, n_wanted).

    slots (n_op, 7), source_slots (n_source, n_par): where in dH the derivative by this
    parameter of this element or source goes (added, as the parts of a divided beam share
    theirs), -1 for nowhere.

    What WAVES add is left to the caller: returned are the states behind (4) and before (4)
    each, (n_matrix, n, 8, n_source) at unit f and K, and those of the sensors' dual solutions,
    (n_matrix, n, 8, n_sensor).
    """
    n_sensor, n_source = x.feed.shape
    z = np.zeros((f.matrix.shape[0], s.size, 8, n_source), complex)
    zh = np.zeros((f.matrix.shape[0], s.size, 8, n_sensor), complex)
    _run(
        x, f, s, RESPOND, slots, source_slots, np.zeros(0, np.int64), np.zeros((0, 4)),
        H, dH, z, zh, _NO_COMPLEX, _NO_FLOAT,
    )  # fmt: skip
    return z, zh


def response(x: System, f: Factors, s: Complex, H: Complex) -> None:
    """`gradient` without derivatives."""
    _run(
        x, f, s, RESPOND, np.full((x.kinds.shape[0], 7), -1), np.full((x.source.shape[0], 1), -1),
        np.zeros(0, np.int64), np.zeros((0, 4)), H, np.zeros((*H.shape, 0), complex),
        _NO_STATES, _NO_STATES, _NO_COMPLEX, _NO_FLOAT,
    )  # fmt: skip


def fields(x: System, f: Factors, s: Complex, jumps: Int, jump_c: Float, out: Complex) -> None:
    """out (n, n_jump, n_op + 1, 4): the states at all ports for jumps at ports `jumps`.

    jump_c (n_jump, 4): the sensor to which each is dual, see `solve`. At the jump's own
    port the state upstream of it.
    """
    _run(
        x, f, s, FIELD, _NO_INT, _NO_INT, jumps, jump_c,
        np.zeros((0, 0, 0), complex), _NO_STATES, out, _NO_STATES, _NO_COMPLEX, _NO_FLOAT,
    )  # fmt: skip


def characteristic(x: System, f: Factors, s: Complex, mantissa: Complex, log: Float) -> None:
    """mantissa exp(log) = D(s), the tip's conditions on the columns from the base; still times
    E1 E2 of every WAVES."""
    _run(
        x, f, s, CHARACTERISTIC, _NO_INT, _NO_INT, np.zeros(0, np.int64), np.zeros((0, 4)),
        np.zeros((0, 0, 0), complex), _NO_STATES, _NO_STATES, _NO_STATES, mantissa, log,
    )  # fmt: skip


@part
def _blocks(
    x: System,
    f: Factors,
    s: Complex,
    task: int,
    slots: Int,
    source_slots: Int,
    jumps: Int,
    jump_c: Float,
    H: Complex,
    dH: Complex,
    out: Complex,
    duals: Complex,
    mantissa: Complex,
    log: Float,
) -> None:
    n_op, n_term = x.kinds.shape[0], x.term.shape[0]
    n_sensor, n_source = x.feed.shape
    k = workspace(n_op)
    answers = np.zeros((n_sensor, 2 * LANES))
    wanted = np.zeros(n_op + 1, np.bool_)
    elements = np.zeros(n_op, np.bool_)
    first, last = 0, n_op  # ports to sweep to from tip and base
    if task == RESPOND:
        for t in range(n_term):
            wanted[x.term[t, 1]] = True
        for source in range(n_source):
            wanted[x.source[source, 0]] = True
        for e in range(n_op):
            elements[e] = x.kinds[e] != IDENTITY and slots[e].max() >= 0
            if elements[e]:
                wanted[e + 1] = True
                wanted[e] |= x.kinds[e] >= BEAM_KIND
    else:
        wanted[:] = True
    adjoint = elements.any()
    if task == CHARACTERISTIC:
        first = n_op
    elif task == RESPOND and not adjoint:
        first, last = x.source[0, 0], x.source[-1, 0]
    z = np.zeros((n_source, n_op if adjoint else 0, 16 * LANES))
    zh = np.zeros((n_sensor, n_op if adjoint else 0, 16 * LANES))
    low, high = n_op, 0
    for port in range(n_op + 1):
        if wanted[port]:
            low, high = min(low, port), max(high, port)
    for start in range(0, s.shape[0], LANES):
        n = block(x, f, k, s, start, first, last, wanted)
        if task == CHARACTERISTIC:
            _characteristic(x, k, start, n, mantissa, log)
        elif task == FIELD:
            _fields(x, k, start, n, jumps, jump_c, wanted, out)
        else:
            for source in range(n_source):
                jump = x.source[source, 0]
                set_factor(k.W, f.drive[source], start)
                solve(x, k, jump, x.source_c[source, :4], low, high, wanted)
                read_sensors(x, f, k, source, answers, start)
                _store_answers(x, source, answers, n, H[start:])
                if source_slots[source].max() >= 0:
                    slot = source_slots[source]
                    source_parameters(
                        x.source[source, 1], f.drive_d[source], answers, slot, start, n, dH[start:]
                    )
                if adjoint:
                    element_states(x, k, elements, jump, False, z[source])
            if adjoint:
                for t in range(n_term):
                    jump = x.term[t, 1]
                    set_term_factor(x, f.jump, k.W, t, start)
                    solve(x, k, jump, x.term_c[t], low, high, wanted)
                    more = t > 0 and x.term[t, 0] == x.term[t - 1, 0]
                    element_states(x, k, elements, jump, more, zh[x.term[t, 0]])
                element_parameters(x, f.jump_d, k, elements, slots, z, zh, start, n, dH[start:])
                keep_waves(x, elements, z, start, n, out)
                keep_waves(x, elements, zh, start, n, duals)


@kernel
def _run(files: int) -> Callable[..., None]:
    def run(*asked: Any) -> None:
        if files > 0:
            _blocks(*asked)

    return run


@part
def _store_answers(x: System, source: int, answers: Float, n: int, H: Complex) -> None:
    K = x.source_c[source, 4]
    actuator = x.source[source, 1]
    for j in range(answers.shape[0]):
        for i in range(n):
            H[i, j, actuator] += scaled(complex(answers[j, i], answers[j, LANES + i]), K)


@part
def _fields(
    x: System, k: Work, start: int, n: int, jumps: Int, jump_c: Float, wanted: Flag, out: Complex
) -> None:
    n_op = x.kinds.shape[0]
    for j in range(jumps.shape[0]):
        for i in range(LANES):
            put(k.W, FACTOR, i, complex(1.0, 0.0))
        solve(x, k, jumps[j], jump_c[j], 0, n_op, wanted)
        for port in range(n_op + 1):
            port_state(k, port, jumps[j], True, False)
            for i in range(n):
                for m in range(4):
                    out[start + i, j, port, m] = get(k.W, Z + 2 * m, i)


@part
def _characteristic(x: System, k: Work, start: int, n: int, mantissa: Complex, log: Float) -> None:
    n_op = x.kinds.shape[0]
    X = k.columns_p[n_op]
    for i in range(n):
        if x.ends[1] == CLAMPED:
            D = get(X, 0, i) * 0.0 - get(X, 8, i) * get(X, 2, i)
        elif x.ends[1] == PINNED:
            D = get(X, 0, i) * get(X, 10, i) - get(X, 8, i) * get(X, 4, i)
        elif x.ends[1] == GUIDED:
            D = get(X, 2, i) * get(X, 12, i)
        else:
            D = get(X, 4, i) * get(X, 12, i) - get(X, 10, i) * get(X, 6, i)
        mantissa[start + i], log[start + i] = D, 0.0
    for e in range(n_op):
        if x.kinds[e] < SPRING:
            continue
        if x.kinds[e] == BEAM_KIND:
            recall_beam(k, e)
        for i in range(n):
            log[start + i] -= math.log(k.changes_p[e, (SCALE - B) * LANES + i])
            if x.kinds[e] == BEAM_KIND:
                # B also holds E1 E2: its modulus goes to the scale, its phase is undone.
                mantissa[start + i] *= conj(get(k.W, PHASE, i))
                log[start + i] += k.W[DECAY * LANES + i]
    for i in range(start, start + n):
        size = math.sqrt(norm2(mantissa[i]))
        mantissa[i] = scaled(mantissa[i], 1.0 / size) if size > 0 else mantissa[i]
        log[i] = log[i] + math.log(size) if size > 0 else 0.0
