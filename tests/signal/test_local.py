"""Local models: a single sweep, cut off while it rings, over lightly damped modes."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy import signal as filters

from samii_rig.signal import local
from samii_rig.signal.estimate import estimate
from samii_rig.signal.groups import Piece
from samii_rig.signal.spectra import spectrum
from samii_rig.types import Channel, Recording

STUDY = Path(__file__).resolve().parents[2] / "benchmarks" / "coverage_study.py"
SPEC = importlib.util.spec_from_file_location("coverage_study", STUDY)
assert SPEC is not None
assert SPEC.loader is not None
study = importlib.util.module_from_spec(SPEC)
__import__("sys").modules["coverage_study"] = study
SPEC.loader.exec_module(study)


def test_a_fast_sweep_over_a_lightly_damped_mode_is_measured_although_it_rings_on():
    found = study.fast_sweep(seed=1)
    assert found.welch_error > 0.8
    assert found.welch_coherence < 0.3
    assert found.local_error < 0.002
    assert found.local_error < 5 * found.local_sigma


def test_a_rational_model_of_a_rational_response_is_exact_without_noise():
    rng = np.random.default_rng(0)
    n = 400
    r = rng.normal(size=n)
    z = np.zeros((n, 2))
    z[:, 0] = r
    pole = 0.98 * np.exp(0.5j)
    state = 3.0 + 0j  # rings from before the record
    for k in range(n):
        z[k, 1] = state.real
        state = pole * state + r[k]
    s = spectrum(Piece("x", r, z), 100.0)
    f0 = s.frequency[20:60]
    data = local.windows([s], f0, 5.0, ((0, 0.0),))
    errors = []
    for degree in (0, 1, 2):
        H = local.fit(data, degree).H[:, 0]
        q = np.exp(2j * np.pi * f0 / 100.0)
        truth = (1 / (q - pole) + 1 / (q - pole.conj())) / 2
        errors.append(np.max(np.abs(H / truth - 1)))
    assert errors[0] > 0.1
    assert errors[2] < 1e-3


def test_two_losses_close_together_are_one_transient():
    _, apart = local.plan([[10.0, 20.0]], 2, 40.0, at_rest=True)
    _, near = local.plan([[10.0, 10.02]], 2, 40.0, at_rest=True)
    assert len(apart) == 2
    assert near == ((0, 10.01),)
    width, none = local.plan([[]], 2, 40.0, at_rest=True)
    assert none == ()
    assert width < local.plan([[]], 2, 40.0, at_rest=False)[0]


def test_where_the_sweep_starts_it_cannot_be_told_from_a_transient():
    u = study.swept_sine(16.0, 15.5, lead=0.0)
    s = spectrum(Piece("x", u, np.stack([u, u], axis=1)), study.RATE)
    width, transients = local.plan([[]], 1, 16.0, at_rest=False)
    f0 = np.array([0.8, 8.0])
    clear = local.windows([s], f0, width, transients).distinct()
    assert clear[0] < 0.1
    assert clear[1] > 0.5


@pytest.mark.parametrize("kind", ["burst", "single"])
def test_intervals_of_a_single_sweep_hold_on_average(kind):
    u = study.swept_sine(**study.BURST) if kind == "burst" else study.swept_sine(16.0, 15.5)
    found = study.coverage(
        study.runs(6, 11, repeats=1, u=u, kind=kind, method="local", band=(4.5, 18.0))
    )
    both = (found.inside["real"].mean() + found.inside["imag"].mean()) / 2
    assert 0.83 < both < 0.95
    assert np.median(found.ratio) < 1.3


def test_an_encoder_that_its_loop_feeds_back_step_by_step_is_known_to_its_rounding_only():
    rng = np.random.default_rng(4)
    step, n, rate = 0.01, 4000, 500.0
    steps = np.cumsum(np.where(np.arange(n) % 400 == 0, rng.choice([-1.0, 1.0], n), 0.0))
    a = filters.lfilter([0.2], [1, -1.6, 0.8], steps) + 0.01 * rng.normal(size=n)
    channels = (
        Channel("u", "V", "command"),
        Channel("theta", "rad", resolution=step),
        Channel("a", "m/s^2"),
    )
    values = np.column_stack([-steps, step * steps, a])
    at = np.arange(n)
    recording = Recording(channels, rate, at * 2_000_000, at, values, np.zeros((n, 3), np.uint8))
    found = estimate([recording], method="local")[0]
    variance = found.variance()[:, 0, 0]
    assert np.all(variance > 0)
    driven = np.abs(np.fft.rfft(-steps)) ** 2 / n
    per_line = np.interp(found.frequency, np.arange(n // 2 + 1) * rate / n, driven)
    assert np.median(variance * per_line) < step**2 / 12
    assert np.median(variance * per_line) > step**2 / 120
    assert any("step^2/12" in f.message for f in found.findings)
