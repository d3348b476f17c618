"""The device's own ways to null, tried: its deadman, its emergency input, its reset.

For a device at the bench whose valve is not connected. The output is told nothing but null, through
the gate; what acts is the device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from samii_rig.devices.channels import centring_name
from samii_rig.devices.protocols import CommandBlock, OpenRig, Reports
from samii_rig.errors import DeviceError, GateError, SamiiRigError
from samii_rig.rig.schema import Rig
from samii_rig.run.check import Check
from samii_rig.run.session import listen, opened
from samii_rig.safety.gate import Gate
from samii_rig.safety.lane import FLIGHT
from samii_rig.safety.limits import MAX_AHEAD, gate_limits
from samii_rig.types import Quality, SampleBlock

AHEAD = 0.025  # s from a reference to its first sample; half the shortest deadman there is
LATER = 0.1  # s by which null may come after the deadman: the latency to the device and back
WITHIN = 60.0  # s in which a person opens a contact or presses a button
LOOK = 0.25  # s between two looks at whether it was done
UNPLUGGED = "do not connect a valve to this device"


def own_protections(rig: Rig, ask: Callable[[str], None]) -> Iterator[Check]:
    """Each protection, as it was tried; `ask` tells the person what to do."""
    try:
        with opened(rig) as device:
            yield _deadman(rig, device)
            yield from _emergency(rig, device, ask)
            yield _reset(device, ask)
        # Whoever drives it next finds it at null, or is told why not.
        with opened(rig) as device:
            if np.any(_output(rig, listen(device, LOOK))[0]):
                yield Check("after reset", "bad", "the output is not at null", UNPLUGGED)
    except SamiiRigError as error:
        yield Check.failed("protections", error)


def _output(rig: Rig, block: SampleBlock) -> tuple[np.ndarray, np.ndarray]:
    """(n,) the output that is furthest from null, and (n,) whether the device itself holds all of
    them where they were not asked to be."""
    names = [c.name for c in block.channels]
    at = [names.index(a.name) for a in rig.actuator]
    return (
        np.abs(block.values[:, at]).max(axis=1),
        ((block.quality[:, at] & Quality.LIMITED) != 0).all(axis=1),
    )


def _armed(rig: Rig, device: OpenRig) -> tuple[Gate, int]:
    """A gate that is armed with all loops open, and the newest sample's number; GateError, or the
    device's DeviceError, if it is refused."""
    names = [a.name for a in rig.actuator]
    limits = tuple(
        gate_limits(
            rig,
            name,
            0.0,
            centring_name(rig, name),
            beside=tuple(other for other in names if other != name),
        )
        for name in names
    )
    gate = Gate(device.actuator, limits, device.sensor.channels, lambda _: None)
    block = listen(device, LOOK)
    gate.observe(block, device.clock.now())
    gate.arm(device.clock.now())
    return gate, int(block.sequence[-1])


def _deadman(rig: Rig, device: OpenRig) -> Check:
    """A reference of null, sent once and as far ahead as the gate allows: it must not last."""
    what, deadman = "deadman", device.actuator.deadman
    if deadman is None:
        return Check(what, "look", "the device declares none", "the gate never arms it")
    try:
        gate, newest = _armed(rig, device)
        gate.start(device.clock.now())
        first = newest + 1 + math.ceil(AHEAD * rig.rate_hz)
        rest = np.zeros(math.floor((MAX_AHEAD - 2 * AHEAD) * rig.rate_hz))
        blocks = tuple(CommandBlock(first, rest, rest) for _ in rig.actuator)
        gate.write(blocks, device.clock.now())
    except GateError as error:
        return Check.failed(what, error)
    block = listen(device, deadman + MAX_AHEAD + LATER + FLIGHT)
    gate.stop("the deadman was tried", device.clock.now())
    v, held = _output(rig, block)
    if np.any(v):
        return Check(what, "bad", "the output left null", UNPLUGGED)
    if not held.any():
        return Check(what, "bad", f"not after {deadman:g} s without a reference", UNPLUGGED)
    took = (int(block.sequence[np.argmax(held)]) - newest) / rig.rate_hz
    found = f"null {1e3 * took:.0f} ms after the only reference, {1e3 * deadman:.0f} are declared"
    if took > deadman + LATER:
        return Check(what, "bad", found, UNPLUGGED)
    return Check(what, "good", found)


def _emergency(rig: Rig, device: OpenRig, ask: Callable[[str], None]) -> Iterator[Check]:
    """Open, it holds null; closed again, the device can be armed."""
    what = "emergency"
    ask("open the emergency input now")
    for _ in _looks(device):
        v, held = _output(rig, listen(device, LOOK))
        if held[-1]:
            break
    else:
        found = f"nothing acted within {WITHIN:g} s"
        yield Check(what, "bad", found, "wire a contact that opens to the emergency input")
        return
    reason = _last_reason(device)
    if np.any(v) or _arms(rig, device):
        yield Check(what, "bad", "it was seen, and the output can still be armed", UNPLUGGED)
        return
    yield Check(what, "good", f"null{reason}, and no arming")
    ask("close the emergency input again")
    for _ in _looks(device):
        if _arms(rig, device):
            yield Check("cleared", "good", "it can be armed again")
            return
    yield Check("cleared", "bad", f"not within {WITHIN:g} s", "is the emergency input closed?")


def _looks(device: OpenRig) -> Iterator[None]:
    """One after another, as long as a person may need; each `listen` takes LOOK."""
    end = device.clock.now() + round(WITHIN * 1e9)
    while device.clock.now() < end:
        yield


def _arms(rig: Rig, device: OpenRig) -> bool:
    """Whether the device takes its limits, which clears a trip whose cause is gone."""
    try:
        gate, _ = _armed(rig, device)
    except (GateError, DeviceError):
        device.actuator.zero()
        return False
    gate.stop("arming was tried", device.clock.now())
    return True


def _last_reason(device: OpenRig) -> str:
    """What the device itself says about its last change, if it says such things."""
    events = device.sensor.events() if isinstance(device.sensor, Reports) else []
    reasons = [str(e.fields["reason"]) for e in events if "reason" in e.fields]
    return f" by {reasons[-1]}" if reasons else ""


def _reset(device: OpenRig, ask: Callable[[str], None]) -> Check:
    """The device says itself that it has started again."""
    what = "reset"
    ask("press the device's reset button, or halt its processor with a debugger")
    try:
        for _ in _looks(device):
            listen(device, LOOK)
    except DeviceError as error:
        if "rebooted" in str(error):
            return Check(what, "good", str(error).partition("; find out")[0])
        return Check.failed(what, error)
    return Check(what, "look", f"none was seen within {WITHIN:g} s", "its watchdog was not tried")
