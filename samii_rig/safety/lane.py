"""One output as the gate sees it: its limits, what was sent to it, and what came back."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from samii_rig.devices.protocols import CommandBlock
from samii_rig.errors import GateError
from samii_rig.safety.agreement import Followed, apart
from samii_rig.safety.latest import Latest, observe
from samii_rig.safety.limits import GateLimits
from samii_rig.safety.readback import Places, Sent, stray
from samii_rig.types import Channel, SampleBlock

FLIGHT = 0.05  # s that a sample may take from the device to here


class Lane:
    """What is known of one output. It decides nothing and holds no device.

    Parameters
    ----------
    channels : of the device's samples; GateError if one that the limits need is not there.
    place : of this output among those that the device drives.

    latest, sent : what the samples said last, and what was sent and has not come back.
    """

    def __init__(self, limits: GateLimits, channels: tuple[Channel, ...], place: int = 0) -> None:
        names = [c.name for c in channels]
        for needed in limits.channels:
            if needed.channel not in names:
                raise GateError(
                    f"the device reports no channel {needed.channel}, which the gate needs; "
                    f"it has {', '.join(names)}"
                )
        self.limits = limits
        self._columns = np.array([names.index(c.channel) for c in limits.channels])
        self._rates = tuple(
            i
            for i, c in enumerate(limits.channels)
            if math.isfinite(c.max_rate) or c.channel == limits.centring_sensor
        )
        self._places = Places.among(channels, limits.output.channel, limits.centring_sensor, place)
        self._pairs = [(names.index(a.sensor), names.index(a.other)) for a in limits.agreements]
        self._followed = [Followed() for _ in limits.agreements]
        self.sent = Sent()
        self.latest = Latest.nothing(len(self._columns))

    @property
    def name(self) -> str:
        """The output's."""
        return self.limits.output.channel

    def beat(self, now: int) -> None:
        """A sign of life from the operator's client."""
        self.latest = replace(self.latest, heartbeat=now)

    def observe(self, block: SampleBlock, now: int) -> None:
        """Take in all samples that arrived, perhaps none."""
        latest = observe(self.latest, block, self._columns, self._rates, now)
        if len(block):  # nothing new takes nothing back
            strayed = stray(self.sent, block, self._places, self.limits.kp)
            latest = replace(latest, stray=strayed, apart=self._apart(block))
        self.latest = latest
        self.sent = self.sent.after(latest.sequence)

    def configured(self) -> None:
        """From here on the device must change nothing by itself, but for what was under way."""
        first = self.latest.sequence + 1 + math.ceil(FLIGHT * self.limits.rate_hz)
        self.latest = replace(self.latest, first=first)

    def wrote(self, block: CommandBlock) -> None:
        """This reference was sent."""
        self.sent = self.sent.then(block)
        self.latest = replace(
            self.latest,
            first=min(block.first, self.latest.first),
            next=block.first + len(block),
            u=float(block.u[-1]),
            theta_ref=float(block.theta_ref[-1]),
        )

    def zeroed(self) -> None:
        """The output is at zero, and nothing of what was sent will come out."""
        self.sent = Sent()
        self.latest = replace(self.latest, first=-1, next=-1, u=0.0, theta_ref=0.0)

    def afresh(self) -> None:
        """Forget all samples, so that arming needs new ones."""
        beat = self.latest.heartbeat
        self.latest = replace(Latest.nothing(len(self._columns)), heartbeat=beat)
        self._followed = [Followed() for _ in self._followed]

    def nearest(self) -> tuple[float, str]:
        """The largest |value|/limit in the newest block, and the channel that has it."""
        return max(
            (p / c.max, c.channel)
            for p, c in zip(self.latest.peak, self.limits.channels, strict=True)
        )

    def _apart(self, block: SampleBlock) -> tuple[float, ...]:
        found = [
            apart(a, columns, before, block)
            for a, columns, before in zip(
                self.limits.agreements, self._pairs, self._followed, strict=True
            )
        ]
        self._followed = [followed for followed, _ in found]
        return tuple(way for _, way in found)
