"""Samples of one device at the times of another."""

from __future__ import annotations

import numpy as np

from samii_rig.types import Channel, Flags, Float, Int, Quality, SampleBlock

PAST_KEPT = 4096  # samples: seconds, more than anything waits
AROUND = 4  # samples through which the cubic goes
# s between two samples beyond which nothing is known between them: of a motion below 15 Hz the
# cubic then misses 2 % at most, and a host that is late by 12 ms, as one in ten thousand is,
# loses nothing. Slower devices: so many of their usual times between two samples.
GAP = 0.015
USUALS = 2.5


class Track:
    """The newest samples of a device, on the time that is asked for.

    gap : s between two samples that is bridged at most.
    heard : ns of the host, when a good sample came last.
    """

    def __init__(self, channels: tuple[Channel, ...], gap: float = GAP) -> None:
        self.channels = channels
        self.heard = 0
        self.gap = gap
        m = len(channels)
        self._time: Int = np.zeros(0, dtype=np.int64)
        self._values: Float = np.zeros((0, m))
        self._clipped = np.zeros((0, m), dtype=bool)
        self._usual = 0.0

    def add(self, times: Int, block: SampleBlock, now: int) -> None:
        """Samples at these times, ns; those without a number leave a gap."""
        good = np.isfinite(block.values).all(axis=1)
        good &= ~(block.quality & Quality.MISSING).any(axis=1)
        # A better knowledge of the clocks may move a time a little below the last one.
        if len(self._time):
            good &= times > self._time[-1]
        if not good.any():
            return
        self.heard = now
        clipped = (block.quality[good] & Quality.CLIPPED) != 0
        self._time = np.concatenate([self._time, times[good]])[-PAST_KEPT:]
        self._values = np.concatenate([self._values, block.values[good]])[-PAST_KEPT:]
        self._clipped = np.concatenate([self._clipped, clipped])[-PAST_KEPT:]
        self._usual = float(np.median(np.diff(self._time[-64:]))) if len(self._time) > 1 else 0.0

    @property
    def known(self) -> int:
        """The latest time that lies between four samples; nothing before there are as many."""
        return int(self._time[-2]) if len(self._time) >= AROUND else -(2**62)

    def at(self, times: Int) -> tuple[Float, Flags]:
        """(n, m) values and flags at these times, through the samples around them; NaN and MISSING
        where these are not there or too far apart. CLIPPED as the two neighbours are."""
        n, m = len(times), len(self.channels)
        values = np.full((n, m), np.nan)
        quality = np.full((n, m), Quality.MISSING, dtype=np.uint8)
        t = self._time
        most = max(self.gap * 1e9, USUALS * self._usual)
        after = np.searchsorted(t, times, "left")
        # A line through two where there are no four, as at both ends of a gap.
        for width in (1, AROUND // 2):
            first = after - width
            inside = np.flatnonzero((first >= 0) & (after + width - 1 < len(t)))
            own = first[inside]
            steps = [t[own + k + 1] - t[own + k] for k in range(2 * width - 1)]
            near = np.all([s <= most for s in steps], axis=0)
            rows, own = inside[near], own[near]
            values[rows] = self._through(own, 2 * width, times[rows])
            ends = self._clipped[own + width - 1] | self._clipped[own + width]
            quality[rows] = np.where(ends, Quality.CLIPPED, Quality.GOOD).astype(np.uint8)
        return values, quality

    def _through(self, first: Int, count: int, times: Int) -> Float:
        """Lagrange's polynomial through `count` samples from each `first` on."""
        at = first[:, None] + np.arange(count)
        # In units of the usual time between samples, so that products stay of one size.
        x = (self._time[at] - times[:, None]) / max(self._usual, 1.0)
        # From the first one on: what stands still stays the very same value, bit by bit.
        start = self._values[at[:, 0]]
        out: Float = start.copy()
        for j in range(1, count):
            others = [k for k in range(count) if k != j]
            weight = np.prod([x[:, k] / (x[:, k] - x[:, j]) for k in others], axis=0)
            out += weight[:, None] * (self._values[at[:, j]] - start)
        return out
