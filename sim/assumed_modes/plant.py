"""The continuous plant: mechanism, sources, the inputs' paths and the sensors' filters as one

    x' = A x + B u,    y = C x + D u,    z = Z x

with the inputs u = [v of each drive, the forces' laws, the disturbances], y what the converters
sample and z the motions that the laws read. Everything is linear here and a matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.errors import SamiiRigError
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    Current,
    Displacement,
    Force,
    Moment,
    Pressure,
    RelativeAngle,
    SensorBase,
    Strain,
    Velocity,
)
from samii_rig.types import Float
from sim.assumed_modes.parts import SOURCES, Lag, Part, Setup
from sim.assumed_modes.parts import Force as Law
from sim.assumed_modes.ritz import FLOOR, Mechanism

GRAVITY = 9.80665  # m/s^2, as the rig file's `tilt` means it


@dataclass(frozen=True, slots=True)
class Push:
    """A disturbance's place: `floor` (m/s^2), `valve` (before the sources of the actuator `on`, in
    its unit), or a force `w` (N), a torque `theta` (N m) at `x` m along the part `on`, or `joint`
    (N m across one)."""

    kind: str
    on: str = ""
    x: float = 0.0


@dataclass(frozen=True, slots=True)
class Plant:
    """Matrices of the continuous plant.

    A (n, n), B (n, n_u), C (n_y, n), D (n_y, n_u). Z : (2 n_law, n), displacement and velocity of
    each law in turn, or the moment at the source and 0 for a law of the flow.
    n_in, n_law : drives and laws; the inputs are v (n_in), then n_law forces, then the
    disturbances.
    """

    A: Float
    B: Float
    C: Float
    D: Float
    Z: Float
    n_in: int
    n_law: int


class _Signals:
    """Rows over [x, u], appended to as states are found."""

    def __init__(self, n_x: int, n_u: int) -> None:
        self.n_x, self.n_u = n_x, n_u
        self.rate = np.zeros((n_x, n_x + n_u))
        self._used = 0

    def states(self, n: int) -> slice:
        """Room for n more states."""
        self._used += n
        return slice(self._used - n, self._used)

    def unit(self, at: int) -> Float:
        """The row that reads one entry of [x, u]."""
        row = np.zeros(self.n_x + self.n_u)
        row[at] = 1.0
        return row

    def filtered(self, row: Float, sections: list[tuple[Float, Float, Float, float]]) -> Float:
        """The row behind a cascade of filters (a, b, c, d)."""
        for a, b, c, d in sections:
            own = self.states(len(a))
            self.rate[own] += np.outer(b, row)
            self.rate[own, own] += a
            row = d * row
            row[own] += c
        return row


def _lag(p: float) -> tuple[Float, Float, Float, float]:
    return np.array([[-p]]), np.array([p]), np.ones(1), 0.0


def _second(omega: float, zeta: float) -> tuple[Float, Float, Float, float]:
    # The states are the output and its rate over omega, both of the output's size.
    a = omega * np.array([[0.0, 1.0], [-1.0, -2.0 * zeta]])
    return a, np.array([0.0, omega]), np.array([1.0, 0.0]), 0.0


def sensor_sections(sensor: SensorBase) -> list[tuple[Float, Float, Float, float]]:
    """Filters of a sensor's chain in series: Butterworth pairs, lag, high-pass."""
    out = []
    if sensor.antialias is not None:
        n, corner = sensor.antialias.order, 2 * np.pi * sensor.antialias.corner_hz
        out += [
            _second(corner, float(np.sin(np.pi * (2 * k + 1) / (2 * n)))) for k in range(n // 2)
        ]
        out += [_lag(corner)] * (n % 2)
    if sensor.lag > 0:
        out.append(_lag(1.0 / sensor.lag))
    if sensor.highpass_hz > 0:
        a = 2 * np.pi * sensor.highpass_hz
        out.append((np.array([[-a]]), np.array([a]), -np.ones(1), 1.0))
    return out


def _path_sections(path: tuple[Lag, ...]) -> list[tuple[Float, Float, Float, float]]:
    return [_second(f.omega, f.zeta) if f.omega > 0 else _lag(f.p) for f in path]


def _source_states(part: Part) -> int:
    if part.kind in ("displacement_source", "acceleration_source"):
        return 2
    if part.kind in ("angular_velocity_source", "velocity_source"):
        return 2
    if part.kind == "angular_velocity_source_2":
        return 3
    return int(part.values.get("p", 0.0) > 0)


NO_MASS = 1e-12  # of the mass matrix scaled to a unit diagonal; SAMII's smallest is 6e-7


class UnphysicalError(SamiiRigError):
    """A mass or stiffness that no body has: negative kinetic energy, or a motion out of bounds."""


def _split(M: Float) -> tuple[Float, Float]:
    """Columns that span the coordinates with mass, and those without: two springs in series."""
    if not np.all(np.diag(M) > 0):
        raise UnphysicalError("a coordinate without mass or with a negative one")
    scale = 1.0 / np.sqrt(np.diag(M))
    value, vector = np.linalg.eigh(M * np.outer(scale, scale))
    if value[0] < -NO_MASS:
        raise UnphysicalError("a motion with a negative mass")
    some = value > NO_MASS
    if np.all(some):
        return np.eye(len(M)), np.zeros((len(M), 0))
    columns = scale[:, None] * vector
    return columns[:, some], columns[:, ~some]


def _solution(A: Float, b: Float) -> Float:
    try:
        return np.asarray(np.linalg.solve(A, b), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise UnphysicalError("a motion that nothing resists") from error


def _relaxations(sig: _Signals, mech: Mechanism, Q: Float, load: Float) -> dict[int, Float]:
    """The Maxwell branches in states and loads: t s' = q - s pulls with k (q - s); the slip s of
    each branch's dashpot, by its coordinate."""
    slipped: dict[int, Float] = {}
    for branch in mech.maxwell:
        own = sig.states(1)
        slipped[branch.at] = sig.unit(own.start)
        sig.rate[own] += Q[branch.at] / branch.t
        sig.rate[own, own] -= 1.0 / branch.t
        load[branch.at] -= branch.k * Q[branch.at]
        load[branch.at, own] += branch.k
    return slipped


def plant(setup: Setup, pushes: tuple[Push, ...] = ()) -> Plant:
    """The continuous plant of `setup`, with inputs for its laws and for the disturbances."""
    mech = Mechanism(setup)
    sources = [p for p in setup.parts if p.kind in SOURCES]
    filters = [sensor_sections(s) for s in setup.sensors]
    paths = [_path_sections(d.path) for d in setup.drives]
    f = mech.free
    heavy, light = _split(mech.M[np.ix_(f, f)])
    n_p, n_r = heavy.shape[1], light.shape[1]
    n_x = 2 * n_p + n_r + len(mech.maxwell) + sum(_source_states(p) for p in sources)
    n_x += sum(len(a) for s in (*filters, *paths) for a, *_ in s)
    n_in, n_law = len(setup.drives), len(setup.forces)
    first_law, first_push = n_x + n_in, n_x + n_in + n_law
    n_u = n_in + n_law + len(pushes)
    sig = _Signals(n_x, n_u)
    place, speed, between = sig.states(n_p), sig.states(n_p), sig.states(n_r)
    n = mech.size
    Q, dQ, ddQ = (np.zeros((n, n_x + n_u)) for _ in range(3))
    Q[f, place], Q[f, between], dQ[f, speed] = heavy, light, heavy
    moves: dict[str, Float] = {}  # what reaches a source, by its name
    for i, (drive, path) in enumerate(zip(setup.drives, paths, strict=True)):
        v = sig.unit(n_x + i)
        for j, push in enumerate(pushes):
            if push.kind == "valve" and push.on == drive.name:
                v = v + sig.unit(first_push + j)
        moves |= dict.fromkeys(drive.sources, sig.filtered(v, path))
    load = np.zeros((n, n_x + n_u))  # generalised forces
    pushed: dict[str, Float] = {}  # of the sources that push
    for part in sources:
        row = _source(sig, mech, part, moves[part.name], (Q, dQ, ddQ), load)
        if row is not None:
            pushed[part.name] = row
    _push_back(mech, first_law, load)
    _pushes(mech, pushes, first_push, load, ddQ)
    slipped = _relaxations(sig, mech, Q, load)
    if n_r:
        # Without mass the forces balance at once: C r' = ... gives the rate of what lies between.
        balance = _solution(
            light.T @ mech.C[np.ix_(f, f)] @ light,
            light.T @ (load - mech.C @ dQ - mech.K @ Q)[f],
        )
        dQ[f] += light @ balance
        sig.rate[between] = balance
    load -= mech.C @ dQ + mech.K @ Q
    moved = _solution(heavy.T @ mech.M[np.ix_(f, f)] @ heavy, heavy.T @ (load[f] - mech.M[f] @ ddQ))
    ddQ[f] = heavy @ moved  # no sensor of acceleration stands on what has no mass
    sig.rate[place, speed], sig.rate[speed] = np.eye(n_p), moved
    # What holds a locked rotation is the moment inside the chain at that place.
    inside = load - mech.M @ ddQ
    rows = [
        s.gain * sig.filtered(_seen(s, mech, (Q, dQ, ddQ), inside, slipped, pushed), sections)
        for s, sections in zip(setup.sensors, filters, strict=True)
    ]
    Y = np.array(rows)
    Z = np.array([row for x in setup.forces for row in _read(x, mech, Q, dQ, inside)])
    Z = Z.reshape(2 * n_law, n_x + n_u)[:, :n_x]
    return Plant(sig.rate[:, :n_x], sig.rate[:, n_x:], Y[:, :n_x], Y[:, n_x:], Z, n_in, n_law)


def _source(
    sig: _Signals,
    mech: Mechanism,
    part: Part,
    drive: Float,
    motion: tuple[Float, Float, Float],
    load: Float,
) -> Float | None:
    """The states of a source and what it does: its angle or displacement prescribed, or a force,
    which is returned."""
    values, (Q, dQ, ddQ) = part.values, motion
    if part.kind in ("displacement_source", "acceleration_source"):
        at, w = mech.sources[part.name], values.get("omega", 0.0)
        if w == 0.0:
            place = sig.states(2).start
            sig.rate[place], sig.rate[place + 1] = sig.unit(place + 1), values["K"] * drive
            Q[at], dQ[at], ddQ[at] = sig.unit(place), sig.unit(place + 1), sig.rate[place + 1]
            return None
        first = sig._used  # the states of a second-order filter: its output, and its rate over w
        static = values["K"] / (w**2 if part.kind == "acceleration_source" else 1.0)
        Q[at] = sig.filtered(static * drive, [_second(w, values["zeta"])])
        dQ[at], ddQ[at] = w * sig.unit(first + 1), w * sig.rate[first + 1]
        return None
    if part.name in mech.sources:
        at = mech.sources[part.name]
        second = part.kind == "angular_velocity_source_2"
        own = sig.states(1)
        section = _second(values["omega"], values["zeta"]) if second else _lag(values["p"])
        before = sig._used
        speed = sig.filtered(values["K"] * drive, [section])
        Q[at] = sig.unit(own.start)
        dQ[at] = speed
        sig.rate[own] = speed
        ddQ[at] = sig.rate[before]  # the first state of either filter is the speed itself
        return None
    row = mech.before(part.name)[0 if part.kind == "force_source" else 1]
    lag = [_lag(values["p"])] if values.get("p", 0.0) > 0 else []
    push = sig.filtered(values["K"] * drive, lag)
    load += np.outer(row, push)
    return push


def _push_back(mech: Mechanism, first: int, load: Float) -> None:
    """Where a unit force of each law acts: across a joint, or on a body."""
    for i, force in enumerate(mech.setup.forces):
        if force.ground:
            load[:, first + i] += mech.against_ground(force.on)
        elif force.on in mech.joints:
            load[mech.joints[force.on], first + i] += 1.0


def _pushes(mech: Mechanism, pushes: tuple[Push, ...], first: int, load: Float, ddQ: Float) -> None:
    for j, push in enumerate(pushes):
        if push.kind == "floor":
            ddQ[FLOOR, first + j] += 1.0
        elif push.kind == "joint":
            load[mech.joints[push.on], first + j] += 1.0
        elif push.kind in ("w", "theta"):
            load[:, first + j] += mech.place(push.on, push.x)[int(push.kind == "theta")]


def _seen(
    sensor: SensorBase,
    mech: Mechanism,
    motion: tuple[Float, Float, Float],
    inside: Float,
    slipped: dict[int, Float],
    pushed: dict[str, Float],
) -> Float:
    """The quantity at a sensor's place as a row over [x, u], before its filters."""
    Q, _, ddQ = motion
    row: Float
    match sensor:
        case RelativeAngle():
            row = (mech.after(sensor.across[-1])[1] - mech.before(sensor.across[0])[1]) @ Q
        case AbsoluteAngle():
            row = mech.after(sensor.after)[1] @ Q
        case Acceleration():
            w, theta = mech.place(sensor.on, sensor.position)
            row = w @ ddQ + sensor.tilt * GRAVITY * (theta @ Q)
        case Displacement():
            row = _stretch(sensor, mech) @ Q
        case Velocity():
            row = _stretch(sensor, mech) @ motion[1]
        case Force():
            row = inside[mech.gaps[sensor.after]]
        case Pressure() if sensor.area is not None:
            row = -inside[mech.gaps[sensor.after]] / sensor.area
        case Pressure():
            row = _chamber(sensor, mech, Q, slipped)
        case Strain():
            row = -sensor.height * (mech.bend(sensor.on, sensor.position) @ Q)
        case Current():
            at = mech.sources.get(sensor.of)
            push = pushed[sensor.of] if at is None else -inside[at]
            row = push / sensor.constant
        case Moment():
            row = inside[mech.cuts[sensor.after]]
        case _:
            raise TypeError(type(sensor))
    return row


def _chamber(sensor: Pressure, mech: Mechanism, Q: Float, slipped: dict[int, Float]) -> Float:
    """The pressure in one chamber: what the oil's stretch less the leak makes there, and what the
    leak leaves in both where the areas differ."""
    v = mech.setup.part(sensor.after).values
    at = mech.joints[sensor.after]
    leaked = slipped.get(at, np.zeros_like(Q[at]))
    common = (v["A_1"] - v["A_2"]) / (v["V_1"] + v["V_2"])
    own = v["A_1"] / v["V_1"] if sensor.chamber == 1 else -v["A_2"] / v["V_2"]
    return np.asarray(-v["B"] * (own * (Q[at] - leaked) + common * leaked))


def _stretch(sensor: Displacement | Velocity, mech: Mechanism) -> Float:
    """The row of w between a sensor's two places; one of them may be the ground."""
    w = mech.after(sensor.after)[0]
    return w if sensor.against is None else w - mech.after(sensor.against)[0]


def _read(law: Law, mech: Mechanism, Q: Float, dQ: Float, inside: Float) -> tuple[Float, Float]:
    """Displacement and velocity of a joint, or of a body against the ground; of an actuator's law
    the moment at its source."""
    on = law.on
    if law.ground:
        row = mech.against_ground(on)
        return row @ Q, row @ dQ
    if on in mech.joints:
        return Q[mech.joints[on]], dQ[mech.joints[on]]
    drive = next(d for d in mech.setup.drives if d.name == on)
    at = next(mech.sources[name] for name in drive.sources if name in mech.sources)
    return inside[at], np.zeros_like(inside[at])
