"""Effects of channels: the input's chain, each sensor's, and what is not physics at all."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.effect import Effect, Factor, Key, Unknown, Values
from samii_rig.diagnose.physics.reduced import FASTER, faster_than, slower_than
from samii_rig.diagnose.physics.rows import EVERY_SENSOR, PHYSICS
from samii_rig.diagnose.physics.scales import SMALLEST
from samii_rig.diagnose.physics.unheld import measured
from samii_rig.rig.schema import (
    ANGLE_SOURCES,
    SOURCES,
    Acceleration,
    AngularVelocitySource,
    RelativeAngle,
    Rig,
    SensorBase,
    TorsionalSpring,
)
from samii_rig.types import Complex, Float

Law = Callable[[Complex, Float], tuple[Complex, list[Complex]]]

# Not physics: wiring, units and signs. They compete with physics and are reported separately.
# Of a period at the top of the band, a delay that no bench shows; a lag of as much looks the same.
INVISIBLE = 1e-6
# Part of what it makes of a command's edges by which a meter is not as `not_held`: one of a plant
# of ours was by 0.8 % of a sample late.
METERED = 0.01
NOT_PHYSICS = tuple(row.name for row in PHYSICS.values() if not row.physical)


def dead_time(s: Complex, x: Float) -> tuple[Complex, list[Complex]]:
    """exp(-s tau)."""
    F = np.exp(-s * x[0])
    return F, [-s * F]


def lead(s: Complex, x: Float) -> tuple[Complex, list[Complex]]:
    """exp(s tau): read before the other channels, which no physics does."""
    F = np.exp(s * x[0])
    return F, [s * F]


def lag(s: Complex, x: Float) -> tuple[Complex, list[Complex]]:
    """p/(s + p)."""
    F = x[0] / (s + x[0])
    return F, [s / (s + x[0]) ** 2]


def other_lag(s: Complex, x: Float, p: float) -> tuple[Complex, list[Complex]]:
    """r (s + p)/(s + r p): a lag of corner p rad/s that has r times that, or is none."""
    r = x[0]
    return r * (s + p) / (s + r * p), [s * (s + p) / (s + r * p) ** 2]


def lower(s: Complex, x: Float, w: float) -> tuple[Complex, list[Complex]]:
    """(s + w)/(s + r w): a high-pass of corner w rad/s that has r times that, or is none."""
    return (s + w) / (s + x[0] * w), [-w * (s + w) / (s + x[0] * w) ** 2]


def highpass(s: Complex, x: Float) -> tuple[Complex, list[Complex]]:
    """s/(s + 2 pi corner)."""
    w = 2 * math.pi * x[0]
    return s / (s + w), [-2 * math.pi * s / (s + w) ** 2]


def gain(s: Complex, x: Float) -> tuple[Complex, list[Complex]]:
    """A constant."""
    return np.full(s.shape, x[0], complex), [np.ones(s.shape, complex)]


def second_order(s: Complex, x: Float) -> tuple[Complex, list[Complex]]:
    """omega^2/(s^2 + 2 zeta omega s + omega^2)."""
    w, z = x
    D = s**2 + 2 * z * w * s + w**2
    return w**2 / D, [2 * w / D - w**2 * (2 * z * s + 2 * w) / D**2, -2 * w**3 * s / D**2]


def effects(rig: Rig, low_hz: float, high_hz: float) -> Iterator[Effect]:
    """All effects of the rig's channels."""
    for actuator in rig.actuator:
        yield from _input(rig, actuator.name, low_hz, high_hz)
    for sensor in rig.sensor:
        yield from _sensor(sensor, low_hz, high_hz)
        yield from _less(sensor)
        if isinstance(sensor, Acceleration) and sensor.tilt == 0:
            yield from _tilted(sensor.name)
        if isinstance(sensor, RelativeAngle):
            yield from _encoders(rig, sensor)
    yield from _coupled(rig, low_hz)


def _unknown(symbol: str, unit: str, low: float, high: float, n: int = 8) -> Unknown:
    starts = tuple(float(x) for x in np.geomspace(low, high, n + 2)[1:-1])
    return Unknown(symbol, unit, low, high, starts)


def _gains() -> Unknown:
    """A gain, also one so near 1 that only its derivative shows it."""
    unknown = _unknown("gain", "1", 1e-4, 1e4, 16)
    return Unknown("gain", "1", unknown.low, unknown.high, (*unknown.starts, 1.0), ratio=True)


