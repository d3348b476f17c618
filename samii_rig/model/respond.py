"""The loops over blocks of s: responses, gradients, fields, characteristic function."""

from __future__ import annotations

import math

import numpy as np

from samii_rig.model.block import block, recall_beam
from samii_rig.model.gradient import contributions, integrals
from samii_rig.model.lanes import LANES, conj, get, inverse, kernel, norm2, part, put, scaled, store
from samii_rig.model.registers import (
    BEAM_KIND,
    CLAMPED,
    COMPLIANCE,
    DECAY,
    FACTOR,
    IDENTITY,
    PHASE,
    PINNED,
    RESULT,
    SCALE,
    SPRING,
    B,
    Flag,
    S,
    System,
    Work,
    Z,
    workspace,
)
from samii_rig.model.solve import (
    port_state,
    read_sensors,
    set_source_factor,
    set_term_factor,
    solve,
    walk,
)
from samii_rig.types import Complex, Float, Int


@part
def _solve_source(x: System, k: Work, source: int, low: int, high: int, wanted: Flag) -> None:
    """The coefficients at ports `low` to `high` for p/(s (s + p)), the source at K = 1."""
    port = x.source[source, 0]
    set_source_factor(x, k.W, port)
    # A unit jump of theta is dual to minus the moment.
    solve(k.W, k.columns_p[port], k.columns_q[port], np.array([0.0, 0.0, -1.0, 0.0]))
    walk(x, k, port, low, high, wanted)


@kernel
def response(x: System, s: Complex, H: Complex) -> None:
    """Add the response of all sensors to all actuators to H (n, n_sensor, n_actuator)."""
    n_op, n_sensor = x.kinds.shape[0], x.feed.shape[0]
    k = workspace(n_op)
    answers = np.zeros((n_sensor, 2 * LANES))
    wanted = np.zeros(n_op + 1, np.bool_)
    low, high = n_op, 0
    for t in range(x.term.shape[0]):
        wanted[x.term[t, 1]] = True
        low, high = min(low, x.term[t, 1]), max(high, x.term[t, 1])
    for source in range(x.source.shape[0]):
        wanted[x.source[source, 0]] = True
    for start in range(0, s.shape[0], LANES):
        n = block(x, k, s, start, x.source[0, 0], x.source[-1, 0], wanted)
        for source in range(x.source.shape[0]):
            _solve_source(x, k, source, low, high, wanted)
            read_sensors(x, k, source, answers)
            actuator = x.source[source, 1]
            K = x.pars[x.source[source, 0], 0]
            for j in range(n_sensor):
                for i in range(n):
                    y = complex(answers[j, i], answers[j, LANES + i])
                    H[start + i, j, actuator] += scaled(y, K)


@kernel
def gradient(x: System, s: Complex, slots: Int, H: Complex, dH: Complex) -> None:
    """`response`, and dH (n, n_sensor, n_actuator, n_wanted) by the adjoint.

    slots (n_op, 5): where in dH the derivative by this parameter of this element goes
    (added, as the parts of a divided beam share theirs), -1 for nowhere.
    """
    n_op, n_term = x.kinds.shape[0], x.term.shape[0]
    n_sensor, n_source = x.feed.shape
    k = workspace(n_op)
    answers = np.zeros((n_source, n_sensor, 2 * LANES))
    z = np.zeros((n_source, n_op, 16 * LANES))
    zh = np.zeros((n_sensor, n_op, 16 * LANES))
    elements = np.zeros(n_op, np.bool_)
    wanted = np.zeros(n_op + 1, np.bool_)
    for t in range(n_term):
        wanted[x.term[t, 1]] = True
    for source in range(n_source):
        wanted[x.source[source, 0]] = True
    for e in range(n_op):
        elements[e] = x.kinds[e] != IDENTITY and slots[e].max() >= 0
        if elements[e]:
            wanted[e + 1] = True
            wanted[e] |= x.kinds[e] == BEAM_KIND
    low, high = n_op, 0
    for port in range(n_op + 1):
        if wanted[port]:
            low, high = min(low, port), max(high, port)
    for start in range(0, s.shape[0], LANES):
        n = block(x, k, s, start, low, high, wanted)
        for source in range(n_source):
            _solve_source(x, k, source, low, high, wanted)
            read_sensors(x, k, source, answers[source])
            _element_states(x, k, elements, x.source[source, 0], False, z[source])
        for t in range(n_term):
            port = x.term[t, 1]
            set_term_factor(x, k.W, t)
            solve(k.W, k.columns_p[port], k.columns_q[port], x.term_c[t])
            walk(x, k, port, low, high, wanted)
            more = t > 0 and x.term[t, 0] == x.term[t - 1, 0]
            _element_states(x, k, elements, port, more, zh[x.term[t, 0]])
        for e in range(n_op):
            if not elements[e]:
                continue
            if x.kinds[e] == BEAM_KIND:
                recall_beam(k, e)
                integrals(k.W, k.regimes[e])
            for j in range(n_sensor):
                direct = 0.0
                for t in range(n_term):
                    if x.term[t, 0] == j and x.term[t, 2] == COMPLIANCE and x.term[t, 3] == e:
                        direct += x.term_c[t, 2]
                for source in range(n_source):
                    contributions(
                        k.W, x.kinds[e], x.pars[e], k.regimes[e], direct, z[source, e], zh[j, e]
                    )
                    K = x.pars[x.source[source, 0], 0]
                    _scatter(k.W, slots[e], K, n, dH[start:, j, x.source[source, 1]])
        for source in range(n_source):
            _source_parameters(x, k.W, source, answers[source], slots, n, H[start:], dH[start:])


