"""The sampled rig with effects added, as a function of one vector of logarithms."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.physics.aliases import NEAR_ALIASES, lower, over
from samii_rig.diagnose.physics.along import body_of
from samii_rig.diagnose.physics.causal import CausalChain
from samii_rig.diagnose.physics.effect import Effect, Factor, Key
from samii_rig.diagnose.physics.fractional import ChainLike, FractionalChain
from samii_rig.diagnose.physics.grid import OWN_ALIASES, Folded, Grid
from samii_rig.diagnose.physics.poses import turned
from samii_rig.diagnose.physics.unheld import stated
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig, parameters
from samii_rig.rig.schema.elements import flattened
from samii_rig.types import Complex, Float, Int

LOGARITHM_STEP = 1e-6  # of a logarithm, for the derivative of parameters by unknowns
FARTHEST = 6.0  # tolerances that a refit moves a nominal parameter at most


@dataclass(frozen=True, slots=True)
class _Passed:
    """What factors on channels do to the response at several orders of s.

    F : (order, n, q) their product. parts : of each unknown, its place in x, the entries that
    it acts on and the slope of the product's logarithm there (order, n, 1).
    """

    F: Complex
    parts: Sequence[tuple[int, Int, Complex]]

    def slopes(self) -> Iterator[tuple[int, Int, Complex]]:
        """Of each unknown the slope of F itself."""
        return ((j, on, self.F[:, :, on] * slope) for j, on, slope in self.parts)


def _through(
    at: Grid, folded: Folded, near: _Passed | None, beyond: _Passed | None
) -> tuple[Complex, Complex]:
    """(n, q) hold, filters and delays of a grid and its aliases, each times its factors. folded :
    of the model."""
    if near is None and folded.times is None:
        return at.factor, at.aliases
    rest, each, factor = at.rest, folded.near, at.factor
    if near is not None:
        each, factor = each * near.F[1:], np.asarray(factor * near.F[0])
        if beyond is not None and at.far is not None:
            rest = rest + at.far.added(at, near.F[0], beyond.F[0])
    if folded.times is not None:
        rest = folded.times * rest
    return factor, np.asarray(rest + np.sum(each, axis=0))


class Model:
    """A rig, the effects added to it, and its uncertain nominal parameters.

    The vector x is log(value/nominal) of the nominal parameters `keys`, then the logarithm of
    each effect's unknowns. prior : (n_x,) standard deviations, inf for unknowns, whose
    bounds are `lower` and `upper`.
    """

    def __init__(self, rig: Rig, effects: Sequence[Effect] = ()) -> None:
        self.rig, self.effects = rig, tuple(effects)
        built = rig
        for effect in effects:
            built = effect.build(built)
        self.built = built
        self._stated = stated(built)
        self.chain = self.chain_of(built)
        known = {(e.name, s): p for e in flattened(rig.element) for s, p in parameters(e).items()}
        have = set(self.chain.parameters)
        self.keys: tuple[Key, ...] = tuple(
            k for k, p in known.items() if p.tolerance > 0 and p.value != 0 and k in have
        )
        self.nominal = {k: p.value for k, p in known.items()}
        self._start = np.array([self.nominal[k] for k in self.keys])
        unknowns = [u for e in effects for u in e.unknowns]
        n = len(self.keys)
        self.n_nominal, self.n = n, n + len(unknowns)
        self.prior = np.full(self.n, math.inf)
        self.prior[:n] = [known[k].tolerance for k in self.keys]
        self.lower = np.concatenate(
            [-FARTHEST * self.prior[:n], [math.log(u.low) for u in unknowns]]
        )
        self.upper = np.concatenate(
            [FARTHEST * self.prior[:n], [math.log(u.high) for u in unknowns]]
        )

    def having(self, effects: Sequence[Effect]) -> Model:
        """The same rig with other effects; nominal parameters keep their place in x."""
        return Model(self.rig, effects)

    def under(self, change: Callable[[Rig], Rig]) -> Model:
        """The same effects in a rig that was changed."""
        rig = change(self.rig)
        return Model(rig, [turned(e, self.rig, rig) for e in self.effects])

    def chain_of(self, rig: Rig) -> ChainLike:
        """The chain of a rig, as the effects have it."""
        chain: ChainLike = Chain(rig)
        causal = dict(e.causal for e in self.effects if e.causal is not None)
        if causal:
            own = [e.name for e in flattened(rig.element) if body_of(e.name) in causal]
            pieces = [name for name in own if name not in causal]
            middle = next(iter(causal.values()))
            chain = CausalChain(chain.plain, (*causal, *pieces), middle)
        for joint in (e.fractional for e in self.effects if e.fractional is not None):
            chain = FractionalChain(chain, joint)
        return chain

    def parts(self, x: Float) -> list[Float]:
        """The values of each effect's unknowns."""
        out, at = [], self.n_nominal
        for effect in self.effects:
            out.append(np.exp(x[at : at + len(effect.unknowns)]))
            at += len(effect.unknowns)
        return out

    def passing(self, x: Float) -> list[tuple[Factor, Float, int]]:
        """The factors on channels, the values of their unknowns and where these begin in x: of the
        effects, and of inputs that the built rig has as measured."""
        out, first = [], self.n_nominal
        for effect, theta in zip(self.effects, self.parts(x), strict=True):
            if effect.factor is not None:
                out.append((effect.factor, theta, first))
            first += len(effect.unknowns)
        return out + [(factor, np.zeros(0), first) for factor in self._stated]

    def metered(self, command: str) -> bool:
        """Whether a meter recorded a command, which its rig followed between samples, too."""
        measured = [e.factor for e in self.effects if e.metered] + list(self._stated)
        return any(factor is not None and factor.channel == command for factor in measured)

    def own(self, i: int) -> range:
        """Where the unknowns of effect i stand in x."""
        first = self.n_nominal + sum(len(e.unknowns) for e in self.effects[:i])
        return range(first, first + len(self.effects[i].unknowns))

    def values(self, x: Float) -> dict[Key, float]:
        """The chain's parameters that differ from the built rig's."""
        moved = dict(
            zip(self.keys, (self._start * np.exp(x[: self.n_nominal])).tolist(), strict=True)
        )
        all_values = {**self.nominal, **moved}
        pairs = zip(self.effects, self.parts(x), strict=True)
        for effect, theta in sorted(pairs, key=lambda pair: bool(pair[0].pieces)):
            change = effect.parameters(theta, all_values)
            all_values.update(change)
            moved.update(change)
        return moved

    def plain(self, x: Float) -> Chain:
        """The chain at x, a loss factor the same at all frequencies, no fractional damper."""
        return self.chain.with_values(self.values(x)).plain

    def response(self, x: Float, at: Grid) -> Complex:
        """(n, q) at the grid's frequencies."""
        chain = self.chain.with_values(self.values(x))
        G, folded = at.response_and_folded(chain.evaluate(at.asked())[:, at.sensor, at.actuator])
        factor, aliases = _through(at, folded, *self._passed(x, at))
        H = np.asarray(G * factor + aliases)
        return H if at.loop is None else at.loop.closed(H)

    def gradient(self, x: Float, at: Grid) -> tuple[Complex, Complex]:
        """The same, and its derivatives (n, q, n_x)."""
        values = self.values(x)
        keys = tuple(values)
        chain = self.chain.with_values(values)
        every, slopes = chain.gradient_at(at.asked(), keys)
        G, folded = at.response_and_folded(every[:, at.sensor, at.actuator])
        near, beyond = self._passed(x, at)
        factor, aliases = _through(at, folded, near, beyond)
        own, *folds = at.by_alias(slopes[:, at.sensor, at.actuator])
        dG = own * factor[:, :, None]
        far, larger = aliases, np.zeros(dG.shape[1:])
        for i, (k, d) in enumerate(zip(NEAR_ALIASES, folds, strict=False)):
            assert at.own_aliases is not None
            by, d, alias = at.own_aliases[i], lower(d, k), folded.near[i]
            part = over(by, alias) / (OWN_ALIASES * len(alias))
            larger += np.matmul(part.T[:, None, :], d.swapaxes(0, 1))[:, 0].real
            if near is not None:
                by, alias = by * near.F[1 + i], alias * near.F[1 + i]
            dG += d * by[:, :, None]
            far = far - alias
        if folds:
            dG += far[:, :, None] * larger  # the slope of `Folded.times`
        dH = np.zeros((*G.shape, self.n), complex)
        n = self.n_nominal
        dH[:, :, :n] = dG[:, :, :n] * np.array([values[k] for k in self.keys])
        read = self._reading()
        if read:
            map_ = np.zeros((len(keys), len(read)))
            for i, j in enumerate(read):
                ahead = x.copy()
                ahead[j] += LOGARITHM_STEP
                there = self.values(ahead)
                map_[:, i] = [(there[k] - values[k]) / LOGARITHM_STEP for k in keys]
            dH[:, :, read] = dG @ map_
        if near is not None:
            terms = np.concatenate([(G * at.factor)[None], folded.near])
            for j, on, slope in near.slopes():
                dH[:, on, j] += np.sum(terms[:, :, on] * slope, axis=0)
        if near is not None and beyond is not None and at.far is not None:
            for (j, on, d_own), (_, _, d_passed) in zip(
                near.slopes(), beyond.slopes(), strict=True
            ):
                own, passed = np.zeros_like(near.F[0]), np.zeros_like(beyond.F[0])
                own[:, on], passed[:, on] = d_own[0], d_passed[0]
                slope = at.far.slope(at, near.F[0], beyond.F[0], own, passed)
                dH[:, :, j] += slope if folded.times is None else folded.times * slope
        H = G * factor + aliases
        return (H, dH) if at.loop is None else (at.loop.closed(H), at.loop.slopes(H, dH))

    def _reading(self) -> list[int]:
        """Entries of x that reach the chain's parameters through an effect."""
        touched = {k for e in self.effects for k in e.touches}
        return [i for i, k in enumerate(self.keys) if k in touched] + list(
            range(self.n_nominal, self.n)
        )

    def _passed(self, x: Float, at: Grid) -> tuple[_Passed | None, _Passed | None]:
        """What the factors on channels do at the grid's own s and to the aliases of `folded`, and
        to those of `far`; None where there is no factor, or no such aliases."""
        if not self.passing(x):
            return None, None
        near = self._passed_at(x, at, np.stack([at.s, *at.orders()]))
        return near, None if at.far is None else self._passed_at(x, at, at.far.s[None])

    def _passed_at(self, x: Float, at: Grid, s: Complex) -> _Passed:
        """s : (order, n)."""
        total = np.ones((*s.shape, at.sensor.size), complex)
        parts = []
        for factor, theta, first in self.passing(x):
            F, dF = factor.value(s.ravel(), theta)
            on = self.entries(factor, at)
            total[:, :, on] *= F.reshape(*s.shape, 1)
            parts += [
                (first + j, on, (d * theta[j] / F).reshape(*s.shape, 1)) for j, d in enumerate(dF)
            ]
        return _Passed(total, parts)

    def entries(self, factor: Factor, at: Grid) -> Int:
        """Entries of the grid that a factor is on."""
        if factor.kind == "input":
            names = [a.name for a in self.rig.actuator]
            return np.flatnonzero(at.actuator == names.index(factor.channel))
        names = [s.name for s in self.rig.sensor]
        return np.flatnonzero(at.sensor == names.index(factor.channel))
