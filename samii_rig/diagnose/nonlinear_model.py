"""A rig with one nonlinear force in it, line by line and level by level.

The force e is fed into the rig at its place and driven by what moves there,

    reading = l0 v + l1 e,    e = x(|reading|) reading,    y = a v + r e,

so every output is the Moebius function a + r x l0/(1 - x l1) of the describing function x, and
the amplitude that x depends on is found with it, by sweeps. a, r, l0 and l1 are columns of one
chain that has an input and a sensor more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from samii_rig.diagnose import insert
from samii_rig.diagnose.effect import Effect, Key
from samii_rig.diagnose.model import STEP, Grid, Model
from samii_rig.diagnose.nonlinear_laws import EXCESS, Law, Strength
from samii_rig.diagnose.nonlinear_levels import LevelGrid, Loop, RecordGrid
from samii_rig.errors import InputError
from samii_rig.model.sampled import sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import (
    ActuatorSpec,
    Moment,
    Parameter,
    RelativeAngle,
    Rig,
    TorqueSource,
)
from samii_rig.types import Complex, Float

CAP = 1.5  # power of its height, that what a limit cuts off a sine grows with
LEAST_CUT = 1e-6  # of the largest command, height of what a limit cuts off
DIFFERENCE = 1e-3  # of the strength's logarithm, for what the force does in time
EXTRA = f"{insert.PREFIX}force"  # the input and the sensor that the chain has more

Kind = Literal["joint", "drive", "command", "flow"]


@dataclass(frozen=True, slots=True)
class Quasi:
    """A nonlinear force: where it is fed in, what drives it, and how.

    kind : `joint`, a torque between both sides of `across`, driven by the angle over it;
        `drive`, on the input of the source, driven by the source's own angle; `command`, on
        the input, driven by the input; `flow`, on the input, driven by it and by the torque
        behind the source.
    across : elements, base to tip; of a drive or flow the source.
    law : None for flow. sign : e = sign scale N reading. scale : a parameter that multiplies it.
    """

    kind: Kind
    across: tuple[str, ...]
    law: Law | None
    sign: float = -1.0
    scale: Key | None = None

    @property
    def power(self) -> int:
        """Of the strength, that a weak force grows with."""
        return -1 if self.law is None else 1

    @property
    def own_input(self) -> bool:
        """Whether the force has an input of its own."""
        return self.kind == "joint"

    def widened(self, rig: Rig) -> Rig:
        """The rig with the force's input behind its own and its sensors behind its own."""
        names = [e.name for e in rig.element]
        first, last = names.index(self.across[0]), self.across[-1]
        before = names[first - 1] if first > 0 else None
        sensors: tuple[RelativeAngle | Moment, ...] = (
            RelativeAngle(kind="relative_angle", name=EXTRA, across=self.across, unit="rad"),
        )
        match self.kind:
            case "joint":
                rig = insert.inserted(rig, last, _torque(1.0, "behind"))
                rig = insert.inserted(rig, before, _torque(-1.0, "before"))
            case "flow":
                sensors = (Moment(kind="moment", name=EXTRA, after=last, unit="N m"),)
        update: dict[str, object] = {"sensor": (*rig.sensor, *sensors)}
        if self.own_input:
            spec = ActuatorSpec(name=EXTRA, unit="N m", low=-1.0, high=1.0)
            update["actuator"] = (*rig.actuator, spec)
        return rig.model_copy(update=update)


def _torque(K: float, name: str) -> TorqueSource:
    gain = Parameter(value=K, unit="1", source="unit torque")
    return TorqueSource(kind="torque_source", name=f"{EXTRA}_{name}", input=EXTRA, K=gain)


