"""A sensor that wanders over a run of bursts: no scatter shows it, the periods' means do."""

import numpy as np
import pytest

from samii_rig.signal.groups import Piece
from samii_rig.signal.spectra import settled_spectra

N, RATE = 4000, 100.0


def pieces(drift: np.ndarray) -> list[Piece]:
    """Four periods of one settled motion, the output with a drift on it."""
    t = np.arange(N) / RATE
    r = np.sin(2 * np.pi * 0.5 * t) * (t < 30)
    y = np.sin(2 * np.pi * 0.5 * t + 0.3)
    runs = np.tile(y, 4) + drift
    return [
        Piece(f"burst {i}", r, np.stack([r, runs[i * N : (i + 1) * N]], axis=1)) for i in range(4)
    ]


@pytest.mark.parametrize("order", [1, 2])
def test_a_drift_over_the_run_does_not_reach_the_spectra(order: int) -> None:
    time = np.linspace(-1, 1, 4 * N)
    clean, _ = settled_spectra(pieces(np.zeros(4 * N)), RATE)
    drifted, _ = settled_spectra(pieces(0.5 + 2.0 * time**order), RATE)
    for a, b in zip(clean, drifted, strict=True):
        assert np.allclose(a.Z, b.Z, atol=1e-9 * np.abs(a.Z).max())


def test_a_motion_that_repeats_is_left_as_it_is() -> None:
    still, _ = settled_spectra(pieces(np.zeros(4 * N)), RATE)
    line = round(0.5 * N / RATE) - 1
    assert abs(still[0].Z[line, 1]) == pytest.approx(np.sqrt(N) / 2, rel=1e-6)