@part
def _scatter(W: Float, slot: Int, K: float, n: int, target: Complex) -> None:
    for m in range(5):
        if slot[m] >= 0:
            for i in range(n):
                target[i, slot[m]] += scaled(get(W, RESULT + 2 * m, i), K)


@part
def _source_parameters(
    x: System, W: Float, source: int, answers: Float, slots: Int, n: int, H: Complex, dH: Complex
) -> None:
    """H, dH/dK and dH/dp from the answers to p/(s (s + p))."""
    e, actuator = x.source[source, 0], x.source[source, 1]
    K, p = x.pars[e, 0], x.pars[e, 1]
    by_K, by_p = slots[e, 0], slots[e, 1]
    for i in range(n):
        s = get(W, S, i)
        lag = scaled(s * inverse(complex(s.real + p, s.imag)), K / p)
        for j in range(answers.shape[0]):
            y = complex(answers[j, i], answers[j, LANES + i])
            H[i, j, actuator] += scaled(y, K)
            if by_K >= 0:
                dH[i, j, actuator, by_K] += y
            if by_p >= 0:
                dH[i, j, actuator, by_p] += y * lag


@part
def _element_states(x: System, k: Work, elements: Flag, jump: int, more: bool, out: Float) -> None:
    """Set or add to out[e] the state behind element e (of a spring M alone), and for a beam
    also before it."""
    for e in range(x.kinds.shape[0]):
        if elements[e]:
            only = x.kinds[e] == SPRING
            port_state(k, e + 1, jump, True, only)
            if only:
                _keep(out[e, 4 * LANES : 6 * LANES], k.W[(Z + 4) * LANES :], 2, more)
            else:
                _keep(out[e], k.W[Z * LANES :], 8, more)
            if x.kinds[e] == BEAM_KIND:
                port_state(k, e, jump, False, False)
                _keep(out[e, 8 * LANES :], k.W[Z * LANES :], 8, more)


@part
def _keep(out: Float, rows: Float, n: int, more: bool) -> None:
    if more:
        for i in range(n * LANES):
            out[i] += rows[i]
    else:
        store(out, rows, 0, n)


@kernel
def fields(x: System, s: Complex, jumps: Int, jump_c: Float, out: Complex) -> None:
    """out (n, n_jump, n_op + 1, 4): the states at all ports for jumps at ports `jumps`.

    jump_c (n_jump, 4): the sensor to which each is dual, see `solve`. At the jump's own
    port the state upstream of it.
    """
    n_op = x.kinds.shape[0]
    k = workspace(n_op)
    wanted = np.ones(n_op + 1, np.bool_)
    for i in range(LANES):
        put(k.W, FACTOR, i, complex(1.0, 0.0))
    for start in range(0, s.shape[0], LANES):
        n = block(x, k, s, start, 0, n_op, wanted)
        for j in range(jumps.shape[0]):
            jump = jumps[j]
            solve(k.W, k.columns_p[jump], k.columns_q[jump], jump_c[j])
            walk(x, k, jump, 0, n_op, wanted)
            for port in range(n_op + 1):
                port_state(k, port, jump, True, False)
                for i in range(n):
                    for m in range(4):
                        out[start + i, j, port, m] = get(k.W, Z + 2 * m, i)


@kernel
def characteristic(x: System, s: Complex, clear: bool, mantissa: Complex, log: Float) -> None:
    """mantissa exp(log) = D(s): the tip's conditions on the columns from the base.

    clear: times (1 + c s / k) for every spring.
    """
    n_op = x.kinds.shape[0]
    k = workspace(n_op)
    wanted = np.zeros(n_op + 1, np.bool_)
    wanted[n_op] = True
    for start in range(0, s.shape[0], LANES):
        n = block(x, k, s, start, n_op, n_op, wanted)
        X = k.columns_p[n_op]
        for i in range(n):
            if x.ends[1] == CLAMPED:
                D = get(X, 0, i) * 0.0 - get(X, 8, i) * get(X, 2, i)
            elif x.ends[1] == PINNED:
                D = get(X, 0, i) * get(X, 10, i) - get(X, 8, i) * get(X, 4, i)
            else:
                D = get(X, 4, i) * get(X, 12, i) - get(X, 10, i) * get(X, 6, i)
            mantissa[start + i], log[start + i] = D, 0.0
        for e in range(n_op):
            if x.kinds[e] < SPRING:
                continue
            if x.kinds[e] == BEAM_KIND:
                recall_beam(k, e)
            slope = x.pars[e, 1] / x.pars[e, 0] if clear else 0.0
            for i in range(n):
                log[start + i] -= math.log(k.changes_p[e, (SCALE - B) * LANES + i])
                if x.kinds[e] == BEAM_KIND:
                    # B also holds E1 E2: its modulus goes to the scale, its phase is undone.
                    mantissa[start + i] *= conj(get(k.W, PHASE, i))
                    log[start + i] += k.W[DECAY * LANES + i]
                else:
                    mantissa[start + i] *= 1.0 + scaled(get(k.W, S, i), slope)
        for i in range(start, start + n):
            size = math.sqrt(norm2(mantissa[i]))
            mantissa[i] = scaled(mantissa[i], 1.0 / size) if size > 0 else mantissa[i]
            log[i] = log[i] + math.log(size) if size > 0 else 0.0
