"""The second plant against what it shares no code with: the transfer matrices' frequencies and
responses, brute-force integration, closed forms; and its trials against their own truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from samii_rig.errors import InputError
from samii_rig.model.loops import closed_response
from samii_rig.model.modes import natural_frequencies
from samii_rig.model.sampled import sampled_response
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import (
    Branch,
    LumpedMass,
    Parameter,
    Rig,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
)
from sim.assumed_modes import __main__ as command
from sim.assumed_modes import (
    effects,
    forces,
    kernel,
    make,
    outside,
    rigfile,
    ritz,
    size,
    styles,
    trial,
    varying,
)
from sim.assumed_modes.noise import noise_model, whitener
from sim.assumed_modes.parts import Attachment, Force, Part, Setup, nominal, setup_of
from sim.assumed_modes.plant import plant
from sim.assumed_modes.ritz import Mechanism
from sim.assumed_modes.sampled import Loop, closed, discrete, timeline
from sim.assumed_modes.sigma import Bench, Records, Waveform
from sim.assumed_modes.simulate import Control, clean, recorded

RIGS = (
    "samii",
    "samii_braced",
    "samii_joint_3",
    "samii_torque_horizontal",
    "samii_torque_vertical",
    "sflr",
)


BENCHES = (
    "beam_on_shaker",
    "carriage",
    "cylinder",
    "flexible_joint",
    "one_mass",
    "spindle_drive",
    "three_masses",
    "two_masses",
)


def loop_of(setup: Setup, rig: Rig) -> Loop:
    made = plant(setup)
    return closed(discrete(made, timeline(setup, made, rig.rate_hz)), trial.feedback_of(rig))


def response(loop: Loop, frequency: np.ndarray, rate_hz: float) -> np.ndarray:
    """(n_freq, n_y), of the first input."""
    return responses(loop, frequency, rate_hz)[:, :, 0]


def responses(loop: Loop, frequency: np.ndarray, rate_hz: float) -> np.ndarray:
    """(n_freq, n_y, n_in)."""
    z = np.exp(2j * np.pi * frequency / rate_hz)
    return np.array([loop.C @ np.linalg.solve(x * np.eye(len(loop.A)) - loop.A, loop.b) for x in z])


@pytest.mark.parametrize("name", RIGS)
def test_natural_frequencies_are_those_of_the_transfer_matrices(name: str) -> None:
    rig, _ = load_rig(name)
    expected = natural_frequencies(rig, 0.1, 200.0).hz
    mech = Mechanism(setup_of(rig, {}))
    free = np.ix_(mech.free, mech.free)
    found = np.sqrt(np.abs(eigh(mech.K[free], mech.M[free], eigvals_only=True))) / (2 * np.pi)
    np.testing.assert_allclose(found[: expected.size], expected, rtol=2e-7)


# SFLR's accelerometer has no anti-alias filter and its beam no damping: modes of some kHz fold
# back, where twelve shapes no longer follow.
@pytest.mark.parametrize(
    ("name", "tolerance"), [*((n, 1e-4) for n in RIGS if n != "sflr"), ("sflr", 1e-3)]
)
def test_closed_loop_is_that_of_the_transfer_matrices(name: str, tolerance: float) -> None:
    rig, _ = load_rig(name)
    f = np.geomspace(0.2, 40.0, 60)
    expected = closed_response(rig, f)[:, :, 0]
    found = response(loop_of(setup_of(rig, {}), rig), f, rig.rate_hz)
    assert np.max(np.abs(found / expected - 1)) < tolerance


@pytest.mark.parametrize("name", BENCHES)
def test_benches_that_slide_turn_and_shake_are_those_of_the_transfer_matrices(name: str) -> None:
    rig, _ = load_rig(name)
    f = np.geomspace(0.2, 60.0, 60)
    expected = (closed_response if rig.centring else sampled_response)(rig, f)[:, :, 0]
    found = response(loop_of(setup_of(rig, {}), rig), f, rig.rate_hz)
    assert np.max(np.abs(found / expected - 1)) < 1e-5
    # The rig file that goes with a trial is the same rig.
    again = parse(Rig, rigfile.text(rig), name)
    kept = (closed_response if rig.centring else sampled_response)(again, f)[:, :, 0]
    np.testing.assert_allclose(kept, expected, rtol=1e-12)


def test_a_table_whose_acceleration_was_measured_is_that_of_the_transfer_matrices() -> None:
    rig, _ = load_rig("beam_on_shaker")
    table, *others = rig.element
    measured = table.model_copy(update={"omega": None, "zeta": None})
    rig = rig.model_copy(update={"element": (measured, *others)})
    f = np.geomspace(0.2, 60.0, 60)
    expected = sampled_response(rig, f)[:, :, 0]
    found = response(loop_of(setup_of(rig, {}), rig), f, rig.rate_hz)
    assert np.max(np.abs(found / expected - 1)) < 1e-5
    assert parse(Rig, rigfile.text(rig), "again").element[0] == measured


@pytest.mark.parametrize(("rig", "effect"), [
    ("two_masses", "added_mass"), ("two_masses", "ground_spring"),
    ("carriage", "translational_compliance"), ("spindle_drive", "torsional_compliance"),
    ("flexible_joint", "added_inertia"), ("cylinder", "viscous_damping"),
])  # fmt: skip
def test_an_effect_of_a_bench_is_named_by_places_where_it_means_the_same(
    rig: str, effect: str
) -> None:
    nominal_rig, _ = load_rig(rig)
    setup = setup_of(nominal_rig, {})
    f = np.geomspace(1.0, 60.0, 20)
    before = response(loop_of(setup, nominal_rig), f, nominal_rig.rate_hz)
    draft = effects.LINEAR[effect](np.random.default_rng(3), setup)
    scale = {"translational_compliance": 1e-5, "torsional_compliance": 0.1, "ground_spring": 2e3,
             "viscous_damping": 20.0}.get(effect, 0.02)  # fmt: skip
    after = response(loop_of(draft.put(setup, scale), nominal_rig), f, nominal_rig.rate_hz)
    assert np.max(np.abs(after / before - 1)) > 1e-3
    where = setup.turning() if effect in ("torsional_compliance", "added_inertia") else (
        setup.shifting())  # fmt: skip
    assert draft.site in where
    assert {site for _, site in draft.also} <= {p.name for p in setup.parts}


def test_what_cannot_move_so_conceals_nothing() -> None:
    masses, joint = (setup_of(load_rig(n)[0], {}) for n in ("two_masses", "flexible_joint"))
    rng = np.random.default_rng(0)
    for make_draft, setup in ((effects.inertia, masses), (effects.compliance, masses),
                              (effects.mass, joint), (effects.sideways, joint)):  # fmt: skip
        with pytest.raises(LookupError):
            make_draft(rng, setup)


def _two_joints() -> tuple[Rig, Setup]:
    rig, _ = load_rig("samii_two_joints")
    return rig, setup_of(rig, {})


@pytest.mark.parametrize("gain", [0.0, 1.0], ids=["open loops", "closed loops"])
def test_two_driven_joints_answer_as_the_transfer_matrices_say(gain: float) -> None:
    rig, setup = _two_joints()
    feedback = gain * trial.feedback_of(rig)
    made = plant(setup)
    loop = closed(discrete(made, timeline(setup, made, rig.rate_hz)), feedback)
    f = np.geomspace(0.2, 60.0, 40)
    H = sampled_response(rig, f)
    # v = u - F y and y = H v: both loops close at once.
    expected = H @ np.linalg.inv(np.eye(2) + feedback @ H)
    found = responses(loop, f, rig.rate_hz)
    assert found.shape == (40, 5, 2)
    assert np.max(np.abs(found / expected - 1)) < 1e-6


@pytest.mark.parametrize("k", [0, 1])
def test_a_drive_s_effect_is_in_the_answers_to_its_own_input(k: int) -> None:
    _, setup = _two_joints()
    f = np.geomspace(0.5, 40.0, 20)
    s = 2j * np.pi * f

    def answers(setup: Setup) -> np.ndarray:
        p = plant(setup)
        eye = np.eye(len(p.A))
        return np.array([p.C @ np.linalg.solve(x * eye - p.A, p.B[:, :2]) for x in s])

    drafts = [effects.lag(np.random.default_rng(seed), setup) for seed in range(8)]
    draft = next(d for d in drafts if d.site == ("joint_2_source", "joint_3_source")[k])
    ratio = answers(draft.put(setup, 1 / 300.0)) / answers(setup)
    lagging = 300.0 / (s + 300.0)
    assert np.max(np.abs(ratio[:, :, 1 - k] - 1.0)) < 1e-7
    assert np.max(np.abs(ratio[:, :, k] / lagging[:, None] - 1.0)) < 1e-7


@pytest.mark.parametrize("k", [0, 1])
@pytest.mark.parametrize(("law", "values"), [
    ("valve_deadband", {"width": 1.0}), ("output_saturation", {"limit": 0.2}),
    ("flow_saturation", {"M_stall": 30.0}),
])  # fmt: skip
def test_a_drive_s_law_acts_on_its_own_command(law: str, values: dict[str, float], k: int) -> None:
    rig, setup = _two_joints()
    bent = replace(setup, forces=(Force(law, f"v_{2 + k}", values),))
    open_loops = Control(np.zeros((2, 5)), rig.rate_hz)
    sine = 2.0 * np.sin(2 * np.pi * 4.0 * np.arange(300) / rig.rate_hz)
    for driven in (0, 1):
        r = np.zeros((300, 2))
        r[:, driven] = sine
        plain, with_law = clean(setup, open_loops, r), clean(bent, open_loops, r)
        change = np.abs(with_law - plain).max(axis=0) / np.abs(plain).max(axis=0)
        if driven == k:
            assert np.all(change > 0.03)
        else:
            assert np.all(change < 1e-9)


@pytest.mark.parametrize("how", styles.SEVERAL)
@pytest.mark.parametrize(
    "excitation", [x for x in styles.EXCITATIONS if x not in styles.OF_ONE_INPUT]
)
def test_experiments_of_two_inputs_tell_them_apart(excitation: str, how: str) -> None:
    about = styles.About(500.0, inputs=2)
    style = styles.draw(np.random.default_rng(8), ("clean", excitation, how), about)
    pieces = [p for f in style.files for p in f]
    assert style.options == (how,)
    assert {p.driven for p in pieces} == ({(0,), (1,)} if how == "in_turn" else {(0, 1)})
    assert max(float(np.abs(p.r).max()) for p in pieces) <= 1.0 + 1e-9
    # Over all experiments of a level the inputs' products cancel.
    level = [p.r for p in pieces if p.level == 1.0 and p.repeat == 0]
    products = sum(r.T @ r for r in level)
    assert abs(products[0, 1]) < 1e-9 * min(products[0, 0], products[1, 1])


def test_a_trial_of_two_inputs_has_the_columns_of_both_and_both_loops(tmp_path: Path) -> None:
    rig, text = load_rig("samii_two_joints")
    folder = make("nothing", 1, tmp_path, text, ("clean", "bursts", "in_turn"))
    run = read_recording(folder / "run_01.mcap")
    assert run.names("reference") == ("u_v_2", "theta_ref_v_2", "u_v_3", "theta_ref_v_3")
    assert run.names("command") == ("v_2", "v_3")
    assert {s.excited for s in run.segments} == {("v_2",), ("v_3",)}
    for name in ("v_2", "v_3"):
        loop = rig.centring_of(name)
        assert loop is not None
        u, v, theta = (run.values[:, run.column(x)] for x in (f"u_{name}", name, loop.sensor))
        assert np.abs(v - (u - loop.kp * theta)).max() <= 0.51 * 20.0 / 2**16


def _parameter(value: float, unit: str) -> Parameter:
    return Parameter(value=value, unit=unit, source="test")


def _elements() -> dict[str, tuple[object, object]]:
    """An effect of this plant beside the element that the transfer matrices have for it."""
    hung = Branch(
        kind="branch",
        name="hung",
        element=(
            TranslationalSpring(
                kind="translational_spring",
                name="hook",
                k=_parameter(900.0, "N/m"),
                c=_parameter(1.0, "N s/m"),
            ),
            LumpedMass(kind="lumped_mass", name="bob", m=_parameter(0.3, "kg")),
        ),
    )
    mass = LumpedMass(
        kind="lumped_mass", name="x", m=_parameter(0.4, "kg"), I=_parameter(0.02, "kg m^2")
    )
    spring = TranslationalGroundSpring(
        kind="translational_ground_spring",
        name="x",
        k=_parameter(2e4, "N/m"),
        c=_parameter(30.0, "N s/m"),
    )
    gives = TorsionalSpring(
        kind="torsional_spring",
        name="x",
        k=_parameter(4e4, "N m/rad"),
        c=_parameter(20.0, "N m s/rad"),
    )
    L = 0.3302  # m, link_0's
    return {
        "mass": (mass, Attachment("mass", "link_0", L, {"m": 0.4, "J": 0.02})),
        "ground": (spring, Attachment("ground", "link_0", L, {"k": 2e4, "c": 30.0})),
        "oscillator": (
            hung,
            Attachment("oscillator", "link_0", L, {"m": 0.3, "k": 900.0, "c": 1.0}),
        ),
        "compliance": (gives, Part("x", "torsional_spring", {"k": 4e4, "c": 20.0})),
    }


@pytest.mark.parametrize("what", ["mass", "ground", "oscillator", "compliance"])
def test_effects_are_the_elements_of_the_transfer_matrices(what: str) -> None:
    rig, _ = load_rig("samii")
    element, effect = _elements()[what]
    at = [e.name for e in rig.element].index("link_0") + 1
    changed = rig.model_copy(update={"element": (*rig.element[:at], element, *rig.element[at:])})
    setup = setup_of(rig, {})
    if isinstance(effect, Part):
        # In series with joint_1 without a mass between: a coordinate without mass.
        setup = setup.inserted("link_0", effect)
    else:
        assert isinstance(effect, Attachment)
        setup = setup.attached(effect)
    f = np.geomspace(0.3, 40.0, 50)
    expected = closed_response(changed, f)[:, :, 0]
    found = response(loop_of(setup, rig), f, rig.rate_hz)
    assert np.max(np.abs(found / expected - 1)) < 1e-5


def _continuous(setup: Setup, s: np.ndarray) -> np.ndarray:
    """The first sensor's continuous response, dead time left out."""
    p = plant(setup)
    eye = np.eye(len(p.A))
    return np.array([p.C[0] @ np.linalg.solve(x * eye - p.A, p.B[:, 0]) for x in s])


