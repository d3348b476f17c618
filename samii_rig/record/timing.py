"""Which columns of a foreign file say when its samples were taken, and what they say."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from samii_rig.types import Float

# A step of a time column may be off a whole number of periods by this much, as the import has it.
_JITTER = 0.25
_EVEN_PART = 0.98  # of all steps, which are whole periods in a column of time
_TIMES = re.compile(r"^(t|time|zeit|temps|tid|timestamp|seconds|sec|x)([ _(].*)?$", re.IGNORECASE)
_COUNTS = re.compile(r"^(n|i|k|no|nr|index|sample|samples|count|counter|seq|sequence)$", re.I)
_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


@dataclass(frozen=True, slots=True)
class Timing:
    """When the samples were taken; the fields are those of `describe.Description`."""

    time: str = ""
    time_unit: str = "s"
    unit_guessed: bool = False
    sequence: str = ""
    rate_hz: float | None = None
    length_s: float = float("nan")
    gaps: int = 0
    lost: int = 0
    notes: tuple[str, ...] = ()


def timing(columns: Mapping[str, Float], units: Mapping[str, str], rate_hz: float | None) -> Timing:
    """What columns, with the units that some have, say of time. rate_hz : what the file states."""
    rising = {name: data for name, data in columns.items() if _rises(data)}
    sequence = next((name for name, data in rising.items() if _is_count(name, data)), "")
    count = rising.get(sequence)
    time = "" if rate_hz is not None else _time_column(rising, sequence, units, columns)
    unit, guessed, notes = "s", False, []
    if time:
        unit, guessed = _unit_of_time(time, rising[time], units.get(time, ""))
        seconds = rising[time] / _PER_SECOND[unit]
        per_sample = np.diff(seconds) / (1.0 if count is None else np.diff(count))
        rate_hz = float(f"{1.0 / float(np.median(per_sample)):.9g}")
        if count is None:
            steps = np.diff(seconds) * rate_hz
            off = np.flatnonzero((np.abs(steps - np.rint(steps)) > _JITTER) | (steps < 0.5))
            if off.size:
                notes.append(
                    f"{off.size} steps of {time!r} are no whole number of periods, the first "
                    f"at sample {off[0] + 1}; the import refuses them"
                )
            count = np.concatenate([[0.0], np.cumsum(np.maximum(np.rint(steps), 1.0))])
        rate_hz = _rate(seconds, count)
    if rate_hz is None:
        notes.append("nothing says the rate; the map needs rate_hz or a column of time")
    if count is None:
        count = np.arange(max(data.size for data in columns.values()), dtype=np.float64)
    jumps = np.diff(count) - 1.0
    length = float(count[-1] - count[0]) / rate_hz if rate_hz else float("nan")
    gaps, lost = int(np.count_nonzero(jumps)), int(jumps.sum())
    return Timing(time, unit, guessed, sequence, rate_hz, length, gaps, lost, tuple(notes))


def _rate(seconds: Float, count: Float) -> float:
    """Hz, of stamps (n,) of so many samples since the first: their mean rate, which the last digit
    of a stamp moves least; the whole number if one is as near as the stamps tell. Where a clock
    jumps or rows are missing that no count tells, that of the middle step."""
    length, samples = float(seconds[-1] - seconds[0]), count - count[0]
    mean = float(samples[-1]) / length
    away = float(np.max(np.abs(seconds - seconds[0] - samples / mean)))
    if away * mean > _JITTER:  # steps so long that the last digit hardly moves them
        apart = max(count.size // 8, 1)
        steps = (seconds[apart:] - seconds[:-apart]) / (count[apart:] - count[:-apart])
        return float(f"{1.0 / float(np.median(steps)):.9g}")
    off = away / length * mean
    whole = round(mean)
    return float(whole) if abs(mean - whole) <= off else float(f"{mean:.9g}")


def _time_column(
    rising: Mapping[str, Float],
    sequence: str,
    units: Mapping[str, str],
    columns: Mapping[str, Float],
) -> str:
    """The column of time: by its unit, else by its name, else the first column if it rises."""
    others = [name for name in rising if name != sequence]
    by_unit = [name for name in others if units.get(name) in _PER_SECOND]
    by_name = [name for name in others if _TIMES.match(name)]
    first = [name for name in others if name == next(iter(columns))]
    return next(iter([*by_unit, *by_name, *first]), "")


def _rises(data: Float) -> bool:
    """A column that may be time or a count: it rises, by whole multiples of one step."""
    if data.size < 3 or not np.isfinite(data).all():
        return False
    steps = np.diff(data)
    if not (steps > 0).all():
        return False
    periods = steps / float(np.median(steps))
    return bool(np.mean(np.abs(periods - np.rint(periods)) <= _JITTER) >= _EVEN_PART)


def _is_count(name: str, data: Float) -> bool:
    whole = bool((data == np.rint(data)).all()) and float(np.median(np.diff(data))) == 1.0
    return whole and bool(_COUNTS.match(name))


def _unit_of_time(name: str, data: Float, stated: str) -> tuple[str, bool]:
    """The unit of a column of time, and whether it is a guess."""
    if stated in _PER_SECOND:
        return stated, False
    ending = re.search(r"[_( ](s|ms|us|ns)\)?$", name)
    if ending:
        return ending[1], False
    # No rig is sampled slower than once a second: whole steps of 1 or more are smaller units.
    step = float(np.median(np.diff(data)))
    for unit, factor in _PER_SECOND.items():
        if step < factor:
            return unit, True
    return "ns", True
