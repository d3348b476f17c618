"""The forces that a rig may hide, each with its range over the data at hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from samii_rig.diagnose.forces.laws import (
    CLIPPED,
    FRICTION,
    HARDENING,
    HYSTERESIS,
    ORIFICE,
    OVERLAP,
    PLAY,
    PRESLIDING,
    QUADRATIC,
    SLACK,
    SOFTENING,
    STOP_ABOVE,
    STOP_BELOW,
    STOPS,
    UNEVEN,
    Force,
    Law,
)
from samii_rig.diagnose.forces.paths import TransferPaths
from samii_rig.diagnose.forces.place import Place, parts
from samii_rig.diagnose.physics.effect import Effect, Unknown
from samii_rig.diagnose.physics.scales import spread
from samii_rig.rig.schema import (
    ANGLE_SOURCES,
    SOURCES,
    ActuatorSpec,
    Rig,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
    output_unit,
)

Spring = TorsionalSpring | TranslationalSpring | TorsionalGroundSpring | TranslationalGroundSpring

STRENGTH_STARTS = 14  # of a strength over its range
# Of a strength over the one that doubles or halves the motion at its place.
STRENGTH_RANGE = (1e-9, 30.0)
SOFTEST = 1.0  # the same of a stiffness that falls: beyond, a spring would push
PRESLID = (
    1e-4,
    1e-3,
    1e-2,
)  # way before dry friction slides over the largest motion, to begin with
HELD = 1e-9  # of the largest motion, one that is rounding
NEAREST = 1e-3  # of the largest motion, a way to a stop: nearer, it is a spring
HARDEST = 1e3  # stiffness of a stop over the one that halves the motion there: it moves no further
WIDTHS = (1e-6, 2.0)  # of a gap or limit over the largest amplitude that meets it
BEYOND = 3.0  # standard deviations of a meter's noise, which is beyond in 0.3 % of the samples
LEAST_LIMIT = 0.02  # of the largest command
WEAKEST_SUPPLY = 1e4  # of the largest moment: the loss of flow is 1e-4/2 of the flow


def forces(rig: Rig, paths: TransferPaths) -> Iterator[Effect]:
    """Every force that the table knows on this rig; ranges are those of the data."""
    order = [e.name for e in rig.element]
    kinds = {e.name: e for e in rig.element}
    for e in rig.element:
        slides = isinstance(e, TranslationalSpring | TranslationalGroundSpring)
        if isinstance(e, TorsionalGroundSpring | TranslationalGroundSpring):
            yield from _between(paths, Place("ground", (e.name,), slides), e)
        if isinstance(e, TranslationalSpring):
            yield from _between(paths, Place("joint", (e.name,), slides), e)
        if isinstance(e, TorsionalSpring):
            at = order.index(e.name)
            near: list[tuple[str, ...]] = [
                (order[i], e.name) if i < at else (e.name, order[i])
                for i in (at - 1, at + 1)
                if 0 <= i < len(order) and isinstance(kinds[order[i]], ANGLE_SOURCES)
            ]
            for across in ((e.name,), *near):
                yield from _between(paths, Place("joint", across), e)
    yield from _to_ground(rig, paths)
    for index in paths.whole.acting:
        actuator = rig.actuator[index]
        source = next(
            (e for e in rig.element if isinstance(e, SOURCES) and e.input == actuator.name), None
        )
        if source is None:
            continue
        # What a force cell showed is the force itself: no valve, no drive is left to bend it.
        if not actuator.held and actuator.unit == output_unit(source.kind):
            continue
        turns = isinstance(source, ANGLE_SOURCES)
        yield from _drive(paths, source.name, actuator, turns=turns)


def _between(paths: TransferPaths, place: Place, spring: Spring) -> Iterator[Effect]:
    """Forces between both sides of a joint, of its spring alone or of spring and source; or between
    a part and the ground."""
    name, (of_force, of_way) = spring.name, place.units
    other = next((n for n in place.across if n != name), "")
    rubbing = list(_rubbing(paths, place, name, other))
    yield from (*rubbing, *_stops(paths, place, name, other))
    moved = paths.ports(place, of_speed=False)
    if other or moved is None or not rubbing:
        return
    # The sine in c2 |speed| speed is two thirds of that in friction of T_c = c2 speed^2.
    speed = _largest(paths, place, of_speed=True)
    c2 = 3 / 2 * _stopping(paths, place) / speed**2
    unknown = _log(
        "c2", f"{of_force} s^2/{of_way}^2", STRENGTH_RANGE[0] * c2, STRENGTH_RANGE[1] * c2
    )
    yield effect(QUADRATIC, place, name, "", (unknown,))
    top = _largest(paths, place, of_speed=False)
    doubles = 1 / float(np.median(moved.y1))  # force a way
    k3 = 4 / 3 * doubles / top**2
    for law, most in ((HARDENING, STRENGTH_RANGE[1]), (SOFTENING, SOFTEST)):
        unknown = _log("k3", f"{of_force}/{of_way}^3", STRENGTH_RANGE[0] * k3, most * k3)
        yield effect(law, place, name, "", (unknown,))
    if spring.k.value > 0:
        width = _log("width", of_way, WIDTHS[0] * top, WIDTHS[1] * top)
        yield effect(PLAY, place, name, "", (width,), name)
        if spring.c.value > 0:
            yield effect(SLACK, place, name, "", (width,), name)
    T_y = _log(
        "T_y", of_force, STRENGTH_RANGE[0] * doubles * top, STRENGTH_RANGE[1] * doubles * top
    )
    k = _log("k", f"{of_force}/{of_way}", STRENGTH_RANGE[0] * doubles, STRENGTH_RANGE[1] * doubles)
    yield effect(HYSTERESIS, place, name, "", (T_y, k))


def _to_ground(rig: Rig, paths: TransferPaths) -> Iterator[Effect]:
    """Forces between a body and the ground: across, or about it where nothing shifts."""
    bodies = list(parts(rig))
    springs = [
        Place("joint", (e.name,), isinstance(e, TranslationalSpring))
        for e in rig.element
        if isinstance(e, TorsionalSpring | TranslationalSpring)
    ]
    ways = {
        on: [_largest(paths, b.to_ground(slides=on), of_speed=False) for b in bodies]
        for on in (True, False)
    }
    top = max((way for each in ways.values() for way in each), default=0.0)  # m, or rad
    slides = any(way > HELD * top for way in ways[True])
    for body, way in zip(bodies, ways[slides], strict=True):
        place = body.to_ground(slides=slides)
        if way <= HELD * top or body.held[not slides]:
            continue
        if any(paths.alike(place, spring) for spring in springs):  # one that stands on the ground
            continue
        for e in (*_rubbing(paths, place, body.site, ""), *_stops(paths, place, body.site)):
            aliases = tuple((e.physics, other) for other in body.others)
            yield replace(e, aliases=aliases, position=body.position)


def _rubbing(paths: TransferPaths, place: Place, site: str, other: str) -> Iterator[Effect]:
    force = _stopping(paths, place)
    if force <= 0:
        return
    T_c = _log("T_c", place.units[0], STRENGTH_RANGE[0] * force, STRENGTH_RANGE[1] * force)
    yield effect(FRICTION, place, site, other, (T_c,))


def _stopping(paths: TransferPaths, place: Place) -> float:
    """Dry friction that would halve the speed at a place; 0 where nothing moves."""
    speed, ports = _largest(paths, place, of_speed=True), paths.ports(place, of_speed=True)
    return 0.0 if ports is None else np.pi / 4 * speed / float(np.median(ports.y1))


def _stops(paths: TransferPaths, place: Place, site: str, other: str = "") -> Iterator[Effect]:
    top, moved = _largest(paths, place, of_speed=False), paths.ports(place, of_speed=False)
    if top <= 0 or moved is None:
        return
    of_force, of_way = place.units
    doubles = 1 / float(np.median(moved.y1))
    gap = _log("gap", of_way, NEAREST * top, WIDTHS[1] * top)
    k = _log("k", f"{of_force}/{of_way}", STRENGTH_RANGE[0] * doubles, HARDEST * doubles)
    for law in (STOPS, STOP_ABOVE, STOP_BELOW):
        yield effect(law, place, site, other, (gap, k))


def _drive(
    paths: TransferPaths, source: str, actuator: ActuatorSpec, *, turns: bool
) -> Iterator[Effect]:
    """Forces on the command. turns : whether the source gives an angle."""
    alias, unit, across = actuator.name, actuator.unit, (source,)
    drive, flow = Place("drive", across), Place("flow", across)
    largest = paths.largest(drive)
    # What is narrower than a step of the command's converter is that converter's rounding; what is
    # as narrow as the noise of a meter takes that out where the command rests.
    noise = BEYOND * paths.meter_noise(drive, actuator.resolution)
    at_rest = noise if paths.rests(drive, noise) else 0.0
    low, high = max(WIDTHS[0] * largest, actuator.resolution, at_rest), WIDTHS[1] * largest
    wide = low < high
    if wide and turns and paths.ports(drive, of_speed=True) is not None:
        yield effect(FRICTION, drive, source, alias, (_log("T_c", unit, low, high),))
    top = _largest(paths, flow, of_speed=False) if turns else 0.0
    if top > 0:
        yield effect(ORIFICE, flow, source, alias, (_log("T_s", "N m", top, WEAKEST_SUPPLY * top),))
    on_command = Place("command", across)
    if wide:
        yield effect(OVERLAP, on_command, source, alias, (_log("width", unit, low, high),))
    # So is what clips the noise on top of the largest command, which has as much on either side; a
    # limit as far below that again still took more noise from tops than it bent them.
    top, least = largest - 4 * noise, LEAST_LIMIT * largest
    if top > least:
        yield effect(CLIPPED, on_command, source, alias, (_log("limit", unit, least, top),))


def uneven(even: Effect) -> Effect:
    """Dry friction that may differ by direction in the place of one that does not."""
    assert even.force is not None
    (T_c,) = even.unknowns
    unknowns = tuple(_log(symbol, T_c.unit, T_c.low, T_c.high) for symbol in UNEVEN.symbols)
    return _in_place_of(even, UNEVEN, unknowns)


def _in_place_of(old: Effect, law: Law, unknowns: tuple[Unknown, ...]) -> Effect:
    """Another law where a force is, by all names of that place."""
    assert old.force is not None
    aliases = tuple((law.physics, site) for _, site in old.aliases)
    made = effect(law, old.force.place, old.site, "", unknowns)
    return replace(made, aliases=aliases, position=old.position)


def presliding(even: Effect, paths: TransferPaths) -> Effect | None:
    """Dry friction with presliding in the place of one without, or of what sticks and slips by
    another law; None where it has no place to give."""
    assert even.force is not None
    place = even.force.place
    ports = paths.ports(place, of_speed=False)
    if place.kind not in PRESLIDING.kinds or ports is None:
        return None
    T_c = even.unknowns[0]
    of_force, of_way = place.units
    doubles = 1 / float(np.median(ports.y1))
    # So that what is as strong as what moves there slides after the least way that is tried.
    stiff = T_c.high / STRENGTH_RANGE[1] / (PRESLID[0] * _largest(paths, place, of_speed=False))
    high = max(STRENGTH_RANGE[1] * doubles, stiff)
    k = _log("k", f"{of_force}/{of_way}", STRENGTH_RANGE[0] * doubles, high)
    unknowns = (_log(PRESLIDING.symbols[0], T_c.unit, T_c.low, T_c.high), k)
    return _in_place_of(even, PRESLIDING, unknowns)


def _largest(paths: TransferPaths, place: Place, *, of_speed: bool) -> float:
    return max(
        (float(np.max(np.abs(y))) for y in paths.motion(place, of_speed=of_speed)), default=0
    )


def _log(symbol: str, unit: str, low: float, high: float) -> Unknown:
    return Unknown(symbol, unit, low, high, spread(low, high, STRENGTH_STARTS))


def effect(
    law: Law,
    place: Place,
    site: str,
    alias: str,
    unknowns: tuple[Unknown, ...],
    part: str = "",
) -> Effect:
    """A force as a hypothesis. alias : another name of its site. part : as of `Force`."""
    softens = law is SOFTENING
    return Effect(
        physics=law.physics,
        site=site,
        unknowns=unknowns,
        force=Force(place, law, part),
        aliases=((law.physics, alias),) if alias else (),
        rough=0.0 if place.kind == "command" else law.rough,
        variant=f"{law.tag} {place.name}",
        report=(lambda x: -x) if softens else (lambda x: x),
    )
