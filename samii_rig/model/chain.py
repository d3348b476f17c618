"""From a rig file to the arrays of the kernels.

A chain of n elements has n + 1 ports: port j lies before element j, port n is the tip. A
beam that carries an accelerometer is divided there, so it counts as two elements.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from samii_rig.errors import InputError
from samii_rig.model.kernels.registers import (
    BEAM_KIND,
    CLAMPED,
    FREE_END,
    GUIDED,
    HINGE,
    IDENTITY,
    JUMP,
    LINK,
    PINNED,
    SPRING,
    THETA_M,
    WAVES,
    System,
)
from samii_rig.model.laws import POINTS, SOURCE_LAWS
from samii_rig.model.sensing import reading_of, source_feed, terms
from samii_rig.model.weight import Weight, segments
from samii_rig.rig.schema import (
    BEAMS,
    LINES,
    SOURCES,
    Acceleration,
    Beam,
    Bend,
    Branch,
    Element,
    Gear,
    Key,
    LumpedMass,
    Rig,
    RigidLink,
    Rod,
    Spindle,
    Strain,
    TimoshenkoBeam,
    TorsionalSpring,
    parameters,
)
from samii_rig.rig.schema.axial import turning
from samii_rig.types import Float, Int

ENDS = {"free": FREE_END, "pinned": PINNED, "clamped": CLAMPED}
# Of a chain that moves along itself theta is free at the base, held at the tip and so 0; of one
# that turns first and slides behind its spindle, w is free at the base in its place.
AXIAL_BASE = {"free": FREE_END, "clamped": PINNED}
TURNING_BASE = {"free": FREE_END, "clamped": GUIDED}
AXIAL_TIP = {"free": GUIDED, "clamped": CLAMPED}
WIDTH = 9  # the most parameters that an element has, the tension of a beam among them
L_OF_BEAM = 2  # place of L among the beams' parameters
SOURCE_WIDTH = 4 + 6  # the most parameters of a source and of a hydraulic line behind it
LINE_AT = 4  # place of the line's first among them


@dataclass(frozen=True, slots=True)
class CompiledChain:
    """The arrays of the kernels, and how to read them.

    system : of the kernels; what depends on s comes from `factors.bind`.
    parameters : (element, symbol) of every parameter, in the file's order.
    slots : (n_op, 9) index into `parameters` of each element's parameters, -1 for none; from
        their number on, of the loads of `weight`.
    source_slots : (n_source, 10) the same of each source and of the line behind it;
        source_values the values there.
    fixed, source_fixed : what is added to the parameters there: a beam's part is shorter
        than the beam by what lies before it.
    kinds : kind of each element, by name; sources : of each source.
    lines : (n_source,) kind of the line that follows, "" for none.
    points, waves, poles : the elements of kind JUMP or HINGE, of kind WAVES, and those whose
        law may have poles.
    at_end : (sensor, port, index into `parameters`) of an accelerometer at the very end of a
        beam, and of that beam's L.
    places : for each port (element, m from its upstream end); the base is at 0 of the first.
    branches : (element of the kernels, chain, index into `parameters` of its first).
    rigid : indices into `parameters` that cannot change without a new chain, as a sensor stands at
        the end of the beam whose length they are, or its tension is cut into steps.
    divided : index into `parameters` of a beam's length, and m of the last sensor or position that
        divides it: a beam that ends before is another chain.
    readings : (sensor, law of `laws.READINGS`, element of the kernels) of the sensors whose reading
        depends on what they stand on.
    weight : what gravity loads, None without it.
    """

    system: System
    parameters: tuple[Key, ...]
    values: Float
    slots: Int
    source_slots: Int
    fixed: Float
    source_fixed: Float
    source_values: Float
    kinds: tuple[str, ...]
    sources: tuple[str, ...]
    lines: tuple[str, ...]
    points: tuple[int, ...]
    waves: tuple[int, ...]
    poles: tuple[int, ...]
    at_end: tuple[tuple[int, int, int], ...]
    places: tuple[tuple[str, float], ...]
    branches: tuple[tuple[int, CompiledChain, int], ...]
    rigid: frozenset[int]
    divided: tuple[tuple[int, float], ...]
    readings: tuple[tuple[int, str, int], ...] = ()
    weight: Weight | None = None

    def holds(self, values: Float, changed: Iterable[int]) -> bool:
        """Whether it may have these values (n_param,), SI units, of which those at `changed`
        differ."""
        longer = all(values[i] > last for i, last in self.divided)
        return longer and self.rigid.isdisjoint(changed)

    def with_values(self, values: Float) -> CompiledChain:
        """The same chain with other values (n_param,), SI units, which it `holds`."""
        padded = _padded(values, self.weight)
        pars = padded[self.slots] + self.fixed
        source = padded[self.source_slots] + self.source_fixed
        branches = tuple(
            (e, c.with_values(values[first : first + len(c.parameters)]), first)
            for e, c, first in self.branches
        )
        if self.weight:
            self.weight.load(pars, [c.mass() for _, c, _ in branches])
        system = self.system._replace(pars=pars)
        if self.sources:
            dual = system.source_c.copy()
            dual[:, 4] = source[:, 0]
            system = system._replace(source_c=dual)
        return replace(self, system=system, values=values, source_values=source, branches=branches)

    def mass(self) -> float:
        """kg of a chain with a weight."""
        assert self.weight
        inner = [c.mass() for _, c, _ in self.branches]
        return float(np.sum(self.weight.masses(self.system.pars, inner)))

    def mass_slopes(self) -> Float:
        """(n_op, n_param) of the masses of a chain with a weight."""
        assert self.weight
        by = self._by_values()
        inner = []
        for _, c, first in self.branches:
            own = np.zeros(self.values.size)
            own[first : first + c.values.size] = c.mass_slopes().sum(axis=0)
            inner.append(own)
        return self.weight.mass_slopes(self.system.pars, by, inner)

    def load_slopes(self) -> Float:
        """(n_load, n_param) of the loads of `weight`, (0, n_param) without one."""
        if not self.weight:
            return np.zeros((0, self.values.size))
        inner = [c.mass() for _, c, _ in self.branches]
        masses = self.weight.masses(self.system.pars, inner)
        by = self._by_values()
        return self.weight.slopes(self.system.pars, by, masses, self.mass_slopes())

    def _by_values(self) -> Float:
        """(n_op, WIDTH, n_param): 1 where a parameter of an operation is one of the chain's."""
        return np.asarray(self.slots[:, :, None] == np.arange(self.values.size), dtype=float)


