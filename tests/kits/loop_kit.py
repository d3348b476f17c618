"""What tests of the loop share."""

from __future__ import annotations

import time

import numpy as np
from fake_device import RATE, FakeDevice, fake_rig
from wait_kit import patient

from samii_rig.devices.clock import MonotonicClock
from samii_rig.devices.protocols import OpenRig
from samii_rig.rig.schema import Rig
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.signal.excitation import swept_sine


def plan(level=1.0, segments=2, duration=0.6):
    u, f = swept_sine(RATE, 2.0, 20.0, duration, ramp=0.1, lead_in=0.1, ring_down=0.3)
    parts = tuple(
        PlannedSegment(
            f"burst_{i}", "burst", level, "V", i, level * u, np.zeros_like(u), (2.0, 20.0), f
        )
        for i in range(segments)
    )
    return Plan("sweep", RATE, "v", 4.0, "theta", parts, 0)


class Memory:
    """A sink that keeps everything."""

    def __init__(self):
        self.blocks, self.events, self.segments = [], [], []

    def write(self, block):
        self.blocks.append(block)

    def event(self, time, name, payload):
        self.events.append((name, payload))

    def segment(self, segment):
        held = self.column("sequence")
        assert held[-1] >= segment.stop - 1, "a segment before its samples"
        self.segments.append(segment)

    def column(self, name):
        if name in ("sequence", "time"):
            return np.concatenate([getattr(b, name) for b in self.blocks])
        i = [c.name for c in self.blocks[0].channels].index(name)
        return np.concatenate([b.values[:, i] for b in self.blocks])


class after:  # noqa: N801 an event that sets itself
    """Stands for threading.Event: set once asked often enough."""

    def __init__(self, seconds):
        self.left = round(seconds / 0.04)

    def is_set(self):
        self.left -= 1
        return self.left < 0


class Broken(Memory):
    """A sink that fails in one method, once a run is under way."""

    def __init__(self, method, error):
        super().__init__()
        self.method, self.error = method, error

    def write(self, block):
        super().write(block)
        if self.method == "write" and len(self.blocks) > 2:
            raise self.error

    def event(self, time, name, payload):
        super().event(time, name, payload)
        if self.method == name:
            raise self.error

    def segment(self, segment):
        super().segment(segment)
        if self.method == "segment":
            raise self.error


PATIENCE = 0.5  # s for which a busy machine may hold up what runs by its clock


def patient_rig() -> Rig:
    """The fake rig, for `RealTime`: neither its deadman nor its sensors are sooner than that."""
    rig = patient(fake_rig(), PATIENCE)
    own = tuple(a.model_copy(update={"deadman": PATIENCE}) for a in rig.actuator)
    return rig.model_copy(update={"actuator": own})


class RealTime(FakeDevice):
    """The same device, on the host's clock."""

    def __init__(self):
        super().__init__()
        self.deadman = PATIENCE
        self.clock, self.zero_at = MonotonicClock(), time.monotonic_ns()

    def read(self):
        FakeDevice.sleep(self, (self.clock.now() - self.zero_at) * 1e-9 - self.time * 1e-9)
        return super().read()

    def open(self):
        return OpenRig(self, self, self.clock, "fake in real time", {})
