"""What stands between a rig and a good run: found, judged, with the remedy in words."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import GateError, SamiiRigError
from samii_rig.rig.schema import Rig
from samii_rig.run.check import Check
from samii_rig.run.priority import prioritised
from samii_rig.run.protections import own_protections
from samii_rig.run.session import (
    PULSE,
    PULSE_PART,
    column,
    listen,
    opened,
    pulse,
    sleep_lateness,
)
from samii_rig.safety.latch import Latch
from samii_rig.safety.limits import gate_limits
from samii_rig.units import pretty

LISTEN = 2.0  # s
SLEEP_LATE = 0.01  # s that a sleep may end too late at worst
LATENCY_TIMER = 1  # ms; adapters come with 16, longer than a tick
DISK = 16 << 20  # bytes written to learn how fast the disk is
SLOWEST = 5e6  # bytes/s; a rig of 8 channels at 1 kHz writes 0.1e6
SLOWEST_SYNC = 1.0  # s
FREE = 1 << 30  # bytes
NOISE = 3.0  # times the rig file's that a sensor at rest may show, or less than one of it
MOVED = (0.3, 3.0)  # of the predicted travel of the pulse


def examine(
    rig: Rig, rig_toml: str, folder: Path, *, move: bool, protections: Callable[[str], None] | None
) -> Iterator[Check]:
    """All checks, as they are made; `move` pushes the joint a little to see the encoder's sign.

    protections : tells the person what to do, while the device's own ways to null are tried; None
        where they are not.
    """
    yield _machine()
    yield _disk(folder)
    yield from _latency_timers(rig)
    yield from _can(rig)
    fault = Latch(rig.name, rig.device.driver).fault
    if fault:
        remedy = "look at the rig, then samii-rig clear-fault"
        yield Check("fault", "bad", f"latched since {fault.time}: {fault.reason}", remedy)
        return
    try:
        with opened(rig) as device:
            yield Check("device", "good", device.description)
            yield from _samples(rig, device)
    except (SamiiRigError, GateError) as error:
        yield Check.failed("device", error)
        return
    if protections:
        yield from own_protections(rig, protections)
    if move:
        for actuator in rig.actuator:
            yield _sign(rig, rig_toml, folder, actuator.name)


def _machine() -> Check:
    late = sleep_lateness()
    with prioritised() as granted:
        pass
    found = f"sleeps end {1e3 * np.median(late):.2f} ms late, {1e3 * late.max():.1f} ms at worst"
    if late.max() > SLEEP_LATE:
        return Check("clock", "bad", found, "end other programs, or take a quieter machine")
    if not granted:
        remedy = "allow it: a line `USER - rtprio 1` in /etc/security/limits.conf, log in again"
        return Check("clock", "look", f"{found}; no real-time priority", remedy)
    return Check("clock", "good", f"{found}; real-time priority granted")


def _disk(folder: Path) -> Check:
    data = os.urandom(1 << 20)
    probe = folder / f".doctor_{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        start = time.monotonic()
        with probe.open("wb") as file:
            for _ in range(DISK >> 20):
                file.write(data)
            file.flush()
            sync = time.monotonic()
            os.fsync(file.fileno())
        end = time.monotonic()
    except OSError as error:
        return Check(
            "disk", "bad", f"{folder}: {error.strerror}", "record to another folder: --out"
        )
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    rate, free = DISK / (end - start), shutil.disk_usage(folder).free
    found = f"{rate / 1e6:.0f} MB/s, sync {end - sync:.2f} s, {free / 1e9:.1f} GB free in {folder}"
    if rate < SLOWEST or end - sync > SLOWEST_SYNC:
        return Check("disk", "look", found, "record to a local disk, not over a network")
    if free < FREE:
        return Check("disk", "look", found, "make room, or record to another folder: --out")
    return Check("disk", "good", found)


def _texts(value: object) -> Iterator[tuple[str, str]]:
    """All (key, text) of a driver's settings, nested tables too."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if isinstance(inner, str):
                yield str(key), inner
            yield from _texts(inner)


