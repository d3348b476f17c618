"""Sweeps of the simulated rig as recordings: converters, loop, sensor noise and a disturbance."""

from __future__ import annotations

import numpy as np

from experiments.swept_sine import SweptSine
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.rig.schema import Rig
from samii_rig.types import Recording, Segment
from sim.rig import open_rig

DISTURBANCE = 0.01  # V rms, at the input


def swept(
    rig: Rig,
    level: float,
    *,
    repeats: int,
    duration: float,
    ring_down: float,
    seed: int = 1,
    rig_toml: str = "",
    actuator: str = "v_2",
    source: str = "",
) -> Recording:
    """Sweeps of 0.8 to 35 Hz at one level, V, each from rest to rest; s."""
    plan = SweptSine(
        experiment="swept_sine", name="short", actuator=actuator, unit="V", sweep="logarithmic",
        start_hz=0.8, stop_hz=35.0, duration=duration, ramp=0.5, lead_in=1.0, ring_down=ring_down,
        amplitudes=(level,), repeats=repeats,
    ).plan(rig)  # fmt: skip
    device = open_rig(rig, {"seed": seed, "disturbance_rms": DISTURBANCE})
    device.actuator.configure(DeviceLoop(plan.centring_sensor, plan.kp, 10.0, 1e9, 1e9))
    u = np.concatenate([s.u for s in plan.segments])
    device.actuator.write(CommandBlock(0, u, np.zeros_like(u)))
    device.clock.sleep(len(u) / rig.rate_hz)
    b = device.sensor.read()
    ends = np.cumsum([len(s.u) for s in plan.segments])
    segments = tuple(
        Segment(f"sweep {i + 1}", s.kind, int(end) - len(s.u), int(end), s.level, s.unit, i)
        for i, (s, end) in enumerate(zip(plan.segments, ends, strict=True))
    )
    return Recording(
        b.channels, rig.rate_hz, b.time, b.sequence, b.values, b.quality, segments,
        rig_toml=rig_toml, source=source or f"run at {level:g} V",
    )  # fmt: skip
