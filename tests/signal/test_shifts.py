"""Recordings of other inputs, set beside each other by the phases of their responses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from samii_rig.signal.columns import aligned
from samii_rig.types import Channel, Float, Recording, Segment

N, RATE = 16_000, 500.0  # samples, Hz
CHANNELS = (
    Channel("u", "V", "reference"),
    Channel("v", "V", "command", -10.0, 10.0, 1e-3),
    Channel("x_1", "m", "sensor"),
    Channel("x_2", "m", "sensor"),
)


def random_input(rng: np.random.Generator) -> Float:
    """(N,) noise up to 20 Hz, in which both modes are: 3.3 and 14 Hz."""
    b, a = signal.butter(4, 20.0, fs=RATE)
    return np.asarray(signal.lfilter(b, a, rng.standard_normal(N)))


def two_masses(u: Float, rng: np.random.Generator, *, k: float = 1.5e3, late: int = 0) -> Recording:
    """Of 1 and 0.5 kg, the first on a spring k (N/m) that damps by 1 %, with noise of 0.3 %."""
    m, k_2 = np.diag([1.0, 0.5]), 2e3
    K = np.array([[k + k_2, -k_2], [-k_2, k_2]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(m, K), -7e-4 * K]])
    B = np.array([[0.0], [0.0], [1.0], [0.0]])
    plant = signal.StateSpace(A, B, np.eye(2, 4), np.zeros((2, 1))).to_discrete(1 / RATE)
    x = np.roll(signal.dlsim(plant, u)[1], late, axis=0)
    x = x + 3e-3 * np.std(x, axis=0) * rng.standard_normal(x.shape)
    values = np.column_stack([u, u, x])
    return Recording(
        CHANNELS, RATE, np.arange(N) * 2_000_000, np.arange(N), values,
        np.zeros(values.shape, np.uint8), (Segment("random", "single", 0, N, 1.0, "V", 0),),
        rig_toml="", source=f"late_{late}.mcap",
    )  # fmt: skip


def moved(runs: list[Recording]) -> list[str]:
    """Of each what was done to it: the samples, and to which side."""
    said = [finding.message if finding else "" for _, finding in aligned(runs)]
    return [text.partition("stands ")[2].partition(" than")[0] for text in said]


@pytest.mark.parametrize(("k", "late"), [(1.5e3, -3), (1.5e3, 1), (1.65e3, 5)])
def test_recordings_of_other_inputs_are_set_beside_each_other(k: float, late: int):
    """Also where a spring is 10 % stiffer in one of them."""
    rng = np.random.default_rng(1)
    runs = [two_masses(random_input(rng), rng), two_masses(random_input(rng), rng, k=k, late=late)]
    samples = f"{abs(late)} sample{'s' * (abs(late) > 1)}"
    assert moved(runs) == ["", f"{samples} {'later' if late > 0 else 'earlier'}"]


@pytest.mark.parametrize("part", [0.005, 0.02, 0.05, 0.2])
@pytest.mark.parametrize("same", [True, False])
def test_a_spring_that_differs_is_no_shift(part: float, same: bool):
    """It turns the phase about its resonance, by a sample and more there, and nowhere else."""
    rng = np.random.default_rng(2)
    u = random_input(rng)
    other = u if same else random_input(rng)
    runs = [two_masses(u, rng), two_masses(other, rng, k=1.5e3 * (1 + part))]
    assert moved(runs) == ["", ""]


def test_sensors_that_show_noise_alone_tell_no_shift():
    rng = np.random.default_rng(3)
    for _ in range(20):
        runs = [two_masses(random_input(rng), rng) for _ in range(2)]
        for run in runs:
            run.values[:, 2:] = rng.standard_normal((N, 2))
        assert moved(runs) == ["", ""]


def test_recordings_stand_as_most_of_them_do():
    rng = np.random.default_rng(4)
    runs = [two_masses(random_input(rng), rng, late=late) for late in (2, 0, 0)]
    assert moved(runs) == ["2 samples later", "", ""]
    assert "beside late_0.mcap" in aligned(runs)[0][1].message  # type: ignore[union-attr]


def test_recordings_compare_by_the_sensors_that_all_have():
    rng = np.random.default_rng(5)
    first, other = (two_masses(random_input(rng), rng, late=late) for late in (0, 2))
    other = replace(other, channels=other.channels[:3], values=other.values[:, :3])
    assert moved([first, other]) == ["", "2 samples later"]


def test_a_sensor_that_one_of_them_never_read_is_no_error():
    rng = np.random.default_rng(6)
    runs = [two_masses(random_input(rng), rng, late=late) for late in (0, 2)]
    runs[1].values[:, 3] = np.nan
    assert moved(runs) == ["", ""]
