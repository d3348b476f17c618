"""A force in the loop of the rig, instant by instant, while the command repeats itself.

The partial fractions of the rig's way from command and force to what drives the force move by
exact steps, some to a sample. The force is held over each and found together with the motion
that it makes: dry friction stops what it can hold, play and hardening act on the middle of the
step, so that errors fall with the square of its length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from samii_rig.diagnose.nonlinear_laws import CUBIC, FRICTION, GAP, Law
from samii_rig.diagnose.nonlinear_model import LevelModel
from samii_rig.diagnose.rigfile import valued
from samii_rig.model.realise import Realisation, realise
from samii_rig.model.sampled import hold_response
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, Int

INNER = 8  # steps a sample
NEWTON = 5  # steps to the root of a cubic that is monotonous
LAPS, SAME = 10, 1e-3  # periods at most; of the largest force, by which the last two may differ
MEMORY, KEPT = 4, 1e-8  # differences of earlier periods that are used, of what singular value
STAYS = 0.02  # of a state, lost in a period: one that loses less is left where it is
DRY, CUBE, PLAY, FLOW = range(4)
_CODES: tuple[tuple[Law | None, int], ...] = ((FRICTION, DRY), (CUBIC, CUBE), (GAP, PLAY))


@njit(cache=True, fastmath={"reassoc", "contract", "nsz"})
def _lap(
    w: Float,
    grow: Float,
    by_v: Float,
    by_e: Float,
    direct: float,
    g: float,
    v: Float,
    late: int,
    inner: int,
    code: int,
    p: float,
    scale: float,
) -> Float:
    """(n inner,) the force over one period of the command v (n,), from the states w, which are
    left as they are then.

    w, grow, by_v, by_e : (2, n_pole) real and imaginary parts. What drives the force is the sum
    of all real parts, and direct and g per unit of command and of force.
    """
    n_pole = w.shape[1]
    wr, wi, gr, gi = w[0], w[1], grow[0], grow[1]
    vr, vi, er, ei = by_v[0], by_v[1], by_e[0], by_e[1]
    e = np.zeros(v.size * inner)
    before, f = 0.0, 0.0
    for step in range(e.size):
        u = v[(step - late) // inner]
        y = 0.0
        for k in range(n_pole):
            real, imag = wr[k] + er[k] * f, wi[k] + ei[k] * f
            wr[k] = gr[k] * real - gi[k] * imag + vr[k] * u
            wi[k] = gr[k] * imag + gi[k] * real + vi[k] * u
            y += wr[k]
        y += direct * u
        f = 0.0
        if code == DRY:
            f = min(max(-y / g, -p), p)
        elif code == PLAY:
            middle = 0.5 * (before + y) / (1.0 - 0.5 * g * scale)
            f = scale * min(max(middle, -p / 2), p / 2)
        elif code == CUBE:
            free, slope = 0.5 * (before + y), 0.5 * g * scale * p
            x = before
            for _ in range(NEWTON):
                x -= (x - free - slope * x * x * x) / (1.0 - 3.0 * slope * x * x)
            f = scale * p * x * x * x
        else:
            moment = 0.5 * (before + y)
            against = 1.0 + moment / p if u >= 0.0 else 1.0 - moment / p
            f = u * (np.sqrt(max(against, 0.0)) - 1.0)
        e[step] = f
        before = y + g * f
    for k in range(n_pole):
        wr[k] += er[k] * f
        wi[k] += ei[k] * f
    return e


@njit(cache=True, fastmath={"reassoc", "contract", "nsz"})
def _read(
    e: Float, grow: Float, by_e: Float, direct: Float, inner: int, late: Int, n: int
) -> Float:
    """(n, q) what sensors show of a force e (n inner,), before each sample's steps.

    grow : (2, n_pole); by_e : (2, q, n_pole) what a force held over a step makes of each sensor's
    state. late : (q,) steps of each sensor's delay.
    """
    q, n_pole = by_e.shape[1], by_e.shape[2]
    out = np.zeros((n, q))
    wr, wi = np.zeros(n_pole), np.zeros(n_pole)
    before = 0.0
    for step in range(e.size):
        for i in range(q):
            if (step + late[i]) % inner == 0 and (step + late[i]) // inner < n:
                y = direct[i] * before
                for k in range(n_pole):
                    y += by_e[0, i, k] * wr[k] - by_e[1, i, k] * wi[k]
                out[(step + late[i]) // inner, i] = y
        before = e[step]
        for k in range(n_pole):
            real = grow[0, k] * wr[k] - grow[1, k] * wi[k] + before
            wi[k] = grow[0, k] * wi[k] + grow[1, k] * wr[k]
            wr[k] = real
    return out


@dataclass(frozen=True, slots=True)
class Sensed:
    """A rig's partial fractions from a force to its sensors, no loop closed; as `_read` has it."""

    grow: Float
    by_e: Float
    direct: Float
    late: Int

    def of(self, e: Float) -> Float:
        """(n, q) of a force e (n INNER,) from rest."""
        n = e.size // INNER
        return _read(e, self.grow, self.by_e, self.direct, INNER, self.late, n)