def test_the_drive_s_effects_are_filters_of_the_input() -> None:
    rig, _ = load_rig("samii")
    f = np.geomspace(0.3, 40.0, 50)
    s = 2j * np.pi * f
    setup = setup_of(rig, {})
    rng = np.random.default_rng(1)
    for name, strength, expected in (
        ("actuator_lag", 1 / 400.0, 400.0 / (s + 400.0)),
        ("transport_delay", 3.3e-3, np.exp(-3.3e-3 * s)),
    ):
        draft = effects.LINEAR[name](rng, setup)
        put = draft.put(setup, strength)
        ratio = _continuous(put, s) / _continuous(setup, s)
        late = np.exp(-s * (put.drives[0].delay - setup.drives[0].delay))
        np.testing.assert_allclose(ratio * late, expected, rtol=1e-8)


def test_loss_factor_is_held_over_the_band_and_causal() -> None:
    eta = 0.04
    g, t, static = ritz.prony(eta)
    assert static > 0
    assert np.all(t > 0)
    w = 2 * np.pi * np.geomspace(0.2, 500.0, 200)
    x = w[:, None] * t
    storage, loss = static + (x**2 / (1 + x**2)) @ g, (x / (1 + x**2)) @ g
    np.testing.assert_allclose(loss / storage, eta, rtol=0.05)
    at = 2 * np.pi * ritz.REFERENCE_HZ * t
    assert static + (at**2 / (1 + at**2)) @ g == pytest.approx(1.0)
    # Kramers and Kronig for a small constant loss: the modulus grows by 2 eta/pi a neper.
    growth = np.diff(np.log(storage)) / np.diff(np.log(w))
    np.testing.assert_allclose(growth[40:-40].mean(), 2 * eta / np.pi, rtol=0.05)


