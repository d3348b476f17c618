"""What can be set of the simulated rig: the table [device.settings] of a rig file."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag

from samii_rig.rig.schema import Name, NonNegative, Positive, Rig, Strict
from samii_rig.rig.settings import checked, wrong
from sim import faults


class Hum(Strict):
    """A tone that a sensor's cable picks up, before its filters: `amplitude` in its unit."""

    amplitude: NonNegative
    frequency_hz: Positive


def _which(given: object) -> str:
    return "by_actuator" if isinstance(given, dict) else "of_every_drive"


class SimSettings(Strict):
    """Settings of the simulated rig; an unknown one is an error.

    seed : of all noise; the same seed gives the same samples. Without one it is drawn anew
        for each run, which the recording then names.
    noise : false makes the sensors ideal: no noise, no steps of the converter, no offset.
        Their filters, delays and ranges stay, and so do the steps of the output.
    inner : inner steps a sample. Without disturbance and friction it changes nothing,
        because every step is exact.
    band_hz : edge of the search for poles; default 4 times the sample rate.
    disturbance_rms : a disturbance of the drive that does not depend on the reference, in the
        actuator's unit: white noise that adds to v behind the point where v is recorded. Its mean
        over one sample has this rms. It enters where v enters, so the true response from v to
        every sensor stays the one without disturbance.
    coulomb_friction : dry friction of the drive, as the input that just overcomes it, in the
        actuator's unit. An ideal velocity source does not feel a torque beside it, so the
        friction acts inside the drive: speed' = p (v - friction sign(speed) - speed), stuck
        at zero speed while |v| is smaller. The best linear response then depends on the level.
        A number is that of every drive; by an actuator's name it is of that one alone.
    guide_friction : dry friction, N, of the guide of a mass that slides, by the mass's name. The
        force stops the mass where it can and opposes its speed else. One mass may have it.
    play : width of a gap, m or rad, by the name of the spring that has it: the spring does not push
        within half the width to either side, its damper does. One spring may have it, where no
        guide has friction.
    hum : by sensor name.
    stuck, nan : by sensor name, s from which the sensor repeats its last value, or gives NaN.
    pace : times real time at which simulated time passes at most, for who wants to watch; 0 for
        as fast as it can.
    drop : numbers of samples that the device takes but that never arrive.
    faults : by name, such as "stuck a_1" (`sim.faults`); they add to the settings above.
    """

    seed: Annotated[int, Field(ge=0, default_factory=lambda: secrets.randbits(32))]
    noise: bool = True
    inner: Annotated[int, Field(ge=1, le=64)] = 8
    band_hz: Positive | None = None
    disturbance_rms: NonNegative = 0.0
    coulomb_friction: Annotated[
        Annotated[NonNegative, Tag("of_every_drive")]
        | Annotated[dict[Name, NonNegative], Tag("by_actuator")],
        Discriminator(_which),  # one reading of what was given, and so one line of what is wrong
    ] = 0.0
    guide_friction: dict[Name, NonNegative] = Field(default_factory=dict)
    play: dict[Name, NonNegative] = Field(default_factory=dict)
    hum: dict[Name, Hum] = Field(default_factory=dict)
    stuck: dict[Name, NonNegative] = Field(default_factory=dict)
    nan: dict[Name, NonNegative] = Field(default_factory=dict)
    pace: NonNegative = 0.0
    drop: tuple[Annotated[int, Field(ge=0)], ...] = ()
    faults: tuple[str, ...] = ()


def read_settings(rig: Rig, overrides: Mapping[str, object]) -> SimSettings:
    """The rig file's [device.settings] with `overrides` on top; InputError names a wrong one."""
    settings = checked(SimSettings, rig, {**rig.device.settings, **overrides})
    names = {s.name for s in rig.sensor}
    for setting in ("hum", "stuck", "nan"):
        for name in getattr(settings, setting):
            if name not in names:
                raise wrong(rig, setting, name, f"one of {', '.join(sorted(names))}")
    if isinstance(settings.coulomb_friction, dict):
        known = [a.name for a in rig.actuator]
        for name in settings.coulomb_friction:
            if name not in known:
                raise wrong(rig, "coulomb_friction", name, f"one of {', '.join(known)}")
    for made in faults.settings(rig, settings.faults):
        for setting, value in made.items():
            settings = settings.model_copy(
                update={setting: _both(getattr(settings, setting), value)}
            )
    return settings


def _both(one: Any, other: Any) -> Any:
    """Of two dicts or two tuples."""
    return {**one, **other} if isinstance(one, dict) else (*one, *other)
