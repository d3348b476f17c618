"""What moved the rig before each piece, as far as its lines show that: see `past`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from samii_rig.likelihood.algebra import as_complex, as_real, root_of
from samii_rig.likelihood.form import weights
from samii_rig.likelihood.free import Free, Group
from samii_rig.likelihood.noise import Noise
from samii_rig.likelihood.past import shown
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
    last = sum(before.shape[2] for before, _ in blocks)
    m, q, p = last + sum(beside.shape[2] for _, beside in blocks), e.shape[1], len(group.square)
    along, first = np.zeros((p, q, m + 1)), 0  # the change of each shape, and of the lines
    every = []
    for on, X, (before, beside) in zip(group.on, group.X, blocks, strict=True):
        place = np.r_[first : first + before.shape[2], last : last + beside.shape[2], m]
        first, last = first + before.shape[2], last + beside.shape[2]
        shapes = np.concatenate([before, beside, e[on, :, None]], axis=2)
        along[:, :, place] += (X.T @ as_real(shapes.reshape(len(on), -1))).reshape(p, q, -1)
        every.append((on, X, place, shapes))
    root = root_of(group.square)
    change = (root @ (root.T @ along.reshape(p, -1))).reshape(p, -1)
    both = np.zeros((m, m + 1))
    for on, X, place, shapes in every:
        beyond = as_complex(X @ -change).reshape(len(on), q, m + 1)
        beyond[:, :, place] += shapes
        flat = (W[on] @ beyond).reshape(-1, m + 1)
        both += (beyond.reshape(-1, m + 1)[:, :m].conj().T @ flat).real
    return shown(both[:, :m], both[:, m], sum(before.shape[2] for before, _ in blocks))
