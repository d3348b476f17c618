"""What tests of the feedback share."""

from __future__ import annotations

import numpy as np

from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.signal.excitation import swept_sine

RATE, BAND = 500.0, 200.0


SAMII, TEXT = load_rig("samii")


U, REF, V, THETA, A_0 = range(5)


LOOP = """
[[feedback]]
name = "damping"
sensor = "a_0"
actuator = "v_2"
gain = 1296.0
unit = "V/(m/s^2)"
poles = [-5.6, -5.6, -5.6]
max = 2.0
"""


def rig_with(text: str = LOOP) -> Rig:
    return parse(Rig, TEXT + text, "samii_damped")


class Memory:
    def __init__(self):
        self.blocks, self.segments, self.events = [], [], []

    def write(self, block):
        self.blocks.append(block)

    def event(self, time, name, payload):
        self.events.append((name, payload))

    def segment(self, segment):
        self.segments.append(segment)

    def values(self):
        return np.concatenate([b.values for b in self.blocks])


def plan_for(level=0.5, duration=6.0, repeats=1, ring_down=1.0):
    u, f = swept_sine(RATE, 1.0, 20.0, duration, ramp=0.5, lead_in=0.5, ring_down=ring_down)
    parts = tuple(
        PlannedSegment(f"s{i}", "burst", level, "V", i, level * u, np.zeros_like(u), (1.0, 20.0), f)
        for i in range(repeats)
    )
    return Plan("test", RATE, "v_2", 4.0, "theta_2", parts, 0)
