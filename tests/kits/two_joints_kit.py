"""Recordings of SAMII with joints 2 and 3 driven, of the simulated rig with something concealed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from samii_rig.devices.channels import reference_channels
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import LumpedMass, Parameter, Rig
from samii_rig.signal.excitation import swept_sine
from samii_rig.types import Channel, Float, Recording, Segment
from sim.rig import open_rig

RIG = load_rig("samii_two_joints")[0]
INPUTS = tuple(a.name for a in RIG.actuator)
BAND = (0.5, 20.0)  # Hz: most of what a diagnosis takes grows with the square of its lines
SWEEP = 24.0  # s: 40 lines to the first octave
LEVEL = 0.4  # V, far from every limit


def heavier(mass: float, after: str = "link_3_6") -> Rig:
    """The rig with a mass (kg) behind a link that its file does not have."""
    m = Parameter(value=mass, unit="kg", source="concealed")
    hidden = LumpedMass(kind="lumped_mass", name="hidden", m=m)
    at = [e.name for e in RIG.element].index(after) + 1
    return RIG.model_copy(update={"element": (*RIG.element[:at], hidden, *RIG.element[at:])})


def late(actuator: str, delay: float) -> Rig:
    """The rig with one output that comes later, s."""
    actuators = tuple(
        a.model_copy(update={"delay": delay}) if a.name == actuator else a for a in RIG.actuator
    )
    return RIG.model_copy(update={"actuator": actuators})


def sweep(low: float = BAND[0], high: float = BAND[1]) -> Float:
    """(n,) V, cut off where it ends."""
    return LEVEL * swept_sine(RIG.rate_hz, low, high, SWEEP, ramp=1.0)[0]


def in_turn() -> list[Float]:
    """(n, 2) of each recording: one joint is driven, the loop of the other keeps it centred."""
    u = sweep()
    return [np.stack([u, 0 * u], axis=1), np.stack([0 * u, u], axis=1)]


def together() -> list[Float]:
    """(n, 2): one sweep upwards and one downwards, then the first alike and the second reversed."""
    up, down = 0.5 * sweep(), 0.5 * sweep(*BAND[::-1])
    return [np.stack([up, down], axis=1), np.stack([up, -down], axis=1)]


def recorded(
    hidden: Rig, references: Sequence[Float], seed: int = 1, **settings: object
) -> list[Recording]:
    """One recording of each reference (n, 2), from rest, with noise, steps and the loops.
    settings : more of the simulated rig."""
    return [
        _one(hidden, u, f"run_{i}", {"seed": seed + i, **settings})
        for i, u in enumerate(references)
    ]


def _one(hidden: Rig, u: Float, name: str, settings: dict[str, object]) -> Recording:
    device = open_rig(hidden, settings)
    loops = [hidden.centring_of(n) for n in INPUTS]
    far = 1e9  # limits that nothing reaches
    device.actuator.configure(tuple(DeviceLoop(c.sensor, c.kp, far, far, far) for c in loops))
    device.actuator.write(tuple(CommandBlock(0, x, np.zeros_like(x)) for x in u.T))
    device.clock.sleep(len(u) / hidden.rate_hz)
    block = device.sensor.read()
    n = len(block.values)
    segment = Segment("sweep", "single", 0, n, LEVEL, "V", 0, excited=_driven(u))
    return Recording(
        _channels(), hidden.rate_hz, block.time, block.sequence, block.values, block.quality,
        (segment,), source=f"{name}.mcap",
    )  # fmt: skip


def _driven(u: Float) -> tuple[str, ...]:
    return tuple(n for n, x in zip(INPUTS, u.T, strict=True) if x.any())


def _channels() -> tuple[Channel, ...]:
    references = reference_channels(RIG)
    commands = [Channel(a.name, a.unit, "command", resolution=a.resolution) for a in RIG.actuator]
    sensors = [Channel(s.name, RIG.units()[s.name], resolution=s.resolution) for s in RIG.sensor]
    return (*references, *commands, *sensors)
