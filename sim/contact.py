"""Forces of contact in the chain: dry friction of a guide, and play of a spring.

Both are f = min(max(gain y, -most), most) of one motion y, held over an inner step:

- Friction looks at the body's speed at the end of the step, gain = -1/(speed that 1 N makes of it
  in a step). So the force stops the body by then, or is as large as it can be (Moreau 1988).
- Play of a width b looks at the way x over the spring in the middle of the step, which the force
  itself moves by c a newton: f = k min(max(x + c f, -b/2), b/2), so gain = k/(1 - k c) and most =
  k b/2. It takes from the spring what it would give in the gap. A damper beside it acts there too.

The error of friction falls with the inner step: where one or two masses stick a tenth to a third of
the time, 0.4 to 0.6 % of the largest displacement with 8 steps a sample and 0.04 to 0.08 % with 64,
against an integration that is exact between two stops. That of play falls with its square.

The chain is linear beside it, so the force moves a plant of its own, as one more output would, and
every sensor reads the sum. A hidden sensor of the motion is what the force looks at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from samii_rig.model.realise import Realisation, realise
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Displacement,
    Element,
    Force,
    ForceSource,
    Moment,
    Parameter,
    RelativeAngle,
    Rig,
    Sensor,
    TorqueSource,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
    Velocity,
    parameters,
)
from samii_rig.rig.settings import wrong
from sim.base import UNRELATED
from sim.kernel import Contact, free
from sim.plant import Tables, tabulate
from sim.settings import SimSettings

HIDDEN = "contact_of_the_simulated_rig"  # the force's elements and input, and its motion
FRICTION, PLAY = "guide_friction", "play"
SLIDES = "mass"  # kind of the elements that a guide holds
BETWEEN = (TranslationalSpring, TorsionalSpring)
GROUND = (TranslationalGroundSpring, TorsionalGroundSpring)
TURNS = (TorsionalSpring, TorsionalGroundSpring)
# Of the acceleration F/m, what a force makes of a body that its source holds: 0 but for rounding,
# where a beam's end mass has 0.3 and more.
HELD = 1e-6
# k c, what a force that a spring of k gives moves that spring back in half a step: 0.01 is 31 steps
# in the period of the spring and what it moves. There the carriage was off by 0.1 to 0.3 % of its
# largest displacement, with 16 steps in the period by 1 %.
YIELDS = 0.01


@dataclass(frozen=True, slots=True)
class Asked:
    """The one force of contact: its law, a setting's name; where; and N of friction, or the width
    of the play in m or rad."""

    law: str
    at: str
    size: float


def check_contact(rig: Rig, settings: SimSettings) -> None:
    """InputError for friction on what does not slide, play of what is no spring, several of them,
    or one with several outputs."""
    asked = _asked(settings)
    for one in asked:
        where = _friction_at(rig) if one.law == FRICTION else _play_at(rig)
        if one.at not in where:
            kind = (
                f"a {SLIDES} of a chain that slides" if one.law == FRICTION else "a spring with k"
            )
            raise wrong(rig, one.law, one.at, f"{kind}: {', '.join(where) or 'it has none'}")
    said = ", ".join(one.at for one in asked)
    if len(asked) > 1:
        raise wrong(rig, asked[-1].law, said, "one body with friction, or one spring with play")
    for one in asked:
        if len(rig.actuator) > 1:
            raise wrong(rig, one.law, said, "none with several outputs")
        if one.law == FRICTION:
            _check_gives_way(rig, one)
        elif one.size > 0:
            _check_resolved(rig, one, settings)


def tables_of(rig: Rig, made: Realisation, settings: SimSettings) -> tuple[Tables, Contact]:
    """Tables of the one output of a rig, realised as `made`, and its force of contact, if it has
    one."""
    for one in _asked(settings):
        if one.size > 0:
            return _touched(rig, one, settings)
    tables = tabulate(rig, made, settings.inner)
    return tables, free(tables)


def _asked(settings: SimSettings) -> tuple[Asked, ...]:
    given = ((FRICTION, settings.guide_friction), (PLAY, settings.play))
    return tuple(Asked(law, at, size) for law, table in given for at, size in table.items())


def _friction_at(rig: Rig) -> list[str]:
    return [e.name for e in rig.element if e.kind == SLIDES]


def _play_at(rig: Rig) -> list[str]:
    return [e.name for e in rig.element if isinstance(e, (*BETWEEN, *GROUND)) and e.k.value > 0]


def _value(rig: Rig, at: str, symbol: str) -> float:
    return next(parameters(e)[symbol].value for e in rig.element if e.name == at)


def _check_gives_way(rig: Rig, one: Asked) -> None:
    s = np.array([1j * np.pi * rig.rate_hz])
    mobility = Chain(_widened(rig, one)).evaluate(s)[0, -1, -1]
    if abs(mobility * s[0] * _value(rig, one.at, "m")) < HELD:
        what = "a mass that gives way: friction does nothing where a source sets the motion"
        raise wrong(rig, FRICTION, one.at, what)


def _check_resolved(rig: Rig, one: Asked, settings: SimSettings) -> None:
    yields = _moved(_tables(rig, one, settings)[1]) * _value(rig, one.at, "k")
    if yields > YIELDS:
        needed = math.ceil(settings.inner * math.sqrt(yields / YIELDS))
        what = f"a softer spring, or inner = {needed}: it swings faster than inner steps show"
        raise wrong(rig, PLAY, one.at, what)


def _touched(rig: Rig, one: Asked, settings: SimSettings) -> tuple[Tables, Contact]:
    drive, push = _tables(rig, one, settings)
    m = len(rig.sensor)
    at_once = 0.0
    if one.law == FRICTION:
        at, most = 1.0, one.size
        gain = -1.0 / float((push.row[m] * (push.old + push.new)).sum())
    else:
        k = _value(rig, one.at, "k")
        at, most = 0.5, k * one.size / 2
        gain = k / (1.0 - k * _moved(push))
        at_once = k / (1.0 - k * float(push.row_extra[m]))
    look, of_old, of_new = _looked(drive, m, at)
    touch = Contact(
        most=most,
        gain=gain,
        look=look,
        of_old=of_old,
        of_new=of_new,
        own=_looked(push, m, at)[0],
        at_once=at_once,
        look_now=drive.row[m].copy(),
        own_now=push.row[m].copy(),
        of_now=float(drive.row_extra[m]),
        row=push.row[:m].copy(),
        row_extra=push.row_extra[:m].copy(),
        push=push.old + push.new,
        x=0.0 * push.old,
        held=np.zeros(1),
    )
    seen = drive._replace(
        row=drive.row[:m].copy(),
        row_old=drive.row_old[:m].copy(),
        row_new=drive.row_new[:m].copy(),
        row_extra=drive.row_extra[:m].copy(),
        ahead=drive.ahead[:m].copy(),
    )
    return seen, touch


def _looked(t: Tables, i: int, at: float) -> tuple[np.ndarray, float, float]:
    """Sensor i at the share `at` of its way over a step, 1 its end: from the states at its start,
    and from the inputs before and after the change."""
    row = t.row[i]
    a, b = t.decay
    ends = np.stack([a * row[0] + b * row[1], a * row[1] - b * row[0]])
    direct = t.row_extra[i]  # an input that is at the sensor at once, for its share of the step
    of_old = at * float((row * t.old).sum()) + t.mean * direct
    of_new = at * float((row * t.new).sum()) + (1.0 - t.mean) * direct
    return (1.0 - at) * row + at * ends, of_old, of_new


def _moved(push: Tables) -> float:
    """m or rad by which 1 N or N m moves its own place by the middle of a step."""
    return sum(_looked(push, push.row.shape[0] - 1, 0.5)[1:])


def _tables(rig: Rig, one: Asked, settings: SimSettings) -> tuple[Tables, Tables]:
    """Of the rig's output and of the force; the last sensor is the motion that it looks at."""
    made = _realised(rig.model_dump_json(exclude=UNRELATED), one, settings.band_hz)
    both = _widened(rig, one)
    drive, push = (tabulate(both, made, settings.inner, i) for i in range(2))
    return drive, push


