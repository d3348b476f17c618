"""The lines of all pieces by frequency, beside what a change of the response does in each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from samii_rig.likelihood.algebra import by_input
from samii_rig.likelihood.contour import Contour
from samii_rig.likelihood.leak import columns
from samii_rig.likelihood.records import Records
from samii_rig.likelihood.seen import Seen
from samii_rig.types import Complex, Float, Int


@dataclass(frozen=True, slots=True)
class Rows:
    """Lines of all pieces by frequency, each in units of the root of its record's power.

    X : of each piece (n_i, 2 b) what a change on the nodes does in its lines, (n_i, 2 b m) of m
    inputs; none where none is asked for. e : (n, q) what the reference leaves.
    N : of each piece (n_i, q, m_i) the nuisances of its lines; prior : (m_i,) as of `Seen`.
    f : (n,) Hz. k : (n,) numbers of the lines. piece : (n,) which.
    order : (n,) of the lines of all pieces, one after the other, which these are.
    """

    X: Sequence[Complex]
    e: Complex
    N: Sequence[Complex]
    prior: Sequence[Float]
    f: Float
    k: Int
    piece: Int
    order: Int

    def take(self, which: NDArray[np.bool_]) -> Rows:
        """Some of the lines."""
        if which.all():
            return self
        X, N = (
            [one[which[self.piece == i]] for i, one in enumerate(each)] for each in (self.X, self.N)
        )
        return Rows(
            X, self.e[which], N, self.prior, self.f[which], self.k[which],
            self.piece[which], self.order[which],
        )  # fmt: skip

    def each(self) -> list[tuple[Int, Complex, Float]]:
        """Of each piece its lines, and their nuisances with `prior`."""
        every = (
            (np.flatnonzero(self.piece == i), N, prior)
            for i, (N, prior) in enumerate(zip(self.N, self.prior, strict=True))
        )
        return [one for one in every if one[0].size]

    def changes(self) -> Iterator[tuple[Int, Complex]]:
        """Of each piece its lines, and what changes do in them."""
        every = ((np.flatnonzero(self.piece == i), X) for i, X in enumerate(self.X))
        return ((on, X) for on, X in every if on.size)


def rows_of(records: Records, changes: Sequence[Complex], seen: Sequence[Seen]) -> Rows:
    """changes : of each piece what one on the nodes does; none where none is asked for."""
    lines = [records.lines(p) for p in records.pieces]
    size = [x.k.size for x in lines]
    order = np.argsort(np.concatenate([x.frequency for x in lines]), kind="stable")
    # Where each line of each piece stands.
    place = np.split(np.argsort(order), np.cumsum(size)[:-1])
    n, q = order.size, seen[0].e.shape[1]
    e, f = np.zeros((n, q), complex), np.zeros(n)
    k, which = np.zeros(n, np.int64), np.zeros(n, np.int64)
    for i, on in enumerate(place):
        e[on], f[on], k[on], which[on] = seen[i].e, lines[i].frequency, lines[i].k, i
    N, prior = [s.N for s in seen], [s.prior for s in seen]
    return Rows(changes, e, N, prior, f, k, which, order)


def changes_of(records: Records, contour: Contour, nodes: Int) -> list[Complex]:
    """Of each piece (n_lines, 2 n_nodes), in units of the root of its record's power, of several
    inputs one beside the other; those of one shape are computed together."""
    out: dict[int, Complex] = {}
    shapes = [
        (p.history, len(p.z), band) for p, band in zip(records.pieces, records.bands, strict=True)
    ]
    for shape in set(shapes):
        own = [i for i, s in enumerate(shapes) if s == shape]
        X = [contour.damped(r) for i in own for r in by_input(records.pieces[i].r)]
        lines = records.lines(records.pieces[own[0]])
        both = columns(contour, np.stack(X), nodes, *shape[:2], lines.k)
        m = len(both) // len(own)
        for j in records.undriven:
            both[j::m] = 0.0
        both *= 1 / np.sqrt(shape[1])
        for j, i in enumerate(own):
            out[i] = both[j] if m == 1 else np.concatenate(both[j * m : (j + 1) * m], axis=1)
    return [out[i] for i in range(len(records.pieces))]
