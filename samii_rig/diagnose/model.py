"""The sampled rig with effects added, as a function of one vector of logarithms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.effect import Effect, Key
from samii_rig.model.sampled import hold_response, sampled_response, sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig, parameters
from samii_rig.types import Complex, Float, Int

ALIAS_POINTS = 120  # frequencies at which the aliases are summed; they are smooth between
STEP = 1e-6  # of a logarithm, for the derivative of parameters by unknowns


@dataclass(frozen=True, slots=True)
class Grid:
    """Frequencies (n,) with what does not change between models there.

    factor : (n, q) hold, filters and delays. aliases : (n, q) what the sum over aliases adds.
    sensor, actuator : (q,) entries.
    """

    frequency: Float
    factor: Complex
    aliases: Complex
    sensor: Int
    actuator: Int

    def at(self, frequency: Float, level: Int | None = None) -> Grid:
        """The same on some of the frequencies; what depends on their level is in `LevelGrid`."""
        del level
        i = np.searchsorted(self.frequency, frequency)
        return Grid(frequency, self.factor[i], self.aliases[i], self.sensor, self.actuator)


def grid(rig: Rig, frequency: Float, sensor: Int, actuator: Int) -> Grid:
    """The grid of a rig at sorted frequencies, Hz."""
    f = np.unique(frequency)
    hold = np.stack([hold_response(f, rig.rate_hz, a.delay) for a in rig.actuator], axis=1)
    factor = sensor_response(rig.sensor, f)[:, sensor] * hold[:, actuator]
    few = np.geomspace(f[0], f[-1], min(ALIAS_POINTS, f.size))
    few[0], few[-1] = f[0], f[-1]
    chain = Chain(rig)
    held = np.stack([hold_response(few, rig.rate_hz, a.delay) for a in rig.actuator], axis=1)
    part = sensor_response(rig.sensor, few)[:, sensor] * held[:, actuator]
    rest = (
        sampled_response(rig, few, chain)[:, sensor, actuator]
        - chain.response(few)[:, sensor, actuator] * part
    )
    aliases = np.stack([np.interp(f, few, r) for r in rest.T], axis=1)
    return Grid(f, factor, aliases, sensor, actuator)


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
        self.chain = Chain(built)
        known = {(e.name, s): p for e in rig.element for s, p in parameters(e).items()}
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
        self.lower = np.concatenate([-6 * self.prior[:n], [math.log(u.low) for u in unknowns]])
        self.upper = np.concatenate([6 * self.prior[:n], [math.log(u.high) for u in unknowns]])

    def parts(self, x: Float) -> list[Float]:
        """The values of each effect's unknowns."""
        out, at = [], self.n_nominal
        for effect in self.effects:
            out.append(np.exp(x[at : at + len(effect.unknowns)]))
            at += len(effect.unknowns)
        return out

    def values(self, x: Float) -> dict[Key, float]:
        """The chain's parameters that differ from the built rig's."""
        moved = dict(
            zip(self.keys, (self._start * np.exp(x[: self.n_nominal])).tolist(), strict=True)
        )
        all_values = {**self.nominal, **moved}
        for effect, theta in zip(self.effects, self.parts(x), strict=True):
            change = effect.parameters(theta, all_values)
            all_values.update(change)
            moved.update(change)
        return moved

    def response(self, x: Float, at: Grid) -> Complex:
        """(n, q) at the grid's frequencies."""
        chain = self.chain.with_values(self.values(x))
        G = chain.response(at.frequency)[:, at.sensor, at.actuator]
        F, _ = self._factors(x, at, slopes=False)
        return np.asarray(G * at.factor * F + at.aliases)

    def gradient(self, x: Float, at: Grid) -> tuple[Complex, Complex]:
        """The same, and its derivatives (n, q, n_x)."""
        values = self.values(x)
        keys = tuple(values)
        chain = self.chain.with_values(values)
        G, dG = chain.gradient(at.frequency, keys)
        G, dG = G[:, at.sensor, at.actuator], dG[:, at.sensor, at.actuator]
        map_ = np.zeros((len(keys), self.n))
        for i, key in enumerate(self.keys):
            if key in values:
                map_[i, i] = values[key]
        for j in self._reading():
            ahead = x.copy()
            ahead[j] += STEP
            there = self.values(ahead)
            map_[:, j] = [(there[k] - values[k]) / STEP for k in keys]
        F, slopes = self._factors(x, at, slopes=True)
        factor = at.factor * F
        dH = (dG @ map_) * factor[:, :, None]
        for j, dlog in slopes:
            dH[:, :, j] += G * at.factor * dlog
        return G * factor + at.aliases, dH

    def _reading(self) -> list[int]:
        """Entries of x that reach the chain's parameters through an effect."""
        touched = {k for e in self.effects for k in e.touches}
        return [i for i, k in enumerate(self.keys) if k in touched] + list(
            range(self.n_nominal, self.n)
        )

    def _factors(
        self, x: Float, at: Grid, *, slopes: bool
    ) -> tuple[Complex, list[tuple[int, Complex]]]:
        total = np.ones((at.frequency.size, at.sensor.size), complex)
        parts = []
        s = np.asarray(2j * np.pi * at.frequency, np.complex128)
        first = self.n_nominal
        for effect, theta in zip(self.effects, self.parts(x), strict=True):
            if effect.factor is not None:
                F, dF = effect.factor.value(s, theta)
                on = self._entries(effect, at)
                total[:, on] *= F[:, None]
                parts.append((first, on, F, dF, theta))
            first += len(effect.unknowns)
        out: list[tuple[int, Complex]] = []
        if slopes:
            for first, on, F, dF, theta in parts:
                for j, d in enumerate(dF):
                    slope = np.zeros_like(total)
                    slope[:, on] = total[:, on] * (d * theta[j] / F)[:, None]
                    out.append((first + j, slope))
        return total, out

    def _entries(self, effect: Effect, at: Grid) -> Int:
        assert effect.factor is not None
        if effect.factor.kind == "input":
            names = [a.name for a in self.rig.actuator]
            return np.flatnonzero(at.actuator == names.index(effect.factor.channel))
        names = [s.name for s in self.rig.sensor]
        return np.flatnonzero(at.sensor == names.index(effect.factor.channel))
