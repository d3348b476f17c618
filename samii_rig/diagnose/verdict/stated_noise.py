"""The noise of the records against that which the rig file states for its sensors.

Noise is estimated from what a model leaves. What follows the motion and is in no row, or changes
within a record that never repeats, passes for it: then there is more of it than the sensors have,
and it is unlike noise in what it does to the response.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.fit.own_noise import MORE_NOISE, estimated, stated
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.units import pretty

# Times the noise of a sensor, root mean square, from which nothing is said to be missing or not,
# and no cause is sure: twice the most of 46 recordings in which nothing was hidden. A spring that
# swings by 3 % in one record makes 29.
FAR_MORE = 20.0
# Times as far below 1 as the threshold is above, from which chi-square is no steady noise's: 2 of
# 685 recordings in which nothing was hidden lie below, gains that sag and cogging do by as much.
TOO_WELL = 2.0
# Part of what a pulse has at any frequency that it has just below half the rate, from which what
# folds back may be told as physics: half-sines of 4 samples have 7 %, of 8 2 %, of 12 0.8 %, and
# through a Butterworth filter of order 6 at 0.35 of the rate, with 1.04 times the noise, 1.6 %.
UNFILTERED = 0.02


@dataclass(frozen=True, slots=True)
class MoreNoise:
    """More noise than a sensor's own. times : root mean square, over what the rig file states."""

    sensor: str
    unit: str
    times: float
    rms: float

    def describe(self) -> str:
        """In words."""
        return (
            f"{self.sensor} has {self.times:.0f} times the noise that the rig file states for it "
            f"({self.rms:.2g} for {self.rms / self.times:.2g} {pretty(self.unit)}): a disturbance, "
            "or something in no row that passes for noise; repeats of one excitation tell which"
        )

    @property
    def far_more(self) -> bool:
        """Whether what passes for noise may be anything."""
        return self.times > FAR_MORE


def unfiltered(search: RecordSearch, best: Explanation) -> str:
    """That pulses were measured without a filter before the converter, so that what they are
    between samples is not in the record, in words; "" where they were not. best : the explanation
    that is told, by which the input was measured."""
    whole = search.whole
    measured = {e.site for e in best.effects if e.physics == "input_not_held"}
    measured |= {a.name for a in best.fitted.model.built.actuator if not a.held}
    if not isinstance(whole, Whole) or not measured:
        return ""
    each = zip(*(c.meter for p in whole.records.pieces for c in p.commands), strict=True)
    for x, noise in zip(whole.wired.inputs, each, strict=True):
        folds = float(np.median([one.folds for one in noise]))
        if x.command in measured and folds > UNFILTERED:
            return (
                f"the pulses of {x.command} have {100 * folds:.0f} % of their amplitude at half "
                "the rate: they were recorded without an anti-aliasing filter, and nobody knows "
                f"what they are between samples; record {x.command} and the sensors through one, "
                "or at a higher rate"
            )
    return ""


def fits_too_well(ratio: float, threshold: float) -> bool:
    """Whether a chi-square per degree of freedom lies farther below 1 than noise brings it."""
    return 1 - ratio > TOO_WELL * (threshold - 1)


def more_noise(search: RecordSearch) -> MoreNoise | None:
    """The sensor whose noise is the most over the one that the rig file states; None where no
    sensor has so much, or none has its noise stated."""
    whole = search.whole
    if not isinstance(whole, Whole) or np.all(np.isnan(known := stated(whole))):
        return None
    units = {s.name: s.unit for s in whole.rig.sensor}
    each = [
        MoreNoise(name, units[name], float(rms / own), float(rms))
        for name, rms, own in zip(whole.wired.sensors, estimated(search, whole), known, strict=True)
        if rms > MORE_NOISE * own
    ]
    return max(each, key=lambda one: one.times, default=None)
