"""A force in the loop: its step, its slopes and the rig it moves, against other computations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from concealed_kit import SAMII, driven
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from samii_rig.diagnose.forces import laws
from samii_rig.diagnose.forces.laws import Force, Law
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.steps import OUT, advanced, slid
from samii_rig.diagnose.forces.way import INNER, Way
from samii_rig.diagnose.physics.effect import Effect, Unknown
from samii_rig.errors import InputError
from samii_rig.likelihood.contour import EXACT, Contour
from samii_rig.model.sampled import hold_at, sensors_at
from samii_rig.model.tmm import Chain
from samii_rig.types import Float
from sim.concealed.parts import Law as PlantLaw
from sim.concealed.parts import described

JOINT_1, JOINT_2 = Place("joint", ("joint_1",)), Place("joint", ("joint_2",))
FLOW = Place("flow", ("joint_2_source",))
DRIVE = Place("drive", ("joint_2_source",))
COMMAND = Place("command", ("joint_2_source",))
K_1 = ("joint_1", "k")
# Each law at a place of SAMII, at strengths that move the rig by some percent.
CASES: dict[str, tuple[Force, tuple[float, ...]]] = {
    "friction": (Force(JOINT_2, laws.FRICTION), (0.5,)),
    "friction in the drive": (Force(DRIVE, laws.FRICTION), (0.05,)),
    "uneven": (Force(JOINT_2, laws.UNEVEN), (0.3, 0.6)),
    "hardening": (Force(JOINT_1, laws.HARDENING), (1e8,)),
    "softening": (Force(JOINT_1, laws.SOFTENING), (2e7,)),
    "quadratic": (Force(JOINT_1, laws.QUADRATIC), (2e4,)),
    "play": (Force(JOINT_1, laws.PLAY, "joint_1"), (1e-4,)),
    "slack": (Force(JOINT_1, laws.SLACK, "joint_1"), (1e-4,)),
    "hysteresis": (Force(JOINT_1, laws.HYSTERESIS), (1.0, 3e3)),
    "orifice": (Force(FLOW, laws.ORIFICE), (500.0,)),
}
PLANT = {
    "friction": PlantLaw("coulomb", "joint_2", (0.5,)),
    "hardening": PlantLaw("cubic", "joint_1", (1e8,)),
    "quadratic": PlantLaw("drag", "joint_1", (2e4,)),
    "play": PlantLaw("backlash", "joint_1", (1e-4, 1.36e4)),
    "orifice": PlantLaw("flow_saturation", "joint_2_source", (500.0,)),
}


def chirp(n: int = 3000) -> Float:
    t = np.arange(n) / SAMII.rate_hz
    return 0.5 * np.sin(2 * np.pi * (0.5 * t + 1.5 * t**2))


def model_of(force: Force, strengths: tuple[float, ...]) -> tuple[ForceModel, Float]:
    unknowns = tuple(Unknown(f"p{i}", "1", p / 10, 10 * p, (p,)) for i, p in enumerate(strengths))
    model = ForceModel(SAMII, (Effect("force", "here", unknowns, force=force),))
    return model, np.append(np.zeros(model.n - len(strengths)), np.log(strengths))


def added(name: str, v: Float) -> Float:
    """(n, q) what a force adds to the sensors, no loop closed."""
    model, x = model_of(*CASES[name])
    way = Way.of(model, x)
    return way.sensed.of(way.force(model, v, model.numbers(x), model.seeds(x, ()))[0])


def rms(x: Float) -> Float:
    return np.sqrt(np.mean(x**2, axis=0))


@pytest.mark.parametrize("name", PLANT)
def test_what_a_force_adds_from_rest_is_what_another_integrator_says(name: str) -> None:
    """From rest to a cut end, no loop closed, sensor by sensor."""
    v, plant = chirp(), described(SAMII)
    plain = driven(plant, v)[1]
    plant.laws = [PLANT[name]]
    want = driven(plant, v, inner=16)[1] - plain
    off, size = rms(added(name, v) - want), rms(want)
    assert np.all(size > 0)
    assert np.all(off < 0.03 * size), off / size


def test_hysteresis_that_never_slips_is_a_spring_beside_the_joints_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Against transfer matrices of the stiffer joint, by the contour."""
    k, v = 2e3, chirp()
    monkeypatch.setitem(CASES, "hysteresis", (Force(JOINT_1, laws.HYSTERESIS), (1e9, k)))
    got = added("hysteresis", v)
    contour = Contour.over(v.size, SAMII.rate_hz, EXACT)
    s = contour.s
    around = (
        sensors_at(SAMII.sensor, s) * hold_at(s, SAMII.rate_hz, SAMII.actuator[0].delay)[:, None]
    )
    chain = Chain(SAMII)
    own = chain.values()[chain.parameters.index(K_1)]
    change = chain.with_values({K_1: own + k}).evaluate(s) - chain.evaluate(s)
    want = contour.record(change[:, :, 0] * around * contour.damped(v)[:, None], v.size)
    assert np.all(rms(got - want) < 0.02 * rms(want)), rms(got - want) / rms(want)