Law = Callable[[float], float]


def _brute(setup: Setup, control: Control, r: np.ndarray, force: Law | None = None) -> np.ndarray:
    """The loop by a general integrator, sample by sample; the sensors' delays as a history."""
    made = plant(setup)
    T = 1.0 / control.rate_hz
    (drive,) = setup.drives
    lag = drive.actuator.delay + drive.delay
    wait, switch = int(lag / T), lag % T
    x, history, shown = np.zeros(len(made.A)), [0.0] * (wait + 2), []
    lines: list[list[float]] = [[] for _ in setup.sensors]
    y = np.zeros((len(r), len(setup.sensors)))

    def rate(t: float, x: np.ndarray, v: float) -> np.ndarray:
        u = np.zeros(made.B.shape[1])
        u[0] = v
        if force is not None:
            u[1] = force(float(made.Z[0] @ x))
        return made.A @ x + made.B @ u

    for k in range(len(r)):
        for i, s in enumerate(setup.sensors):
            late = int(s.delay / T + 1e-9) + 1
            y[k, i] = lines[i][k - late] if k >= late else 0.0
        history = [float(r[k, 0] - control.feedback[0] @ y[k]), *history[:-1]]
        marks = sorted({0.0, switch, T, *(T - s.delay % T for s in setup.sensors)})
        for a, b in pairwise(marks):
            v = history[wait + 1] if b <= switch + 1e-12 else history[wait]
            solved = solve_ivp(rate, (a, b), x, args=(v,), rtol=1e-10, atol=1e-13, method="LSODA")
            x = solved.y[:, -1]
            for i, s in enumerate(setup.sensors):
                if abs(b - (T - s.delay % T)) < 1e-12:
                    lines[i].append(float(made.C[i] @ x))
        shown.append(x)
    return y


