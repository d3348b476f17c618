"""Uncertain time between two devices is in the covariance, and only where it matters."""

import json
from dataclasses import replace

import numpy as np
import pytest

from samii_rig.signal.estimate import estimate
from samii_rig.signal.skew import Skew, skews_of, to_text, with_skew
from samii_rig.types import Channel, FrequencyResponse, Quality, Recording, Segment

RATE = 500.0
F = np.array([1.0, 10.0, 40.0])


def response(outputs=("theta", "M", "F"), inputs=("v",)):
    rng = np.random.default_rng(1)
    shape = (len(F), len(outputs), len(inputs))
    H = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    p = shape[1] * shape[2]
    return FrequencyResponse(
        frequency=F,
        H=H,
        covariance=np.tile(1e-6 * np.eye(p, dtype=complex), (len(F), 1, 1)),
        dof=np.full(len(F), 30.0),
        coherence=np.ones(shape[:2]),
        inputs=tuple(Channel(n, "V") for n in inputs),
        outputs=tuple(Channel(n, "rad") for n in outputs),
        level=1.0,
        level_unit="V",
        input_rms=np.ones((len(F), len(inputs))),
        rate_hz=RATE,
        n_averages=4,
        method="made up",
        why="",
    )


def test_the_variance_grows_by_the_square_of_the_phase():
    plain = response()
    after = with_skew(plain, {"M": Skew("ft", 1e-3)})
    more = after.variance() - plain.variance()
    np.testing.assert_allclose(
        more[:, 1, 0], (2 * np.pi * F * 1e-3 * np.abs(plain.H[:, 1, 0])) ** 2
    )
    assert not more[:, [0, 2]].any()
    assert [f.channel or f.kind for f in after.findings] == ["clock"]
    assert "1 ms" in after.findings[0].message


def test_what_one_clock_does_to_two_channels_is_one_error():
    plain = response()
    skews = {"M": Skew("ft", 2e-3), "F": Skew("ft", 2e-3)}
    more = with_skew(plain, skews).covariance - plain.covariance
    assert (np.linalg.matrix_rank(more) == 1).all()
    # The error that a delay dt makes is that direction, to first order.
    for k in range(len(F)):
        dH = -2j * np.pi * F[k] * 2e-3 * plain.H[k, :, 0] * [0, 1, 1]
        np.testing.assert_allclose(more[k], np.outer(dH, dH.conj()), atol=1e-15)
    two = {"M": Skew("ft", 2e-3), "F": Skew("other", 2e-3)}
    more = with_skew(plain, two).covariance - plain.covariance
    assert (np.linalg.matrix_rank(more) == 2).all()


def test_input_and_output_of_one_clock_are_not_touched():
    plain = response(outputs=("M",), inputs=("F",))
    skews = {"M": Skew("ft", 2e-3), "F": Skew("ft", 2e-3)}
    assert np.array_equal(with_skew(plain, skews).covariance, plain.covariance)
    assert with_skew(plain, {"F": Skew("ft", 1e-3)}).covariance[1, 0, 0].real > 1e-6


def test_a_skew_too_small_to_see_is_not_talked_about():
    assert not with_skew(response(), {"M": Skew("ft", 1e-6)}).findings


def recording(late, skews, seed=0):
    """Three bursts of a sweep; M is v through a low-pass, its clock `late` s behind."""
    rng = np.random.default_rng(seed)
    n = 2000
    t = np.arange(n) / RATE
    window = np.sin(np.pi * np.clip((t - 0.5) / 2.5, 0, 1)) ** 2
    v = window * np.sin(2 * np.pi * (1.0 * t + 4.0 * t**2))
    f = np.fft.rfftfreq(2 * n, 1 / RATE)
    H = np.exp(-2j * np.pi * f * late) / (1 + 1j * f / 20.0)
    m = np.fft.irfft(np.fft.rfft(v, 2 * n) * H)[:n]
    rows = [np.column_stack([v, v, m + 1e-4 * rng.standard_normal(n)]) for _ in range(3)]
    values = np.concatenate(rows)
    k = np.arange(3 * n)
    channels = (Channel("u", "V", "reference"), Channel("v", "V", "command"), Channel("M", "N m"))
    return Recording(
        channels,
        RATE,
        (k * 1e9 / RATE).astype(np.int64),
        k,
        values,
        np.full(values.shape, Quality.GOOD, np.uint8),
        tuple(Segment(f"s{i}", "burst", i * n, (i + 1) * n, 1.0, "V", i) for i in range(3)),
        metadata={"device_timing": skews} if skews else {},
    )


def test_the_estimate_of_a_recording_states_what_its_clocks_do():
    sigma = 4e-4
    text = to_text({"M": Skew("ft", sigma)})
    (bare,) = estimate([recording(sigma, "")])
    (told,) = estimate([recording(sigma, text)])
    np.testing.assert_array_equal(bare.H, told.H)
    truth = 1 / (1 + 1j * bare.frequency / 20.0)
    inside = (bare.frequency > 4) & (bare.frequency < 12)
    off = np.abs(bare.H[:, 0, 0] - truth)[inside]
    # One sigma late: many standard deviations without the skew, one with it.
    assert np.median(off / np.sqrt(bare.variance()[inside, 0, 0])) > 10
    assert np.median(off / np.sqrt(told.variance()[inside, 0, 0])) == pytest.approx(1.0, abs=0.1)
    assert any(f.kind == "clock" for f in told.findings)


def test_of_several_recordings_the_largest_counts_and_nonsense_counts_for_nothing():
    one = recording(0.0, to_text({"M": Skew("ft", 1e-4), "F": Skew("ft", 5e-4)}))
    two = recording(0.0, to_text({"M": Skew("ft", 3e-4)}))
    rubbish = ["{", "[]", '{"M": 3}', '{"M": ["ft", "x"]}', '{"M": ["ft", -1]}', "null"]
    bad = [replace(one, metadata={"device_timing": x}) for x in rubbish]
    found = skews_of([one, two, *bad])
    assert found == {"M": Skew("ft", 3e-4), "F": Skew("ft", 5e-4)}
    assert skews_of([replace(one, metadata={})]) == {}
    assert json.loads(to_text(found))["M"] == ["ft", 3e-4]
