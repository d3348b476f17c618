"""A sensor of few steps that a diagnosis does without: what the next experiment has to change."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.diagnose.verdict.plan import harder
from samii_rig.rig.load import load_rig
from samii_rig.types import Channel, Recording, Segment

SFLR = load_rig("sflr")[0]
STEP = 2 * np.pi / 1024  # rad, of SFLR's encoder


def swept(steps: float, seconds: float = 8.0) -> Recording:
    """A command that drives throughout, and theta that moves by so many steps from end to end."""
    n = round(seconds * SFLR.rate_hz)
    wave = np.sin(2 * np.pi * 5.0 * np.arange(n) / SFLR.rate_hz)
    values = np.column_stack([10.0 * wave, np.rint(steps / 2 * wave) * STEP, wave])
    channels = (
        Channel("v", "count", "command", resolution=1.0),
        Channel("theta", "rad", "sensor", resolution=STEP),
        Channel("a", "m/s^2", "sensor"),
    )
    at, whole = np.arange(n), (Segment("sweep", "single", 0, n, 1.0, "count", 0),)
    return Recording(channels, SFLR.rate_hz, at, at, values, np.zeros(values.shape, int), whole)


@pytest.mark.parametrize(("steps", "times"), [(2.0, 2), (1.2, 2), (4.0, 2)])
def test_a_sensor_of_few_steps_asks_for_more_drive(steps: float, times: int) -> None:
    why, experiment = harder([swept(steps)], SFLR, {"theta"})
    assert "theta is not read" in why
    assert f"drive v {times} times as hard" in experiment


def test_what_stands_still_in_some_recordings_counts_where_it_moves() -> None:
    """A motion within half a step either way reads as none."""
    _, experiment = harder([swept(0.8), swept(0.8), swept(2.0)], SFLR, {"theta"})
    assert "moves by 2 of them" in experiment


def test_nothing_is_asked_for_where_no_sensor_is_left_out_or_none_moves() -> None:
    assert harder([swept(2.0)], SFLR, set()) == ("", "")
    assert harder([swept(0.8)], SFLR, {"theta"}) == ("", "")