def _delayed(name: str) -> tuple[Setup, Control]:
    rig, _ = load_rig(name)
    setup = setup_of(rig, {})
    sensors = (
        setup.sensors[0].model_copy(update={"delay": 0.0027}),
        *(s.model_copy(update={"delay": 0.0004}) for s in setup.sensors[1:]),
    )
    late = setup
    for k, drive in enumerate(setup.drives):  # each input by another part of a sample
        late = late.driven(replace(drive, delay=0.0033 - 0.0008 * k))
    return replace(late, sensors=sensors), Control(trial.feedback_of(rig), rig.rate_hz)


def test_exact_steps_with_delays_agree_with_brute_force() -> None:
    setup, control = _delayed("samii_torque_vertical")
    r = np.random.default_rng(3).standard_normal((60, 1))
    expected = _brute(setup, control, r)
    found = clean(setup, control, r)
    assert np.abs(found - expected).max(axis=0) == pytest.approx(
        np.zeros(2), abs=1e-7 * np.abs(expected).max()
    )


def _bench(setup: Setup, control: Control, r: np.ndarray, answer: np.ndarray) -> Bench:
    waveform = Waveform(r, (1.0,), 1)
    return Bench(control.rate_hz, 1, control.feedback, (waveform,), answer)


@pytest.mark.parametrize("name", ["samii", "samii_torque_vertical", "samii_two_joints"])
def test_the_compiled_loop_is_the_convolution_with_its_impulse_response(name: str) -> None:
    setup, control = _delayed(name)
    r = np.random.default_rng(4).standard_normal((3000, len(setup.drives)))
    expected = clean(setup, control, r)
    found = _bench(setup, control, r, np.zeros((1, 1, 1))).linear(setup)[0]
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