def _padded(values: Float, weight: Weight | None) -> Float:
    """The values, the loads (still 0) and the 0 of what is no parameter."""
    out = np.zeros(values.size + 1 + (weight.size if weight else 0))
    out[: values.size] = values
    return out


def _kind(element: Element, pull: float) -> int:
    match element:
        case Beam() if pull == 0:
            return BEAM_KIND
        case Beam() | TimoshenkoBeam() | Branch() | Rod() | Gear() | Spindle() | Bend():
            return WAVES
        case RigidLink() | LumpedMass():
            return LINK
        case TorsionalSpring():
            return SPRING
    if isinstance(element, SOURCES):
        return IDENTITY
    return HINGE if POINTS[element.kind].pair == THETA_M else JUMP


def _cuts(rig: Rig, extra: Mapping[str, Sequence[float]]) -> dict[str, list[float]]:
    """Where each beam is divided: at accelerometers inside it and at `extra` positions."""
    cuts: dict[str, list[float]] = {}
    beams = [e.name for e in rig.element if isinstance(e, BEAMS)]
    for name in extra:
        if name not in beams:
            raise InputError("positions", "", name, f"a beam of {beams}")
    for element, pull in zip(rig.element, rig.pulls, strict=True):
        if not isinstance(element, BEAMS):
            continue
        wanted = {float(x) for x in extra.get(element.name, ())}
        for sensor in rig.sensor:
            if isinstance(sensor, Acceleration | Strain) and sensor.on == element.name:
                wanted.add(sensor.position)
        L = element.L.value
        for x in wanted:
            if not 0 <= x <= L:
                raise InputError(element.name, "position", x, f"between 0 and L = {L:g} m")
        inner = sorted(x for x in wanted if 0 < x < L)
        cuts[element.name] = _in_segments(element, pull, inner)
    return cuts