def test_hysteresis_that_slips_at_once_is_dry_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    v = chirp()
    dry = added("friction", v)
    monkeypatch.setitem(CASES, "hysteresis", (Force(JOINT_2, laws.HYSTERESIS), (0.5, 1e6)))
    slips = added("hysteresis", v)
    # Accelerometers see the stiff part ring at every stop; the angle does not.
    assert rms(slips - dry)[0] < 0.03 * rms(dry)[0]


def test_friction_that_is_alike_both_ways_is_one_law(monkeypatch: pytest.MonkeyPatch) -> None:
    v = chirp(800)
    monkeypatch.setitem(CASES, "uneven", (Force(JOINT_2, laws.UNEVEN), (0.5, 0.5)))
    np.testing.assert_array_equal(added("uneven", v), added("friction", v))


def test_uneven_friction_holds_back_as_much_as_each_way_says() -> None:
    model, x = model_of(*CASES["uneven"])
    e = Way.of(model, x).force(model, chirp(), model.numbers(x), model.seeds(x, ()))[0]
    assert np.min(e) == pytest.approx(-0.3)
    assert np.max(e) == pytest.approx(0.6)


def follows(
    after: Callable[..., tuple[float, ...]],
    grows: Callable[[float, Float], Float],
    top: float,
    k: float,
    phase: float,
) -> None:
    """Steps of a law are h' = k x' grows(x', h), x of two sines."""
    t = np.linspace(0, 6, 4001)
    x = np.sin(t) + 0.5 * np.sin(2.7 * t + phase)

    def rate(now: float, h: Float) -> Float:
        speed = math.cos(now) + 1.35 * math.cos(2.7 * now + phase)
        return k * speed * grows(speed, h)

    want = solve_ivp(rate, (0, 6), [0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=2e-3).y[0]
    h, got = 0.0, [0.0]
    for dx in np.diff(x):
        h = after(h, dx, top, k)[0]
        got.append(h)
    assert np.max(np.abs(got - want)) < 2e-3 * top


@given(top=st.floats(0.1, 3.0), k=st.floats(0.5, 20.0), phase=st.floats(0.0, 6.0))
@settings(max_examples=10, deadline=None)
def test_a_step_of_bouc_wen_is_its_differential_equation(top: float, k: float, phase: float):
    """h' = k x' (1 - (sign(x' h) + 1)/2 |h|/top)."""

    def grows(speed: float, h: Float) -> Float:
        return 1 - 0.5 * (np.sign(speed * h) + 1) * np.abs(h) / top

    follows(advanced, grows, top, k, phase)


@given(top=st.floats(0.1, 3.0), k=st.floats(0.5, 20.0), phase=st.floats(0.0, 6.0))
@settings(max_examples=5, deadline=None)
def test_a_step_of_dahl_is_his_differential_equation(top: float, k: float, phase: float) -> None:
    """h' = k x' (1 - sign(x') h/top)."""
    follows(slid, lambda speed, h: 1 - np.sign(speed) * h / top, top, k, phase)


@pytest.mark.parametrize("law", [laws.HYSTERESIS, laws.PRESLIDING], ids=lambda law: law.tag)
@given(way=st.floats(-10.0, 10.0), memory=st.floats(-1.0, 1.0), stiff=st.floats(0.1, 300.0))
@settings(max_examples=50, deadline=None)
def test_however_stiff_before_it_slips_a_step_ends_at_its_root(
    law: Law, way: float, memory: float, stiff: float
) -> None:
    """Newton alone goes to and fro across the bend from 5 times the compliance on."""
    out = np.zeros(OUT)
    assert law.step is not None
    law.step(0.0, way, 0.0, stiff, np.array([1.0, 1.0, 0.0]), memory, out)
    dx = way + stiff * out[0]
    of = advanced if law is laws.HYSTERESIS else slid
    assert of(memory, dx, 1.0, 1.0)[0] == pytest.approx(out[3], abs=1e-7)
    assert out[0] == pytest.approx(-0.5 * (memory + out[3]), abs=1e-12)


STEPS = {law.tag: law for law in laws.LAWS if law.step is not None}


@pytest.mark.parametrize("tag", STEPS)
@given(
    before=st.floats(-1.0, 1.0),
    free=st.floats(-1.0, 1.0),
    memory=st.floats(-0.5, 0.5),
    p=st.tuples(st.floats(0.6, 2.0), st.floats(0.6, 2.0)),
)
@settings(max_examples=15, deadline=None)
def test_the_slopes_of_a_step_are_its_differences(
    tag: str, before: float, free: float, memory: float, p: tuple[float, float]
) -> None:
    law, g, u = STEPS[tag], 0.05, 0.7
    # Its damper takes a twentieth of the way in a step, its spring less.
    numbers = np.array([p[0], p[1] if law.fixed[1] == 0 else law.fixed[1], 1.0])

    def stepped(change: Float) -> Float:
        out = np.zeros(OUT)
        assert law.step is not None
        own = np.array([before, free, memory]) + change[:3]
        law.step(own[0], own[1], u, g, numbers + change[3:], own[2], out)
        return out

    found = stepped(np.zeros(6))
    slopes = ((1, 5), (2, 6), (4, 7), (8, 9), (10, 11), (12, 13))
    for j, (by_f, by_m) in enumerate(slopes):
        h = np.zeros(6)
        h[j] = 1e-6
        right, left = stepped(h) - found, found - stepped(-h)
        if np.max(np.abs(right - left)[[0, 3]]) > 1e-9:
            continue  # a corner of the law
        slope = (right + left) / 2e-6
        assert slope[0] == pytest.approx(found[by_f], rel=1e-3, abs=1e-5)
        assert slope[3] == pytest.approx(found[by_m], rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("name", CASES)
def test_slopes_led_along_with_the_motion_are_differences_of_whole_runs(name: str) -> None:
    model, x = model_of(*CASES[name])
    way, v = Way.of(model, x), chirp(1500)
    slopes = way.force(model, v, model.numbers(x), model.seeds(x, model.moving))[1:]
    assert len(model.moving) == len(CASES[name][1]) + len(model.force.keys)

    def shown(y: Float) -> Float:
        return way.sensed.of(way.force(model, v, model.numbers(y), model.seeds(y, ()))[0])

    for j, slope in zip(model.moving, slopes, strict=True):
        step = np.zeros(model.n)
        step[j] = 1e-4
        want = (shown(x + step) - shown(x - step)) / 2e-4
        off = rms(way.sensed.of(slope) - want)
        assert np.all(off < 0.02 * rms(want)), (j, off / rms(want))


@pytest.mark.parametrize(
    ("before", "free", "held"),
    [
        (0.1, 0.2, "nothing acts"),
        (0.7, 0.9, "closed"),
        (0.45, 0.495, "at the edge"),  # with the damper it stays inside, without it goes out
    ],
)
def test_a_gap_in_which_nothing_acts(before: float, free: float, held: str) -> None:
    """A spring of 2 and a damper of 3 a step, gone within 0.5 to either side; g is 0.05."""
    g, p, out = 0.05, np.array([1.0, 2.0, 3.0]), np.zeros(OUT)
    laws.SLACK.step(before, free, 0.0, g, p, 0.0, out)
    x, way = 0.5 * (before + free + g * out[0]), free + g * out[0] - before
    if held == "nothing acts":
        assert out[0] == pytest.approx(p[1] * x + p[2] * way)
    elif held == "closed":
        assert out[0] == pytest.approx(0.5 * p[0] * p[1])
    else:
        assert x == pytest.approx(0.5 * p[0])
        assert 0.5 * p[0] * p[1] < out[0] < p[1] * x + p[2] * way
    for j, at in enumerate((8, 10, 12)):
        step = np.zeros(3)
        step[j] = 1e-7
        ends = []
        for change in (step, -step):
            other = np.zeros(OUT)
            laws.SLACK.step(before, free, 0.0, g, p + change, 0.0, other)
            ends.append(other[0])
        assert out[at] == pytest.approx((ends[0] - ends[1]) / 2e-7, abs=1e-5)


def test_half_the_step_leaves_a_quarter_of_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = []
    for inner in (INNER, 2 * INNER, 8 * INNER):
        monkeypatch.setattr("samii_rig.diagnose.forces.way.INNER", inner)
        ends.append(added("hardening", chirp(1500)))
    coarse, fine = (rms(e - ends[2]) for e in ends[:2])
    assert np.all(fine < 0.3 * coarse)


@pytest.mark.parametrize("law", [laws.OVERLAP, laws.CLIPPED])
def test_slopes_of_what_the_command_drives_are_its_differences(law: Law) -> None:
    v, p = np.linspace(-1.5, 1.5, 300), np.array([0.8, 0.0])
    assert law.of_command is not None
    d = np.array([1e-6, 0.0])
    want = (law.of_command(v, p + d)[0] - law.of_command(v, p - d)[0]) / 2e-6
    np.testing.assert_allclose(law.of_command(v, p)[1][:, 0], want, atol=1e-6)


def test_a_law_that_is_not_known_is_an_error_and_never_another() -> None:
    with pytest.raises(ValueError, match="driven by a motion or by the command"):
        replace(laws.PLAY, tag="new", step=None)
    with pytest.raises(ValueError, match="does not act on a flow"):
        Force(FLOW, laws.FRICTION)
    with pytest.raises(ValueError, match="parameter of the rig"):
        Force(JOINT_1, laws.PLAY)
    model, x = model_of(*CASES["friction"])
    way = Way.of(model, x)
    told, y = model_of(Force(COMMAND, laws.CLIPPED), (0.5,))
    with pytest.raises(InputError, match="a law that a motion drives"):
        way.force(told, chirp(100), told.numbers(y), told.seeds(y, ()))


def test_one_model_has_one_force() -> None:
    effects = tuple(
        Effect("force", "here", (Unknown("p", "1", 0.1, 10.0, (1.0,)),), force=force, variant=name)
        for name, (force, p) in CASES.items()
        if len(p) == 1
    )
    with pytest.raises(InputError, match="one force at a time"):
        ForceModel(SAMII, effects[:2])
