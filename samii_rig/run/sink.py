"""From the loop to the recorder: blocks are gathered, completed with the reference, and
handed over without ever making the loop wait."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from samii_rig.devices.channels import reference_names
from samii_rig.errors import DeviceError, DiskError
from samii_rig.rig.schema import Rig
from samii_rig.run.dwell import Reference
from samii_rig.run.outputs import columns, completed
from samii_rig.run.plan import Plan
from samii_rig.types import Channel, Quality, SampleBlock, Segment

# s that the recorder may still write after the run: a queue that is full on a disk of a few
# megabytes a second. A disk that hangs for longer is reported, not waited for.
CLOSE_WITHIN = 30.0


class Sink(Protocol):
    """Where a run's samples and events go: a recorder."""

    def write(self, block: SampleBlock, /) -> None:
        """Keep these samples."""

    def event(self, time: int, name: str, payload: dict[str, Any], /) -> None:
        """Keep what happened at `time` (ns, device's clock): a gate decision, a gap, an error."""

    def segment(self, segment: Segment, /) -> None:
        """A part of the plan was done, whole; its samples were written before."""


@runtime_checkable
class Dated(Protocol):
    """A sink that stamps what it gets with the wall clock."""

    def clocks(self, device: int, wall: int, /) -> None:
        """The device's clock and the wall clock showed these times, ns, at one moment."""


def pair_clocks(sink: Sink, device: int, wall: int) -> None:
    """Tell `sink` these two times if it wants to know."""
    if isinstance(sink, Dated):
        sink.clocks(device, wall)


class QueuedSink:
    """Lets a slow sink work in a thread of its own, so that a slow disk never moves the output.

    What the thread raises comes out of every later call here: samples are lost from then on,
    and a caller that swallows it once must not end as if they were not. So does a DiskError when
    the thread is gone. A queue that is full raises DeviceError: a run that cannot be recorded ends.

    close_within : s that `close` waits for what is still queued.
    """

    def __init__(self, sink: Sink, depth: int = 256, close_within: float = CLOSE_WITHIN) -> None:
        self._sink, self._depth, self._close_within = sink, depth, close_within
        # No queue with locks of its own: an exception that comes from outside (Ctrl-C, the end of
        # the memory) in the wrong place would leave them locked for ever.
        self._queue: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._error: BaseException | None = None
        self._done = False
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def write(self, block: SampleBlock) -> None:
        """Queue samples."""
        self._put(lambda: self._sink.write(block))

    def event(self, time: int, name: str, payload: dict[str, Any]) -> None:
        """Queue an event."""
        self._put(lambda: self._sink.event(time, name, payload))

    def clocks(self, device: int, wall: int) -> None:
        """Queue a pair of times."""
        self._put(lambda: pair_clocks(self._sink, device, wall))

    def segment(self, segment: Segment) -> None:
        """Queue a finished segment."""
        self._put(lambda: self._sink.segment(segment))

    def close(self) -> None:
        """Return when all is written; raises what went wrong, DeviceError if it takes too long."""
        self._queue.put(None)
        self._thread.join(self._close_within)
        self._raise()
        if self._thread.is_alive():
            raise DeviceError(
                f"the recorder did not finish in {self._close_within:g} s; the last samples are "
                "lost; expected a disk that answers"
            )

    def _put(self, job: Callable[[], None]) -> None:
        self._raise()
        if self._queue.qsize() >= self._depth:
            raise DeviceError(
                f"the recorder fell {self._depth} blocks behind; expected a faster disk"
            )
        self._queue.put(job)

    def _raise(self) -> None:
        error = self._error
        if isinstance(error, Exception):
            raise error
        if error is not None:  # an end of the thread is none of the program
            raise DiskError(f"the recorder was ended by {type(error).__name__}") from error
        if not (self._done or self._thread.is_alive()):
            raise DiskError("the recorder's thread has ended")

    def _work(self) -> None:
        try:
            while (job := self._queue.get()) is not None:
                if self._error is None:
                    job()
            self._done = True
        except BaseException as error:
            self._error = error
            self._empty()

    def _empty(self) -> None:
        """Nothing is kept any more; what is queued goes."""
        while self._queue.get() is not None:
            pass


class Watched:
    """A sink that shows each block to somebody after it was taken."""

    def __init__(self, sink: Sink, watch: Callable[[SampleBlock], None]) -> None:
        self._sink, self._watch = sink, watch
        self.event, self.segment = sink.event, sink.segment

    def clocks(self, device: int, wall: int) -> None:
        """Hand on a pair of times."""
        pair_clocks(self._sink, device, wall)

    def write(self, block: SampleBlock) -> None:
        """Keep the samples, then show them."""
        self._sink.write(block)
        self._watch(block)


def recorded_channels(rig: Rig, plan: Plan, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
    """The columns of a run's recording: the device's own `channels`, and the reference.

    A device that reports channels of role `reference` itself is believed; to another's
    `u` and `theta_ref` are added, filled in from the plan by sample number.
    """
    if any(c.role == "reference" for c in channels):
        return channels
    units, added = rig.units(), list[Channel]()
    for output in completed(plan, rig).outputs:
        angle = units.get(output.centring_sensor, "1")
        u, theta_ref = reference_names(rig, output.actuator)
        added += [
            Channel(u, units[output.actuator], "reference", description="excitation"),
            Channel(theta_ref, angle, "reference", description="centring set point"),
        ]
    return (*channels, *added)


class Collector:
    """Gathers a device's blocks into larger ones with the columns of `recorded_channels`.

    reference : what is sent, as it stands. rows : samples after which `full` is true.
    """

    def __init__(
        self,
        rig: Rig,
        plan: Plan,
        reference: Reference,
        channels: tuple[Channel, ...],
        rows: int,
    ) -> None:
        self._rows, self._held, self._blocks = rows, 0, list[SampleBlock]()
        self._reference = reference
        self._start = -1
        self.channels = recorded_channels(rig, plan, channels)
        self._added = len(self.channels) > len(channels)

    def start_at(self, sequence: int) -> None:
        """The plan's first sample has this number."""
        self._start = sequence

    def add(self, block: SampleBlock) -> None:
        """Hold a block."""
        if len(block):
            self._blocks.append(block)
            self._held += len(block)

    @property
    def full(self) -> bool:
        """Whether enough is held to be worth a message."""
        return self._held >= self._rows

    def take(self) -> SampleBlock | None:
        """All that is held as one block, None if nothing is."""
        if not self._blocks:
            return None
        blocks, self._blocks, self._held = self._blocks, [], 0
        sequence = np.concatenate([b.sequence for b in blocks])
        values = np.concatenate([b.values for b in blocks])
        quality = np.concatenate([b.quality for b in blocks])
        if self._added:
            pairs = zip(
                columns(self._reference.u).T, columns(self._reference.theta_ref).T, strict=True
            )
            sent = [x for pair in pairs for x in pair]
            n = len(self._reference.u)
            at = sequence - self._start
            inside = (at >= 0) & (at < n) & (self._start >= 0)
            at = np.where(inside, at, 0)
            values = np.column_stack([values, *(np.where(inside, x[at], 0.0) for x in sent)])
            known = np.full((len(sequence), len(sent)), Quality.GOOD, dtype=np.uint8)
            quality = np.concatenate([quality, known], axis=1)
        time = np.concatenate([b.time for b in blocks])
        return SampleBlock(self.channels, time, sequence, values, quality)