def _in_segments(
    beam: Beam | TimoshenkoBeam, pull: float, inner: Sequence[float] = ()
) -> list[float]:
    """The places `inner` of a beam and those at which its tension is cut into steps."""
    out = list(inner)
    for start, stop in pairwise([0.0, *inner, beam.L.value]):
        out += segments(beam, pull, start, stop)
    return sorted(out)


class _Parts:
    """The elements of the kernels as they are listed, one list for each array."""

    def __init__(
        self, cuts: Mapping[str, Sequence[float]], inputs: Sequence[str], *, weighs: bool
    ) -> None:
        self.cuts, self.inputs, self.weighs = cuts, inputs, weighs
        self.pull = 0.0  # along the chain at the element that is added
        self.pulls: list[float] = []
        self.bends: list[tuple[int, float]] = []
        self.keys: list[Key] = []
        self.values: list[float] = []
        self.op: list[tuple[int, int, int]] = []  # kind, pair, row
        self.kinds: list[str] = []
        self.slots: list[list[int]] = []
        self.fixed: list[list[float]] = []
        self.places: list[tuple[str, float]] = []
        self.sources: list[str] = []
        self.source: list[tuple[int, int]] = []
        self.source_slots: list[list[int]] = []
        self.lines: list[str] = []
        self.branches: list[tuple[int, CompiledChain, int]] = []
        self.rigid: set[int] = set()
        self.divided: list[tuple[int, float]] = []
        self.rows = {JUMP: 0, WAVES: 0}

    def add(self, element: Element, pull: float) -> None:
        self.pull = pull
        first = len(self.keys)
        own = parameters(element)
        self.keys += [(element.name, symbol) for symbol in own]
        self.values += [p.value for p in own.values()]
        index = [*range(first, first + len(own))]
        if not self.places:
            self.places.append((element.name, 0.0))
        if isinstance(element, SOURCES):
            self._source(element, dict(zip(own, index, strict=True)))
            index = []
        elif isinstance(element, LINES):
            self.lines[-1] = element.kind
            self.source_slots[-1][LINE_AT : LINE_AT + len(index)] = index
        elif isinstance(element, LumpedMass):
            index = [-1, -1, *index]  # a link of no length
        elif isinstance(element, Branch):
            inner = compile_branch(element, pull, weighs=self.weighs)
            self.keys += inner.parameters
            self.values += list(inner.values)
            self.branches.append((len(self.op), inner, first))
        if pull and isinstance(element, RigidLink):
            self._moment(element)
        if isinstance(element, Bend):
            self._carried(element)
        length = element.L.value if isinstance(element, (*BEAMS, RigidLink, Rod)) else 0.0
        inside = self.cuts.get(element.name, ())
        for start, stop in pairwise([0.0, *inside, length]):
            slot, fixed = index + [-1] * (WIDTH - len(index)), [0.0] * WIDTH
            if isinstance(element, Bend):
                fixed[0] = math.cos(element.angle.value)
            if isinstance(element, BEAMS):
                if stop == length:
                    # A position is fixed, so a longer beam is longer behind the last one.
                    fixed[L_OF_BEAM] = -start
                else:
                    slot[L_OF_BEAM], fixed[L_OF_BEAM] = -1, stop - start
            self._op(element, slot, fixed)
            self.places.append((element.name, stop))
        if isinstance(element, BEAMS) and inside:
            if pull:  # its tension is cut into steps along its length
                self.rigid.add(index[L_OF_BEAM])
            else:
                self.divided.append((index[L_OF_BEAM], inside[-1]))

    def _moment(self, element: Element) -> None:
        """The moment of gravity on a body, before it."""
        self.op.append((JUMP, POINTS["gravity_stiffness"].pair, self.rows[JUMP]))
        self.rows[JUMP] += 1
        self._loaded("gravity_stiffness", element)

    def _carried(self, element: Bend) -> None:
        """The mass of what lies beyond a bend, before it, as far as w moves it along itself."""
        self.bends.append((len(self.op), math.sin(element.angle.value) ** 2))
        self.op.append((LINK, -1, -1))
        self._loaded("carried", element)

    def _loaded(self, kind: str, element: Element) -> None:
        """An operation whose only parameter is a load."""
        self.kinds.append(kind)
        self.slots.append([-1] * WIDTH)
        self.fixed.append([0.0] * WIDTH)
        self.pulls.append(self.pull)
        self.places.append((element.name, 0.0))

    def weight(self) -> Weight | None:
        """What gravity and a bend load."""
        if not self.weighs:
            return None
        kinds = [kind for kind, _, _ in self.op]
        bends = {e for e, _ in self.bends}
        bodies = [e for e, kind in enumerate(kinds) if kind == LINK and e not in bends]
        beams = [e for e, kind in enumerate(self.kinds) if kind in ("beam", "timoshenko_beam")]
        found = Weight(
            tuple(self.pulls),
            tuple(beams),
            tuple(e for e in beams if self.pulls[e]),
            tuple(bodies),
            tuple(e - 1 if self.kinds[e] == "rigid_link" and self.pulls[e] else -1 for e in bodies),
            tuple(e for e, _, _ in self.branches),
            tuple(self.bends),
        )
        found.slots(self.slots, len(self.keys))
        return found

    def _op(self, element: Element, slot: list[int], fixed: list[float]) -> None:
        kind = _kind(element, self.pull)
        pair, row = -1, -1
        if kind in (JUMP, HINGE):
            pair, row = POINTS[element.kind].pair, self.rows[JUMP]
            self.rows[JUMP] += 1
        elif kind == WAVES:
            row = self.rows[WAVES]
            self.rows[WAVES] += 1
        self.op.append((kind, pair, row))
        self.pulls.append(self.pull)
        self.kinds.append(element.kind)
        self.slots.append(slot)
        self.fixed.append(fixed)

    def _source(self, element: Element, index: dict[str, int]) -> None:
        assert isinstance(element, SOURCES)
        symbols = [s for s in type(element).model_fields if s not in ("name", "kind", "input")]
        slots = [index.get(symbol, -1) for symbol in symbols]
        self.source.append((len(self.op), self.inputs.index(element.input)))
        self.source_slots.append(slots + [-1] * (SOURCE_WIDTH - len(slots)))
        self.sources.append(element.kind)
        self.lines.append("")


