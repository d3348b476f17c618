"""Whether the output that a device reads back is the one that it was commanded to put out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from samii_rig.devices.protocols import CommandBlock
from samii_rig.types import Channel, Float, Quality, SampleBlock

# What says nothing of what the device reckoned with; a changed output is judged by its flag.
UNJUDGED = np.uint8(Quality.MISSING | Quality.STALE | Quality.CLIPPED | Quality.LIMITED)


def _none() -> Float:
    return np.zeros(0)


@dataclass(frozen=True, slots=True)
class Sent:
    """References that were sent and have not come back: samples first, first + 1, ..."""

    first: int = -1
    u: Float = field(default_factory=_none)
    theta_ref: Float = field(default_factory=_none)

    def then(self, block: CommandBlock) -> Sent:
        """With a block that continues it."""
        first = self.first if len(self.u) else block.first
        u = np.concatenate([self.u, block.u])
        return Sent(first, u, np.concatenate([self.theta_ref, block.theta_ref]))

    def after(self, sequence: int) -> Sent:
        """Without what lies up to sample `sequence`."""
        over = sequence + 1 - self.first
        if over <= 0 or not len(self.u):
            return self
        return Sent(self.first + over, self.u[over:], self.theta_ref[over:])


def travel(sent: Sent, block: CommandBlock, angle: float, rate: float, kp: float) -> float:
    """Largest |theta| to which a reference will have turned the joint, in the sensor's unit.

    From `angle`, the newest one measured, through what was sent and has not come back and then
    `block`, by the angular velocity source alone: a sample turns the joint by

        theta[n+1] = theta[n] + rate (u[n] + kp (theta_ref[n] - theta[n])),

    rate : unit of the sensor for each sample and unit of the actuator.
    """
    command = np.concatenate([sent.u + kp * sent.theta_ref, block.u + kp * block.theta_ref])
    # The solution of the recursion, with a the part of an angle that is left after a sample.
    left = (1.0 - rate * kp) ** np.arange(1, len(command) + 1)
    theta = left * (angle + np.cumsum(rate * command / left))
    return float(np.abs(theta).max())


@dataclass(frozen=True, slots=True)
class Places:
    """Columns of a device's samples: the output, the centring sensor, and the references that
    it says it used; None for what it does not report."""

    v: int
    theta: int | None
    u: int | None
    theta_ref: int | None

    @classmethod
    def among(
        cls, channels: tuple[Channel, ...], output: str, sensor: str, place: int = 0
    ) -> Places:
        """ValueError if the output is not there. place : of it among the device's outputs."""
        names = [c.name for c in channels]
        references = [i for i, c in enumerate(channels) if c.role == "reference"]
        # Of a device that reports references, the first two are u and theta_ref of its first
        # output, the next two those of the next.
        own = references[2 * place : 2 * place + 2]
        u, theta_ref = own if len(own) > 1 else (None, None)
        theta = names.index(sensor) if sensor in names else None
        return cls(names.index(output), theta, u, theta_ref)


def stray(sent: Sent, block: SampleBlock, places: Places, kp: float) -> float:
    """Largest distance between what the device put out and what it was commanded, in its unit.

    At every sample of `block` for which a reference was sent,

        |v - (u + kp (theta_ref - theta))|,

    with u and theta_ref as the device says it used them, and then also the distance of these
    from the ones that were sent. u = 0 is no difference: that is a reference that was lost on its
    way, which is counted, and the device held its set point. Before anything was sent the output
    must be zero. 0 where nothing can be compared.
    """
    if sent.first < 0:
        judged = (block.quality[:, places.v] & UNJUDGED) == 0
        return float(np.abs(block.values[judged, places.v]).max(initial=0.0))
    at = block.sequence - sent.first
    inside = np.flatnonzero((at >= 0) & (at < len(sent.u)))
    if not len(inside) or (kp != 0.0 and places.theta is None):
        return 0.0
    columns = [i for i in (places.v, places.theta) if i is not None]
    judged = ((block.quality[inside][:, columns] & UNJUDGED) == 0).all(axis=1)
    rows = inside[judged]
    if not len(rows):
        return 0.0
    values, at = block.values[rows], at[rows]
    due = sent.u[at] + kp * sent.theta_ref[at]
    away = 0.0
    if places.u is not None:
        used = values[:, places.u] + kp * values[:, places.theta_ref]
        off = np.abs(used - due)[values[:, places.u] != 0.0]
        away, due = float(off.max(initial=0.0)), used
    theta = values[:, places.theta] if kp != 0.0 else 0.0
    return max(away, float(np.abs(values[:, places.v] - due + kp * theta).max()))
