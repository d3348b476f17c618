"""The loop over blocks of s, and what is asked of it.

There is one compiled entry, `_run`, for all of it: each further one would compile the
sweeps again. `Asked` says which task it has, `Found` where the answer goes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from samii_rig.model.kernels.adjoint import (
    element_parameters,
    element_states,
    keep_waves,
    source_parameters,
)
from samii_rig.model.kernels.block import block, recall_beam
from samii_rig.model.kernels.lanes import (
    LANES,
    conj,
    get,
    kernel,
    norm2,
    part,
    put,
    scaled,
)
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
    Span,
    States,
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


class Asked(NamedTuple):
    """What is asked at every s: the task and, of the arrays, those that it needs.

    slots (n_op, 7), source_slots (n_source, n_par) : as of `gradient`.
    jumps (n_jump,), jump_c (n_jump, 4) : as of `fields`.
    """

    task: int
    slots: Int
    source_slots: Int
    jumps: Int
    jump_c: Float


class Found(NamedTuple):
    """Where the answers go: H, dH and both states of `gradient`, states of `fields`, mantissa and
    log of `characteristic`; the others are empty."""

    H: Complex
    dH: Complex
    states: Complex
    duals: Complex
    mantissa: Complex
    log: Float


class Ports(NamedTuple):
    """Which states a task needs.

    wanted (n_op + 1,) : ports at which a state is read. elements (n_op,) : those with a derivative;
        adjoint : whether there are any. first, last : ports to sweep to from tip and base.
        low, high : the outermost wanted ports.
    """

    wanted: Flag
    elements: Flag
    adjoint: bool
    first: int
    last: int
    low: int
    high: int


_ASKED = Asked(
    RESPOND, np.zeros((0, 0), np.int64), np.zeros((0, 0), np.int64), np.zeros(0, np.int64),
    np.zeros((0, 4)),
)  # fmt: skip
_FOUND = Found(
    np.zeros((0, 0, 0), complex), np.zeros((0, 0, 0, 0), complex),
    np.zeros((0, 0, 0, 0), complex), np.zeros((0, 0, 0, 0), complex),
    np.zeros(0, complex), np.zeros(0),
)  # fmt: skip


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
    asked = _ASKED._replace(slots=slots, source_slots=source_slots)
    _run(x, f, s, asked, _FOUND._replace(H=H, dH=dH, states=z, duals=zh))
    return z, zh


def response(x: System, f: Factors, s: Complex, H: Complex) -> None:
    """`gradient` without derivatives."""
    slots, source_slots = np.full((x.kinds.shape[0], 7), -1), np.full((x.source.shape[0], 1), -1)
    asked = _ASKED._replace(slots=slots, source_slots=source_slots)
    _run(x, f, s, asked, _FOUND._replace(H=H, dH=np.zeros((*H.shape, 0), complex)))


def fields(x: System, f: Factors, s: Complex, jumps: Int, jump_c: Float, out: Complex) -> None:
    """out (n, n_jump, n_op + 1, 4): the states at all ports for jumps at ports `jumps`.

    jump_c (n_jump, 4): the sensor to which each is dual, see `solve`. At the jump's own
    port the state upstream of it.
    """
    asked = _ASKED._replace(task=FIELD, jumps=jumps, jump_c=jump_c)
    _run(x, f, s, asked, _FOUND._replace(states=out))


def characteristic(x: System, f: Factors, s: Complex, mantissa: Complex, log: Float) -> None:
    """mantissa exp(log) = D(s), the tip's conditions on the columns from the base; still times
    E1 E2 of every WAVES."""
    asked = _ASKED._replace(task=CHARACTERISTIC)
    _run(x, f, s, asked, _FOUND._replace(mantissa=mantissa, log=log))


def compiled() -> bool:
    """Whether the disk keeps these kernels compiled; who calls them else waits for a minute."""
    return any(Path(cast(Any, _run).stats.cache_path).glob("respond.*.nbi"))


@part
def _ports(x: System, asked: Asked) -> Ports:
    n_op, n_source = x.kinds.shape[0], x.source.shape[0]
    wanted = np.zeros(n_op + 1, np.bool_)
    elements = np.zeros(n_op, np.bool_)
    if asked.task == RESPOND:
        for t in range(x.term.shape[0]):
            wanted[x.term[t, 1]] = True
        for source in range(n_source):
            wanted[x.source[source, 0]] = True
        for e in range(n_op):
            elements[e] = x.kinds[e] != IDENTITY and asked.slots[e].max() >= 0
            if elements[e]:
                wanted[e + 1] = True
                wanted[e] |= x.kinds[e] >= BEAM_KIND
    else:
        wanted[:] = True
    adjoint = bool(elements.any())
    first, last = 0, n_op
    if asked.task == CHARACTERISTIC:
        first = n_op
    elif asked.task == RESPOND and not adjoint:
        first, last = x.source[0, 0], x.source[-1, 0]
    low, high = n_op, 0
    for port in range(n_op + 1):
        if wanted[port]:
            low, high = min(low, port), max(high, port)
    return Ports(wanted, elements, adjoint, first, last, low, high)


# The loop stands in the entry itself: as a part that it calls, all would be optimised twice.
@kernel
def _run(files: int) -> Callable[..., None]:
    def run(x: System, f: Factors, s: Complex, asked: Asked, found: Found) -> None:
        if files < 0:  # never: it is here to be closed over
            return
        n_op = x.kinds.shape[0]
        n_sensor, n_source = x.feed.shape
        k = workspace(n_op)
        ports = _ports(x, asked)
        # Names of their own for what the loop uses: numba counts an array at each look into a
        # tuple.
        wanted, elements, adjoint = ports.wanted, ports.elements, ports.adjoint
        first, last, low, high = ports.first, ports.last, ports.low, ports.high
        slots, source_slots, H, dH = asked.slots, asked.source_slots, found.H, found.dH
        answers = np.zeros((n_sensor, 2 * LANES))
        z = np.zeros((n_source, n_op if adjoint else 0, 16 * LANES))
        zh = np.zeros((n_sensor, n_op if adjoint else 0, 16 * LANES))
        for start in range(0, s.shape[0], LANES):
            span = Span(start, block(x, f, k, s, start, first, last, wanted))
            if asked.task == CHARACTERISTIC:
                _characteristic(x, k, span, found.mantissa, found.log)
            elif asked.task == FIELD:
                _fields(x, k, span, asked, wanted, found.states)
            else:
                for source in range(n_source):
                    jump = x.source[source, 0]
                    set_factor(k.W, f.drive[source], start)
                    solve(x, k, jump, x.source_c[source, :4], low, high, wanted)
                    read_sensors(x, f, k, source, answers, start)
                    _store_answers(x, source, answers, span.n, H[start:])
                    slot = source_slots[source]
                    if slot.max() >= 0:
                        slopes = f.drive_d[source]
                        source_parameters(
                            x.source[source, 1], slopes, answers, slot, span, dH[start:]
                        )
                    if adjoint:
                        element_states(x, k, elements, jump, False, z[source])
                if adjoint:
                    for t in range(x.term.shape[0]):
                        jump = x.term[t, 1]
                        set_term_factor(x, f.jump, k.W, t, start)
                        solve(x, k, jump, x.term_c[t], low, high, wanted)
                        more = t > 0 and x.term[t, 0] == x.term[t - 1, 0]
                        element_states(x, k, elements, jump, more, zh[x.term[t, 0]])
                    states = States(elements, z, zh)
                    element_parameters(x, f.jump_d, k, slots, states, span, dH[start:])
                    keep_waves(x, elements, z, span, found.states)
                    keep_waves(x, elements, zh, span, found.duals)

    return run


@part
def _store_answers(x: System, source: int, answers: Float, n: int, H: Complex) -> None:
    K = x.source_c[source, 4]
    actuator = x.source[source, 1]
    for j in range(answers.shape[0]):
        for i in range(n):
            H[i, j, actuator] += scaled(complex(answers[j, i], answers[j, LANES + i]), K)


@part
def _fields(x: System, k: Work, span: Span, asked: Asked, wanted: Flag, states: Complex) -> None:
    n_op = x.kinds.shape[0]
    for j in range(asked.jumps.shape[0]):
        jump = asked.jumps[j]
        for i in range(LANES):
            put(k.W, FACTOR, i, complex(1.0, 0.0))
        solve(x, k, jump, asked.jump_c[j], 0, n_op, wanted)
        for port in range(n_op + 1):
            port_state(k, port, jump, True, False)
            for i in range(span.n):
                for m in range(4):
                    states[span.start + i, j, port, m] = get(k.W, Z + 2 * m, i)


@part
def _characteristic(x: System, k: Work, span: Span, mantissa: Complex, log: Float) -> None:
    start, n, n_op = span.start, span.n, x.kinds.shape[0]
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
