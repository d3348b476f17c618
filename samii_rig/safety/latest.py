"""What the gate knows of the samples: a small summary, carried on block by block."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.types import Float, Int, Quality, SampleBlock

# How much faster than the host's a device's clock may seem to fall behind before its
# samples count as old, s/s: ten times the 100 ppm of a poor crystal.
CLOCK_DRIFT = 1e-3
# Flags as plain numbers: an enum in an array operation costs more than the operation.
BLIND = np.uint8(Quality.MISSING | Quality.STALE)  # a value that says nothing new
CLIPPED, LIMITED = np.uint8(Quality.CLIPPED), np.uint8(Quality.LIMITED)
NEVER = -(2**62)  # a time before all others, ns


@dataclass(frozen=True, slots=True)
class Latest:
    """What the samples and the client said last; times in ns. n: channels the gate needs.

    good : (n,) device time of the newest value of each channel that was not blind.
    peak, rate : (n,) largest |value| and |change|/s in the newest block; NaN for a value
        that is not a number and not marked missing; the rate reaches back over the border.
    low : (n,) smallest value in the newest block, NaN before there was any.
    last : (n,) newest good value.
    since : (n,) time of the newest good value that differed from the one before it.
    travel, effort : (n,) integral of v and of |v| since then, in actuator unit times s.
    clipped : (n,) a converter at its end. limited : the device itself changed the output.
    stray : how far the output of the newest block was from what the device was commanded, see
        `readback.stray`.
    apart : how far the two of each agreement parted in the newest block, see `agreement.apart`.
    disorder : samples came out of order, now or before.
    sequence, time : of the newest sample. offset : smallest host minus device time, as of
        `offset_at`, host time.
    first : first sample at which the device must not change its output; -1 for none.
    next : sample that is commanded next; -1 for none.
    u, theta_ref : reference at the last sample commanded.
    """

    good: tuple[int, ...]
    peak: tuple[float, ...]
    rate: tuple[float, ...]
    low: tuple[float, ...]
    last: tuple[float, ...]
    since: tuple[int, ...]
    travel: tuple[float, ...]
    effort: tuple[float, ...]
    clipped: tuple[bool, ...]
    limited: bool = False
    stray: float = 0.0
    apart: tuple[float, ...] = ()
    disorder: bool = False
    sequence: int = -1
    time: int = NEVER
    offset: int = -NEVER
    offset_at: int = 0
    heartbeat: int = NEVER
    first: int = -1
    next: int = -1
    u: float = 0.0
    theta_ref: float = 0.0

    @classmethod
    def nothing(cls, n: int) -> Latest:
        """Before the first sample."""
        zero = (0.0,) * n
        never, unknown = (NEVER,) * n, (math.nan,) * n
        return cls(never, zero, zero, zero, unknown, never, zero, zero, (False,) * n)

    def age(self, i: int, now: int) -> float:
        """Seconds since channel i said something new; inf before it said anything.

        The two clocks have different zeros, so what is measured is how much later than the
        promptest sample so far: silence shows, and so does a queue that grows.
        """
        if self.good[i] == NEVER:
            return math.inf
        drift = CLOCK_DRIFT * (now - self.offset_at)
        return max(0.0, (now - self.good[i] - self.offset - drift) * 1e-9)


def observe(
    latest: Latest, block: SampleBlock, columns: Int, rates: tuple[int, ...], now: int
) -> Latest:
    """What is known after a block of samples.

    columns : (n,) column of each channel that the gate needs, the actuator's first.
    rates : which of those n have a limit on their rate.
    """
    n = len(block)
    if n == 0:
        return latest
    time, sequence = block.time, block.sequence
    values = block.values[:, columns]
    quality = block.quality[:, columns]
    held = lowest = values
    good, last = (int(time[-1]),) * len(columns), tuple(values[-1].tolist())
    clipped, limited = (False,) * len(columns), False
    seen: list[slice | Int] = [slice(None)] * len(columns)
    if quality.any():
        blind = (quality & BLIND) != 0
        clipped = tuple(((quality & CLIPPED) != 0).any(axis=0).tolist())
        commanded = sequence >= latest.first if latest.first >= 0 else np.zeros(n, dtype=bool)
        limited = bool(((quality[:, 0] & LIMITED) != 0)[commanded].any())
        # A blind value says nothing: the one before the block stands in its place.
        lowest = np.where(blind, latest.last, values)
        held = np.where(blind, np.nan_to_num(latest.last), values)
        seen = [np.flatnonzero(~b) for b in blind.T]
        ends = [int(rows[-1]) if len(rows) else -1 for rows in seen if not isinstance(rows, slice)]
        good = tuple(int(time[e]) if e >= 0 else g for e, g in zip(ends, latest.good, strict=True))
        last = tuple(
            float(values[e, i]) if e >= 0 else x
            for i, (e, x) in enumerate(zip(ends, latest.last, strict=True))
        )
    # Not a number, or infinite, without being marked missing: NaN, which trips.
    peaks = np.abs(held).max(axis=0).tolist()
    peak = tuple(x if x < math.inf else math.nan for x in peaks)
    rate = [0.0] * len(columns)
    for i in rates:
        rate[i] = _steepest(latest.last[i], latest.good[i], values[seen[i], i], time[seen[i]])
    since, travel, effort = _standstill(latest, values, time, seen)
    drifted = latest.offset + round(CLOCK_DRIFT * (now - latest.offset_at))
    return replace(
        latest,
        good=good,
        peak=peak,
        rate=tuple(rate),
        low=tuple(np.fmin.reduce(lowest, axis=0).tolist()),
        last=last,
        since=since,
        travel=travel,
        effort=effort,
        clipped=clipped,
        limited=limited,
        disorder=latest.disorder or not _in_order(latest, block),
        sequence=int(sequence[-1]),
        time=int(time[-1]),
        offset=min(drifted, now - int(time[-1])),
        offset_at=now,
    )


def _in_order(latest: Latest, block: SampleBlock) -> bool:
    """Whether times and sequence numbers rise, from the last block on and within this one."""
    time, sequence = block.time, block.sequence
    rises = bool(time[0] > latest.time and sequence[0] > latest.sequence)
    return rises and bool((time[1:] > time[:-1]).all() and (sequence[1:] > sequence[:-1]).all())


def _standstill(
    latest: Latest, values: Float, time: Int, seen: list[slice | Int]
) -> tuple[tuple[int, ...], tuple[float, ...], tuple[float, ...]]:
    """For each channel the time of its last change, and the integrals of v and |v| since."""
    # v acts from its sample to the next. One that is lost or no number moves nothing here:
    # the limits judge it.
    v = np.concatenate([[latest.last[0]], values[:-1, 0]])
    v[~np.isfinite(v)] = 0.0
    elapsed = np.diff(time, prepend=time[0] if latest.time == NEVER else latest.time) * 1e-9
    with np.errstate(over="ignore", invalid="ignore"):
        pushed, worked = np.cumsum(v * elapsed), np.cumsum(np.abs(v) * elapsed)
        rows = np.arange(len(time))
        since, travel, effort = list(latest.since), list(latest.travel), list(latest.effort)
        for i, good in enumerate(seen):
            x, at = values[good, i], rows[good]
            changed = at[x != np.concatenate([[latest.last[i]], x[:-1]])] if len(x) else at
            if len(changed):
                j = int(changed[-1])
                since[i] = int(time[j])
                travel[i] = float(pushed[-1] - pushed[j])
                effort[i] = float(worked[-1] - worked[j])
            else:
                travel[i] += float(pushed[-1])
                effort[i] += float(worked[-1])
    return tuple(since), tuple(travel), tuple(effort)


def _steepest(last: float, since: int, x: Float, t: Int) -> float:
    """Largest |dx/dt| in 1/s over the values x at t (ns), from the one before them on."""
    if len(x) == 0:
        return 0.0
    steepest = 0.0
    if not math.isnan(last):
        # max(1, ...): time that stands still is found by the check of the order.
        steepest = abs(float(x[0]) - last) / (max(1, int(t[0]) - since) * 1e-9)
    if len(x) > 1:
        inside = np.abs(x[1:] - x[:-1]) / (np.maximum(t[1:] - t[:-1], 1) * 1e-9)
        steepest = max(steepest, float(inside.max()))
    return steepest
