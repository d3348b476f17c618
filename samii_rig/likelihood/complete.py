"""Whole records, and what no change of one linear response explains of them.

`Reduced` keeps of the lines what tells a response. A force that depends on amplitude moves the rest
too: harmonics, and levels against each other. With the whitened lines g, nuisances projected out,
and the whitened columns A = Q C of all changes d on the nodes,

    |g - A d|^2 = |C d - Q' g|^2 + |g - Q Q' g|^2,

the first part that of `Reduced`. A force changes g, and so both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from samii_rig.likelihood.noise import Disturbances
from samii_rig.likelihood.pieces import Loops
from samii_rig.likelihood.reduce import Records, Reduced, Response, Rows, formed, orthonormal
from samii_rig.types import Complex, Float, Int


@dataclass(frozen=True)
class Complete:
    """Chi-square of all lines, split.

    rows : the lines. root : (n, q, q) so that root e has real and imaginary parts of variance 1.
    nuisances : of each piece its lines and orthonormal columns over their real, then imaginary
    parts. factor : (m, m) C.
    """

    reduced: Reduced
    rows: Rows
    root: Complex
    nuisances: tuple[tuple[Int, Float], ...]
    factor: Float

    @classmethod
    def about(
        cls,
        records: Records,
        response: Response,
        disturbances: Disturbances,
        loop: Loops = (),
        part: Callable[[Int], NDArray[np.bool_]] | None = None,
    ) -> Complete:
        """As `reduced`."""
        found, rows = formed(records, response, disturbances, loop, part)
        root = np.sqrt(2) * np.linalg.inv(found.noise.root(rows.f, rows.piece))
        each = [np.flatnonzero(rows.piece == i) for i in np.unique(rows.piece)]
        nuisances = tuple((on, _columns(root[on] @ rows.N[on])) for on in each)
        m = found.factor.shape[0]
        return cls(found, rows, root, nuisances, found.factor.reshape(m, m))

    @property
    def expected(self) -> float:
        """Mean of chi-square."""
        return self.reduced.known + self.reduced.inside[1]

    def split(self, e: Complex) -> Float:
        """(m + 2 n q,) both parts of lines e (n, q), in noise units."""
        g = self.white(e)
        X, q = self.rows.X, e.shape[1]
        back = np.einsum("nji,nj->ni", self.root.conj(), g)
        head = (back.conj().T @ X).real.ravel()
        t = linalg.solve_triangular(self.factor, head, trans="T", check_finite=False)
        d = linalg.solve_triangular(self.factor, t, check_finite=False)
        rest = g - self.white(X @ d.reshape(q, -1).T)
        return np.concatenate([t, rest.real.ravel(), rest.imag.ravel()])

    def joined(self, parts: Float) -> Complex:
        """(n, q, k) of what `split` would make of lines: of slopes or residuals, both `parts`
        (m + 2 n q, k), the whitened lines. Their real products are those of the parts."""
        m, (n, q) = len(self.factor), self.rows.e.shape
        d = linalg.solve_triangular(self.factor, parts[:m], check_finite=False)
        own = self.rows.X @ d.reshape(q, -1, parts.shape[1]).transpose(1, 0, 2).reshape(
            -1, q * parts.shape[1]
        )
        out = self.white(own.reshape(n, q, -1))
        rest = parts[m:].reshape(2, n, q, -1)
        return np.asarray(out + rest[0] + 1j * rest[1])

    def white(self, e: Complex) -> Complex:
        """(n, q) or (n, q, p) whitened, without nuisances."""
        white = self.root @ e.reshape(*e.shape[:2], -1)
        for on, Q in self.nuisances:
            own = white[on].reshape(-1, white.shape[2])
            goal = np.concatenate([own.real, own.imag])
            goal -= Q @ (Q.T @ goal)
            white[on] = (goal[: len(own)] + 1j * goal[len(own) :]).reshape(
                on.size, *white.shape[1:]
            )
        return np.asarray(white.reshape(e.shape), np.complex128)


def _columns(N: Complex) -> Float:
    """(2 n q, m) directions of one piece's nuisances (n, q, m_all)."""
    flat = N.reshape(-1, N.shape[2])
    flat = flat[:, np.any(flat != 0, axis=0)]
    return orthonormal(np.concatenate([flat.real, flat.imag]))