class LevelModel(Model):
    """A model one of whose effects is a nonlinear force; on a plain grid it is left out."""

    def __init__(self, rig: Rig, effects: Sequence[Effect]) -> None:
        super().__init__(rig, effects)
        forces = [(i, e) for i, e in enumerate(effects) if e.quasi is not None]
        if len(forces) != 1:
            raise InputError(rig.name, "effects", len(forces), "one nonlinear force at a time")
        self._which, effect = forces[0]
        assert effect.quasi is not None
        self.quasi = effect.quasi
        self.chain = self.chain_of(self.quasi.widened(self.built))
        self.unknown = self.own(self._which)[0]

    def plain(self, x: Float) -> Chain:
        """As of `Model`, without the force's input and sensor."""
        return Chain(self.built).with_values(self.values(x))

    def response(self, x: Float, at: Grid) -> Complex:
        """(n, q) at the grid's lines; of whole records, behind these what the force adds to all."""
        if isinstance(at, RecordGrid):
            return np.concatenate([super().response(x, at), at.added(self, x)])
        if not isinstance(at, LevelGrid) or at.power is None:
            return super().response(x, at)
        G, loop, r = self.looped(x, at)
        F, _ = self._factors(x, at, slopes=False)
        p, scale = self.strength(x)
        t, _ = loop.force(self.quasi, p, scale)
        y = G[:, at.sensor, at.actuator] * at.factor + r * t[:, None] * at.filter
        aliases, _ = self._aliases(x, at, slopes=False)
        return np.asarray(y * F + aliases + self._more(at, p)[0])

    def several(self, x: Float, at: LevelGrid, strengths: Float) -> Complex:
        """(m, n, q) what the force adds to the response, at strengths (m,) instead of that in x."""
        _, loop, r = self.looped(x, at)
        F, _ = self._factors(x, at, slopes=False)
        t, _ = loop.force(self.quasi, strengths[:, None], self.strength(x)[1])
        by_force = r * at.filter * F
        return np.asarray(t[:, :, None] * by_force + self._more(at, strengths[:, None, None])[0])

    def looped(self, x: Float, at: LevelGrid) -> tuple[Complex, Loop, Complex]:
        """(n, ...) response of the chain, the force's loop, and outputs per unit force (n, q)."""
        f, which = np.unique(at.frequency, return_inverse=True)
        G = self.chain.with_values(self.values(x)).response(f)[which]
        return G, *self._loop(G, at)

    def scaled(self, at: LevelGrid, p: Float, times: Float) -> Float:
        """The strengths (m,) at which a weak force is about so many times as strong."""
        extra = at.extra.get(self.quasi)
        if self.quasi.law is EXCESS:
            if extra is None:
                return p
            cut = np.maximum(extra.top - p, 0.0) * np.clip(times, 0.02, 8.0) ** (1 / CAP)
            return np.asarray(extra.top - cut)
        return np.asarray(p * np.clip(times, 0.4, 2.5) ** (1 / self.quasi.power))

    def per_force(self, x: Float, at: Grid) -> Complex:
        """(n, q) the sampled outputs per unit of the force."""
        G = self.chain.with_values(self.values(x)).response(at.frequency)
        act = int(at.actuator[0])
        own = len(self.rig.actuator) if self.quasi.own_input else act
        filters = sensor_response(self.rig.sensor, at.frequency)[:, at.sensor]
        return np.asarray(G[:, at.sensor, own] * filters * self._factors(x, at, slopes=False)[0])

    def factors(self, x: Float, at: LevelGrid) -> Complex:
        """(n, q) of the effects on channels."""
        return self._factors(x, at, slopes=False)[0]

    def _more(self, at: LevelGrid, p: Strength) -> tuple[Complex | float, Float | float]:
        """What the force adds beyond its describing function, where it is known; and how fast
        that grows, d log / d log p."""
        extra = at.extra.get(self.quasi)
        if extra is None:
            return 0.0, 0.0
        if self.quasi.law is EXCESS:
            if extra.top == 0:  # no command of these levels is known
                return 0.0, 0.0
            # A cap of height a is cut off a sine over a time like sqrt(a).
            # Nothing is cut by a limit that is not reached, now or when it was computed.
            least = LEAST_CUT * extra.top
            left = np.maximum(extra.top - p, least)
            grown = (left / max(extra.top - extra.p, least)) ** CAP
            return np.asarray(extra.part * grown), np.asarray(-CAP * p / left)
        power = self.quasi.power
        return np.asarray(extra.part * (p / extra.p) ** power), float(power)

    def gradient(self, x: Float, at: Grid) -> tuple[Complex, Complex]:
        """The same, and its derivatives (n, q, n_x)."""
        if isinstance(at, RecordGrid):
            return self._with_lines(x, at)
        if not isinstance(at, LevelGrid) or at.power is None:
            return super().gradient(x, at)
        values = self.values(x)
        f, which = np.unique(at.frequency, return_inverse=True)
        G, dG = self.chain.with_values(values).gradient(f, tuple(values))
        map_ = self._map(x, values)
        on = np.flatnonzero(np.any(map_, axis=0))
        # One product of two matrices, before the levels repeat its rows.
        dG = (dG.reshape(G.size, len(values)) @ map_[:, on]).reshape(*G.shape, on.size)
        G, dG = G[which], dG[which]
        loop, r = self._loop(G, at)
        p, scale = self.strength(x)
        t, found = loop.force(self.quasi, p, scale)
        more, growth = self._more(at, p)
        moved, dr = self._loop(dG, at)
        dt = np.zeros((t.size, self.n), complex)
        if self.quasi.law is None:
            # What the chain's own parameters do to the lost flow is of second order.
            dt[:, self.unknown] = (loop.force(self.quasi, p * (1 + STEP))[0] - t) / STEP
        else:
            fixed = self.quasi.kind == "command"
            changes = (moved.l0[:, 0], moved.l1[:, 0])
            none = np.zeros((t.size, on.size), complex)
            by_chain, by_p, by_scale = loop.slopes(
                self.quasi, p, scale, found, (none, none) if fixed else changes
            )
            dt[:, on] = by_chain
            dt[:, self.unknown] += by_p
            if self.quasi.scale in values:
                row = map_[list(values).index(self.quasi.scale)] / scale
                dt += by_scale[:, None] * row
        F, slopes = self._factors(x, at, slopes=True)
        own = G[:, at.sensor, at.actuator] * at.factor + r * t[:, None] * at.filter
        filtered = (at.filter * F)[:, :, None]
        dy = r[:, :, None] * dt[:, None, :] * filtered
        dy[:, :, on] += dr * t[:, None, None] * filtered
        dy[:, :, on] += dG[:, at.sensor, at.actuator] * (at.factor * F)[:, :, None]
        for j, dlog in slopes:
            dy[:, :, j] += own * dlog
        dy[:, :, self.unknown] += growth * more
        aliases, folded = self._aliases(x, at, slopes=True)
        for j, slope in folded:
            dy[:, :, j] += slope
        return np.asarray(own * F + aliases + more), dy

    def _with_lines(self, x: Float, at: RecordGrid) -> tuple[Complex, Complex]:
        """`gradient` on whole records: the force moves with its strength; what the chain's own
        parameters do to it is of second order."""
        h, dh = super().gradient(x, at)
        ahead = x.copy()
        inside = x[self.unknown] + DIFFERENCE <= self.upper[self.unknown]
        ahead[self.unknown] += DIFFERENCE if inside else -DIFFERENCE
        added = at.added(self, x)
        more = np.zeros((*added.shape, self.n), complex)
        step = ahead[self.unknown] - x[self.unknown]
        more[:, :, self.unknown] = (at.added(self, ahead) - added) / step
        return np.concatenate([h, added]), np.concatenate([dh, more])

    def _map(self, x: Float, values: dict[Key, float]) -> Float:
        """(key, n_x) derivatives of the chain's parameters."""
        out = np.zeros((len(values), self.n))
        for j in range(self.n):
            ahead = x.copy()
            ahead[j] += STEP
            there = self.values(ahead)
            out[:, j] = [(there[k] - values[k]) / STEP for k in values]
        return out

    def strength(self, x: Float) -> tuple[float, float]:
        """The force's unknown, and what multiplies it."""
        p = float(np.exp(x[self.unknown]))
        if self.quasi.scale is None:
            return p, 1.0
        return p, float({**self.nominal, **self.values(x)}[self.quasi.scale])

    def _loop(self, G: Complex, at: LevelGrid) -> tuple[Loop, Complex]:
        """The loop, and (n, q) of the outputs per unit force, filters left out."""
        n = len(self.rig.sensor)
        act = int(at.actuator[0])
        own = len(self.rig.actuator) if self.quasi.own_input else act
        s = at.s
        hold = at.hold.reshape(-1, *(1,) * (G.ndim - 2))
        if self.quasi.kind == "command":
            l0, l1 = at.hold[:, None], np.zeros((s.size, 1), complex)
        else:
            l0, l1 = G[:, n:, act] * hold, G[:, n:, own]
        if self.quasi.kind == "drive":
            e = next(e for e in self.rig.element if e.name == self.quasi.across[0])
            l0, l1 = l0 / e.K.value, l1 / e.K.value  # type: ignore[union-attr]
        return Loop(s, np.asarray(l0), np.asarray(l1), at), np.asarray(G[:, at.sensor, own])


def model_of(rig: Rig, effects: Sequence[Effect]) -> Model:
    """The model that the effects need."""
    forced = any(e.quasi is not None for e in effects)
    return LevelModel(rig, effects) if forced else Model(rig, effects)
