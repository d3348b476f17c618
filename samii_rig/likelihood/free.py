"""What a change of the response that is free leaves of all lines: there the noise is seen.

Pieces, repeats and levels that differ by more than noise are not noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.likelihood import rounding
from samii_rig.likelihood.algebra import AT_ONCE, as_complex, as_real, lengths, root_of, spanned
from samii_rig.likelihood.noise import Noise
from samii_rig.likelihood.pieces import Piece, Samples
from samii_rig.likelihood.records import Records
from samii_rig.likelihood.rows import Rows
from samii_rig.likelihood.seen import Seen
from samii_rig.types import Complex, Float, Int

ENOUGH = 0.75  # lines over unknowns of a change, from which a piece shows its noise by itself
# Of an input's largest in any piece, what it does in one that it does not excite: where noise is
# told no change of its response is free there, which would fit that with its converter's rounding.
RESTS = 0.01


@dataclass(frozen=True, slots=True)
class Group:
    """Pieces that share one change that is free.

    pieces : their numbers. on : (n_i,) of each its lines. X : (2 n_i, p) of each, what the change
    does in these, of every sensor, a column of size 1 in all of them together. square : (p, p)
    products of X.
    """

    pieces: Sequence[int]
    on: Sequence[Int]
    X: Sequence[Float]
    square: Float

    @classmethod
    def of(cls, pieces: Sequence[int], on: Sequence[Int], X: Sequence[Float]) -> Group:
        """X : of any size; it is changed."""
        square = np.asarray(sum(own.T @ own for own in X))
        size = np.sqrt(np.diagonal(square))
        over = 1 / np.where(size > 0, size, 1.0)
        for own in X:
            own *= over
        return cls(pieces, on, X, square * np.outer(over, over))


@dataclass(frozen=True, slots=True)
class Free:
    """A change that is free where noise is estimated, and the lines that show it together: each
    piece's by themselves where they are enough. rows : of all lines."""

    rows: Rows
    groups: list[Group]

    @classmethod
    def of(cls, rows: Rows, changes: Sequence[Complex], spare: Float) -> Free:
        """changes : of each piece, as `changes_of`. spare : (b, m) the change that is free, on the
        nodes."""
        b = len(spare)
        parts = range(0, rows.X[0].shape[1], b)
        each = []
        for change in changes:
            real = as_real(change)
            each.append(np.concatenate([real[:, i : i + b] @ spare for i in parts], axis=1))
        if len(parts) > 2:
            _excited(each, len(parts) // 2)
        pieces = [on for on, *_ in rows.each()]
        if all(len(on) >= ENOUGH * _free(X) for on, X in zip(pieces, each, strict=True)):
            alone = zip(pieces, each, strict=True)
            return cls(rows, [Group.of([i], [on], [X]) for i, (on, X) in enumerate(alone)])
        return cls(rows, [Group.of(range(len(each)), pieces, each)])


def residual_of(change: Free, seen: Sequence[Seen]) -> tuple[Complex, Float]:
    """What the best change of each sensor in each piece leaves (n, q), and the freedom (n,) that
    each line has left: pieces that differ by more than noise are not noise.

    Nuisances are projected out piece by piece: side by side those of many pieces would be many
    times as much as all lines.
    """
    n, q = change.rows.e.shape
    left, used = np.zeros((n, q), complex), np.zeros(n)
    for group in change.groups:
        for c in range(q):
            _leave(group, change.rows.e[:, c], [seen[i].N[:, c] for i in group.pieces],
                   left[:, c], used)  # fmt: skip
    return left, np.maximum(1 - used / (2 * q), 0.0)


def _leave(group: Group, e: Complex, N: Sequence[Complex], left: Complex, used: Float) -> None:
    """Note in `left` (n,) what the best change leaves of one sensor's lines e (n,), and add to
    `used` (n,) the freedom that this takes. N : of each piece its nuisances (n_i, m)."""
    beside = [spanned(_nuisances_of(own)) for own in N]
    across = [Q.T @ X for Q, X in zip(beside, group.X, strict=True)]
    goals = [as_real(e[on]) for on in group.on]
    goals = [goal - Q @ (Q.T @ goal) for goal, Q in zip(goals, beside, strict=True)]
    root = root_of(group.square - sum(own.T @ own for own in across))
    along = sum(X.T @ goal for X, goal in zip(group.X, goals, strict=True))
    best = root @ (root.T @ along)
    for on, X, goal, Q, own in zip(group.on, group.X, goals, beside, across, strict=True):
        left[on] = as_complex(goal - X @ best + Q @ (own @ best))
        taken = lengths(Q)
        for first in range(0, len(X), 2 * AT_ONCE):  # real and imaginary parts
            some = slice(first, first + 2 * AT_ONCE)
            taken[some] += lengths(X[some] @ root - Q[some] @ (own @ root))
        used[on] += taken[: len(on)] + taken[len(on) :]


def _excited(each: Sequence[Float], inputs: int) -> None:
    """Take out of what changes do in each piece (2 n, p) what those of an input do that rests in
    it."""
    parts = [X.reshape(len(X), inputs, -1) for X in each]
    size = np.sqrt([np.mean(np.sum(X**2, axis=2), axis=0) for X in parts])
    for X, rests in zip(parts, size < RESTS * size.max(axis=0), strict=True):
        X[:, rests] = 0.0


def _free(X: Float) -> int:
    """Columns that do anything."""
    return int(np.count_nonzero(np.any(X != 0, axis=0)))


def _nuisances_of(N: Complex) -> Float:
    """(2 n, m) those of (n, m_all) that there are in one sensor, of size 1."""
    some = as_real(N[:, np.any(N != 0, axis=0)])
    return np.asarray(some / np.linalg.norm(some, axis=0))


def with_repeats(
    records: Records, H: Complex, seen: Sequence[Seen], rows: Rows, left: Complex, free: Float
) -> tuple[Float, Complex, Float, Int]:
    """Frequency, lines, freedom and piece of all that the noise is estimated from: what repeats
    differ by, too."""
    every = [(rows.f, left, free, rows.piece)]
    for i, (piece, own) in enumerate(zip(records.pieces, seen, strict=True)):
        if np.any(rounding.alike(piece, records.step) > rounding.ALIKE):
            continue
        for f, e, some in _beside(records, piece, piece.repeats, H, own):
            every.append((f, e, some, np.full(f.size, i)))
    f, left, free, which = (np.concatenate(x) for x in zip(*every, strict=True))
    order = np.argsort(f, kind="stable")
    return f[order], left[order], free[order], which[order]


def _beside(
    records: Records, piece: Piece, others: Sequence[Samples], H: Complex, own: Seen
) -> list[tuple[Float, Complex, Float]]:
    """Of the repeats or contrasts of a piece: Hz (n,), what H leaves without nuisances (n, q), and
    the freedom left (n,)."""
    if not others:
        return []
    lines, exact = records.lines(piece), records.exact()
    left = np.stack([records.residual(samples, lines.k, H, exact) for samples in others], axis=2)
    left, free = _without(left, own.N)
    return [(lines.frequency, left[:, :, i], free) for i in range(len(others))]


def scatter(records: Records, H: Complex, seen: Sequence[Seen], noise: Noise) -> Float:
    """(q,) power of repeats against each other over that of the noise, most of both where that is
    largest; nan where nothing was repeated."""
    power, mean = np.zeros((2, H.shape[1] // records.pieces[0].inputs))
    for i, (piece, own) in enumerate(zip(records.pieces, seen, strict=True)):
        every = _beside(records, piece, piece.repeats, H, own)
        if every:
            f, _, free = every[0]  # of one piece all repeats have the same
            of = np.full(f.size, i)
            read = ~noise.covered(f, of)
            C = np.diagonal(noise.covariance(f, of), axis1=1, axis2=2).real
            mean += len(every) * (free[read] @ C[read])
            power += sum(np.sum(np.abs(left[read]) ** 2, axis=0) for _, left, _ in every)
    return np.asarray(np.divide(power, mean, out=np.full(mean.size, np.nan), where=mean > 0))


def differing(
    records: Records, H: Complex, seen: Sequence[Seen], noise: Noise
) -> tuple[float, float]:
    """Chi-square of the levels against each other, and its mean."""
    total = count = 0.0
    for i, (piece, own) in enumerate(zip(records.pieces, seen, strict=True)):
        every = _beside(records, piece, piece.contrasts, H, own)
        if every:
            f, k = every[0][0], records.lines(piece).k
            of = np.full(f.size, i)
            first = 1 + len(piece.repeats)
            covered = [  # as much of it as nuisances leave of all noise
                e + np.sqrt(free)[:, None] * noise.cover(f, of, k, j)
                for j, (_, e, free) in enumerate(every, first)
            ]
            white = noise.whitened(f, of, np.stack(covered, axis=2))
            total += 2 * float(np.sum(np.abs(white) ** 2))
            count += 2.0 * white.shape[1] * sum(float(np.sum(free)) for _, _, free in every)
    return total, count


def _without(e: Complex, N: Complex) -> tuple[Complex, Float]:
    """(n, q, p) without nuisances (n, q, m), each sensor's by itself, and the freedom left (n,)."""
    n, q = e.shape[:2]
    out, used = np.zeros_like(e), np.zeros(2 * n)
    for c in range(q):
        Q = spanned(_nuisances_of(N[:, c]))
        goal = as_real(e[:, c])
        goal = goal - Q @ (Q.T @ goal)
        used += lengths(Q)
        out[:, c] = as_complex(goal)
    return out, np.maximum(1 - (used[:n] + used[n:]) / (2 * q), 0.0)
