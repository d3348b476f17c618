"""What tests of the gate judgement share."""

from __future__ import annotations

import numpy as np
from fake_device import FakeDevice, fake_rig

from samii_rig.devices.protocols import CommandBlock
from samii_rig.rig.schema import Feedback
from samii_rig.safety.latest import Latest, observe
from samii_rig.safety.limits import gate_limits
from samii_rig.types import SampleBlock

LIMITS = gate_limits(fake_rig(), "v", 4.0, "theta")


COLUMNS, RATES = np.array([0, 1]), (0, 1)


def block(values, *, first=0, quality=None, late=0):
    values = np.atleast_2d(np.array(values, dtype=float))
    n = len(values)
    sequence = np.arange(first, first + n)
    time = sequence * 2_000_000
    flags = np.zeros((n, 2), dtype=np.uint8) if quality is None else np.array(quality, np.uint8)
    return SampleBlock(FakeDevice.channels, time, sequence, values, flags)


def seen(values, now=None, latest=None, **how):
    b = block(values, **how)
    now = int(b.time[-1]) if now is None else now
    return observe(latest or Latest.nothing(2), b, COLUMNS, RATES, now)


def command(u, theta_ref=None, first=100):
    u = np.atleast_1d(np.array(u, dtype=float))
    ref = np.zeros_like(u) if theta_ref is None else np.atleast_1d(np.array(theta_ref, dtype=float))
    return CommandBlock(first, u, ref)


FINE = seen([[0.0, 0.0], [0.0, 0.0]])


def with_feedback():
    values = {"name": "f", "sensor": "theta", "actuator": "v", "gain": 1.0, "unit": "V/(rad)"}
    loop = Feedback(**values, poles=(-5.0,), max=0.5)
    return gate_limits(fake_rig().model_copy(update={"feedback": (loop,)}), "v", 4.0, "theta")
