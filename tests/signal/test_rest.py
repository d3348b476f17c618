"""After how many bursts that run into each other the memory of the start is below the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from sweep_kit import swept

from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from samii_rig.signal.groups import Piece
from samii_rig.signal.rest import NEVER, ringing
from samii_rig.types import Channel, Float

RATE, N, REST = 100.0, 2000, 500  # Hz, samples of a burst, and those of its ring-down
CHANNELS = Channel("v", "V", "command"), Channel("y", "m"), Channel("theta", "rad")


def driven(hz: float, zeta: float, u: Float) -> Float:
    """The states of a mode, sampled."""
    a = 2 * np.pi * hz * (-zeta + 1j * np.sqrt(1 - zeta**2))
    return np.asarray(lfilter([1.0], [1.0, -np.exp(a / RATE)], u.astype(complex)).imag)


def row(seed: int, zeta: float, drift: float, noise: float = 1.0) -> list[Piece]:
    """Three bursts in a row of a mode at 2 Hz; theta has a random walk and little of the mode."""
    rng = np.random.default_rng(seed)
    r = np.zeros(N)
    r[100 : N - REST] = np.sin(2 * np.pi * 2.0 * np.arange(N - REST - 100) / RATE)
    u = np.tile(r, 3)
    y = driven(2.0, zeta, u)
    y *= 100.0 / np.max(np.abs(y))
    white = noise * rng.standard_normal((2, u.size))
    theta = 0.02 * y + 0.02 * white[1] + drift * np.cumsum(rng.standard_normal(u.size))
    z = np.stack([u, y + white[0], theta], axis=1)
    return [Piece(f"burst_{i}", r, z[i * N : (i + 1) * N], follows=i > 0) for i in range(3)]


@pytest.mark.parametrize("drift", [0.0, 0.02, 0.1])
def test_a_ring_that_decays_is_seen_beside_an_output_that_drifts(drift: float) -> None:
    """It falls by e^-12 over a burst: one is left out, whatever theta does."""
    found = [ringing(row(seed, 0.05, drift), CHANNELS, 0.3) for seed in range(40)]
    assert [x.settled_after for x in found if x] == [1] * 40


def test_a_ring_that_outlasts_a_burst_needs_more_of_them() -> None:
    """It falls to a quarter over a burst, from some hundred sd of the tail's line."""
    found = [ringing(row(seed, 0.0055, 0.0), CHANNELS, 0.3) for seed in range(5)]
    assert all(x and 2 <= x.settled_after < NEVER for x in found)


def test_a_tone_that_does_not_decay_never_settles() -> None:
    pieces = row(1, 0.5, 0.02)
    tone = np.sin(2 * np.pi * 2.0 * np.arange(N) / RATE)  # of whole periods in a burst
    for p in pieces:
        p.z[:, 1] += 20 * tone * np.linspace(0.5, 1.0, N)
    found = ringing(pieces, CHANNELS, 0.3)
    assert found is not None
    assert found.settled_after == NEVER


@pytest.mark.parametrize("seed", [3, 5, 7, 8])
def test_a_valve_that_is_disturbed_does_not_hide_that_mode_1_decays(seed: int) -> None:
    """The encoder by itself, which sees the disturbance most, shows no decay in these runs."""
    rig = load_rig("samii")[0]
    recording = swept(rig, 0.5, repeats=3, duration=30.0, ring_down=11.0, seed=seed)
    (found,) = estimate([recording])
    assert (found.estimator, found.n_averages) == ("settled", 2)


@pytest.mark.parametrize("stated", [True, False])
def test_an_encoder_that_repeats_read_alike_is_no_ring(stated: bool) -> None:
    """All lines of one repeat less their mean are 0: its rounding is the noise that is known."""
    pieces = row(2, 0.5, 0.0)
    step = 1e-3
    channels = (*CHANNELS[:2], replace(CHANNELS[2], resolution=step if stated else 0.0))
    for p in pieces:
        p.z[:, 2] = step * np.rint(300 * p.r)
        p.z[N - 40, 2] = step  # where it rests between two steps
    assert ringing(pieces, channels, 0.3) is None
