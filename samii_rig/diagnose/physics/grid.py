"""Frequencies at which models are held against data, with what does not change between models."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from samii_rig.diagnose.physics.aliases import (
    NEAR_ALIASES,
    Aliases,
    Far,
    alias_points,
    around,
    each_alias,
    lower,
    upper,
)
from samii_rig.diagnose.physics.loops import Closed
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, Int

# Of `NEAR_ALIASES`, those of each model itself where that shows: modes are seldom above 1.5 rates.
OWN_ALIASES = 2


@dataclass(frozen=True, slots=True)
class Folded:
    """What of a model folds back. near : (order, n, q) of the orders `NEAR_ALIASES`. times : (q,)
    by how much all beyond the model's own are larger than those of the grid; None where none is.
    """

    near: Complex
    times: Float | None = None


def _larger(own: Complex, of_grid: Complex) -> Float:
    """(q,) how many times an entry's own aliases (order, n, q) are those of a grid, in the mean of
    the logarithm: far above its modes a rig answers as K p / (s ...) does, all aliases alike."""
    known = (own != 0) & (of_grid != 0)
    ratio = np.divide(own, of_grid, out=np.ones_like(own), where=known)
    return np.asarray(np.exp(np.mean(np.log(np.abs(ratio)), axis=(0, 1))))


@dataclass(frozen=True, slots=True)
class Grid:
    """Frequencies (n,), at s = sigma + 2 pi j f, with what does not change between models there.

    factor : (n, q) hold, filters and delays. aliases : (n, q) what the sum over aliases adds.
    folded : (order, n, q) of these the ones of `NEAR_ALIASES`, or none. far : those beyond.
    own_aliases : (`OWN_ALIASES`, n, q) hold, filters and delays of the first of `folded`, if every
    model has its own there; None where those of one chain are near enough. rate_hz : of samples.
    sensor, actuator : (q,) entries. loop : closed around them, if responses are to the references.
    sigma : of all, or (n,) of each.
    """

    frequency: Float
    factor: Complex
    aliases: Complex
    folded: Complex
    rate_hz: float
    sensor: Int
    actuator: Int
    sigma: float | Float = field(default=0.0, kw_only=True)
    loop: Closed | None = field(default=None, kw_only=True)
    far: Far | None = field(default=None, kw_only=True)
    own_aliases: Complex | None = field(default=None, kw_only=True)

    @property
    def changed(self) -> slice:
        """The rows on which further effects act."""
        return slice(None)

    @property
    def s(self) -> Complex:
        """(n,) rad/s."""
        return np.asarray(self.sigma + 2j * np.pi * self.frequency, np.complex128)

    def at(self, frequency: Float, level: Int | None = None) -> Grid:
        """The same on some of the frequencies, whatever their level."""
        del level
        i = np.searchsorted(self.frequency, frequency)
        return Grid(
            frequency, self.factor[i], self.aliases[i], self.folded[:, i], self.rate_hz,
            self.sensor, self.actuator, sigma=self.sigma, loop=self.loop, far=self.far,
            own_aliases=None if self.own_aliases is None else self.own_aliases[:, i],
        )  # fmt: skip

    @property
    def rest(self) -> Complex:
        """(n, q) of the aliases those that are not in `folded`."""
        return np.asarray(self.aliases - np.sum(self.folded, axis=0))

    def without_aliases(self) -> Grid:
        """The same of the rig before it is sampled, no loop closed."""
        none = np.zeros((0, *self.factor.shape), complex)
        nothing = np.zeros_like(self.factor)
        return replace(self, aliases=nothing, folded=none, far=None, own_aliases=None, loop=None)

    def asked(self) -> Complex:
        """s at which a model's chain is asked: of the grid, and of its own aliases behind."""
        own = () if self.own_aliases is None else NEAR_ALIASES[:OWN_ALIASES]
        return np.concatenate([self.s, *(upper(self.s, k, self.rate_hz) for k in own)])

    def by_alias(self, answers: Complex) -> list[Complex]:
        """Answers there, as rows, of the grid and of each of these aliases."""
        return np.split(answers, 1 if self.own_aliases is None else 1 + OWN_ALIASES)

    def response_and_folded(self, answers: Complex) -> tuple[Complex, Folded]:
        """Answers (n ..., q) there as those of the grid (n, q), and what folds back: of the chain
        itself where it was asked."""
        G, *terms = self.by_alias(answers)
        if self.own_aliases is None:
            return G, Folded(self.folded)
        each = zip(terms, NEAR_ALIASES, self.own_aliases, strict=False)
        own = np.stack([lower(t, k) * f for t, k, f in each])
        times = _larger(own, self.folded[:OWN_ALIASES])
        return G, Folded(np.concatenate([own, times * self.folded[OWN_ALIASES:]]), times)

    def orders(self) -> list[Complex]:
        """s (n,) of each order of `folded`."""
        known = NEAR_ALIASES[: len(self.folded)]
        return [self.s + 2j * np.pi * k * self.rate_hz for k in known]


def grid(
    rig: Rig,
    frequency: Float,
    sensor: Int,
    actuator: Int,
    chain: Chain | None = None,
    sigma: float = 0.0,
    aliases: Aliases | None = None,
    own_aliases: bool = False,
) -> Grid:
    """The grid of a rig at sorted frequencies, Hz, without a loop. chain : whose aliases these are,
    if they are not the rig's own. sigma : 1/s, how far beside the imaginary axis. aliases : those
    of the chain, where they are known from before. own_aliases : whether every model folds back
    what is its own."""
    f = np.unique(frequency)
    chain = Chain(rig) if chain is None else chain
    if aliases is None:
        aliases = Aliases.of(rig, chain, alias_points(f[f > 0][0], f[-1], f.size), sensor, actuator)
    s = np.asarray(sigma + 2j * np.pi * f, np.complex128)
    folded = each_alias(rig, chain, s, NEAR_ALIASES, sensor, actuator)
    every = aliases.spread(s, rig.rate_hz) + folded.sum(axis=0)
    orders = (0, *NEAR_ALIASES[:OWN_ALIASES]) if own_aliases else (0,)
    factor, *own = around(rig, s, orders, sensor, actuator)
    return Grid(
        f, factor, every, folded, rig.rate_hz, sensor, actuator,
        sigma=sigma, far=aliases.far,
        own_aliases=np.stack(own) if own_aliases else None,
    )  # fmt: skip
