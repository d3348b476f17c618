"""What moved the rig before each piece, as far as its lines show that: see `past`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from samii_rig.likelihood.algebra import as_complex, as_real, orthonormal
from samii_rig.likelihood.form import products, weights
from samii_rig.likelihood.free import Free
from samii_rig.likelihood.noise import Noise
from samii_rig.likelihood.past import likely, shown
from samii_rig.likelihood.records import Records
from samii_rig.likelihood.seen import Seen
from samii_rig.types import Complex, Float, Int


def with_past(records: Records, change: Free, seen: Sequence[Seen], noise: Noise) -> Records | None:
    """The same records, with what moved the rig before each piece as far as its lines show that,
    whatever the change of the response is; None where nothing did."""
    W = weights(change.rows, noise)
    pieces = list(records.pieces)
    for which, on, X in change.groups:
        own = [(i, seen[i]) for i in which]
        group = change.rows.piece[on]
        blocks = []
        for i, s in own:
            before = s.past.likely / math.sqrt(len(pieces[i].z))  # lines are a sample's
            blocks.append((np.flatnonzero(group == i), before, s.N[:, :, s.beside]))
        found = _past_of(orthonormal(X), blocks, change.rows.e[on], W[on])
        if found is None:
            continue
        for i, s in own:
            amplitudes, found = np.split(found, [s.past.impulses.shape[1]])
            if s.past.begins(s.left, amplitudes):
                pieces[i] = s.past.before(pieces[i], amplitudes)
    if all(a is b for a, b in zip(pieces, records.pieces, strict=True)):
        return None
    return replace(records, pieces=tuple(pieces))


def _past_of(
    Q: Float, blocks: Sequence[tuple[Int, Complex, Complex]], e: Complex, W: Complex
) -> Float | None:
    """The amplitudes of what moved the rig before pieces that share one change, as `past.likely`.

    Q : (2 n, p) directions of the change, of each sensor. blocks : of each piece its lines, the
    shapes of what was before, and those beside them. e : (n, q) lines. W : as of `likely`.
    """
    if len(blocks) == 1:
        ((_, before, beside),) = blocks
        return likely(_beyond(Q, before), _beyond(Q, e[:, :, None])[:, :, 0], _beyond(Q, beside), W)
    # Side by side the shapes of many pieces would be many times as much as all lines: of each its
    # products, and what all lose to the change by its p directions.
    n, q = e.shape
    We = (W @ e[:, :, None])[:, :, 0]
    K, pull = products(as_complex(Q), W, We)

    def along(at: Int, x: Complex) -> Float:
        """(q p, m) of lines x (k, q, m) along the change."""
        there = Q[np.concatenate([at, n + at])].T
        return np.concatenate([there @ as_real(x[:, c]) for c in range(q)])

    last = sum(before.shape[2] for _, before, _ in blocks)
    m = last + sum(beside.shape[2] for _, _, beside in blocks)
    square, head, first = np.zeros((m, m)), np.zeros(m), 0
    B, T = np.zeros((len(K), m)), np.zeros((len(K), m))
    for at, before, beside in blocks:
        A = np.concatenate([before, beside], axis=2)
        place = np.r_[first : first + before.shape[2], last : last + beside.shape[2]]
        first, last = first + before.shape[2], last + beside.shape[2]
        WA, flat = W[at] @ A, A.reshape(-1, A.shape[2]).conj().T
        square[np.ix_(place, place)] = (flat @ WA.reshape(-1, A.shape[2])).real
        head[place] = (flat @ We[at].ravel()).real
        B[:, place], T[:, place] = along(at, A), along(at, WA)
    square += B.T @ (K @ B) - T.T @ B - B.T @ T
    own = along(np.arange(n), e[:, :, None])[:, 0]
    head += B.T @ (K @ own - pull) - T.T @ own
    return shown(square, head, sum(before.shape[2] for _, before, _ in blocks))


def _beyond(Q: Float, x: Complex) -> Complex:
    """Lines (n, q, m) less what is along directions Q (2 n, p) of each sensor."""
    flat = as_real(x.reshape(len(x), -1))
    return as_complex(flat - Q @ (Q.T @ flat)).reshape(x.shape)
