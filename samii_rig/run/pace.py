"""How often the loop looks at the device, and how far ahead it sends the reference.

A device that has heard nothing for its deadman's time drops its output, so the loop must feed it
in time even when the machine is late. On real time the tick follows from that:

    tick = PART (deadman - LATE)

at 50 ms a tick of 3 ms, fed at every one of them: 40 ms late on top of it, and the rest is for
the way to the device and for its counting in whole samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import InputError
from samii_rig.safety.limits import MAX_AHEAD

TICK = 0.02  # s between looks at the device, where its deadman allows that
LATE = 0.04  # s that the host may be late without any consequence
PART = 0.3  # of what the deadman leaves beside LATE
# A tick takes at least this part of a deadman that leaves nothing beside LATE: the host may
# then be late by the rest of the deadman only.
LEAST_PART = 0.08
LEAST_AHEAD = 0.05  # s of reference that the device still has when the next is sent
# On real time also for a host that is LATE, and for samples that come in blocks of up to 10 ms.
SENT_AHEAD = 0.1
# A tick that is asked for may take this part of the deadman's time, so that one late tick does
# not trip it. Simulated time is never late and may use more of it, which saves ticks.
DEADMAN_PART = 0.5
DEADMAN_PART_SIMULATED = 0.8
# s after its time from which a tick counts as late: far above what a scheduler does (0.1 ms),
# far below what has a consequence.
COUNTS_AS_LATE = 0.01


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """Pace of the loop, in s.

    tick : between looks at the device; None for what its deadman asks for.
    ahead : reference that the device still holds at the next tick; None for 0.1, on simulated
        time 0.05. report : between progress reports.
    heartbeat_age : largest silence of the operator's client; inf where none is needed.
    """

    tick: float | None = None
    ahead: float | None = None
    report: float = 0.25
    heartbeat_age: float = math.inf


def choose_tick(settings: LoopSettings, device: OpenRig, rate_hz: float, simulated: bool) -> float:
    """The tick to use; InputError if the one asked for would starve the deadman."""
    deadman = device.actuator.deadman
    part = DEADMAN_PART_SIMULATED if simulated else DEADMAN_PART
    most = math.inf if deadman is None else part * deadman
    # The rest of what may be sent ahead is left to the tick; a sample is for rounding up.
    most = min(most, MAX_AHEAD / 2 - 1.0 / rate_hz)
    if settings.tick is None:
        if simulated:
            return most
        if deadman is not None:
            most = min(most, max(PART * (deadman - LATE), LEAST_PART * deadman))
        return min(TICK, most)
    if not 0.0 < settings.tick <= most:
        raise InputError("loop", "tick", settings.tick, f"above 0 and at most {most:g} s")
    return settings.tick


def choose_ahead(settings: LoopSettings, simulated: bool) -> float:
    """The lead of the reference, s; InputError if the one asked for is none to run on."""
    if settings.ahead is None:
        return LEAST_AHEAD if simulated else SENT_AHEAD
    if not LEAST_AHEAD <= settings.ahead <= MAX_AHEAD / 2:
        expected = f"{LEAST_AHEAD:g} to {MAX_AHEAD / 2:g} s"
        raise InputError("loop", "ahead", settings.ahead, expected)
    return settings.ahead
