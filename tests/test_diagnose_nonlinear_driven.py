"""Forces under the inputs that were recorded: the same as an integration in time, and confirmed."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from identify_kit import noiseless, samii, without_tolerances

from samii_rig.diagnose import nonlinear_inner
from samii_rig.diagnose.effect import Effect, Unknown
from samii_rig.diagnose.judge import _is_thin
from samii_rig.diagnose.measured import measured
from samii_rig.diagnose.model import Model, grid
from samii_rig.diagnose.nonlinear import compete
from samii_rig.diagnose.nonlinear_confirm import seen
from samii_rig.diagnose.nonlinear_consistent import self_consistent
from samii_rig.diagnose.nonlinear_driven import driven, drives, forced, timed, top_of
from samii_rig.diagnose.nonlinear_inner import Inner, _lap
from samii_rig.diagnose.nonlinear_laws import CUBIC, EXCESS, FRICTION, GAP
from samii_rig.diagnose.nonlinear_levels import Extra, level_grid
from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi
from samii_rig.diagnose.nonlinear_screen import Bins, Levels
from samii_rig.diagnose.nonlinear_time import simulate
from samii_rig.diagnose.refit import Problem, refit
from samii_rig.diagnose.search import Search
from samii_rig.diagnose.stated import IN_DATA
from samii_rig.types import Channel, Recording, Segment

N = 6000  # samples of a period
CASES = [
    (Quasi("joint", ("joint_2",), FRICTION), 0.5),
    (Quasi("joint", ("joint_1",), CUBIC), 1e6),
    (Quasi("joint", ("joint_2",), GAP, 1.0, ("joint_2", "k")), 1e-6),
    (Quasi("drive", ("joint_2_source",), FRICTION), 0.05),
    (Quasi("command", ("joint_2_source",), GAP), 0.01),
    (Quasi("command", ("joint_2_source",), EXCESS), 0.95),
    (Quasi("flow", ("joint_2_source",), None), 5e4),
]


def sweep(level):
    """A sweep from 1 to 30 Hz and back, which repeats itself without a step."""
    t = np.arange(N) / N
    f = 15.5 - 14.5 * np.cos(2 * np.pi * t)
    return level * np.sin(2 * np.pi * np.cumsum(f) / samii().rate_hz)


@cache
def campaign():
    """Lines and grid of two levels, without a force."""
    f = np.arange(12, 361) * samii().rate_hz / N
    responses = [
        replace(
            noiseless(samii(), f),
            level=level,
            method="settled (drawn)",
            input_rms=np.full((f.size, 1), level / np.sqrt(2)),
        )
        for level in (0.5, 1.0)
    ]
    lines = measured(responses, samii())
    at = grid(samii(), lines.frequency, lines.sensor, lines.actuator)
    return responses, lines, level_grid(samii(), at, lines, responses)


def model_of(quasi, p):
    effect = Effect("x", "y", (Unknown("p", "1", p / 100, 100 * p, (p / 2, p)),), quasi=quasi)
    model = LevelModel(samii(), [effect])
    return effect, model, np.append(np.zeros(model.n - 1), np.log(p))


def recorded(quasi, p):
    """Two periods at each level, integrated from rest, without noise."""
    runs = []
    names = [s.name for s in samii().sensor]
    for level in (0.5, 1.0):
        v = np.tile(sweep(level), 3)
        y = simulate(samii(), v, quasi, p)
        channels = (Channel("v_2", "V", "command"),
                    *(Channel(n, samii().units()[n], "sensor") for n in names))  # fmt: skip
        segments = tuple(
            Segment(f"s{i}", "burst", i * N, (i + 1) * N, level, "V", i) for i in range(3)
        )
        runs.append(
            Recording(
                channels, samii().rate_hz, np.arange(3 * N) * 2_000_000, np.arange(3 * N),
                np.column_stack([v, y]), np.zeros((3 * N, 1 + len(names)), np.uint8), segments,
            )
        )  # fmt: skip
    return runs


@pytest.mark.parametrize(("quasi", "p"), CASES)
def test_a_force_in_time_is_that_of_an_integration(quasi, p):
    _, model, x = model_of(quasi, p)
    at = campaign()[2]
    (one,) = forced(model, x, {1: sweep(1.0)[None]}, p)
    v = np.tile(sweep(1.0), 3)
    force = simulate(samii(), v, quasi, p, inner=16) - simulate(
        samii(), v, quasi, 1e9 if quasi.law in (None, EXCESS) else 0.0, inner=16
    )
    want = np.fft.rfft(force[2 * N :], axis=0)[one.bins]
    on = (one.frequency > 1) & (one.frequency < 30)
    there = grid(samii(), one.frequency[on], at.sensor, at.actuator)
    got = model.per_force(x, there) * one.E[on][:, None]
    apart = np.linalg.norm(got - want[on], axis=0) / np.linalg.norm(want[on], axis=0)
    assert np.max(apart) < 0.15


def test_what_a_gap_takes_is_of_each_command_as_it_was_converted():
    quasi, p = CASES[4]
    _, model, x = model_of(quasi, p)
    step = 2 * p
    off = step * np.array([[0.0], [1 / 3], [2 / 3]])
    commands = step * np.round((sweep(1.0) + off) / step)
    (all_,) = forced(model, x, {1: commands}, p)
    each = [forced(model, x, {1: one[None]}, p)[0].E for one in commands]
    (mean,) = forced(model, x, {1: commands.mean(axis=0)[None]}, p)
    assert np.allclose(all_.E, np.mean(each, axis=0))
    assert np.linalg.norm(mean.E - all_.E) > 0.02 * np.linalg.norm(all_.E)


def test_periods_are_found_from_the_lines_the_first_left_out():
    responses, lines, _ = campaign()
    given = drives(samii(), lines, responses, recorded(*CASES[0]))
    assert sorted(given) == [0, 1]
    assert given[1].shape == (2, N)
    assert np.allclose(given[1], sweep(1.0))
    assert drives(samii(), lines, responses, []) == {}


def test_recordings_with_a_force_confirm_it_and_others_do_not():
    quasi, p = CASES[0]
    responses, lines, at = campaign()
    held = Problem.of(lines, at)
    _, model, x = model_of(quasi, p)
    there = refit(model, held, x, steps=0)
    plain = refit(Model(samii()), held, x[:-1], steps=0)
    true = seen(plain, there, at, lines, responses, recorded(quasi, p))
    none = seen(plain, there, at, lines, responses, recorded(quasi, 1e-9))
    assert true.holds
    assert true.share == pytest.approx(1.0, abs=0.1)
    assert not none.holds
    assert none.fall < 0
    assert "of the force" in true.told()
    assert seen(plain, there, at, lines, responses, []) is None


def test_force_and_parameters_end_where_both_agree_with_the_data():
    quasi, p = CASES[1]
    effect, _, _ = model_of(quasi, p)
    model = LevelModel(without_tolerances(samii(), but=("joint_1", "joint_2")), [effect])
    truth = np.append(np.zeros(model.n - 1), np.log(p))
    _, lines, at = campaign()
    given = {0: sweep(0.5)[None], 1: sweep(1.0)[None]}
    turns = []

    def problem(model, x, data=lines):
        now = model.strength(x)[0]
        turns.append(now)
        extra = Extra(driven(model, x, at, given, now), now)
        return Problem.of(data, replace(at, extra={quasi: extra}))

    held = problem(model, truth)
    measured_ = replace(lines, H=model.response(truth, held.at))
    start = truth.copy()
    start[model.unknown] += 0.3
    bent = refit(model, Problem.of(measured_, at), start, far=False)
    turns.clear()
    end = self_consistent(bent, lambda m, x: problem(m, x, measured_))
    assert np.exp(bent.x[model.unknown]) != pytest.approx(p, rel=0.02)
    assert np.exp(end.x[model.unknown]) == pytest.approx(p, rel=0.01)
    assert end.cost < 0.3
    assert len(turns) < 4 * model.n


def test_levels_that_differ_are_told_without_a_model():
    quasi, p = CASES[0]
    _, model, x = model_of(quasi, p)
    _, lines, at = campaign()
    other = replace(lines, H=model.response(x, at.at(lines.frequency, lines.level)))
    assert lines.differing() < 1e-6
    assert other.differing() > 0.5
    assert np.isnan(lines.take(lines.level == 0).differing())


def test_levels_against_each_other_tell_a_force_but_nothing_linear():
    quasi, p = CASES[0]
    effect, model, x = model_of(quasi, p)
    _, lines, at = campaign()
    plain = refit(Model(samii()), Problem.of(lines, at), x[:-1], steps=0)
    h = model.response(x, at.at(lines.frequency, lines.level))
    late = lines.H * np.exp(-2e-4j * 2 * np.pi * lines.frequency)[:, None]

    def promised(H):
        problem = Problem.of(Bins.of(replace(lines, H=H), plain, at).combined(), at)
        return Levels.of(problem, plain).promise(effect, model)

    there, not_there = promised(h), promised(late)
    assert there.contrast == pytest.approx(there.due, rel=0.05)
    assert there.starts[0] == pytest.approx(p, rel=0.1)
    assert not_there.contrast < 0.05 * max(not_there.due, not_there.gain, 1.0)


def test_bursts_that_still_ring_have_no_period():
    responses, lines, _ = campaign()
    ringing = [replace(responses[0], method="local (drawn)"), responses[1]]
    assert sorted(drives(samii(), lines, ringing, recorded(*CASES[0]))) == [1]


@pytest.mark.parametrize("settled", [0, 1, 2])
def test_levels_are_left_out_where_two_others_repeat_themselves(settled):
    bursts = [
        replace(r, method="settled (drawn)" if i < settled else "local (drawn)", level=level)
        for i, (r, level) in enumerate(zip(campaign()[0] * 2, (0.5, 1.0, 0.7), strict=False))
    ]
    multisines = [replace(r, method="periodic (drawn)") for r in campaign()[0]]
    responses = [*bursts, *multisines]
    runs = recorded(*CASES[0])
    runs += [
        replace(r, segments=tuple(replace(s, kind="periodic") for s in r.segments)) for r in runs
    ]
    lines = measured(responses, samii()).splits()[0]
    search = Search(samii(), lines, grid(samii(), *at_of(lines)), [])
    assert compete(search, responses, runs) is None
    assert search.lines is lines
    given = drives(samii(), lines, responses, runs)
    kept = timed(lines, given)
    assert sorted(set(kept.level)) == ([0, 1] if settled == 2 else [0, 1, 2])


def at_of(lines):
    return lines.frequency, lines.sensor, lines.actuator


def test_a_rig_is_driven_until_its_force_repeats_itself():
    """After two of these periods, which do not end at rest, it is still 2 % off."""
    quasi, p = CASES[1]
    _, model, x = model_of(quasi, p)
    inner = Inner.of(model, x)
    found = inner.force(sweep(1.0), p)
    last = inner.force(np.tile(sweep(1.0), 5), p)[-found.size :]
    assert np.linalg.norm(found - last) < 1e-3 * np.linalg.norm(found)


@pytest.mark.parametrize(("quasi", "p"), [CASES[1], CASES[2]])
def test_what_rings_for_many_periods_is_found_in_a_few(quasi, p, monkeypatch):
    """A second of multisine: after five of them from rest the force is still far off."""
    _, model, x = model_of(quasi, p)
    inner = Inner.of(model, x)
    n, rng = 500, np.random.default_rng(3)
    t = np.arange(n) / n
    v = sum(np.sin(2 * np.pi * (k * t + rng.uniform())) for k in range(1, 30)) / 8
    periods = 0

    def counted(*given):
        nonlocal periods
        periods += 1
        return _lap(*given)

    monkeypatch.setattr(nonlinear_inner, "_lap", counted)
    found = inner.force(v, p)
    assert periods < nonlinear_inner.LAPS  # it ended by itself
    state = np.zeros_like(inner.grow)
    long = _lap(
        state, inner.grow, inner.by_v, inner.by_e, inner.direct, inner.g, np.tile(v, 80),
        inner.late, nonlinear_inner.INNER, inner.code, p, inner.scale,
    ).reshape(80, -1)  # fmt: skip
    assert np.linalg.norm(long[4] - long[-1]) > 0.02 * np.linalg.norm(long[-1])
    assert np.linalg.norm(found - long[-1]) < 1e-3 * np.linalg.norm(long[-1])


def test_a_limit_is_looked_for_below_the_largest_command_of_the_levels_at_hand():
    _, model, _ = model_of(*CASES[5])
    lines = campaign()[1]
    given = {0: sweep(0.5)[None], 1: sweep(1.0)[None], 7: sweep(3.0)[None]}
    assert top_of(model, given, lines) == pytest.approx(1.0, abs=1e-3)
    assert top_of(model, given, lines.take(lines.level == 0)) == pytest.approx(0.5, abs=1e-3)
    _, joint, _ = model_of(*CASES[0])
    assert top_of(joint, given, lines) == 0


@pytest.mark.parametrize("top", [1.0, 0.0])
def test_a_limit_that_was_computed_above_every_command_cuts_nothing(top):
    """A refit may lead there; what follows must stay a number."""
    quasi, p = CASES[5]
    _, model, x = model_of(quasi, p)
    _, lines, at = campaign()
    zero = np.zeros((*at.driven.shape, at.sensor.size), complex)
    beyond = replace(at, extra={quasi: Extra(zero, 1.2, top)})
    there = beyond.at(lines.frequency, lines.level)
    h, dh = model.gradient(x, there)
    bare, _ = model.gradient(x, at.at(lines.frequency, lines.level))
    np.testing.assert_array_equal(h, bare)
    assert np.all(np.isfinite(dh))


@pytest.mark.parametrize(("gained", "told"), [(14.0, False), (60.0, True)])
def test_a_linear_effect_beside_a_force_must_show_in_the_data(gained, told):
    force, _, _ = model_of(*CASES[0])
    beside = Effect("added_mass", "beam")
    one = SimpleNamespace(key=frozenset({force.key}), effects=(force,), fitted=fit_of(1000.0))
    both = SimpleNamespace(
        key=frozenset({force.key, beside.key}),
        effects=(force, beside),
        fitted=fit_of(1000.0 - gained),
    )
    search = SimpleNamespace(
        found={one.key: one},
        temperature=1.0,
        worth=IN_DATA,
        nominal=SimpleNamespace(fitted=fit_of(5000.0)),
    )
    assert _is_thin(search, both) is not told


@pytest.mark.parametrize(("better", "rough", "told"), [(2000.0, 0.05, False), (6000.0, 0.05, True),
                                                       (2000.0, 0.0, True)])  # fmt: skip
def test_several_effects_must_outdo_a_law_by_more_than_it_is_off(better, rough, told):
    loss = Effect("structural_damping", "beam", rough=rough)
    a, b = Effect("torsional_compliance", "clamp"), Effect("viscous_damping", "joint_1")
    one = SimpleNamespace(key=frozenset({loss.key}), effects=(loss,), fitted=fit_of(4500.0))
    both = SimpleNamespace(
        key=frozenset({a.key, b.key}), effects=(a, b), fitted=fit_of(4500.0 - better)
    )
    without = SimpleNamespace(effects=(a,), fitted=fit_of(1e5))
    search = SimpleNamespace(
        found={one.key: one},
        temperature=1.0,
        worth=IN_DATA,
        nominal=SimpleNamespace(fitted=fit_of(1.6e6)),
        without=lambda _e, _i: without,
    )
    assert _is_thin(search, both) is not told


def fit_of(chi2):
    return SimpleNamespace(chi2=chi2)