STYLE = ("clean", "single")


@pytest.fixture(scope="module")
def scene() -> trial.Scene:
    rngs = [np.random.default_rng([5, k]) for k in range(2)]
    rig = parse(Rig, load_rig("samii")[1], "samii")
    return trial.scene_of(rngs[0], rngs[1], rig, STYLE)


def test_the_predictor_makes_all_noise_white(scene: trial.Scene) -> None:
    wander = scene.noise.white * 4.0
    noise = replace(scene.noise, wander=wander, offset=0 * wander)
    loop = trial._loop(scene.setup, scene.control, noise.pushes)
    n = 20_000
    answer = whitener(noise_model(loop, noise, 500.0)).response(n)
    quiet = np.zeros((n, 1))
    y, v = recorded(scene.setup, scene.control, noise, quiet, np.random.default_rng(6))
    # What the output's converter rounds is known, as v is recorded.
    r = v + y @ scene.control.feedback.T
    bench = _bench(scene.setup, scene.control, r, answer)
    white = bench.white(y - bench.linear(scene.setup)[0])[500:]
    within = 5.0 / np.sqrt(n)
    np.testing.assert_allclose(white.var(axis=0), 1.0, atol=within * np.sqrt(2) + 0.02)
    across = np.corrcoef(white.T) - np.eye(4)
    assert np.abs(across).max() < within
    for lag in (1, 2, 10):
        assert np.abs(np.mean(white[lag:] * white[:-lag], axis=0)).max() < within


def test_a_refit_absorbs_what_the_tolerances_allow_and_keeps_the_rest(scene: trial.Scene) -> None:
    refit = trial.nominal_refit(scene)
    offsets = np.zeros(refit.n)
    offsets[scene.nominal.keys.index(("link_3_6", "m"))] = 1.0
    level = scene.bench.waveforms[0].levels[0]
    moved = [[level * y] for y in scene.bench.linear(scene.built(offsets))]
    assert refit.raw(moved) > 20.0
    assert refit.left(moved).sigma <= 1.0  # the move itself would do, and costs one tolerance
    gain = effects.changed(scene.setup, "a_1", gain=1.05)
    records = [[level * y] for y in scene.bench.linear(gain)]
    left = refit.left(records)
    assert 10.0 < left.sigma <= refit.raw(records)
    assert left.sigma**2 == pytest.approx(left.data**2 + left.moved @ left.moved)


@pytest.mark.parametrize(
    ("rig", "element", "far", "way"),
    [
        ("three_masses", "spring_1", 6.0, "cooled"),
        ("three_masses", "spring_3", -6.0, "cooled"),
        pytest.param("samii", "joint_1", 6.0, "cooled", marks=pytest.mark.slow),
        pytest.param("samii", "clamp", 6.0, "grown", marks=pytest.mark.slow),
    ],
)
def test_what_a_stiffness_far_off_explains_costs_no_more_than_that(
    rig: str, element: str, far: float, way: str
) -> None:
    rngs = [np.random.default_rng([7, k]) for k in range(2)]
    made = trial.scene_of(rngs[0], rngs[1], parse(Rig, load_rig(rig)[1], rig), STYLE)
    refit = trial.nominal_refit(made)
    offsets = np.zeros(refit.n)
    offsets[made.nominal.keys.index((element, "k"))] = far

    def of(strength: float) -> Records:
        unit = made.bench.linear(made.built(strength * offsets))
        both = zip(made.bench.waveforms, unit, strict=True)
        return [[level * y for level in w.levels] for w, y in both]

    assert refit.left(of(1.0)).sigma > 10 * abs(far)  # another valley
    found = refit.cooled(of(1.0)) if way == "cooled" else size.grown(refit, of, 1.0)
    # What grows ends where its cost is flat, to a few hundredths; how few, rounding decides.
    assert found.sigma <= abs(far) * (1.001 if way == "cooled" else 1.05)


def test_a_small_effect_s_sigma_is_that_of_the_linear_algebra(scene: trial.Scene) -> None:
    refit = trial.nominal_refit(scene)
    level = scene.bench.waveforms[0].levels[0]
    gain = effects.changed(scene.setup, "a_1", gain=1.0001)
    records = [[level * y] for y in scene.bench.linear(gain)]
    assert refit.left(records).sigma == pytest.approx(refit.tangent(records).sigma, rel=1e-2)


