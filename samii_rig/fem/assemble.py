"""From a rig file to the matrices of a constrained mechanism.

Every beam node and every rigid body has coordinates (w, theta) of its own, every joint its
relative rotation. Nothing is shared: what is joined is joined by a constraint with a Lagrange
multiplier. That is paper 1, eq. (12), for small motions about the straight chain:

    M q'' + C q' + K q + Phi^T lambda = f,      Phi q = b,

Phi the constraint gradient Phi_q. b is zero but for an angular velocity source, whose rotation
is prescribed. The multiplier of the constraint between two rotations is the moment M there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array, csc_array

from samii_rig.errors import InputError
from samii_rig.fem import hermite
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    AngularVelocitySource,
    Beam,
    Moment,
    RelativeAngle,
    Rig,
    RigidLink,
    Sensor,
    TorsionalSpring,
)
from samii_rig.types import Float

Row = dict[int, float]  # a linear function of the coordinates: coefficient by coordinate


@dataclass(frozen=True, slots=True)
class Source:
    """A joint whose rotation is prescribed, K p/(s (s + p)) v (paper 2, eq. 1).

    coordinate : of the joint; column : of the input v among the rig's actuators.
    gain : K p in rad/s^2 per unit of the input. p : rad/s.
    """

    element: str
    coordinate: int
    column: int
    gain: float
    p: float


@dataclass(frozen=True, slots=True)
class Feedback:
    """A joint with intrinsic velocity feedback, T = g_v (g_a v - theta') (paper 1, eq. 18).

    coordinate, column : as in `Source`. gain : g_v g_a in N m per unit of the input; g_v
    itself stands in `Mechanism.G`.
    """

    element: str
    coordinate: int
    column: int
    gain: float


@dataclass(frozen=True, slots=True)
class Places:
    """Where shapes are drawn: base, beam nodes, ends of bodies, both sides of joints.

    x : (n,) m from the base. element : (n,) name of the element that ends or lies there, ""
    at the base. w, theta : (n, n_q) rows that give displacement and rotation.
    """

    x: Float
    element: tuple[str, ...]
    w: csc_array
    theta: csc_array


@dataclass(frozen=True, slots=True)
class Mechanism:
    """The matrices; n_q coordinates, n_c constraints.

    M, K : (n_q, n_q) kg, N/m and so on. C : viscous damping of the rig file, without velocity
    feedback. H : loss, the imaginary part of the stiffness of beams with `eta`.
    G : (n_q, n_q) velocity feedback, g_v at each joint that has it.
    Phi : (n_c, n_q) what joins the parts; `locks` are held beside: {element: coordinate}.
    joints : coordinate of every joint by element name.
    angle, acceleration : (n_sensor, n_q) rows; zero for a sensor of another kind.
    moment : (sensor, row of Phi) of every moment sensor at a joint that can carry one.
    """

    M: csc_array
    C: csc_array
    H: csc_array
    K: csc_array
    G: csc_array
    Phi: csc_array
    locks: dict[str, int]
    joints: dict[str, int]
    sources: tuple[Source, ...]
    feedback: tuple[Feedback, ...]
    angle: csc_array
    acceleration: csc_array
    moment: tuple[tuple[int, int], ...]
    places: Places


def assemble(
    rig: Rig,
    elements: int = 15,
    rigid: Collection[str] = (),
    feedback: Mapping[str, tuple[float, float]] | None = None,
) -> Mechanism:
    """The mechanism of `rig` (see `samii_rig.fem.model.Fem` for the arguments)."""
    feedback = {} if feedback is None else feedback
    _check(rig, elements, rigid, feedback)
    walk = _Walk(rig, elements)
    walk.base()
    for e in rig.element:
        before = walk.theta
        match e:
            case Beam():
                walk.beam(e)
            case RigidLink():
                walk.body(e)
            case TorsionalSpring():
                walk.spring(e, e.name in rigid)
            case AngularVelocitySource():
                walk.source(e, feedback.get(e.name))
            case _:
                raise InputError(rig.name, e.name, e.kind, "an element that fem knows")
        walk.leave(e.name, before)
    walk.tip()
    return walk.mechanism()


@dataclass
class _Entries:
    """A sparse matrix while it is filled."""

    i: list[int] = field(default_factory=list)
    j: list[int] = field(default_factory=list)
    value: list[float] = field(default_factory=list)

    def add(self, at: list[int], block: ArrayLike) -> None:
        for i, line in zip(at, np.atleast_2d(block), strict=True):
            self.i += [i] * len(at)
            self.j += at
            self.value += line.tolist()

    def matrix(self, n: int) -> csc_array:
        return csc_array(coo_array((self.value, (self.i, self.j)), shape=(n, n)))


class _Walk:
    """Goes from base to tip; `w` and `theta` are the motion at the place reached, `x` m on."""

    def __init__(self, rig: Rig, elements: int) -> None:
        self._rig, self._n_beam = rig, elements
        self._n = 0  # coordinates so far
        self._M, self._C, self._H, self._K, self._G = (_Entries() for _ in range(5))
        self._constraints: list[Row] = []
        self._waiting: list[str] = []  # elements since the last joining constraint
        self._moment: dict[str, int] = {}
        self._span: dict[str, tuple[Row, Row]] = {}  # rotation before and after each element
        self._nodes: dict[str, int] = {}  # first coordinate of each beam and body
        self._locks: dict[str, int] = {}
        self._joints: dict[str, int] = {}
        self._sources: list[Source] = []
        self._feedback: list[Feedback] = []
        self._places: list[tuple[float, str, Row, Row]] = []
        self.w: Row = {}
        self.theta: Row = {}
        self.x = 0.0

    def base(self) -> None:
        if self._rig.base == "free":
            self.w = self._new()
        if self._rig.base != "clamped":
            self.theta = self._new()
        self._place("")

    def beam(self, e: Beam) -> None:
        n, h = self._n_beam, e.L.value / self._n_beam
        first = self._nodes[e.name] = self._n
        self._n += 2 * (n + 1)
        self._join(first)
        k, m = hermite.stiffness(e.EI.value, h), hermite.consistent_mass(e.mu.value, h)
        for i in range(n):
            at = list(range(first + 2 * i, first + 2 * i + 4))
            self._K.add(at, k)
            self._M.add(at, m)
            self._C.add(at, e.tau.value * k)
            self._H.add(at, e.eta.value * k)
            if i < n - 1:
                self.x += h
                self.w, self.theta = {at[2]: 1.0}, {at[3]: 1.0}
                self._place(e.name)
        self.x += h
        self.w, self.theta = {first + 2 * n: 1.0}, {first + 2 * n + 1: 1.0}

    def body(self, e: RigidLink) -> None:
        first = self._nodes[e.name] = self._n
        self._n += 2
        self._join(first, -e.r.value)
        self._M.add([first, first + 1], np.diag([e.m.value, e.I.value]))
        self.x += e.L.value
        self.w, self.theta = {first: 1.0, first + 1: e.L.value - e.r.value}, {first + 1: 1.0}

    def spring(self, e: TorsionalSpring, rigid: bool) -> None:
        j = self._joint(e.name)
        if rigid:
            self._locks[e.name] = j
        else:
            self._K.add([j], e.k.value)
            self._C.add([j], e.c.value)

    def source(self, e: AngularVelocitySource, feedback: tuple[float, float] | None) -> None:
        j = self._joint(e.name)
        column = [a.name for a in self._rig.actuator].index(e.input)
        if feedback is None:
            self._locks[e.name] = j
            K, p = e.K.value, e.p.value
            self._sources.append(Source(e.name, j, column, K * p, p))
        else:
            g_v, g_a = feedback
            self._G.add([j], g_v)
            self._feedback.append(Feedback(e.name, j, column, g_v * g_a))

    def leave(self, name: str, before: Row) -> None:
        self._waiting.append(name)
        self._span[name] = before, self.theta
        self._place(name)

    def tip(self) -> None:
        if self._rig.tip != "free":
            self._constraints.append(_minus({}, self.w))
        if self._rig.tip == "clamped":
            self._join_rotation({})

    def mechanism(self) -> Mechanism:
        n, sensors = self._n, self._rig.sensor
        x, element, w, theta = zip(*self._places, strict=True)
        return Mechanism(
            self._M.matrix(n),
            self._C.matrix(n),
            self._H.matrix(n),
            self._K.matrix(n),
            self._G.matrix(n),
            _stack(self._constraints, n),
            self._locks,
            self._joints,
            tuple(self._sources),
            tuple(self._feedback),
            _stack([self._angle(s) for s in sensors], n),
            _stack([self._acceleration(s) for s in sensors], n),
            tuple(
                (i, self._moment[s.after])
                for i, s in enumerate(sensors)
                if isinstance(s, Moment) and s.after in self._moment
            ),
            Places(np.array(x), element, _stack(w, n), _stack(theta, n)),
        )

    def _new(self) -> Row:
        self._n += 1
        return {self._n - 1: 1.0}

    def _joint(self, name: str) -> int:
        j = self._joints[name] = self._n
        self.theta = {**self.theta, **self._new()}
        return j

    def _join(self, node: int, offset: float = 0.0) -> None:
        """Put the point `offset` m beside a node where the walk stands."""
        self._constraints.append(_minus({node: 1.0, node + 1: offset}, self.w))
        self._join_rotation({node + 1: 1.0})

    def _join_rotation(self, theta: Row) -> None:
        # What crosses this constraint is the moment after all elements since the last one.
        self._moment.update(dict.fromkeys(self._waiting, len(self._constraints)))
        self._waiting.clear()
        self._constraints.append(_minus(theta, self.theta))

    def _place(self, name: str) -> None:
        self._places.append((self.x, name, self.w, self.theta))

    def _angle(self, sensor: Sensor) -> Row:
        match sensor:
            case AbsoluteAngle():
                return self._span[sensor.after][1]
            case RelativeAngle():
                return _minus(self._span[sensor.across[-1]][1], self._span[sensor.across[0]][0])
        return {}

    def _acceleration(self, sensor: Sensor) -> Row:
        if not isinstance(sensor, Acceleration):
            return {}
        at, first = sensor.position, self._nodes[sensor.on]
        host = next(e for e in self._rig.element if e.name == sensor.on)
        if isinstance(host, RigidLink):
            return {first: 1.0, first + 1: at - host.r.value}
        assert isinstance(host, Beam)  # the schema allows no other
        h = host.L.value / self._n_beam
        i = min(int(at / h), self._n_beam - 1)
        values = hermite.shape(at - i * h, h).tolist()
        return {first + 2 * i + a: value for a, value in enumerate(values)}


def _minus(a: Row, b: Row) -> Row:
    return {i: a.get(i, 0.0) - b.get(i, 0.0) for i in a | b}


def _stack(rows: list[Row] | tuple[Row, ...], n: int) -> csc_array:
    i = [line for line, row in enumerate(rows) for _ in row]
    j = [column for row in rows for column in row]
    value = [coefficient for row in rows for coefficient in row.values()]
    return csc_array(coo_array((value, (i, j)), shape=(len(rows), n), dtype=float))


def _check(
    rig: Rig,
    elements: int,
    rigid: Collection[str],
    feedback: Mapping[str, tuple[float, float]],
) -> None:
    if elements < 1:
        raise InputError(rig.name, "elements", elements, "1 beam element or more")
    springs = [e.name for e in rig.element if isinstance(e, TorsionalSpring)]
    for name in rigid:
        if name not in springs:
            raise InputError(rig.name, "rigid", name, f"torsional springs, of {springs}")
    sources = [e.name for e in rig.element if isinstance(e, AngularVelocitySource)]
    for name, (g_v, _) in feedback.items():
        if name not in sources:
            raise InputError(rig.name, "feedback", name, f"sources, of {sources}")
        if not g_v > 0:
            raise InputError(rig.name, f"feedback.{name}", g_v, "g_v above 0 N m s/rad")
