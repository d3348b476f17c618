"""The rig's response stepped exactly: tables of one inner step and of the sensors' read-out.

Each pole of the realisation is a block x' = [[a, -b], [b, a]] x + [1, 0] v. Over a step h at
whose start, middle or end the held output changes, the solution is closed,

    x(h) = exp(p h) x(0) + phi(h - delta) exp(0) v_new + [phi(h) - phi(h - delta)] v_old,
    phi(t) = (exp(p t) - 1)/p,

so neither the hold, nor a delay that is no multiple of h, nor a sensor that is read between
two steps costs any accuracy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from samii_rig.model.realise import Realisation
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, Int


class Tables(NamedTuple):
    """One inner step, the same for every step. n poles, m sensors.

    decay, old, new : (2, n) real and imaginary parts: exp(p h), and what the inputs before
        and after the output's change within the step add to the state. An input that does not
        change adds old + new.
    change : the inner step of a sample in which the output changes; pipeline : whole samples
        that a command waits before that.
    row : (m, 2, n) sensor values from the state at the start of the step they are read in.
    row_old, row_new, row_extra : (m,) from the inputs of that step.
    ahead : (m,) inner steps by which that step lies before the sample's own instant.
    mean : share of the step before the change.
    """

    inner: int
    decay: Float
    old: Float
    new: Float
    change: int
    pipeline: int
    mean: float
    row: Float
    row_old: Float
    row_new: Float
    row_extra: Float
    ahead: Int


def tabulate(rig: Rig, made: Realisation, inner: int, actuator: int = 0) -> Tables:
    """Tables of the response to one actuator at `inner` steps a sample."""
    h = 1.0 / (rig.rate_hz * inner)
    p = made.poles
    whole, delta = _split(rig.actuator[actuator].delay + float(made.late[actuator]), h)
    pipeline, change = divmod(whole, inner)
    new = _phi(p, h - delta)
    old = _phi(p, h) - new
    weight = np.where(p.imag > 0, 2.0, 1.0)[:, None] * made.residues[:, :, actuator]
    m = len(rig.sensor)
    row = np.zeros((m, 2, p.size))
    row_old, row_new, row_extra = np.zeros(m), np.zeros(m), np.zeros(m)
    ahead = np.zeros(m, dtype=np.int64)
    for i, sensor in enumerate(rig.sensor):
        behind, into = _split(sensor.delay, h)
        if into > 0:
            behind, into = behind + 1, h - into
        ahead[i] = behind
        c = weight[:, i]
        carried = c * np.exp(p * into)
        row[i, 0], row[i, 1] = carried.real, -carried.imag
        # Read before or after the output changes within the step, the side before included.
        late = max(into - delta, 0.0)
        all_in, new_in = (c @ _phi(p, into)).real, (c @ _phi(p, late)).real
        D = made.direct[i, actuator]
        row_new[i] = new_in + (D if late > 0 else 0.0)
        row_old[i] = all_in - new_in + (0.0 if late > 0 else D)
        row_extra[i] = all_in + D
    return Tables(
        inner,
        _parts(np.exp(p * h)),
        _parts(old),
        _parts(new),
        change,
        pipeline,
        delta / h,
        row,
        row_old,
        row_new,
        row_extra,
        ahead,
    )


def _split(delay: float, h: float) -> tuple[int, float]:
    """A delay as whole steps and a rest in [0, h)."""
    whole = int(np.floor(delay / h + 1e-9))
    rest = delay - whole * h
    return whole, (rest if rest > 1e-9 * h else 0.0)


def _phi(p: Complex, t: float) -> Complex:
    safe = np.where(p == 0, 1.0, p)
    return np.where(p == 0, t, np.expm1(safe * t) / safe)


def _parts(z: Complex) -> Float:
    return np.stack([z.real, z.imag])
