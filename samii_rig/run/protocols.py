"""What a device, a clock and an experiment promise.

A host in Python cannot pace a kilohertz, so the device's clock paces. The host streams
the reference some tens of milliseconds ahead; the device closes the centring loop

    v[n] = u[n] + kp (theta_ref[n] - theta[n]) + feedback[n]

at its own sample rate, holds v[n] until n + 1, keeps its own hard limits and drops its
output to zero when nothing came for `deadman` seconds. Samples stream back in blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from samii_rig.rig.schema import Feedback, Rig
from samii_rig.types import Channel, Float, Kind, SampleBlock


@dataclass(frozen=True, slots=True)
class CommandBlock:
    """Reference for the samples first, first + 1, ... of the device's own count.

    u, theta_ref : (n,) in the actuator's and the centring sensor's unit.
    """

    first: int
    u: Float
    theta_ref: Float

    def __len__(self) -> int:
        return int(self.u.shape[0])


@dataclass(frozen=True, slots=True)
class DeviceLoop:
    """The loop and the hard limits that the device keeps by itself.

    kp : actuator unit per unit of the sensor called `sensor`; 0 opens the loop.
    max_output, max_rate : |v| and |dv/dt| in actuator units (per second).
    max_angle : |theta| of `sensor` beyond which the device drops to zero and says so.
    feedback : filters that run from zero state while the output is live, see `Feedback`; a
        device that cannot run them refuses in `configure` with DeviceError.
    """

    sensor: str
    kp: float
    max_output: float
    max_rate: float
    max_angle: float
    feedback: tuple[Feedback, ...] = ()


@runtime_checkable
class Actuator(Protocol):
    """An output that can move the rig. Only the gate may hold one.

    deadman : s for which it holds the last command before it drops to zero by itself;
        None if it does not, and then it is never armed.
    """

    name: str
    deadman: float | None

    def configure(self, loop: DeviceLoop) -> None:
        """Set loop and limits; allowed only while the output is zero."""

    def write(self, block: CommandBlock) -> None:
        """Queue reference samples; feeds the deadman."""

    def zero(self) -> None:
        """Output zero now, drop all that is queued. Never raises, may be called twice."""


@runtime_checkable
class Sensor(Protocol):
    """A source of samples. The device that drives an output also reads back v."""

    channels: tuple[Channel, ...]

    def read(self) -> SampleBlock:
        """All samples that arrived since the last call, oldest first; may be empty."""


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """What a device tells beside its samples: `time` in ns of its clock, a word, and fields."""

    time: int
    name: str
    fields: dict[str, str | int | float]


@runtime_checkable
class Reports(Protocol):
    """A sensor that also has events: a change of the device's own state, counts of its line."""

    def events(self) -> list[DeviceEvent]:
        """All since the last call, oldest first. Never raises."""


@runtime_checkable
class Clock(Protocol):
    """Time, injected so that a simulated hour passes in a second."""

    def now(self) -> int:
        """Nanoseconds, monotonic."""

    def sleep(self, seconds: float) -> None:
        """Return when `seconds` have passed on this clock."""


@dataclass(frozen=True, slots=True)
class OpenRig:
    """A rig whose devices are open: what an entry point of `samii_rig.devices` returns.

    An entry point is called with (rig: Rig, settings: dict[str, object]).
    """

    actuator: Actuator
    sensor: Sensor
    clock: Clock
    description: str
    metadata: dict[str, str]

    def close(self) -> None:
        """Output zero. A driver that holds a port extends this to release it after that."""
        self.actuator.zero()


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

    u, theta_ref : (n,) at the rig's rate, lead-in and ring-down included.
    band_hz : where the excitation has its energy.
    frequency : (n,) Hz at each sample, NaN at rest, inf where the whole band is driven at
        once; for the progress display.
    dwell : the part that may be left early, None for a segment that is done as it is.
    recorded : the samples [start, stop) of u that the recording's segment holds, None for
        all; what is outside (ramps, settling) is recorded too, but belongs to no segment.
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
class Plan:
    """All that a run will do, sample by sample, before anything moves."""

    experiment: str
    rate_hz: float
    actuator: str
    kp: float
    centring_sensor: str
    segments: tuple[PlannedSegment, ...]
    seed: int

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
