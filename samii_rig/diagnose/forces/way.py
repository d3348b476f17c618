"""The rig's way from command and force to what drives the force, and on to its sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from samii_rig.diagnose.forces.march import march, moved, read
from samii_rig.diagnose.forces.model import ForceModel, augmented
from samii_rig.diagnose.forces.steps import LAW_NUMBERS
from samii_rig.errors import InputError
from samii_rig.model.realise import Realisation, realise
from samii_rig.types import Complex, Float, Int

INNER = 8  # steps a sample: 3 % of what a force adds, halved steps a quarter of that


@dataclass(frozen=True, slots=True)
class Sensed:
    """A rig's partial fractions from a force to its sensors, no loop closed; as `read` has it."""

    transition: Float
    by_e: Float
    direct: Float
    late: Int

    def of(self, e: Float) -> Float:
        """(n, q) of a force e (n INNER,) from rest."""
        e = np.ascontiguousarray(e)
        return read(e, self.transition, self.by_e, self.direct, INNER, self.late)


@dataclass(frozen=True, slots=True)
class Way:
    """A rig's partial fractions from commands and force to what drives the force, by exact steps.

    transition, by_e : (2, n_pole) what a step makes of a state and of a force held over it, real
    and imaginary parts; by_v (m, 2, n_pole) of each command. direct (m,), g : as `march` has them.
    late : (m,) steps of dead time. own : the command in whose drive the force acts, 0 for none.
    structure : the chain's own poles.
    """

    transition: Float
    by_v: Float
    by_e: Float
    direct: Float
    g: float
    late: Int
    own: int
    structure: Complex
    sensed: Sensed

    @classmethod
    def of(
        cls,
        model: ForceModel,
        x: Float,
        near: Complex | None = None,
        acting: Sequence[int] = (0,),
    ) -> Way:
        """Of a force that the motion drives. near : as `realise` has it. acting : the actuators
        whose commands drive the rig.

        Raises InputError as that does.
        """
        made = realise(augmented(model, x, model.force.place), near=near)
        rig = model.built
        n = len(rig.sensor)
        h = 1 / (rig.rate_hz * INNER)
        transition, push = _steps(made.poles, h)
        pairs = np.where(made.poles.imag > 0, 2.0, 1.0)
        at = model.force.place.acts_on(rig)
        by_e = made.residues[:, :n, at].T * (pairs * push)
        late = np.array([round(s.delay / h) for s in rig.sensor], np.int64)
        parts = np.ascontiguousarray(_parts(by_e))
        sensed = Sensed(_parts(transition), parts, np.ascontiguousarray(made.direct[:n, at]), late)
        return cls._made(model, made, sensed, list(acting))

    @classmethod
    def _made(cls, model: ForceModel, made: Realisation, sensed: Sensed, acting: list[int]) -> Way:
        """From partial fractions whose last sensor is what drives the force."""
        rig = model.built
        h = 1 / (rig.rate_hz * INNER)
        late = np.array([round((rig.actuator[a].delay + made.late[a]) / h) for a in acting])
        place = model.force.place
        at = place.acts_on(rig)
        on = np.any(made.residues[:, -1] != 0, axis=1)  # the others are of sensors' filters
        poles = made.poles[on]
        transition, push = _steps(poles, h)
        R = made.residues[on, -1] * np.where(poles.imag > 0, 2.0, 1.0)[:, None]
        D = made.direct[-1]
        if model.force.law.of_speed:  # and at once by what changes it
            D = R.sum(axis=0).real
            R = R * poles[:, None]
        both = push[:, None] * R
        g = float(D[at] + both[:, at].real.sum())
        return cls(
            _parts(transition), np.stack([_parts(both[:, a]) for a in acting]), _parts(both[:, at]),
            D[acting], g, late, 0 if place.own_input else acting.index(at), made.structure.poles,
            sensed,
        )  # fmt: skip

    def force(self, model: ForceModel, v: Float, p: Float, seeds: Float) -> Float:
        """(1 + k, n INNER) a force of numbers p under commands v (n,) or (n, m) that begin when the
        rig is at rest, and its slopes along `seeds` (k, 3).

        Raises InputError where it is no number: the numbers are of no stable rig.
        """
        step = model.force.law.step
        if step is None:
            raise InputError(
                model.rig.name, "force", model.force.law.tag, "a law that a motion drives"
            )
        each = np.ascontiguousarray(v.reshape(len(v), -1).T, np.float64)
        others = np.zeros(len(v) * INNER if len(each) > 1 else 0)
        for j, command in enumerate(each):
            if j != self.own and command.any():
                by_v, late = self.by_v[j], int(self.late[j])
                others += moved(command, self.transition, by_v, float(self.direct[j]), late, INNER)
        # A damper's force over a step is by the way of that.
        by_step, of_part = np.ones(LAW_NUMBERS), model.force.law.of_part
        if "c" in of_part:
            by_step[1 + of_part.index("c")] = model.built.rate_hz * INNER
        e = march(
            step,
            self.transition,
            self.by_v[self.own],
            self.by_e,
            float(self.direct[self.own]),
            self.g,
            each[self.own],
            others,
            int(self.late[self.own]),
            INNER,
            p * by_step,
            seeds * by_step,
        )
        if not np.all(np.isfinite(e[:, -1])):
            raise InputError(model.rig.name, "force", model.force.law.tag, "a stable rig with it")
        return e


@dataclass
class Ways:
    """The partial fractions through which forces act, kept where each was computed first: what the
    chain's parameters change of a force is of second order, until `clear` asks for it."""

    kept: dict[str, Way] = field(default_factory=dict)
    marched: int = 0  # samples, under which forces were computed through any of them
    near: Complex | None = None  # poles, which are the same wherever a force acts
    acting: tuple[int, ...] = (0,)  # actuators whose commands drive the rig

    def at(self, model: ForceModel, x: Float) -> Way:
        """Of a model near x, whatever the strength.

        Raises SamiiRigError where it has none.
        """
        speed = str(model.force.law.of_speed)
        key = " ".join((model.force.place.name, speed, *_linear_keys(model)))
        if key not in self.kept:
            self.kept[key] = Way.of(model, x, self.near, self.acting)
            self.near = self.kept[key].structure
        return self.kept[key]

    def clear(self) -> None:
        """Compute all anew, where they are asked for next."""
        self.kept.clear()


def _linear_keys(model: ForceModel) -> list[str]:
    return [e.key for e in model.effects if e.force is None]


def _steps(poles: Complex, h: float) -> tuple[Complex, Complex]:
    """What a step h makes of the state of each pole, and of an input held over it."""
    transition = np.exp(poles * h)
    still = np.abs(poles) * h < 1e-12
    return transition, np.where(still, h, (transition - 1) / np.where(still, 1.0, poles))


def _parts(x: Complex) -> Float:
    """(2, n) real and imaginary parts."""
    return np.ascontiguousarray(np.stack([x.real, x.imag]))