def compile_chain(rig: Rig, extra: Mapping[str, Sequence[float]] | None = None) -> CompiledChain:
    """The kernels' arrays of a rig; beams are also divided at `extra` positions, m.

    Raises InputError for a position that does not lie on its beam.
    """
    pulls = rig.pulls
    weighs = any(pulls) or rig.bent
    parts = _Parts(_cuts(rig, extra or {}), [a.name for a in rig.actuator], weighs=weighs)
    for element, pull in zip(rig.element, pulls, strict=True):
        parts.add(element, pull)
    term, term_c = terms(rig, parts.places)
    beam_ends = {(e.name, e.L.value) for e in rig.element if isinstance(e, BEAMS)}
    at_end = tuple(
        (i, parts.places.index((sensor.on, sensor.position)), parts.keys.index((sensor.on, "L")))
        for i, sensor in enumerate(rig.sensor)
        if isinstance(sensor, Acceleration) and (sensor.on, sensor.position) in beam_ends
    )
    parts.rigid.update(index for _, _, index in at_end)
    dual = np.array([SOURCE_LAWS[kind].dual for kind in parts.sources]).reshape(-1, 4)
    ends = ENDS[rig.base], ENDS[rig.tip]
    if rig.motion == "axial":
        base = TURNING_BASE if turning(rig) else AXIAL_BASE
        ends = base[rig.base], AXIAL_TIP[rig.tip]
    compiled = _assemble(
        parts,
        ends,
        np.array(parts.source),
        dual,
        source_feed(rig),
        term,
        term_c,
        at_end,
    )
    return replace(compiled, readings=tuple(_readings(rig, parts.places)))


