"""A device with two outputs, theta_a' = K v_a and theta_b' = K v_b, for tests of what stands
above it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from fake_device import RATE, K

from samii_rig.devices.protocols import CommandBlock, DeviceLoop, OpenRig
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.types import Channel, Quality, SampleBlock

_JOINT = """
[[element]]
kind = "angular_velocity_source"
name = "source_{0}"
input = "v_{0}"
K = {{value = 0.5, unit = "rad/(s V)", source = "test"}}
p = {{value = 100.0, unit = "rad/s", source = "test"}}

[[element]]
kind = "rigid_link"
name = "link_{0}"
L = {{value = 0.5, unit = "m", source = "test"}}
r = {{value = 0.25, unit = "m", source = "test"}}
m = {{value = 1.0, unit = "kg", source = "test"}}
I = {{value = 0.1, unit = "kg m^2", source = "test"}}

[[sensor]]
kind = "relative_angle"
name = "theta_{0}"
across = ["source_{0}"]
unit = "rad"
low = -2.0
high = 2.0

[[limit]]
channel = "v_{0}"
unit = "V"
max = 5.0
max_rate = 2000.0
reason = "half of the range"

[[limit]]
channel = "theta_{0}"
unit = "rad"
max = 0.35
reason = "the frame"

[[actuator]]
name = "v_{0}"
unit = "V"
low = -10.0
high = 10.0
deadman = 0.05
"""

RIG = (
    'name = "two pendulums"\nbase = "clamped"\ntip = "free"\nrate_hz = 500.0\n'
    '[centring]\nsensor = "theta_a"\nkp = 4.0\n'
    + _JOINT.format("a")
    + _JOINT.format("b")
    + 'centring = {sensor = "theta_b", kp = 2.0}\n'
)
NAMES = ("v_a", "v_b")


def pair_rig() -> Rig:
    return parse(Rig, RIG, "two pendulums")


class FakePair:
    """Actuators, sensor and clock in one; `spoil` may change or raise on each block read."""

    names = NAMES
    channels = (
        Channel("v_a", "V", "command"),
        Channel("v_b", "V", "command"),
        Channel("theta_a", "rad"),
        Channel("theta_b", "rad"),
    )

    def __init__(self, spoil: Callable[[SampleBlock], SampleBlock] | None = None) -> None:
        self.deadman: float | None = 0.05
        self.spoil = spoil or (lambda block: block)
        self.loops: tuple[DeviceLoop, ...] = ()
        self.queue: dict[int, list[tuple[float, float]]] = {}
        self.fed = -(10**9)  # ns of the last write
        self.v, self.theta = np.zeros(2), np.zeros(2)
        self.time = self.taken = 0
        self.rows: list[np.ndarray] = []
        self.written: list[tuple[CommandBlock, ...]] = []
        self.silent = False
        self.held: dict[int, float] = {}  # what an encoder shows that stands still, by its place

    def configure(self, loops: tuple[DeviceLoop, ...]) -> None:
        self.loops = loops

    def write(self, blocks: tuple[CommandBlock, ...]) -> None:
        self.fed = self.time
        self.written.append(blocks)
        for i in range(len(blocks[0])):
            pairs = [(float(b.u[i]), float(b.theta_ref[i])) for b in blocks]
            self.queue[blocks[0].first + i] = pairs

    def zero(self) -> None:
        self.queue.clear()
        self.v = np.zeros(2)

    @property
    def live(self) -> bool:
        """Whether an output is, or will by itself become, anything but zero."""
        fresh = self.deadman is None or self.time - self.fed <= self.deadman * 1e9
        queued = any(u or r for pairs in self.queue.values() for u, r in pairs)
        return fresh and (bool(self.v.any()) or queued)

    def now(self) -> int:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += max(0, round(seconds * 1e9))
        while self.taken * 1e9 / RATE <= self.time:
            reference = self.queue.pop(self.taken, None)
            dead = self.deadman is not None and self.time - self.fed > (self.deadman + 0.1) * 1e9
            self.v, measured = np.zeros(2), self.theta.copy()
            for place, value in self.held.items():
                measured[place] = value
            if reference is not None and not dead:
                kp = np.array([loop.kp for loop in self.loops])
                u, ref = np.array(reference).T
                self.v = u + kp * (ref - measured)
            self.rows.append(np.concatenate([[self.taken], self.v, measured]))
            self.theta = self.theta + K * self.v / RATE
            self.taken += 1

    def read(self) -> SampleBlock:
        rows, self.rows = self.rows, []
        if self.silent:
            rows = []
        table = np.array(rows, dtype=float).reshape(-1, 5)
        sequence = table[:, 0].astype(np.int64)
        time = np.rint(sequence * 1e9 / RATE).astype(np.int64)
        quality = np.full((len(rows), 4), Quality.GOOD, dtype=np.uint8)
        return self.spoil(SampleBlock(self.channels, time, sequence, table[:, 1:], quality))

    def open(self) -> OpenRig:
        return OpenRig(self, self, self, "fake", {"clock": "simulated"})
