"""What a run sends: the plan's reference, which may be shortened while it goes.

The device is always some tens of milliseconds ahead (see `loop`), so a dwell is left at the
first end of a block that has not been sent yet. What is sent stays sent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.run.protocols import Dwell, Plan
from samii_rig.signal.stepped import line
from samii_rig.types import Channel, Complex, Int, Quality, SampleBlock


class Reference:
    """The samples of a plan in one row, and where its segments are in it.

    u, theta_ref : (n,); changed only at samples that are still to be sent.
    """

    def __init__(self, plan: Plan) -> None:
        self.segments = list(plan.segments)
        self._lay()

    def _lay(self) -> None:
        self.u = np.concatenate([s.u for s in self.segments])
        self.theta_ref = np.concatenate([s.theta_ref for s in self.segments])
        self.ends: Int = np.cumsum([len(s.u) for s in self.segments])

    def begin(self, i: int) -> int:
        """First sample of segment i."""
        return int(self.ends[i]) - len(self.segments[i].u)

    def at(self, sample: int) -> int:
        """The segment that holds this sample."""
        return int(np.searchsorted(self.ends, sample, side="right"))

    def shorten(self, i: int, leave: int) -> None:
        """Leave the dwell of segment i at its sample `leave`."""
        self.segments[i] = self.segments[i].shortened(leave)
        self._lay()


@dataclass(frozen=True, slots=True)
class Left:
    """A dwell that was left early: after how many blocks, and how well the response of the
    worst output was known when that was decided."""

    name: str
    blocks: int
    relative: float


class Watch:
    """Looks at the samples of a dwell block by block and says when enough is known.

    channels : of the device, the actuator called `actuator` among them.
    """

    def __init__(self, reference: Reference, channels: tuple[Channel, ...], actuator: str) -> None:
        self._reference = reference
        self._names = [c.name for c in channels]
        self._input = self._names.index(actuator)
        self._segment = -1
        self._sum: Complex = np.zeros((0, 0), dtype=np.complex128)
        self._held: Int = np.zeros(0, dtype=np.int64)
        self._whole = 0

    def take(self, block: SampleBlock, start: int, sent: int) -> Left | None:
        """Take in samples; shortens the reference and says so where a dwell has done enough.

        start : number of the plan's first sample. sent : samples of the plan already sent.
        """
        newest = int(block.sequence[-1]) - start
        if not 0 <= newest < len(self._reference.u):
            return None
        i = self._reference.at(newest)
        segment = self._reference.segments[i]
        if segment.dwell is None:
            return None
        begin = self._reference.begin(i)
        self._add(i, segment.dwell, block, start + begin + segment.dwell.first)
        whole = self._held == segment.dwell.block
        n = int(np.count_nonzero(whole))
        if n == self._whole or n < segment.dwell.least:
            return None
        self._whole = n
        found = line(np.ones(n, dtype=np.complex128), self._sum[whole])
        relative = float(found.relative.max())
        if not relative <= segment.dwell.wanted:
            return None
        blocks = max(-(-(sent - begin - segment.dwell.first) // segment.dwell.block), n)
        if blocks >= segment.dwell.blocks:
            return None
        self._reference.shorten(i, segment.dwell.first + blocks * segment.dwell.block)
        return Left(segment.name, blocks, relative)

    def _add(self, i: int, dwell: Dwell, block: SampleBlock, first: int) -> None:
        columns = [self._input, *(self._names.index(name) for name in dwell.outputs)]
        if i != self._segment:
            self._segment, self._whole = i, 0
            self._sum = np.zeros((dwell.blocks, len(columns)), dtype=np.complex128)
            self._held = np.zeros(dwell.blocks, dtype=np.int64)
        at = block.sequence - first
        values = block.values[:, columns]
        missing = ((block.quality[:, columns] & Quality.MISSING) != 0).any(axis=1)
        # A block that misses a sample never becomes whole.
        good = (at >= 0) & (at < dwell.last - dwell.first) & ~missing
        good &= np.isfinite(values).all(axis=1)
        at = at[good]
        turn = np.exp(-2j * np.pi * dwell.cycles * (at % dwell.block) / dwell.block)
        np.add.at(self._sum, at // dwell.block, turn[:, None] * values[good])
        np.add.at(self._held, at // dwell.block, 1)
