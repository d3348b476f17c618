"""The concealed plant, nothing hidden: closed forms, energy, the model it must not know.

1. Finite elements: cantilever, pendulum, energy.
2. Poles and sampling: the transfer matrix model's response, from the samples of a closed loop.
3. Time: delays of any size, no trace of the inner step where nothing is nonlinear.
"""

from __future__ import annotations

import ast
import copy
from pathlib import Path

import numpy as np
import pytest
from concealed_kit import FREQUENCY, SAMII, SAMII_TOML, continuous, driven, modelled, settled
from scipy.linalg import eigh

import sim.concealed
from samii_rig.errors import InputError
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import parameters
from sim.assumed_modes.parts import setup_of
from sim.assumed_modes.plant import plant as assumed_modes
from sim.assumed_modes.sampled import discrete, timeline
from sim.concealed.assemble import PHASE, assemble
from sim.concealed.draw import draw_values
from sim.concealed.modes import poles_of
from sim.concealed.parts import Description, Drive, Part, described
from sim.concealed.size import STEP, changed, tangent

TOLERATED = [
    (e.name, symbol) for e in SAMII.element for symbol, p in parameters(e).items() if p.tolerance
]


def structure(*parts: Part, base: str = "clamped") -> Description:
    source = Part("angular_velocity_source", "motor", {})
    drive = Drive("motor", 1.0, 100.0, 0.0)
    return Description(base, 500.0, [*parts, source], [], [drive], parts[-1].name)


def frequencies(plant: Description) -> np.ndarray:
    s = assemble(plant)
    free = np.delete(np.arange(s.M.shape[0]), list(s.driven.values()))
    block = np.ix_(free, free)
    return np.sqrt(np.abs(eigh(s.K[block], s.M[block], eigvals_only=True)))


def test_cantilever_has_the_frequencies_of_its_closed_form() -> None:
    EI, mu, L = 5.0, 0.62, 0.5
    plant = structure(Part("beam", "beam", {"EI": EI, "mu": mu, "L": L}))
    closed = np.array([1.875104068711961, 4.694091132974175, 7.854757438237613]) ** 2
    assert frequencies(plant)[:3] == pytest.approx(closed * np.sqrt(EI / mu) / L**2, rel=2e-5)


def test_pendulum_swings_with_the_root_of_its_gravity_stiffness_over_its_inertia() -> None:
    m, r, I, g = 2.0, 0.3, 0.05, 9.81  # noqa: E741
    link = Part("rigid_link", "link", {"L": 0.5, "r": r, "m": m, "I": I})
    gravity = Part("gravity_stiffness", "link", {"k": m * g * r})
    plant = structure(link, gravity, base="pinned")
    assert frequencies(plant) == pytest.approx([np.sqrt(m * g * r / (I + m * r**2))])


def test_mass_of_the_beam_is_its_weight() -> None:
    plant = structure(Part("beam", "beam", {"EI": 5.0, "mu": 0.62, "L": 0.5}), base="free")
    s = assemble(plant)
    shift = np.zeros(s.M.shape[0])
    shift[0] = 1.0  # the base's displacement; every node's own is absolute
    shift[2 : s.driven["motor"] : 2] = 1.0
    assert shift @ s.M @ shift == pytest.approx(0.62 * 0.5)
    assert s.K @ shift == pytest.approx(0.0, abs=1e-6)


def test_without_damping_no_pole_loses_energy() -> None:
    plant = described(SAMII)
    for part in plant.parts:
        part.values.update({k: 0.0 for k in ("c", "tau") if k in part.values})
    plant.sensors.clear()
    pole = np.linalg.eigvals(_dynamics(plant))
    slow = np.abs(pole) < 2 * np.pi * 250
    moving = slow & (np.abs(pole.imag) > 1.0)
    assert np.count_nonzero(moving) >= 10
    assert np.abs(pole.real[moving] / pole.imag[moving]).max() < 1e-7


