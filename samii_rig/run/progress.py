"""How far a run is, as its display shows it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is, for a display.

    segment : 1-based, of n_segments; name, level, unit, repeat are the segment's.
    time_left : s on the device's clock, every dwell in full. frequency : Hz now, NaN at rest,
        inf where the whole band is driven at once.
    channel, margin : the channel nearest to its limit since the last report, 1 - |value|/limit.
    worst_channel, worst_margin : the same over the whole run.
    """

    segment: int
    n_segments: int
    name: str
    level: float
    unit: str
    repeat: int
    time_left: float
    frequency: float
    channel: str
    margin: float
    worst_channel: str
    worst_margin: float
    late_ticks: int
    missing_samples: int


def nearer(a: tuple[str, float], b: tuple[str, float]) -> tuple[str, float]:
    """Of two channels with their margins the one with less."""
    return a if a[1] <= b[1] else b
