"""Records of which hardly a line can be told from a transient: an input of few steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from few_kit import only
from scipy import signal

from samii_rig.diagnose.diagnose import case_of, diagnose
from samii_rig.diagnose.fit import records as whole_records
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.forces.variation import Uneven
from samii_rig.diagnose.posed import of_any_kind
from samii_rig.diagnose.verdict import by_record
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.errors import EstimateError
from samii_rig.likelihood.excited import within
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, Float, Recording, Segment

RIG = load_rig("one_mass")[0]
RATE, N, STEP = 500.0, 6000, 0.5e-6
STEPS = (250, 334)  # samples at which the command jumps between two values
M, K, C, GAIN, CORNER = 1.2, 6000.0, 6.0, 4.0, 2 * np.pi * 120.0


def way_of(v: Float, k: float = K, finer: int = 1) -> Float:
    """(n,) m, of the mass on a spring of k in N/m under commands v (n,), the coil's force behind
    its lag, at `finer` times the record's rate."""
    A = np.array([[0.0, 1.0, 0.0], [-k / M, -C / M, 1 / M], [0.0, 0.0, -CORNER]])
    B = np.array([[0.0], [0.0], [GAIN * CORNER]])
    held = signal.cont2discrete((A, B, np.eye(3)[:1], np.zeros((1, 1))), 1 / (RATE * finer))
    return np.asarray(signal.dlsim(held, v)[1][:, 0])


def recorded(seed: int, corner: float, level: float) -> Recording:
    """Steps of the command, and x of a sensor that shows nothing slow, below `corner` in Hz."""
    v = np.zeros(N)
    for first in STEPS:
        v[first:] = level - v[first:]
    x = way_of(v)
    fast = signal.cont2discrete(([1.0, 0.0], [1.0, 2 * np.pi * corner]), 1 / RATE, "bilinear")
    x = signal.lfilter(fast[0].ravel(), fast[1], x)
    x = x + np.random.default_rng(seed).normal(0.0, 1e-6, N)
    x = STEP * np.rint(x / STEP)
    channels = (
        Channel("v", "V", "command", resolution=0.3e-3),
        Channel("x", "m", "sensor", resolution=STEP),
    )
    return Recording(
        channels=channels,
        rate_hz=RATE,
        time=np.round(np.arange(N) * (1e9 / RATE)).astype(np.int64),
        sequence=np.arange(N),
        values=np.column_stack([v, x]),
        quality=np.zeros((N, 2), np.uint8),
        segments=(Segment("steps", "single", 0, N, level, "V", 0),),
        source=f"steps_{seed}.mcap",
    )


@pytest.mark.parametrize("corner", [0.0, 0.02])
def test_whole_records_tell_what_lines_alone_do_not(
    corner: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    only(
        monkeypatch, ("sensor_highpass", "x"), ("viscous_damping", "spring"), ("added_mass", "mass")
    )
    runs = [recorded(1, corner, 0.3), recorded(2, corner, 0.5)]
    responses = estimate(runs)
    assert {r.estimator for r in responses} == {"h1"}
    assert "told from a transient" in responses[0].why
    found = diagnose(responses, RIG, runs=runs)
    assert found.used.lines > 500
    if corner:
        assert [(c.physics, c.site) for c in found.causes] == [("sensor_highpass", "x")]
        found_corner = found.causes[0].parameters["corner"]
        assert found_corner.low < corner < found_corner.high
    else:
        assert found.verdict == "no_mismatch"
    assert not any("Welch" in words for words in found.not_physics)


def test_windows_that_leak_name_nothing_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, ("sensor_highpass", "x"), ("viscous_damping", "spring"))
    found = diagnose(estimate([recorded(1, 0.3, 0.3), recorded(2, 0.3, 0.5)]), RIG)
    assert found.verdict != "named"
    assert any("leakage" in words for words in found.not_physics)


def test_steps_that_are_for_the_eye_are_taken_whole_too() -> None:
    run = recorded(1, 0.0, 0.3)
    (segment,) = run.segments
    run = replace(run, segments=(replace(segment, kind="transient"),))
    with pytest.raises(EstimateError, match="steps and other transients only"):
        estimate([run])
    assert estimate(of_any_kind([run]))[0].estimator == "h1"


