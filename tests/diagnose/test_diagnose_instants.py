"""An input that jumps at an instant between two samples, and was seen by a meter."""

from __future__ import annotations

import numpy as np
from table_kit import table_of
from two_masses_kit import RATE, RIG, diagnosed, recorded


def test_steps_that_a_meter_showed_came_at_any_time_within_a_sample() -> None:
    """Taken for steps at the samples they are 13 times the noise of x_1."""
    t = np.arange(round(10.0 * RATE)) / RATE
    up = np.sin(2 * np.pi * (1.0 + 0.95 * t) * t)
    v = np.concatenate([up, up[::-1]])
    for at, height in ((2002, 2.0), (3501, -3.0), (5003, 1.5), (6502, -0.5)):
        v[at:] += height
    every = 4
    run = recorded(v, 6, every=every, meter=4e-3)
    rig = RIG.model_copy(update={"rate_hz": RATE / every})
    few = table_of(rig, 1.0, 50.0, "added_mass", "input_not_held")
    found = diagnosed(run, effects=few, rig=rig)
    assert found.verdict == "no_mismatch"
    assert 0.8 < found.chi2_per_dof < found.threshold
    assert not any("times the noise" in words for words in found.not_physics)
