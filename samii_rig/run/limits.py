"""What the safety gate holds a run to, as data: numbers, units, and the reason of each."""

from __future__ import annotations

import math
from dataclasses import dataclass

from samii_rig.errors import InputError
from samii_rig.rig.schema import ActuatorSpec, Rig
from samii_rig.run.protocols import DeviceLoop

# How long the read-back of an actuator without a deadman may be missing, s. Such an
# actuator is never armed, so the number only has to be defined.
READBACK_STALE = 0.05

# How far ahead of the newest sample a reference may reach, s. What the device holds it
# carries out even if this program dies, and only then does its deadman count.
MAX_AHEAD = 0.25


@dataclass(frozen=True, slots=True)
class ChannelLimit:
    """One channel that must be fresh and small while the output is live.

    max, max_rate : largest |value| in `unit` and |change| in `unit` per second; inf for none.
    slack : added to `max` (and one step a sample to the rate) before a trip: one step of
        the converter, so that a device that holds its output at the limit is not blamed
        for its rounding.
    stale_after : s.
    """

    channel: str
    unit: str
    max: float
    max_rate: float
    stale_after: float
    reason: str
    slack: float = 0.0


@dataclass(frozen=True, slots=True)
class GateLimits:
    """Everything that the gate decides by.

    output : limit on the actuator's own channel, the command before the wire and the
        read-back after it.
    sensors : limits on sensors, the centring sensor among them whenever kp is not 0.
    kp, centring_sensor : the device's loop v = u + kp (theta_ref - theta).
    heartbeat_age : s without a sign of the operator's client; inf where none is needed.
    max_ahead : s from the newest sample to the last of a reference.
    """

    rate_hz: float
    output: ChannelLimit
    sensors: tuple[ChannelLimit, ...]
    kp: float
    centring_sensor: str
    heartbeat_age: float = math.inf
    max_ahead: float = MAX_AHEAD

    @property
    def channels(self) -> tuple[ChannelLimit, ...]:
        """All channels that the gate needs, the actuator's first."""
        return (self.output, *self.sensors)

    def device_loop(self) -> DeviceLoop:
        """The same limits in the device's own terms, which it keeps when we are gone."""
        angle = [s.max for s in self.sensors if s.channel == self.centring_sensor]
        return DeviceLoop(
            sensor=self.centring_sensor,
            kp=self.kp,
            max_output=self.output.max,
            max_rate=self.output.max_rate,
            max_angle=min(angle, default=math.inf),
        )


def find_actuator(rig: Rig, name: str, where: str) -> ActuatorSpec:
    """The actuator called `name`; InputError if the rig has none of that name."""
    for actuator in rig.actuator:
        if actuator.name == name:
            return actuator
    names = ", ".join(a.name for a in rig.actuator)
    raise InputError(where, "actuator", name, f"an actuator of {rig.name}: {names}")


def gate_limits(
    rig: Rig, actuator: str, kp: float, sensor: str, heartbeat_age: float = math.inf
) -> GateLimits:
    """The limits of a rig file for a run that drives `actuator` and centres by `sensor`.

    Several limits on one channel: the tightest of each number holds. The ends of the
    actuator's converter are a limit too.
    """
    spec = find_actuator(rig, actuator, rig.name)
    output = _channel(
        rig,
        actuator,
        spec.unit,
        min(-spec.low, spec.high),
        "end of the converter's range",
        spec.deadman or READBACK_STALE,
        spec.resolution,
    )
    sensors = []
    for s in rig.sensor:
        limited = any(True for _ in rig.limits_on(s.name))
        if limited or (kp != 0.0 and s.name == sensor):
            reason = "the loop that centres the joint reads it"
            sensors.append(_channel(rig, s.name, s.unit, math.inf, reason, s.stale_after, 0.0))
    return GateLimits(rig.rate_hz, output, tuple(sensors), kp, sensor, heartbeat_age)


def _channel(
    rig: Rig, name: str, unit: str, most: float, reason: str, stale_after: float, slack: float
) -> ChannelLimit:
    rate = math.inf
    for limit in rig.limits_on(name):
        if limit.max < most:
            most, reason = limit.max, limit.reason
        if limit.max_rate is not None:
            rate = min(rate, limit.max_rate)
    return ChannelLimit(name, unit, most, rate, stale_after, reason, slack)
