"""Margins of all loops of a rig together: how much every output may change at once.

One loop at a time shows nothing of two that change together (Doyle 1978): with L (k, k) the gain of
all loops cut at the outputs, S = (I + L)^-1 and T = L S,

    alpha = 1/max_f mu(S - I/2)

is the largest disk of factors, one for each output, different and complex, that keeps the loops
stable: each gain may change by (2 + alpha)/(2 - alpha) up and down, or each phase by
2 arctan(alpha/2) (Seiler, Packard and Gahinet 2020, IEEE Control Syst. Mag. 40(5)). mu is the
structured singular value for such factors, min over D of sigma_max(D M D^-1), exact for up to three
outputs and above that no larger than alpha says.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize

from samii_rig.control.plants import Plant
from samii_rig.model.loops import Loops, loops_of
from samii_rig.model.sampled import hold_at, sensors_at
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

# Points of the arc around s = 0, where integrators are, over a right angle: four degrees apart a
# product of ten integrators turns by less than half a turn from one to the next.
ARC = 24
MOST_WINDING = 0.5  # half turns: a stable loop's determinant makes none
FARTHEST = 12.0  # log of D: factors beyond 1e5 between outputs are none that units make
CLOSE = 1e-6  # of log D


@dataclass(frozen=True, slots=True)
class Multiloop:
    """Margins of all loops at once, negative feedback.

    outputs : those with a loop. stable : of all together, by Nyquist's count. alpha : the disk;
    worst at alpha_hz. gain_db, phase_deg : what every output may change by at once; inf for
    alpha >= 2. smallest : least singular value of I + L, the inverse of the largest of S; at
    smallest_hz. loops_alone : alpha of each output with the others closed and unchanged.
    """

    outputs: tuple[str, ...]
    stable: bool
    alpha: float
    alpha_hz: float
    gain_db: float
    phase_deg: float
    smallest: float
    smallest_hz: float
    loops_alone: tuple[float, ...]


def multiloop(given: Plant, rig: Rig) -> Multiloop | None:
    """The margins of the loops of a rig file on its plant; None where fewer than two run."""
    every = [loops_of(rig, a.name) for a in rig.actuator]
    loops = [one for one in every if one.kp or one.feedback]
    if len(loops) < 2:
        return None
    L = gain_of(rig, loops, given.frequency, given.response)
    S = np.linalg.inv(np.eye(len(loops)) + L)
    mu = np.array([structured(M) for M in S - np.eye(len(loops)) / 2])
    alone = 1 / np.max(np.abs(np.diagonal(S, axis1=1, axis2=2) - 0.5), axis=0)
    size = np.linalg.norm(S, 2, axis=(1, 2))
    at, far = int(np.argmax(mu)), int(np.argmax(size))
    gain_db, phase_deg = disk(1 / float(mu[at]))
    return Multiloop(
        tuple(rig.actuator[one.actuator].name for one in loops),
        _stable(rig, loops, given, L),
        1 / float(mu[at]),
        float(given.frequency[at]),
        gain_db,
        phase_deg,
        1 / float(size[far]),
        float(given.frequency[far]),
        tuple(float(a) for a in alone),
    )


def gain_of(rig: Rig, loops: list[Loops], f: Float, H: Complex) -> Complex:
    """L (n, k, k) of H (n, n_sensor, n_actuator) at f (n,) Hz, cut at the outputs of the loops."""
    return _gain(rig, loops, np.exp(2j * np.pi * f / rig.rate_hz), H)


def _gain(rig: Rig, loops: list[Loops], z: Complex, H: Complex) -> Complex:
    rows = []
    for one in loops:
        filters = one.filters(z, rig.rate_hz)
        rows.append([replace(one, actuator=x.actuator).gain(H, filters) for x in loops])
    return np.moveaxis(np.array(rows), 2, 0)


def disk(alpha: float) -> tuple[float, float]:
    """dB and degrees by which a factor in the disk may change a loop."""
    if alpha >= 2:
        return math.inf, 2 * math.degrees(math.atan(alpha / 2))
    gain = 20 * math.log10((2 + alpha) / (2 - alpha))
    return gain, 2 * math.degrees(math.atan(alpha / 2))


def structured(M: Complex) -> float:
    """min over D of sigma_max(D M D^-1) of M (k, k), D diagonal: mu for a factor an output."""

    def size(log: Float) -> float:
        d = np.exp(np.append(log, 0.0))
        return float(np.linalg.norm(d[:, None] * M / d, 2))

    if len(M) == 2:  # convex in log D (Sezginer and Overton 1990)
        one = optimize.minimize_scalar(
            lambda x: size(np.array([x])),
            bounds=(-FARTHEST, FARTHEST),
            method="bounded",
            options={"xatol": CLOSE},
        )
        return float(one.fun)
    start = np.zeros(len(M) - 1)
    found = optimize.minimize(size, start, method="Nelder-Mead", options={"xatol": CLOSE})
    return float(min(found.fun, size(start)))


def _stable(rig: Rig, loops: list[Loops], given: Plant, L: Complex) -> bool:
    """By Nyquist's count: det(I + L) does not turn along an arc beside s = 0, then up to half the
    rate. L : (n, k, k) at the plant's frequencies."""
    s = 2 * np.pi * given.frequency[0] * np.exp(0.5j * np.pi * np.arange(ARC) / ARC)
    hold = np.stack([hold_at(s, rig.rate_hz, a.delay) for a in rig.actuator], axis=1)
    # So far below the rate no alias counts.
    H = Chain(rig).evaluate(s) * sensors_at(rig.sensor, s)[:, :, None] * hold[:, None, :]
    near = _gain(rig, loops, np.exp(s / rig.rate_hz), H)
    D = np.linalg.det(np.eye(len(loops)) + np.concatenate([near, L]))
    turns = float(np.abs(np.sum(np.diff(np.unwrap(np.angle(D))))) / np.pi)
    return turns < MOST_WINDING


def line(found: Multiloop) -> str:
    """In words."""
    if not found.stable:
        return f"the loops of {' and '.join(found.outputs)} together: NOT STABLE"
    gain = f"{found.gain_db:.3g} dB" if math.isfinite(found.gain_db) else "any gain"
    return (
        f"the loops of {' and '.join(found.outputs)} together: each may change by {gain} or "
        f"{found.phase_deg:.3g} deg at once (disk margin {found.alpha:.3g} at "
        f"{found.alpha_hz:.3g} Hz), smallest singular value of I + L {found.smallest:.3g} at "
        f"{found.smallest_hz:.3g} Hz"
    )


def plain(found: Multiloop | None) -> dict[str, Any] | None:
    """As data."""
    return None if found is None else asdict(found)
