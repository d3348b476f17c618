"""How often the loop looks at the device, and how far ahead it sends the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass

from samii_rig.errors import InputError
from samii_rig.run.limits import MAX_AHEAD
from samii_rig.run.protocols import OpenRig

TICK = 0.02  # s between looks at the device
AHEAD = 0.05  # s of reference that the device still has when the next is sent
# A tick may take this part of the deadman's time, so that one late tick does not trip it.
# Simulated time is never late and may use more of it, which saves ticks.
DEADMAN_PART = 0.5
DEADMAN_PART_SIMULATED = 0.8


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """Pace of the loop, in s.

    tick : between looks at the device; None for 0.02, less if the deadman asks for less,
        more on simulated time. ahead : reference that the device still holds at the next tick.
    report : between progress reports.
    heartbeat_age : largest silence of the operator's client; inf where none is needed.
    """

    tick: float | None = None
    ahead: float = AHEAD
    report: float = 0.25
    heartbeat_age: float = math.inf


def choose_tick(settings: LoopSettings, device: OpenRig, rate_hz: float, simulated: bool) -> float:
    """The tick to use; InputError if the one asked for would starve the deadman."""
    deadman = device.actuator.deadman
    part = DEADMAN_PART_SIMULATED if simulated else DEADMAN_PART
    most = math.inf if deadman is None else part * deadman
    if not AHEAD <= settings.ahead <= MAX_AHEAD / 2:
        expected = f"{AHEAD:g} to {MAX_AHEAD / 2:g} s"
        raise InputError("loop", "ahead", settings.ahead, expected)
    # The rest of what may be sent ahead is left to the tick; a sample is for rounding up.
    most = min(most, MAX_AHEAD / 2 - 1.0 / rate_hz)
    if settings.tick is None:
        return most if simulated else min(TICK, most)
    if not 0.0 < settings.tick <= most:
        raise InputError("loop", "tick", settings.tick, f"above 0 and at most {most:g} s")
    return settings.tick
