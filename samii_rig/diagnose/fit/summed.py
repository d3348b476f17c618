"""Several sets of records under one vector of parameters: their nodes one behind the other, and
their likelihoods summed, which is exact."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import linalg

from samii_rig.diagnose.physics.grid import Grid
from samii_rig.likelihood.algebra import by_sensor
from samii_rig.likelihood.form import Reduced
from samii_rig.types import Complex, Float

RANK = 1e-10  # of the largest, a direction of rounding alone


@dataclass(frozen=True, slots=True)
class Stacked(Grid):
    """The rows of several grids, `sizes` of each, in their order."""

    sizes: tuple[int, ...] = field(kw_only=True)

    @classmethod
    def of(cls, each: Sequence[Grid]) -> Stacked:
        """Grids as one; rate, entries and loop are the same of all."""
        first = each[0]
        return cls(
            frequency=np.concatenate([g.frequency for g in each]),
            factor=np.concatenate([g.factor for g in each]),
            aliases=np.concatenate([g.aliases for g in each]),
            folded=np.concatenate([g.folded for g in each], axis=1),
            rate_hz=first.rate_hz,
            sensor=first.sensor,
            actuator=first.actuator,
            sigma=np.concatenate([np.full(g.frequency.size, g.sigma) for g in each]),
            loop=first.loop,
            far=first.far,  # hardly differs: far above what a pose or a part moves
            own_aliases=_joined([g.own_aliases for g in each]),
            sizes=tuple(g.frequency.size for g in each),
        )

    def parts(self) -> tuple[Grid, ...]:
        """The grids."""
        sigma = np.broadcast_to(self.sigma, self.frequency.shape)
        return tuple(
            Grid(
                self.frequency[own], self.factor[own], self.aliases[own], self.folded[:, own],
                self.rate_hz, self.sensor, self.actuator, sigma=sigma[own], loop=self.loop,
                far=self.far,
                own_aliases=None if self.own_aliases is None else self.own_aliases[:, own],
            )
            for own in runs(self.sizes)
        )  # fmt: skip


def _joined(each: Sequence[Complex | None]) -> Complex | None:
    known = [one for one in each if one is not None]
    return np.concatenate(known, axis=1) if len(known) == len(each) else None


def runs(sizes: Sequence[int]) -> Iterator[slice]:
    """The rows of each of several, one behind the other."""
    at = 0
    for size in sizes:
        yield slice(at, at + size)
        at += size


@dataclass(frozen=True, slots=True)
class Summed(Reduced):
    """The likelihoods of several sets of records, summed. each : of one set by itself."""

    each: tuple[Reduced, ...]

    @classmethod
    def of(cls, each: Sequence[Reduced], *, alike: bool = False) -> Summed:
        """alike : what no model explains is free at every node, and the same in all sets, which
        have the same nodes."""
        q = each[0].factor.shape[1]
        rows = list(runs([one.factor.shape[0] for one in each]))
        nodes = list(runs([one.factor.shape[3] for one in each]))
        factor = np.zeros((rows[-1].stop, q, 2, nodes[-1].stop))
        for one, row, node in zip(each, rows, nodes, strict=True):
            factor[row, :, :, node] = one.factor
        target = np.concatenate([one.target for one in each])
        known = sum(one.known for one in each)
        if alike:
            common = sum(factor[..., node] for node in nodes)
            rest, rank = _null_space(np.asarray(common).reshape(len(factor), -1))
            factor = (rest.T @ factor.reshape(len(factor), -1)).reshape(-1, *factor.shape[1:])
            target, known = rest.T @ target, known - rank
        return cls(
            frequency=np.concatenate([one.frequency for one in each]),
            sigma=each[0].sigma,
            reference=np.concatenate([one.reference for one in each]),
            factor=factor,
            target=target,
            known=known,
            inside=_added([one.inside for one in each]),
            noise=each[0].noise,
            differing=_added([one.differing for one in each]),
            log_determinant=sum(one.log_determinant for one in each),
            each=tuple(each),
        )

    def slopes(self, dh: Complex) -> Float:
        """As of `Reduced`."""
        flat = by_sensor(dh)
        return np.asarray(self.factor.reshape(-1, len(flat)) @ flat)

    def interpolation_error(self, d: Complex, middle: Complex) -> float:
        """As of `Reduced`."""
        sizes = [one.frequency.size for one in self.each]
        between = runs([n - 1 for n in sizes])
        each = zip(self.each, runs(sizes), between, strict=True)
        return math.hypot(*(one.interpolation_error(d[own], middle[gap]) for one, own, gap in each))


def parts_of(found: Reduced) -> tuple[Reduced, ...]:
    """The likelihoods of which one is the sum."""
    assert isinstance(found, Summed)
    return found.each


def _added(pairs: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return sum(a for a, _ in pairs), sum(b for _, b in pairs)


def _null_space(columns: Float) -> tuple[Float, int]:
    """Orthonormal directions (m, m - rank) that no column (m, n) has, and the rank."""
    scale = np.linalg.norm(columns, axis=0)
    Q, R, _ = linalg.qr(columns / np.where(scale > 0, scale, 1.0), pivoting=True)
    size = np.abs(np.diagonal(R))
    rank = int(np.count_nonzero(size > RANK * size[0]))
    return np.asarray(Q[:, rank:]), rank
