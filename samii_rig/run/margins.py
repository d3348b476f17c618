"""How near a predicted plan comes to each limit: of the gate, of the converters, of the loops."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.model.feedback import reach
from samii_rig.rig.schema import Rig, Sensor
from samii_rig.run.plan import Plan
from samii_rig.safety.limits import GateLimits
from samii_rig.types import Float

SIGMAS = 5.0  # of the sensor's noise; passed once in 1.7 million samples


@dataclass(frozen=True, slots=True)
class Margin:
    """One limit and what the plan comes to at its worst.

    what : `limit` or `rate` of the gate (for the actuator the bound |u| + kp (|theta_ref| +
        |theta|) + sum max by which the gate judges), `range` of the converter, `max` of a
        feedback loop, by its name: a loop that is clipped no longer does what is predicted.
    predicted, limit : in `unit`. segment, level : where the worst is.
    largest_level : `level` at which the limit would just be reached if all levels were
        scaled alike; 0 if the sensor's noise or offset alone reaches it.
    """

    channel: str
    what: str
    unit: str
    predicted: float
    limit: float
    reason: str
    segment: str
    level: float
    level_unit: str
    largest_level: float

    @property
    def margin(self) -> float:
        """1 - predicted/limit; below 0 when the limit is broken."""
        return 1.0 - self.predicted / self.limit


def margins(
    plan: Plan,
    rig: Rig,
    limits: GateLimits,
    series: Mapping[str, Float],
    added: Mapping[str, Float],
    parts: Sequence[slice],
) -> tuple[Margin, ...]:
    """All margins, worst first.

    series : predicted v and sensors, (n,) each by name; added : outputs of the feedback loops by
    name, before they are clipped. parts : the samples of each segment.
    """
    gate = [
        *_output_margins(plan, rig, limits, series, parts),
        *_sensor_margins(plan, rig, limits, series, parts),
    ]
    limited = [m for m in gate if math.isfinite(m.limit)]
    return worst_first([*limited, *_feedback_margins(plan, rig, limits, added, parts)])


def worst_first(found: Iterable[Margin]) -> tuple[Margin, ...]:
    """By margin, the smallest first."""
    return tuple(sorted(found, key=lambda m: m.margin))


def worse_of(ways: Iterable[Sequence[Margin]]) -> tuple[Margin, ...]:
    """Of several ways through a plan the smallest margin to each limit, worst first."""
    worst: dict[tuple[str, str, str], Margin] = {}
    for m in (m for way in ways for m in way):
        key = m.channel, m.what, m.reason
        if key not in worst or m.margin < worst[key].margin:
            worst[key] = m
    return worst_first(worst.values())


def _noise(sensor: Sensor) -> float:
    """The largest part of a reading that no level scales: offset, noise, half a step."""
    return abs(sensor.offset) + SIGMAS * sensor.noise_rms + sensor.resolution / 2


def _output_margins(
    plan: Plan, rig: Rig, limits: GateLimits, series: Mapping[str, Float], parts: Sequence[slice]
) -> Iterable[Margin]:
    """Of the output and its slew, by the bounds that the gate judges a reference by."""
    sensors = {s.name: s for s in rig.sensor}
    rate, kp, output = plan.rate_hz, abs(plan.kp), limits.output
    authority = sum(a.loop.max for a in limits.feedback)
    slewing = [(a.slew, sensors[a.loop.sensor]) for a in limits.feedback]
    slew_noise = sum(slew * _noise(sensor) for slew, sensor in slewing)
    centring = sensors.get(plan.centring_sensor) if kp > 0 else None
    theta = series[centring.name] if centring else np.zeros(1)
    theta_noise = _noise(centring) if centring else 0.0
    bound, slew = [], []
    # The whole plan's steps, from rest and back to rest: segments are sent without a border.
    u, theta_ref = (
        np.concatenate([[0.0], *(getattr(s, name) for s in plan.segments), [0.0]])
        for name in ("u", "theta_ref")
    )
    steps = np.abs(np.diff(u)) + kp * np.abs(np.diff(theta_ref))
    turning = np.abs(np.diff(theta, prepend=0.0)) if centring else np.zeros(len(u) - 2)
    reach = math.ceil(limits.max_ahead * rate)
    for s, part in zip(plan.segments, parts, strict=True):
        # The gate judges a reference by the angle of up to `reach` samples before.
        seen = slice(max(0, part.start - reach), part.stop)
        angle = np.abs(theta[seen]) if centring else np.zeros(1)
        bound.append(float((np.abs(s.u) + kp * np.abs(s.theta_ref)).max() + kp * angle.max()))
        # The step out of a segment counts for it too: it leads back to rest after the last.
        step = steps[part.start : part.stop + 1].max()
        turn_of = sum(k * float(np.abs(series[x.name][seen]).max()) for k, x in slewing)
        slew.append(float(step + kp * turning[seen].max()) * rate + turn_of)
    name, unit, reason = output.channel, output.unit, output.reason
    fixed = kp * theta_noise + authority
    yield _worst(plan, name, "limit", unit, bound, fixed, output.max, reason)
    fixed = 2 * kp * theta_noise * rate + slew_noise
    yield _worst(plan, name, "rate", f"{unit}/s", slew, fixed, output.max_rate, reason)


def _sensor_margins(
    plan: Plan, rig: Rig, limits: GateLimits, series: Mapping[str, Float], parts: Sequence[slice]
) -> Iterable[Margin]:
    """Of what the sensors read and how fast it changes, and of the ends of their converters."""
    sensors, rate = {s.name: s for s in rig.sensor}, plan.rate_hz
    for c in limits.sensors:
        if c.channel not in series:
            continue  # a monitor, which no model predicts
        x, fixed = series[c.channel], _noise(sensors[c.channel])
        size = [float(np.abs(x[part]).max()) for part in parts]
        yield _worst(plan, c.channel, "limit", c.unit, size, fixed, c.max, c.reason)
        turns = np.abs(np.diff(x, prepend=0.0))
        turn = [float(turns[part].max()) * rate for part in parts]
        noise = 2 * fixed * rate
        yield _worst(plan, c.channel, "rate", f"{c.unit}/s", turn, noise, c.max_rate, c.reason)
    for sensor in rig.sensor:
        reason = "end of the converter's range"
        up = [float(series[sensor.name][part].max()) for part in parts]
        down = [float(-series[sensor.name][part].min()) for part in parts]
        for peaks, end in ((up, sensor.high), (down, -sensor.low)):
            noise = _noise(sensor)
            yield _worst(plan, sensor.name, "range", sensor.unit, peaks, noise, end, reason)


def _feedback_margins(
    plan: Plan, rig: Rig, limits: GateLimits, added: Mapping[str, Float], parts: Sequence[slice]
) -> list[Margin]:
    """Whether each feedback loop stays inside its `max`."""
    out = []
    for a in limits.feedback:
        loop = a.loop
        sensor = next(s for s in rig.sensor if s.name == loop.sensor)
        bounds = reach(loop, plan.rate_hz)
        steady = bounds.peak * (abs(sensor.offset) + sensor.resolution / 2)
        fixed = steady + SIGMAS * sensor.noise_rms * bounds.rms
        size = [float(np.abs(added[loop.name][part]).max()) for part in parts]
        reason = "the device clips this loop there"
        out.append(
            _worst(plan, loop.name, "max", limits.output.unit, size, fixed, loop.max, reason)
        )
    return out


def _worst(
    plan: Plan,
    channel: str,
    what: str,
    unit: str,
    x: list[float],
    fixed: float,
    limit: float,
    reason: str,
) -> Margin:
    i = int(np.argmax(x))
    s = plan.segments[i]
    room = max(0.0, limit - fixed)
    largest = s.level * room / x[i] if x[i] > 0 else math.inf
    return Margin(
        channel, what, unit, x[i] + fixed, limit, reason, s.name, s.level, s.unit, largest
    )
