"""What moved the rig before each piece, as far as its lines show that: see `past`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from samii_rig.likelihood.algebra import as_complex, as_real, root_of
from samii_rig.likelihood.form import products, weights
from samii_rig.likelihood.free import Free, Group
from samii_rig.likelihood.noise import Noise
from samii_rig.likelihood.past import likely, shown
from samii_rig.likelihood.records import Records
from samii_rig.likelihood.seen import Seen
from samii_rig.types import Complex, Float


def with_past(records: Records, change: Free, seen: Sequence[Seen], noise: Noise) -> Records | None:
    """The same records, with what moved the rig before each piece as far as its lines show that,
    whatever the change of the response is; None where nothing did."""
    W = weights(change.rows, noise)
    pieces = list(records.pieces)
    for group in change.groups:
        blocks = []
        for i in group.pieces:
            before = seen[i].past.likely / math.sqrt(len(pieces[i].z))  # lines are a sample's
            blocks.append((before, seen[i].N[:, :, seen[i].beside]))
        found = _past_of(group, blocks, change.rows.e, W)
        if found is None:
            continue
        for i in group.pieces:
            past = seen[i].past
            amplitudes, found = np.split(found, [past.impulses.shape[1]])
            if past.begins(seen[i].left, amplitudes):
                pieces[i] = past.before(pieces[i], amplitudes)
    if all(a is b for a, b in zip(pieces, records.pieces, strict=True)):
        return None
    return replace(records, pieces=tuple(pieces))


def _past_of(
    group: Group, blocks: Sequence[tuple[Complex, Complex]], e: Complex, W: Complex
) -> Float | None:
    """The amplitudes of what moved the rig before pieces that share one change, as `past.likely`,
    whatever that change is.

    blocks : of each piece the shapes of what was before, and those beside them. e : (n, q) all
    lines. W : as of `past.likely`.
    """
    root = root_of(group.square)
    ways = root @ root.T  # from what is along a change to the change that explains it
    if len(blocks) == 1:
        (at,), (X,), ((before, beside),) = group.on, group.X, blocks

        def beyond(x: Complex) -> Complex:
            """Lines (n, q, m) less what the change of each sensor explains."""
            flat = as_real(x.reshape(len(x), -1))
            return as_complex(flat - X @ (ways @ (X.T @ flat))).reshape(x.shape)

        own = beyond(e[at, :, None])[:, :, 0]
        return likely(beyond(before), own, beyond(beside), W[at])

    # Side by side the shapes of many pieces would be many times as much as all lines: of each its
    # products, and what all lose to the change by its p unknowns.
    def along(X: Float, x: Complex) -> Float:
        """(q, p, m) of lines x (k, q, m) along the change of each sensor."""
        flat = X.T @ as_real(x.reshape(len(x), -1))
        return flat.reshape(len(ways), *x.shape[1:]).swapaxes(0, 1)

    last = sum(before.shape[2] for before, _ in blocks)
    m, q, p = last + sum(beside.shape[2] for _, beside in blocks), e.shape[1], len(ways)
    K, pull = np.zeros((q * p, q * p)), np.zeros(q * p)
    square, head, first = np.zeros((m, m)), np.zeros(m), 0
    B, T, lines = np.zeros((q, p, m)), np.zeros((q, p, m)), np.zeros((q, p, 1))
    for at, X, (before, beside) in zip(group.on, group.X, blocks, strict=True):
        A = np.concatenate([before, beside], axis=2)
        place = np.r_[first : first + before.shape[2], last : last + beside.shape[2]]
        first, last = first + before.shape[2], last + beside.shape[2]
        We = (W[at] @ e[at, :, None])[:, :, 0]
        WA, flat = W[at] @ A, as_real(A.reshape(-1, A.shape[2]))
        square[np.ix_(place, place)] = flat.T @ as_real(WA.reshape(-1, A.shape[2]))
        head[place] = flat.T @ as_real(We.ravel())
        B[:, :, place], T[:, :, place] = along(X, A), along(X, WA)
        lines += along(X, e[at, :, None])
        K_at, pull_at = products(as_complex(X), W[at], We)
        K += K_at
        pull += pull_at
    change, through, best = (ways @ B).reshape(-1, m), T.reshape(-1, m), (ways @ lines).ravel()
    square += change.T @ (K @ change) - through.T @ change - change.T @ through
    head += change.T @ (K @ best - pull) - through.T @ best
    return shown(square, head, sum(before.shape[2] for before, _ in blocks))
