"""Rows of a recording in which nothing that is needed is missing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from samii_rig.types import Quality, Recording


def whole_rows(cut: Recording, names: Sequence[str]) -> tuple[NDArray[np.bool_], tuple[int, ...]]:
    """(n,) the rows in which no needed channel is missing, and the breaks among them."""
    columns = [cut.column(n) for n in names]
    missing = (cut.quality[:, columns] & Quality.MISSING).astype(bool)
    kept: NDArray[np.bool_] = np.all(~missing & np.isfinite(cut.values[:, columns]), axis=1)
    jumps = np.flatnonzero(np.diff(cut.sequence[kept]) > 1) + 1
    return kept, tuple(int(j) for j in jumps)
