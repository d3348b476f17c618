"""Two clocks held against each other: a line through paired times, with its uncertainty.

A device stamps a sample on its own clock, the host notes when the sample arrived:

    host = device + offset + drift (device - origin) + delay,    delay >= 0.

The delay has a floor that hardly changes (wire, converter, operating system) and a tail that a
busy machine makes. So only the promptest pair of each short interval counts, a straight line is
laid through those by least squares, and what lies far above it is left out. The line knows
nothing of the floor itself: that is a systematic uncertainty, and whoever knows an interval for
it (a round trip measures one) states it as `latency`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from samii_rig.types import Float, Int

INTERVAL = 100_000_000  # ns of which the promptest pair counts
KEPT = 600  # intervals: a minute, over which a crystal's rate does not change
LEAST = 3  # intervals before a line is worth anything
# Relative rate of two clocks that is known before anything is measured, 1 sigma: two poor
# crystals, 100 ppm each at most.
CRYSTALS = 1e-4
TICK = 1e-6  # s, floor of the scatter: no two clocks are read at the same moment
FAR = 4.0  # scatters above the line at which a pair was late and is left out


@runtime_checkable
class Timed(Protocol):
    """A sensor whose samples carry its own clock, and that knows when they arrived.

    latency : s, the shortest and the longest time that may pass from a sample's instant to its
        arrival when nothing else holds it up.
    """

    latency: tuple[float, float]

    def arrivals(self) -> Int:
        """(n, 2) ns: device's time and host's monotonic time of arrival, those since the last
        call."""


@dataclass(frozen=True, slots=True)
class ClockFit:
    """host = device + offset + drift (device - origin).

    origin, offset : ns. drift : s/s. drift_sigma : its standard deviation.
    sigma : s, standard deviation of the offset at the newest pair: the fit's own, and an even
        distribution over the interval of the latency. scatter : s, of the pairs around the line.
    """

    origin: int
    offset: float
    drift: float
    drift_sigma: float
    sigma: float
    scatter: float

    def host(self, device: Int) -> Int:
        """Host's times of the device's times, ns."""
        since = (device - self.origin).astype(np.float64)
        host: Int = device + np.rint(self.offset + self.drift * since).astype(np.int64)
        return host

    def device(self, host: Int) -> Int:
        """Device's times of the host's times, ns."""
        since = (host - self.origin - self.offset) / (1.0 + self.drift)
        device: Int = self.origin + np.rint(since).astype(np.int64)
        return device


class ClockModel:
    """The line, kept up to date from pairs as they come.

    latency : as in `Timed`; its middle is taken off, its width is part of `sigma`.
    """

    def __init__(self, latency: tuple[float, float] = (0.0, 0.0)) -> None:
        self.latency = latency
        self._pairs: deque[tuple[int, int]] = deque(maxlen=KEPT)  # device, host - device
        self._interval = -1
        self._best: tuple[int, int] | None = None
        self._fit: ClockFit | None = None

    def add(self, pairs: Int) -> None:
        """Take (n, 2) pairs of device's and host's time, ns, in the order of arrival."""
        for device, host in pairs.tolist():
            interval, apart = device // INTERVAL, host - device
            if interval != self._interval:
                if self._best is not None:
                    self._pairs.append(self._best)
                    self._fit = None
                self._interval, self._best = interval, None
            if self._best is None or apart < self._best[1]:
                self._best = (device, apart)

    @property
    def ready(self) -> bool:
        """Whether there are enough pairs for a line."""
        return len(self._pairs) >= LEAST

    def fit(self) -> ClockFit:
        """The line through what came so far; ValueError before it is `ready`."""
        if not self.ready:
            raise ValueError(f"{len(self._pairs)} intervals of paired times; expected {LEAST}")
        if self._fit is None:
            self._fit = _line(np.array(self._pairs, dtype=np.int64), self.latency)
        return self._fit


def _line(pairs: Int, latency: tuple[float, float]) -> ClockFit:
    """Least squares with the crystals' rate as prior, late pairs left out."""
    origin, base = int(pairs[-1, 0]), int(pairs[:, 1].min())
    x: Float = ((pairs[:, 0] - origin) * 1e-9).astype(np.float64)
    y: Float = ((pairs[:, 1] - base) * 1e-9).astype(np.float64)
    kept = np.ones(len(x), dtype=bool)
    for _ in range(3):
        a, b, covariance, scatter = _fitted(x[kept], y[kept])
        near = y - (a + b * x) <= FAR * scatter
        if np.array_equal(near, kept) or near.sum() < LEAST:
            break
        kept = near
    low, high = latency
    sigma = float(np.hypot(np.sqrt(covariance[0, 0]), (high - low) / np.sqrt(12.0)))
    return ClockFit(
        origin,
        base + (a - 0.5 * (low + high)) * 1e9,
        b,
        float(np.sqrt(covariance[1, 1])),
        sigma,
        scatter,
    )


def _fitted(x: Float, y: Float) -> tuple[float, float, Float, float]:
    """Offset and rate of y over x, their covariance (2, 2), and the scatter around the line.

    The scatter is found from the line's own residuals by the median, so that single late pairs
    do not widen it; the prior's weight depends on it, hence the second pass.
    """
    scatter = TICK
    A = np.column_stack([np.ones_like(x), x])
    for _ in range(2):
        normal = A.T @ A / scatter**2 + np.diag([0.0, CRYSTALS**-2])
        covariance: Float = np.linalg.inv(normal).astype(np.float64)
        a, b = covariance @ (A.T @ y) / scatter**2
        rest = y - (a + b * x)
        # 1.4826: standard deviation of a normal distribution over its median deviation.
        scatter = max(TICK, 1.4826 * float(np.median(np.abs(rest - np.median(rest)))))
    return float(a), float(b), covariance, scatter
