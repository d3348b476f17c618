"""Stops with a gap, and dry friction of a body against the ground, in both plants: against an
integration that shares no code with either, closed forms, and the truths that they write."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from concealed_kit import SAMII_TOML, driven, loop
from scipy.integrate import solve_ivp

from samii_rig.prove.trial import Truth
from samii_rig.rig.load import load_rig
from samii_rig.types import Float
from sim.assumed_modes import forces, ground, trial
from sim.assumed_modes.parts import Force, setup_of
from sim.assumed_modes.simulate import Control, clean
from sim.concealed.draw import draw
from sim.concealed.effects import ROWS, places
from sim.concealed.integrate import run, tabulate
from sim.concealed.measure import ideally, loop_of, reach
from sim.concealed.modes import poles_of
from sim.concealed.parts import Description, Drive, Law, Part, SensorPath, described
from sim.concealed.runs import Design, runs
from sim.concealed.trial import make

M, C, K = 1.2, 6.0, 6000.0  # kg, N s/m, N/m: a mass that swings at 11 Hz
RATE = 1000.0  # samples/s
T = np.arange(600) / RATE  # s
PUSH = 12.0 * np.sin(2 * np.pi * 9.0 * T)  # N, held for a sample
GAP, HARD = 2.5e-3, 4 * K  # m, N/m: the mass alone swings by 6 mm
Sides = tuple[float, float]
Moves = Callable[[str, tuple[float, ...], Float, float], Float]


def both(values: tuple[float, ...]) -> dict[str, float]:
    return dict(zip(("k", "gap", "above", "below"), values, strict=True))


def concealed(kind: str, values: tuple[float, ...], push: Float, c: float) -> Float:
    """Samples of the mass's displacement, m, in the finite elements: an arm of a metre on a joint
    carries it, and a drive behind it turns nothing."""
    bob = [
        Part("torsional_spring", "joint", {"k": K, "c": c}),
        Part("rigid_link", "arm", {"L": 1.0, "r": 0.0, "m": 0.0, "I": 0.0}),
        Part("lumped_mass", "bob", {"m": M}),
        Part("angular_velocity_source", "motor", {}),
    ]
    angle = SensorPath("angle", "relative_angle", ("joint",), 0.0, None, [], 0.0)
    drive = Drive("motor", 1.0, 50.0, 0.0)
    plant = Description("clamped", RATE, bob, [angle], [drive], "bob")
    kind, _, place = kind.partition(" ")
    plant.laws = [Law(kind, place or "bob", values, ground=not place)]
    u, error = np.zeros((push.size, 1)), np.zeros((push.size, 1))
    _, y, _ = run(tabulate(poles_of(plant), plant), loop(1), u, u, push, error)
    return y[:, 0]


def assumed_modes(kind: str, values: tuple[float, ...], push: Float, c: float) -> Float:
    """The same in the assumed modes: the mass on its spring under a coil without a lag."""
    rig, _ = load_rig("one_mass")
    setup = setup_of(rig, {})
    for name, symbol, value in (("spring", "k", K), ("spring", "c", c), ("mass", "m", M),
                                ("coil", "K", 1.0), ("coil", "p", 0.0)):  # fmt: skip
        setup = setup.with_value(name, symbol, value)
    kind, _, place = kind.partition(" ")
    law, numbers = {"stop": ("end_stop", both), "coulomb": ("coulomb_friction", lambda v: {
        "T_c": v[0]})}[kind]  # fmt: skip
    on = "spring" if place else "mass"
    setup = replace(setup, forces=(Force(law, on, numbers(values), ground=not place),))
    return clean(setup, Control(np.zeros((1, 1)), RATE), push[:, None])[:, 0]


PLANTS = pytest.mark.parametrize("moves", [concealed, assumed_modes], ids=lambda x: x.__name__)


def integrated(sides: Sides) -> Float:
    """The mass by a general integrator, sample by sample."""

    def rate(_: float, x: Float, f: float) -> list[float]:
        beyond = sides[0] * max(x[0] - GAP, 0.0) + sides[1] * min(x[0] + GAP, 0.0)
        return [x[1], (f - C * x[1] - K * x[0] - HARD * beyond) / M]

    x, out = np.zeros(2), []
    for f in PUSH:
        out.append(x[0])
        span = (0.0, 1 / RATE)
        x = solve_ivp(rate, span, x, args=(f,), rtol=1e-9, atol=1e-12).y[:, -1]
    return np.array(out)


@PLANTS
@pytest.mark.parametrize("place", ["", " joint"], ids=["of the body", "of the joint"])
@pytest.mark.parametrize("sides", [(1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
def test_a_mass_against_a_stop_moves_as_a_general_integrator_says(
    moves: Moves, place: str, sides: Sides
) -> None:
    expected = integrated(sides)
    found = moves(f"stop{place}", (HARD, GAP, *sides), PUSH, C)
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()
    free = moves(f"stop{place}", (0.0, GAP, *sides), PUSH, C)
    assert np.abs(free - expected).max() > 0.3 * np.abs(expected).max()


@PLANTS
def test_a_stop_on_one_side_leaves_the_other_free(moves: Moves) -> None:
    hard = 300 * K
    above = moves("stop", (hard, GAP, 1.0, 0.0), PUSH, C)
    below = moves("stop", (hard, GAP, 0.0, 1.0), PUSH, C)
    assert above.max() < 1.15 * GAP
    assert above.min() < -1.5 * GAP
    # The mirrored stop under the mirrored push is the same bench, seen from behind.
    mirrored = moves("stop", (hard, GAP, 0.0, 1.0), -PUSH, C)
    np.testing.assert_allclose(mirrored, -above, atol=1e-9 * GAP)
    assert below.min() > -1.15 * GAP


@PLANTS
@pytest.mark.parametrize("place", ["", " joint"], ids=["of the body", "of the joint"])
def test_friction_takes_four_times_its_force_over_the_stiffness_in_each_cycle_and_then_holds(
    moves: Moves, place: str
) -> None:
    T_c = 2.0
    push = np.zeros(1500)
    push[:150] = 60.0  # pulled aside, and let go
    x = moves(f"coulomb{place}", (T_c,), push, 0.0)[150:]
    turns = np.flatnonzero(np.diff(np.sign(np.diff(x))) != 0) + 1
    swings = np.abs(x[turns])
    swings = swings[swings > 2 * T_c / K]
    assert swings.size >= 6
    lost = -np.diff(swings)  # in half a cycle
    np.testing.assert_allclose(lost, 2 * T_c / K, rtol=0.03)
    # It rests where the spring pulls by less than the friction holds, and does not creep.
    assert np.ptp(x[-200:]) < 1e-9 * GAP
    assert abs(x[-1]) <= T_c / K


def test_the_concealed_plant_s_friction_of_a_beam_s_end_holds_it() -> None:
    """More friction than any force there: the end is held sideways, as a hard spring holds it."""
    u = 0.3 * np.sin(2 * np.pi * 3.0 * np.arange(500) / 500.0)
    rubbed, braced = described(load_rig("samii")[0]), described(load_rig("samii")[0])
    rubbed.laws = [Law("coulomb", "beam", (1e6,), ground=True)]
    spring = {"k": 1e9, "c": 1e5}
    braced.insert(Part("translational_ground_spring", "beam", spring), after="beam")
    held, expected = driven(rubbed, u)[1], driven(braced, u)[1]
    assert np.abs(held - expected)[:, 0].max() < 1e-3 * np.abs(expected[:, 0]).max()


@pytest.mark.parametrize("site", ["joint_1", "beam"])
def test_halving_the_concealed_plant_s_step_changes_less_than_the_noise(site: str) -> None:
    rig, _ = load_rig("samii")
    plant, design = described(rig), Design()
    own = {"joint_1": 1.36e4, "beam": 5.6e3}[site]
    at_beam = site == "beam"
    gap = 0.4 * reach(rig, plant, design, site, ground=at_beam)
    plant.laws = [Law("stop", site, (30 * own, gap, 1.0, 1.0), at_beam)]
    one = runs(replace(design, bursts=1), rig, 0)[2]  # the largest level's burst
    whole = loop_of(rig, plant, ideal=True)
    coarse, fine = (ideally(one, tabulate(poles_of(plant), plant, n), whole) for n in (8, 16))
    assert coarse[2][0] > gap
    floor = [np.hypot(design.noise * s.noise_rms, s.resolution / 12**0.5) for s in rig.sensor]
    change = np.sqrt(np.mean((coarse[1] - fine[1]) ** 2, axis=0))
    assert np.all(change < floor), change / floor


def test_every_third_place_of_friction_and_stops_is_the_ground() -> None:
    plant = described(load_rig("samii")[0])
    for name in ("coulomb_friction", "end_stop"):
        (row,) = (r for r in ROWS if r.physics == name)
        found = places(plant, row)
        share = found.count("beam") / len(found)
        assert share == pytest.approx(1 / 3, abs=0.06)


QUICK = Design(levels=(0.5,), burst=10.0, ring_down=3.0, bursts=2, period=2.0, settle=1, periods=1,
               steps=1)  # fmt: skip


@pytest.mark.parametrize("name", ["end_stop", "coulomb_friction"])
def test_the_concealed_plant_s_truth_names_what_acts_against_the_ground(
    name: str, tmp_path: Path
) -> None:
    number = next(i for i, row in enumerate(ROWS) if row.physics == name)
    sites = places(described(load_rig("samii")[0]), ROWS[number])
    seed = number + len(ROWS) * sites.index("beam")
    folder = make("one", seed, tmp_path, SAMII_TOML, QUICK)
    record = json.loads((tmp_path / "truth" / f"{folder.name}.json").read_text())
    (effect,) = Truth.of(record).effects
    assert effect.name == (name, "beam")
    assert set(effect.parameters) == ({"T_c"} if name == "coulomb_friction" else {"gap", "k"})
    assert all(x > 0 for x in effect.parameters.values())
    wheres = ("ground",) if name == "coulomb_friction" else ("both", "above", "below")
    assert record["effects"][0]["where"] in wheres
    assert record["size"] > 0


def test_the_concealed_plant_draws_gaps_that_are_met() -> None:
    n = len(ROWS)
    (number,) = (i for i, row in enumerate(ROWS) if row.gap)
    sites = places(described(load_rig("samii")[0]), ROWS[number])
    for turn, site in enumerate(sites[:3]):
        drawn = draw("one", number + n * turn, SAMII_TOML, QUICK)
        (effect,), (law,) = drawn.effects, drawn.plant.laws
        assert (effect.site, law.ground) == (site, site == "beam")
        most = reach(drawn.nominal, drawn.plant, QUICK, site, ground=law.ground)
        # As drawn it was 0.2 to 0.9 of a reach without the stop; with it the place moves less.
        assert effect.parameters["gap"] < most * 1.01
        assert effect.parameters["gap"] > 0.1 * most


STYLE = ("clean", "single")


@pytest.mark.parametrize("name", ["end_stop", "coulomb_friction"])
def test_the_assumed_modes_truth_names_what_acts_against_the_ground(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial, "FORCES", {name: forces.FORCES[name]})
    monkeypatch.setattr(forces, "GROUND", 1.0)
    text, found = load_rig("two_masses")[1], set()
    for seed in range(4):
        trial.make("force", seed, tmp_path, text, STYLE)
        (effect,) = json.loads((tmp_path / "truth" / f"force_{seed}.json").read_text())["effects"]
        assert effect["physics"] == name
        assert all(p["value"] > 0 for p in effect["parameters"].values())
        names = {(n["physics"], n["site"]) for n in effect["also"]}
        if effect["site"] == "mass_1":
            assert (name, "spring_1") in names
        found.add(effect["site"])
    body = found & {"mass_1", "mass_2"}
    assert body
    if name == "coulomb_friction":
        assert found == body


def test_places_that_are_the_same_against_the_ground_have_each_other_s_names() -> None:
    masses, strip = (setup_of(load_rig(n)[0], {}) for n in ("two_masses", "beam_on_shaker"))
    assert ground.bodies(masses) == ["mass_1", "mass_2"]
    assert ground.bodies(strip) == ["strip", "tip_mass"]
    assert ("x", "spring_1") in ground.same_as_body("x", masses, "mass_1")
    assert ground.same_as_body("x", masses, "mass_2") == ()
    assert ground.same_as_joint("x", masses, "spring_1") == (("x", "mass_1"),)
    assert ground.same_as_joint("x", masses, "spring_2") == ()
    assert ground.same_as_body("x", strip, "strip") == (("x", "tip_mass"),)
    # In series: mass_2 rests on both springs.
    springs = [masses.part(n).values["k"] for n in ("spring_1", "spring_2")]
    assert ground.held(masses, "mass_2") == pytest.approx(1 / sum(1 / k for k in springs))
    assert ground.bodies(setup_of(load_rig("flexible_joint")[0], {})) == []


def test_a_third_of_friction_is_against_the_ground_and_half_of_the_stops_on_both_sides() -> None:
    setup = setup_of(load_rig("two_masses")[0], {})
    names = ("spring_1", "spring_2", "mass_1", "mass_2")
    swing = forces.Swing(
        dict.fromkeys(names[:2], 1e-3), {}, {}, dict.fromkeys(names[2:], 1e-3)
    )  # fmt: skip
    rng = np.random.default_rng(0)
    rubs = [forces.friction(rng, setup, swing) for _ in range(600)]
    assert np.mean([d.where == "ground" for d in rubs]) == pytest.approx(1 / 3, abs=0.06)
    stops = [forces.stop(rng, setup, swing) for _ in range(600)]
    for where, share in (("both", 0.5), ("above", 0.25), ("below", 0.25)):
        assert np.mean([d.where == where for d in stops]) == pytest.approx(share, abs=0.06)
    assert {d.site for d in stops} == set(names)
    gaps = np.array([d.values(1.0)["gap"] for d in stops]) / 1e-3
    assert gaps.min() >= 0.2
    assert gaps.max() <= 0.9
