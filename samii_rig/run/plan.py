"""What an experiment promises: a plan of all that a run will do, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from samii_rig.rig.schema import Rig
from samii_rig.types import Float, Kind


@dataclass(frozen=True, slots=True)
class Dwell:
    """A part of a segment that may be left early, once enough is known.

    From sample `first` to `last` of the segment the drive is a sine of `cycles` periods in every
    `block` samples. It may be left at first + k block, k >= least: what follows `last` then
    comes at once, and since that is a whole number of periods later, without a step.

    outputs, wanted : it is left when the response of each of these sensors at this frequency
        has a relative standard deviation sqrt(E|dH|^2)/|H| of at most `wanted`.
    """

    first: int
    last: int
    block: int
    cycles: int
    least: int
    outputs: tuple[str, ...]
    wanted: float

    @property
    def blocks(self) -> int:
        """Blocks in the whole of it."""
        return (self.last - self.first) // self.block


@dataclass(frozen=True, slots=True)
class PlannedSegment:
    """One thing to do: a reference and what it is called in the recording (see `Segment`).

    u, theta_ref : (n,) at the rig's rate, lead-in and ring-down included; (n, k) of a plan with
        k outputs, in the order of `Plan.outputs`.
    band_hz : where the excitation has its energy.
    frequency : (n,) Hz at each sample, NaN at rest, inf where the whole band is driven at
        once; for the progress display.
    dwell : the part that may be left early, None for a segment that is done as it is.
    recorded : the samples [start, stop) of u that the recording's segment holds, None for
        all; what is outside (ramps, settling) is recorded too, but belongs to no segment.
    excited : actuators that it drives, of a plan with several outputs; the others rest.
    """

    name: str
    kind: Kind
    level: float
    unit: str
    repeat: int
    u: Float
    theta_ref: Float
    band_hz: tuple[float, float]
    frequency: Float
    recorded: tuple[int, int] | None = None
    dwell: Dwell | None = None
    excited: tuple[str, ...] = ()

    def shortened(self, leave: int) -> PlannedSegment:
        """As it is when its dwell is left at sample `leave`, and cannot be left any more."""
        assert self.dwell is not None
        kept = np.r_[:leave, self.dwell.last : len(self.u)]
        first, last = self.recorded or (0, len(self.u))
        return replace(
            self,
            u=self.u[kept],
            theta_ref=self.theta_ref[kept],
            frequency=self.frequency[kept],
            recorded=(first, last - (self.dwell.last - leave)),
            dwell=None,
        )


@dataclass(frozen=True, slots=True)
class Output:
    """One output of a plan and the loop on it: v = u + kp (theta_ref - theta)."""

    actuator: str
    kp: float
    centring_sensor: str


@dataclass(frozen=True, slots=True)
class Plan:
    """All that a run will do, sample by sample, before anything moves.

    actuator, kp, centring_sensor : of the first output. beside : the outputs after it.
    """

    experiment: str
    rate_hz: float
    actuator: str
    kp: float
    centring_sensor: str
    segments: tuple[PlannedSegment, ...]
    seed: int
    beside: tuple[Output, ...] = ()

    @property
    def outputs(self) -> tuple[Output, ...]:
        """All outputs, in the order of the columns of a segment's u."""
        return (Output(self.actuator, self.kp, self.centring_sensor), *self.beside)

    def only(self, place: int) -> Plan:
        """What it asks of one of its outputs, as a plan with that output alone."""
        if not self.beside:
            return self
        one = self.outputs[place]
        segments = tuple(
            replace(s, u=s.u[:, place], theta_ref=s.theta_ref[:, place]) for s in self.segments
        )
        return replace(
            self,
            actuator=one.actuator,
            kp=one.kp,
            centring_sensor=one.centring_sensor,
            segments=segments,
            beside=(),
        )

    @property
    def duration(self) -> float:
        """Seconds, all segments; every dwell in full."""
        return sum(len(s.u) for s in self.segments) / self.rate_hz

    @property
    def shortest(self) -> Plan | None:
        """The plan with each dwell left as early as it may be; None if it has none."""
        if not any(s.dwell for s in self.segments):
            return None
        cut = [
            s.shortened(s.dwell.first + s.dwell.least * s.dwell.block) if s.dwell else s
            for s in self.segments
        ]
        return replace(self, segments=tuple(cut))


@runtime_checkable
class Experiment(Protocol):
    """An experiment file, checked. Its class is an entry point of `samii_rig.experiments`
    and a pydantic model, so that a TOML file loads into it."""

    name: str

    def plan(self, rig: Rig) -> Plan:
        """The reference of every segment; InputError if the rig cannot be asked this."""