def _dynamics(plant: Description) -> np.ndarray:
    s = assemble(plant)
    free = np.delete(np.arange(s.M.shape[0]), list(s.driven.values()))
    block = np.ix_(free, free)
    n = free.size
    pull = np.linalg.solve(s.M[block], np.hstack([s.K[block], s.C[block]]))
    return np.block([[np.zeros((n, n)), np.eye(n)], [-pull]])


@pytest.mark.parametrize("name", ["samii", "sflr"])
def test_nothing_hidden_it_answers_as_the_transfer_matrices_do(name: str) -> None:
    rig, _ = load_rig(name)
    H = poles_of(described(rig)).sampled(FREQUENCY)
    assert np.abs(H / sampled_response(rig, FREQUENCY)[:, :, 0] - 1).max() < 2e-4


def test_slope_of_the_response_holds_where_a_step_of_it_would_divide_the_beam_anew() -> None:
    plant = described(SAMII)
    beam = plant.part("beam").values
    phase = (beam["mu"] * (np.pi * plant.rate_hz) ** 2 / beam["EI"]) ** 0.25 * beam["L"]
    beam["mu"] *= (24 * PHASE / phase) ** 4 * (1 - STEP / 2)
    up, down = (_with_mu(plant, beam["mu"] * (1 + step)) for step in (STEP, -STEP))
    at, above = (len(assemble(p).inside["beam"]) for p in (plant, up))
    assert (at, above) == (24, 25)
    _, slopes = tangent(plant, SAMII, FREQUENCY)
    slope = slopes[TOLERATED.index(("beam", "mu"))]
    H, less = (poles_of(p).sampled(FREQUENCY) for p in (plant, down))
    wrong = np.abs((H - less) / STEP - slope).max(axis=0)
    assert (wrong < 0.01 * np.abs(slope).max(axis=0)).all()


@pytest.mark.parametrize(("name", "seed"), [("samii", 1), ("samii_braced", 2)])
def test_slope_by_every_parameter_is_the_difference_of_the_responses(name: str, seed: int) -> None:
    rig, _ = load_rig(name)
    plant, _ = draw_values(rig, np.random.default_rng(seed))
    H = np.abs(poles_of(plant).sampled(FREQUENCY)).max(axis=0)
    keys = [(e.name, s) for e in rig.element for s, p in parameters(e).items() if p.tolerance]
    step = 1e-4
    assert ("beam", "L") in keys
    for (element, symbol), slope in zip(keys, tangent(plant, rig, FREQUENCY)[1], strict=True):
        near = [changed(plant, element, symbol, 1 + by) for by in (step, -step)]
        up, down = (poles_of(other).sampled(FREQUENCY) for other in near)
        wrong = np.abs((up - down) / (2 * step) - slope).max(axis=0)
        # By a parameter that hardly acts, the difference shows the rounding of the poles.
        allowed = 0.02 * np.abs(slope).max(axis=0) + 1e-3 * H
        assert (wrong < allowed).all(), (element, symbol, wrong / allowed)


def _with_mu(plant: Description, mu: float) -> Description:
    other = copy.deepcopy(plant)
    other.part("beam").values["mu"] = mu
    return other


def test_recorded_samples_of_the_closed_loop_show_the_model_of_the_sampled_rig() -> None:
    rng = np.random.default_rng(1)
    period = rng.standard_normal(2000)
    f, H = settled(described(SAMII), period, 30, kp=4.0)
    band = (f > 0.4) & (f < 50.0)
    model = sampled_response(SAMII, f[band])[:, :, 0]
    assert np.abs(H[band] / model - 1).max() < 1e-4


def test_delays_of_any_size_are_exact() -> None:
    plant = described(SAMII)
    plant.drives[0].delay = 0.0029
    plant.sensor("theta_2").delay = 0.0007
    plant.sensor("a_1").delay = 0.0052
    period = np.random.default_rng(2).standard_normal(1000)
    f, H = settled(plant, period, 60, kp=4.0)
    band = (f > 0.4) & (f < 50.0)
    assert np.abs(H[band] / poles_of(plant).sampled(f[band]) - 1).max() < 1e-6


