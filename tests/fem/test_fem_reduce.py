"""The component-mode reduction (paper 1, eq. 13, 14): what it keeps exactly."""

import time

import numpy as np
import pytest
from fem_kit import SOURCE, chain, samii
from scipy.signal import cont2discrete

from samii_rig.errors import InputError
from samii_rig.fem.model import Fem
from samii_rig.fem.reduce import reduce
from samii_rig.model.realise import realise

SPRINGS = {"clamp", "joint_1", "joint_2", "joint_3"}
SMALL = (2e-4, 0.05)  # Rayleigh damping, s and 1/s: 0.2 % to 1.5 % of critical below 25 Hz


def test_the_papers_model_has_two_rigid_and_four_flexible_modes() -> None:
    fem = Fem(samii(), rigid=SPRINGS, rayleigh=SMALL)
    reduced = reduce(fem, torque=["joint_3"])
    assert reduced.coordinates == ("joint_2_source", "joint_3")
    assert reduced.M.shape == (6, 6)
    stiffness = np.diag([0.0, 0.0, *(fem.modes(4).omega ** 2)])  # eq. 14
    assert np.allclose(reduced.K, stiffness, rtol=1e-9, atol=1e-9)
    alpha, beta = SMALL
    damping = alpha * reduced.K + beta * reduced.M
    assert np.allclose(reduced.C, damping, rtol=1e-9, atol=1e-9)
    # Turning joint 2 by 1 rad moves all behind it as one body: its inertia about the joint.
    parts = {e.name: e for e in samii().element}
    inertia, x = 0.0, 0.0
    for name in ("link_2", "link_3_6"):
        link = parts[name]
        inertia += link.I.value + link.m.value * (x + link.r.value) ** 2
        x += link.L.value
    assert reduced.M[0, 0] == pytest.approx(inertia, rel=1e-9)


def test_all_modes_give_the_full_model() -> None:
    moment = {"name": "m", "kind": "moment", "after": "beam", "unit": "N m"}
    last = {"name": "end", "kind": "moment", "after": "link", "unit": "N m"}
    rig = chain(
        ("clamp", "torsional_spring", {"k": 30.0, "c": 0.02}),
        ("beam", "beam", {"EI": 3.0, "mu": 0.2, "L": 0.7, "tau": 1e-4}),
        SOURCE,
        ("link", "rigid_link", {"L": 0.3, "r": 0.1, "m": 0.4, "I": 2e-3}),
        tip="pinned",
        sensors=[
            {"name": "y", "kind": "absolute_angle", "after": "link", "unit": "rad"},
            {"name": "a", "kind": "acceleration", "on": "beam", "position": 0.5, "unit": "m/s^2"},
            moment,
            last,
            {**moment, "name": "at_source", "after": "source"},
        ],
    )
    f = np.geomspace(0.1, 200, 30)
    fem = Fem(rig)
    every = reduce(fem, flexible=fem.basis().modes.omega.size)
    assert every.response(f) == pytest.approx(fem.response(f), rel=1e-6, abs=1e-12)


def test_a_reduction_takes_less_than_50_ms_with_its_model_built() -> None:
    times = []
    for _ in range(5):
        start = time.process_time()
        reduce(Fem(samii()))
        times.append(time.process_time() - start)
    assert np.median(times) < 0.05


def test_a_few_modes_are_enough_below_their_frequencies() -> None:
    fem = Fem(samii())
    f = np.linspace(0.5, 20, 200)
    H = fem.response(f)
    peak = abs(H).max(axis=0)
    off = [np.max(abs(reduce(fem, flexible=n).response(f) - H) / peak) for n in (2, 4, 8, 16, 32)]
    assert np.all(np.diff(off) < 0)
    assert off[1] < 0.04
    assert off[-1] < 1e-3
    perfect = Fem(samii(), rigid=SPRINGS, rayleigh=SMALL)
    H = perfect.response(f)
    assert np.max(abs(reduce(perfect).response(f) - H) / abs(H).max(axis=0)) < 1e-3


def test_velocity_feedback_survives_the_reduction() -> None:
    fem = Fem(samii(collocated=True), feedback={"joint_2_source": (500.0, 0.5)})
    f = np.linspace(0.5, 10, 100)
    H = fem.response(f)
    assert reduce(fem, flexible=8).response(f) == pytest.approx(H, rel=2e-2)