def _mass(name: str, m: float) -> str:
    exact = "".join(
        f'{k} = {{ value = 0.0, unit = "{unit}", source = "a point" }}\n'
        for k, unit in (("L", "m"), ("r", "m"), ("I", "kg m^2"))
    )
    return (
        f'[[element]]\nname = "{name}"\nkind = "rigid_link"\n{exact}'
        f'm = {{ value = {m}, unit = "kg", tolerance = 0.02, source = "test" }}\n'
        f'[[sensor]]\nname = "a_{name}"\nkind = "acceleration"\non = "{name}"\nposition = 0.0\n'
        'unit = "m/s^2"\nnoise_rms = 0.01\nlow = -50.0\nhigh = 50.0\n'
    )


def _spring(name: str, k: float) -> str:
    return (
        f'[[element]]\nname = "{name}"\nkind = "translational_spring"\n'
        f'k = {{ value = {k}, unit = "N/m", tolerance = 0.1, source = "test" }}\n'
        'c = { value = 2.0, unit = "N s/m", tolerance = 0.3, source = "test" }\n'
    )


MASSES = (
    'name = "Two masses"\nbase = "clamped"\ntip = "free"\nrate_hz = 500.0\n'
    + _spring("inner", 4000.0)
    + '[[element]]\nname = "shaker"\nkind = "force_source"\ninput = "v"\n'
    'K = { value = 5.0, unit = "N/V", tolerance = 0.05, source = "test" }\n'
    + _mass("first", 1.2)
    + _spring("outer", 2500.0)
    + _mass("second", 0.8)
    + '[[actuator]]\nname = "v"\nunit = "V"\nlow = -10.0\nhigh = 10.0\ndeadman = 0.05\n'
)
TORQUE = load_rig("samii_torque_vertical")[1]  # eight states: quick


def _samii() -> str:
    return load_rig("samii")[1]


def test_a_trial_says_what_it_conceals_and_is_the_same_again(tmp_path: Path) -> None:
    folders = [make("one", 3, tmp_path / x, TORQUE, STYLE) for x in "ab"]
    truth = json.loads((tmp_path / "a" / "truth" / "one_3.json").read_text())
    assert truth == json.loads((tmp_path / "b" / "truth" / "one_3.json").read_text())
    (effect,) = truth["effects"]
    assert effect["physics"] in effects.LINEAR
    assert effect["sigma"] >= 2.4
    runs = [read_recording(f / "run_01.mcap") for f in folders]
    np.testing.assert_array_equal(runs[0].values, runs[1].values)
    assert [c.name for c in runs[0].channels] == [
        "u", "theta_ref", "v_2", "theta_2", "M_2",
    ]  # fmt: skip
    assert runs[0].rig_toml == (folders[0] / "rig.toml").read_text()
    assert (
        parse(Rig, runs[0].rig_toml, "rig.toml").element
        == load_rig("samii_torque_vertical")[0].element
    )
    # The loop's law holds in what is recorded, to the rounding of the output.
    column = runs[0].column
    u, v, theta = (runs[0].values[:, column(x)] for x in ("u", "v_2", "theta_2"))
    assert np.abs(v - (u - 2.0 * theta)).max() <= 0.51 * 20.0 / 2**16


def test_the_truth_explains_the_record_and_the_rig_file_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    conceal, drawn = trial.conceal, []

    def kept(*order: Any) -> trial.Conceals:
        drawn.append(conceal(*order))
        return drawn[-1]

    monkeypatch.setattr(trial, "conceal", kept)
    # Samples: of a tenth of them the mean of squares is still known to 0.007.
    monkeypatch.setattr(styles, "BUDGET", 10_000)
    folder = make("one", 3, tmp_path, _samii(), STYLE)
    (made,) = drawn
    scene, (hidden,) = made.scene, made.found
    run = read_recording(folder / "run_01.mcap")
    y = run.values[:, -4:] - scene.noise.offset
    r = run.values[:, [run.column("v_2")]] + y @ scene.control.feedback.T
    n = len(y)
    setup = hidden.draft.put(scene.setup, hidden.strength)
    loop = trial._loop(setup, scene.control, scene.noise.pushes)
    answer = whitener(noise_model(loop, scene.noise, 500.0)).response(n)
    bench = _bench(setup, scene.control, r, answer)
    chi2 = [
        np.mean(bench.white(y - bench.linear(s)[0])[500:] ** 2)
        for s in (setup, setup_of(scene.rig, {}))
    ]
    assert chi2[0] == pytest.approx(1.0, abs=0.05)
    assert chi2[1] > 2.0


def test_two_effects_are_different_and_each_has_its_own_sigma(tmp_path: Path) -> None:
    make("two", 1, tmp_path, TORQUE, STYLE)
    one, other = json.loads((tmp_path / "truth" / "two_1.json").read_text())["effects"]
    assert (one["physics"], one["site"]) != (other["physics"], other["site"])
    for effect in (one, other):
        assert 0 < effect["sigma"] < 1.1 * effect["sigma_alone"]


