"""Steps and pulses from rest: how a rig with its loops closed comes to rest again."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from experiments.driven import HIGHEST, Driven
from samii_rig.errors import InputError
from samii_rig.rig.schema import Positive, Rig
from samii_rig.run.plan import Plan, PlannedSegment


class Step(Driven):
    """A step experiment file: rest, the level held for `hold`, and rest again.

    A long `hold` makes two steps, up and down; one of half a period of a mode is a pulse that
    leaves this mode to decay freely.

    lead_in, hold, ring_down : s before, at and after the level.
    """

    experiment: Literal["step"]
    lead_in: Positive = 1.0
    hold: Positive
    ring_down: Positive
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1

    def plan(self, rig: Rig) -> Plan:
        """Every segment's reference at the rig's rate, all repeats of a level one by one.

        InputError if the rig has no such actuator, another unit or no centring sensor, or if
        one of the times is shorter than a sample.
        """
        where = f"experiment {self.name}"
        kp, sensor = self.loop(rig, where)
        times = {"lead_in": self.lead_in, "hold": self.hold, "ring_down": self.ring_down}
        for field, seconds in times.items():
            if seconds * rig.rate_hz < 1:
                least = f"at least one sample, {1 / rig.rate_hz:g} s"
                raise InputError(where, field, seconds, least)
        longest = max(times, key=lambda field: times[field])
        samples = sum(times.values()) * rig.rate_hz
        self.check_length(rig, where, longest, samples * len(self.amplitudes) * self.repeats)
        n = [round(seconds * rig.rate_hz) for seconds in times.values()]
        shape = np.repeat([0.0, 1.0, 0.0], n)
        segments = []
        for level in self.amplitudes:
            u, theta_ref = self.references(level * shape)
            for repeat in range(self.repeats):
                segments.append(
                    PlannedSegment(
                        name=f"{self.name}_{level:g}_{repeat + 1}",
                        kind="transient",
                        level=level,
                        unit=self.unit,
                        repeat=repeat,
                        u=u,
                        theta_ref=theta_ref,
                        band_hz=(1 / sum(times.values()), HIGHEST * rig.rate_hz),
                        frequency=np.full(shape.shape, np.nan),
                    )
                )
        return self.planned(rig, kp, sensor, tuple(segments))
