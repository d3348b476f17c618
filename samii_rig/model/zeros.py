"""Transmission zeros: where a sensor does not answer, or the poles of a ratio of two sensors.

    zeros(rig, "a_0", "v_2", 50.0)         # of a_0/v_2
    zeros(rig, "a_0", "theta_2", 50.0)     # of a_0/theta_2: the same but what both share

H = N/D with the determinant D of the chain and the sources' own factors; N = H D is analytic,
and its zeros are found and counted as the poles are. The poles of a ratio of two sensors a/b
are the zeros of b, as both share D: `zeros(rig, "theta_2", "v_2", ...)` are the
resonances that theta_2 -> a_0 shows (paper 1, Fig. 6).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import InputError
from samii_rig.model.modes import causal, determinant, own_poles
from samii_rig.model.poles import Characteristic, PoleSet, find_poles
from samii_rig.model.realise import search_region
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Acceleration, Rig
from samii_rig.types import Complex, Float, Int

SHARED = 1e-7  # relative distance below which a zero and a pole cancel
ORIGIN = 1e-6  # rad/s, used for s = 0, where a source's factor is infinite
AT_ORIGIN = 1e-4  # rad/s, a zero of smaller modulus is one at s = 0


@dataclass(frozen=True, slots=True)
class Zeros:
    """Zeros of output/over in a region of the s-plane.

    zero : (n,) rad/s, Im >= 0, by modulus; one with Im > 0 stands for its conjugate as well.
    multiplicity : (n,). at_origin : zeros at s = 0, not among them: two of an acceleration,
        s^2 w, two more of one that only inertia forces move; less the poles at s = 0.
    cancelled : zeros that are poles as well, conjugates included: motions that the output
        does not see or that are not excited.
    found : the search of the numerator, with region and count.
    """

    output: str
    over: str
    zero: Complex
    multiplicity: Int
    at_origin: int
    cancelled: int
    found: PoleSet

    @property
    def hz(self) -> Float:
        """(n,) |z|/(2 pi)."""
        return np.asarray(np.abs(self.zero) / (2 * np.pi))

    @property
    def ratio(self) -> Float:
        """(n,) -Re z/|z|; negative right of the axis, where a zero delays."""
        return np.asarray(0.0 - self.zero.real / np.maximum(np.abs(self.zero), 1e-300))

    @property
    def proof(self) -> str:
        """Why none is missing, in words."""
        r = self.found.region
        return (
            f"{self.found.count} zeros of the numerator of {self.output} counted where "
            f"{r.left:.6g} <= Re s <= {r.right:.6g} and |Im s| <= {r.top:.6g} rad/s, and as "
            f"many found; {self.cancelled} of them cancel in {self.output}/{self.over}; beside "
            f"them {self.at_origin} at s = 0"
        )


def zeros(
    model: Rig | Chain, output: str, over: str, high_hz: float, actuator: str | None = None
) -> Zeros:
    """All zeros of output/over with |z| up to about 2 pi high_hz, left and right of the axis.

    output : a sensor. over : an actuator, or another sensor; then both answer to `actuator`
    (default the only one). Filters and gains of sensors have no part in it.

    Raises InputError for unknown names, an output that never answers, high_hz not above 0.
    """
    chain = model if isinstance(model, Chain) else Chain(model)
    rig = chain.rig
    sensors, actuators = [s.name for s in rig.sensor], [a.name for a in rig.actuator]
    if output not in sensors:
        raise InputError("zeros", "output", output, f"a sensor of {sensors}")
    if over not in sensors + actuators or over == output:
        raise InputError("zeros", "over", over, f"an actuator or another sensor of {rig.name}")
    if over in actuators:
        driven = over
    elif actuator is None and len(actuators) == 1:
        driven = actuators[0]
    elif actuator in actuators:
        driven = str(actuator)
    else:
        raise InputError("zeros", "actuator", actuator, f"one of {actuators}")
    if not (np.isfinite(high_hz) and high_hz > 0):
        raise InputError("zeros", "high_hz", high_hz, "a frequency above 0 Hz")
    region = search_region(rig, high_hz)
    # Zeros of sensors that are not collocated lie right of the axis too.
    region = replace(region, right=region.top)
    found = find_poles(_numerator(chain, output, driven), region)
    if over in actuators:
        other = find_poles(determinant(chain), found.region)
    else:
        other = find_poles(_numerator(chain, over, driven), found.region)
    kept, cancelled = _without(found, other)
    still = np.abs(found.poles[kept]) < AT_ORIGIN
    accelerations = {s.name for s in rig.sensor if isinstance(s, Acceleration)}
    origin = 2 * (output in accelerations) + int(found.multiplicity[kept[still]].sum())
    if over in accelerations:
        origin -= 2
    elif over in actuators:
        origin -= sum(p == 0 for p in own_poles(rig, driven))
    kept = kept[~still]
    return Zeros(
        output,
        over,
        found.poles[kept],
        found.multiplicity[kept],
        max(origin, 0),
        cancelled,
        found,
    )


def _numerator(chain: Chain, output: str, actuator: str) -> Characteristic:
    """H D without the factors of the source and the s^2 of an acceleration."""
    rig = chain.rig
    i = [s.name for s in rig.sensor].index(output)
    j = [a.name for a in rig.actuator].index(actuator)
    own = own_poles(rig, actuator)
    D, H = determinant(chain), causal(chain)
    twice = isinstance(rig.sensor[i], Acceleration)

    def numerator(s: Complex) -> tuple[Complex, Float]:
        s = np.asarray(np.where(s == 0, ORIGIN, s), dtype=np.complex128)
        mantissa, log_scale = D(s)
        value = H.evaluate(s)[:, i, j] * mantissa
        if twice:
            value = value / s**2
        for p in own:
            value = value * (s - p)
        size = np.abs(value)
        log_scale = log_scale + np.log(np.where(size > 0, size, 1.0))
        return np.asarray(value / np.where(size > 0, size, 1.0)), log_scale

    probe = np.asarray(2j * np.pi * np.array([1.0, 3.0, 10.0]))
    if not np.any(np.abs(H.evaluate(probe)[:, i, j]) > 0):
        raise InputError("zeros", "output", output, f"a sensor that answers to {actuator}")
    return numerator


def _without(found: PoleSet, other: PoleSet) -> tuple[Int, int]:
    """Indices of `found` that are none of `other`, and how many (with conjugates) are."""
    free = list(other.poles)
    kept: list[int] = []
    cancelled = 0
    for i, z in enumerate(found.poles):
        near = [p for p in free if abs(p - z) <= SHARED * max(abs(z), 1.0)]
        if near:
            free.remove(near[0])
            cancelled += int(found.multiplicity[i]) * (2 if z.imag > 0 else 1)
        else:
            kept.append(i)
    return np.array(kept, dtype=np.int64), cancelled