def test_nothing_conceals_nothing(tmp_path: Path) -> None:
    make("nothing", 2, tmp_path, load_rig("samii_torque_vertical")[1], STYLE)
    truth = json.loads((tmp_path / "truth" / "nothing_2.json").read_text())
    assert truth["effects"] == []
    drawn = [p["offset_in_tolerances"] for p in truth["nominal"]]
    assert len(drawn) == len(nominal(load_rig("samii_torque_vertical")[0]).keys)
    assert 0 < np.abs(drawn).max() <= trial.FARTHEST


@pytest.mark.parametrize("excitation", styles.EXCITATIONS)
def test_every_excitation_keeps_within_its_budget_and_peak(excitation: str) -> None:
    about = styles.About(500.0)
    style = styles.draw(np.random.default_rng(8), ("clean", excitation), about)
    pieces = [p for f in style.files for p in f]
    assert style.excitation == excitation
    assert sum(len(p.r) for p in pieces) <= 1.3 * styles.BUDGET
    assert max(p.level for p in pieces) == 1.0
    assert max(float(np.abs(p.r).max()) for p in pieces) <= 1.0 + 1e-9


def test_wrong_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="kind is 'three'; expected one of"):
        make("three", 0, tmp_path, _samii())
    with pytest.raises(InputError, match="style is 'fast'; expected one of"):
        make("nothing", 0, tmp_path, _samii(), ("fast",))
    fixed = _samii().replace('tip = "free"', 'tip = "pinned"')
    with pytest.raises(InputError, match="tip is 'pinned'; expected 'free'"):
        make("nothing", 0, tmp_path, fixed, STYLE)
    code = command.main(["nothing", "0", "--out", str(tmp_path), "--style", "fast"])
    assert code == 2
    assert "fast" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def _with_law(law: str, values: dict[str, float]) -> tuple[Setup, Control, np.ndarray]:
    """The torque test's link on its joint with a law, driven hard enough to need it."""
    rig, _ = load_rig("samii_torque_vertical")
    setup = setup_of(rig, {})
    r = 4.0 * np.sin(2 * np.pi * 12.0 * np.arange(150)[:, None] / 500.0)
    control = Control(np.array([[2.0, 0.0]]), 500.0)
    return replace(setup, forces=(Force(law, "joint_2", values),)), control, r


@pytest.mark.parametrize(
    ("law", "values", "force"),
    [
        ("cubic_stiffness", {"k3": 3e9}, lambda z: -3e9 * z**3),
        (
            "backlash",
            {"k": 1.08e4, "width": 4e-4},
            lambda z: 1.08e4 * float(np.clip(z, -2e-4, 2e-4)),
        ),
    ],
)
def test_a_joint_s_law_agrees_with_brute_force(
    law: str, values: dict[str, float], force: Law
) -> None:
    setup, control, r = _with_law(law, values)
    expected = _brute(setup, control, r, force)
    found = clean(setup, control, r)
    without = clean(replace(setup, forces=()), control, r)
    shown = np.abs(without - expected).max(axis=0)
    assert np.all(np.abs(found - expected).max(axis=0) < 0.02 * shown)


def test_friction_sticks_and_takes_energy() -> None:
    setup, control, r = _with_law("coulomb_friction", {"T_c": 1e6})
    rigid = setup_of(load_rig("samii_torque_vertical")[0], {}).with_value("joint_2", "k", 1e12)
    # More friction than any moment: the joint is locked, as a spring without give is.
    stuck, locked = clean(setup, control, r), clean(rigid, control, r)
    np.testing.assert_allclose(stuck, locked, atol=2e-3 * np.abs(locked).max())


def test_friction_over_one_period_takes_four_times_its_moment_times_the_swing() -> None:
    # A free joint (no spring to speak of) that slides with T_c against a moving source loses
    # speed by T_c/J: here the link hangs on friction alone after the source has stopped.
    rig, _ = load_rig("samii_torque_horizontal")
    setup = setup_of(rig, {}).with_value("joint_2", "k", 1e-6).with_value("joint_2", "c", 1e-9)
    T_c, J = 0.05, 2.0 * 0.15**2 + 0.015
    setup = replace(setup, forces=(Force("coulomb_friction", "joint_2", {"T_c": T_c}),))
    r = np.zeros((400, 1))
    r[:50] = 4.0
    y = clean(setup, Control(np.zeros((1, 2)), 500.0), r)
    speed = np.diff(y[:, 0]) * 500.0
    # Sensor M_2 reads the moment that the link's inertia asks for: T_c while it slides.
    sliding = np.abs(np.abs(y[:, 1]) - T_c) < 0.02 * T_c
    assert sliding[20:40].all()
    slope = np.polyfit(np.arange(20, 40) / 500.0, speed[20:40], 1)[0]
    assert slope == pytest.approx(T_c / J, rel=0.02)


