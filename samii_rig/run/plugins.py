"""Somebody else's experiments: a wrong plan is reported as wrong input, field by field."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np

from samii_rig.devices.plugins import wrong
from samii_rig.errors import InputError, one_of
from samii_rig.rig.schema import Rig
from samii_rig.run.plan import Dwell, Output, Plan, PlannedSegment
from samii_rig.types import Kind


def checked_plan(plan: object, rig: Rig, who: str) -> Plan:
    """What an experiment's plan() returned, if it is a plan for this rig; else InputError."""
    if not isinstance(plan, Plan):
        raise InputError.saying(who, "plan()", f"returned {type(plan).__name__}; expected a Plan")
    beside = plan.beside
    if not (isinstance(beside, tuple) and all(isinstance(o, Output) for o in beside)):
        raise wrong(who, "plan().beside", beside, "a tuple of Output")
    _check_output(plan, "plan()", rig, who)
    for i, output in enumerate(beside):
        _check_output(output, f"plan().beside[{i}]", rig, who)
    names = [o.actuator for o in plan.outputs]
    if len(set(names)) != len(names):
        raise wrong(who, "plan().beside", names, "each actuator once")
    if not _number(plan.rate_hz):
        raise wrong(who, "plan().rate_hz", plan.rate_hz, "a finite number")
    if not isinstance(plan.segments, tuple) or not plan.segments:
        raise wrong(who, "plan().segments", plan.segments, "a tuple of at least one PlannedSegment")
    for i, segment in enumerate(plan.segments):
        _check_segment(segment, f"plan().segments[{i}]", who, names)
    return plan


def _check_output(output: Plan | Output, where: str, rig: Rig, who: str) -> None:
    actuators, sensors = [a.name for a in rig.actuator], [s.name for s in rig.sensor]
    for field, names in (("actuator", actuators), ("centring_sensor", sensors)):
        if getattr(output, field) not in names:
            given = getattr(output, field)
            raise wrong(
                who, f"{where}.{field}", given, f"a name of {rig.name}, {one_of(given, names)}"
            )
    if not _number(output.kp):
        raise wrong(who, f"{where}.kp", output.kp, "a finite number")


def _check_segment(s: object, where: str, who: str, outputs: list[str]) -> None:
    if not isinstance(s, PlannedSegment):
        raise wrong(who, where, s, "a PlannedSegment")
    n = len(s.u) if isinstance(s.u, np.ndarray) else 0
    k = len(outputs)
    for field, finite in (("u", True), ("theta_ref", True), ("frequency", False)):
        x = getattr(s, field)
        wide = (n, k) if finite and k > 1 else (n,)
        fits = isinstance(x, np.ndarray) and x.dtype.kind == "f" and x.shape == wide and n > 0
        if not fits or (finite and not np.isfinite(x).all()):
            values = "finite floats" if finite else "floats"
            each = f"{k} a sample" if len(wide) > 1 else "one a sample"
            raise wrong(who, f"{where}.{field}", x, f"an array of {values}, {each}")
    if not (isinstance(s.excited, tuple) and all(name in outputs for name in s.excited)):
        raise wrong(who, f"{where}.excited", s.excited, f"names among {', '.join(outputs)}")
    band = s.band_hz
    if not (isinstance(band, tuple) and len(band) == 2 and all(map(_number, band))):
        raise wrong(who, f"{where}.band_hz", band, "two frequencies in Hz")
    if not 0.0 <= band[0] <= band[1]:
        raise wrong(who, f"{where}.band_hz", band, "the lower frequency first, 0 or more")
    if s.kind not in get_args(Kind):
        raise wrong(who, f"{where}.kind", s.kind, f"one of {', '.join(get_args(Kind))}")
    if not (_number(s.level) and isinstance(s.name, str) and isinstance(s.unit, str)):
        raise wrong(who, where, (s.name, s.level, s.unit), "a name, a finite level and its unit")
    part = s.recorded or (0, n)
    if not (isinstance(part, tuple) and len(part) == 2 and 0 <= part[0] < part[1] <= n):
        raise wrong(who, f"{where}.recorded", part, f"a first and a last sample of {n}")
    dwell = s.dwell
    if dwell is not None and not (isinstance(dwell, Dwell) and 0 <= dwell.first < dwell.last <= n):
        raise wrong(who, f"{where}.dwell", dwell, f"a Dwell inside the segment's {n} samples")


def _number(x: object) -> bool:
    return isinstance(x, int | float | np.integer | np.floating) and math.isfinite(x)
