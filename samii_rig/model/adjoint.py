"""Gradients of one block by the adjoint: see `solve` for the duals, `gradient` for the elements."""

from __future__ import annotations

from samii_rig.model.block import recall_beam
from samii_rig.model.gradient import contributions, integrals
from samii_rig.model.lanes import LANES, get, inverse, part, scaled, store
from samii_rig.model.registers import (
    BEAM_KIND,
    COMPLIANCE,
    RESULT,
    SPRING,
    Flag,
    S,
    System,
    Work,
    Z,
)
from samii_rig.model.solve import port_state
from samii_rig.types import Complex, Float, Int


@part
def element_states(x: System, k: Work, elements: Flag, jump: int, more: bool, out: Float) -> None:
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


@part
def _scatter(W: Float, slot: Int, K: float, n: int, target: Complex) -> None:
    for m in range(5):
        if slot[m] >= 0:
            for i in range(n):
                target[i, slot[m]] += scaled(get(W, RESULT + 2 * m, i), K)


@part
def source_parameters(
    x: System, W: Float, source: int, answers: Float, slot: Int, n: int, dH: Complex
) -> None:
    """dH/dK and dH/dp of a source from the answers to p/(s (s + p))."""
    e, actuator = x.source[source, 0], x.source[source, 1]
    K, p = x.pars[e, 0], x.pars[e, 1]
    for i in range(n):
        s = get(W, S, i)
        lag = scaled(s * inverse(complex(s.real + p, s.imag)), K / p)
        for j in range(answers.shape[0]):
            y = complex(answers[j, i], answers[j, LANES + i])
            if slot[0] >= 0:
                dH[i, j, actuator, slot[0]] += y
            if slot[1] >= 0:
                dH[i, j, actuator, slot[1]] += y * lag


@part
def element_parameters(
    x: System, k: Work, elements: Flag, slots: Int, z: Float, zh: Float, n: int, dH: Complex
) -> None:
    """Add the derivatives by the parameters of all elements but sources to dH."""
    for e in range(x.kinds.shape[0]):
        if not elements[e]:
            continue
        if x.kinds[e] == BEAM_KIND:
            recall_beam(k, e)
            integrals(k.W, k.regimes[e])
        for j in range(x.feed.shape[0]):
            direct = 0.0
            for t in range(x.term.shape[0]):
                if x.term[t, 0] == j and x.term[t, 2] == COMPLIANCE and x.term[t, 3] == e:
                    direct += x.term_c[t, 2]
            for source in range(x.source.shape[0]):
                contributions(
                    k.W, x.kinds[e], x.pars[e], k.regimes[e], direct, z[source, e], zh[j, e]
                )
                K = x.pars[x.source[source, 0], 0]
                _scatter(k.W, slots[e], K, n, dH[:, j, x.source[source, 1]])