def _latency_timers(rig: Rig) -> Iterator[Check]:
    """Adapters of one kind gather bytes for 16 ms unless they are told not to."""
    for key, port in _texts(rig.device.settings):
        timer = Path("/sys/bus/usb-serial/devices") / Path(os.path.realpath(port)).name
        if key != "port" or not (timer / "latency_timer").exists():
            continue
        ms = int((timer / "latency_timer").read_text())
        if ms > LATENCY_TIMER:
            remedy = f"echo {LATENCY_TIMER} | sudo tee {timer / 'latency_timer'}"
            yield Check("latency timer", "bad", f"{port} gathers bytes for {ms} ms", remedy)
        else:
            yield Check("latency timer", "good", f"{port}: {ms} ms")


def _can(rig: Rig) -> Iterator[Check]:
    for key, channel in _texts(rig.device.settings):
        state = Path("/sys/class/net") / channel / "operstate"
        if key != "channel" or not channel.startswith(("can", "vcan")):
            continue
        if not state.exists():
            yield Check("CAN", "bad", f"no interface {channel}", "ip link shows what there is")
            continue
        # A virtual one says "unknown" while it works.
        up = state.read_text().strip() in ("up", "unknown")
        remedy = f"sudo ip link set {channel} up type can bitrate 1000000"
        yield Check(
            "CAN",
            "good" if up else "bad",
            f"{channel} {'up' if up else 'down'}",
            "" if up else remedy,
        )


def _samples(rig: Rig, device: OpenRig) -> Iterator[Check]:
    block = listen(device, LISTEN)
    span = int(block.sequence[-1] - block.sequence[0])
    lost = span + 1 - len(block)
    rate = span / ((block.time[-1] - block.time[0]) * 1e-9)
    found = f"{rate:.2f} samples/s, {lost} of {span + 1} samples lost"
    if lost:
        yield Check("samples", "bad", found, "check the cable and its shield")
    elif abs(rate / rig.rate_hz - 1.0) > 1e-3:
        yield Check(
            "samples", "bad", found, f"the rig file says {rig.rate_hz:g} Hz: correct rate_hz"
        )
    else:
        yield Check("samples", "good", found)
    n = np.arange(len(block))
    for s in rig.sensor:
        x = column(block, s.name)
        if not np.isfinite(x).all():
            yield Check(s.name, "bad", "gives no number", "check its plug and its supply")
            continue
        noise = float(np.std(x - np.polyval(np.polyfit(n, x, 1), n)))
        expected = s.own_noise
        unit = pretty(s.unit)
        found = f"at {np.mean(x):.3g} {unit}, noise {noise:.2g} {unit}"
        found += f", by the rig file {expected:.2g} {unit}"
        if noise > NOISE * expected:
            yield Check(s.name, "look", found, "keep the rig still; check shield and ground")
        elif s.noise_rms > s.resolution and noise < expected / NOISE:
            yield Check(s.name, "look", found, "too quiet: is it plugged in, is its supply on?")
        else:
            yield Check(s.name, "good", found)


def _sign(rig: Rig, rig_toml: str, folder: Path, actuator: str = "") -> Check:
    """With the loop of the actuator (the first by default) open: a wrong sign would make the
    centring drive the joint away."""
    name = actuator or rig.actuator[0].name
    what, loop = "encoder sign", rig.centring_of(name)
    if loop is None:
        whose = "the rig" if len(rig.actuator) == 1 else name
        return Check(what, "look", f"{whose} centres on no encoder", "state [centring]")
    sensor = loop.sensor
    limits = gate_limits(rig, name, loop.kp, sensor)
    if limits.turning == 0.0:
        return Check(what, "look", f"how far {sensor} follows {name} is not known from the model")
    # Half of the pulse's peak over its time, see `session.pulse`.
    expected = limits.turning * 0.5 * PULSE_PART * limits.output.max * PULSE
    try:
        move = pulse(rig, rig_toml, folder, name)
    except SamiiRigError as error:
        return Check.failed(what, error)
    turned = move.after - move.before
    found = f"{sensor} turned by {turned:.2g} {move.unit}, predicted {expected:.2g} {move.unit}"
    if move.stop.status != "completed":
        return Check(what, "bad", f"{move.stop.status}: {move.stop.reason}", "look at the rig")
    part = turned / expected
    if -part > MOVED[0]:
        return Check(what, "bad", found, f"turn the sign of {sensor}'s counts_per_unit")
    if part < MOVED[0]:
        return Check(what, "bad", found, "is the pump on, the valve plugged in, the joint free?")
    if part > MOVED[1]:
        return Check(what, "bad", found, "check counts_per_unit, and K of the rig file")
    return Check(what, "good", found)
