"""Swept sine: bursts at several levels, repeated, each starting and ending at rest."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from experiments.inputs import Inputs
from samii_rig.errors import InputError
from samii_rig.rig.schema import NonNegative, Positive, Rig
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.signal.excitation import Profile, Sweep, swept_sine


class SweptSine(Inputs):
    """A swept sine experiment file. Several inputs are swept one after the other.

    start_hz, stop_hz, duration : of the sweep, s; `ramp` at both of its ends is inside.
    schedule : points [Hz, factor], factor at most 1, by which the level is lowered over
        frequency; in between as `interpolation` says.
    order : `by_level` repeats a level before the next, `by_repeat` runs through all levels
        in each repeat, `random` shuffles all with `seed`.
    lead_in, ring_down : s of silence before and after each sweep.
    """

    experiment: Literal["swept_sine"]
    sweep: Sweep
    start_hz: Positive
    stop_hz: Positive
    duration: Positive
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1
    ramp: NonNegative = 0.0
    lead_in: NonNegative = 0.0
    ring_down: NonNegative = 0.0
    schedule: tuple[tuple[Positive, Annotated[float, Field(ge=0, le=1)]], ...] = ()
    order: Literal["by_level", "by_repeat", "random"] = "by_level"

    @model_validator(mode="after")
    def _shape(self) -> Self:
        if self.start_hz == self.stop_hz:
            raise ValueError(
                f"start_hz and stop_hz are both {self.start_hz:g} Hz; expected a sweep between two"
            )
        if 2.0 * self.ramp > self.duration:
            raise ValueError(
                f"two ramps of {self.ramp:g} s do not fit into a sweep of {self.duration:g} s"
            )
        hz = [point[0] for point in self.schedule]
        if sorted(set(hz)) != hz:
            raise ValueError("schedule: frequencies must increase")
        if self.interpolation == "logarithmic" and any(f == 0 for _, f in self.schedule):
            raise ValueError('schedule: a factor of 0 needs interpolation = "linear"')
        return self

    def plan(self, rig: Rig) -> Plan:
        """Every segment's reference at the rig's rate.

        InputError if the rig has no such actuator, another unit or no centring sensor, if
        the sweep is shorter than two samples or reaches above 0.45 of the rate.
        """
        where = f"experiment {self.name}"
        kp, sensor = self.loop(rig, where)
        if self.duration * rig.rate_hz < 2:
            raise InputError(
                where, "duration", self.duration, f"at least two samples, {2 / rig.rate_hz:g} s"
            )
        self.check_band(rig, where, ("start_hz", self.start_hz), ("stop_hz", self.stop_hz))
        samples = (self.lead_in + self.duration + self.ring_down) * rig.rate_hz
        segments = len(self.amplitudes) * self.repeats * len(self.inputs)
        self.check_length(rig, where, "duration", samples * segments)
        return self.one_by_one(rig, self._plan(rig, kp, sensor))

    def _plan(self, rig: Rig, kp: float, sensor: str) -> Plan:
        shape, frequency = swept_sine(
            rig.rate_hz,
            self.start_hz,
            self.stop_hz,
            self.duration,
            ramp=self.ramp,
            lead_in=self.lead_in,
            ring_down=self.ring_down,
            profile=Profile(self.sweep, self.schedule, self.interpolation),
        )
        band = (min(self.start_hz, self.stop_hz), max(self.start_hz, self.stop_hz))
        levels = {level: level * shape for level in self.amplitudes}
        segments = []
        for level, repeat in self._order():
            wave = levels[level]
            u, theta_ref = self.references(wave)
            segments.append(
                PlannedSegment(
                    name=f"{self.name}_{level:g}_{repeat + 1}",
                    kind="burst",
                    level=level,
                    unit=self.unit,
                    repeat=repeat,
                    u=u,
                    theta_ref=theta_ref,
                    band_hz=band,
                    frequency=frequency,
                )
            )
        return self.planned(rig, kp, sensor, tuple(segments))

    def _order(self) -> list[tuple[float, int]]:
        """(level, repeat) of each segment. Repeats of a level stay in order, so that a
        repeat's number says when it was done."""
        by_level = [(a, r) for a in self.amplitudes for r in range(self.repeats)]
        if self.order == "by_level":
            return by_level
        if self.order == "by_repeat":
            return [(a, r) for r in range(self.repeats) for a in self.amplitudes]
        levels = [a for a, _ in by_level]
        shuffled = np.random.default_rng(self.seed).permutation(levels).tolist()
        return [(a, shuffled[:i].count(a)) for i, a in enumerate(shuffled)]
