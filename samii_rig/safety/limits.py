"""What the safety gate holds a run to, as data: numbers, units, and the reason of each."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from samii_rig.devices.protocols import DeviceLoop
from samii_rig.errors import InputError
from samii_rig.model.feedback import reach
from samii_rig.rig import schema
from samii_rig.rig.schema import (
    AbsoluteAngle,
    ActuatorSpec,
    AngularVelocitySource,
    AngularVelocitySource2,
    Displacement,
    Feedback,
    Gear,
    RelativeAngle,
    Rig,
    Sensor,
    Spindle,
    TranslationalGroundSpring,
    VelocitySource,
)
from samii_rig.safety.agreement import Agreement

# How long the read-back of an actuator without a deadman may be missing, s. Such an
# actuator is never armed, so the number only has to be defined.
READBACK_STALE = 0.05

# How far ahead of the newest sample a reference may reach, s. What the device holds it
# carries out even if this program dies, and only then does its deadman count.
MAX_AHEAD = 0.25

# When a value that repeats bit by bit is a dead sensor, and not a joint at rest or a coarse
# encoder. Where theta dips (an antiresonance) an angle may stand still for some time while
# the command moves the source to and fro; for longer than STUCK_AFTER the shipped campaigns
# leave at most 4.2 steps of such travel unseen, and 17 % of the limit for a shorter time.
STUCK_AFTER = 0.25  # s
STUCK_STEPS = 16.0  # of the sensor's resolution
STUCK_PART = 0.01  # of its limit, where its steps are finer than that
AT_ONCE_PART = 0.5  # of its limit, however short the time
# Any other sensor is judged by its own noise: with this rms, in steps of its converter, a
# value repeats for a second once in 1e11 seconds.
NOISY = 0.25
NOISE_AFTER = 1.0  # s
NOISE_STEPS = 4.0  # of the actuator's converter: smallest mean |v| that counts as moving


# How far the output that a device reads back may be from what it was commanded, in steps of its
# converter (it rounds the reference, the product and the sum) and as a part of its limit.
READBACK_STEPS = 4.0
READBACK_PART = 0.01


@dataclass(frozen=True, slots=True)
class Stuck:
    """When a value that repeats bit by bit is a fault, while the output v is not zero.

    gain : sensor unit per s and actuator unit: what the command must cause, gain * integral
        of v, counted from the value's last change.
    after, travel : s and sensor unit, both passed: stuck. at_once : the same in any time.
    noise_after, effort : s and mean |v|, both passed: stuck. inf for what is not judged.
    """

    gain: float = 0.0
    after: float = math.inf
    travel: float = math.inf
    at_once: float = math.inf
    noise_after: float = math.inf
    effort: float = math.inf


@dataclass(frozen=True, slots=True)
class ChannelLimit:
    """One channel that must be fresh and small while the output is live.

    max, max_rate : largest |value| in `unit` and |change| in `unit` per second; inf for none.
    min : smallest value in `unit`, -inf for none.
    slack : added to `max` (and one step a sample to the rate) before a trip: one step of
        the converter, so that a device that holds its output at the limit is not blamed
        for its rounding.
    stale_after : s. stuck : when the channel must not stand still.
    """

    channel: str
    unit: str
    max: float
    max_rate: float
    stale_after: float
    reason: str
    slack: float = 0.0
    stuck: Stuck = Stuck()
    min: float = -math.inf


@dataclass(frozen=True, slots=True)
class Addition:
    """What one feedback loop may add to the output: its `loop.max`, which the device keeps,
    and `slew`, the change per second for each unit of its sensor."""

    loop: Feedback
    slew: float


@dataclass(frozen=True, slots=True)
class GateLimits:
    """Everything that the gate decides by.

    output : limit on the actuator's own channel, the command before the wire and the
        read-back after it.
    sensors : limits on sensors; those that a loop reads are among them, so that none acts
        on a dead one. Then those on monitors.
    kp, centring_sensor : the device's loop v = u + kp (theta_ref - theta).
    heartbeat_age : s without a sign of the operator's client; inf where none is needed.
    max_ahead : s from the newest sample to the last of a reference.
    feedback : the device's loops beside the centring.
    readback : how far v as read back may be from u + kp (theta_ref - theta) + feedback.
    turning : unit of the centring sensor per s and actuator unit where an angular velocity
        source turns it, with its sign; 0 where the travel does not follow from the output.
    agreements : between sensors and what else is known of them.
    """

    rate_hz: float
    output: ChannelLimit
    sensors: tuple[ChannelLimit, ...]
    kp: float
    centring_sensor: str
    heartbeat_age: float = math.inf
    max_ahead: float = MAX_AHEAD
    feedback: tuple[Addition, ...] = ()
    readback: float = math.inf
    turning: float = 0.0
    agreements: tuple[Agreement, ...] = ()

    @property
    def authority(self) -> float:
        """The most that all feedback loops together may add to the output."""
        return sum(a.loop.max for a in self.feedback)

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
            feedback=tuple(a.loop for a in self.feedback),
        )


# An experiment that is made for one rig is run on another, or --rig is forgotten.
_OTHERWISE = "; name it in a copy of the experiment's file, or another rig by --rig"


def find_actuator(rig: Rig, name: str, where: str) -> ActuatorSpec:
    """The actuator called `name`; InputError if the rig has none of that name."""
    for actuator in rig.actuator:
        if actuator.name == name:
            return actuator
    names = ", ".join(a.name for a in rig.actuator)
    raise InputError(where, "actuator", name, f"an actuator of {rig.name}: {names}{_OTHERWISE}")


def gate_limits(
    rig: Rig,
    actuator: str,
    kp: float,
    sensor: str,
    heartbeat_age: float = math.inf,
    beside: tuple[str, ...] = (),
) -> GateLimits:
    """The limits of a rig file for a run that drives `actuator` and centres by `sensor`.

    beside : actuators that are driven too. An angle that they turn as well says nothing of this
    one alone: it is judged by its noise, and no loop may centre by it.

    The feedback loops of the rig on that actuator are part of the run.
    Several limits on one channel: the tightest of each number holds. The ends of the
    actuator's converter are a limit too.

    InputError for a loop on a sensor that could stand still unseen, see `_refuse_blind`, and for
    an agreement with an output that turns the sensor at no known speed.
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
    feedback = tuple(
        Addition(f, reach(f, rig.rate_hz).slew) for f in rig.feedback if f.actuator == actuator
    )
    agreements = tuple(
        _agreement(rig, a, beside) for a in rig.agreement if a.over is None or a.other == actuator
    )
    compared = {name for a in agreements for name in (a.sensor, a.other)}
    sensors = _sensor_limits(rig, spec, kp, sensor, beside, feedback, compared)
    sensors += [
        _channel(rig, m.name, m.unit, math.inf, "", m.stale_after, 0.0)
        for m in rig.monitor
        if m.name in compared or any(True for _ in rig.limits_on(m.name))
    ]
    turning = sum(_own_gain(rig, actuator, beside, s) for s in rig.sensor if s.name == sensor)
    readback = max(READBACK_STEPS * spec.resolution, READBACK_PART * output.max)
    return GateLimits(
        rig.rate_hz,
        output,
        tuple(sensors),
        kp,
        sensor,
        heartbeat_age,
        feedback=feedback,
        readback=readback,
        turning=turning,
        agreements=agreements,
    )


