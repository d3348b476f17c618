"""What a device and a clock promise.

A host in Python cannot pace a kilohertz, so the device's clock paces. The host streams
the reference some tens of milliseconds ahead; the device closes the centring loop

    v[n] = u[n] + kp (theta_ref[n] - theta[n]) + feedback[n]

at its own sample rate, holds v[n] until n + 1, keeps its own hard limits and drops its
output to zero when nothing came for `deadman` seconds. Samples stream back in blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from samii_rig.rig.schema import Feedback
from samii_rig.types import Channel, Float, SampleBlock


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
class Actuators(Protocol):
    """Several outputs that one device drives together. Only the gate may hold them.

    They are one: what drops one of them to zero (its limit, an angle, the deadman) drops all.

    names : of the outputs, in the order of the rig file; so are loops and blocks below.
    deadman : as of an `Actuator`, of all at once.
    """

    names: tuple[str, ...]
    deadman: float | None

    def configure(self, loops: tuple[DeviceLoop, ...]) -> None:
        """Set each output's loop and limits; allowed only while all outputs are zero."""

    def write(self, blocks: tuple[CommandBlock, ...]) -> None:
        """Queue reference samples, the same ones of every output; feeds the deadman."""

    def zero(self) -> None:
        """All outputs zero now, drop all that is queued. Never raises, may be called twice."""


class Alone:
    """An actuator as a device's only output, so that whoever drives outputs knows one kind."""

    def __init__(self, actuator: Actuator) -> None:
        self._actuator = actuator
        self.names = (actuator.name,)

    @property
    def deadman(self) -> float | None:
        """The actuator's own."""
        return self._actuator.deadman

    def configure(self, loops: tuple[DeviceLoop, ...]) -> None:
        """Its loop and limits."""
        (loop,) = loops
        self._actuator.configure(loop)

    def write(self, blocks: tuple[CommandBlock, ...]) -> None:
        """Its reference."""
        (block,) = blocks
        self._actuator.write(block)

    def zero(self) -> None:
        """Its output at zero."""
        self._actuator.zero()


@runtime_checkable
class Sensor(Protocol):
    """A source of samples. The device that drives an output also reads back v."""

    channels: tuple[Channel, ...]

    def read(self) -> SampleBlock:
        """All samples that arrived since the last call, oldest first; may be empty."""


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """What a device reports beside its samples: `time` in ns of its clock, a word, and fields."""

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

    actuator: Actuator | Actuators
    sensor: Sensor
    clock: Clock
    description: str
    metadata: dict[str, str]

    def close(self) -> None:
        """Output zero. A driver that holds a port extends this to release it after that."""
        self.actuator.zero()
