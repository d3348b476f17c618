"""All by which one spring swings, fitted together: frequencies that the records have in common, and
in each record a constant and both phases.

A frequency is told by how a swing comes and goes beside all others and beside the constant, and the
phases are told with the frequency free. So one step of Gauss and Newton is taken in all of them at
once, and its normal equations give the covariance of what is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.fit.intervals import TAIL
from samii_rig.diagnose.forces.varying import ONE_PHASE, PieceModulation
from samii_rig.types import Float

# Angles that are added up: so many for each standard deviation of the best known one, within.
ANGLES, ANGLES_BETWEEN = 16.0, (64, 4096)
# Radii that are added up: at first to so many times the mean, then twice more where they are likely
# by more than a part of the most likely one.
RADII, FARTHEST_RADIUS, FINER, NOTHING = 400, 10.0, 3, 1e-5


@dataclass(frozen=True, slots=True)
class Swings:
    """What is told of m frequencies.

    hz : (m,). changes : of each piece (rows, 1 + 2 m), as `PieceModulation.changes` has them.
    off : (m, m) covariance of the frequencies, Hz^2. own : of each piece (1 + 2 m, 1 + 2 m) that of
    the changes of a row with the frequencies known; along : (rows, 1 + 2 m, m) by how much these
    move with a frequency. left : of chi-square that the last step promised, of each number.
    """

    hz: Float
    changes: tuple[Float, ...]
    off: Float
    own: tuple[Float, ...]
    along: tuple[Float, ...]
    left: float = math.inf

    @classmethod
    def none(cls, rows: Sequence[int]) -> Swings:
        """Nothing varies. rows : of each piece."""
        return cls(
            np.zeros(0),
            tuple(np.zeros((n, 1)) for n in rows),
            np.zeros((0, 0)),
            tuple(np.zeros((1, 1)) for _ in rows),
            tuple(np.zeros((n, 1, 0)) for n in rows),
        )

    def beside(self, hz: float) -> Swings:
        """The same with a frequency more, of which nothing is told yet."""
        more = tuple(np.pad(x, ((0, 0), (0, 2))) for x in self.changes)
        return Swings(np.append(self.hz, hz), more, self.off, self.own, self.along)

    def closer(self, pieces: Sequence[PieceModulation], most: float) -> Swings:
        """A step on, to what the records hold beyond these. most : Hz, of a frequency's step."""
        a, m = 1 + 2 * self.hz.size, self.hz.size
        curvature, slope, each = np.zeros((m, m)), np.zeros(m), []
        for one, x in zip(pieces, self.changes, strict=True):
            G, pull = one.normal(self.hz.tolist(), slopes=True)
            own = np.linalg.pinv(G[:a, :a], rcond=ONE_PHASE**2, hermitian=True)
            found, along = (own @ pull[:a]).T, np.zeros((len(x), a, m))
            # About the best phases: of a frequency that was only now found there are no others.
            for row, D in enumerate(_by_frequency(x + found)):
                K = own @ G[:a, a:] @ D
                curvature += D.T @ (G[a:, a:] @ D - G[a:, :a] @ K)
                slope += D.T @ pull[a:, row] - K.T @ pull[:a, row]
                along[row] = K
            each.append((own, along, found, pull[:a]))
        size = np.sqrt(np.diag(curvature))
        size = np.where(size > 0, size, 1.0)
        off = np.linalg.pinv(curvature / np.outer(size, size), rcond=ONE_PHASE**2, hermitian=True)
        off = off / np.outer(size, size)
        step = np.clip(off @ slope, -most, most)
        changes, left = [], float(slope @ step)
        for x, (_, along, found, pull) in zip(self.changes, each, strict=True):
            changes.append(x + found - along @ step)
            left += float(np.sum(found.T * pull))
        return Swings(
            self.hz + step,
            tuple(changes),
            off,
            tuple(np.asarray(own) for own, *_ in each),
            tuple(along for _, along, *_ in each),
            left / (m + a * sum(map(len, changes))),
        )

    def depth(
        self,
        j: int,
        pieces: Sequence[PieceModulation],
        parts: Sequence[Sequence[float]],
        louder: float = 1.0,
    ) -> tuple[float, float, float]:
        """The amplitude at the j-th frequency, the same in every record, and its 90 % interval.

        Its phase in each is as likely anywhere, and a motion that is short for the swing shows one
        of both phases better than the other. parts : of each piece, of its records. louder : power
        of the noise, in units of what it is told.
        """
        at = slice(1 + 2 * j, 3 + 2 * j)
        found: list[Float] = []
        known: list[Float] = []
        every = zip(pieces, parts, self.changes, self.own, self.along, strict=True)
        for one, part, x, own, along in every:
            turn, size = one.of_records(part)
            y = turn.T @ x[:, at] / size[:, None]
            K = np.einsum("ri,rcm->icm", turn, along[:, at]) / size[:, None, None]
            off = K @ self.off @ np.moveaxis(K, 1, 2)
            found.extend(y)
            known.extend(np.linalg.pinv(louder * (own[at, at] / n**2 + c), hermitian=True)
                         for c, n in zip(off, size, strict=True))  # fmt: skip
        return _radius(np.array(found), np.array(known))


def _radius(x: Float, known: Float) -> tuple[float, float, float]:
    """The radius of circles on which all of x (n, 2) lie, each told with a precision (n, 2, 2): the
    most likely one and its 90 % interval, all angles and radii as likely beforehand."""
    square = np.einsum("ni,nij,nj->n", x, known, x)
    total = float(np.trace(known.sum(axis=0))) / 2
    if not total > 0:
        return 0.0, 0.0, 0.0
    middle = math.sqrt(float(square.sum()) / total) or 1.0 / math.sqrt(total)
    sharp = math.sqrt(float(np.max(square)))
    n = int(np.clip(ANGLES * sharp, *ANGLES_BETWEEN))
    turned = np.exp(2j * np.pi * np.arange(n) / n)
    u = np.stack([turned.real, turned.imag])
    low, high = 0.0, FARTHEST_RADIUS * middle
    for _ in range(FINER):
        r = np.linspace(low, high, RADII)
        likely = np.zeros(RADII)
        for y, G, own in zip(x, known, square, strict=True):
            along, size = y @ G @ u, np.einsum("in,ij,jn->n", u, G, u)
            each = np.outer(r, along) - np.outer(r**2 / 2, size) - own / 2
            most = each.max(axis=1)
            likely += most + np.log(np.mean(np.exp(each - most[:, None]), axis=1))
        p = np.exp(likely - likely.max())
        inside = r[p > NOTHING]
        step = r[1] - r[0]
        low, high = max(inside[0] - step, 0.0), inside[-1] + step
    share = np.cumsum(p) / p.sum()
    ends = np.interp([TAIL, 1 - TAIL], share, r)
    return float(r[np.argmax(p)]), float(ends[0]), float(ends[1])


def _by_frequency(changes: Float) -> Float:
    """(rows, 2 m, m) what t cos and t sin of each frequency have to do with a change of it."""
    m = changes.shape[1] // 2
    D = np.zeros((len(changes), 2 * m, m))
    for j in range(m):
        c, s = changes[:, 1 + 2 * j], changes[:, 2 + 2 * j]
        D[:, 2 * j, j], D[:, 2 * j + 1, j] = 2 * np.pi * s, -2 * np.pi * c
    return D