@dataclass(frozen=True, slots=True)
class Inner:
    """A rig's partial fractions from command and force to what drives the force, by exact steps.

    The rig has one actuator. grow, by_v, by_e : (2, n_pole) what a step makes of a state, and of
    command and force held over it, real and imaginary parts. direct, g : as `_lap` has them.
    late : steps of dead time. code : of the law. scale : e = scale times what the law says.
    structure : the chain's own poles.
    """

    grow: Float
    by_v: Float
    by_e: Float
    direct: float
    g: float
    late: int
    code: int
    scale: float
    rate_hz: float
    structure: Complex

    @classmethod
    def of(cls, model: LevelModel, x: Float, near: Complex | None = None) -> Inner:
        """Of a force that the motion drives. near : as `realise` has it.

        Raises InputError as that does.
        """
        wide = _widened(model, x)
        own = wide.model_copy(update={"sensor": wide.sensor[len(model.built.sensor) :]})
        return cls._made(model, x, realise(own, near=near))

    @classmethod
    def sensed(
        cls, model: LevelModel, x: Float, near: Complex | None = None
    ) -> tuple[Inner, Sensed]:
        """As `of`, and the way from the force to the rig's sensors."""
        made = realise(_widened(model, x), near=near)
        rig = model.built
        n = len(rig.sensor)
        h = 1 / (rig.rate_hz * INNER)
        grow, push = _steps(made.poles, h)
        pairs = np.where(made.poles.imag > 0, 2.0, 1.0)
        by_e = made.residues[:, :n, -1].T * (pairs * push)
        late = np.array([round(s.delay / h) for s in rig.sensor], np.int64)
        parts = np.ascontiguousarray(_parts(by_e))
        return cls._made(model, x, made), Sensed(_parts(grow), parts, made.direct[:n, -1], late)

    @classmethod
    def _made(cls, model: LevelModel, x: Float, made: Realisation) -> Inner:
        """From partial fractions whose last sensor is what drives the force."""
        quasi, rig = model.quasi, model.built
        h = 1 / (rig.rate_hz * INNER)
        late = round((rig.actuator[0].delay + float(made.late[0])) / h)
        code = next((c for law, c in _CODES if law is quasi.law), FLOW)
        scale = quasi.sign * model.strength(x)[1]
        on = np.any(made.residues[:, -1] != 0, axis=1)  # the others are of sensors' filters
        poles = made.poles[on]
        grow, push = _steps(poles, h)
        R = made.residues[on, -1] * np.where(poles.imag > 0, 2.0, 1.0)[:, None]
        D = made.direct[-1]
        if code == DRY:  # driven by the speed, and at once by what changes it
            D = R.sum(axis=0).real
            R = R * poles[:, None]
        both = push[:, None] * R
        g = float(D[-1] + both[:, -1].real.sum())
        return cls(
            _parts(grow), _parts(both[:, 0]), _parts(both[:, -1]), float(D[0]), g, late, code,
            scale, rig.rate_hz, made.structure.poles,
        )  # fmt: skip

    def from_rest(self, v: Float, p: float) -> Float:
        """(n INNER,) the force p under a command v (n,) that begins when the rig is at rest."""
        quiet = -(-self.late // INNER)  # samples before the command arrives
        e = _lap(
            np.zeros_like(self.grow), self.grow, self.by_v, self.by_e, self.direct, self.g,
            np.concatenate([v, np.zeros(quiet)]), self.late, INNER, self.code, p, self.scale,
        )  # fmt: skip
        return e[: v.size * INNER]

    def force(self, v: Float, p: float) -> Float:
        """(n INNER,) the force p in a period of a command v (n,) that has gone on until the force
        repeats itself too: a lightly damped rig remembers more than one burst.

        A state that is the same before and after a period is what a linear rig has at once from
        what one period makes of rest; what the force changes of it is found by Anderson's method.
        """
        start, e = np.zeros_like(self.grow), v
        before: Float | None = None
        seen: list[tuple[Float, Float]] = []
        for lap in range(LAPS):
            w = start.copy()
            e = _lap(
                w, self.grow, self.by_v, self.by_e, self.direct, self.g,
                np.ascontiguousarray(v), self.late, INNER, self.code, p, self.scale,
            )  # fmt: skip
            if before is not None and np.max(np.abs(e - before)) <= SAME * np.max(np.abs(e)):
                break
            before = e
            if lap == 0:
                start = self._settled(w, v.size * INNER)
            else:
                seen = [*seen[-MEMORY:], (start.ravel(), (w - start).ravel())]
                start = _mixed(seen).reshape(w.shape)
        return np.asarray(e)

    def _settled(self, w: Float, steps: int) -> Float:
        """The states that so many steps lead back to, where they lead from rest to w."""
        kept = (self.grow[0] + 1j * self.grow[1]) ** steps
        lost = np.where(np.abs(1 - kept) > STAYS, 1 - kept, 1.0)
        return _parts((w[0] + 1j * w[1]) / lost)

    def lines(self, v: Float, bins: Int, p: float) -> Complex:
        """The same at these cycles a period; a sum over samples, as that of v."""
        f = np.asarray(bins * self.rate_hz / v.size)
        held = hold_response(f, self.rate_hz * INNER)
        return np.asarray(np.fft.rfft(self.force(v, p))[bins] / INNER * held)


def _widened(model: LevelModel, x: Float) -> Rig:
    """The rig at x with what its force needs more."""
    values = model.values(x)
    element = tuple(valued(e, values, {}) for e in model.built.element)
    return model.quasi.widened(model.built.model_copy(update={"element": element}))


def _steps(poles: Complex, h: float) -> tuple[Complex, Complex]:
    """What a step h makes of the state of each pole, and of an input held over it."""
    grow = np.exp(poles * h)
    still = np.abs(poles) * h < 1e-12
    return grow, np.where(still, h, (grow - 1) / np.where(still, 1.0, poles))


def _mixed(seen: Sequence[tuple[Float, Float]]) -> Float:
    """Where a period should change nothing: from states (n,) and what a period changed of each, the
    last as it is or led on by how the changes changed (Anderson, J. ACM 12, 1965)."""
    x, f = (np.array(rows) for rows in zip(*seen, strict=True))
    d_x, d_f = np.diff(x, axis=0).T, np.diff(f, axis=0).T
    along = np.linalg.lstsq(d_f, f[-1], rcond=KEPT)[0]
    return np.asarray(x[-1] + f[-1] - (d_x + d_f) @ along)


def _parts(x: Complex) -> Float:
    """(2, n) real and imaginary parts."""
    return np.stack([x.real, x.imag])
