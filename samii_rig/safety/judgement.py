"""The judgement of the safety gate: a pure function of everything that the gate knows.

`latest.observe` keeps what the samples say, `decide` says what may happen. Neither holds a
device, so the whole input space can be tested, and mutants of them killed.

    SAFE --arm--> ARMED --start--> RUNNING --stop--> SAFE
    ARMED or RUNNING --anything wrong--> FAULT --clear(person, reason)--> SAFE
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from samii_rig.devices.protocols import CommandBlock
from samii_rig.safety.latest import Latest
from samii_rig.safety.limits import ChannelLimit, GateLimits
from samii_rig.safety.readback import Sent, travel

# How much beyond its limit a prediction may lead an angle: the source alone knows nothing of the
# joint's spring, and what is measured beyond the limit trips anyway.
TRAVEL = 1.2


class State(Enum):
    """Where the gate stands. Only RUNNING lets a command through."""

    SAFE = "safe"
    ARMED = "armed"
    RUNNING = "running"
    FAULT = "fault"


@dataclass(frozen=True, slots=True)
class Arm:
    """Ask for ARMED. deadman : as the actuator declares it, s, or None."""

    deadman: float | None


@dataclass(frozen=True, slots=True)
class Start:
    """Ask for RUNNING."""


@dataclass(frozen=True, slots=True)
class Check:
    """Ask whether all is well."""


@dataclass(frozen=True, slots=True)
class Write:
    """Ask to send a reference. sent : what was sent before and has not come back."""

    block: CommandBlock
    sent: Sent = field(default_factory=Sent)


@dataclass(frozen=True, slots=True)
class Stop:
    """End at zero. Always granted; a FAULT stays one."""

    reason: str


@dataclass(frozen=True, slots=True)
class Fail:
    """Something broke: end at zero and in FAULT. Always granted."""

    reason: str


@dataclass(frozen=True, slots=True)
class Clear:
    """A person takes a FAULT back and says why that is safe."""

    person: str
    reason: str


Request = Arm | Start | Check | Write | Stop | Fail | Clear


class Act(Enum):
    """What the holder does with the actuator."""

    NOTHING = "nothing"
    CONFIGURE = "configure"
    WRITE = "write"
    ZERO = "zero"


@dataclass(frozen=True, slots=True)
class Decision:
    """What was decided: the state that follows and what to do with the actuator.

    what : a word for it. number, limit : what was compared, in `unit`; NaN where nothing was.
    """

    state: State
    act: Act
    accepted: bool
    what: str
    reason: str = ""
    number: float = math.nan
    limit: float = math.nan
    unit: str = ""


def decide(
    state: State, request: Request, latest: Latest, limits: GateLimits, now: int
) -> Decision:
    """What may happen. A pure function of everything that the gate knows.

    A request that comes in the wrong state is a defect of whoever sent it and ends in
    FAULT; arming that is refused for a cause that can be mended stays SAFE.
    """
    match request:
        case Stop(reason):
            after = State.FAULT if state is State.FAULT else State.SAFE
            return Decision(after, Act.ZERO, True, "stop", reason)
        case Fail(reason):
            return Decision(State.FAULT, Act.ZERO, True, "failure", reason)
        case Clear(person, reason):
            if state is not State.FAULT:
                return _wrong_state(state, "clear", State.FAULT)
            if not (person.strip() and reason.strip()):
                return Decision(
                    state, Act.ZERO, False, "clear", "a fault is cleared by a name and a reason"
                )
            return Decision(State.SAFE, Act.ZERO, True, "clear", f"{person}: {reason}")
        case Arm(deadman):
            if state is not State.SAFE:
                return _wrong_state(state, "arm", State.SAFE)
            if deadman is None:
                return Decision(
                    state,
                    Act.ZERO,
                    False,
                    "deadman",
                    f"{limits.output.channel} declares no deadman, so nothing would end its "
                    "output if this program died",
                )
            wrong = violation(latest, limits, now)
            if wrong is not None:
                return replace(wrong, state=state)
            return Decision(State.ARMED, Act.CONFIGURE, True, "arm")
        case Start():
            if state is not State.ARMED:
                return _wrong_state(state, "start", State.ARMED)
            return violation(latest, limits, now) or Decision(
                State.RUNNING, Act.NOTHING, True, "start"
            )
        case Check():
            if state in (State.SAFE, State.FAULT):
                return Decision(state, Act.NOTHING, True, "check")
            return violation(latest, limits, now) or Decision(state, Act.NOTHING, True, "check")
    # What is left is a Write.
    if state is not State.RUNNING:
        return _wrong_state(state, "write", State.RUNNING)
    return (
        violation(latest, limits, now)
        or command_violation(request.block, latest, limits, request.sent)
        or Decision(state, Act.WRITE, True, "write")
    )


def decide_all(
    state: State,
    requests: Sequence[Request],
    known: Sequence[tuple[Latest, GateLimits]],
    now: int,
) -> Decision:
    """What may happen to all outputs of a device: each is judged by itself, and what is refused
    to one is refused to all.

    requests, known : one of each output; every request of the same kind. A reference comes whole,
    a block of the same samples for every output, or is refused.
    """
    if len(requests) != len(known):
        return _fault(
            "shape", f"a reference for {len(requests)} outputs; expected {len(known)} of them"
        )
    spans = {(len(r.block), r.block.first) for r in requests if isinstance(r, Write)}
    if len(spans) > 1:
        return _fault("shape", "the references of the outputs are not of the same samples")
    decisions = [
        decide(state, request, latest, limits, now)
        for request, (latest, limits) in zip(requests, known, strict=True)
    ]
    for decision, (_, limits) in zip(decisions, known, strict=True):
        if not decision.accepted:
            name = limits.output.channel
            if len(known) == 1 or name in decision.reason:
                return decision
            return replace(decision, reason=f"{name}: {decision.reason}")
    return decisions[0]


def violation(latest: Latest, limits: GateLimits, now: int) -> Decision | None:
    """The first thing that the samples or the client's silence say is wrong, as a FAULT."""
    if latest.disorder:
        return _fault("order", "samples came out of order; the device's clock or count jumped back")
    for i, c in enumerate(limits.channels):
        peak, rate = latest.peak[i], latest.rate[i]
        if math.isnan(peak):
            return _fault("not a number", f"{c.channel} gave a value that is not a number")
        if peak > c.max + c.slack:
            return _over(c, peak, c.max, "limit", c.unit)
        if latest.low[i] < c.min:
            low = latest.low[i]
            text = f"{c.channel} at {low:.4g} {c.unit} is under {c.min:g} {c.unit} ({c.reason})"
            return _fault("least", text, low, c.min, c.unit)
        if rate > c.max_rate + c.slack * limits.rate_hz:
            return _over(c, rate, c.max_rate, "rate", f"{c.unit}/s")
        if latest.clipped[i]:
            return _fault("clipped", f"{c.channel} is at the end of its range and sees no further")
        age = latest.age(i, now)
        if age > c.stale_after:
            return _fault(
                "stale",
                f"{c.channel} said nothing new for {age:.3g} s; allowed {c.stale_after:g} s",
                age,
                c.stale_after,
                "s",
            )
        stuck = _standstill(c, latest, i)
        if stuck is not None:
            return stuck
    if latest.limited:
        return _fault("device", f"the device itself changed {limits.output.channel}")
    if latest.stray > limits.readback + limits.authority:
        c, most = limits.output, limits.readback + limits.authority
        text = f"{c.channel} read back is {latest.stray:.4g} {c.unit} away from what was commanded"
        return _fault("readback", f"{text}; allowed {most:.3g}", latest.stray, most, c.unit)
    for a, way in zip(limits.agreements, latest.apart, strict=False):
        if way > a.max:
            text = f"{a.sensor} and {a.other} are {way:.4g} {a.unit} apart: one of them drifts"
            return _fault("apart", f"{text}; allowed {a.max:g} ({a.reason})", way, a.max, a.unit)
    silence = (now - latest.heartbeat) * 1e-9
    if silence > limits.heartbeat_age:
        return _fault(
            "heartbeat",
            f"no sign of the operator's client; allowed {limits.heartbeat_age:g} s",
            silence,
            limits.heartbeat_age,
            "s",
        )
    return None


