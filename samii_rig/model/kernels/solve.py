"""The response of a chain to a jump of the state at one port.

Left of the jump the state is P a (P the columns swept from the base), right of it Q b (from
the tip), and Q b - P a = e. With w(x, y) = x^T J y (`elements.J`) every element keeps
w(P, Q), and w(P, P) = w(Q, Q) = 0, so

    G b = w(P, e),    G^T a = w(Q, e),    G = w(P, Q)  (2x2).

A sensor that reads c^T z is dual to the jump e with w(x, e) = -c^T x: by reciprocity the
chain's answer zh to that jump gives the sensor's answer to any jump d elsewhere,
y = -w(zh, d). So one more solution of the same chain a sensor yields all gradients.

`terms` of a sensor are products of a factor (1, s, s^2 or a spring's compliance) and c^T z at a
port. At a port with a jump, z is the value upstream of it.
"""

from __future__ import annotations

from samii_rig.model.kernels.lanes import LANES, get, inverse, part, put, scaled, store
from samii_rig.model.kernels.registers import (
    ACCELERATION,
    ALPHA,
    COMPLIANCE,
    FACTOR,
    FLAG,
    GAMMA,
    HINGE,
    OUT,
    RHO,
    SCALE,
    SPRING,
    VELOCITY,
    B,
    Factors,
    Flag,
    S,
    System,
    Work,
    X,
    Z,
)
from samii_rig.types import Complex, Float


@part
def set_factor(W: Float, values: Complex, start: int) -> None:
    """FACTOR = values[start:], the last one repeated."""
    last = values.shape[0] - 1
    for i in range(LANES):
        put(W, FACTOR, i, values[min(start + i, last)])


@part
def set_term_factor(x: System, jump: Complex, W: Float, t: int, start: int) -> None:
    """FACTOR of term t: 1, s, s^2 or the compliance of a spring or hinge."""
    kind, spring = x.term[t, 2], x.term[t, 3]
    if kind == ACCELERATION:
        for i in range(LANES):
            put(W, FACTOR, i, get(W, S + 2, i))
    elif kind == VELOCITY:
        for i in range(LANES):
            put(W, FACTOR, i, get(W, S, i))
    elif kind == COMPLIANCE and x.kinds[spring] == HINGE:
        set_factor(W, jump[x.place[spring, 1]], start)
    elif kind == COMPLIANCE:
        k, c = x.pars[spring, 0], x.pars[spring, 1]
        for i in range(LANES):
            s = get(W, S, i)
            put(W, FACTOR, i, inverse(complex(k + c * s.real, c * s.imag)))
    else:
        for i in range(LANES):
            put(W, FACTOR, i, complex(1.0, 0.0))


@part
def _coefficients(W: Float, p: Float, q: Float, c: Float) -> None:
    """ALPHA and GAMMA for the jump dual to FACTOR c, from a port's columns p and q."""
    cw, ct, cM, cV = c[0], c[1], c[2], c[3]
    for i in range(LANES):
        w1, t1, M1, V1 = get(p, X, i), get(p, X + 2, i), get(p, X + 4, i), get(p, X + 6, i)
        w2, M2, V2 = get(p, X + 8, i), get(p, X + 10, i), get(p, X + 12, i)
        u1, r1, N1, T1 = get(q, X, i), get(q, X + 2, i), get(q, X + 4, i), get(q, X + 6, i)
        u2, N2, T2 = get(q, X + 8, i), get(q, X + 10, i), get(q, X + 12, i)
        # Minus G, as theta and V of Q are mirrored; the two minus signs below cancel it.
        g11 = w1 * T1 + V1 * u1 + t1 * N1 + M1 * r1
        g12 = w1 * T2 + V1 * u2 + t1 * N2
        g21 = w2 * T1 + V2 * u1 + M2 * r1
        g22 = w2 * T2 + V2 * u2
        f = get(W, FACTOR, i) * inverse(g11 * g22 - g12 * g21)
        p1 = scaled(w1, cw) + scaled(t1, ct) + scaled(M1, cM) + scaled(V1, cV)
        p2 = scaled(w2, cw) + scaled(M2, cM) + scaled(V2, cV)
        q1 = scaled(u1, cw) - scaled(r1, ct) + scaled(N1, cM) - scaled(T1, cV)
        q2 = scaled(u2, cw) + scaled(N2, cM) - scaled(T2, cV)
        put(W, GAMMA, i, f * (g22 * p1 - g12 * p2))
        put(W, GAMMA + 2, i, f * (g11 * p2 - g21 * p1))
        put(W, ALPHA, i, f * (g22 * q1 - g21 * q2))
        put(W, ALPHA + 2, i, f * (g11 * q2 - g12 * q1))


@part
def _carry(c: Float, kind: int, change: Float) -> None:
    """The two coefficients c (4 rows), from behind an element to before it."""
    if kind in (SPRING, HINGE):
        for i in range(LANES):
            a, b = get(c, 0, i), get(c, 2, i)
            flag = change[(FLAG - B) * LANES + i]
            keep = 1.0 - flag
            a = scaled(a - get(change, RHO - B, i) * b, change[(SCALE - B) * LANES + i])
            put(c, 0, i, scaled(a, keep) - scaled(b, flag))
            put(c, 2, i, scaled(b, keep) + scaled(a, flag))
    else:
        for i in range(LANES):
            a, b = get(c, 0, i), get(c, 2, i)
            put(c, 0, i, get(change, 0, i) * a + get(change, 2, i) * b)
            put(c, 2, i, get(change, 4, i) * a + get(change, 6, i) * b)


