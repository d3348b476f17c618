"""Dry friction of a guide: a force on a body that slides, which stops it or opposes its speed.

Its error falls with the inner step: where one or two masses stick a tenth to a third of the time,
0.4 to 0.6 % of the largest displacement with 8 steps a sample and 0.04 to 0.08 % with 64, against
an integration that is exact between two stops.

The chain is linear beside it, so the force moves a plant of its own, as one more output would, and
every sensor reads the sum. A hidden velocity of the body is what the force looks at.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from samii_rig.model.realise import Realisation, realise
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import ForceSource, Parameter, Rig, Velocity, parameters
from samii_rig.rig.settings import wrong
from sim.base import UNRELATED
from sim.kernel import Guide, free
from sim.plant import Tables, tabulate
from sim.settings import SimSettings

HIDDEN = "guide_of_the_simulated_rig"  # the force's element and input, and the body's velocity
SETTING = "guide_friction"
SLIDES = "mass"  # kind of the elements that a guide holds
# Of the acceleration F/m, what a force makes of a body that its source holds: 0 but for rounding,
# where a beam's end mass has 0.3 and more.
HELD = 1e-6


def check_guide(rig: Rig, settings: SimSettings) -> None:
    """InputError for friction on what does not slide, on two bodies, or with several outputs."""
    rubs = settings.guide_friction
    bodies = [e.name for e in rig.element if e.kind == SLIDES]
    for name in rubs:
        if name not in bodies:
            what = f"a {SLIDES} of a chain that slides: {', '.join(bodies) or 'it has none'}"
            raise wrong(rig, SETTING, name, what)
    if len(rubs) > 1:
        raise wrong(rig, SETTING, ", ".join(rubs), "one body with friction")
    if rubs and len(rig.actuator) > 1:
        raise wrong(rig, SETTING, ", ".join(rubs), "none with several outputs")
    for name in rubs:
        s = np.array([1j * np.pi * rig.rate_hz])
        mobility = Chain(_with_force(rig, name)).evaluate(s)[0, -1, -1]
        mass = next(parameters(e)["m"].value for e in rig.element if e.name == name)
        if abs(mobility * s[0] * mass) < HELD:
            what = "a mass that gives way: friction does nothing where a source sets the motion"
            raise wrong(rig, SETTING, name, what)


def tables_of(rig: Rig, made: Realisation, settings: SimSettings) -> tuple[Tables, Guide]:
    """Tables of the one output of a rig, realised as `made`, and its guide, with friction or
    without."""
    if any(settings.guide_friction.values()):
        return _guided(rig, settings)
    tables = tabulate(rig, made, settings.inner)
    return tables, free(tables)


def _guided(rig: Rig, settings: SimSettings) -> tuple[Tables, Guide]:
    ((body, force),) = settings.guide_friction.items()
    made = _realised(rig.model_dump_json(exclude=UNRELATED), body, settings.band_hz)
    both = _with_force(rig, body)
    drive, push = (tabulate(both, made, settings.inner, i) for i in range(2))
    m = len(rig.sensor)
    step, own = push.old + push.new, push.row[m]
    guide = Guide(
        force=force,
        row=push.row[:m].copy(),
        row_extra=push.row_extra[:m].copy(),
        push=step,
        speed=drive.row[m].copy(),
        own=own.copy(),
        gain=float((own * step).sum()),
        x=0.0 * step,
        held=0.0 * push.row_extra[:1],
    )
    seen = drive._replace(
        row=drive.row[:m].copy(),
        row_old=drive.row_old[:m].copy(),
        row_new=drive.row_new[:m].copy(),
        row_extra=drive.row_extra[:m].copy(),
        ahead=drive.ahead[:m].copy(),
    )
    return seen, guide


@lru_cache(maxsize=4)
def _realised(rig_json: str, body: str, band_hz: float | None) -> Realisation:
    # Added to a rig that was checked: no rig file may have this output.
    return realise(_with_force(Rig.model_validate_json(rig_json), body), band_hz)


def _with_force(rig: Rig, body: str) -> Rig:
    """The rig with a force on a body, a second output, and the body's velocity, a last sensor."""
    at = [e.name for e in rig.element].index(body) + 1
    one = Parameter(value=1.0, unit="N/V", source="a force of 1 N a unit")
    force = ForceSource(kind="force_source", name=HIDDEN, input=HIDDEN, K=one)
    output = rig.actuator[0].model_copy(update={"name": HIDDEN, "delay": 0.0})
    speed = Velocity(kind="velocity", name=HIDDEN, after=body, unit="m/s")
    return rig.model_copy(
        update={
            "element": (*rig.element[:at], force, *rig.element[at:]),
            "actuator": (*rig.actuator, output),
            "sensor": (*rig.sensor, speed),
        }
    )
