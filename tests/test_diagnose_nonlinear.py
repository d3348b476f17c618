"""Nonlinear forces: told by their levels, checked against an integration in time, not made up."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identify_kit import noiseless, samii, without_tolerances

from samii_rig.diagnose import nonlinear
from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.diagnose.effect import Effect, Unknown
from samii_rig.diagnose.measured import measured
from samii_rig.diagnose.model import grid
from samii_rig.diagnose.nonlinear_laws import CUBIC, EXCESS, FRICTION, GAP, starved
from samii_rig.diagnose.nonlinear_levels import level_grid
from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi
from samii_rig.diagnose.nonlinear_time import confirm, simulate
from samii_rig.diagnose.refit import Problem, refit
from samii_rig.diagnose.search import Search
from samii_rig.identify.bootstrap import redraw
from samii_rig.model.sampled import sampled_response
from samii_rig.record.importer import import_file
from samii_rig.record.maps import load_map
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, Recording

BAND = (0.5, 40.0)
LINES = np.geomspace(*BAND, 80)
LEVELS = (0.25, 0.5, 1.0)
JOINT = Quasi("joint", ("joint_2",), FRICTION)
ACROSS = Quasi("joint", ("joint_2_source", "joint_2"), FRICTION)
DRIVE = Quasi("drive", ("joint_2_source",), FRICTION)
HARD = Quasi("joint", ("joint_1",), CUBIC)
PLAY = Quasi("joint", ("joint_2",), GAP, 1.0, ("joint_2", "k"))
OVERLAP = Quasi("command", ("joint_2_source",), GAP)
CLIP = Quasi("command", ("joint_2_source",), EXCESS)
FLOW = Quasi("flow", ("joint_2_source",), None)
CASES = [
    (JOINT, 5.0), (ACROSS, 5.0), (DRIVE, 0.05), (HARD, 1e8), (PLAY, 1e-4), (OVERLAP, 0.5),
    (CLIP, 0.5), (FLOW, 500.0),
]  # fmt: skip


def like(level, f=LINES):
    """A response at one level: a sweep of that amplitude at every frequency."""
    return replace(
        noiseless(samii(), f), level=level, input_rms=np.full((f.size, 1), level / np.sqrt(2))
    )


def problem(levels, f=LINES, method="burst (drawn)"):
    responses = [replace(like(x, f), method=method) for x in levels]
    lines = measured(responses, samii())
    at = grid(samii(), lines.frequency, lines.sensor, lines.actuator)
    return Problem.of(lines, level_grid(samii(), at, lines, responses))


def model_of(quasi, p):
    effect = Effect("x", "y", (Unknown("p", "1", p / 100, 100 * p, (p,)),), quasi=quasi)
    model = LevelModel(samii(), [effect])
    x = np.zeros(model.n)
    x[-1] = np.log(p)
    return model, x


@cache
def drawn(quasi, p, seed=1):
    """Measurements at three levels of a rig with the force in it, or without."""
    there = problem(LEVELS)
    model, x = model_of(quasi or DRIVE, p)
    at = there.at if quasi else replace(there.at, power=None)
    h = model.response(x, at)
    rng = np.random.default_rng(seed)
    return [
        redraw(like(level), h[there.data.level == k][:, :, None], rng, 10)
        for k, level in enumerate(LEVELS)
    ]


@cache
def linear_rivals():
    names = ("velocity_feedback", "actuator_lag", "sensor_gain")
    return [e for e in table(samii(), *BAND) if e.physics in names]


@pytest.mark.parametrize("law", [FRICTION, CUBIC, GAP, EXCESS])
@given(A=st.floats(0.1, 10.0), p=st.floats(0.1, 5.0))
@settings(max_examples=15)
def test_a_describing_function_is_the_fundamental_of_the_force(law, A, p):
    turn = (np.arange(20000) + 0.5) / 20000 * 2 * np.pi
    y = A * np.cos(turn)
    fundamental = 2 * np.mean(law.force(y, p) * np.cos(turn)) / A
    assert law.sine(np.array([A]), p)[0] == pytest.approx(fundamental, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize("law", [FRICTION, CUBIC, GAP, EXCESS])
@given(sigma=st.floats(0.2, 3.0), p=st.floats(0.2, 3.0))
@settings(max_examples=10)
def test_for_a_gaussian_motion_it_is_the_best_linear_gain(law, sigma, p):
    y = np.linspace(-8, 8, 20001) * sigma
    weight = np.exp(-0.5 * (y / sigma) ** 2)
    best = np.sum(weight * y * law.force(y, p)) / np.sum(weight * y**2)
    assert law.gauss(np.array([sigma]), p)[0] == pytest.approx(best, rel=2e-3, abs=1e-5)


def test_an_orifice_lets_less_through_against_a_load_and_more_with_it():
    flow = np.array([1 + 0j, 1 + 0j])
    against, along = starved(flow, np.array([-0.3, 0.3]) + 0j, 1.0)
    assert against.real < 0 < along.real
    assert np.abs(starved(flow, np.array([0.3, 0.3]) + 0j, 1e9)).max() < 1e-9


@pytest.mark.parametrize(("quasi", "p"), CASES)
def test_the_quasi_linear_response_is_that_of_an_integration_in_time(quasi, p):
    f0, rate = 6.25, samii().rate_hz
    f = np.array([1.0, f0, 7.0])
    there = problem([1.0], f)
    model, x = model_of(quasi, p)
    want = model.response(x, there.at)[1]
    linear = model.response(x, replace(there.at, power=None))[1]
    n = np.arange(int(6 * rate))
    y = simulate(samii(), np.cos(2 * np.pi * f0 * n / rate), quasi, p)
    late = n >= 4 * rate
    tone = np.exp(-2j * np.pi * f0 * n[late] / rate)
    got = 2 * np.mean((y[late] - y[late].mean(axis=0)) * tone[:, None], axis=0)
    assert np.all(np.abs(want - linear) > 3e-3 * np.abs(linear))
    # Harmonics that come back are all that a describing function leaves out.
    assert np.all(np.abs(got - want) < 0.1 * np.abs(want - linear) + 2e-3 * np.abs(linear))


def test_without_a_force_the_integration_is_the_sampled_rig():
    rate = samii().rate_hz
    n = np.arange(int(6 * rate))
    y = simulate(samii(), np.cos(2 * np.pi * 6.25 * n / rate))[n >= 4 * rate]
    tone = np.exp(-2j * np.pi * 6.25 * n[n >= 4 * rate] / rate)
    got = 2 * np.mean((y - y.mean(axis=0)) * tone[:, None], axis=0)
    assert np.allclose(got, sampled_response(samii(), np.array([6.25]))[0, :, 0], rtol=2e-3)


@pytest.mark.parametrize("method", ["burst (drawn)", "periodic (drawn)"])
@pytest.mark.parametrize(("quasi", "p"), [(JOINT, 0.3), (DRIVE, 0.01), (HARD, 1e6), (OVERLAP, 0.1)])
def test_a_gradient_is_the_derivative(quasi, p, method):
    there = problem(LEVELS, LINES[::4], method)
    model, x = model_of(quasi, p)
    h, dh = model.gradient(x, there.at)
    assert np.allclose(h, model.response(x, there.at), rtol=1e-12)
    for j in (0, 4, model.n - 1):
        step = np.zeros(model.n)
        step[j] = 1e-4
        slope = (model.response(x + step, there.at) - model.response(x - step, there.at)) / 2e-4
        assert np.allclose(dh[:, :, j], slope, rtol=5e-3, atol=1e-3 * np.abs(slope).max())


@pytest.mark.parametrize(("quasi", "p"), [(JOINT, 0.3), (DRIVE, 0.01)])
def test_a_force_alone_has_a_gradient_where_the_rig_file_states_no_tolerance(quasi, p):
    there = problem(LEVELS, LINES[::4], "burst (drawn)")
    whole, x = model_of(quasi, p)
    model = LevelModel(without_tolerances(samii()), whole.effects)
    h, dh = model.gradient(x[-1:], there.at)
    bare, every = whole.gradient(x, there.at)
    np.testing.assert_allclose(h, bare, rtol=1e-12)
    np.testing.assert_allclose(dh, every[:, :, -1:], rtol=1e-9)


@pytest.mark.parametrize(
    ("quasi", "p", "name"),
    [
        (Quasi("joint", ("joint_1",), FRICTION), 0.25, ("coulomb_friction", "joint_1", "T_c")),
        (CLIP, 0.8, ("output_saturation", "joint_2_source", "limit")),
    ],
)
def test_what_depends_on_the_level_is_named_but_not_without_confirmation(quasi, p, name):
    found = diagnose(drawn(quasi, p), samii(), effects=linear_rivals())
    (cause,) = found.causes
    assert (cause.physics, cause.site) == name[:2]
    assert cause.parameters[name[2]].value == pytest.approx(p, rel=0.05)
    assert found.verdict == "ambiguous"
    assert any("not confirmed in time" in text for text in found.not_physics)
    assert found.gap.value > 0.8
    assert any("its part in the response" in text for text in found.not_physics)
    assert "amplitude" in found.why


def test_a_linear_rig_gets_no_nonlinear_name():
    for seed in range(2):
        found = diagnose(drawn(None, 0.01, seed), samii(), effects=linear_rivals()[:4])
        assert found.verdict == "no_mismatch"
        assert found.causes == ()


def test_linear_physics_stays_linear_at_three_levels():
    late = next(e for e in linear_rivals() if e.name == ("sensor_gain", "a_1"))
    responses = []
    for r in drawn(None, 0.01):
        gain = np.array([1, 1, 1.2, 1])
        covariance = gain[:, None] * r.covariance * gain
        responses.append(replace(r, H=r.H * gain[:, None], covariance=covariance))
    found = diagnose(responses, samii(), effects=[late, *linear_rivals()[:4]])
    assert [c.physics for c in found.causes] == ["sensor_gain"]
    assert found.verdict == "named"


def test_with_one_level_it_says_what_cannot_be_known():
    found = diagnose(drawn(HARD, 3e6)[-1:], samii(), effects=linear_rivals()[:6])
    assert not {c.physics for c in found.causes} & set(nonlinear.NAMES)
    assert found.verdict == "no_mismatch" or nonlinear.ONE_LEVEL in found.not_physics


def test_the_lines_that_a_multisine_leaves_silent_are_told():
    odd = replace(like(0.5), odd=np.full((LINES.size, 4), 0.03), even=np.zeros((LINES.size, 4)))
    assert nonlinear.distorted([odd]) == [
        "odd distortion of 3 % at 0.5 V",
        "even distortion of 0 % at 0.5 V",
    ]


def recorded(quasi, p, level, seed=0):
    """A sweep of the rig with the force, as a recording without noise."""
    rate = samii().rate_hz
    t = np.arange(int(12 * rate)) / rate
    v = level * np.sin(2 * np.pi * (0.5 * t + 0.4 * t**2)) * np.minimum(1, 12 - t)
    y = simulate(samii(), v, quasi, p, inner=16)
    names = [s.name for s in samii().sensor]
    return Recording(
        channels=(
            Channel("v_2", "V", "command"),
            *(Channel(n, samii().units()[n], "sensor") for n in names),
        ),
        rate_hz=rate,
        time=np.arange(t.size) * 2_000_000,
        sequence=np.arange(t.size),
        values=np.column_stack([v, y]),
        quality=np.zeros((t.size, 1 + len(names)), np.uint8),
    )


def test_recorded_inputs_confirm_the_force_that_is_there_and_no_other():
    responses = drawn(DRIVE, 0.02)
    there = measured(responses, samii())
    at = grid(samii(), there.frequency, there.sensor, there.actuator)
    held = Problem.of(there, level_grid(samii(), at, there, responses))
    model, x = model_of(DRIVE, 0.02)
    forced = refit(model, held, x)
    linear = refit(model, Problem(held.data, held.root, replace(held.at, power=None)), x)
    plain = replace(linear, model=forced.model)
    true = confirm(plain, forced, [recorded(DRIVE, 0.02, 0.5)], BAND)
    model, x = model_of(HARD, 1e7)
    other = confirm(plain, refit(model, held, x), [recorded(DRIVE, 0.02, 0.5)], BAND)
    assert true.holds
    assert true.forced < 0.5 * true.linear
    assert not other.holds
    assert "simulated in time" in true.told()


def test_the_real_motor_has_dry_friction_that_also_holds_on_steps(recordings):
    rig = load_rig("sflr")[0]
    off = ("clamp", "beam", "accelerometer_mass")
    motor = rig.model_copy(
        update={
            "element": tuple(e for e in rig.element if e.name not in off),
            "sensor": tuple(s for s in rig.sensor if s.name == "theta"),
            "limit": (),
        }
    )
    band = (1.0, 6.0)  # above it the drive's gain falls with the amplitude, which friction cannot

    def runs(pattern, layout):
        return [import_file(f, *load_map(layout)) for f in sorted(recordings.glob(pattern))]

    sweeps = [r for n in (50, 100, 150) for r in runs(f"*motor-only_swept*amp-{n}_*", "sflr_motor")]
    steps = runs("*motor-only_ol_step*", "sflr_motor_open")
    rivals = [e for e in table(motor, *band) if e.physics in ("viscous_damping", "actuator_lag")]
    responses = estimate(sweeps, band=band)
    seen, _, _ = measured(responses, motor, band).splits()
    at = grid(motor, measured(responses, motor, band).frequency, seen.sensor, seen.actuator)
    search = Search(motor, seen, at, rivals)
    search.run()
    friction = nonlinear.compete(search, responses)
    assert friction is not None
    assert friction.physics == "coulomb_friction"
    assert {site for _, site in friction.names} == {"motor", "spring"}
    best = search.ranked()[0]
    assert np.exp(best.fitted.x[-1]) == pytest.approx(0.0128, rel=0.1)  # N m
    held = confirm(search.nominal.fitted, best.fitted, steps)
    assert held.holds
    assert held.forced < 0.75 * held.linear
