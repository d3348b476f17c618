"""From a rig file to the arrays of the kernels.

A chain of n elements has n + 1 ports: port j lies before element j, port n is the tip. A
beam that carries an accelerometer is divided there, so it counts as two elements.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from samii_rig.errors import InputError
from samii_rig.model.registers import (
    ACCELERATION,
    BEAM_KIND,
    CLAMPED,
    COMPLIANCE,
    FREE_END,
    IDENTITY,
    LINK,
    ONE,
    PINNED,
    SPRING,
    System,
)
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    AngularVelocitySource,
    Beam,
    Element,
    Moment,
    RelativeAngle,
    Rig,
    RigidLink,
    TorsionalSpring,
    parameters,
)
from samii_rig.types import Float, Int

ENDS = {"free": FREE_END, "pinned": PINNED, "clamped": CLAMPED}
L_OF_BEAM = 2  # place of L among the beam's parameters


@dataclass(frozen=True, slots=True)
class CompiledChain:
    """The arrays of the kernels, and how to read them.

    parameters : (element, symbol) of every parameter, in the file's order.
    slots : (n_op, 5) index into `parameters` of each element's parameters, -1 for none.
    at_end : (sensor, port, index into `parameters`) of an accelerometer at the very end of a
        beam, and of that beam's L.
    places : for each port (element, m from its upstream end); the base is at 0 of the first.
    """

    system: System
    parameters: tuple[tuple[str, str], ...]
    slots: Int
    at_end: tuple[tuple[int, int, int], ...]
    places: tuple[tuple[str, float], ...]


def _kind(element: Element) -> int:
    match element:
        case Beam():
            return BEAM_KIND
        case RigidLink():
            return LINK
        case TorsionalSpring():
            return SPRING
        case AngularVelocitySource():
            return IDENTITY


def _cuts(rig: Rig, extra: Mapping[str, Sequence[float]]) -> dict[str, list[float]]:
    """Where each beam is divided: at accelerometers inside it and at `extra` positions."""
    cuts: dict[str, list[float]] = {}
    beams = [e.name for e in rig.element if isinstance(e, Beam)]
    for name in extra:
        if name not in beams:
            raise InputError("positions", "", name, f"a beam of {beams}")
    for element in rig.element:
        if not isinstance(element, Beam):
            continue
        wanted = {float(x) for x in extra.get(element.name, ())}
        for sensor in rig.sensor:
            if isinstance(sensor, Acceleration) and sensor.on == element.name:
                wanted.add(sensor.position)
        L = element.L.value
        for x in wanted:
            if not 0 <= x <= L:
                raise InputError(element.name, "position", x, f"between 0 and L = {L:g} m")
        cuts[element.name] = sorted(x for x in wanted if 0 < x < L)
    return cuts


def _terms(rig: Rig, places: Sequence[tuple[str, float]]) -> tuple[Float, Int, Float]:
    """`feed`, `term` and `term_c` of `System`."""
    elements = {e.name: e for e in rig.element}
    behind = {name: port for port, (name, _) in enumerate(places)}  # the last of its ports
    before = {}
    port = 0
    for name in elements:
        before[name] = port
        port = behind[name]
    sources = [e.name for e in rig.element if isinstance(e, AngularVelocitySource)]
    feed = np.zeros((len(rig.sensor), len(sources)))
    term: list[tuple[int, int, int, int]] = []
    term_c: list[tuple[float, float, float, float]] = []

    def add(
        port: int,
        w: float = 0.0,
        theta: float = 0.0,
        M: float = 0.0,
        factor: int = ONE,
        spring: int = -1,
    ) -> None:
        term.append((i, port, factor, spring))
        term_c.append((w, theta, M, 0.0))

    for i, sensor in enumerate(rig.sensor):
        match sensor:
            case RelativeAngle():
                # Summed over the parts, not theta behind less theta before: the rotation of
                # the whole may be much larger than that of the joint.
                for name in sensor.across:
                    match elements[name]:
                        case AngularVelocitySource():
                            feed[i, sources.index(name)] = 1.0
                        case TorsionalSpring():
                            add(before[name], M=1.0, factor=COMPLIANCE, spring=before[name])
                        case Beam():
                            add(behind[name], theta=1.0)
                            add(before[name], theta=-1.0)
                        case RigidLink():
                            pass
            case AbsoluteAngle():
                add(behind[sensor.after], theta=1.0)
            case Moment():
                add(behind[sensor.after], M=1.0)
            case Acceleration() if isinstance(elements[sensor.on], Beam):
                if sensor.position == 0:
                    add(before[sensor.on], w=1.0, factor=ACCELERATION)
                else:
                    add(places.index((sensor.on, sensor.position)), w=1.0, factor=ACCELERATION)
            case Acceleration():
                add(before[sensor.on], w=1.0, theta=sensor.position, factor=ACCELERATION)
    return (
        feed,
        np.array(term, dtype=np.int64).reshape(-1, 4),
        np.array(term_c, dtype=np.float64).reshape(-1, 4),
    )


def compile_chain(rig: Rig, extra: Mapping[str, Sequence[float]] | None = None) -> CompiledChain:
    """The kernels' arrays of a rig; beams are also divided at `extra` positions, m.

    Raises InputError for a position that does not lie on its beam.
    """
    cuts = _cuts(rig, extra or {})
    keys: list[tuple[str, str]] = []
    kinds: list[int] = []
    pars: list[list[float]] = []
    slots: list[list[int]] = []
    places = [(rig.element[0].name, 0.0)]
    source: list[tuple[int, int]] = []
    actuators = [a.name for a in rig.actuator]
    for element in rig.element:
        values = [p.value for p in parameters(element).values()]
        index = [len(keys) + i for i in range(len(values))]
        keys += [(element.name, symbol) for symbol in parameters(element)]
        if isinstance(element, AngularVelocitySource):
            source.append((len(kinds), actuators.index(element.input)))
        length = values[list(parameters(element)).index("L")] if "L" in parameters(element) else 0.0
        edges = [0.0, *cuts.get(element.name, ()), length]
        for start, stop in pairwise(edges):
            part, slot = list(values), list(index)
            if isinstance(element, Beam):
                part[L_OF_BEAM] = stop - start
                # A position is fixed, so a longer beam is longer behind the last one.
                slot[L_OF_BEAM] = index[L_OF_BEAM] if stop == length else -1
            kinds.append(_kind(element))
            pars.append(part + [0.0] * (5 - len(part)))
            slots.append(slot + [-1] * (5 - len(slot)))
            places.append((element.name, stop))
    feed, term, term_c = _terms(rig, places)
    ends = {(e.name, e.L.value) for e in rig.element if isinstance(e, Beam)}
    at_end = tuple(
        (i, places.index((sensor.on, sensor.position)), keys.index((sensor.on, "L")))
        for i, sensor in enumerate(rig.sensor)
        if isinstance(sensor, Acceleration) and (sensor.on, sensor.position) in ends
    )
    return CompiledChain(
        system=System(
            kinds=np.array(kinds, dtype=np.int64),
            pars=np.array(pars),
            ends=np.array([ENDS[rig.base], ENDS[rig.tip]], dtype=np.int64),
            source=np.array(source, dtype=np.int64).reshape(-1, 2),
            feed=feed,
            term=term,
            term_c=term_c,
        ),
        parameters=tuple(keys),
        slots=np.array(slots, dtype=np.int64),
        at_end=at_end,
        places=tuple(places),
    )