@lru_cache(maxsize=4)
def _realised(rig_json: str, one: Asked, band_hz: float | None) -> Realisation:
    # Added to a rig that was checked: no rig file may have this output.
    return realise(_widened(Rig.model_validate_json(rig_json), one), band_hz)


def _widened(rig: Rig, one: Asked) -> Rig:
    """The rig with the force, a second output, and the motion that it looks at, a last sensor."""
    at = [e.name for e in rig.element].index(one.at)
    output = rig.actuator[0].model_copy(update={"name": HIDDEN, "delay": 0.0})
    element = rig.element[at]
    before = rig.element[at - 1].name if at else None
    turns = isinstance(element, TURNS)
    behind = _source(f"{HIDDEN}_behind", 1.0, turns=turns)
    two = isinstance(element, BETWEEN) and before is not None
    ahead = (_source(f"{HIDDEN}_before", -1.0, turns=turns),) if two else ()
    return rig.model_copy(
        update={
            "element": (
                *rig.element[:at],
                *ahead,
                element,
                behind,
                *rig.element[at + 1 :],
            ),
            "actuator": (*rig.actuator, output),
            "sensor": (
                *(_behind(s, one.at, behind.name) for s in rig.sensor),
                _motion(element, before),
            ),
        }
    )


def _motion(element: Element, before: str | None) -> Sensor:
    """What the force of an element looks at. before : the element before it."""
    name, at = HIDDEN, element.name
    match element:
        case TorsionalSpring():
            return RelativeAngle(kind="relative_angle", name=name, across=(at,), unit="rad")
        case TorsionalGroundSpring():
            return AbsoluteAngle(kind="absolute_angle", name=name, after=at, unit="rad")
        case TranslationalSpring():
            return Displacement(kind="displacement", name=name, after=at, against=before, unit="m")
        case TranslationalGroundSpring():
            return Displacement(kind="displacement", name=name, after=at, unit="m")
        case _:
            return Velocity(kind="velocity", name=name, after=at, unit="m/s")


def _source(name: str, K: float, *, turns: bool) -> TorqueSource | ForceSource:
    unit = "N m/V" if turns else "N/V"
    gain = Parameter(value=K, unit=unit, source="a force of 1 a unit")
    if turns:
        return TorqueSource(kind="torque_source", name=name, input=HIDDEN, K=gain)
    return ForceSource(kind="force_source", name=name, input=HIDDEN, K=gain)


def _behind(sensor: Sensor, at: str, source: str) -> Sensor:
    """A load cell behind the element reads all that it passes on, the force too."""
    if isinstance(sensor, Moment | Force) and sensor.after == at:
        return sensor.model_copy(update={"after": source})
    return sensor
