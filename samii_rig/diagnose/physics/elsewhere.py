"""A sensor at another place than the rig file says, along a beam."""

from __future__ import annotations

from collections.abc import Iterator

from samii_rig.diagnose.physics import along as along_
from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.along import AT_A_POINT, BODIES, Along, stretches
from samii_rig.diagnose.physics.effect import Effect, Key, Values
from samii_rig.rig.schema import (
    BEAMS,
    Acceleration,
    Displacement,
    Element,
    LumpedMass,
    Rig,
    parameters,
)
from samii_rig.types import Float

Placed = Acceleration | Displacement
STARTS = (0.15, 0.4, 0.6, 0.85)  # parts of the way along a stretch, between a beam's modes


def effects(rig: Rig) -> Iterator[Effect]:
    """Each accelerometer and displacement sensor, along the beam that it is on or at an end of."""
    for sensor in rig.sensor:
        if isinstance(sensor, Displacement) and sensor.against is not None:
            continue
        if isinstance(sensor, Placed):
            rest = _without(rig, sensor)
            for beam in _beams(rig, sensor):
                for stretch in stretches(rest, beam):
                    yield _moved(sensor, beam, stretch)


def _beams(rig: Rig, sensor: Placed) -> Iterator[Element]:
    """The beam that a sensor is on; those that end where it is, if it is at an end."""
    order = list(rig.element)
    at = next(i for i, e in enumerate(order) if e.name == _place(sensor))
    here = order[at]
    if isinstance(sensor, Acceleration) and isinstance(here, BODIES):
        yield from (here,) if isinstance(here, BEAMS) else ()  # along a link it has no end
        return
    upstream = [e for e in order[: at + 1] if not isinstance(e, AT_A_POINT)]
    yield from (e for e in upstream[-1:] if isinstance(e, BEAMS))
    downstream = [e for e in order[at + 1 :] if not isinstance(e, AT_A_POINT)]
    yield from (e for e in downstream[:1] if isinstance(e, BEAMS))


def _place(sensor: Placed) -> str:
    return sensor.on if isinstance(sensor, Acceleration) else sensor.after


def _without(rig: Rig, sensor: Placed) -> Rig:
    rest = tuple(s for s in rig.sensor if s.name != sensor.name)
    return rig.model_copy(update={"sensor": rest})


def _moved(sensor: Placed, beam: Element, stretch: Along) -> Effect:
    """It anywhere along a stretch: on a part with no mass, where the beam is cut."""
    name = f"{insert.PREFIX}place_of_{sensor.name}"
    part = LumpedMass(kind="lumped_mass", name=name, m=insert.parameter(0.0, "kg"))

    def build(r: Rig) -> Rig:
        own = next(s for s in r.sensor if s.name == sensor.name)
        there = (
            {"on": part.name, "position": 0.0}
            if isinstance(own, Acceleration)
            else {"after": part.name}
        )
        cut = along_.cut(_without(r, sensor), stretch, part)
        at = [s.name for s in r.sensor].index(sensor.name)
        sensors = (*cut.sensor[:at], own.model_copy(update=there), *cut.sensor[at:])
        return cut.model_copy(update={"sensor": sensors})

    def placed(x: Float, nominal: Values) -> dict[Key, float]:
        return stretch.of_pieces(float(x[0]), nominal, [*parameters(beam)])

    def write(r: Rig, x: Float) -> Rig:
        if isinstance(sensor, Displacement):
            return r  # it stands behind an element
        at = {"on": beam.name, "position": stretch.position(float(x[0]))}
        return insert.sensor_changed(along_.joined(r, stretch, part.name), sensor.name, **at)

    return Effect(
        physics="sensor_position",
        site=sensor.name,
        unknowns=(stretch.unknown(STARTS),),
        build=build,
        parameters=placed,
        touches=tuple((beam.name, s) for s in parameters(beam)),
        report=lambda x: x * 0 + stretch.position(float(x[0])),
        write=write,
        weight=stretch.share,
        variant=stretch.place(),
        pieces=stretch.pieces,
    )
