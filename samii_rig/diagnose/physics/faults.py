"""Faults of measurement, as hypotheses: no unknown, no physics, distinguished from it.

One table. Each row is a factor on a column that is exactly known, or a sensor that is another. They
compete with physics in the same search, at the price of what has no unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.channels import METERED
from samii_rig.diagnose.physics.confusions import UNITS
from samii_rig.diagnose.physics.effect import Effect, Factor
from samii_rig.diagnose.physics.unheld import not_held
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    Displacement,
    RelativeAngle,
    Rig,
    Sensor,
    Velocity,
)
from samii_rig.types import Complex, Float

SHIFTED = "columns_shifted"  # of an input against the sensors, by a logger
MOST_SHIFTED = 5  # samples, by which a logger's columns are apart; as `signal.columns` looks for
MEASURED = 0.3  # of loggers that shift columns, those that measure the command
ORDERS = ("a displacement", "a velocity", "an acceleration")
# How often that was derived which a sensor measures.
ORDER = {AbsoluteAngle: 0, RelativeAngle: 0, Displacement: 0, Velocity: 1, Acceleration: 2}


@dataclass(frozen=True, slots=True)
class Fault:
    """A column that is F(s) times what it is said to be. description : in words, behind its
    name. rough : part of what it does by which F is off, 0 where that is exactly known."""

    physics: str
    description: str
    factor: Callable[[Complex], Complex]
    weight: float = 1.0
    rough: float = 0.0


def scaled(s: Complex, by: float) -> Complex:
    """A factor that all frequencies share."""
    return np.full(s.shape, by, complex)


def behind(s: Complex, seconds: float) -> Complex:
    """exp(-s t)."""
    return np.exp(-s * seconds)


def derived(s: Complex, times: int) -> Complex:
    """s^n; what was integrated says nothing at s = 0."""
    return np.where(s == 0, 0.0, np.where(s == 0, 1.0, s) ** float(times))


def effects(rig: Rig, recorded_hz: float) -> Iterator[Effect]:
    """Every fault that this rig's columns allow, of so many rows a second."""
    for actuator in rig.actuator:
        shifts = list(_shifts(SHIFTED, recorded_hz))
        # What the rig file states as measured is so with every fault.
        both = _measured_too(shifts, rig.rate_hz) if actuator.held else ()
        for m in (*_of_any(), *shifts, *both):
            yield _on("input", actuator.name, m)
    for sensor in rig.sensor:
        rows = [*_of_any(), *_of_kind(sensor)]
        if len(rig.sensor) > 1:
            rows += _shifts("column_shifted", recorded_hz)
        for m in rows:
            yield _on("sensor", sensor.name, m)
        yield from _angles(rig, sensor)
    for a, b in combinations([s.name for s in rig.sensor], 2):
        yield Effect(
            physics="channel_swap",
            site=a,
            build=partial(insert.exchanged, a=a, b=b),
            aliases=(("channel_swap", b),),
            weight=0.3,
            variant=b,
        )


def _of_any() -> Iterator[Fault]:
    """Of a column of any kind."""
    yield Fault("sign_error", "has the wrong sign", partial(scaled, by=-1.0))
    for unit in UNITS:
        for by in (unit.factor, 1 / unit.factor):
            description = f"is {by:.4g} times what it should be: {unit.name}"
            yield Fault("unit_error", description, partial(scaled, by=by), 1 / (2 * len(UNITS)))


def _shifts(physics: str, rate_hz: float) -> Iterator[Fault]:
    """Of a logger: a dead time is no whole number of samples but by chance."""
    for n in (n for n in range(-MOST_SHIFTED, MOST_SHIFTED + 1) if n != 0):
        many = f"{abs(n)} sample{'s' * (abs(n) > 1)} {'later' if n > 0 else 'earlier'}"
        description = f"stands {many} than the other columns: a logger's, or a delay of as much"
        if physics == SHIFTED:
            who = "a logger's shift"
            if n > 0:
                who += ", or a dead time of as much: [centring] of the rig file would tell which"
            description = f"is in another row than what it moved: the sensors' stand {many} ({who})"
        law = partial(behind, seconds=n / rate_hz)
        yield Fault(physics, description, law, 1 / (2 * MOST_SHIFTED))


def _measured_too(shifts: Iterable[Fault], rate_hz: float) -> Iterator[Fault]:
    """Each of them where what stands apart was measured, not sent: both at once look like one dead
    time or lag, and explain none of it alone."""

    def both(s: Complex, factor: Callable[[Complex], Complex]) -> Complex:
        return factor(s) * not_held(s, np.zeros(0), rate_hz)[0]

    for m in shifts:
        description = f"was measured, not held, and {m.description}"
        law, weight = partial(both, factor=m.factor), MEASURED * m.weight
        yield Fault(m.physics, description, law, weight, METERED)


def _of_kind(sensor: Sensor) -> Iterator[Fault]:
    """Of a sensor that measures another derivative of the same motion."""
    own = ORDER.get(type(sensor))
    for order, kind in enumerate(ORDERS):
        if own is not None and order != own:
            description = f"reads as {kind}, not as {ORDERS[own]}"
            if not isinstance(sensor, Displacement | Velocity | Acceleration):
                description = f"reads as {kind} of the angle, not as the angle"
            yield Fault("kind_error", description, partial(derived, times=order - own), 0.5)


def _on(kind: Any, name: str, m: Fault) -> Effect:
    def value(s: Complex, _: Float) -> tuple[Complex, list[Complex]]:
        return m.factor(s), []

    factor = Factor(kind, name, value)
    return Effect(
        m.physics, name, factor=factor, weight=m.weight, variant=m.description, rough=m.rough
    )


def _angles(rig: Rig, sensor: Sensor) -> Iterator[Effect]:
    """An angle against the ground for one across parts, and the other way round."""
    made: Sensor | None = None
    fields = {k: getattr(sensor, k) for k in sensor.model_fields_set - {"kind", "across", "after"}}
    if isinstance(sensor, RelativeAngle):
        made = AbsoluteAngle(kind="absolute_angle", after=sensor.across[-1], **fields)
        description = f"reads as an angle against the ground, not as one across {sensor.across[0]}"
    elif isinstance(sensor, AbsoluteAngle):
        order = [e.name for e in rig.element]
        acting = [e.name for e in rig.element if getattr(e, "input", None)]
        span = order[: order.index(sensor.after) + 1] if sensor.after in order else []
        starts = [order.index(name) for name in acting if name in span]
        if starts and starts[-1] > 0:
            across = tuple(span[starts[-1] :])
            made = RelativeAngle(kind="relative_angle", across=across, **fields)
            description = f"reads as an angle across {across[0]}, not as one against the ground"
    if made is not None:
        build = partial(insert.replaced, sensor=made)
        yield Effect("kind_error", sensor.name, build=build, weight=0.5, variant=description)
