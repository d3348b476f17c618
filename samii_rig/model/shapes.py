"""Mode shapes: the states along a chain in one natural motion.

    found = natural_frequencies(rig, 0.1, 50.0)
    mode = mode_shape(rig, found.hz[0])                 # undamped: real
    mode.x, mode.w, mode.slope_changes["joint_1"]
    mode_shape(rig, poles(rig, 50.0).pole[0])           # damped: complex

A shape is the residue of the chain's answer to a force: near a pole p of a chain with symmetric
matrices the displacement at j by a force at i is phi_i phi_j / (2 j Im(p) (s - p)), which for
a chain without damping has modal mass 1: phi^T M phi = 1. So no mass matrix and no integral is
needed for the normalisation, and both can check it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from samii_rig.errors import InputError
from samii_rig.model.laws import READINGS
from samii_rig.model.modes import undamped
from samii_rig.model.poles import contour_residues
from samii_rig.model.sensing import reading_of
from samii_rig.model.tmm import Chain, State
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    Current,
    Displacement,
    Element,
    Force,
    Moment,
    Pressure,
    RelativeAngle,
    Rig,
    RigidLink,
    Rod,
    Sensor,
    Strain,
    Velocity,
    parameters,
)
from samii_rig.rig.schema.elements import ANGLE_SOURCES, BEAMS, MOTION_SOURCES
from samii_rig.types import Complex, Float

POINTS = 40  # places along each beam
CIRCLE = 1e-4  # radius of a residue's circle over |s|
ON_CIRCLE = 8  # points on it: what is regular falls as (radius/distance)^8
NEAR = 0.02  # how far from what was asked a natural frequency may lie, relative
STEPS = 30  # of the secant method
CONVERGED = 1e-13  # relative step at which it ends
LONE = 1e-6  # second singular value over the first: a residue of one mode has rank one

Normalisation = Literal["mass", "displacement"]


@dataclass(frozen=True, slots=True)
class ModeShape:
    """One mode. Real parts are the motion at one instant; undamped shapes are real.

    s : rad/s, j omega for an undamped mode.
    x : (n,) m from the base along the chain. place : (n,) (element, m from its upstream end).
    state : (n, 4) w, theta, M, V in m, rad, N m, N.
    modal_mass : kg, 1 if normalised by mass; complex for a damped mode.
    slope_changes : theta after less theta before each element without length, rad.
    readings : amplitude of every sensor in its unit, its gain and filters left out.

    The sign makes the largest displacement positive (real).
    """

    s: complex
    x: Float
    place: tuple[tuple[str, float], ...]
    state: Complex
    modal_mass: complex
    slope_changes: dict[str, complex]
    readings: dict[str, complex]

    @property
    def hz(self) -> float:
        """|s|/(2 pi)."""
        return abs(self.s) / (2 * np.pi)

    @property
    def ratio(self) -> float:
        """Damping ratio -Re s/|s|."""
        return -self.s.real / abs(self.s)

    @property
    def w(self) -> Complex:
        """(n,) displacement, m."""
        return self.state[:, 0]

    @property
    def theta(self) -> Complex:
        """(n,) rotation, rad."""
        return self.state[:, 1]


def mode_shape(
    model: Rig | Chain,
    at: complex,
    *,
    positions: Mapping[str, Sequence[float]] | None = None,
    normalise: Normalisation = "displacement",
) -> ModeShape:
    """The mode at a natural frequency (real `at`, Hz, undamped) or a pole (complex `at`, rad/s).

    at : need not be exact; the root next to it is used, within 2 %.
    positions : {beam: (m, ...)} places along beams, default 40 even steps of each.
    normalise : "displacement" for a largest |w| of 1 m, "mass" for a modal mass of 1.

    Raises InputError if no root is near, for a real pole, a mode that is not alone (a double
    natural frequency has no shape of its own) or shows no displacement.
    """
    if np.iscomplexobj(at):
        chain = model if isinstance(model, Chain) else Chain(model)
        start = complex(at)
    else:
        chain, start = undamped(model), 2j * np.pi * at.real
    rig = chain.rig
    if not (np.isfinite(start) and start.imag > 0):
        raise InputError("mode shape", "at", at, "Hz above 0, or a pole with Im s > 0 in rad/s")
    p = root(chain, start)
    if positions is None:
        positions = {
            e.name: np.linspace(0, e.L.value, POINTS + 1).tolist()
            for e in rig.element
            if isinstance(e, BEAMS)
        }
    places = chain.places(positions)
    ports = _last_ports(rig, places)
    state = _state(chain, p, start, positions, ports, len(places))
    top = state[np.argmax(np.abs(state[:, 0])), 0]
    if abs(top) == 0 or not np.isfinite(state).all():
        raise InputError("mode shape", "at", at, "a mode with a displacement")
    modal_mass = 1.0 + 0j
    if normalise == "displacement":
        state, modal_mass = state / top, 1 / top**2
    elif top.real < 0:
        state = -state
    if not np.iscomplexobj(at):
        p = 1j * p.imag
        state, modal_mass = np.asarray(state.real + 0j), complex(abs(modal_mass))
    return ModeShape(
        p,
        _x(rig, places),
        places,
        state,
        modal_mass,
        _slope_changes(rig, ports, state),
        {sensor.name: _reading(sensor, rig, places, ports, state, p) for sensor in rig.sensor},
    )


def _state(
    chain: Chain,
    p: complex,
    start: complex,
    positions: Mapping[str, Sequence[float]],
    ports: Sequence[int],
    n: int,
) -> Complex:
    """(n, 4) state vectors of the mode at the root p, for a modal mass of 1: from the residue of
    the answer to the force or torque that moves it most. n : places."""
    jumps: list[tuple[int, State]] = [(port, k) for port in ports for k in ("V", "M")]

    def answer(s: Complex) -> Complex:
        z = chain.field_at(s, jumps, positions)
        return z.reshape(s.size, len(jumps), -1)

    R = contour_residues(answer, np.array([p]), np.array([CIRCLE * abs(p)]), ON_CIRCLE)[0][0]
    z = (2j * p.imag * R).reshape(len(jumps), n, 4)
    _refuse_several(chain.rig, start, R)
    # A jump of V is a force on w, one of M is a torque on -theta.
    squares = np.array([z[i, port, 0] if k == "V" else -z[i, port, 1]
                        for i, (port, k) in enumerate(jumps)])  # fmt: skip
    length = sum(_length(e) for e in chain.rig.element) or 1.0
    unit = np.where([k == "V" for _, k in jumps], 1.0, length**2)  # m^2 of both
    best = int(np.argmax(np.abs(squares) * unit))
    return np.asarray(z[best] / np.sqrt(squares[best]))


def root(chain: Chain, start: complex) -> complex:
    """The root of the determinant next to `start`, rad/s, by the secant method.

    Raises InputError if there is none near.
    """
    reference = float(chain.characteristic([start], clear=True)[1][0])

    def D(s: complex) -> complex:
        mantissa, log_scale = chain.characteristic([s], clear=True)
        return complex(mantissa[0] * np.exp(np.clip(log_scale[0] - reference, -600.0, 600.0)))

    a, b = start * (1 + 1e-5), start
    f_a, f_b = D(a), D(b)
    for _ in range(STEPS):
        if f_b == 0 or f_a == f_b:
            break
        step = -f_b * (b - a) / (f_b - f_a)
        a, f_a = b, f_b
        b += step
        f_b = D(b)
        if abs(b - start) > NEAR * abs(start):
            break
        if abs(step) < CONVERGED * abs(b):
            break
    else:
        b = complex(np.nan)
    if not abs(b - start) <= NEAR * abs(start):
        hz = abs(start) / (2 * np.pi)
        raise InputError.saying(
            chain.rig.name,
            "mode shape",
            f"no root within {100 * NEAR:g} % of {hz:.6g} Hz; expected a natural frequency or pole",
        )
    return b


def _last_ports(rig: Rig, places: Sequence[tuple[str, float]]) -> list[int]:
    """The port of the base and the last one of each element."""
    last = {name: port for port, (name, _) in enumerate(places)}
    return [0, *(last[e.name] for e in rig.element)]


def _refuse_several(rig: Rig, start: complex, R: Complex) -> None:
    size = np.linalg.svd(R / np.max(np.abs(R)), compute_uv=False)
    if size.size > 1 and size[1] > LONE * size[0]:
        raise InputError.saying(
            rig.name,
            "mode shape",
            f"more than one mode at {abs(start) / (2 * np.pi):.6g} Hz; expected one that is alone",
        )


def _x(rig: Rig, places: Sequence[tuple[str, float]]) -> Float:
    """(n,) m from the base along the chain."""
    start: dict[str, float] = {}
    reached = 0.0
    for e in rig.element:
        start[e.name] = reached
        reached += _length(e)
    return np.array([start[name] + position for name, position in places])


def _length(element: Element) -> float:
    return element.L.value if isinstance(element, (RigidLink, Rod, *BEAMS)) else 0.0


def _slope_changes(rig: Rig, ports: Sequence[int], state: Complex) -> dict[str, complex]:
    return {
        e.name: complex(state[ports[i + 1], 1] - state[ports[i], 1])
        for i, e in enumerate(rig.element)
        if _length(e) == 0
    }


def _reading(
    sensor: Sensor,
    rig: Rig,
    places: Sequence[tuple[str, float]],
    ports: Sequence[int],
    state: Complex,
    s: complex,
) -> complex:
    order = [e.name for e in rig.element]
    match sensor:
        case RelativeAngle():
            first, last = order.index(sensor.across[0]), order.index(sensor.across[-1])
            return complex(state[ports[last + 1], 1] - state[ports[first], 1])
        case AbsoluteAngle():
            return complex(state[ports[order.index(sensor.after) + 1], 1])
        case Moment():
            return complex(state[ports[order.index(sensor.after) + 1], 2])
        case Acceleration():
            at = order.index(sensor.on)
            if isinstance(rig.element[at], RigidLink):
                w = state[ports[at], 0] + sensor.position * state[ports[at], 1]
            elif sensor.position == 0 and isinstance(rig.element[at], BEAMS):
                w = state[ports[at], 0]
            elif sensor.position == 0:
                w = state[ports[at + 1], 0]
            else:
                w = state[places.index((sensor.on, sensor.position)), 0]
            return complex(s**2 * w)
        case Displacement() | Velocity():
            w = state[ports[order.index(sensor.after) + 1], 0]
            if sensor.against is not None:
                w -= state[ports[order.index(sensor.against) + 1], 0]
            return complex(s * w if isinstance(sensor, Velocity) else w)
        case Force():
            return complex(-state[ports[order.index(sensor.after) + 1], 3])
        case Pressure():
            area = sensor.area or 1.0
            push = complex(state[ports[order.index(sensor.after) + 1], 3])
            return push / area * _law(sensor, rig, s)
        case Strain():
            port = ports[order.index(sensor.on)]
            if sensor.position > 0:
                port = places.index((sensor.on, sensor.position))
            return -sensor.height * complex(state[port, 2]) * _law(sensor, rig, s)
        case Current():
            source, port = rig.element[order.index(sensor.of)], ports[order.index(sensor.of) + 1]
            if isinstance(source, ANGLE_SOURCES):
                return -complex(state[port, 2]) / sensor.constant
            if isinstance(source, MOTION_SOURCES):
                return complex(state[port, 3]) / sensor.constant
            return 0j  # at zero input it does not push


def _law(sensor: Sensor, rig: Rig, s: complex) -> complex:
    """By which a sensor reads its state, where that depends on its element."""
    found = reading_of(sensor)
    if not found:
        return 1.0 + 0j
    law, on = found
    p = np.array([q.value for e in rig.element if e.name == on for q in parameters(e).values()])
    return complex(READINGS[law].value(np.array([s], complex), p)[0])
