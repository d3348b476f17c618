"""What a model leaves of every record, whitened, by piece: what repeats differ by, too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.likelihood.pieces import Loops
from samii_rig.likelihood.reduce import (
    Records,
    Reduced,
    Response,
    as_complex,
    as_real,
    orthonormal,
)
from samii_rig.types import Complex, Int


@dataclass(frozen=True, slots=True)
class Unexplained:
    """Of one piece.

    k : (n,) its lines. root : (n, q, q) what whitens them: real and imaginary parts of variance 1.
    white : (1 + repeats, n, q) what the model leaves of the piece, and what its repeats differ by,
        nuisances at their best.
    """

    k: Int
    root: Complex
    white: Complex

    @property
    def pull(self) -> Complex:
        """(1 + repeats, n, q) so that the real part of conj(d) pull, summed up, is how far a change
        d (n, q) of the lines lies along what is left."""
        return np.asarray(np.einsum("nji,rnj->rni", self.root.conj(), self.white))


def unexplained(
    records: Records, response: Response, noise: Reduced, loop: Loops = ()
) -> list[Unexplained]:
    """Of every piece. noise : as of these records."""
    exact = records.exact()
    H = response(exact.s)
    records = records.without_spikes(H)
    out = []
    for i, (piece, seen) in enumerate(zip(records.pieces, records.seen(H, loop), strict=True)):
        lines = records.lines(piece)
        root = np.sqrt(2) * np.linalg.inv(
            noise.noise.root(lines.frequency, np.full(lines.k.size, i))
        )
        N = (root @ seen.N).reshape(-1, seen.N.shape[2])
        Q = orthonormal(as_real(N))
        white = []
        for e in (seen.e, *(records.left(x, lines.k, H, exact) for x in piece.repeats)):
            goal = as_real((root @ e[:, :, None]).ravel())
            white.append(as_complex(goal - Q @ (Q.T @ goal)).reshape(e.shape))
        out.append(Unexplained(lines.k, root, np.stack(white)))
    return out