def _corners(symbol: str, low_hz: float, high_hz: float) -> Unknown:
    """A corner in rad/s, from far below the band to where it is invisible."""
    w = 2 * math.pi * math.sqrt(low_hz * high_hz)
    return _unknown(symbol, "rad/s", w / 30, high_hz / INVISIBLE)


def _times(high_hz: float) -> Unknown:
    return _unknown("tau", "s", INVISIBLE / high_hz, 2 / high_hz)


def _input(rig: Rig, name: str, low_hz: float, high_hz: float) -> Iterator[Effect]:
    """Effects in the path of one actuator's input; their site is the source that it drives."""
    source = next((e for e in rig.element if isinstance(e, SOURCES) and e.input == name), None)
    place = source.name if source else name

    def known(
        physics: str,
        law: Law,
        unknowns: tuple[Unknown, ...],
        write: Callable[[Rig, Float], Rig] = lambda rig, _x: rig,
    ) -> Effect:
        return Effect(
            physics=physics,
            site=place,
            unknowns=unknowns,
            factor=Factor("input", name, law),
            write=write,
            aliases=((physics, name),) if source else (),
        )

    def later(rig: Rig, x: Float) -> Rig:
        return insert.actuator_changed(rig, name, lambda a: {"delay": a.delay + float(x[0])})

    def slower(rig: Rig, x: Float) -> Rig:
        """Two lags in a row are one of second order."""
        e = next(e for e in rig.element if e.name == place)
        if not isinstance(e, AngularVelocitySource):
            return rig
        p, more = e.p.value, float(x[0])
        omega = math.sqrt(p * more)
        return insert.second_order(rig, place, omega, (p + more) / (2 * omega))

    def of_second_order(x: Float, _: Values) -> dict[Key, float]:
        return {(place, "omega"): float(x[0]), (place, "zeta"): float(x[1])}

    omega = _corners("omega", low_hz, high_hz)
    zeta = Unknown("zeta", "1", 0.05, 3.0, (0.2, 0.7))
    yield known("transport_delay", dead_time, (_times(high_hz),), later)
    yield known("actuator_lag", lag, (_corners("p", low_hz, high_hz),), slower)
    yield known("valve_dynamics", second_order, (omega, zeta))
    if isinstance(source, AngularVelocitySource):
        yield Effect(
            physics="valve_dynamics",
            site=place,
            unknowns=(omega, zeta),
            build=partial(insert.second_order, source=place),
            parameters=of_second_order,
            aliases=(("valve_dynamics", name),),
            variant="instead of the lag",
        )
    yield Effect(
        physics="common_gain",
        site=name,
        unknowns=(_gains(),),
        factor=Factor("input", name, gain),
    )
    yield _as_recorded(rig, name)


def is_stated(effect: Effect, rig: Rig) -> bool:
    """Whether the rig file says of an input what the effect does."""
    said = {a.name: "input_held" if a.held else "input_not_held" for a in rig.actuator}
    return effect.physics == said.get(effect.site)


def _as_recorded(rig: Rig, name: str) -> Effect:
    """That the recorded input is not what the rig file states: measured in the place of held, or
    held in the place of measured."""
    if next(a.held for a in rig.actuator if a.name == name):
        return Effect(
            physics="input_not_held",
            site=name,
            factor=measured(rig, name),
            write=lambda rig, _x: insert.actuator_changed(rig, name, lambda _: {"held": False}),
            rough=METERED,
        )
    held = partial(insert.actuator_changed, name=name, change=lambda _: {"held": True})
    return Effect(physics="input_held", site=name, build=held)


Update = Callable[[float], dict[str, object]]


def _on(name: str, physics: str, law: Law, unknown: Unknown, update: Update) -> Effect:
    """A factor on a sensor, and what the rig file says of it."""

    def write(rig: Rig, x: Float) -> Rig:
        return insert.sensor_changed(rig, name, **update(float(x[0])))

    return Effect(
        physics=physics,
        site=name,
        unknowns=(unknown,),
        factor=Factor("sensor", name, law),
        write=write,
    )