def _sensor_limits(
    rig: Rig,
    spec: ActuatorSpec,
    kp: float,
    sensor: str,
    beside: tuple[str, ...],
    feedback: tuple[Addition, ...],
    compared: set[str],
) -> list[ChannelLimit]:
    """Of each sensor that has a limit, is compared with another, or is read by a loop."""
    sensors = []
    for s in rig.sensor:
        limited = s.name in compared or any(True for _ in rig.limits_on(s.name))
        read = [a.loop.name for a in feedback if a.loop.sensor == s.name]
        if limited or read or (kp != 0.0 and s.name == sensor):
            reason = "the loop that centres the joint reads it"
            if read:
                reason = f"the feedback {read[0]} reads it"
            c = _channel(rig, s.name, s.unit, math.inf, reason, s.stale_after, 0.0)
            gain = _own_gain(rig, spec.name, beside, s)
            stuck = _stuck(spec, s, c.max, gain)
            centring = kp != 0.0 and s.name == sensor
            _refuse_blind(rig, spec, s, stuck, gain, centring=centring, read=read)
            sensors.append(replace(c, stuck=stuck))
    return sensors


def _agreement(rig: Rig, a: schema.Agreement, beside: tuple[str, ...]) -> Agreement:
    unit = rig.units()[a.sensor]
    if a.over is None:
        return Agreement(a.sensor, a.other, unit, a.max, a.reason)
    (sensor,) = (s for s in rig.sensor if s.name == a.sensor)
    gain = _own_gain(rig, a.other, beside, sensor)
    if gain == 0.0:
        alone = " alone" if beside else ""
        expected = f"an angle that {a.other}{alone} turns through an angular velocity source"
        raise InputError(rig.name, "agreement.sensor", a.sensor, expected)
    return Agreement(a.sensor, a.other, unit, a.max, a.reason, gain, a.over)


