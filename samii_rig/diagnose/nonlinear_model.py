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
from samii_rig.diagnose.nonlinear_laws import Law
from samii_rig.diagnose.nonlinear_levels import LevelGrid, Loop
from samii_rig.errors import InputError
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import (
    AbsoluteAngle,
    ActuatorSpec,
    AngularVelocitySource,
    Moment,
    Parameter,
    RelativeAngle,
    Rig,
    TorqueSource,
)
from samii_rig.types import Complex, Float

FAST = 1e6  # rad/s: an injected flow has no lag
EXTRA = f"{insert.PREFIX}force"  # the input and the sensor that the chain has more

Kind = Literal["joint", "ground", "drive", "command", "flow"]


@dataclass(frozen=True, slots=True)
class Quasi:
    """A nonlinear force: where it is fed in, what drives it, and how.

    kind : `joint`, a torque between both sides of `across`, driven by the angle over it;
        `ground`, a torque against the ground behind the element, driven by its angle;
        `drive`, on the input of the source, driven by the source's own angle; `command`, on
        the input, driven by the input; `flow`, of the source, driven by flow and torque.
    across : elements, base to tip; of a drive or flow the source.
    law : None for flow. sign : e = sign scale N reading. scale : a parameter that multiplies it.
    """

    kind: Kind
    across: tuple[str, ...]
    law: Law | None
    sign: float = -1.0
    scale: Key | None = None

    @property
    def own_input(self) -> bool:
        """Whether the force has an input of its own."""
        return self.kind in ("joint", "ground", "flow")

    def widened(self, rig: Rig) -> Rig:
        """The rig with the force's input behind its own and its sensors behind its own."""
        names = [e.name for e in rig.element]
        first, last = names.index(self.across[0]), self.across[-1]
        before = names[first - 1] if first > 0 else None
        sensors: tuple[RelativeAngle | AbsoluteAngle | Moment, ...] = (
            RelativeAngle(kind="relative_angle", name=EXTRA, across=self.across, unit="rad"),
        )
        match self.kind:
            case "joint":
                rig = insert.inserted(rig, last, _torque(1.0, "behind"))
                rig = insert.inserted(rig, before, _torque(-1.0, "before"))
            case "ground":
                rig = insert.inserted(rig, last, _torque(1.0, "behind"))
                sensors = (
                    AbsoluteAngle(kind="absolute_angle", name=EXTRA, after=last, unit="rad"),
                )
            case "flow":
                K = Parameter(value=1.0, unit="1", source="unit flow")
                p = Parameter(value=FAST, unit="rad/s", source="no lag")
                flow = AngularVelocitySource(
                    kind="angular_velocity_source", name=f"{EXTRA}_flow", input=EXTRA, K=K, p=p
                )
                seen = [
                    s.name for s in rig.sensor if isinstance(s, RelativeAngle) and last in s.across
                ]
                rig = insert.inserted(rig, last, flow, tuple(seen))
                sensors += (Moment(kind="moment", name=f"{EXTRA}_M", after=last, unit="N m"),)
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
        self.chain = Chain(self.quasi.widened(self.built))
        first = self.n_nominal + sum(len(e.unknowns) for e in self.effects[: self._which])
        self.unknown = first

    def response(self, x: Float, at: Grid) -> Complex:
        """(n, q) at the grid's lines."""
        if not isinstance(at, LevelGrid) or at.power is None:
            return super().response(x, at)
        G = self.chain.with_values(self.values(x)).response(at.frequency)
        F, _ = self._factors(x, at, slopes=False)
        loop, r = self._loop(G, at)
        t, _ = loop.force(self.quasi, *self._strength(x))
        y = G[:, at.sensor, at.actuator] * at.factor + r * t[:, None] * at.filter
        return np.asarray(y * F + at.aliases)

    def gradient(self, x: Float, at: Grid) -> tuple[Complex, Complex]:
        """The same, and its derivatives (n, q, n_x)."""
        if not isinstance(at, LevelGrid) or at.power is None:
            return super().gradient(x, at)
        values = self.values(x)
        G, dG = self.chain.with_values(values).gradient(at.frequency, tuple(values))
        loop, r = self._loop(G, at)
        p, scale = self._strength(x)
        t, found = loop.force(self.quasi, p, scale)
        map_ = self._map(x, values)
        on = np.flatnonzero(np.any(map_, axis=0))
        moved, dr = self._loop(dG @ map_[:, on], at)
        dt = np.zeros((t.size, self.n), complex)
        if self.quasi.law is None:
            # What the chain's own parameters do to the flow that is lost is of second order.
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
        dy = (dG[:, at.sensor, at.actuator] @ map_) * (at.factor * F)[:, :, None]
        dy = dy + r[:, :, None] * dt[:, None, :] * filtered
        dy[:, :, on] += dr * t[:, None, None] * filtered
        for j, dlog in slopes:
            dy[:, :, j] += own * dlog
        return np.asarray(own * F + at.aliases), dy

    def _map(self, x: Float, values: dict[Key, float]) -> Float:
        """(key, n_x) derivatives of the chain's parameters."""
        out = np.zeros((len(values), self.n))
        for j in range(self.n):
            ahead = x.copy()
            ahead[j] += STEP
            there = self.values(ahead)
            out[:, j] = [(there[k] - values[k]) / STEP for k in values]
        return out

    def _strength(self, x: Float) -> tuple[float, float]:
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
        s = np.asarray(2j * np.pi * at.frequency, np.complex128)
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