def _standstill(c: ChannelLimit, latest: Latest, i: int) -> Decision | None:
    """A value that repeats bit by bit although the output must have moved it, as a FAULT."""
    rule, held = c.stuck, (latest.time - latest.since[i]) * 1e-9
    travel = rule.gain * abs(latest.travel[i])
    if travel > rule.at_once or (held >= rule.after and travel > rule.travel):
        limit = rule.travel if held >= rule.after else rule.at_once
        reason = (
            f"{c.channel} is stuck: the same value for {held:.3g} s while the output must have "
            f"moved it by {travel:.3g} {c.unit}; allowed {limit:.3g} {c.unit}"
        )
        return _fault("stuck", reason, travel, limit, c.unit)
    if held >= rule.noise_after and latest.effort[i] > rule.effort * held:
        reason = (
            f"{c.channel} is stuck: the very same value, without its noise, for {held:.3g} s "
            f"while the output moved; allowed {rule.noise_after:g} s"
        )
        return _fault("stuck", reason, held, rule.noise_after, "s")
    return None


def _misplaced(block: CommandBlock, latest: Latest, limits: GateLimits) -> Decision | None:
    """A FAULT where a reference is not one number a sample, does not continue what was sent, or
    comes too late or too far ahead of the samples."""
    n = len(block)
    if n == 0 or block.u.shape != (n,) or block.theta_ref.shape != (n,):
        return _fault("shape", "u and theta_ref must be one value a sample, at least one")
    if not (np.isfinite(block.u).all() and np.isfinite(block.theta_ref).all()):
        return _fault("not a number", "the reference holds a value that is not a number")
    if latest.next >= 0 and block.first != latest.next:
        return _fault(
            "order",
            f"the reference continues at sample {block.first}; expected {latest.next}",
            block.first,
            latest.next,
        )
    if block.first <= latest.sequence:
        return _fault(
            "late",
            f"the reference for sample {block.first} came after sample {latest.sequence}",
            block.first,
            latest.sequence,
        )
    ahead = (block.first + n - 1 - latest.sequence) / limits.rate_hz
    if ahead > limits.max_ahead:
        return _fault(
            "ahead",
            f"the reference reaches {ahead:.3g} s ahead; allowed {limits.max_ahead:g} s",
            ahead,
            limits.max_ahead,
            "s",
        )
    return None


