"""Stepped sine: one frequency at a time, each for as long as it takes to know it well enough."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from experiments.driven import Driven
from samii_rig.errors import InputError
from samii_rig.rig.schema import Name, NonNegative, Positive, Rig
from samii_rig.run.plan import Dwell, Plan, PlannedSegment
from samii_rig.signal.excitation import schedule_factor
from samii_rig.types import Float

MOST_POINTS = 2000
# How far a frequency may be moved so that whole periods are whole samples, in parts of it.
MOVED = 0.02
LEAST_BLOCK = 8  # samples


class SteppedSine(Driven):
    """A stepped sine experiment file.

    At each frequency: a cosine ramp up, settling, the dwell, a ramp down. The dwell is measured
    in blocks of whole periods and is left when each of `outputs` is known to `wanted`, but not
    before `least` blocks and not after `most` s.

    frequencies : Hz, one by one; or `points` of them from `low_hz` to `high_hz`, evenly spaced
        on a logarithmic axis. Each is moved by at most 2 % so that a block is whole samples.
    order : `up`, `down` or `random` (by `seed`), the same for every level.
    settle : s between the ramp up and the dwell, or points [Hz, s], straight lines between.
    block : s at least; a block is the next whole number of periods.
    least : blocks of a dwell at least, two more than the rig has sensors. most : s at most.
    wanted : relative standard deviation of the response, sqrt(E|dH|^2)/|H|.
    outputs : sensors that must be known that well; all without.
    ramp : s of each ramp. schedule : as for the swept sine.
    """

    experiment: Literal["stepped_sine"]
    frequencies: tuple[Positive, ...] = ()
    low_hz: Positive | None = None
    high_hz: Positive | None = None
    points: Annotated[int, Field(ge=2, le=MOST_POINTS)] | None = None
    order: Literal["up", "down", "random"] = "up"
    settle: NonNegative | tuple[tuple[Positive, NonNegative], ...] = 0.0
    block: Positive = 0.5
    least: Annotated[int, Field(ge=3, le=10_000)] = 8
    most: Positive
    wanted: Annotated[float, Field(gt=0, lt=1)]
    outputs: tuple[Name, ...] = ()
    ramp: Positive = 0.5
    schedule: tuple[tuple[Positive, Annotated[float, Field(gt=0, le=1)]], ...] = ()

    @model_validator(mode="after")
    def _shape(self) -> Self:
        spaced = (self.low_hz, self.high_hz, self.points)
        if self.frequencies and any(x is not None for x in spaced):
            raise ValueError("frequencies, or low_hz, high_hz and points; expected one of the two")
        if not self.frequencies and any(x is None for x in spaced):
            raise ValueError("expected frequencies, or all of low_hz, high_hz and points")
        if self.low_hz is not None and self.high_hz is not None and self.high_hz <= self.low_hz:
            raise ValueError(f"high_hz: {self.high_hz:g} Hz; expected more than low_hz")
        if len(self.frequencies) > MOST_POINTS:
            raise ValueError(
                f"frequencies: {len(self.frequencies)}; expected {MOST_POINTS} at most"
            )
        for what in ("schedule", "settle"):
            points = getattr(self, what)
            hz = [] if isinstance(points, float) else [point[0] for point in points]
            if sorted(set(hz)) != hz:
                raise ValueError(f"{what}: frequencies must increase")
        return self

    def plan(self, rig: Rig) -> Plan:
        """Every frequency's reference at the rig's rate, its dwell in full.

        InputError if the rig has no such actuator, unit, sensor or no centring sensor, if a
        frequency is too high or two come out the same, or if `least` blocks do not fit.
        """
        where = f"experiment {self.name}"
        kp, sensor = self.loop(rig, where)
        names = [s.name for s in rig.sensor]
        for name in self.outputs:
            if name not in names:
                raise InputError(where, "outputs", name, f"sensors of {rig.name}: {names}")
        if self.least < len(names) + 2:
            expected = f"at least {len(names) + 2}, for a covariance of {len(names)} sensors"
            raise InputError(where, "least", self.least, expected)
        wanted = self._wanted_hz()
        low, high = ("frequencies",) * 2 if self.frequencies else ("low_hz", "high_hz")
        self.check_band(rig, where, (low, float(wanted.min())), (high, float(wanted.max())))
        self.check_length(rig, where, "block", self.block * rig.rate_hz)
        lines = [whole_periods(f, self.block, rig.rate_hz) for f in wanted]
        hz = np.array([cycles * rig.rate_hz / block for block, cycles in lines])
        far = np.abs(hz / wanted - 1) > MOVED
        if far.any():
            expected = f"one whose period is nearer to whole samples, such as {hz[far][0]:g} Hz"
            raise InputError(where, "frequencies", float(wanted[far][0]), expected)
        if len(np.unique(hz)) < len(hz):
            raise InputError(where, "frequencies", len(hz), f"{len(np.unique(hz))} that differ")
        for f, (block, _) in zip(hz, lines, strict=True):
            if self.least * block > self.most * rig.rate_hz:
                expected = f"at least {self.least * block / rig.rate_hz:.3g} s, {self.least} blocks"
                raise InputError(where, "most", self.most, f"{expected} at {f:.4g} Hz")
        settle = self._settling(hz)
        longest = (float(settle.sum()) + len(hz) * (self.most + 2 * self.ramp)) * rig.rate_hz
        self.check_length(rig, where, "most", longest * len(self.amplitudes))
        factor = schedule_factor(hz, self.schedule, self.interpolation)
        return self.planned(
            rig,
            kp,
            sensor,
            tuple(
                self._segment(rig.rate_hz, level, factor[i], *lines[i], settle[i], names)
                for level in self.amplitudes
                for i in self._order(hz)
            ),
        )

    def _wanted_hz(self) -> Float:
        if self.frequencies:
            return np.array(self.frequencies)
        return np.geomspace(self.low_hz or 1.0, self.high_hz or 1.0, self.points or 1)

    def _settling(self, hz: Float) -> Float:
        if isinstance(self.settle, float):
            return np.full(hz.shape, self.settle)
        at, seconds = np.array(self.settle).T
        return np.asarray(np.interp(hz, at, seconds))

    def _order(self, hz: Float) -> list[int]:
        order = np.argsort(hz)
        if self.order == "down":
            order = order[::-1]
        if self.order == "random":
            order = np.random.default_rng(self.seed).permutation(order)
        return [int(i) for i in order]

    def _segment(
        self,
        rate_hz: float,
        level: float,
        factor: float,
        block: int,
        cycles: int,
        settle: float,
        names: list[str],
    ) -> PlannedSegment:
        ramp = max(1, round(self.ramp * rate_hz))
        first = ramp + round(settle * rate_hz)
        last = first + int(self.most * rate_hz) // block * block
        t = np.arange(last + ramp)
        f = cycles * rate_hz / block
        # The phase counts from the dwell, so that every block is the very same samples.
        wave = level * factor * np.sin(2 * np.pi * ((t - first) % block) * cycles / block)
        wave[:ramp] *= 0.5 - 0.5 * np.cos(np.pi * t[:ramp] / ramp)
        wave[last:] *= 0.5 + 0.5 * np.cos(np.pi * (t[last:] - last) / ramp)
        u, theta_ref = self.references(wave)
        return PlannedSegment(
            name=f"{self.name}_{level:g}_{f:.4g}Hz",
            kind="periodic",
            level=level,
            unit=self.unit,
            repeat=0,
            u=u,
            theta_ref=theta_ref,
            band_hz=(f, f),
            frequency=np.full(u.shape, f),
            recorded=(first, last),
            dwell=Dwell(
                first, last, block, cycles, self.least, self.outputs or tuple(names), self.wanted
            ),
        )


def whole_periods(f: float, block: float, rate_hz: float) -> tuple[int, int]:
    """(samples, periods) of the shortest block of at least `block` s and one period that is
    whole samples, with a frequency as near to f as that allows.

    Samples and periods have no common divisor, so that no shorter block is periodic.
    """
    cycles = max(1, math.ceil(block * f - 1e-9))
    near = max(LEAST_BLOCK, round(cycles * rate_hz / f))
    for away in range(near):
        for n in (near + away, near - away):
            if n >= LEAST_BLOCK and n > 2 * cycles and math.gcd(n, cycles) == 1:
                return n, cycles
    return near, cycles
