"""What stands between a simulated rig and the numbers: converters, the device's own loops, the
drive. Tables for the kernel, of one output each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError
from samii_rig.model.feedback import sections
from samii_rig.model.sampled import filter_response
from samii_rig.rig.schema import (
    SOURCES,
    AccelerationSource,
    AngularVelocitySource2,
    DisplacementSource,
    Feedback,
    Rig,
)
from samii_rig.types import Flags, Float
from sim import kernel
from sim.settings import SimSettings

SECOND_ORDER = (AngularVelocitySource2, DisplacementSource, AccelerationSource)
NEVER = np.iinfo(np.int64).max  # a sample that does not come


def converters(rig: Rig, settings: SimSettings, actuator: int = 0) -> kernel.Converters:
    """What stands between the analogue values and the numbers; of one output."""
    sensors, spec = rig.sensor, rig.actuator[actuator]
    ideal = 0.0 if not settings.noise else 1.0

    def sample(times: Mapping[str, float], name: str) -> int:
        return int(np.ceil(times[name] * rig.rate_hz)) if name in times else NEVER

    hum, hum_rate = np.zeros(len(sensors)), np.zeros(len(sensors))
    for i, s in enumerate(sensors):
        if s.name in settings.hum:
            tone = settings.hum[s.name]
            passed = filter_response(s, np.array([2j * np.pi * tone.frequency_hz]))
            hum[i] = tone.amplitude * abs(passed[0])
            hum_rate[i] = 2 * np.pi * tone.frequency_hz / rig.rate_hz
    return kernel.Converters(
        np.array([s.resolution * ideal for s in sensors]),
        np.array([s.low for s in sensors]),
        np.array([s.high for s in sensors]),
        np.array([s.noise_rms * ideal for s in sensors]),
        np.array([s.offset * ideal for s in sensors]),
        hum,
        hum_rate,
        np.array([sample(settings.stuck, s.name) for s in sensors], dtype=np.int64),
        np.array([sample(settings.nan, s.name) for s in sensors], dtype=np.int64),
        spec.resolution,
        spec.low,
        spec.high,
    )


def filters(rig: Rig, feedback: Sequence[Feedback]) -> kernel.Filters:
    """The loops as tables, from zero state."""
    names = [s.name for s in rig.sensor]
    rows = [sections(f, rig.rate_hz) for f in feedback]
    table = np.concatenate([np.zeros((0, 5)), *rows])
    return kernel.Filters(
        np.array([names.index(f.sensor) for f in feedback], dtype=np.int64),
        np.array([f.max for f in feedback], dtype=np.float64),
        np.cumsum([0, *(len(r) for r in rows)], dtype=np.int64),
        table,
        np.zeros((len(table), 2)),
    )


def drive(rig: Rig, settings: SimSettings, actuator: int = 0) -> kernel.Drive:
    """What acts on one output's drive beside the command."""
    # The disturbance passes the source's lag; a source without a first-order one lets it through.
    sources, name = [e for e in rig.element if isinstance(e, SOURCES)], rig.actuator[actuator].name
    own = next(e for e in sources if e.input == name)
    rubs = settings.coulomb_friction
    lag = None if isinstance(own, SECOND_ORDER) else own.p
    p = lag.value if lag else np.inf
    return kernel.Drive(
        # White noise: its mean over `inner` steps has this rms.
        settings.disturbance_rms * np.sqrt(settings.inner),
        rubs.get(name, 0.0) if isinstance(rubs, dict) else rubs,
        float(np.exp(-p / (rig.rate_hz * settings.inner))),
    )


def control(rig: Rig, name: str, loop: DeviceLoop, patience: int) -> kernel.Control:
    """The loop of output `name` for the kernel; DeviceError for one that cannot be closed."""
    names = [s.name for s in rig.sensor]
    for sensor in (loop.sensor, *(f.sensor for f in loop.feedback)):
        if sensor not in names:
            raise DeviceError(f"{name}: no sensor {sensor!r} to close the loop on")
    for f in loop.feedback:
        if f.actuator != name:
            raise DeviceError(f"{name}: feedback {f.name} drives {f.actuator}, not this")
    numbers = (loop.kp, loop.max_output, loop.max_rate, loop.max_angle)
    if not all(x >= 0.0 for x in numbers) or not np.isfinite(loop.kp):
        raise DeviceError(f"{name}: negative or missing number in {loop}")
    return kernel.Control(
        names.index(loop.sensor),
        float(loop.kp),
        float(loop.max_output),
        float(loop.max_rate) / rig.rate_hz,
        float(loop.max_angle),
        patience,
    )


def references(queue: Sequence[CommandBlock], first: int, n: int) -> tuple[Float, Float, Flags]:
    """u, theta_ref (n,) of the samples from `first`, and 1 where the queue holds one."""
    u, theta_ref, given = np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.uint8)
    for block in queue:
        low, high = max(block.first, first), min(block.first + len(block), first + n)
        if low < high:
            here, there = slice(low - first, high - first), slice(low - block.first, None)
            u[here] = block.u[there][: high - low]
            theta_ref[here] = block.theta_ref[there][: high - low]
            given[here] = 1
    return u, theta_ref, given


def check_block(name: str, block: CommandBlock) -> None:
    """DeviceError for a reference of output `name` that is none."""
    if block.u.shape != block.theta_ref.shape or block.u.ndim != 1:
        raise DeviceError(f"{name}: u and theta_ref of a block differ in length")
    if not (np.isfinite(block.u).all() and np.isfinite(block.theta_ref).all()):
        raise DeviceError(f"{name}: a reference sample is not a finite number")
