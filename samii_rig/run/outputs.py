"""What a plan leaves open on a rig with several outputs: all of them are driven, or none.

A plan that asks something of one joint says nothing of the others, which the device drives as
well: each rests in the middle of its own centring loop meanwhile.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from samii_rig.rig.schema import Rig
from samii_rig.run.plan import Output, Plan, PlannedSegment
from samii_rig.safety.limits import GateLimits, gate_limits
from samii_rig.types import Float


def at_rest(rig: Rig, actuator: str) -> Output:
    """An output with its rig file's own loop; kp = 0 where it has none."""
    loop = rig.centring_of(actuator)
    if loop is None:
        return Output(actuator, 0.0, rig.sensor[0].name)
    return Output(actuator, loop.kp, loop.sensor)


def completed(plan: Plan, rig: Rig) -> Plan:
    """The plan with an output for each actuator of the rig, in the rig file's order.

    What it says itself stays; an actuator that it leaves out has its own loop and rests at 0. A
    plan for a rig with one actuator is returned as it is.
    """
    names = tuple(a.name for a in rig.actuator)
    given = {o.actuator: o for o in plan.outputs}
    if tuple(given) == names:
        return plan
    first, *beside = (given.get(name) or at_rest(rig, name) for name in names)
    places = [names.index(name) for name in given]
    segments = tuple(_spread(s, places, len(names), tuple(given)) for s in plan.segments)
    return replace(
        plan,
        actuator=first.actuator,
        kp=first.kp,
        centring_sensor=first.centring_sensor,
        beside=tuple(beside),
        segments=segments,
    )


def _spread(s: PlannedSegment, places: list[int], n: int, given: tuple[str, ...]) -> PlannedSegment:
    def spread(x: Float) -> Float:
        out = np.zeros((len(x), n))
        out[:, places] = columns(x)
        return out

    excited = s.excited or given
    return replace(s, u=spread(s.u), theta_ref=spread(s.theta_ref), excited=excited)


def columns(x: Float) -> Float:
    """(n, k) of a reference (n,) or (n, k)."""
    return x[:, None] if x.ndim == 1 else x


def plan_limits(plan: Plan, rig: Rig, heartbeat_age: float = math.inf) -> tuple[GateLimits, ...]:
    """The gate's limits of each output of a completed plan, the others driven beside it."""
    outputs = plan.outputs
    return tuple(
        gate_limits(
            rig,
            o.actuator,
            o.kp,
            o.centring_sensor,
            heartbeat_age,
            tuple(other.actuator for other in outputs if other is not o),
        )
        for o in outputs
    )
