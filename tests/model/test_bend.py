"""A chain with a joint at rest at an angle, against the plane motion of all its bodies.

Plan: two arms in closed form; any chain of bodies by the second derivatives of its energies, taken
from positions in the plane; a beam on each side against a frame that is stiff along itself; finite
elements; the gradient; the simulated rig in time; a right angle comes near without loss; what is
refused.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from elements_kit import branch, part
from gravity_kit import SWAY, G, arm, gradient_agrees, hanging
from scipy.linalg import eigh

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import InputError
from samii_rig.fem.hermite import consistent_mass, stiffness
from samii_rig.fem.model import Fem
from samii_rig.model.modes import natural_frequencies
from samii_rig.model.realise import realise
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import checked
from samii_rig.rig.schema import Rig
from samii_rig.types import Float
from sim.rig import open_rig


def bend(angle: float) -> dict[str, Any]:
    return {"name": "elbow", "kind": "bend", "angle": {"value": angle, "unit": "deg"}}


def hinge(name: str, k: float) -> dict[str, Any]:
    return part("torsional_spring", name, k=k)


UPPER = arm("upper", L=0.7, r=0.3, m=3.0, I=0.12)
LOWER = arm("lower", L=0.5, r=0.2, m=1.4, I=0.05)


def two_arms(angle: float, pose: float | None, gravity: float = G, k: float = 40.0) -> Rig:
    parts = hinge("shoulder", 90.0), UPPER, bend(angle), hinge("joint", k), LOWER
    sensor = [{**SWAY, "after": "lower"}]
    return hanging(*parts, base="clamped", pose=pose, gravity=gravity, sensor=sensor)


def exact(M: Float, K: Float) -> Float:
    """Hz of M q'' + K q = 0."""
    return np.sqrt(eigh(K, M, eigvals_only=True)) / (2 * np.pi)


@pytest.mark.parametrize("angle", [0.0, 35.0, -80.0, 89.8, 140.0])
@pytest.mark.parametrize("pose", [0.0, 50.0, 90.0])
def test_two_arms_have_the_frequencies_of_the_linearised_double_pendulum(
    angle: float, pose: float
) -> None:
    """In absolute angles M_12 is m2 L1 r2 cos(angle), and each weight has its own arm's pose."""
    turn = np.deg2rad(angle)
    up, low = G * np.cos(np.deg2rad(pose)), G * np.cos(np.deg2rad(pose) + turn)
    both = 1.4 * 0.7 * 0.2 * np.cos(turn)
    M = np.array([[0.12 + 3.0 * 0.3**2 + 1.4 * 0.7**2, both], [both, 0.05 + 1.4 * 0.2**2]])
    weight = np.diag([up * (3.0 * 0.3 + 1.4 * 0.7), low * 1.4 * 0.2])
    K = np.array([[130.0, -40.0], [-40.0, 40.0]]) + weight
    rig = two_arms(angle, pose)
    found = natural_frequencies(rig, 0.1, 20.0).hz
    assert found == pytest.approx(exact(M, K), rel=1e-8)
    assert Fem(rig).modes().frequency_hz == pytest.approx(found, rel=1e-8)


def test_a_straight_bend_is_none() -> None:
    f = np.geomspace(0.2, 30, 50)
    bent = two_arms(0.0, 30.0)
    straight = hanging(
        hinge("shoulder", 90.0), UPPER, hinge("joint", 40.0), LOWER,
        base="clamped", pose=30.0, sensor=[{**SWAY, "after": "lower"}],
    )  # fmt: skip
    assert Chain(bent).response(f) == pytest.approx(Chain(straight).response(f), rel=1e-12)


def plane(
    bodies: list[dict[str, Any]], springs: list[float], angles: Float, gravity: float
) -> tuple[Float, Float]:
    """M and K of bodies on hinges in the plane, from where each centre is. angles : rad."""
    n = len(bodies)
    value = [{s: b[s]["value"] for s in "Lrm"} | {"I": b["I"]["value"]} for b in bodies]
    turn = np.tril(np.ones((n, n)))  # absolute from relative angles
    M, K = np.zeros((n, n)), np.diag(springs)
    for i, b in enumerate(value):
        arms = np.array([v["L"] for v in value[:i]] + [b["r"]] + [0.0] * (n - i - 1))
        dx, dy = arms * np.cos(angles) @ turn, arms * np.sin(angles) @ turn
        M += b["m"] * (np.outer(dx, dx) + np.outer(dy, dy)) + b["I"] * np.outer(turn[i], turn[i])
        K = K + b["m"] * gravity * turn.T @ np.diag(arms * np.cos(angles)) @ turn
    return M, K


