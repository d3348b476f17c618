"""Responses to several inputs: what drives them, what they are, and how far to trust them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from several_kit import (
    INPUTS,
    OUTPUTS,
    driven,
    masses,
    multisines,
    recording,
    repeated,
    sweep,
)

from samii_rig.errors import EstimateError, InputError
from samii_rig.signal import statistics
from samii_rig.signal.coherence import partial_coherence
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel

TRUTH = masses().response


@pytest.fixture
def rng():
    return np.random.default_rng(20)


def bursts(which, rng, count=3, **options):
    return [driven(sweep(which), rng, **options) for _ in range(count)]


def off(response):
    """Largest error of any entry, in its standard deviations."""
    error = np.abs(response.H - TRUTH(response.frequency))
    return float((error / np.sqrt(response.variance())).max())


def near(response):
    """Median relative error."""
    truth = TRUTH(response.frequency)
    return float(np.median(np.abs(response.H / truth - 1)))


def agrees(response):
    """Whether the joint 90 % region of all entries holds the truth at about 90 % of the lines."""
    _, p = statistics.model_distance(response, TRUTH(response.frequency))
    return 0.8 < np.mean(p > 0.1) <= 0.99


def test_a_column_of_inputs_in_turn_is_the_response_to_that_input_alone(rng):
    both = recording([*bursts(0, rng), *bursts(1, rng)], "burst")
    (found,) = estimate([both])
    assert [c.name for c in found.inputs] == list(INPUTS)
    assert [c.name for c in found.outputs] == list(OUTPUTS)
    assert agrees(found)
    for i, name in enumerate(INPUTS):
        own = replace(both, segments=both.segments[3 * i : 3 * i + 3])
        (alone,) = estimate([own], input=name)
        at = np.isin(np.round(alone.frequency, 6), np.round(found.frequency, 6))
        np.testing.assert_array_equal(found.H[:, :, i], alone.H[at, :, 0])
        block = found.covariance.reshape(-1, 3, 2, 3, 2)[:, :, i, :, i]
        np.testing.assert_array_equal(block, alone.covariance[at])
        np.testing.assert_array_equal(found.input_rms[:, i], alone.input_rms[at, 0])


def test_experiments_of_two_inputs_share_no_noise(rng):
    (found,) = estimate([recording([*bursts(0, rng), *bursts(1, rng)], "burst")])
    C = found.covariance.reshape(-1, 3, 2, 3, 2)
    assert not C[:, :, 0, :, 1].any()
    assert C[:, :, 0, :, 0].any()


def test_inputs_in_turn_may_lie_in_two_recordings_and_interleave(rng):
    first, second = bursts(0, rng), bursts(1, rng)
    apart = [recording(x, "burst", source=f"{k}") for k, x in enumerate((first, second))]
    mixed = recording([x for pair in zip(first, second, strict=True) for x in pair], "burst")
    (a,), (b,) = estimate(apart), estimate([mixed])
    np.testing.assert_array_equal(a.H, b.H)


def test_loops_around_both_inputs_do_not_bias_the_open_loop_response(rng):
    noisy = {"loop": 150.0, "noise": 1e-4}
    runs = [[*bursts(0, rng, **noisy), *bursts(1, rng, **noisy)] for _ in range(12)]
    found = [estimate([recording(x, "burst")], method="burst")[0] for x in runs]
    truth = TRUTH(found[0].frequency)
    mean = np.mean([r.H for r in found], axis=0)
    sd = np.sqrt(np.mean([r.variance() for r in found], axis=0) / len(found))
    # Rayleigh: the median of |error|/sd is 0.83 without a bias.
    assert np.median(np.abs(mean - truth) / sd) == pytest.approx(0.83, abs=0.08)
    assert "through u_1, u_2" in found[0].method
    alone = [estimate([recording(x[:3], "burst")], input="v_1", method="burst")[0] for x in runs]
    closed = np.mean([r.H[:, 0, 0] for r in alone], axis=0)
    band = slice(20, 150)  # where v_2 answers v_1 through its loop
    there = TRUTH(alone[0].frequency)[:, 0, 0]
    assert np.median(np.abs(closed / there - 1)[band]) > 0.01


@pytest.mark.parametrize("loop", [0.0, 100.0])
def test_orthogonal_multisines_together_give_all_entries(rng, loop):
    made = [
        recording([repeated(u, 2, rng, loop=loop)], "periodic", source=f"{k}")
        for k, u in enumerate(multisines(3, rng))
    ]
    (found,) = estimate(made)
    assert found.method.startswith("periodic")
    assert near(found) < 0.01
    assert off(found) < 5.5
    assert agrees(found)


def test_noise_is_known_from_periods_and_distortion_from_realisations(rng):
    def levels(cubic):
        made = [
            recording([repeated(u, 4, rng, cubic=cubic)], "periodic", source=f"{k}")
            for k, u in enumerate(multisines(4, rng))
        ]
        (found,) = estimate(made)
        said = [f for f in found.findings if f.kind == "distortion"]
        return found, said

    linear, quiet = levels(0.0)
    hard, said = levels(4e5)
    assert linear.noise is not None
    assert hard.distortion is not None
    # The noise of a line of one period is NOISE whatever the spring does.
    np.testing.assert_allclose(np.median(hard.noise / linear.noise, axis=0), 1.0, atol=0.15)
    assert not quiet
    assert {f.channel for f in said} == set(OUTPUTS)
    assert np.median(hard.distortion) > 5 * np.median(linear.distortion)
    assert np.median(hard.variance() / linear.variance()) > 4


def test_a_single_realisation_shows_the_noise_alone(rng):
    made = [
        recording([repeated(u, 5, rng)], "periodic", source=f"{k}")
        for k, u in enumerate(multisines(1, rng))
    ]
    (found,) = estimate(made)
    assert found.distortion is None
    assert found.noise is not None
    assert agrees(found)


def test_random_inputs_together_are_solved_by_local_polynomials(rng):
    u = rng.normal(size=(6000, 2))
    (found,) = estimate([recording([driven(u, rng, loop=50.0)], "single")], band=(0.5, 10.0))
    assert found.method.startswith("local")
    assert near(found) < 0.02
    assert agrees(found)
    (windows,) = estimate(
        [recording([driven(u, rng)], "single")], band=(0.5, 10.0), method="h1", nperseg=512
    )
    assert near(windows) < 0.1


def test_one_set_is_driven_by_the_outputs_and_another_by_set_points(rng):
    loop, made = 50.0, []
    points = tuple(Channel(f"theta_ref_{k}", "m", "reference") for k in (1, 2))
    for k, unit in enumerate("NNmm"):
        columns = driven(rng.normal(size=(3000, 2)), rng, loop=loop)
        plain = recording([columns], "single", source=f"{k}")
        u, none = columns[:, :2], np.zeros((3000, 2))
        sent = [u, none] if unit == "N" else [none, u / loop]
        made.append(
            replace(
                plain,
                channels=(*plain.channels[:2], *points, *plain.channels[2:]),
                values=np.hstack([*sent, columns[:, 2:]]),
                quality=np.zeros((3000, 9), np.uint8),
                segments=tuple(replace(s, unit=unit) for s in plain.segments),
            )
        )
    both = estimate(made, band=(0.5, 10.0))
    assert [r.level_unit for r in both] == ["N", "m"]
    for found in both:
        assert near(found) < 0.02
        assert agrees(found)


def test_records_that_differ_by_some_samples_are_cut_to_the_shortest(rng):
    u = rng.normal(size=(2, 3000, 2))
    both = [driven(x, rng, loop=50.0) for x in u]
    made = [recording([x[: 3000 - 3 * k]], "single", source=f"{k}") for k, x in enumerate(both)]
    (found,) = estimate(made, band=(0.5, 10.0))
    assert found.method.startswith("local")
    assert near(found) < 0.02
    assert agrees(found)
    half = recording([both[1][:1500]], "single", source="half")
    with pytest.raises(EstimateError, match="the records differ in length"):
        estimate([made[0], half], band=(0.5, 10.0))


def test_measured_inputs_take_the_place_of_commands(rng):
    made = [
        recording([repeated(u, 3, rng)], "periodic", source=f"{k}", keep=(*INPUTS, *OUTPUTS))
        for k, u in enumerate(multisines(2, rng))
    ]
    for k, r in enumerate(made):
        roles = [replace(c, role="sensor") for c in r.channels]
        # Measured: the periods differ by noise, so that each is a segment of its own.
        n = len(r) // 3
        values = r.values + 1e-5 * rng.normal(size=r.values.shape)
        segments = tuple(
            replace(r.segments[0], name=f"{j}", start=j * n, stop=(j + 1) * n, repeat=j)
            for j in range(3)
        )
        made[k] = replace(r, channels=tuple(roles), values=values, segments=segments)
    (found,) = estimate(made, input=list(INPUTS))
    assert near(found) < 0.01
    assert any(f.kind == "closed_loop" for f in found.findings)


def test_an_input_at_another_level_goes_with_its_fellow_and_the_level_is_mixed(rng):
    half = [driven(sweep(1, level=0.5), rng) for _ in range(3)]
    made = recording([*bursts(0, rng), *half], "burst", level=[1.0] * 3 + [0.5] * 3)
    (found,) = estimate([made])
    assert np.isnan(found.level)
    assert agrees(found)


def test_a_level_of_one_input_alone_is_left_out_and_named(rng):
    more = [driven(sweep(0, level=0.5), rng) for _ in range(3)]
    made = recording(
        [*bursts(0, rng), *bursts(1, rng), *more], "burst", level=[1.0] * 6 + [0.5] * 3
    )
    (found,) = estimate([made])
    assert found.level == 1.0
    assert any("v_1 at 0.5 N left out" in f.message for f in found.findings)


def test_coherence_tells_what_all_inputs_and_what_each_explain(rng):
    # The third sensor hardly sees the second mass; noise hides it.
    made = [
        recording([repeated(u, 2, rng, noise=4e-4)], "periodic", source=f"{k}")
        for k, u in enumerate(multisines(4, rng))
    ]
    (found,) = estimate(made)
    partial = partial_coherence(found)
    assert partial.shape == (len(found.frequency), 3, 2)
    assert np.all((partial >= 0) & (partial <= 1))
    signal = np.abs(TRUTH(found.frequency) * found.input_rms[:, None, :]) ** 2
    # A sine of rms a has n a^2/2 at its line of n samples, over sqrt(n); noise s has s^2, and the
    # mean of two periods half of it.
    samples = len(made[0]) // 2
    expected = signal * samples / 2 / (signal * samples / 2 + (4e-4) ** 2 / 2)
    assert found.n_averages == 8
    strong = expected > 0.8
    np.testing.assert_allclose(partial[strong], expected[strong], atol=0.2)
    assert abs(np.median(partial[strong] - expected[strong])) < 0.01
    assert np.median(found.coherence) > np.median(partial)


def test_an_input_that_drives_nothing_is_named(rng):
    made = recording(bursts(0, rng), "burst")
    with pytest.raises(EstimateError, match=r"input v_2 never moves .* or input='v_1'"):
        estimate([made], input=list(INPUTS))


def test_a_recording_without_a_command_says_which_role_is_wanted(rng):
    made = recording(bursts(0, rng), "burst")
    sensors = tuple(replace(c, role="sensor") for c in made.channels)
    with pytest.raises(InputError, match=r'channels is .*; expected one of role "command"'):
        estimate([replace(made, channels=sensors)])


def test_fewer_experiments_than_inputs_are_refused_in_one_line(rng):
    with pytest.raises(EstimateError, match=r"1 experiment for 2 inputs \(v_1, v_2\); expected 2"):
        estimate([recording(bursts(0, rng, loop=50.0), "burst")])
    same = [driven(np.repeat(sweep(0).sum(axis=1)[:, None], 2, axis=1) * k, rng) for k in (1, 2)]
    made = [recording([x], "single", source=f"{k}") for k, x in enumerate(same)]
    with pytest.raises(EstimateError, match="expected 2 independent"):
        estimate(made)


def test_two_experiments_that_do_the_same_are_not_independent(rng):
    u = multisines(1, rng)[0]
    made = [
        recording([repeated(k * u, 4, rng)], "periodic", level=k, source=f"{k}") for k in (1.0, 0.5)
    ]
    with pytest.raises(EstimateError, match="expected 2 independent"):
        estimate(made)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"method": "hv"}, "expected auto, burst, periodic, local or h1"),
        ({"gaps": "model"}, "expected refuse or exclude"),
        ({"input": ["v_1", "v_3"]}, "expected one of u_1, u_2, v_1, v_2"),
    ],
)
def test_what_is_for_one_input_only_is_refused(rng, option, words):
    made = recording([*bursts(0, rng, 2, loop=9.0), *bursts(1, rng, 2, loop=9.0)], "burst")
    with pytest.raises(InputError, match=words):
        estimate([made], **option)


def test_an_output_that_never_changes_is_left_out(rng):
    x = [*bursts(0, rng, loop=9.0), *bursts(1, rng, loop=9.0)]
    for columns in x:
        columns[:, 6] = 0.25
    (found,) = estimate([recording(x, "burst")])
    assert [c.name for c in found.outputs] == ["x_1", "x_2"]
    assert any(f.kind == "stuck" and "x_3" in f.message for f in found.findings)


def test_one_reference_column_may_serve_both_inputs_in_turn(rng):
    """A device with one reference: which input it drives shows in the commands."""
    x = [*bursts(0, rng, loop=100.0), *bursts(1, rng, loop=100.0)]
    for columns in x:
        columns[:, 0] = columns[:, :2].sum(axis=1)
    made = recording(x, "burst", keep=("u_1", *INPUTS, *OUTPUTS))
    (found,) = estimate([made])
    assert agrees(found)


@pytest.mark.parametrize("n_in", [2, 3])
def test_joint_errors_of_several_columns_follow_the_stated_distribution(n_in):
    """Columns of one covariance and columns of their own both have the T^2 of n_in nu."""
    rng = np.random.default_rng(7)
    p, nu, runs = 3, 36, 20000

    def normal(*shape):
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)

    dof = np.full(runs, float(n_in * nu))
    for own in (1, n_in):
        scatter = normal(runs, own, nu, p)
        C = scatter.swapaxes(2, 3) @ scatter.conj() / nu
        T2 = sum(statistics.hotelling(normal(runs, p), C[:, i % own]) for i in range(n_in))
        assert np.mean(T2) == pytest.approx(statistics.hotelling_mean(n_in * p, dof)[0], rel=0.02)
        outside = statistics.hotelling_p(T2, n_in * p, dof) < 0.1
        assert np.mean(outside) == pytest.approx(0.1, abs=0.006)
