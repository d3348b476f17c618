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
    den = (before - floor)[rows].sum(axis=1)
    # Where nothing is left to be closed, only the sign of the change says anything.
    value = (a - b) / (a - 1) if a > 1 else min(a - b, 0.0)
    drawn = num / np.where(np.abs(den) > 0, np.abs(den), np.inf)
    low, high = np.quantile(drawn, [0.05, 0.95])
    return Gap(float(value), float(low), float(high))