@pytest.mark.parametrize("gravity", [0.0, G])
@pytest.mark.parametrize("at", [1, 2, 3])
def test_four_bodies_with_a_bend_move_as_they_do_in_the_plane(at: int, gravity: float) -> None:
    """Before the bend stand one, two or three of them; nothing is assumed of any direction."""
    bodies = [
        arm(f"b{i}", L=0.3 + 0.1 * i, r=0.1 + 0.05 * i, m=2.0 - 0.3 * i, I=0.03) for i in range(4)
    ]
    k = [300.0, 200.0, 120.0, 60.0]
    elements = [
        x for b, one in zip(bodies, k, strict=True) for x in (hinge(f"h_{b['name']}", one), b)
    ]
    elements.insert(2 * at, bend(64.0))
    rig = hanging(
        *elements, base="clamped", gravity=gravity, pose=25.0 if gravity else None,
        sensor=[{**SWAY, "after": "b3"}],
    )  # fmt: skip
    angles = np.deg2rad(25.0 + 64.0 * (np.arange(4) >= at))
    hz = exact(*plane(bodies, k, angles, gravity))
    found = natural_frequencies(rig, 0.3 * hz[0], 1.1 * hz[-1]).hz
    assert found == pytest.approx(hz, rel=1e-6)
    assert Fem(rig).modes().frequency_hz == pytest.approx(found, rel=1e-6)


