"""A rig opened for a short job at the bench: looking, a small move, a calibration.

The same latch, lock, gate and recorder as a whole run has; only the prediction is missing, so the
moves are bounded here.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from samii_rig.devices.opening import close_device, open_device
from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import DeviceError, InputError
from samii_rig.files import make_folder
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.rig.schema import Rig
from samii_rig.run.ending import finish
from samii_rig.run.loop import run
from samii_rig.run.plan import Output, Plan, PlannedSegment
from samii_rig.run.priority import prioritised
from samii_rig.run.sink import recorded_channels
from samii_rig.safety.latch import Latch
from samii_rig.safety.limits import gate_limits
from samii_rig.types import Float, SampleBlock, StopRecord

FASTEST = 0.2  # of the centring sensor's unit per s, at which a person can still step back
SPEED = 0.05  # the same, where nothing is asked for
FURTHEST = 0.8  # of the centring sensor's limit
# How near a move comes to where it was to go: parts of the way, of which five time constants leave
# 0.7 %, and multiples of what the sensor cannot resolve.
NEAR, NEAR_NOISE = 0.02, 5.0
SETTLE = 0.5  # s at the end of a move, and so many time constants of the centring loop
SETTLE_CONSTANTS, LONGEST_SETTLE = 5.0, 10.0  # and s
PULSE = 0.2  # s of the pulse that shows the encoder's sign
PULSE_PART = 0.05  # of the actuator's limit


@dataclass(frozen=True, slots=True)
class Move:
    """A small move: where the joint was, where it is, and how it ended.

    to, within : where it was to go and how near that is, in `unit`; NaN and inf where the move has
    no such place.
    """

    before: float
    after: float
    unit: str
    stop: StopRecord
    recording: Path
    to: float = math.nan
    within: float = math.inf

    @property
    def reached(self) -> bool:
        """Whether it went through, and the joint is where it was to go."""
        there = math.isnan(self.to) or abs(self.after - self.to) <= self.within
        return self.stop.status == "completed" and there


@contextmanager
def opened(rig: Rig) -> Iterator[OpenRig]:
    """The rig's device for this program alone.

    GateError while a fault is latched, DeviceError if it does not open or is driven already.
    """
    latch = Latch(rig.name, rig.device.driver)
    latch.refuse()
    device = open_device(rig, {})
    try:
        with latch.held(device):
            yield device
    finally:
        close_device(device)


def listen(device: OpenRig, seconds: float) -> SampleBlock:
    """All samples of the next `seconds`; DeviceError if none comes."""
    device.sensor.read()
    blocks: list[SampleBlock] = []
    until = device.clock.now() + round(seconds * 1e9)
    while device.clock.now() < until:
        device.clock.sleep(0.02)
        block = device.sensor.read()
        if len(block):
            blocks.append(block)
    if not blocks:
        raise DeviceError(f"the device gave no sample in {seconds:g} s")
    return SampleBlock(
        blocks[0].channels,
        np.concatenate([b.time for b in blocks]),
        np.concatenate([b.sequence for b in blocks]),
        np.concatenate([b.values for b in blocks]),
        np.concatenate([b.quality for b in blocks]),
    )


def column(block: SampleBlock, name: str) -> Float:
    """(n,) values of one channel."""
    return block.values[:, [c.name for c in block.channels].index(name)]


def jog(rig: Rig, rig_toml: str, to: float, speed: float, folder: Path) -> Move:
    """Bring the joint of the centring loop to the angle `to` at `speed`, through the gate.

    InputError for a rig without centring, an angle or a speed that is too large.
    """
    if rig.centring is None:
        raise InputError(rig.name, "centring", None, "a loop that can bring the joint somewhere")
    sensor, name = rig.centring.sensor, rig.actuator[0].name
    limits = gate_limits(rig, name, rig.centring.kp, sensor)
    most = min((c.max for c in limits.sensors if c.channel == sensor), default=np.inf) * FURTHEST
    unit = rig.units()[sensor]
    if not abs(to) <= most:
        raise InputError("jog", "--to", to, f"at most {most:.3g} {unit}: 80 % of {sensor}'s limit")
    if not 0.0 < speed <= FASTEST:
        raise InputError("jog", "--speed", speed, f"above 0 and at most {FASTEST:g} {unit}/s")
    with opened(rig) as device:
        before = float(np.mean(column(listen(device, 0.1), sensor)))
        n = max(2, round(abs(to - before) / speed * rig.rate_hz * np.pi / 2))
        way = 0.5 - 0.5 * np.cos(np.pi * np.arange(n) / (n - 1))
        pull = abs(limits.turning * rig.centring.kp)
        settle = min(SETTLE_CONSTANTS / pull, LONGEST_SETTLE) if pull else SETTLE
        rest = np.full(round(max(settle, SETTLE) * rig.rate_hz), to)
        theta_ref = np.concatenate([before + (to - before) * way, rest])
        kp = rig.centring.kp
        output = Output(name, kp, sensor)
        move = _moved(rig, rig_toml, device, 0.0 * theta_ref, theta_ref, output, folder)
        reads = next(x for x in rig.sensor if x.name == sensor)
        blind = NEAR_NOISE * math.hypot(reads.noise_rms, reads.resolution)
        return replace(move, to=to, within=max(NEAR * abs(to - before), blind))


def pulse(rig: Rig, rig_toml: str, folder: Path, actuator: str) -> Move:
    """A short push with the actuator's loop open, from which the sign of its encoder is seen."""
    loop = rig.centring_of(actuator)
    assert loop is not None
    n = round(PULSE * rig.rate_hz)
    limits = gate_limits(rig, actuator, 0.0, loop.sensor)
    u = PULSE_PART * limits.output.max * np.sin(np.pi * np.arange(n) / n) ** 2
    u = np.concatenate([u, np.zeros(round(SETTLE * rig.rate_hz))])
    with opened(rig) as device:
        return _moved(rig, rig_toml, device, u, 0.0 * u, Output(actuator, 0.0, loop.sensor), folder)


