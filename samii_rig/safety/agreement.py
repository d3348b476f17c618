"""Whether a sensor agrees with what else is known of the same thing, or drifts away from it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from samii_rig.types import Quality, SampleBlock

UNTOLD = np.uint8(Quality.MISSING | Quality.STALE)


@dataclass(frozen=True, slots=True)
class Agreement:
    """A sensor and another one, or the output that turns it; see `samii_rig.rig.schema.Agreement`.

    gain : unit of the sensor per s and unit of the output `other`; 0 for another sensor.
    """

    sensor: str
    other: str
    unit: str
    max: float
    reason: str
    gain: float = 0.0
    over: float = math.inf


@dataclass(frozen=True, slots=True)
class Followed:
    """How far a sensor has gone by itself, after its newest value.

    time : ns. value, output : of sensor and output then, NaN before the first. lead : what of its
    way the output does not explain.
    """

    time: int = 0
    value: float = math.nan
    output: float = 0.0
    lead: float = 0.0


def apart(
    a: Agreement, columns: tuple[int, int], before: Followed, block: SampleBlock
) -> tuple[Followed, float]:
    """How far the two are apart at most in a block, and what the next one goes on from.

    For another sensor that is the difference. For an output v it is e, from

        e' = theta' - gain v - e/over,    e = 0 at first,

    a sensor's way less that of an angular velocity source, forgotten over `over` s: a drift of r
    per second comes to r over. columns : of sensor and other. A value that was not reported says
    nothing here; how long that may last is the channel's own limit.
    """
    values = block.values[:, columns]
    good = ((block.quality[:, columns] & UNTOLD) == 0).all(axis=1) & np.isfinite(values).all(axis=1)
    values, times = values[good], block.time[good]
    if a.gain == 0.0:
        return before, float(np.abs(values[:, 0] - values[:, 1]).max(initial=0.0))
    now, most = before, 0.0
    for time, (value, output) in zip(times.tolist(), values.tolist(), strict=True):
        lead = now.lead
        if not math.isnan(now.value):
            step = (time - now.time) * 1e-9
            lead = lead * math.exp(-step / a.over) + value - now.value - a.gain * now.output * step
        now = Followed(time, value, output, lead)
        most = max(most, abs(lead))
    return now, most