def test_too_few_lines_for_the_noise_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, ("sensor_highpass", "x"))
    runs = [recorded(1, 0.0, 0.3)]
    case = case_of(estimate(runs), RIG, None, None, runs)
    assert case.whole is not None
    narrow = replace(case.whole, records=within(case.whole.records, (0.4, 1.1)))
    with pytest.raises(EstimateError, match="so nothing shows the noise"):
        RecordSearch(narrow, case.search)
    with pytest.raises(EstimateError, match="so nothing shows the noise"):
        on_records(replace(case, whole=narrow))


def test_an_input_that_repeats_itself_has_no_lines_between_its_own() -> None:
    run = recorded(1, 0.0, 0.3)
    values = run.values.copy()
    values[:, 0] = np.tile(np.repeat([0.5, -0.5], 125), N // 250)
    (response,) = estimate([replace(run, values=values)])
    assert response.estimator == "h1"
    assert response.why == "the reference has no lines between its own"


def test_a_square_wave_drives_the_rig_far_above_its_band() -> None:
    """There, too, a response may change; a sweep that fades in and out drives nothing beyond it."""
    t = np.arange(N) / RATE
    sweep = np.hanning(N) * signal.chirp(t, 2.0, t[-1], 30.0)
    run = recorded(1, 0.0, 0.3)
    driven = []
    for v in (np.sign(np.sin(2 * np.pi * 0.8 * t + 0.2)), sweep):
        whole = Whole.of([replace(run, values=np.column_stack([v, run.values[:, 1]]))], RIG)
        assert whole.records.band[1] < 60.0
        driven.append(whole.with_harmonics().records.driven)
    assert driven[0] > 200.0
    assert driven[1] < 60.0


def metered(
    seed: int, high_hz: float, finer: int = 4, meter: float = 4e-3, *, reference: bool = False
) -> Recording:
    """A sweep from rest that is cut, its command as a meter of much noise shows it, by a loop
    `finer` times as fast as the record."""
    t = np.arange(N * finer) / (RATE * finer)
    v = 0.4 * signal.chirp(t, 1.0, t[-1], high_hz, phi=-90)
    rng = np.random.default_rng(seed)
    x = way_of(v, finer=finer)[::finer] + rng.normal(0.0, 1e-6, N)
    shown = (v + np.append(v[0], v[:-1]))[::finer] / 2 + rng.normal(0.0, meter, N)
    run = recorded(seed, 0.0, 0.3)
    if reference:
        asked = Channel("u_v", "V", "reference")
        run = replace(run, channels=(asked, *run.channels), quality=np.zeros((N, 3), np.uint8))
    columns = [v[::finer]] * reference + [shown, STEP * np.rint(x / STEP)]
    return replace(run, values=np.column_stack(columns))


def test_a_meters_noise_drives_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Above the sweep the mass does not follow what the meter adds, and nothing is missing."""
    only(
        monkeypatch, ("input_not_held", "v"), ("viscous_damping", "spring"), ("added_mass", "mass")
    )
    runs = [metered(seed, 15.0) for seed in (1, 2)]
    whole = Whole.of(runs, RIG)
    assert 14.0 < whole.records.driven < 22.0
    assert whole.with_harmonics().records.driven == whole.records.driven
    found = diagnose(estimate(runs), RIG, runs=runs)
    assert found.verdict == "no_mismatch"
    assert any("was not held between samples" in words for words in found.not_physics)
    assert Whole.of([recorded(1, 0.0, 0.3)], RIG).records.driven == np.inf


def test_a_loop_that_runs_faster_than_the_record_is_held_as_it_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The law tells that a meter shows it a quarter of a sample late."""
    only(
        monkeypatch, ("input_not_held", "v"), ("viscous_damping", "spring"), ("added_mass", "mass")
    )
    runs = [metered(seed, 60.0, 2, reference=True) for seed in (1, 2)]
    whole = Whole.of(runs, RIG)
    assert whole.rig.rate_hz == 2 * RATE
    assert whole.every == 2
    assert Whole.of(runs, whole.rig).rig == whole.rig
    found = diagnose(estimate(runs), RIG, runs=runs)
    assert found.verdict == "no_mismatch"
    assert found.chi2_per_dof < 1.2
    assert any("runs at 1000 Hz, 2 times for each sample" in words for words in found.not_physics)
    assert not any("was not held between samples" in words for words in found.not_physics)


def test_local_models_that_were_chosen_stay() -> None:
    with pytest.raises(EstimateError, match="cannot be told from a transient anywhere"):
        estimate([recorded(1, 0.0, 0.3)], method="local")


def rubbed(T_c: float) -> list[Recording]:
    """Two records of one multisine of 0.5 to 2 Hz, below the mode at 11 Hz, with dry friction
    beside the spring; by the equation of motion in 64 steps a sample."""
    fine = 64
    t = np.arange(N) / RATE
    phases = np.random.default_rng(1).uniform(0, 2 * np.pi, 19)
    lines = zip(np.arange(6, 25) * (RATE / N), phases, strict=True)
    v = 0.06 * sum(np.cos(2 * np.pi * f * t + phase) for f, phase in lines)
    dt = 1 / (RATE * fine)
    lag = np.exp(-CORNER * dt)
    x = speed = push = 0.0
    way = np.empty(N)
    for i, command in enumerate(v.tolist()):
        way[i] = x
        for _ in range(fine):
            push = lag * push + (1 - lag) * GAIN * command
            free = speed + dt * (push - K * x - C * speed) / M
            held = dt * T_c / M
            speed = 0.0 if abs(free) <= held else free - np.copysign(held, free)
            x += dt * speed
    out = []
    for seed in (1, 2):
        run = recorded(seed, 0.0, 0.3)
        shown = way + np.random.default_rng(seed).normal(0.0, 1e-6, N)
        out.append(replace(run, values=np.column_stack([v, STEP * np.rint(shown / STEP)])))
    return out


def test_friction_shows_far_above_a_narrow_excitation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its harmonics reach a mode that nothing else drives: they tell a third more."""
    only(
        monkeypatch,
        ("coulomb_friction", "spring"),
        ("viscous_damping", "spring"),
        ("added_mass", "mass"),
    )
    runs = rubbed(T_c=2e-3)
    explained = []
    for highest in (3, whole_records.HARMONIC):
        monkeypatch.setattr(whole_records, "HARMONIC", highest)
        found = diagnose(estimate(runs), RIG, runs=runs)
        assert [(c.physics, c.site) for c in found.causes] == [("coulomb_friction", "spring")]
        T_c = found.causes[0].parameters["T_c"]
        assert T_c.low < 2e-3 < T_c.high
        explained.append(found.evidence["drop"])
    assert explained[1] > 1.2 * explained[0]


def test_a_force_is_looked_for_below_what_is_excited_where_no_response_may_change() -> None:
    """Above it one may: a record that begins at once moves the mode at 11 Hz, too."""
    whole = Whole.of(rubbed(T_c=0.0), RIG)
    low, high = whole.records.band
    more = whole.with_harmonics().records
    assert more.bands[0] == (0.0, pytest.approx(whole_records.HARMONIC * high))
    assert more.changing == (low, pytest.approx(more.bands[0][1]))


@pytest.mark.parametrize(("chi2", "verdict"), [(6.0, "no_mismatch"), (200.0, "unknown")])
def test_what_is_in_no_row_is_not_told_of_less_than_what_is(
    chi2: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    only(monkeypatch, ("viscous_damping", "spring"), ("added_mass", "mass"))
    monkeypatch.setattr(by_record, "uneven_spring", lambda seen: Uneven("spring", chi2))
    runs = [recorded(1, 0.0, 0.3), recorded(2, 0.0, 0.5)]
    found = diagnose(estimate(runs), RIG, runs=runs)
    assert found.verdict == verdict
    assert any("not the same to both sides" in said for said in found.not_physics) == (
        verdict == "unknown"
    )


def pushed(seed: int, k: float) -> Recording:
    """A command that jumps between two values twenty times a second, alike in every record, on a
    spring of stiffness k in N/m."""
    v = 0.3 * np.sign(np.random.default_rng(5).standard_normal(N // 25)).repeat(25)
    x = way_of(v, k) + np.random.default_rng(seed).normal(0.0, 1e-6, N)
    return replace(recorded(seed, 0.0, 0.3), values=np.column_stack([v, STEP * np.rint(x / STEP)]))


def test_what_two_recordings_differ_by_is_explained_though_it_was_taken_for_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A spring that is 10 % stiffer in the second of two: it was two states that nothing told."""
    only(monkeypatch, ("attached_oscillator", "mass"), ("viscous_damping", "spring"))
    runs = [pushed(1, 0.95 * K), pushed(2, 1.05 * K)]
    found = diagnose(estimate(of_any_kind(runs)), RIG, runs=runs)
    assert [(c.physics, c.site) for c in found.causes] == [("stiffness_variation", "spring")]
    spread = found.causes[0].parameters["spread"]
    assert spread.low < 0.05 * 2**0.5 < spread.high
    assert not found.states
