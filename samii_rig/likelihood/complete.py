"""Whole records, and what no change of one linear response explains of them.

`Reduced` keeps of the lines what determines a response. A force that depends on amplitude moves the
rest too: harmonics, and levels against each other. With the whitened lines g, nuisances projected
out, and the whitened columns A = Q C of all changes d on the nodes,

    |g - A d|^2 = |C d - Q' g|^2 + |g - Q Q' g|^2,

the first part that of `Reduced`. A force changes g, and so both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from samii_rig.likelihood.algebra import Shrinking, as_complex, as_real
from samii_rig.likelihood.form import Reduced
from samii_rig.likelihood.noise import Disturbances
from samii_rig.likelihood.pieces import Loops
from samii_rig.likelihood.records import Records, Response
from samii_rig.likelihood.reduce import formed
from samii_rig.likelihood.rows import Rows
from samii_rig.types import Complex, Float, Int


@dataclass(frozen=True)
class Complete:
    """Chi-square of all lines, split.

    rows : the lines, without `X` and `N`. columns : (2 n, 2 b) real parts of `X`, then imaginary
    ones.
    root : (n, q, q) so that root e has real and imaginary parts of variance 1. nuisances : of each
    piece its lines and what its nuisances leave of their real, then imaginary parts. factor :
    (m, m) C. likely : whether any has a size that is known.
    """

    reduced: Reduced
    rows: Rows
    columns: Float
    root: Complex
    nuisances: tuple[tuple[Int, Shrinking], ...]
    factor: Float
    likely: bool

    @classmethod
    def about(
        cls,
        records: Records,
        response: Response,
        disturbances: Disturbances,
        loop: Loops = (),
        part: Callable[[Int], NDArray[np.bool_]] | None = None,
        own_power: Float | None = None,
    ) -> Complete:
        """As `formed`."""
        found, rows = formed(records, response, disturbances, loop, part, own_power=own_power)
        root = np.sqrt(2) * np.linalg.inv(found.noise.root(rows.f, rows.piece))
        nuisances = tuple((on, _beside(root[on] @ N, prior)) for on, N, prior in rows.each())
        likely = any(prior.any() for prior in rows.prior)
        m = found.factor.shape[0]
        columns = np.empty((2 * rows.f.size, rows.X[0].shape[1]))
        for on, X in rows.changes():
            columns[on], columns[rows.f.size + on] = X.real, X.imag
        rows = replace(rows, X=(), N=(), prior=())
        return cls(found, rows, columns, root, nuisances, found.factor.reshape(m, m), likely)

    @property
    def expected(self) -> float:
        """Mean of chi-square."""
        return self.reduced.known + self.reduced.inside[1]

    def split(self, e: Complex) -> Float:
        """Both parts of lines e (n, q), in noise units, (m + 2 n q,); of several at once, e
        (n, q, p), (m + 2 n q, p)."""
        g = self.white(e.reshape(*e.shape[:2], -1))
        n, q, p = g.shape
        # What is projected out is gone; what is only shrunk counts as in the noise's inverse.
        back = self.root.conj().swapaxes(1, 2) @ (self._without(g.copy()) if self.likely else g)
        head = self.columns.T @ as_real(back.reshape(n, -1))
        head = head.reshape(-1, q, p).swapaxes(0, 1).reshape(-1, p)
        # The factor's rows stand in memory as the columns of a lower triangle: nothing is copied.
        lower = self.factor.T
        t = linalg.blas.dtrsm(1.0, lower, head, lower=1)
        rest = g - self.white(self._lines(linalg.blas.dtrsm(1.0, lower, t, lower=1, trans_a=1)))
        parts = np.concatenate([t, rest.real.reshape(-1, p), rest.imag.reshape(-1, p)])
        return parts if e.ndim == 3 else parts[:, 0]

    def joined(self, parts: Float) -> Complex:
        """(n, q, k) of what `split` would make of lines: of slopes or residuals, both `parts`
        (m + 2 n q, k), the whitened lines. Their real products are those of the parts."""
        m, (n, q) = len(self.factor), self.rows.e.shape
        d = linalg.blas.dtrsm(1.0, self.factor.T, parts[:m], lower=1, trans_a=1)
        rest = parts[m:].reshape(2, n, q, -1)
        return np.asarray(self.white(self._lines(d)) + rest[0] + 1j * rest[1])

    def _lines(self, d: Float) -> Complex:
        """(n, q, p) of changes d (m, p) of the response on the nodes."""
        q, p = self.rows.e.shape[1], d.shape[1]
        flat = d.reshape(q, -1, p).swapaxes(0, 1).reshape(-1, q * p)
        return as_complex(self.columns @ flat).reshape(-1, q, p)

    def white(self, e: Complex) -> Complex:
        """(n, q) or (n, q, p) whitened, without nuisances."""
        white = self._without(self.root @ e.reshape(*e.shape[:2], -1))
        return np.asarray(white.reshape(e.shape), np.complex128)

    def _without(self, white: Complex) -> Complex:
        """Whitened lines (n, q, p) without nuisances, in place."""
        for on, beside in self.nuisances:
            own = white[on].reshape(-1, white.shape[2])
            goal = beside.left(as_real(own))
            white[on] = (goal[: len(own)] + 1j * goal[len(own) :]).reshape(
                on.size, *white.shape[1:]
            )
        return white


def _beside(N: Complex, prior: Float) -> Shrinking:
    """What one piece's nuisances (n, q, m) leave of its lines (2 n q,)."""
    flat = N.reshape(-1, N.shape[2])
    some = np.any(flat != 0, axis=0)
    return Shrinking.of(as_real(flat[:, some]), prior[some])
