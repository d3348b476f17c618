"""Component-mode reduction of the whole mechanism (paper 1, eq. 13 and 14).

    q = [phi_r  phi_f] [theta; eta_f]

A rigid mode phi_r is the motion when one actuator coordinate turns by 1 rad and nothing else is
loaded; a flexible mode phi_f is an undamped mode with all actuator coordinates held. Held, the
reduced model has the natural frequencies of the full one.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.linalg import splu

from samii_rig.errors import InputError
from samii_rig.fem.drive import Load, Prescribed, refuse_dead_time, states
from samii_rig.fem.modal import Basis
from samii_rig.fem.model import Fem, multiplier_unit, positive_hz, saddle
from samii_rig.types import Complex, Float

if TYPE_CHECKING:
    from control import StateSpace

ROUNDING = 1e-10  # of the terms it is summed from, below which a reduced stiffness is zero
# Least inertia of a coordinate beside the others, relative: below it the coordinate has next to no
# mass, its states are too fast, and rounding spoils the response.
INERTIA = 1e-9
FLOATS = 1e-12  # a squared natural frequency below this, over the model's scale, is zero


@dataclass(frozen=True, slots=True)
class Reduced:
    """M eta'' + C eta' + K eta = force u, the first `n_rigid` of eta being joint angles (rad).

    M, C, K : (n, n); for a chain that the joints leave free, only flexible modes have stiffness
    (eq. 14). shapes : (n_q, n) [phi_r phi_f] in the coordinates of the full model.
    coordinates : names of the n_rigid joints. inputs, outputs : names; inputs are the rig's
    actuators, then "T_<joint>" in N m for each joint driven by a torque.
    force : (n, n_in) generalised forces without a law; sources : joints whose rotation is
        prescribed. loads : torques and forces with a law; applied : (n, n_loads) generalised
        force of a unit of each.
    position, velocity, acceleration : (n_out, n) rows, sensors = sum of row times derivative
        and of `carried` (n_out, n_loads) times load.
    """

    M: Float
    C: Float
    K: Float
    shapes: Float
    coordinates: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    force: Float
    sources: tuple[Prescribed, ...]
    loads: tuple[Load, ...]
    applied: Float
    position: Float
    velocity: Float
    acceleration: Float
    carried: Float

    @property
    def n_rigid(self) -> int:
        """Number of actuator coordinates."""
        return len(self.coordinates)

    def state_space(self) -> tuple[Float, Float, Float, Float]:
        """(A, B, C, D) with states [of each source's law, of each load's law, eta_x, eta_x'].

        A law's states are its output and derivatives of it, so a source of first order has
        theta, theta' with theta'' = K p v - p theta' (paper 2, eq. 1). eta_x are all
        coordinates that no source prescribes.
        """
        n, n_in = self.force.shape
        parts: tuple[Prescribed | Load, ...] = (*self.sources, *self.loads)
        s = [self.coordinates.index(d.element) for d in self.sources]
        x = [i for i in range(n) if i not in s]
        starts = np.cumsum([0, *(part.law.order for part in parts)])
        n_law, n_x = int(starts[-1]), len(x)
        size = n_law + 2 * n_x
        A, B = np.zeros((size, size)), np.zeros((size, n_in))
        # Output and its derivatives of each law: rows on the states, on the inputs.
        outs: list[list[tuple[Float, Float]]] = []
        for part, start in zip(parts, starts[:-1], strict=True):
            at = slice(int(start), int(start) + part.law.order)
            A[at, at], B[at, part.column] = states(part.law)
            outs.append(_derivatives(part, int(start), size, n_in))
        # eta = E0 state, eta' = E1 state, eta'' = E2 state + F u.
        E0, E1, E2, F = *(np.zeros((n, size)) for _ in range(3)), np.zeros((n, n_in))
        for i, out in zip(s, outs, strict=False):
            (E0[i], _), (E1[i], _), (E2[i], F[i]) = out
        E0[x, n_law : n_law + n_x] = np.eye(n_x)
        E1[x, n_law + n_x :] = np.eye(n_x)
        loads = outs[len(s) :]
        on_states = np.array([out[0][0] for out in loads]).reshape(-1, size)
        on_inputs = np.array([out[0][1] for out in loads]).reshape(-1, n_in)
        inner, across = self.M[np.ix_(x, x)], self.M[np.ix_(x, s)]
        pull = self.applied[x] @ on_states - self.K[x] @ E0 - self.C[x] @ E1 - across @ E2[s]
        push = self.applied[x] @ on_inputs + self.force[x] - across @ F[s]
        E2[x], F[x] = np.linalg.solve(inner, pull), np.linalg.solve(inner, push)
        A[n_law:], B[n_law:] = np.vstack([E1[x], E2[x]]), np.vstack([np.zeros((n_x, n_in)), F[x]])
        C = self.position @ E0 + self.velocity @ E1 + self.acceleration @ E2
        return A, B, C + self.carried @ on_states, self.acceleration @ F + self.carried @ on_inputs

    def response(self, frequency_hz: ArrayLike) -> Complex:
        """(n_freq, n_out, n_in) as `Fem.response`, of the reduced model."""
        A, B, C, D = self.state_space()
        s = 2j * np.pi * positive_hz(frequency_hz)
        return np.asarray(C @ np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B) + D)

    def to_statespace(self) -> StateSpace:
        """The model as `control.StateSpace`, inputs and outputs named."""
        import control  # takes a second, and most uses of a model need it not

        return control.ss(*self.state_space(), inputs=self.inputs, outputs=self.outputs)


def reduce(fem: Fem, flexible: int = 4, torque: Collection[str] = ()) -> Reduced:
    """The component-mode reduction of a finite element model.

    flexible : flexible modes kept. torque : joints that get an actuator coordinate driven by a
    torque, besides the rig's sources, which all have one; a locked joint is then free.

    Raises InputError for an unknown joint, more flexible modes than there are or than leave a
    joint driven by a torque any inertia, a beam with `eta` or a source with a dead time (no
    equation in time), a load on a part without mass, a chain that floats when its actuators are
    held.
    """
    fem.refuse_loss()
    m, rig = fem.mechanism, fem.rig
    refuse_dead_time(rig.name, (*m.sources, *m.loads))
    driven = [*(a.element for a in m.sources), *(a.element for a in m.feedback)]
    _refuse_torque(fem, driven, torque)
    names = (*driven, *torque)
    joints = [m.joints[name] for name in names]
    basis = fem.basis(joints)
    _refuse_basis(fem, basis, flexible)

    static = _Static(fem, joints)
    turned = [static.unit(static.lock(j))[0][:, None] for j in joints]
    phi = np.hstack([*turned, basis.modes.shapes[:, :flexible]])
    M, K = phi.T @ m.M @ phi, phi.T @ m.K @ phi
    K[abs(K) < ROUNDING * (abs(phi).T @ abs(m.K) @ abs(phi))] = 0.0

    free = M[len(m.sources) :, len(m.sources) :]
    size = np.sqrt(np.maximum(free.diagonal(), np.finfo(float).tiny))
    if np.min(np.linalg.eigvalsh(free / np.outer(size, size)), initial=1.0) < INERTIA:
        raise InputError(
            rig.name, "flexible", flexible, "fewer modes: these leave a joint without inertia"
        )

    inputs = (*(a.name for a in rig.actuator), *(f"T_{name}" for name in torque))
    force = np.zeros((len(K), len(inputs)))
    for i, joint in enumerate(m.feedback, len(m.sources)):
        force[i, joint.column] = joint.gain
    for i in range(len(torque)):
        force[len(driven) + i, len(rig.actuator) + i] = 1.0
    return Reduced(
        M,
        phi.T @ fem.C @ phi,
        K,
        phi,
        names,
        inputs,
        tuple(s.name for s in rig.sensor),
        force,
        m.sources,
        m.loads,
        phi[[load.coordinate for load in m.loads]].T,
        *_readings(fem, static, joints, phi),
    )


def _refuse_torque(fem: Fem, driven: Sequence[str], torque: Collection[str]) -> None:
    """InputError for a joint that no torque can be given."""
    passive = [name for name in fem.mechanism.joints if name not in driven]
    for name in torque:
        if name not in passive or [*torque].count(name) > 1:
            expected = f"joints without a source, each once, of {passive}"
            raise InputError(fem.rig.name, "torque", name, expected)


def _refuse_basis(fem: Fem, basis: Basis, flexible: int) -> None:
    """InputError for modes that are not there, a load that moves no mass, a chain that floats."""
    omega, name = basis.modes.omega, fem.rig.name
    if not 0 <= flexible <= omega.size:
        raise InputError(name, "flexible", flexible, f"0 to {omega.size} modes")
    adrift = np.max(np.abs(basis.massless), initial=0.0) * ROUNDING
    for load in fem.mechanism.loads:
        if np.any(np.abs(basis.massless[load.coordinate]) > adrift):
            raise InputError.saying(
                name, load.element, "acts on a part without mass; expected a mass beside it"
            )
    if omega.size and omega[0] ** 2 < FLOATS * basis.scale:
        raise InputError.saying(name, "base", "the chain floats; expected an end that holds it")


def _readings(
    fem: Fem, static: _Static, joints: Sequence[int], phi: Float
) -> tuple[Float, Float, Float, Float]:
    """What the sensors read of the coordinates, their speeds and accelerations, (n_sensor, n)
    each, and of the loads (n_sensor, n_loads)."""
    m = fem.mechanism
    position, velocity, acceleration = m.angle @ phi, m.velocity @ phi, m.acceleration @ phi
    carried = np.zeros((len(position), len(m.loads)))
    at_loads = [load.coordinate for load in m.loads]
    for sensor, row, factor in m.moment:
        # By reciprocity the multiplier that holds the load r is v^T r, v the static shape of a
        # unit gap at that constraint; r are the loads and the forces of inertia and damping, so
        # that the moment has the static part of all modes left out.
        v, reaction = (factor * x for x in static.unit(row))
        position[sensor, : len(joints)] = [reaction[static.lock(j)] for j in joints]
        velocity[sensor] = -v @ (fem.C @ phi)
        acceleration[sensor] = -v @ (m.M @ phi)
        carried[sensor] = v[at_loads]
    for sensor, index, factor in m.feed:
        carried[sensor, index] += factor
    return position, velocity, acceleration, carried


def _derivatives(
    part: Prescribed | Load, start: int, size: int, n_in: int
) -> list[tuple[Float, Float]]:
    """Rows on the states and on the inputs of a law's output; of its first two derivatives too
    if it prescribes a motion."""
    order = part.law.order
    rows: list[tuple[Float, Float]] = []
    for derivative in range(3 if isinstance(part, Prescribed) else 1):
        on_state, on_input = np.zeros(size), np.zeros(n_in)
        if derivative < order:
            on_state[start + derivative] = 1.0
        else:
            on_state[start : start + order] = states(part.law)[0][-1:].sum(axis=0)
            on_input[part.column] = part.law.gain
        rows.append((on_state, on_input))
    return rows


class _Static:
    """The mechanism at rest with its actuator coordinates held."""

    def __init__(self, fem: Fem, joints: Collection[int]) -> None:
        m, Phi = fem.mechanism, fem.constraints(joints)
        self._n, self._n_c = m.M.shape[0], Phi.shape[0]
        self._first, self._held = m.Phi.shape[0], fem.held(joints)
        self._unit = multiplier_unit(m.K)
        self._lu = splu(saddle(m.K, self._unit * Phi))

    def lock(self, joint: int) -> int:
        """The constraint that holds this coordinate."""
        return self._first + self._held.index(joint)

    def unit(self, constraint: int) -> tuple[Float, Float]:
        """(n_q,) shape and (n_c,) multipliers when Phi q is 1 at this constraint."""
        rhs = np.zeros(self._n + self._n_c)
        rhs[self._n + constraint] = self._unit
        x = self._lu.solve(rhs)
        return x[: self._n], self._unit * x[self._n :]