@part
def solve(x: System, k: Work, port: int, c: Float, low: int, high: int, wanted: Flag) -> None:
    """The coefficients at the wanted ports for the jump at `port` dual to FACTOR c^T z.

    alphas from the port down to `low`, gammas from it up to `high`.
    """
    W = k.W
    _coefficients(W, k.columns_p[port], k.columns_q[port], c)
    alpha = W[ALPHA * LANES : (ALPHA + 4) * LANES]
    gamma = W[GAMMA * LANES : (GAMMA + 4) * LANES]
    if wanted[port]:
        store(k.alphas[port], W, ALPHA, 4)
        store(k.gammas[port], W, GAMMA, 4)
    for e in range(port - 1, low - 1, -1):
        if x.kinds[e] >= SPRING:
            _carry(alpha, x.kinds[e], k.changes_p[e])
        if wanted[e]:
            store(k.alphas[e], W, ALPHA, 4)
    for e in range(port, high):
        if x.kinds[e] >= SPRING:
            _carry(gamma, x.kinds[e], k.changes_q[e])
        if wanted[e + 1]:
            store(k.gammas[e + 1], W, GAMMA, 4)


@part
def state(W: Float, columns: Float, coefficients: Float, mirrored: bool) -> None:
    """Z = columns times coefficients, with theta and V turned back if mirrored."""
    sign = -1.0 if mirrored else 1.0
    for i in range(LANES):
        a, b = get(coefficients, 0, i), get(coefficients, 2, i)
        put(W, Z, i, get(columns, X, i) * a + get(columns, X + 8, i) * b)
        put(W, Z + 2, i, scaled(get(columns, X + 2, i) * a, sign))
        put(W, Z + 4, i, get(columns, X + 4, i) * a + get(columns, X + 10, i) * b)
        V = get(columns, X + 6, i) * a + get(columns, X + 12, i) * b
        put(W, Z + 6, i, scaled(V, sign))


@part
def moment(W: Float, columns: Float, coefficients: Float) -> None:
    """M alone of `state`."""
    for i in range(LANES):
        a, b = get(coefficients, 0, i), get(coefficients, 2, i)
        put(W, Z + 4, i, get(columns, X + 4, i) * a + get(columns, X + 10, i) * b)


@part
def port_state(k: Work, port: int, jump: int, upstream: bool, moment_only: bool) -> None:
    """Z, or M in Z alone, at a port, of the solution with its jump at port `jump`.

    At the jump's own port on its upstream or downstream side.
    """
    mirrored = not (port < jump or (upstream and port == jump))
    columns = k.columns_q[port] if mirrored else k.columns_p[port]
    coefficients = k.gammas[port] if mirrored else k.alphas[port]
    if moment_only:
        moment(k.W, columns, coefficients)
    else:
        state(k.W, columns, coefficients, mirrored)


@part
def _read(W: Float, columns: Float, coefficients: Float, c: Float, mirrored: bool) -> None:
    """Add FACTOR c^T z to OUT."""
    cw, ct, cM = c[0], -c[1] if mirrored else c[1], c[2]
    for i in range(LANES):
        y1 = scaled(get(columns, X, i), cw) + scaled(get(columns, X + 2, i), ct)
        y1 += scaled(get(columns, X + 4, i), cM)
        y2 = scaled(get(columns, X + 8, i), cw) + scaled(get(columns, X + 10, i), cM)
        y = y1 * get(coefficients, 0, i) + y2 * get(coefficients, 2, i)
        put(W, OUT, i, get(W, OUT, i) + y * get(W, FACTOR, i))
    cV = -c[3] if mirrored else c[3]
    if cV != 0.0:  # only at the root of a branch
        for i in range(LANES):
            y = get(columns, X + 6, i) * get(coefficients, 0, i)
            y += get(columns, X + 12, i) * get(coefficients, 2, i)
            put(W, OUT, i, get(W, OUT, i) + scaled(y, cV) * get(W, FACTOR, i))


@part
def read_sensors(x: System, f: Factors, k: Work, source: int, answers: Float, start: int) -> None:
    """answers (n_sensor, 2 LANES): every sensor's answer to the solved source (K = 1)."""
    W = k.W
    jump = x.source[source, 0]
    t = 0
    for sensor in range(x.feed.shape[0]):
        feed = x.feed[sensor, source]
        if feed != 0.0:
            set_factor(W, f.drive[source], start)
        for i in range(2 * LANES):
            W[OUT * LANES + i] = W[FACTOR * LANES + i] * feed
        while t < x.term.shape[0] and x.term[t, 0] == sensor:
            port = x.term[t, 1]
            set_term_factor(x, f.jump, W, t, start)
            mirrored = port > jump
            columns = k.columns_q[port] if mirrored else k.columns_p[port]
            coefficients = k.gammas[port] if mirrored else k.alphas[port]
            _read(W, columns, coefficients, x.term_c[t], mirrored)
            t += 1
        store(answers[sensor], W, OUT, 2)