def test_a_torque_turns_its_joint_by_the_inertia_behind_it() -> None:
    # At high frequency, before anything else moves: the torque meets M alone.
    angle = {"name": "y", "kind": "relative_angle", "across": ["hinge"], "unit": "rad"}
    rig = chain(
        SOURCE,
        ("hinge", "torsional_spring", {"k": 30.0}),
        ("link", "rigid_link", {"L": 0.3, "r": 0.1, "m": 0.4, "I": 2e-3}),
        sensors=[angle],
    )
    reduced = reduce(Fem(rig), flexible=0, torque=["hinge"])
    assert reduced.inputs == ("v", "T_hinge")
    f = np.array([0.3, 5.0, 40.0])
    s = 2j * np.pi * f
    assert reduced.response(f)[:, 0, 1] == pytest.approx(1 / (30.0 + 6e-3 * s**2), rel=1e-12)


def test_python_control_gets_the_same_model() -> None:
    import control  # here: a fifth of a second for each process that collects the tests

    reduced = reduce(Fem(samii()))
    system = reduced.to_statespace()
    assert isinstance(system, control.StateSpace)
    assert system.input_labels == ["v_2"]
    assert system.output_labels == ["theta_2", "a_0", "a_1", "a_2"]
    f = np.geomspace(0.1, 50, 20)
    response = np.moveaxis(system(2j * np.pi * f), -1, 0)
    assert response == pytest.approx(reduced.response(f), rel=1e-7)
    poles = system.poles()
    assert np.all(poles.real < 1e-9)
    assert np.min(abs(poles + 150.0)) < 1e-6  # the source's own


def test_a_minute_of_the_simulated_rig_and_of_finite_elements_is_the_same() -> None:
    plain = tuple(s.model_copy(update={"highpass_hz": 0.0, "antialias": None})
                  for s in samii().sensor)  # fmt: skip
    rig = samii().model_copy(update={"sensor": plain})
    dt = 1 / rig.rate_hz
    t = np.arange(round(60 / dt)) * dt
    v = np.sin(2 * np.pi * (0.5 * t + 0.5 * (9.5 / 60) * t**2))  # 0.5 to 10 Hz
    flexible = Fem(rig).basis().modes.omega.size
    transfer = simulate(realise(rig).state_space(), v, dt)
    flexible = Fem(rig).basis().modes.omega.size
    elements = simulate(reduce(Fem(rig), flexible).state_space(), v, dt)
    rms = np.sqrt(np.mean((transfer - elements) ** 2, axis=0) / np.mean(elements**2, axis=0))
    assert np.all(rms < 5e-3)


def simulate(system: tuple[np.ndarray, ...], v: np.ndarray, dt: float) -> np.ndarray:
    """(n, n_out) samples from rest, the input held from one to the next."""
    A, B, C, D, _ = cont2discrete(system, dt)
    x = np.zeros((len(v) + 1, len(A)))
    for n, held in enumerate(v):
        x[n + 1] = A @ x[n] + B[:, 0] * held
    return x[:-1] @ C.T + np.outer(v, D[:, 0])


@pytest.mark.parametrize(
    ("flexible", "torque", "words"),
    [
        (100, [], "0 to 34 modes"),
        (-1, [], "0 to 34 modes"),
        (4, ["joint_9"], "joints without a source"),
        (4, ["joint_2_source"], "joints without a source"),
        (4, ["joint_3", "joint_3"], "each once"),
    ],
)
def test_what_cannot_be_reduced_is_said(flexible: int, torque: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        reduce(Fem(samii()), flexible, torque)


def test_modes_that_leave_a_joint_without_inertia_are_refused() -> None:
    fem = Fem(samii(), feedback={"joint_2_source": (500.0, 0.5)})
    with pytest.raises(InputError, match="fewer modes"):
        reduce(fem, flexible=30)


def test_a_floating_chain_and_a_loss_factor_are_refused() -> None:
    beam = {"EI": 3.0, "mu": 0.2, "L": 0.7}
    with pytest.raises(InputError, match="floats"):
        reduce(Fem(chain(SOURCE, ("beam", "beam", beam), base="pinned")))
    with pytest.raises(InputError, match="tau"):
        reduce(Fem(chain(SOURCE, ("beam", "beam", {**beam, "eta": 0.01}))))
