"""What a model leaves of every record, whitened, by piece: what repeats differ by, too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from samii_rig.likelihood.algebra import Shrinking, as_complex, as_real
from samii_rig.likelihood.form import Reduced
from samii_rig.likelihood.pieces import Loops
from samii_rig.likelihood.records import Records, Response
from samii_rig.types import Complex, Float, Int

# Parts of the lines in each of which what is added does as much, and what it may be off by in one:
# the laws of both plants are by less than this part of what they do.
EVEN_PARTS, INEXACT = 8, 0.1


@dataclass(frozen=True, slots=True)
class Unexplained:
    """Of one piece.

    k : (n,) its lines. root : (n, q, q) what whitens them: real and imaginary parts of variance 1.
    white : (1 + repeats, n, q) what the model leaves of the piece, and what its repeats differ by,
        nuisances at their best.
    rounded : (offsets, n, q) of each sensor that nothing dithers the same of its rounding, wherever
        it stands in its step; of none where that was not asked for.
    """

    k: Int
    root: Complex
    white: Complex
    rounded: Mapping[int, Complex] = field(default_factory=dict)

    @property
    def pull(self) -> Complex:
        """(1 + repeats, n, q) so that the real part of conj(d) pull, summed up, is how far a change
        d (n, q) of the lines lies along what is left."""
        return np.asarray(np.einsum("nji,rnj->rni", self.root.conj(), self.white))


def unexplained(
    records: Records,
    response: Response,
    noise: Reduced,
    loop: Loops = (),
    *,
    rounded: bool = False,
) -> list[Unexplained]:
    """Of every piece. noise : as of these records. rounded : whether what rounding may do is asked
    for too."""
    exact = records.exact()
    H = response(exact.s)
    records = records.without_spikes(H)
    out = []
    for i, (piece, seen) in enumerate(
        zip(records.pieces, records.seen(H, loop, response), strict=True)
    ):
        lines = records.lines(piece)
        own_piece = np.full(lines.k.size, i)
        root = np.sqrt(2) * np.linalg.inv(noise.noise.root(lines.frequency, own_piece))
        each = [seen.e, *(records.residual(x, lines.k, H, exact) for x in piece.repeats)]
        each = [
            e + noise.noise.cover(lines.frequency, own_piece, lines.k, j)
            for j, e in enumerate(each)
        ]
        N = (root @ seen.N).reshape(-1, seen.N.shape[2])
        beside = Shrinking.of(as_real(N), seen.prior)

        def white(e: Complex, root: Complex = root, beside: Shrinking = beside) -> Complex:
            """(m, n, q) whitened, nuisances at their best."""
            goal = as_real((root @ e[..., None]).reshape(len(e), -1).T)
            return as_complex(beside.left(goal)).T.reshape(e.shape)

        own = {}
        for c, draws in seen.rounding.draws.items() if rounded else ():
            own[c] = np.zeros((*draws.shape, seen.e.shape[1]), complex)
            own[c][:, :, c] = draws
            own[c] = white(own[c])
        out.append(Unexplained(lines.k, root, white(np.stack(each)), own))
    return out


def as_rounding(before: Sequence[Unexplained], after: Sequence[Unexplained]) -> float:
    """Power of the noise along what one model has that another lacks, in units of its estimate,
    1 at least: the rounding of a motion of few steps repeats as the motion does, and has more there
    than noise that is independent from line to line."""
    along: dict[int, Float] = {}
    independent = size = 0.0
    for a, b in zip(before, after, strict=True):
        d = a.white[0] - b.white[0]
        size += float(np.sum(np.abs(d) ** 2))
        for c, draws in a.rounded.items():
            each = np.sum(d.conj() * draws, axis=2)
            along[c] = along.get(c, 0.0) + np.sum(each.real, axis=1)
            independent += float(np.sum(np.abs(each) ** 2)) / (2 * len(each))
    shows = sum(float(np.mean(x**2)) for x in along.values())
    return 1 + max(shows - independent, 0.0) / size if size > 0 else 1.0


def evenly(
    before: Sequence[Unexplained],
    after: Sequence[Unexplained],
    samples: Sequence[int],
    times: float = 1.0,
) -> float:
    """The chance that chi-square falls as unevenly where a model has what another lacks.

    A change d of whitened lines that is right makes it fall by |d|^2 in the mean, with a standard
    deviation of 2 |d|: in each part of the lines, not in some alone. samples : of each piece.
    times : power of what is left after, in units of the noise.
    """
    fall, square, f = [], [], []
    for a, b, n in zip(before, after, samples, strict=True):
        fall.append(np.sum(np.abs(a.white) ** 2 - np.abs(b.white) ** 2, axis=(0, 2)))
        square.append(np.sum(np.abs(a.white - b.white) ** 2, axis=(0, 2)))
        f.append(a.k / n)
    order = np.argsort(np.concatenate(f))
    gain, p = (np.concatenate(x)[order] for x in (fall, square))
    ends = np.searchsorted(np.cumsum(p), np.sum(p) * np.arange(1, EVEN_PARTS) / EVEN_PARTS)
    gain, p = (np.add.reduceat(x, np.unique(np.append(0, ends))) for x in (gain, p))
    variance = 4 * p * max(times, 1.0) + (INEXACT * p) ** 2
    off = float(np.sum((gain - p)[p > 0] ** 2 / variance[p > 0]))
    return float(stats.chi2.sf(off, EVEN_PARTS))
