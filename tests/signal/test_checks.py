"""What is wrong with data is found, named by channel and place, and excluded or refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from samii_rig.errors import EstimateError
from samii_rig.signal import checks
from samii_rig.signal.estimate import estimate
from samii_rig.signal.groups import Selection
from samii_rig.signal.statistics import magnitude_interval
from samii_rig.types import Channel, Quality, Recording, Segment

RATE = 100.0
N = 1600
CHANNELS = (
    Channel("u", "V", "reference"),
    Channel("v", "V", "command", low=-10, high=10),
    Channel("theta", "rad"),
    Channel("a", "m/s^2", low=-50, high=50),
)


def sweeps(repeats: int = 3, seed: int = 0, noise: float = 1e-3) -> Recording:
    """A sampled first-order joint under bursts, in open loop; at rest before and after."""
    rng = np.random.default_rng(seed)
    t = (np.arange(N) - 200) / RATE
    u = np.where((t > 0) & (t < 8), np.sin(2 * np.pi * (1 + t) * t), 0.0)
    theta = np.zeros(N)
    for n in range(1, N):
        theta[n] = 0.9 * theta[n - 1] + 0.1 * u[n - 1]
    a = np.gradient(theta) * 10
    clean = np.stack([u, u, theta, a], axis=1)
    values = np.concatenate(
        [clean + rng.normal(size=clean.shape) * [0, 0, noise, noise] for _ in range(repeats)]
    )
    count = np.arange(N * repeats, dtype=np.int64)
    return Recording(
        CHANNELS,
        RATE,
        count * 10_000_000,
        count,
        values,
        np.zeros(values.shape, np.uint8),
        tuple(
            Segment(f"sweep_{i}", "burst", i * N, (i + 1) * N, 1.0, "V", i) for i in range(repeats)
        ),
        source="log",
    )


def changed(recording: Recording, rows: slice, column: int, value: object) -> Recording:
    values = recording.values.copy()
    values[rows, column] = value
    return replace(recording, values=values)


def without(recording: Recording, rows: slice) -> Recording:
    keep = np.ones(len(recording), bool)
    keep[rows] = False
    return replace(
        recording,
        time=recording.time[keep],
        sequence=recording.sequence[keep],
        values=recording.values[keep],
        quality=recording.quality[keep],
    )


def kinds(recording: Recording, **options: object) -> set[str]:
    return {f.kind for r in estimate([recording], **options) for f in r.findings}


def test_sound_data_raise_no_finding():
    assert kinds(sweeps()) == set()


def test_a_lost_sample_is_refused_with_its_place_and_the_way_out():
    with pytest.raises(EstimateError, match=r"sweep_1: 2 samples missing at sample 2000.*exclude"):
        estimate([without(sweeps(), slice(2000, 2002))])


def test_a_nan_is_refused_with_its_channel():
    broken = changed(sweeps(), slice(100, 103), 3, np.nan)
    with pytest.raises(EstimateError, match="3 samples of a missing at sample 100"):
        estimate([broken])


def test_excluding_a_gap_leaves_the_other_repeats():
    r = estimate([without(sweeps(), slice(2000, 2002))], gaps="exclude")[0]
    assert r.n_averages == 2
    assert any(f.kind == "gap" and f.segment == "sweep_1" for f in r.findings)


def test_excluding_every_segment_is_an_error():
    with pytest.raises(EstimateError, match="no segment is usable"):
        estimate([without(sweeps(1), slice(700, 702))], gaps="exclude")


def test_where_every_segment_has_a_gap_auto_models_it():
    gappy = without(sweeps(1), slice(700, 702))
    alike, modelled = (estimate([gappy], gaps=gaps)[0] for gaps in ("auto", "model"))
    np.testing.assert_array_equal(alike.H, modelled.H)
    beside = without(sweeps(), slice(2000, 2002))
    assert estimate([beside], gaps="auto")[0].n_averages == 2


def test_a_gap_modelled_as_a_transient_gives_the_response_of_the_whole():
    whole = estimate([sweeps(3)], band=(2, 12))[0]
    gappy = without(without(sweeps(3), slice(700, 703)), slice(4000, 4001))
    r = estimate([gappy], gaps="model", band=(2, 12))[0]
    assert r.method.startswith("local")
    assert r.n_averages == 3
    reference = np.interp(r.frequency, whole.frequency, np.abs(whole.H[:, 0, 0]))
    assert np.median(np.abs(np.abs(r.H[:, 0, 0]) / reference - 1)) < 0.01


def test_a_segment_that_begins_late_has_a_gap_at_its_start():
    with pytest.raises(EstimateError, match="5 samples missing at sample 0"):
        estimate([without(sweeps(), slice(0, 5))])


def test_time_that_stands_still_is_refused():
    recording = sweeps()
    time = recording.time.copy()
    time[50] = time[49]
    with pytest.raises(EstimateError, match="does not advance after sample 49"):
        estimate([replace(recording, time=time)])


def test_a_wrong_rate_and_jitter_are_named():
    recording = sweeps()
    wrong = replace(recording, time=(recording.time * 1.01).astype(np.int64))
    assert kinds(wrong) == {"clock"}
    late = recording.time + np.random.default_rng(0).integers(0, 4_000_000, len(recording))
    assert kinds(replace(recording, time=late)) == {"timing"}


def test_a_clipped_repeat_is_left_out():
    recording = sweeps(4)
    quality = recording.quality.copy()
    quality[700:710, 2] = Quality.CLIPPED
    r = estimate([replace(recording, quality=quality)])[0]
    assert r.n_averages == 3
    assert any(f.kind == "clipping" and f.channel == "theta" for f in r.findings)


def test_flat_tops_are_clipping_even_without_a_flag():
    recording = sweeps(4)
    theta = recording.values[:, 2].copy()
    theta[:N] = np.minimum(theta[:N], 0.25)
    r = estimate(
        [
            replace(
                recording,
                values=np.column_stack([recording.values[:, :2], theta, recording.values[:, 3]]),
            )
        ]
    )[0]
    assert r.n_averages == 3


def test_a_sensor_that_starts_at_its_extreme_is_at_rest():
    """One that turns one way only goes back to where it began, and stands there."""
    recording = sweeps(3)
    theta = np.abs(recording.values[:, 2])
    theta[np.abs(recording.values[:, 0]) < 1e-9] = 0.0
    values = np.column_stack([recording.values[:, :2], theta, recording.values[:, 3]])
    found = estimate([replace(recording, values=values)])[0].findings
    assert not any(f.kind == "clipping" for f in found)


def test_a_saturated_command_is_a_warning_because_what_went_out_is_known():
    recording = sweeps()
    quality = recording.quality.copy()
    quality[700:710, 1] = Quality.LIMITED
    r = estimate([replace(recording, quality=quality)])[0]
    assert r.n_averages == 3
    assert any(f.kind == "saturation" and f.channel == "v" for f in r.findings)


def test_a_dead_sensor_is_left_out_and_refused_when_it_was_asked_for():
    dead = changed(sweeps(), slice(None), 3, 0.25)
    r = estimate([dead])[0]
    assert [c.name for c in r.outputs] == ["theta"]
    assert any(f.kind == "stuck" and f.channel == "a" for f in r.findings)
    with pytest.raises(EstimateError, match="a never changed"):
        estimate([dead], outputs=["a"])


@pytest.mark.parametrize(("steps", "hidden"), [(0.6, True), (0.8, True), (1.2, False), (5, False)])
def test_a_sensor_that_moves_by_less_than_its_step_is_told(steps: float, hidden: bool):
    """Root mean square while it moves: at rest between two bursts it has nothing to show."""
    run = sweeps()
    theta = run.values[:, 2]
    power = theta[: 2 * N] ** 2
    step = float(np.sqrt(np.mean(power**2) / np.mean(power) / 3)) / steps
    coarse = changed(run, slice(None), 2, np.rint(theta / step) * step)
    # Rounding makes small motion smaller still: the step is of what the sensor reads.
    found = [f for f in estimate([coarse])[0].findings if f.kind == "resolution"]
    assert bool(found) == hidden
    assert all(f.channel == "theta" and "of its step of" in f.message for f in found)


def test_a_sensor_that_freezes_in_one_repeat_costs_that_repeat():
    frozen = changed(sweeps(4), slice(N + 500, N + 700), 2, 0.1)
    r = estimate([frozen])[0]
    assert r.n_averages == 3
    assert any(f.kind == "stuck" and f.segment == "sweep_1" for f in r.findings)


def test_a_coarse_sensor_that_rests_before_it_moves_is_not_frozen():
    """Its noise reaches the next step now and then, and dry friction holds it at a small drive."""
    run = sweeps()
    theta, rng = run.values[:, 2].copy(), np.random.default_rng(1)
    step = 1e-3 * float(np.std(theta))
    rest = np.where(rng.random(120) < 0.3, step, 0.0)
    rest[50:75] = 0.0
    theta[N + 300 : N + 420] = theta[N + 300] + rest
    coarse = changed(run, slice(None), 2, np.rint(theta / step) * step)
    assert not [f for f in estimate([coarse])[0].findings if f.kind == "stuck"]


@pytest.mark.parametrize(("jump", "frozen"), [(1, False), (40, True)])
def test_a_sensor_that_moves_on_by_single_steps_had_come_to_rest(jump: int, frozen: bool):
    """One that was frozen comes back where the rig is by then."""
    n, rest, step = 600, 100, 1e-3
    steps = np.where(np.arange(n) % 2 == 0, 1, -2) * (1 + np.arange(n) // 50)
    steps[:rest] = 0
    steps[rest : rest + 4] = [jump, 1, 1, 1]
    values = np.zeros((n, len(CHANNELS)))
    values[:, 1] = np.sin(0.3 * np.arange(n))
    values[:, 2] = step * np.cumsum(steps)
    channels = tuple(replace(c, resolution=step) if c.name == "theta" else c for c in CHANNELS)
    segment = Segment("sweep", "single", 0, n, 1.0, "V", 0)
    run = Recording(
        channels, RATE, np.arange(n) * 10_000_000, np.arange(n), values,
        np.zeros(values.shape, np.uint8), (segment,),
    )  # fmt: skip
    found = checks.stuck(run, segment, Selection(channels[1], channels[2:3]))
    assert [f.severity for f in found] == ["error"] * frozen


def test_a_repeat_that_does_not_repeat_is_named_and_left_out():
    recording = sweeps(4)
    r = estimate([changed(recording, slice(N, 2 * N), 2, 1.1 * recording.values[N : 2 * N, 2])])[0]
    assert r.n_averages == 3
    assert [f.segment for f in r.findings if f.kind == "repeat"] == ["log, sweep_1"]


def test_of_two_that_disagree_neither_is_trusted():
    recording = sweeps(2)
    with pytest.raises(EstimateError, match="third repeat"):
        estimate([changed(recording, slice(N, 2 * N), 2, 1.5 * recording.values[N : 2 * N, 2])])


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_makes_no_repeat_foreign(seed):
    rng = np.random.default_rng(seed)
    shape = (5, 300, 3)
    z = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    assert checks.foreign_repeats(3 + z, list("abcde"), list("xyz")) == {}
    assert checks.foreign_repeats(3 + z[:2], list("ab"), list("xyz")) == {}


def test_motion_at_the_end_of_the_bursts_is_leakage():
    recording = sweeps(3)
    n = np.arange(N)
    ringing = np.tile(0.05 * np.sin(0.4 * n) * (n > 600), 3)
    # A sample between the bursts belongs to none, so none is known to run into the next.
    apart = tuple(replace(s, stop=s.stop - 1) for s in recording.segments)
    moved = changed(recording, slice(None), 2, recording.values[:, 2] + ringing)
    r = estimate([replace(moved, segments=apart)])[0]
    assert r.method.startswith("local")
    assert any(f.kind == "leakage" and f.channel == "theta" for f in r.findings)


def ringing_sweeps(
    repeats: int, seed: int, noise: float, radius: float = 0.995
) -> tuple[Recording, np.ndarray]:
    """Bursts of a mode so lightly damped that each runs into the next, and its response."""
    rng = np.random.default_rng(seed)
    t = (np.arange(N) - 100) / RATE
    u = np.where((t > 0) & (t < 12), np.sin(2 * np.pi * (0.3 + 0.3 * t) * t), 0.0)
    b, a = [0.0, 0.02], [1.0, -2 * radius * np.cos(0.15), radius**2]
    x = signal.lfilter(b, a, np.tile(u, repeats))
    values = np.stack([np.tile(u, repeats)] * 2 + [x, np.gradient(x)], axis=1)
    values[:, 2:] += rng.normal(size=(x.size, 2)) * noise
    base = sweeps(repeats)
    w = 2 * np.pi * np.arange(1, N // 2) / N
    return replace(base, values=values), signal.freqz(b, a, w)[1]


def test_bursts_that_run_into_each_other_are_periods_of_one_motion():
    recording, truth = ringing_sweeps(4, 1, 1e-4)
    (r,) = estimate([recording], band=(0.5, 6.0), outputs=["theta"])
    assert r.method.startswith("settled")
    assert r.n_averages == 3
    expected = truth[np.searchsorted(np.arange(1, N // 2) * RATE / N, r.frequency - 1e-9)]
    np.testing.assert_allclose(r.H[:, 0, 0], expected, rtol=2e-3)


def test_intervals_of_bursts_that_run_into_each_other_hold():
    inside = []
    for seed in range(40):
        recording, truth = ringing_sweeps(3, seed, 2e-3)
        (r,) = estimate([recording], band=(0.5, 6.0), outputs=["theta"])
        assert r.method.startswith("settled")
        expected = truth[np.searchsorted(np.arange(1, N // 2) * RATE / N, r.frequency - 1e-9)]
        i = magnitude_interval(r)
        inside.append(np.mean((i.low[:, 0, 0] < abs(expected)) & (abs(expected) < i.high[:, 0, 0])))
    assert 0.87 < np.mean(inside) < 0.93


@pytest.mark.parametrize("periods", [0.4, 0.7, 1.0, 2.0])
@pytest.mark.parametrize("repeats", [3, 4])
def test_the_louder_it_rings_the_less_it_is_taken_for_rest(periods, repeats):
    """A ring that takes `periods` bursts to fall to 1/e differs from tail to tail."""
    radius = np.exp(-1 / (periods * N))
    recording, truth = ringing_sweeps(repeats, 2, 1e-3, radius)
    (r,) = estimate([recording], band=(0.5, 6.0), outputs=["theta"])
    assert not r.method.startswith("burst")
    if r.method.startswith("local"):
        assert any(f.kind == "leakage" for f in r.findings)
    else:
        expected = truth[np.searchsorted(np.arange(1, N // 2) * RATE / N, r.frequency - 1e-9)]
        sigma = np.sqrt(r.variance()[:, 0, 0])
        assert np.quantile(abs(r.H[:, 0, 0] - expected) / sigma, 0.99) < 4


def test_the_same_samples_twice_are_no_repeat():
    recording = sweeps(3)
    with pytest.raises(EstimateError, match="the very samples of another repeat"):
        estimate([recording, recording])


def test_another_amplitude_is_another_experiment_whatever_its_level_says():
    recording = sweeps(4)
    values = recording.values.copy()
    values[2 * N :] *= 3
    assert [r.n_averages for r in estimate([replace(recording, values=values)])] == [2, 2]


def test_a_burst_after_a_foreign_one_is_not_taken_for_a_period():
    recording, _ = ringing_sweeps(5, 1, 1e-4)
    recording = changed(recording, slice(2 * N, 3 * N), 2, -recording.values[2 * N : 3 * N, 2])
    (r,) = estimate([recording], band=(0.5, 6.0), outputs=["theta"])
    assert r.method.startswith("local")


def test_checks_say_where():
    recording = sweeps(1)
    segment = recording.segments[0]
    found = checks.breaks(changed(recording, slice(9, 11), 2, np.nan), segment, ["theta"])
    assert found == [(9, 2, "theta")]
    selection = Selection(CHANNELS[1], CHANNELS[2:])
    at_end = changed(recording, slice(7, 8), 3, 50.0)
    assert "a is at the end of its range in 1 samples, first at 7" in (
        checks.clipping(at_end, segment, selection)[0].message
    )
