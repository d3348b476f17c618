"""What a run sends: the plan's reference, which may be shortened while it goes.

The device is always some tens of milliseconds ahead (see `loop`), so a dwell is left at the
first end of a block that has not been sent yet. What is sent stays sent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import InputError
from samii_rig.run.plan import Dwell, Plan, PlannedSegment
from samii_rig.signal.stepped import line
from samii_rig.types import Channel, Complex, Int, Quality, SampleBlock

# Of the largest sample, by how much blocks of a dwell may differ: rounding.
ALIKE = 1e-9
MIXED = 4  # ways through a plan that are looked at beside the longest and the shortest


def check_segments(plan: Plan) -> None:
    """InputError for a segment whose rows differ in length, or whose dwell cannot be left
    without a step, or never.

    What is left out must be whole blocks of a reference that repeats in blocks, so that the next
    sample sent is the one that would have come.
    """
    where = f"experiment {plan.experiment}"
    for s in plan.segments:
        n, k = s.frequency.size, len(plan.outputs)
        shapes = {s.u.shape, s.theta_ref.shape}
        wide = (n,) if k == 1 else (n, k)
        if shapes != {wide} or s.frequency.shape != (n,) or n == 0:
            shapes.add(s.frequency.shape)
            expected = "u, theta_ref and frequency of one length, at least one sample"
            if k > 1:
                expected = f"u and theta_ref of {k} columns, and {expected}"
            raise InputError(where, s.name, sorted(shapes), expected)
        wrong = _wrong(s, s.dwell) if s.dwell else None
        if wrong:
            what, value, expected = wrong
            raise InputError(where, f"{s.name}.dwell.{what}", value, expected)


def _wrong(s: PlannedSegment, d: Dwell) -> tuple[str, object, str] | None:
    n = len(s.u)
    if not 0 <= d.first < d.last <= n:
        return "last", (d.first, d.last), f"0 <= first < last <= {n}, the segment's samples"
    if d.block < 1 or (d.last - d.first) % d.block:
        return "block", d.block, f"a divisor of the {d.last - d.first} samples of the dwell"
    if not 2 <= d.least <= d.blocks:
        return "least", d.least, f"2 to {d.blocks}, the blocks of the dwell"
    if not d.outputs:
        return "outputs", d.outputs, "at least one sensor"
    start, stop = s.recorded or (0, n)
    if not (start <= d.first and d.last <= stop):
        return "first", (d.first, d.last), f"inside what is recorded, {start} to {stop}"
    for x in (s.u, s.theta_ref):
        blocks = x[d.first : d.last].reshape(d.blocks, -1)
        if not np.abs(blocks - blocks[0]).max() <= ALIKE * max(1.0, np.abs(blocks[0]).max()):
            return "block", d.block, "a reference that is the same in every block"
    return None


def ways(plan: Plan) -> tuple[Plan, ...]:
    """The plan with every dwell in full; if it has any, with each as short as it may be, and
    with `MIXED` draws between, always the same. InputError as `check_segments`.

    What rings on from one frequency meets the next in another phase each way, so neither the
    longest nor the shortest is the worst of all.
    """
    check_segments(plan)
    if plan.shortest is None:
        return (plan,)
    draw = np.random.default_rng(plan.seed)
    mixed = []
    for _ in range(MIXED):
        segments = []
        for s in plan.segments:
            if s.dwell is not None:
                blocks = int(draw.integers(s.dwell.least, s.dwell.blocks + 1))
                s = s.shortened(s.dwell.first + blocks * s.dwell.block)
            segments.append(s)
        mixed.append(replace(plan, segments=tuple(segments)))
    return (plan, plan.shortest, *mixed)


class Reference:
    """The samples of a plan in one row, and where its segments are in it.

    u, theta_ref : (n,), of several outputs (n, k); changed only at samples that are still to be
    sent. InputError as `check_segments`.
    """

    def __init__(self, plan: Plan) -> None:
        check_segments(plan)
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
        self._actuator = actuator
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
        if self._sum[whole, 0].sum() == 0.0:
            return None  # an output that never moved, below half a step of its converter
        found = line(np.ones(n, dtype=np.complex128), self._sum[whole])
        relative = float(found.relative.max())
        if not relative <= segment.dwell.wanted:
            return None
        blocks = max(-(-(sent - begin - segment.dwell.first) // segment.dwell.block), n)
        if blocks >= segment.dwell.blocks:
            return None
        self._reference.shorten(i, segment.dwell.first + blocks * segment.dwell.block)
        return Left(segment.name, blocks, relative)

    def _driven(self, i: int) -> str:
        """The actuator that segment i drives; the first of several."""
        return (*self._reference.segments[i].excited, self._actuator)[0]

    def _add(self, i: int, dwell: Dwell, block: SampleBlock, first: int) -> None:
        columns = [self._names.index(name) for name in (self._driven(i), *dwell.outputs)]
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
