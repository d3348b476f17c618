"""One block of LANES values of s: the beams' waves, then both sweeps."""

from __future__ import annotations

from samii_rig.model.kernels.basis import boundary
from samii_rig.model.kernels.beam import prepare
from samii_rig.model.kernels.lanes import LANES, get, load, part, put, store
from samii_rig.model.kernels.registers import (
    B_ROWS,
    BEAM,
    BEAM_KIND,
    BEAM_ROWS,
    X_ROWS,
    B,
    Factors,
    Flag,
    S,
    System,
    Work,
    X,
)
from samii_rig.model.kernels.sweep import step
from samii_rig.types import Complex, Float


@part
def set_s(W: Float, s: Complex, first: int) -> int:
    """Fill s and s^2 from s[first:]; the number of lanes in use (the rest repeat the last)."""
    n: int = min(LANES, s.shape[0] - first)
    for i in range(n):
        put(W, S, i, s[first + i])
    for i in range(n, LANES):
        put(W, S, i, s[first + n - 1])
    for i in range(LANES):
        z = get(W, S, i)
        put(W, S + 2, i, z * z)
    return n


@part
def recall_beam(k: Work, e: int) -> None:
    """Bring the rows of beam e back to W; a chain's only beam never leaves it."""
    if k.regimes[-1] > 1:
        load(k.W, BEAM, k.beams[e], BEAM_ROWS)


@part
def block(
    x: System, f: Factors, k: Work, s: Complex, start: int, first: int, last: int, wanted: Flag
) -> int:
    """Sweep s[start:] from the base to port `last` and from the tip to `first`.

    Fills columns_p and columns_q of the wanted ports, changes_p and changes_q of every
    element passed that changes the basis. Returns the number of lanes in use.
    """
    W, n_op = k.W, x.kinds.shape[0]
    n = set_s(W, s, start)
    k.regimes[n_op] = 0
    for e in range(n_op):
        k.regimes[n_op] += x.kinds[e] == BEAM_KIND
    for e in range(n_op):
        if x.kinds[e] == BEAM_KIND:
            p = x.pars[e]
            k.regimes[e] = prepare(W, p[0], p[1], p[2], p[3], p[4])
            if k.regimes[n_op] > 1:
                store(k.beams[e], W, BEAM, BEAM_ROWS)
    for side in range(2):
        mirrored = side == 1
        columns = k.columns_q if mirrored else k.columns_p
        changes = k.changes_q if mirrored else k.changes_p
        boundary(W, x.ends[side])
        for i in range(n_op - first if mirrored else last):
            port = n_op - i if mirrored else i
            if wanted[port]:
                store(columns[port], W, X, X_ROWS)
            e = port - 1 if mirrored else port
            if x.kinds[e] == BEAM_KIND:
                recall_beam(k, e)
            if step(W, x.kinds[e], x.pars[e], x.place[e], f, mirrored, k.regimes[e], start):
                store(changes[e], W, B, B_ROWS)
        port = first if mirrored else last
        if wanted[port]:
            store(columns[port], W, X, X_ROWS)
    return n
