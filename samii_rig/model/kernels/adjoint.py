"""Gradients of one block by the adjoint: see `solve` for the duals, `gradient` for the elements."""

from __future__ import annotations

from samii_rig.model.kernels.block import recall_beam
from samii_rig.model.kernels.gradient import contributions, integrals, point
from samii_rig.model.kernels.lanes import LANES, get, part, scaled, store
from samii_rig.model.kernels.registers import (
    BEAM_KIND,
    COMPLIANCE,
    HINGE,
    JUMP,
    RESULT,
    SPRING,
    WAVES,
    Flag,
    Span,
    States,
    System,
    Work,
    Z,
)
from samii_rig.model.kernels.solve import port_state
from samii_rig.types import Complex, Float, Int


@part
def element_states(x: System, k: Work, elements: Flag, jump: int, more: bool, out: Float) -> None:
    """Set or add to out[e] the state behind element e (of a spring M alone), and for a beam or
    waves also before it."""
    for e in range(x.kinds.shape[0]):
        if elements[e]:
            only = x.kinds[e] in (SPRING, HINGE)
            port_state(k, e + 1, jump, True, only)
            if only:
                _keep(out[e, 4 * LANES : 6 * LANES], k.W[(Z + 4) * LANES :], 2, more)
            else:
                _keep(out[e], k.W[Z * LANES :], 8, more)
            if x.kinds[e] >= BEAM_KIND:
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
def _scatter_point(
    W: Float, slope: Complex, slot: Int, K: float, span: Span, target: Complex
) -> None:
    for m in range(slot.shape[0]):
        if slot[m] >= 0:
            for i in range(span.n):
                target[i, slot[m]] += scaled(get(W, RESULT, i) * slope[m, span.start + i], K)


@part
def source_parameters(
    actuator: int, slopes: Complex, answers: Float, slot: Int, span: Span, dH: Complex
) -> None:
    """dH by the parameters of a source and its line from the answers to f; slopes (n_par, n)."""
    for m in range(slopes.shape[0]):
        if slot[m] >= 0:
            for i in range(span.n):
                relative = slopes[m, span.start + i]
                for j in range(answers.shape[0]):
                    y = complex(answers[j, i], answers[j, LANES + i])
                    dH[i, j, actuator, slot[m]] += y * relative


@part
def element_parameters(
    x: System,
    jump_d: Complex,
    k: Work,
    slots: Int,
    states: States,
    span: Span,
    dH: Complex,
) -> None:
    """Add the derivatives by the parameters of all elements but sources and waves to dH."""
    elements, z, zh = states.elements, states.z, states.zh
    for e in range(x.kinds.shape[0]):
        kind = x.kinds[e]
        if not elements[e] or kind == WAVES:
            continue
        if kind == BEAM_KIND:
            recall_beam(k, e)
            integrals(k.W, k.regimes[e])
        for j in range(x.feed.shape[0]):
            direct = 0.0
            for t in range(x.term.shape[0]):
                if x.term[t, 0] == j and x.term[t, 2] == COMPLIANCE and x.term[t, 3] == e:
                    direct += x.term_c[t, 2]
            for source in range(x.source.shape[0]):
                target = dH[:, j, x.source[source, 1]]
                K = x.source_c[source, 4]
                if kind in (HINGE, JUMP):
                    point(k.W, x.place[e, 0], direct, z[source, e], zh[j, e])
                    _scatter_point(k.W, jump_d[x.place[e, 1]], slots[e], K, span, target)
                else:
                    contributions(
                        k.W, kind, x.pars[e], k.regimes[e], direct, z[source, e], zh[j, e]
                    )
                    _scatter(k.W, slots[e], K, span.n, target)


@part
def keep_waves(x: System, elements: Flag, z: Float, span: Span, target: Complex) -> None:
    """target[row, start:, :, solution]: the states behind and before every WAVES."""
    for e in range(x.kinds.shape[0]):
        if elements[e] and x.kinds[e] == WAVES:
            for solution in range(z.shape[0]):
                for m in range(8):
                    for i in range(span.n):
                        target[x.place[e, 1], span.start + i, m, solution] = get(
                            z[solution, e], 2 * m, i
                        )
