"""How much of a mismatch a model closes, with an interval."""

from __future__ import annotations

import numpy as np

from samii_rig.diagnose.result import Gap
from samii_rig.types import Float

DRAWS = 1000  # of the bootstrap: its 5 % quantile is known to 0.7 %


def gap_of(before: Float, after: Float, floor: Float) -> Gap:
    """The part that is closed, of chi-square (n,) line by line before and after; `floor` (n,) where
    there is noise alone."""
    a, b = (float(np.sum(x) / np.sum(floor)) for x in (before, after))
    rows = np.random.default_rng(1).integers(0, before.size, (DRAWS, before.size))
    num = (before - after)[rows].sum(axis=1)
    if a <= 1:  # nothing is left to be closed: only the change itself says anything
        drawn = num / floor[rows].sum(axis=1)
        return Gap(a - b, *_within(drawn), of_noise=True)
    den = (before - floor)[rows].sum(axis=1)
    drawn = num / np.where(den > 0, den, np.inf)
    # Draws in which there was nothing to close: all of it, in the direction of the change.
    drawn = np.where(den > 0, drawn, np.sign(num))
    return Gap((a - b) / (a - 1), *_within(drawn))


def _within(drawn: Float) -> tuple[float, float]:
    """The 90 % interval of what was drawn."""
    low, high = np.quantile(drawn, [0.05, 0.95])
    return float(low), float(high)