def _sensor(sensor: SensorBase, low_hz: float, high_hz: float) -> Iterator[Effect]:
    def one(physics: str, law: Law, unknown: Unknown, update: Update) -> Effect:
        return _on(sensor.name, physics, law, unknown, update)

    delay, times = sensor.delay, _times(high_hz)
    yield one("sensor_delay", dead_time, times, lambda tau: {"delay": delay + tau})
    yield one("sensor_lag", lag, _corners("p", low_hz, high_hz), lambda p: {"lag": 1 / p})
    yield one("sensor_gain", gain, _gains(), lambda g: {"gain": g * sensor.gain})
    yield one("sensor_highpass", highpass, _highpass_corner(low_hz), lambda f: {"highpass_hz": f})
    if delay < times.high:  # earlier by less, the delay of the file is not there
        early = _unknown("tau", "s", max(times.low, delay), times.high)
        yield Effect(
            physics="time_offset",
            site=sensor.name,
            unknowns=(early,),
            factor=Factor("sensor", sensor.name, lead),
        )


def _highpass_corner(low_hz: float) -> Unknown:
    return _unknown("corner", "Hz", 1e-4 * low_hz, 10 * low_hz)


def _coupled(rig: Rig, low_hz: float) -> Iterator[Effect]:
    """One high-pass in all sensors, as of one amplifier or a logger whose channels are AC coupled:
    the same as one before the only input, where no loop reads any of them."""
    loops = rig.centred or rig.feedback
    if len(rig.sensor) < 2 or len(rig.actuator) > 1 or loops:
        return
    if any(s.highpass_hz > 0 for s in rig.sensor):
        return

    def write(rig: Rig, x: Float) -> Rig:
        for s in rig.sensor:
            rig = insert.sensor_changed(rig, s.name, highpass_hz=float(x[0]))
        return rig

    yield Effect(
        physics="sensor_highpass",
        site=EVERY_SENSOR,
        unknowns=(_highpass_corner(low_hz),),
        factor=Factor("input", rig.actuator[0].name, highpass),
        write=write,
    )


def _less(sensor: SensorBase) -> Iterator[Effect]:
    """A delay, lag or high-pass of the rig file that a sensor does not have, or has less of; and a
    lag that is longer: one more in series would be another."""

    def one(physics: str, law: Law, unknown: Unknown, update: Update) -> Effect:
        return replace(_on(sensor.name, physics, law, unknown, update), variant="less")

    if sensor.delay > 0:
        gone = replace(_unknown("tau", "s", SMALLEST * sensor.delay, sensor.delay), ends=True)
        less = one("sensor_delay", lead, gone, lambda tau: {"delay": sensor.delay - tau})
        yield replace(less, report=lambda x: -x)
    if sensor.lag > 0:
        law = partial(other_lag, p=1 / sensor.lag)
        shorter, longer = faster_than(1 + SMALLEST), slower_than(1 - SMALLEST)
        yield one("sensor_lag", law, shorter, lambda r: {"lag": sensor.lag / r})
        more = one("sensor_lag", law, longer, lambda r: {"lag": sensor.lag / r})
        yield replace(more, variant="more")
    if sensor.highpass_hz > 0:
        ratio = _unknown("corner ratio", "1", 1 / FASTER, 1 - SMALLEST)
        law = partial(lower, w=2 * math.pi * sensor.highpass_hz)
        yield one("sensor_highpass", law, ratio, lambda r: {"highpass_hz": r * sensor.highpass_hz})


def _tilted(name: str) -> Iterator[Effect]:
    for sign in (1.0, -1.0):
        yield Effect(
            physics="gravity_cross_sensitivity",
            site=name,
            build=partial(insert.sensor_changed, name=name, tilt=sign),
            weight=0.5,
            variant=f"{sign:+g}",
        )


def _encoders(rig: Rig, sensor: RelativeAngle) -> Iterator[Effect]:
    """The encoder across other neighbours of the same source and springs."""
    order = [e.name for e in rig.element]
    lengthless = [isinstance(e, (TorsionalSpring, *ANGLE_SOURCES)) for e in rig.element]
    first, last = order.index(sensor.across[0]), order.index(sensor.across[-1])
    low, high = first, last
    while low > 0 and lengthless[low - 1]:
        low -= 1
    while high + 1 < len(order) and lengthless[high + 1]:
        high += 1
    spans = [
        tuple(order[i : j + 1])
        for i in range(low, high + 1)
        for j in range(i, high + 1)
        if any(isinstance(rig.element[k], ANGLE_SOURCES) for k in range(i, j + 1))
    ]
    for span in spans:
        if span == sensor.across:
            continue
        yield Effect(
            physics="noncollocated_encoder",
            site=sensor.name,
            build=partial(insert.measured_across, name=sensor.name, span=span),
            weight=1 / max(1, len(spans) - 1),
            variant=" ".join(span),
        )
