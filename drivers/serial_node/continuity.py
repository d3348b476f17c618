"""Whether a node's frames go on from each other: its numbers, its clock, how many are bad."""

from __future__ import annotations

import time
from collections import deque

from drivers.serial_node.link import Link
from drivers.serial_node.wire import HALF, WORD, Event, Samples

# How far the node's clock may be from its own sample count before one of them was reset.
CLOCK_SLACK = 2.0  # samples
CLOCK_DRIFT = 0.01  # of the time between two frames


class Continuity:
    """Numbers and times without their wraps at 2^32.

    period_ns : of a sample. most_bad : frames in one second that may be bad.
    trouble : why the samples cannot go on, "" while they can.
    """

    def __init__(self, link: Link, period_ns: int, most_bad: float) -> None:
        self._link, self._period, self._most_bad = link, period_ns, most_bad
        self.trouble = ""
        self._sample = -1
        self._clock = 0  # us
        self._rejected: int | None = None
        self._bad = 0
        self._history: deque[tuple[float, int]] = deque([(time.monotonic(), 0)])

    @property
    def clock(self) -> int:
        """ns, of the newest frame's first sample."""
        return self._clock * 1000

    def time_of(self, event: Event) -> int:
        """ns on the node's clock; the newest sample's before there is any."""
        ahead = (event.sample - self._sample + HALF) % WORD - HALF
        return max(0, self.clock + ahead * self._period)

    def bad(self) -> dict[str, str | int | float]:
        """Counts of what was wrong on the line."""
        d = self._link.decoder
        return {
            "frames_lost": d.lost,
            "frames_corrupt": d.corrupt,
            "frames_stale": d.stale,
            "frames_refused_by_node": self._bad,
            "streams_refused_by_node": self._link.refused,
        }

    def take(self, frames: list[Samples]) -> list[tuple[int, int]]:
        """Sample number and clock (us) of each frame, up to where the clock jumps against the
        count."""
        self._count_bad(frames)
        starts: list[tuple[int, int]] = []
        period = self._period / 1000
        for f in frames:
            if self._sample < 0:
                self._sample, self._clock = f.first, f.clock_us
            else:
                ahead = (f.first - self._sample) % WORD
                expected = self._clock + round(ahead * period)
                off = (f.clock_us - expected + HALF) % WORD - HALF
                if not 0 < ahead < HALF or abs(off) > period * (CLOCK_SLACK + CLOCK_DRIFT * ahead):
                    self.trouble = (
                        f"{self._link.name}: the node's clock jumped by {off * 1e-6:.3g} s against "
                        f"its count of samples, at sample {f.first}"
                    )
                    break
                self._sample, self._clock = self._sample + ahead, expected + off
            starts.append((self._sample, self._clock))
        return starts

    def _count_bad(self, frames: list[Samples]) -> None:
        """Notice when a second had more bad frames, of both ways, than are allowed."""
        for f in frames:
            before = f.rejected if self._rejected is None else self._rejected
            self._bad += (f.rejected - before) % (1 << 16)
            self._rejected = f.rejected
        d, now = self._link.decoder, time.monotonic()
        total = d.lost + d.stale + self._bad
        self._history.append((now, total))
        while self._history[0][0] < now - 1.0:
            self._history.popleft()
        bad = total - self._history[0][1]
        if bad > self._most_bad:
            self.trouble = (
                f"{self._link.name}: {bad} frames lost or damaged within a second; allowed "
                f"{self._most_bad:g} (device.settings.max_bad_frames); check cable and shield"
            )
