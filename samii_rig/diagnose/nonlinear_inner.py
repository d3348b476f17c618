"""A force in the loop of the rig, instant by instant, while the command repeats itself.

The partial fractions of the rig's way from command and force to what drives the force move by
exact steps, some to a sample. The force is held over each and found together with the motion
that it makes: dry friction stops what it can hold, play and hardening act on the middle of the
step, so that errors fall with the square of its length.
"""

from __future__ import annotations

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
DRY, CUBE, PLAY, FLOW = range(4)
_CODES: tuple[tuple[Law | None, int], ...] = ((FRICTION, DRY), (CUBIC, CUBE), (GAP, PLAY))


@njit(cache=True)
def _lap(
    z: Complex,
    poles: Complex,
    grow: Complex,
    push: Complex,
    R: Complex,
    D: Float,
    v: Float,
    late: int,
    inner: int,
    code: int,
    p: float,
    scale: float,
) -> Float:
    """(n inner,) the force over one period of the command v (n,), from the states z (n_pole,
    n_in), which are left as they are then.

    R : (n_pole, n_in), pairs counted twice, and D : (n_in,) of what drives the force; the last
    input is the force's.
    """
    n_pole, n_in = R.shape
    own = n_in - 1
    # Reading at the end of a step, of a state and per unit force over it.
    W = np.zeros((n_pole, n_in), dtype=np.complex128)
    g = 0.0 if code == DRY else D[own]
    for k in range(n_pole):
        for j in range(n_in):
            W[k, j] = R[k, j] * (poles[k] if code == DRY else 1.0)
        g += (W[k, own] * push[k]).real
        if code == DRY:
            g += R[k, own].real
    e = np.zeros(v.size * inner)
    before = 0.0
    for step in range(e.size):
        u = v[(step - late) // inner]
        y = 0.0 if code == DRY else D[0] * u
        for k in range(n_pole):
            z[k, 0] = grow[k] * z[k, 0] + push[k] * u
            y += (W[k, 0] * z[k, 0]).real
            if code == DRY:
                y += R[k, 0].real * u
            if own == 1:
                z[k, 1] = grow[k] * z[k, 1]
                y += (W[k, 1] * z[k, 1]).real
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
        for k in range(n_pole):
            z[k, own] += push[k] * f
        before = y + g * f
    return e


@dataclass(frozen=True, slots=True)
class Inner:
    """A rig's partial fractions from command and force to what drives the force, by exact steps.

    The rig has one actuator. poles : (n_pole,) rad/s, of pairs one. grow, push : (n_pole,) what a
    step makes of a state, and of an input held over it. R, D : (n_pole, n_in), (n_in,) as `_lap`.
    late : steps of dead time. code : of the law. scale : e = scale times what the law says.
    """

    poles: Complex
    grow: Complex
    push: Complex
    R: Complex
    D: Float
    late: int
    code: int
    scale: float
    rate_hz: float

    @classmethod
    def of(cls, model: LevelModel, x: Float) -> Inner:
        """Of a force that the motion drives. Raises InputError as `realise` does."""
        quasi, values = model.quasi, model.values(x)
        rig = model.built.model_copy(
            update={"element": tuple(valued(e, values, {}) for e in model.built.element)}
        )
        wide = quasi.widened(rig)
        made = realise(wide.model_copy(update={"sensor": wide.sensor[len(rig.sensor) :]}))
        h = 1 / (rig.rate_hz * INNER)
        grow = np.exp(made.poles * h)
        still = np.abs(made.poles) * h < 1e-12
        push = np.where(still, h, (grow - 1) / np.where(still, 1.0, made.poles))
        pairs = np.where(made.poles.imag > 0, 2.0, 1.0)[:, None]
        late = round((rig.actuator[0].delay + float(made.late[0])) / h)
        code = next((c for law, c in _CODES if law is quasi.law), FLOW)
        scale = quasi.sign * model.strength(x)[1]
        R = np.ascontiguousarray(made.residues[:, 0] * pairs)
        return cls(
            made.poles, grow, push, R, made.direct[0], late, code, scale, rig.rate_hz
        )  # fmt: skip

    def force(self, v: Float, p: float) -> Float:
        """(n INNER,) the force p in the second period of a command v (n,)."""
        z = np.zeros((self.poles.size, self.R.shape[1]), complex)
        e = v
        for _ in range(2):
            e = _lap(
                z, self.poles, self.grow, self.push, self.R, self.D, np.ascontiguousarray(v),
                self.late, INNER, self.code, p, self.scale,
            )  # fmt: skip
        return np.asarray(e)

    def lines(self, v: Float, bins: Int, p: float) -> Complex:
        """The same at these cycles a period; a sum over samples, as that of v."""
        f = np.asarray(bins * self.rate_hz / v.size)
        held = hold_response(f, self.rate_hz * INNER)
        return np.asarray(np.fft.rfft(self.force(v, p))[bins] / INNER * held)
