"""The walk along a chain that collects coordinates, matrices and constraints.

Every beam node and every rigid body has coordinates (w, theta) of its own, every joint its
relative motion; a point where something acts from the ground is a node too. The walk carries
the rows that give w and theta where it stands; the next part is joined there by constraints.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array, csc_array

from samii_rig.errors import InputError
from samii_rig.fem import hermite, lagrange
from samii_rig.fem.drive import Feedback, Load, Prescribed, law
from samii_rig.fem.mechanism import Mechanism, Places
from samii_rig.rig.schema import (
    ANGLE_SOURCES,
    MOTION_SOURCES,
    AbsoluteAngle,
    Acceleration,
    AccelerationSource,
    AngularVelocitySource,
    AngularVelocitySource2,
    Beam,
    Bend,
    Branch,
    Current,
    Cylinder,
    Displacement,
    DisplacementSource,
    Element,
    Force,
    ForceSource,
    Gear,
    GravityStiffness,
    LumpedLine,
    LumpedMass,
    Moment,
    OilColumn,
    Pressure,
    RelativeAngle,
    Rig,
    RigidLink,
    Rod,
    Sensor,
    Spindle,
    Strain,
    TimoshenkoBeam,
    TorqueSource,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
    Velocity,
    VelocitySource,
)
from samii_rig.rig.schema.axial import turning
from samii_rig.rig.schema.elements import End
from samii_rig.types import Float

Row = dict[int, float]  # a linear function of the coordinates: coefficient by coordinate


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


class Walk:
    """Goes from base to tip; `w` and `theta` are the motion at the place reached, `x` m on.

    Of a chain that moves along itself theta is nowhere anything.
    """

    def __init__(self, rig: Rig, elements: int) -> None:
        self._rig, self._n_beam = rig, elements
        self._n = 0  # coordinates so far
        self._M, self._C, self._H, self._K, self._G = (_Entries() for _ in range(5))
        self._constraints: list[Row] = []
        self._waiting: list[str] = []  # elements since rotations were last joined
        self._moment: dict[str, int] = {}
        self._pulling: list[str] = []  # elements since displacements were last joined
        self._force: dict[str, int] = {}
        self._moved: dict[str, Row] = {}  # displacement after each element
        self._span: dict[str, tuple[Row, Row]] = {}  # rotation before and after each element
        self._nodes: dict[str, int] = {}  # first coordinate of each beam and body
        self._locks: dict[str, int] = {}
        self._joints: dict[str, int] = {}
        self._sources: list[Prescribed] = []
        self._feedback: list[Feedback] = []
        self._loads: list[Load] = []
        self._places: list[tuple[float, str, Row, Row]] = []
        self._chambers: dict[str, tuple[Row, Row]] = {}  # pressures of each cylinder
        self._beyond = sum(map(_mass, rig.element))  # kg
        self._pull = rig.pull  # m/s^2 along the chain at the place reached
        self.w: Row = {}
        self.theta: Row = {}
        self.x = 0.0

    def base(self) -> None:
        """Fix the base as the rig file says."""
        turns = self._rig.motion == "lateral" or bool(turning(self._rig))
        if self._rig.base == "free" and not turning(self._rig):
            self.w = self._new()
        if self._rig.base != "clamped" and turns:
            self.theta = self._new()
        self._place("")

    def over(
        self,
        e: Element,
        rigid: Collection[str] = (),
        feedback: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        """Add one element and go on to its other end."""
        before = self.theta
        self._beyond -= _mass(e)
        self._add(e, rigid, (feedback or {}).get(e.name))
        self._waiting.append(e.name)
        self._pulling.append(e.name)
        self._span[e.name] = before, self.theta
        self._moved[e.name] = self.w
        self._place(e.name)

    def _add(self, e: Element, rigid: Collection[str], loop: tuple[float, float] | None) -> None:
        """Stiffness, damping, mass and coordinates of one element; loop : of a source."""
        match e:
            case Beam() | TimoshenkoBeam():
                self._beam(e)
            case RigidLink():
                self._body(e.L.value, e.r.value, e.m.value, e.I.value, e.name)
                arm = self._beyond * e.L.value + e.m.value * e.r.value
                self._spring(self._nodes[e.name] + 1, self._pull * arm)
            case LumpedMass():
                self._body(0.0, 0.0, e.m.value, e.I.value, e.name)
            case Rod():
                self._rod(e)
            case Cylinder():
                self._cylinder(e)
            case Gear():
                node = self._point(e.name)
                self.theta = {node + 1: 1 / e.n.value}
            case Spindle():
                node = self._point(e.name)
                self.w, self.theta = {node + 1: e.lead.value}, {}
            case Bend():
                self._bend(e)
            case TorsionalSpring():
                j = self._joint(e.name)
                if e.name in rigid:
                    self._locks[e.name] = j
                else:
                    self._spring(j, e.k.value, e.c.value)
            case OilColumn():
                # A volume D turns by pressure times C_h: compliance C_h/D^2.
                if e.C_h.value > 0:
                    self._spring(self._joint(e.name), e.D.value**2 / e.C_h.value)
            case LumpedLine():
                self._line(e)
            case TranslationalSpring():
                self.w = {**self.w, **self._new()}
                self._spring(self._n - 1, e.k.value, e.c.value)
            case TorsionalGroundSpring():
                self._spring(self._point(e.name) + 1, e.k.value, e.c.value)
            case GravityStiffness():
                self._spring(self._point(e.name) + 1, e.k.value)
            case TranslationalGroundSpring():
                self._spring(self._point(e.name), e.k.value, e.c.value)
            case AngularVelocitySource() | AngularVelocitySource2():
                self._source(e, loop)
            case DisplacementSource() | VelocitySource() | AccelerationSource():
                self._motion_source(e)
            case TorqueSource():
                self._load(e, self._point(e.name) + 1)
            case ForceSource():
                self._load(e, self._point(e.name))
            case Branch():
                self._branch(e, rigid)
            case _:
                expected = "an element with a finite number of coordinates"
                raise InputError(self._rig.name, e.name, e.kind, expected)

    def _beam(self, e: Beam | TimoshenkoBeam) -> None:
        n, h = self._n_beam, e.L.value / self._n_beam
        first = self._nodes[e.name] = self._n
        self._n += 2 * (n + 1)
        self._join(first)
        phi, J = _shear(e, h), e.J.value if isinstance(e, TimoshenkoBeam) else 0.0
        k = hermite.stiffness(e.EI.value, h, phi)
        m = hermite.consistent_mass(e.mu.value, h, phi, J)
        own = self._pull * e.mu.value * h
        for i in range(n):
            at = list(range(first + 2 * i, first + 2 * i + 4))
            self._K.add(at, k)
            if own:
                beyond = self._pull * self._beyond + own * (n - i - 1)
                self._K.add(at, hermite.tension((beyond + own, beyond), h, phi))
            self._M.add(at, m)
            self._C.add(at, e.tau.value * k)
            self._H.add(at, e.eta.value * k)
            if i < n - 1:
                self.x += h
                self.w, self.theta = {at[2]: 1.0}, {at[3]: 1.0}
                self._place(e.name)
        self.x += h
        self.w, self.theta = {first + 2 * n: 1.0}, {first + 2 * n + 1: 1.0}

    def _rod(self, e: Rod) -> None:
        n, h, step = self._n_beam, e.L.value / self._n_beam, lagrange.NODES - 1
        first = self._n
        self._n += step * n + 1
        self._join_displacement({first: 1.0})
        k, m = lagrange.stiffness(e.EA.value, h), lagrange.consistent_mass(e.mu.value, h)
        for i in range(n):
            at = list(range(first + step * i, first + step * (i + 1) + 1))
            self._K.add(at, k)
            self._M.add(at, m)
            self._C.add(at, e.tau.value * k)
        self.x += e.L.value
        self.w = {first + step * n: 1.0}

    def _cylinder(self, e: Cylinder) -> None:
        """The oil as springs and a damper: k_0 beside k_1 in series with c_1, which the leak is."""
        a, b, V, W, B = (p.value for p in (e.A_1, e.A_2, e.V_1, e.V_2, e.B))
        oil, slipping = self._n, self._n + 1
        self.w = {**self.w, **self._new()}
        S0, S1 = 1 / V + 1 / W, a / V + b / W
        k_0, k_1 = B * (a - b) ** 2 / (V * W) / S0, B * S1**2 / S0
        # A stretch of the oil empties chamber 1 and fills chamber 2; what has slipped by the
        # leak has made their pressures one.
        even = (a - b) / (V * W) / S0
        one, two = {oil: -B * a / V}, {oil: B * b / W}
        if e.leak.value > 0:
            one[slipping], two[slipping] = B * (a / V - even), -B * (b / W + even)
        self._chambers[e.name] = one, two
        if e.leak.value == 0:
            self._spring(oil, k_0 + k_1)
            return
        self._n += 1
        self._spring(oil, k_0)
        self._K.add([oil, slipping], [[k_1, -k_1], [-k_1, k_1]])
        self._C.add([slipping], k_1 / (B * e.leak.value * S0))

    def _body(self, L: float, r: float, m: float, I: float, name: str) -> None:  # noqa: E741
        first = self._nodes[name] = self._n
        self._n += 2
        self._join(first, -r)
        self._M.add([first, first + 1], np.diag([m, I]))
        self.x += L
        self.w, self.theta = {first: 1.0, first + 1: L - r}, {first + 1: 1.0}

    def _point(self, name: str) -> int:
        """A node without mass: what acts from the ground changes M or V from here on."""
        self._body(0.0, 0.0, 0.0, 0.0, name)
        return self._nodes[name]

    def _bend(self, e: Bend) -> None:
        """All that lies beyond moves along itself as one, by the part of w in that direction."""
        node, angle = self._point(e.name), e.angle.value
        self._M.add([node], self._beyond * np.sin(angle) ** 2)
        self.w = {node: float(np.cos(angle))}
        self._pull = self._rig.pulls[[x.name for x in self._rig.element].index(e.name)]

    def _spring(self, coordinate: int, k: float, c: float = 0.0) -> None:
        self._K.add([coordinate], k)
        self._C.add([coordinate], c)

    def _line(self, e: LumpedLine) -> None:
        """The oil gives way in a coordinate of its own; what the source lets in moves with what
        it gives, and the line's inertance with both."""
        k, omega = e.D.value**2 / e.C_h.value, e.omega.value
        source, oil = self._joints[e.source], self._joint(e.name)
        self._spring(oil, k, 2 * e.zeta.value * k / omega)
        self._M.add([source, oil], np.full((2, 2), k / omega**2))

    def _source(
        self,
        e: AngularVelocitySource | AngularVelocitySource2,
        feedback: tuple[float, float] | None,
    ) -> None:
        j, column = self._joint(e.name), self._column(e.input)
        if feedback is None:
            self._locks[e.name] = j
            self._sources.append(Prescribed(e.name, j, column, law(e)))
        else:
            g_v, g_a = feedback
            self._G.add([j], g_v)
            self._feedback.append(Feedback(e.name, j, column, g_v * g_a))

    def _motion_source(self, e: DisplacementSource | VelocitySource | AccelerationSource) -> None:
        j = self._joints[e.name] = self._locks[e.name] = self._n
        self.w = {**self.w, **self._new()}
        self._sources.append(Prescribed(e.name, j, self._column(e.input), law(e)))

    def _load(self, e: TorqueSource | ForceSource, coordinate: int) -> None:
        self._loads.append(Load(e.name, coordinate, self._column(e.input), law(e)))

    def _column(self, name: str) -> int:
        return [a.name for a in self._rig.actuator].index(name)

    def _branch(self, e: Branch, rigid: Collection[str]) -> None:
        self._point(e.name)
        here = self.w, self.theta, self.x, self._waiting, self._pulling, self._beyond
        self._waiting, self._pulling = [], []  # no sensor stands on a branch
        self._beyond = _mass(e)
        for part in e.element:
            self.over(part, rigid)
        self.tip(e.tip)
        self.w, self.theta, self.x, self._waiting, self._pulling, self._beyond = here

    def tip(self, end: End) -> None:
        """Fix the end reached as the rig file says."""
        if end != "free":
            self._join_displacement({})
        if end == "clamped" and self._rig.motion == "lateral":
            self._join_rotation({})

    def mechanism(self) -> Mechanism:
        """What the walk has collected."""
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
            tuple(self._loads),
            _stack([self._angle(s) for s in sensors], n),
            _stack([self._speed(s) for s in sensors], n),
            _stack([self._acceleration(s) for s in sensors], n),
            tuple(self._multipliers(sensors)),
            tuple(self._feeds(sensors)),
            Places(np.array(x), element, _stack(w, n), _stack(theta, n)),
        )

    def _multipliers(self, sensors: tuple[Sensor, ...]) -> Iterator[tuple[int, int, float]]:
        for i, s in enumerate(sensors):
            match s:
                case Moment():
                    rows, at, factor = self._moment, s.after, 1.0
                case Force():
                    rows, at, factor = self._force, s.after, 1.0
                case Pressure() if s.area is not None:
                    rows, at, factor = self._force, s.after, -1 / s.area
                case Current():
                    # What a source of motion passes on. One that pushes reads its own load.
                    (source,) = (e for e in self._rig.element if e.name == s.of)
                    turns = isinstance(source, ANGLE_SOURCES)
                    rows = self._moment if turns else self._force
                    at, factor = s.of if s.of in self._locks else "", -1 / s.constant
                case _:
                    continue
            if at in rows:
                yield i, rows[at], factor

    def _feeds(self, sensors: tuple[Sensor, ...]) -> Iterator[tuple[int, int, float]]:
        names = [load.element for load in self._loads]
        for i, s in enumerate(sensors):
            if isinstance(s, Current) and s.of in names:
                yield i, names.index(s.of), 1 / s.constant

    def _new(self) -> Row:
        self._n += 1
        return {self._n - 1: 1.0}

    def _joint(self, name: str) -> int:
        j = self._joints[name] = self._n
        self.theta = {**self.theta, **self._new()}
        return j

    def _join(self, node: int, offset: float = 0.0) -> None:
        """Put the point `offset` m beside a node where the walk stands."""
        self._join_displacement({node: 1.0, node + 1: offset})
        self._join_rotation({node + 1: 1.0})

    def _join_displacement(self, w: Row) -> None:
        # What crosses this constraint is the tension after all elements since the last one.
        self._force.update(dict.fromkeys(self._pulling, len(self._constraints)))
        self._pulling.clear()
        self._constraints.append(_minus(w, self.w))

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
            case Acceleration():
                if self._has_no_extent(sensor):
                    theta = self._span[sensor.on][1]
                else:
                    theta = self._along(sensor, hermite.rotation, {1: 1.0})
                g = self._rig.tilt_gravity(sensor.on)
                return {i: sensor.tilt * g * x for i, x in theta.items() if sensor.tilt}
            case RelativeAngle():
                return _minus(self._span[sensor.across[-1]][1], self._span[sensor.across[0]][0])
            case Displacement():
                return self._way(sensor)
            case Strain():
                bend = self._along(sensor, hermite.curvature, {})
                return {i: -sensor.height * x for i, x in bend.items()}
            case Pressure() if sensor.chamber is not None:
                return self._chambers[sensor.after][sensor.chamber - 1]
        return {}

    def _speed(self, sensor: Sensor) -> Row:
        return self._way(sensor) if isinstance(sensor, Velocity) else {}

    def _way(self, sensor: Displacement | Velocity) -> Row:
        against = {} if sensor.against is None else self._moved[sensor.against]
        return _minus(self._moved[sensor.after], against)

    def _acceleration(self, sensor: Sensor) -> Row:
        if not isinstance(sensor, Acceleration):
            return {}
        if self._has_no_extent(sensor):
            return self._moved[sensor.on]
        host = self._host(sensor)
        arm = sensor.position - host.r.value if isinstance(host, RigidLink) else 0.0
        return self._along(sensor, hermite.shape, {0: 1.0, 1: arm})

    def _along(
        self,
        sensor: Acceleration | Strain,
        on_beam: Callable[[float, float, float], Float],
        on_body: Row,
    ) -> Row:
        """A row on the coordinates of the element that carries the sensor."""
        host, first = self._host(sensor), self._nodes[sensor.on]
        if isinstance(host, RigidLink):
            return {first + i: value for i, value in on_body.items()}
        h = host.L.value / self._n_beam
        i = min(int(sensor.position / h), self._n_beam - 1)
        values = on_beam(sensor.position - i * h, h, _shear(host, h)).tolist()
        return {first + 2 * i + a: value for a, value in enumerate(values)}

    def _has_no_extent(self, sensor: Acceleration) -> bool:
        host = next(e for e in self._rig.element if e.name == sensor.on)
        return isinstance(host, (LumpedMass, *MOTION_SOURCES))

    def _host(self, sensor: Acceleration | Strain) -> Beam | TimoshenkoBeam | RigidLink:
        host = next(e for e in self._rig.element if e.name == sensor.on)
        assert isinstance(host, Beam | TimoshenkoBeam | RigidLink)  # the schema allows no other
        return host


def _mass(e: Element) -> float:
    """kg of an element."""
    match e:
        case Beam() | TimoshenkoBeam():
            return e.mu.value * e.L.value
        case RigidLink() | LumpedMass():
            return e.m.value
        case Branch():
            return sum(map(_mass, e.element))
    return 0.0


def _shear(e: Beam | TimoshenkoBeam, h: float) -> float:
    """12 EI/(GA h^2): shear over bending flexibility of an element, 0 for Euler-Bernoulli."""
    return 12 * e.EI.value / (e.GA.value * h**2) if isinstance(e, TimoshenkoBeam) else 0.0


def _minus(a: Row, b: Row) -> Row:
    return {i: a.get(i, 0.0) - b.get(i, 0.0) for i in a | b}


def _stack(rows: list[Row] | tuple[Row, ...], n: int) -> csc_array:
    i = [line for line, row in enumerate(rows) for _ in row]
    j = [column for row in rows for column in row]
    value = [coefficient for row in rows for coefficient in row.values()]
    return csc_array(coo_array((value, (i, j)), shape=(len(rows), n), dtype=float))