def still(rig: Rig, rig_toml: str, seconds: float, folder: Path, actuator: str) -> Move:
    """An output live at zero with its loop open: what moves now, its valve's null moves."""
    loop = rig.centring_of(actuator)
    assert loop is not None
    u = np.zeros(round(seconds * rig.rate_hz))
    output = Output(actuator, 0.0, loop.sensor)
    with opened(rig) as device:
        return _moved(rig, rig_toml, device, u, u, output, folder)


def _moved(
    rig: Rig,
    rig_toml: str,
    device: OpenRig,
    u: Float,
    theta_ref: Float,
    output: Output,
    folder: Path,
) -> Move:
    """A move of one output; of a rig with several the others rest in their own loops."""
    sensor, actuator = output.centring_sensor, output.actuator
    level = float(np.abs(u).max())
    segment = PlannedSegment(
        "move",
        "transient",
        level,
        rig.units()[actuator],
        0,
        u,
        theta_ref,
        (0.0, 1.0),
        np.full(len(u), np.nan),
    )
    plan = Plan("jog", rig.rate_hz, actuator, output.kp, sensor, (segment,), 0)
    before = float(np.mean(column(listen(device, 0.1), sensor)))
    make_folder("--out", folder)
    path = folder / f"{datetime.now(UTC):%Y-%m-%dT%H-%M-%S-%f}_jog.mcap"
    real = device.metadata.get("clock") != "simulated"
    notes = {
        "experiment": "jog",
        "device": device.description,
        **{f"device_{key}": value for key, value in device.metadata.items()},
    }
    with RunWriter(
        path,
        recorded_channels(rig, plan, device.sensor.channels),
        rig.rate_hz,
        Origin(rig_toml, metadata=notes),
    ) as writer:
        with prioritised() if real else contextlib.nullcontext():
            stop = run(
                plan,
                rig,
                device,
                writer,
                latch=Latch(rig.name, rig.device.driver).set if real else None,
            )
        finish(writer, stop)
    after = float(np.mean(column(listen(device, 0.1), sensor)))
    return Move(before, after, rig.units()[sensor], stop, path)


def sleep_lateness(n: int = 100, seconds: float = 0.004) -> Float:
    """(n,) s by which sleeps of a tick end too late on this machine now."""
    late = []
    with prioritised():
        for _ in range(n):
            due = time.monotonic() + seconds
            time.sleep(seconds)
            late.append(time.monotonic() - due)
    return np.array(late)