def _stuck(actuator: ActuatorSpec, sensor: Sensor, most: float, gain: float) -> Stuck:
    """What the sensor must show of a command, from the chain's statics (gain, see `_angle_gain`)
    and its own noise."""
    noisy = sensor.noise_rms > NOISY * sensor.resolution
    noise_after = NOISE_AFTER if noisy else math.inf
    effort = NOISE_STEPS * actuator.resolution
    floor = STUCK_PART * most if math.isfinite(most) else 0.0
    travel = max(STUCK_STEPS * sensor.resolution, floor)
    if gain == 0.0 or travel == 0.0:
        return Stuck(noise_after=noise_after, effort=effort)
    at_once = max(AT_ONCE_PART * most, travel)
    return Stuck(abs(gain), STUCK_AFTER, travel, at_once, noise_after, effort)


def _refuse_blind(
    rig: Rig,
    actuator: ActuatorSpec,
    sensor: Sensor,
    stuck: Stuck,
    gain: float,
    *,
    centring: bool,
    read: list[str],
) -> None:
    """InputError if a loop reads a sensor that the gate could not see standing still in time.

    Centring on a dead sensor drives the joint away with nothing to hold it, so only an angle
    whose travel is known from the output will do: that of an angular velocity source. A torque
    or a force turns a joint by what its inertia and springs let it. A feedback is held by its
    `max` meanwhile, so its sensor's missing noise is a sign that comes in time.
    """
    where, follows = f"sensor[{sensor.name}]", gain != 0.0
    if centring and not follows:
        expected = (
            f"an angle that {actuator.name} turns through an angular velocity source, or a "
            "displacement through a velocity source, or kp = 0: "
            "the gate sees no other one stand still in time"
        )
        raise InputError(
            rig.name, f"{where}.kind, read by the centring loop", sensor.kind, expected
        )
    if read and not follows and not math.isfinite(stuck.noise_after):
        expected = (
            f"above {NOISY:g} of its resolution, or the gate cannot see it stand still while the "
            f"feedback {read[0]} reads it"
        )
        raise InputError(rig.name, f"{where}.noise_rms", sensor.noise_rms, expected)


def _angle_gain(rig: Rig, actuator: str, sensor: Sensor) -> float:
    """Low-frequency rad/s or m/s of the sensor per unit of the actuator; 0 if it does not
    follow it: slowly turned or pushed, springs and beams of a clamped chain go along. A torque or a
    force moves nothing at a known speed."""
    held = any(isinstance(e, TranslationalGroundSpring) and e.k.value > 0 for e in rig.element)
    speed = _speeds(rig, actuator)
    clamped = rig.base == "clamped"
    match sensor:
        case RelativeAngle():
            before = rig.element[: [e.name for e in rig.element].index(sensor.across[0])]
            return speed[sensor.across[-1]] - (speed[before[-1].name] if before else 0.0)
        case AbsoluteAngle() if clamped:
            return speed[sensor.after]
        # What is held behind a velocity source gives way at no known speed.
        case Displacement() if not held and rig.tip == "free":
            if sensor.against is not None:
                return speed[sensor.after] - speed[sensor.against]
            return speed[sensor.after] if clamped else 0.0
    return 0.0


def _own_gain(rig: Rig, actuator: str, beside: tuple[str, ...], sensor: Sensor) -> float:
    """The same, 0 too where another output turns the sensor: it may undo what this one does."""
    if any(_angle_gain(rig, other, sensor) != 0.0 for other in beside):
        return 0.0
    return _angle_gain(rig, actuator, sensor)


def _speeds(rig: Rig, actuator: str) -> dict[str, float]:
    """The same behind each element, against the base."""
    out, speed = {}, 0.0
    for e in rig.element:
        match e:
            case AngularVelocitySource() | AngularVelocitySource2() | VelocitySource():
                speed += e.K.value if e.input == actuator else 0.0
            case Gear():
                speed /= e.n.value
            case Spindle():
                speed *= e.lead.value
        out[e.name] = speed
    return out


def _channel(
    rig: Rig, name: str, unit: str, most: float, reason: str, stale_after: float, slack: float
) -> ChannelLimit:
    rate, least = math.inf, -math.inf
    for limit in rig.limits_on(name):
        if limit.max < most:
            most, reason = limit.max, limit.reason
        if limit.min is not None:
            least = max(least, limit.min)
        if limit.max_rate is not None:
            rate = min(rate, limit.max_rate)
    return ChannelLimit(name, unit, most, rate, stale_after, reason, slack, min=least)