def test_bouc_wen_s_loop_ends_at_its_yield_force() -> None:
    p = np.array([3.0, 0.01, 0.6, 0.4, 1.5])
    x, h = 0.0, 1e-4
    for _ in range(20_000):
        x = kernel.bouc_wen(p, 0.2, x, h)
    assert kernel.smooth(kernel.BOUC_WEN, p, 0.0, 0.2, 0.0, x, h) == pytest.approx(-3.0, rel=1e-6)
    small = kernel.bouc_wen(p, 0.2, 0.0, 1e-5)
    assert small == pytest.approx(0.2 * 1e-5 / 0.01, rel=1e-3)  # z/z_y while small


def test_fractional_damper_is_a_power_of_s_over_its_band() -> None:
    alpha = 0.45
    k, t = outside.fraction(alpha)
    assert np.all(k >= 0)
    s = 2j * np.pi * np.geomspace(0.1, 200.0, 100)
    found = (k * s[:, None] * t / (1 + s[:, None] * t)).sum(axis=1)
    assert np.max(np.abs(found / s**alpha - 1)) < 0.03


@pytest.mark.parametrize("name", [*forces.FORCES, *outside.OUTSIDE, *varying.VARYING])
def test_every_force_finds_its_size(name: str) -> None:
    rngs = [np.random.default_rng([9, k]) for k in range(3)]
    rig, _ = load_rig("samii_torque_vertical")
    runs = name == varying.BETWEEN
    scene = trial.scene_of(rngs[0], rngs[1], rig, ("clean", "cut"), runs=runs)
    pools = {**forces.FORCES, **outside.OUTSIDE, **varying.VARYING}
    draft = pools[name](rngs[2], scene.setup, trial._swing(scene))
    found = trial._solved(scene, trial.nominal_refit(scene), draft, 30.0, size.SIZE_CLOSE)
    assert found is not None
    assert found.alone.sigma == pytest.approx(30.0, rel=0.3)


def test_what_is_outside_the_table_is_told_as_that(tmp_path: Path) -> None:
    make("outside", 0, tmp_path, TORQUE, STYLE)
    (effect,) = json.loads((tmp_path / "truth" / "outside_0.json").read_text())["effects"]
    assert effect["physics"] in outside.OUTSIDE


def test_what_is_late_by_little_has_rivals_and_by_much_has_none() -> None:
    rngs = [np.random.default_rng([4, k]) for k in range(3)]
    scene = trial.scene_of(rngs[0], rngs[1], load_rig("samii_torque_vertical")[0], ("clean", "cut"))
    refit = trial.nominal_refit(scene)
    draft = effects.lag(rngs[2], scene.setup)
    left = {}
    for target in (5.0, 100.0):
        found = trial._solved(scene, refit, draft, target, size.SIZE_CLOSE)
        assert found is not None
        rivals = trial._rivals(scene, refit, found)
        assert {r["physics"] for r in rivals} == {"valve_dynamics", "transport_delay"}
        left[target] = {r["physics"]: r["sigma"] for r in rivals}
        assert all(0 <= s < 1.01 * found.alone.sigma for s in left[target].values())
    assert left[5.0]["transport_delay"] < 1.0
    assert left[100.0]["transport_delay"] > 3.0


def test_masses_on_springs_are_a_rig_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(styles, "BUDGET", 20_000)  # samples: a fifth conceals two as well
    rig = parse(Rig, MASSES, "masses")
    f = np.geomspace(1.0, 60.0, 30)
    made = plant(setup_of(rig, {}))
    loop = closed(discrete(made, timeline(setup_of(rig, {}), made, 500.0)), np.zeros((1, 2)))
    expected = sampled_response(rig, f)[:, :, 0]
    assert np.max(np.abs(response(loop, f, 500.0) / expected - 1)) < 1e-4
    for seed in range(2):
        make("two", seed, tmp_path, MASSES, STYLE)
        truth = json.loads((tmp_path / "truth" / f"two_{seed}.json").read_text())
        assert len(truth["effects"]) == 2


def test_a_trial_is_not_made_twice(tmp_path: Path) -> None:
    make("nothing", 0, tmp_path, TORQUE, STYLE)
    with pytest.raises(InputError, match="there already"):
        make("nothing", 0, tmp_path, TORQUE, STYLE)


def test_no_dead_band_is_drawn_that_is_narrower_than_a_step_of_its_converter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Noise-free records know no rounding, and call one large that a rounded loop never shows."""
    rig, setup = _two_joints()
    step = rig.actuator[0].resolution
    swing = SimpleNamespace(command={a.name: 1.0 for a in rig.actuator})
    draft = forces.dead_zone(np.random.default_rng(0), setup, swing)
    left = SimpleNamespace(sigma=20.0)
    for strength, drawn in ((0.5 * step, False), (2.0 * step, True)):
        monkeypatch.setattr(trial, "solve", lambda *_, x=strength: (x, left))
        found = trial._solved(None, None, draft, 20.0, 1.1)
        assert (found is not None) == drawn