def frame(
    angle: float, EI: tuple[float, float], mu: float, L: tuple[float, float], n: int
) -> Float:
    """Hz of two beams that meet at an angle, the first clamped: bars of EA that nothing stretches,
    assembled in the plane."""
    size = 3 * (2 * n + 1)
    M, K = np.zeros((size, size)), np.zeros((size, size))
    for i in range(2 * n):
        side = int(i >= n)
        h, turn = L[side] / n, angle * side
        c, s = np.cos(turn), np.sin(turn)
        T = np.kron(np.eye(2), np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
        k, m = np.zeros((6, 6)), np.zeros((6, 6))
        bent = np.ix_([1, 2, 4, 5], [1, 2, 4, 5])
        k[bent], m[bent] = stiffness(EI[side], h), consistent_mass(mu, h)
        along = np.ix_([0, 3], [0, 3])
        k[along] = 3e8 * EI[0] / L[0] ** 2 / h * np.array([[1, -1], [-1, 1]])
        m[along] = mu * h / 6 * np.array([[2, 1], [1, 2]])
        at = slice(3 * i, 3 * i + 6)
        K[at, at] += T.T @ k @ T
        M[at, at] += T.T @ m @ T
    slow = eigh(M[3:, 3:], K[3:, 3:], eigvals_only=True)[:-5:-1]  # 1/omega^2, the largest first
    return 1 / np.sqrt(slow) / (2 * np.pi)


@pytest.mark.parametrize("angle", [30.0, 75.0, 120.0])
def test_two_beams_that_meet_at_an_angle_are_a_frame(angle: float) -> None:
    EI, mu, L = (8.0, 5.0), 0.6, (0.8, 0.5)
    beams = [part("beam", "ab"[i], EI=EI[i], mu=mu, L=L[i]) for i in range(2)]
    rig = hanging(
        beams[0], bend(angle), beams[1], base="clamped", gravity=0.0,
        sensor=[{**SWAY, "after": "b"}],
    )  # fmt: skip
    hz = frame(np.deg2rad(angle), EI, mu, L, 24)
    found = natural_frequencies(rig, 0.3 * hz[0], 1.1 * hz[-1]).hz
    assert found == pytest.approx(hz, rel=5e-6)  # which the frame's rounding leaves
    assert Fem(rig, 40).modes(4).frequency_hz == pytest.approx(found, rel=1e-6)


def limb(angle: float = 50.0, pose: float | None = 20.0) -> Rig:
    """Beams, bodies, a weight and a side chain on both sides of a bend; what reads across it."""
    source = part("angular_velocity_source", "source", K=0.5, p=150.0)
    side = branch(arm("hose", 0.2, 0.1, 0.2, 1e-3), part("beam", "end", EI=1.0, mu=0.3, L=0.3))
    parts = [
        source, part("beam", "strip", EI=40.0, mu=0.5, L=0.6, tau=1e-3), UPPER, bend(angle),
        part("torsional_spring", "joint", k=40.0, c=0.1), side, LOWER,
        part("timoshenko_beam", "thick", EI=40.0, mu=0.5, L=0.4, GA=1e5, J=1e-3, tau=1e-3),
        part("lumped_mass", "tool", m=0.3, I=1e-3),
    ]  # fmt: skip
    a = {"kind": "acceleration", "unit": "m/s^2", "tilt": 1.0}
    sensor = [
        {**a, "name": "a_1", "on": "upper", "position": 0.2},
        {**a, "name": "a_2", "on": "lower", "position": 0.1},
        {"name": "M", "kind": "moment", "after": "joint", "unit": "N m"},
        {"name": "V", "kind": "force", "after": "elbow", "unit": "N"},
        {"name": "w", "kind": "displacement", "after": "tool", "against": "joint", "unit": "m"},
    ]
    return hanging(*parts, base="clamped", pose=pose, sensor=sensor)


@pytest.mark.parametrize("angle", [50.0, -100.0])
def test_every_sensor_of_a_bent_chain_is_that_of_finite_elements(angle: float) -> None:
    f, rig = np.array([0.3, 1.1, 4.0, 15.0]), limb(angle)
    ours = Chain(rig).response(f)
    assert np.max(np.abs(Fem(rig, 40).response(f) / ours - 1)) < 1e-5
    straight = Chain(limb(0.0)).response(f)
    assert np.max(np.abs(straight / ours - 1)) > 0.1


def test_the_gradient_of_a_bent_chain_is_that_of_differences() -> None:
    """By the masses beyond the bend too, which it carries along."""
    f = np.array([0.3, 4.0, 30.0])
    gradient_agrees(Chain(limb()), f, floor=1e-6)


def test_the_simulated_rig_moves_as_two_arms_in_the_plane() -> None:
    """Lagrange's equations of two arms by Runge and Kutta, in absolute angles, level, at 1e-5 rad
    where what is not linear is a hundred-thousandth."""
    turn, K = np.deg2rad(70.0), np.array([[130.0, -40.0], [-40.0, 40.0]])
    damper = part("torsional_spring", "shoulder", k=90.0, c=0.5)
    elbow = part("torsional_spring", "joint", k=40.0, c=0.2)
    C = np.array([[0.7, -0.2], [-0.2, 0.2]])
    rig = hanging(
        damper, part("torque_source", "motor", K=1.0), UPPER, bend(70.0), elbow, LOWER,
        base="clamped", gravity=0.0, sensor=[{**SWAY, "after": "lower"}],
        element=[damper, part("torque_source", "motor", K=1.0), UPPER, bend(70.0), elbow, LOWER],
    )  # fmt: skip
    assert realise(rig).error[0] < 1e-6
    n, h = 1500, 1 / rig.rate_hz
    u = 1e-3 * np.sin(2 * np.pi * (0.5 + 1.5 * np.arange(n) * h) * np.arange(n) * h)
    device = open_rig(rig, {"noise": False})
    device.actuator.configure(DeviceLoop("y", 0.0, 1e9, 1e9, 1e9))
    device.actuator.write(CommandBlock(0, u, np.zeros_like(u)))
    device.clock.sleep(n * h)
    seen = device.sensor.read().values

    def slope(x: Float, torque: float) -> Float:
        (a, b), (p, q) = x[:2], x[2:]
        both = 1.4 * 0.7 * 0.2
        near, far = both * np.cos(b - a + turn), both * np.sin(b - a + turn)
        M = np.array([[0.12 + 3.0 * 0.3**2 + 1.4 * 0.7**2, near], [near, 0.05 + 1.4 * 0.2**2]])
        force = np.array([torque + far * q * q, -far * p * p]) - K @ x[:2] - C @ x[2:]
        return np.concatenate([x[2:], np.linalg.solve(M, force)])

    x, out = np.zeros(4), []
    for v in seen[:, 2]:
        out.append(x[1])
        for _ in range(4):
            k1 = slope(x, v)
            k2 = slope(x + h / 8 * k1, v)
            k3 = slope(x + h / 8 * k2, v)
            k4 = slope(x + h / 4 * k3, v)
            x = x + h / 24 * (k1 + 2 * k2 + 2 * k3 + k4)
    assert np.max(np.abs(seen[:, 3] - out)) < 2e-5 * np.max(np.abs(out))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"angle": 90.0}, "90 deg; expected at least 0.1 deg from a right angle"),
        ({"second": True}, "element second: a second bend; expected elbow alone"),
        ({"base": "free", "gravity": 0.0, "pose": None}, "a bend behind base 'free'"),
        ({"tip": "pinned"}, "a bend before tip 'pinned'"),
        ({"sensor": "w"}, "sensor w: against 'upper', on the other side of the bend elbow"),
        ({"motion": "axial", "gravity": 0.0, "pose": None}, "'axial'"),
    ],
)  # fmt: skip
def test_what_a_bend_cannot_say_is_refused_in_one_line(change: dict[str, Any], said: str) -> None:
    data = two_arms(30.0, 20.0).model_dump(exclude_defaults=True)
    data["element"] = list(data["element"])
    at = [e["name"] for e in data["element"]].index("elbow")
    if "angle" in change:
        data["element"][at] = bend(change.pop("angle"))
    if change.pop("second", False):
        data["element"].append({**bend(10.0), "name": "second"})
    if change.pop("sensor", ""):
        across = {"name": "w", "kind": "displacement", "after": "lower", "against": "upper"}
        data["sensor"] = [{**across, "unit": "m"}]
    if change.get("base") == "free" or "motion" in change:
        del data["gravity"], data["pose"]
    data = {**data, **{k: v for k, v in change.items() if k not in ("gravity", "pose")}}
    with pytest.raises(InputError, match=re.escape(said)) as error:
        checked(Rig, data, "arms.toml")
    assert "\n" not in str(error.value)
