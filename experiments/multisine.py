"""Random-phase odd multisine: periods of noise-like drive that show what is not linear."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from experiments.inputs import Inputs
from samii_rig.errors import InputError
from samii_rig.rig.schema import NonNegative, Positive, Rig
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.signal.excitation import cosine_ramp, schedule_factor
from samii_rig.signal.multisine import odd_lines, realisations
from samii_rig.types import Float

# A weaker line than this part of the strongest measures little, and a detection line beside
# it could not be told from it.
LEAST_FACTOR = 0.01


class Multisine(Inputs):
    """A multisine experiment file. Several inputs are driven together, on the same lines.

    Each segment is one realisation: a cosine ramp, whole periods of settling, whole measured
    periods, a ramp down. The recorded segment (kind `periodic`) holds the last settling
    period and the measured ones; the estimate leaves out its first period.

    schedule : as for the swept sine.
    period : T in s, a whole number of samples; lines are multiples of 1/T.
    low_hz, high_hz : the odd lines between them are driven,
    group : but one of each so many consecutive ones, left out at random as a detection line.
    realisations : how many, each with phases of its own; periods : measured in each.
    settle : periods before the measured ones, one at least.
    ramp : s of the cosine ramp up before them and down after them.
    crest : wanted peak/rms, see `samii_rig.signal.multisine`.
    order : `by_level` runs all realisations of a level before the next, `by_realisation`
        all levels of a realisation.

    With `beside` each realisation is a block of segments, 2 for two inputs and 4 for three or
    four, in which the inputs, with random phases of their own, have orthogonal signs.
    """

    experiment: Literal["multisine"]
    period: Positive
    low_hz: Positive
    high_hz: Positive
    group: Annotated[int, Field(ge=2, le=100)] = 4
    realisations: Annotated[int, Field(ge=1, le=1000)] = 3
    periods: Annotated[int, Field(ge=2, le=1000)] = 3
    settle: Annotated[int, Field(ge=1, le=100)] = 1
    ramp: NonNegative = 0.0
    crest: Annotated[float, Field(gt=1, le=10)] = 2.5
    schedule: tuple[tuple[Positive, Annotated[float, Field(ge=LEAST_FACTOR, le=1)]], ...] = ()
    order: Literal["by_level", "by_realisation"] = "by_level"

    @model_validator(mode="after")
    def _shape(self) -> Self:
        if self.high_hz <= self.low_hz:
            raise ValueError(f"high_hz: {self.high_hz:g} Hz; expected more than low_hz")
        hz = [point[0] for point in self.schedule]
        if sorted(set(hz)) != hz:
            raise ValueError("schedule: frequencies must increase")
        return self

    def plan(self, rig: Rig) -> Plan:
        """Every segment's reference at the rig's rate.

        InputError if the rig has no such actuator, another unit or no centring sensor, if
        the period is no whole number of samples, or if the band is too narrow or too high.
        """
        where = f"experiment {self.name}"
        kp, sensor = self.loop(rig, where)
        self.check_length(rig, where, "period", self.period * rig.rate_hz)
        n = round(self.period * rig.rate_hz)
        if abs(n / rig.rate_hz - self.period) > 1e-9 * self.period or n < 1:
            near = max(n, 1) / rig.rate_hz
            raise InputError(
                where, "period", self.period, f"a whole number of samples, such as {near:g} s"
            )
        self.check_band(rig, where, ("low_hz", self.low_hz), ("high_hz", self.high_hz))
        length = n * (self.settle + self.periods) + 2 * self.ramp * rig.rate_hz
        segments = len(self.amplitudes) * self.realisations * self.block
        self.check_length(rig, where, "period", length * segments)
        grid, *phases = np.random.SeedSequence(self.seed).spawn(2 + len(self.beside))
        lines = odd_lines(
            self.low_hz, self.high_hz, self.period, self.group, np.random.default_rng(grid)
        )
        if lines.odd.size == 0:
            least = f"a longer one: {self.group} odd lines between low_hz and high_hz at least"
            raise InputError(where, "period", self.period, least)
        shape = schedule_factor(lines.excited / self.period, self.schedule, self.interpolation)
        waves, *others = (
            realisations(n, lines.excited, shape, self.crest, self.realisations, own)
            for own in phases
        )
        order = self._order()
        planned = (self._segment(rig.rate_hz, level, i, waves[i]) for level, i in order)
        return self.together(
            rig,
            self.planned(rig, kp, sensor, tuple(planned)),
            [
                [self._wave(rig.rate_hz, level, other[i])[0] for other in others]
                for level, i in order
            ],
        )

    def _wave(self, rate_hz: float, level: float, wave: Float) -> tuple[Float, int, int]:
        """One period repeated with its ramps, and the samples of it that are recorded."""
        n, ramp = wave.size, round(self.ramp * rate_hz)
        before = ramp + (self.settle - 1) * n
        stop = before + (1 + self.periods) * n
        turn = np.arange(-before, stop - before + ramp) % n
        shaped = level * wave[turn] * cosine_ramp(turn.size, rate_hz, ramp / rate_hz)
        return shaped, before, stop

    def _segment(self, rate_hz: float, level: float, i: int, wave: Float) -> PlannedSegment:
        shaped, before, stop = self._wave(rate_hz, level, wave)
        u, theta_ref = self.references(shaped)
        return PlannedSegment(
            name=f"{self.name}_{level:g}_{i + 1}",
            kind="periodic",
            level=level,
            unit=self.unit,
            repeat=i,
            u=u,
            theta_ref=theta_ref,
            band_hz=(self.low_hz, self.high_hz),
            frequency=np.full(u.shape, np.inf),
            recorded=(before, stop),
        )

    def _order(self) -> list[tuple[float, int]]:
        """(level, realisation) of each segment."""
        if self.order == "by_level":
            return [(a, i) for a in self.amplitudes for i in range(self.realisations)]
        return [(a, i) for i in range(self.realisations) for a in self.amplitudes]
