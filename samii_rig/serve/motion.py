"""How the chain moves, from what its sensors read: for a drawing that moves with the rig.

displacement = matrix @ y: y are the angles of the encoders and the accelerations integrated twice.
Each matrix is the one that comes nearest to the model's own motion about one frequency, with any
actuator: at a sensor the drawing shows what is measured, between them what the model has there
when it reads that. Where the whole band is driven, or nothing, slow motions count for most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.errors import SamiiRigError
from samii_rig.model.sampled import sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    Displacement,
    RelativeAngle,
    Rig,
    Sensor,
)
from samii_rig.rig.schema.elements import BEAMS, RigidLink
from samii_rig.types import Complex, Float

LOWEST, HIGHEST, MOTION_POINTS = 0.3, 0.1, 240  # Hz, of the sample rate, and frequencies between
FIRST = 0.5  # Hz about which the first matrix is taken; the others an octave apart
OCTAVES = 0.4  # standard deviation of the frequencies that one counts
BENDS = 16  # points along a beam
# Of the largest singular value: less of a combination of sensors than this says nothing by itself.
LEAST = 0.01


@dataclass(frozen=True, slots=True)
class Motion:
    """displacement = matrix[k] @ y, (n,) m, y (n_sensors,) in rad and m.

    x : (n,) m from the base along the chain. element : (n,) the element that ends or bends there.
    hz : (n_k,) about which each matrix holds; the first, 0, for more than one frequency at once.
    sensors : names; accelerations : whether each is one, to be integrated twice.
    """

    x: Float
    element: tuple[str, ...]
    sensors: tuple[str, ...]
    accelerations: tuple[bool, ...]
    hz: Float
    matrix: Float


def motion(rig: Rig) -> Motion | None:
    """None for a rig whose sensors show no motion, or whose model gives none; and for a chain
    that moves along itself, which has no line to bend."""
    if rig.motion == "axial":
        return None
    at = [i for i, s in enumerate(rig.sensor) if _shows(s)]
    if not at:
        return None
    used = [rig.sensor[i] for i in at]
    beams = [e for e in rig.element if isinstance(e, BEAMS)]
    positions = {e.name: np.linspace(0, e.L.value, BENDS + 1).tolist() for e in beams}
    f = np.geomspace(LOWEST, HIGHEST * rig.rate_hz, MOTION_POINTS)
    try:
        chain = Chain(rig)
        W = chain.field(f, positions=positions)[..., 0]
        read = chain.response(f) * sensor_response(rig.sensor, f)[:, :, None]
    except SamiiRigError:
        return None
    integrated = np.array([isinstance(s, Acceleration) for s in used])
    twice = np.where(integrated, 1 / (2j * np.pi * f[:, None]) ** 2, 1.0)
    Y = (read[:, at] * twice[:, :, None]).swapaxes(1, 2)
    # Each frequency counts by the largest displacement that it makes.
    size = np.abs(W).max(axis=2, keepdims=True)
    if not (np.isfinite(size).all() and (size > 0).all()):
        return None
    W, Y = W / size, Y / size
    hz = FIRST * 2.0 ** np.arange(0, np.log2(f[-1] / FIRST))
    near = np.exp(-0.5 * (np.log2(f / hz[:, None]) / OCTAVES) ** 2)
    weights = np.concatenate([1 / f[None], near])
    matrix = np.stack([_nearest(W, Y, w) for w in weights])
    places = chain.places(positions)
    return Motion(
        np.array([_reach(rig)[name] + x for name, x in places]),
        tuple(name for name, _ in places),
        tuple(s.name for s in used),
        tuple(integrated.tolist()),
        np.concatenate([[0.0], hz]),
        matrix,
    )


def _nearest(W: Complex, Y: Complex, weight: Float) -> Float:
    """(n, m) real matrix with W = matrix Y as near as may be; W (n_freq, n_in, n), Y (.., m)."""
    w, y = (np.reshape(x * weight[:, None, None], (-1, x.shape[2])) for x in (W, Y))
    w, y = (np.concatenate([x.real, x.imag]) for x in (w, y))
    scale = np.linalg.norm(y, axis=0)
    scale[scale == 0] = 1.0
    return np.asarray((np.linalg.pinv(y / scale, rcond=LEAST) @ w).T / scale, float)


def _shows(sensor: Sensor) -> bool:
    if isinstance(sensor, Acceleration):
        # One that reads gravity as it turns cannot be integrated.
        return sensor.tilt == 0.0
    return isinstance(sensor, RelativeAngle | AbsoluteAngle | Displacement)


def _reach(rig: Rig) -> dict[str, float]:
    """Where each element begins, m along the chain."""
    found, reached = {}, 0.0
    for e in rig.element:
        found[e.name] = reached
        reached += e.L.value if isinstance(e, (RigidLink, *BEAMS)) else 0.0
    return found
