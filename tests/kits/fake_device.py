"""A device of fifty lines, theta' = K v, for tests of what stands above a device."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from samii_rig.devices.protocols import CommandBlock, DeviceLoop, OpenRig
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.types import Channel, Quality, SampleBlock

RATE, K = 500.0, 0.5

RIG = """
name = "pendulum"
base = "clamped"
tip = "free"
rate_hz = 500.0

[[element]]
kind = "angular_velocity_source"
name = "source"
input = "v"
K = {value = 0.5, unit = "rad/(s V)", source = "test"}
p = {value = 100.0, unit = "rad/s", source = "test"}

[[element]]
kind = "rigid_link"
name = "link"
L = {value = 0.5, unit = "m", source = "test"}
r = {value = 0.25, unit = "m", source = "test"}
m = {value = 1.0, unit = "kg", source = "test"}
I = {value = 0.1, unit = "kg m^2", source = "test"}

[[sensor]]
kind = "relative_angle"
name = "theta"
across = ["source"]
unit = "rad"
low = -2.0
high = 2.0

[[actuator]]
name = "v"
unit = "V"
low = -10.0
high = 10.0
deadman = 0.05

[centring]
sensor = "theta"
kp = 4.0

[[limit]]
channel = "v"
unit = "V"
max = 5.0
max_rate = 2000.0
reason = "half of the range"

[[limit]]
channel = "theta"
unit = "rad"
max = 0.35
reason = "the frame"
"""


def fake_rig() -> Rig:
    return parse(Rig, RIG, "fake rig")


class FakeDevice:
    """Actuator, sensor and clock in one; `spoil` may change or raise on each block read, `noise`
    is what the sensor adds, for the device's own loop too."""

    name = "v"
    channels = (Channel("v", "V", "command"), Channel("theta", "rad"))

    def __init__(self, spoil: Callable[[SampleBlock], SampleBlock] | None = None) -> None:
        self.deadman: float | None = 0.05
        self.spoil = spoil or (lambda block: block)
        self.noise: Callable[[], float] = lambda: 0.0
        self.loop = DeviceLoop("theta", 0.0, 0.0, 0.0, 0.0)
        self.queue: dict[int, tuple[float, float]] = {}
        self.fed = -(10**9)  # ns of the last write
        self.v = self.theta = 0.0
        self.time = self.taken = 0
        self.rows: list[tuple[int, float, float]] = []
        self.zeros = 0
        self.written: list[CommandBlock] = []
        self.silent = False

    def configure(self, loop: DeviceLoop) -> None:
        self.loop = loop

    def write(self, block: CommandBlock) -> None:
        self.fed = self.time
        self.written.append(block)
        pairs = zip(block.u.tolist(), block.theta_ref.tolist(), strict=True)
        self.queue.update((block.first + i, pair) for i, pair in enumerate(pairs))

    def zero(self) -> None:
        self.zeros += 1
        self.queue.clear()
        self.v = 0.0

    @property
    def live(self) -> bool:
        """Whether the output is, or will by itself become, anything but zero."""
        fresh = self.deadman is None or self.time - self.fed <= self.deadman * 1e9
        return fresh and (self.v != 0.0 or any(u or r for u, r in self.queue.values()))

    def now(self) -> int:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += max(0, round(seconds * 1e9))
        while self.taken * 1e9 / RATE <= self.time:
            reference = self.queue.pop(self.taken, None)
            dead = self.deadman is not None and self.time - self.fed > (self.deadman + 0.1) * 1e9
            self.v, measured = 0.0, self.theta + self.noise()
            if reference is not None and not dead:
                self.v = reference[0] + self.loop.kp * (reference[1] - measured)
            self.rows.append((self.taken, self.v, measured))
            self.theta += K * self.v / RATE
            self.taken += 1

    def read(self) -> SampleBlock:
        rows, self.rows = self.rows, []
        if self.silent:
            rows = []
        table = np.array(rows, dtype=float).reshape(-1, 3)
        sequence = table[:, 0].astype(np.int64)
        time = np.rint(sequence * 1e9 / RATE).astype(np.int64)
        quality = np.full((len(rows), 2), Quality.GOOD, dtype=np.uint8)
        return self.spoil(SampleBlock(self.channels, time, sequence, table[:, 1:], quality))

    def open(self) -> OpenRig:
        return OpenRig(self, self, self, "fake", {"clock": "simulated"})