def _readings(rig: Rig, places: Sequence[tuple[str, float]]) -> Iterator[tuple[int, str, int]]:
    behind = {name: port for port, (name, _) in enumerate(places)}
    for i, sensor in enumerate(rig.sensor):
        found = reading_of(sensor)
        if found:
            yield i, found[0], behind[found[1]] - 1


def compile_branch(branch: Branch, pull: float = 0.0, *, weighs: bool = False) -> CompiledChain:
    """A side chain with its root clamped: sources that move the root by w and theta of 1, and
    sensors of M and V there, so that its response is the impedance of the branch. pull : gravity
    along it, as of the chain that it stands on. weighs : whether its mass is asked for."""
    beams = [e for e in branch.element if isinstance(e, BEAMS)]
    parts = _Parts({e.name: _in_segments(e, pull) for e in beams}, [], weighs=weighs)
    for element in branch.element:
        parts.add(element, pull)
    dual = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.0, 0.0]])  # w and theta jump by +1
    term = np.array([[0, 0, 0, -1], [1, 0, 0, -1]])
    term_c = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    at_root = np.array([[0, 0], [0, 1]])
    return _assemble(
        parts, (CLAMPED, ENDS[branch.tip]), at_root, dual, np.zeros((2, 2)), term, term_c, ()
    )


def _where(kinds: Int, wanted: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(e for e, kind in enumerate(kinds.tolist()) if kind in wanted)


def _assemble(
    parts: _Parts,
    ends: tuple[int, int],
    source: Int,
    dual: Float,
    feed: Float,
    term: Int,
    term_c: Float,
    at_end: tuple[tuple[int, int, int], ...],
) -> CompiledChain:
    values, weight = np.array(parts.values), parts.weight()
    slots = np.array(parts.slots, dtype=np.int64)
    fixed = np.array(parts.fixed)
    source_slots = np.array(parts.source_slots, dtype=np.int64).reshape(-1, SOURCE_WIDTH)
    if not parts.sources:
        source_slots = np.full((len(dual), SOURCE_WIDTH), -1)  # the root of a branch
    source_fixed = np.zeros(source_slots.shape)
    for i, kind in enumerate(parts.sources):
        if kind in ("torque_source", "force_source") and source_slots[i, 1] < 0:
            source_fixed[i, 1] = math.inf  # no lag
    padded = _padded(values, weight)
    source_values = padded[source_slots] + source_fixed
    op = np.array(parts.op, dtype=np.int64)
    kinds = np.ascontiguousarray(op[:, 0])
    pars = padded[slots] + fixed
    if weight:
        weight.load(pars, [inner.mass() for _, inner, _ in parts.branches])
    gain = source_values[:, 0] if parts.sources else np.ones(len(dual))  # a branch's are jumps of 1
    return CompiledChain(
        system=System(
            kinds=kinds,
            pars=pars,
            place=np.ascontiguousarray(op[:, 1:]),
            ends=np.array(ends, dtype=np.int64),
            source=np.array(source, dtype=np.int64).reshape(-1, 2),
            source_c=np.column_stack([dual, gain]),
            feed=feed,
            term=term,
            term_c=term_c,
        ),
        parameters=tuple(parts.keys),
        values=values,
        slots=slots,
        source_slots=source_slots,
        fixed=fixed,
        source_fixed=source_fixed,
        source_values=source_values,
        kinds=tuple(parts.kinds),
        sources=tuple(parts.sources),
        lines=tuple(parts.lines),
        points=_where(kinds, (JUMP, HINGE)),
        waves=_where(kinds, (WAVES,)),
        poles=_where(kinds, (SPRING, JUMP, HINGE)),
        at_end=at_end,
        places=tuple(parts.places),
        branches=tuple(parts.branches),
        rigid=frozenset(parts.rigid),
        divided=tuple(parts.divided),
        weight=weight,
    )