def test_two_driven_joints_answer_as_the_transfer_matrices_and_the_second_plant_say() -> None:
    rig, _ = load_rig("samii_two_joints")
    found = poles_of(described(rig)).response(FREQUENCY).reshape(FREQUENCY.size, 5, 2)
    assert np.abs(found / sampled_response(rig, FREQUENCY) - 1).max() < 1e-5
    # The second plant by its own matrices, loops open.
    setup = setup_of(rig, {})
    made = assumed_modes(setup)
    system = discrete(made, timeline(setup, made, rig.rate_hz))
    z = np.exp(2j * np.pi * FREQUENCY / rig.rate_hz)[:, None, None]
    other = system.C @ np.linalg.solve(z * np.eye(len(system.A)) - system.A, system.b)
    assert np.abs(found / other - 1).max() < 1e-5


def test_two_loops_close_together_with_delays_of_any_size() -> None:
    rig, _ = load_rig("samii_two_joints")
    plant = described(rig)
    for part in plant.parts:  # more damping than SAMII has: settled sooner
        part.values.update({k: 5 * part.values[k] for k in ("c", "tau") if k in part.values})
    plant.drives[0].delay, plant.drives[1].delay = 0.0029, 0.0007
    n, periods, kp = 1000, 60, 3.0
    V, Y = [], []
    for k in range(2):
        u = np.zeros((n, 2))
        u[:, k] = np.random.default_rng(k).standard_normal(n)
        v, y, _ = driven(plant, np.tile(u, (periods, 1)), kp)
        V.append(np.fft.rfft(v[-n:], axis=0))
        Y.append(np.fft.rfft(y[-n:], axis=0))
    f = np.arange(n // 2 + 1) * plant.rate_hz / n
    band = (f > 0.4) & (f < 50.0)
    H = np.stack(Y, axis=2)[band] @ np.linalg.inv(np.stack(V, axis=2)[band])
    expected = poles_of(plant).response(f[band]).reshape(-1, 5, 2)
    assert np.abs(H / expected - 1).max() < 1e-6


def test_disturbing_force_on_the_tip_moves_it_as_newton_says() -> None:
    plant = described(SAMII)
    poles = poles_of(plant)
    static = poles.continuous(np.array([2j * np.pi * 400.0]))[0]
    # Far above the modes of the last body the tip moves as a free body: 1/m + arm^2/I.
    last = plant.parts[-1].values
    arm = last["L"] - last["r"]
    free = 1 / last["m"] + arm**2 / last["I"]
    tip = plant.sensor("a_2")
    assert tip.butterworth is not None
    lag = np.abs(1 / np.sqrt(1 + (400.0 / tip.butterworth[1]) ** 8))
    assert np.abs(static[3, 1]) / lag == pytest.approx(free, rel=0.1)


def test_continuous_response_is_the_transfer_matrices() -> None:
    G = continuous(described(SAMII), FREQUENCY)
    assert np.abs(G / modelled(SAMII_TOML, FREQUENCY) - 1).max() < 1e-4


def test_it_shares_no_code_with_the_model_or_the_diagnosis() -> None:
    forbidden = ("samii_rig.model", "samii_rig.fem", "samii_rig.diagnose", "sim.kernel", "sim.rig")
    files = list(Path(sim.concealed.__path__[0]).glob("*.py"))
    assert len(files) > 10
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not [n for n in names if n.startswith(forbidden)], file


def test_a_chain_it_cannot_be_is_refused() -> None:
    held = SAMII_TOML.replace('tip = "free"', 'tip = "clamped"')
    with pytest.raises(InputError, match="'free'"):
        described(parse(Rig, held, "test"))


def test_the_loop_centres_and_the_output_is_clipped() -> None:
    plant = described(SAMII)
    v, y, _ = driven(plant, np.full(2000, 0.1), kp=4.0)
    assert y[-1, 0] == pytest.approx(0.1 / 4.0, rel=0.02)
    assert v[-1, 0] == pytest.approx(0.0, abs=5e-3)
