"""Which measured mode is which mode of the model, or of another recording.

The modal assurance criterion compares shapes at the sensors that both have:

    MAC(a, b) = |a^H S b|^2/((a^H S a)(b^H S b))

(Allemang and Brown, IMAC 1, 1982). It depends on units where sensors differ in kind, so S scales
the sensors of each unit to the root mean square that the measured shape has among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.modal.modes import ModalModel, Mode
from samii_rig.rig.schema import Acceleration, Rig
from samii_rig.types import Complex, Float

FAR = 0.3  # relative distance of two frequencies that are never one mode
ALIKE = 0.5  # MAC below which two shapes are never one mode
APART = 0.1  # relative distance of frequencies that weighs as much as a MAC of 0
REACH = 1.3  # over the highest frequency measured: how far modes of the model are looked for


@dataclass(frozen=True, slots=True)
class Known:
    """A mode to compare with.

    frequency_hz, damping. shape : reading by output; empty where it is not known.
    x, w : (n,) m from the base and complex displacement there, of a model's mode; empty else.
    sensors : m from the base of each accelerometer of the model.
    """

    frequency_hz: float
    damping: float
    shape: dict[str, complex]
    x: Float = field(default_factory=lambda: np.zeros(0))
    w: Complex = field(default_factory=lambda: np.zeros(0, dtype=np.complex128))
    sensors: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Pair:
    """A measured mode and its counterpart, by their indices.

    mac : NaN where fewer than two sensors are shared.
    """

    mode: int
    other: int
    mac: float


def mac(a: Complex, b: Complex, units: Sequence[str]) -> float:
    """MAC of two shapes (n,) at the same sensors of `units`; NaN for fewer than two sensors.

    The scales of units are those of `a`.
    """
    if len(a) < 2:
        return float("nan")
    S = scales(a, units)
    cross = abs(np.sum(a.conj() * S * b)) ** 2
    sizes = float(np.sum(S * np.abs(a) ** 2) * np.sum(S * np.abs(b) ** 2))
    return float(cross / sizes) if sizes > 0 else float("nan")


def scales(a: Complex, units: Sequence[str]) -> Float:
    """(n,) S of the MAC: one over the mean square that `a` has among the sensors of each unit."""
    S = np.empty(len(a))
    for unit in set(units):
        at = np.array([u == unit for u in units])
        S[at] = 1 / max(float(np.mean(np.abs(a[at]) ** 2)), np.finfo(float).tiny)
    return S


def mac_matrix(found: ModalModel, known: Sequence[Known]) -> Float:
    """(n_mode, n_known) MAC of each mode with each other, NaN where it cannot be said."""
    return _alike([m.shape for m in found.modes], found.outputs, found.units, known)


def _alike(
    shapes: Sequence[Complex], outputs: Sequence[str], units: Sequence[str], known: Sequence[Known]
) -> Float:
    out = np.full((len(shapes), len(known)), np.nan)
    for j, other in enumerate(known):
        at = [k for k, name in enumerate(outputs) if name in other.shape]
        if not at:
            continue
        b = np.array([other.shape[outputs[k]] for k in at])
        own = [units[k] for k in at]
        out[:, j] = [mac(shape[at], b, own) for shape in shapes]
    return out


def pairs(found: ModalModel, known: Sequence[Known]) -> tuple[Pair, ...]:
    """The pairs that lie closest in frequency and shape together, each mode once at most."""
    f = [m.frequency_hz.value for m in found.modes]
    return paired(f, [m.shape for m in found.modes], found.outputs, found.units, known)


def paired(
    hz: Sequence[float],
    shapes: Sequence[Complex],
    outputs: Sequence[str],
    units: Sequence[str],
    known: Sequence[Known],
) -> tuple[Pair, ...]:
    """The same of modes at `hz` with shapes (n_out,) at `outputs` of `units`."""
    if not (len(hz) and known):
        return ()
    f = np.asarray(hz)
    g = np.array([k.frequency_hz for k in known])
    off = np.abs(np.log(f[:, None] / g[None, :]))
    alike = _alike(shapes, outputs, units, known)
    never = (off > FAR) | (alike < ALIKE)
    cost = off / APART + np.where(np.isnan(alike), 0.0, 1 - alike)
    worst = float(np.max(cost)) * (len(f) + len(g)) + 1.0
    rows, columns = linear_sum_assignment(np.where(never, worst, cost))
    return tuple(
        Pair(int(i), int(j), float(alike[i, j]))
        for i, j in zip(rows, columns, strict=True)
        if not never[i, j]
    )


def known_of(found: ModalModel) -> tuple[Known, ...]:
    """The modes of another recording, to compare with."""
    return tuple(_known(m, found.outputs) for m in found.modes)


def _known(m: Mode, outputs: Sequence[str]) -> Known:
    shape = {name: complex(x) for name, x in zip(outputs, m.shape, strict=True)}
    return Known(m.frequency_hz.value, m.damping.value, shape)


def model_modes(rig: Rig, high_hz: float) -> tuple[Known, ...]:
    """Oscillating modes of the rig's damped chain up to a little beyond `high_hz`.

    Shapes are the sensors' readings, filters and delays left out as in the measured ones.
    """
    from samii_rig.model.modes import poles  # loads the model and its compiler
    from samii_rig.model.shapes import mode_shape

    try:
        found = poles(rig, REACH * high_hz)
    except InputError:  # a chain without a pole in the band: no mode to compare with
        return ()
    out = []
    for pole, hz, ratio in zip(found.pole, found.hz, found.ratio, strict=True):
        if pole.imag <= 0 or hz > REACH * high_hz:
            continue
        try:
            m = mode_shape(rig, complex(pole))
        except SamiiRigError:  # two modes at one place: it has no shape of its own
            out.append(Known(float(hz), float(ratio), {}))
            continue
        start = {name: float(x - at) for (name, at), x in zip(m.place, m.x, strict=True)}
        places = {
            s.name: start[s.on] + s.position for s in rig.sensor if isinstance(s, Acceleration)
        }
        out.append(Known(float(hz), float(ratio), m.readings, m.x, m.w, places))
    return tuple(sorted(out, key=lambda k: k.frequency_hz))


def placed(found: ModalModel, mode: Mode, known: Known) -> tuple[Float, Complex, Float] | None:
    """Where the accelerometers sit, their displacement in the model's scale, half widths."""
    shared = [k for k, name in enumerate(found.outputs) if name in known.shape]
    seen = [k for k in shared if found.outputs[k] in known.sensors]
    if not seen:
        return None
    a, b = mode.shape[shared], np.array([known.shape[found.outputs[k]] for k in shared])
    S = scales(a, [found.units[k] for k in shared])
    # The factor that brings the measured shape to the model's, and acceleration to displacement.
    factor = np.sum(S * a.conj() * b) / np.sum(S * np.abs(a) ** 2) / mode.pole**2
    x = np.array([known.sensors[found.outputs[k]] for k in seen])
    return x, factor * mode.shape[seen], np.abs(factor) * mode.shape_interval()[0][seen]
