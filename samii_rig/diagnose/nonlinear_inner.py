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
from samii_rig.model.realise import realise
from samii_rig.model.sampled import hold_response
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
        quasi, values = model.quasi, model.values(x)
        rig = model.built.model_copy(
            update={"element": tuple(valued(e, values, {}) for e in model.built.element)}
        )
        wide = quasi.widened(rig)
        own = wide.model_copy(update={"sensor": wide.sensor[len(rig.sensor) :]})
        made = realise(own, near=near)
        h = 1 / (rig.rate_hz * INNER)
        grow = np.exp(made.poles * h)
        still = np.abs(made.poles) * h < 1e-12
        push = np.where(still, h, (grow - 1) / np.where(still, 1.0, made.poles))
        pairs = np.where(made.poles.imag > 0, 2.0, 1.0)[:, None]
        late = round((rig.actuator[0].delay + float(made.late[0])) / h)
        code = next((c for law, c in _CODES if law is quasi.law), FLOW)
        scale = quasi.sign * model.strength(x)[1]
        R = made.residues[:, 0] * pairs
        D = made.direct[0]
        if code == DRY:  # driven by the speed, and at once by what changes it
            D = R.sum(axis=0).real
            R = R * made.poles[:, None]
        both = push[:, None] * R
        g = float(D[-1] + both[:, -1].real.sum())
        return cls(
            _parts(grow), _parts(both[:, 0]), _parts(both[:, -1]), float(D[0]), g, late, code,
            scale, rig.rate_hz, made.structure.poles,
        )  # fmt: skip

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
