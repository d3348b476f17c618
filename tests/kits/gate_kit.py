"""What tests of the gate share."""

from __future__ import annotations

import numpy as np
from fake_device import FakeDevice, fake_rig

from samii_rig.devices.protocols import CommandBlock
from samii_rig.safety.gate import Gate
from samii_rig.safety.limits import gate_limits

LIMITS = gate_limits(fake_rig(), "v", 4.0, "theta")


class Bench:
    """A gate on a fake device, with a clock in hand."""

    def __init__(self, limits=LIMITS, spoil=None):
        self.device = FakeDevice(spoil)
        self.log = []
        self.gate = Gate(self.device, limits, self.device.channels, self.log.append)
        self.next = None

    def tick(self, seconds=0.02):
        self.device.sleep(seconds)
        self.gate.observe(self.device.read(), self.device.now())

    def ticks(self, n):
        for _ in range(n):
            self.tick()

    def run_and_write(self):
        self.running()
        self.write()

    def running(self):
        self.tick()
        self.gate.arm(self.device.now())
        self.gate.start(self.device.now())
        return self

    def write(self, value=1.0, n=10):
        first = self.device.taken + 5 if self.next is None else self.next
        self.gate.write(CommandBlock(first, np.full(n, value), np.zeros(n)), self.device.now())
        self.next = first + n