def command_violation(
    block: CommandBlock, latest: Latest, limits: GateLimits, sent: Sent
) -> Decision | None:
    """What is wrong with a reference before it reaches the wire, as a FAULT.

    The device adds kp (theta_ref - theta) and its feedback, so the output is bounded by
    |u| + kp (|theta_ref| + |theta|) + sum max with the largest |theta| of the newest block,
    and its slew likewise, over the border to the last block too; a feedback's slew is bounded
    by the largest value of its sensor in the newest block. A set point must lie inside the
    limit of its sensor, and so must, with some room, the angle to which an angular velocity
    source will have turned the joint, see `readback.travel`.
    """
    misplaced = _misplaced(block, latest, limits)
    if misplaced is not None:
        return misplaced
    kp, output = abs(limits.kp), limits.output
    angle = angle_rate = 0.0
    for i, c in enumerate(limits.channels):
        if c.channel == limits.centring_sensor:
            angle, angle_rate = latest.peak[i], latest.rate[i]
            beyond = _travel_violation(block, latest.last[i], limits, c, sent)
            if beyond is not None:
                return beyond
    bound = (
        float((np.abs(block.u) + kp * np.abs(block.theta_ref)).max())
        + kp * angle
        + limits.authority
    )
    if bound > output.max:
        return _over(output, bound, output.max, "limit", output.unit)
    step = abs(float(block.u[0]) - latest.u) + kp * abs(
        float(block.theta_ref[0]) - latest.theta_ref
    )
    if len(block) > 1:
        u, theta_ref = block.u, block.theta_ref
        steps = np.abs(u[1:] - u[:-1]) + kp * np.abs(theta_ref[1:] - theta_ref[:-1])
        step = max(step, float(steps.max()))
    peaks = {c.channel: latest.peak[i] for i, c in enumerate(limits.channels)}
    turning = sum(a.slew * peaks[a.loop.sensor] for a in limits.feedback)
    slew = step * limits.rate_hz + kp * angle_rate + turning
    if slew > output.max_rate:
        return _over(output, slew, output.max_rate, "rate", f"{output.unit}/s")
    return None


def _travel_violation(
    block: CommandBlock, angle: float, limits: GateLimits, c: ChannelLimit, sent: Sent
) -> Decision | None:
    """A set point or a way that leads the centring sensor c beyond its limit, as a FAULT."""
    furthest = float(np.abs(block.theta_ref).max())
    if furthest > c.max:
        text = (
            f"the set point of {furthest:.4g} {c.unit} is beyond {c.channel}'s limit of {c.max:g}"
        )
        return _fault("set point", f"{text} {c.unit} ({c.reason})", furthest, c.max, c.unit)
    rate = limits.turning / limits.rate_hz
    most = TRAVEL * c.max
    ahead = travel(sent, block, angle, rate, limits.kp) if rate else 0.0
    if ahead > most:
        text = (
            f"the reference would turn {c.channel} to {ahead:.4g} {c.unit}; allowed {most:.4g} "
            f"{c.unit} ({c.reason})"
        )
        return _fault("travel", text, ahead, most, c.unit)
    return None


def _fault(
    what: str, reason: str, number: float = math.nan, limit: float = math.nan, unit: str = ""
) -> Decision:
    return Decision(State.FAULT, Act.ZERO, False, what, reason, number, limit, unit)


def _over(c: ChannelLimit, number: float, limit: float, what: str, unit: str) -> Decision:
    text = f"{c.channel} at {number:.4g} {unit} is over its {what} of {limit:g} {unit} ({c.reason})"
    return _fault(what, text, number, limit, unit)


def _wrong_state(state: State, what: str, needed: State) -> Decision:
    return _fault("state", f"{what} in state {state.value}; possible only in {needed.value}")
