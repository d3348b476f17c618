"""Gravity along a chain: pendulums, hanging strips and ropes against closed forms, finite elements,
exudyn and an integration in time."""

from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from elements_kit import branch, part
from gravity_kit import SWAY, G, arm, gradient_agrees, hanging
from mpmath import mp, mpf
from scipy.linalg import eigh
from scipy.special import jn_zeros, roots_laguerre

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import InputError, LimitError
from samii_rig.fem.model import Fem
from samii_rig.model.modes import natural_frequencies
from samii_rig.model.realise import realise
from samii_rig.model.tmm import Chain
from samii_rig.prove.jobs import Plant
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.run import dryrun
from sim.assumed_modes.proof import plant as assumed_modes
from sim.concealed.proof import plant as concealed
from sim.rig import open_rig

EI, MU, L = 0.5, 0.6, 1.5  # N m^2, kg/m, m of a slack strip: its weight bends it as much as EI
HINGE = part("torsional_spring", "hinge", k=1e-9)  # N m/rad, as good as none
STRIP = part("beam", "strip", EI=EI, mu=MU, L=L)
V_AND_Y = (2, 3)  # columns of a device: u, reference, command, sensors
TIP = {"name": "a", "kind": "acceleration", "on": "strip", "position": L, "unit": "m/s^2"}


@pytest.mark.parametrize("pose", [None, 0.0, 30.0, -60.0])
def test_a_hanging_body_is_the_physical_pendulum(pose: float | None) -> None:
    m, r, I = 2.0, 0.4, 0.3  # noqa: E741
    along = G * np.cos(np.deg2rad(pose or 0.0))
    exact = np.sqrt(m * along * r / (I + m * r**2)) / (2 * np.pi)
    rig = hanging(arm(), pose=pose)
    assert natural_frequencies(rig, 0.05, 5.0).hz == pytest.approx([exact], rel=1e-9)
    assert Fem(rig).modes().frequency_hz == pytest.approx([exact], rel=1e-9)


@pytest.mark.parametrize("pose", [10.0, 80.0])
def test_two_bodies_and_a_weight_are_the_double_pendulum(pose: float) -> None:
    rig = hanging(
        arm(), HINGE, arm("fore", 0.7, 0.3, 1.0, 0.1), part("lumped_mass", "tip", m=0.5), pose=pose
    )
    # Lagrange's equations of two bodies with the weight as part of the second.
    m1, r1, L1, I1 = 2.0, 0.4, 1.0, 0.3
    m2, r2 = 1.5, (0.3 * 1.0 + 0.7 * 0.5) / 1.5
    I2 = 0.1 + 1.0 * (r2 - 0.3) ** 2 + 0.5 * (0.7 - r2) ** 2
    M = np.array([[I1 + m1 * r1**2 + m2 * L1**2, m2 * L1 * r2], [m2 * L1 * r2, I2 + m2 * r2**2]])
    K = G * np.cos(np.deg2rad(pose)) * np.diag([m1 * r1 + m2 * L1, m2 * r2])
    exact = np.sqrt(eigh(K, M)[0]) / (2 * np.pi)
    assert natural_frequencies(rig, 0.05, 5.0).hz == pytest.approx(exact, rel=1e-8)
    assert Fem(rig).modes().frequency_hz == pytest.approx(exact, rel=1e-8)


def test_a_body_that_stands_on_a_spring_is_slower_and_falls_where_the_spring_gives_in() -> None:
    m, r, I = 2.0, 0.4, 0.3  # noqa: E741
    spring = part("torsional_spring", "hinge", k=10.0)
    rig = hanging(spring, arm(), base="clamped", pose=180.0, sensor=[{**SWAY, "after": "arm"}])
    exact = np.sqrt((10.0 - m * G * r) / (I + m * r**2)) / (2 * np.pi)
    assert natural_frequencies(rig, 0.01, 5.0).hz == pytest.approx([exact], rel=1e-9)
    dryrun._refuse_falling(rig)
    weak = Chain(rig).with_values({("hinge", "k"): 7.0}).rig  # m g r = 7.85 N m/rad
    with pytest.raises(LimitError, match="falls over by itself"):
        dryrun._refuse_falling(weak)


def strip_hz(clamped: bool, pull: float, near: list[float]) -> list[float]:
    """Natural frequencies of a strip that hangs, by a power series in 40 digits from its tip:
    EI w'''' - (pull mu x w')' = mu omega^2 w, x from the tip up."""
    with mp.workdps(40):
        c, mu, length = mpf(EI), mpf(MU), mpf(L)

        def condition(hz: mpf) -> mpf:
            omega2 = (2 * mp.pi * hz) ** 2
            columns = []
            for start in ((1, 0, 0, 0), (0, 1, 0, 0)):  # no moment and no shear force at the tip
                a = [mpf(x) for x in start]
                for k in range(120):
                    weight = pull * mu * (k + 1) ** 2 * a[k + 1]
                    a.append((weight + mu * omega2 * a[k]) * mp.factorial(k) / mp.factorial(k + 4)
                             / c)  # fmt: skip
                w = sum(x * length**k for k, x in enumerate(a))
                slope = sum(k * x * length ** (k - 1) for k, x in enumerate(a) if k)
                bend = sum(k * (k - 1) * x * length ** (k - 2) for k, x in enumerate(a) if k > 1)
                columns.append((w, slope if clamped else bend))
            (w1, d1), (w2, d2) = columns
            return w1 * d2 - w2 * d1

        return [
            float(mp.findroot(condition, (x * 0.9999, x * 1.0001), solver="secant")) for x in near
        ]


@pytest.mark.parametrize(("base", "pose"), [("clamped", 0.0), ("pinned", 0.0), ("clamped", 130.0)])
def test_a_hanging_strip_has_the_frequencies_of_its_power_series(base: str, pose: float) -> None:
    """N L^2/EI is 40: the weight makes the lowest mode of the clamped strip twice as fast. What
    stands at 130 deg would buckle without most of its weight, so it is a tenth as heavy."""
    scale = 1.0 if pose == 0 else 0.05
    rig = hanging(STRIP, base=base, pose=pose, gravity=G * scale)
    found = natural_frequencies(rig, 0.1, 25.0).hz
    assert found.size >= 4
    pull = G * scale * np.cos(np.deg2rad(pose))
    assert found == pytest.approx(strip_hz(base == "clamped", pull, list(found)), rel=1e-10)
    assert Fem(rig, 60).modes(4).frequency_hz == pytest.approx(found[:4], rel=1e-5)


def test_beads_on_a_thread_are_the_heavy_chain_of_bernoulli() -> None:
    """n equal weights at a distance l: omega^2 = x g/l, x the zeros of Laguerre's polynomial; of
    more and more, j_0^2/4 g/L, j_0 the zeros of the Bessel function."""
    n, l = 16, 0.1  # noqa: E741
    parts = [
        p
        for i in range(n)
        for p in (
            part("torsional_spring", f"hinge_{i}", k=1e-9),
            part("rigid_link", f"thread_{i}", L=l, r=0.0, m=0.0, I=0.0),
            part("lumped_mass", f"bead_{i}", m=0.2),
        )
    ]
    rig = hanging(*parts, base="clamped")
    exact = np.sqrt(roots_laguerre(n)[0] * G / l) / (2 * np.pi)
    found = natural_frequencies(rig, 0.1, 1.01 * exact[-1]).hz
    assert found == pytest.approx(exact, rel=1e-7)
    assert Fem(rig).modes().frequency_hz == pytest.approx(exact, rel=1e-7)
    rope = jn_zeros(0, 2) / 2 * np.sqrt(G / (n * l)) / (2 * np.pi)
    assert found[:2] == pytest.approx(rope, rel=1 / n)


def test_a_tension_that_stays_is_that_of_a_string_with_stiffness() -> None:
    """A strip without weight of its own under a heavy bob that its lower end holds: pinned at both
    ends the modes are sines, omega^2 = k^2 (EI k^2 + N)/mu."""
    mu, bob = 1e-4, 50.0
    rig = hanging(
        part("beam", "strip", EI=EI, mu=mu, L=L), part("lumped_mass", "bob", m=bob), tip="pinned"
    )
    N = G * (bob + mu * L / 2)  # what the strip itself weighs is 3e-6 of it: its mean counts
    k = np.arange(1, 4) * np.pi / L
    exact = np.sqrt(k**2 * (EI * k**2 + N) / mu) / (2 * np.pi)
    found = natural_frequencies(rig, 10.0, 1.1 * exact[-1]).hz
    assert found == pytest.approx(exact, rel=1e-8)


def test_a_hanging_strip_is_exudyns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exu = pytest.importorskip("exudyn", reason="exudyn is not installed")
    item = pytest.importorskip("exudyn.itemInterface")
    mbs, n = exu.SystemContainer().AddSystem(), 40
    ground = mbs.AddMarker(item.MarkerNodeCoordinate(
        nodeNumber=mbs.AddNode(item.NodePointGround()), coordinate=0))  # fmt: skip
    nodes = [
        mbs.AddNode(item.Point2DS1(referenceCoordinates=[i * L / n, 0, 1, 0])) for i in range(n + 1)
    ]
    for pair in pairwise(nodes):
        cable = mbs.AddObject(item.ObjectANCFCable2D(
            length=L / n, massPerLength=MU, bendingStiffness=EI, axialStiffness=1e5,
            nodeNumbers=list(pair), useReducedOrderIntegration=0,
        ))  # fmt: skip
        marker = mbs.AddMarker(item.MarkerBodyMass(bodyNumber=cable))
        mbs.AddLoad(item.LoadMassProportional(markerNumber=marker, loadVector=[G, 0, 0]))
    for i in (0, 1, 3):  # x, y and the slope
        here = mbs.AddMarker(item.MarkerNodeCoordinate(nodeNumber=nodes[0], coordinate=i))
        mbs.AddObject(item.CoordinateConstraint(markerNumbers=[ground, here]))
    mbs.Assemble()
    monkeypatch.chdir(tmp_path)  # where it writes its solution
    mbs.SolveStatic(exu.SimulationSettings(), updateInitialValues=True)
    theirs = np.sort(mbs.ComputeODE2Eigenvalues(convert2Frequencies=True)[0])
    ours = natural_frequencies(hanging(STRIP, base="clamped"), 0.1, 10.0).hz
    # Its cable stretches, by m g/(2 EA) = 4e-5 of its length in the mean; ours does not.
    assert theirs[: ours.size] == pytest.approx(ours, rel=5e-5)


def tree(pose: float) -> Rig:
    """Everything that weighs something: bodies, beams of both kinds, a weight, a side chain."""
    source = part("angular_velocity_source", "source", K=0.5, p=150.0)
    side = branch(
        arm("hose", 0.2, 0.1, 0.2, 1e-3),
        part("torsional_spring", "bend", k=3.0, c=0.01),
        part("beam", "end", EI=1.0, mu=0.3, L=0.5, tau=1e-3),
    )
    strip = part("beam", "strip", EI=8.0, mu=MU, L=L, eta=0.01, tau=1e-3)
    thick = part("timoshenko_beam", "thick", EI=40.0, mu=0.5, L=0.4, GA=1e5, J=1e-3, tau=1e-3)
    mid = {**TIP, "name": "m", "position": 0.7, "tilt": 1.0}
    moment = {"name": "M", "kind": "moment", "after": "source", "unit": "N m"}
    return hanging(
        source, side, thick, strip, part("torsional_spring", "wrist", k=20.0, c=0.1), arm(m=0.8),
        base="clamped", pose=pose, sensor=[mid, {**TIP, "name": "tip"}, moment],
    )  # fmt: skip


@pytest.mark.parametrize("pose", [20.0, 110.0])
def test_the_responses_of_transfer_matrices_and_finite_elements_are_one(pose: float) -> None:
    f = np.array([0.1, 0.7, 2.0, 5.0])
    rig = tree(pose)
    ours = Chain(rig).response(f)
    off = [np.max(np.abs(Fem(rig, n).response(f) / ours - 1)) for n in (20, 40)]
    assert off[1] < 1e-5
    level = Chain(tree(90.0)).response(f)
    assert np.max(np.abs(level / ours - 1)) > 1e-2  # which gravity makes


def test_the_gradient_is_that_of_differences() -> None:
    """By everything that weighs and by all else, in the series of a beam and in its waves."""
    f = np.array([0.3, 4.0, 30.0, 400.0])
    shortest = ("strip", "L")  # which cannot be shorter than where a sensor is
    gradient_agrees(Chain(tree(20.0)), f, floor=1e-7, but=(shortest,))


def test_without_gravity_and_level_the_chain_is_the_same_to_the_last_bit() -> None:
    f = np.geomspace(0.1, 100.0, 50)
    rig = load_rig("samii")[0]
    level = Rig.model_validate(
        {**rig.model_dump(), "gravity": G, "pose": {"value": 90.0, "unit": "deg"}}
    )
    assert np.array_equal(Chain(rig).response(f), Chain(level).response(f))
    assert (rig.pull, level.pull) == (0, 0)


def test_samii_under_gravity_hangs_stiffer_and_stands_softer() -> None:
    rig = load_rig("samii")[0]
    at = [rig.model_copy(update={"gravity": G, "pose": None}), rig, None]
    at[2] = Rig.model_validate(
        {**rig.model_dump(), "gravity": G, "pose": {"value": np.pi, "unit": "rad"}}
    )
    down, none, up = (natural_frequencies(r, 0.3, 10.0).hz[0] for r in at)
    assert up < none < down
    assert Fem(at[0], 30).modes(1).frequency_hz[0] == pytest.approx(down, rel=1e-6)


def test_the_simulated_rig_swings_as_the_integrated_pendulum() -> None:
    """The nonlinear pendulum with friction by Runge and Kutta, driven as the device drives: at a
    thousandth of a radian the sine costs a millionth."""
    m, r, I, c = 2.0, 0.4, 0.3, 0.4  # noqa: E741
    damper = part("torsional_ground_spring", "bearing", k=0.0, c=c)
    rig = hanging(damper, arm(), sensor=[{**SWAY, "after": "arm"}])
    assert realise(rig).error[0] < 1e-6
    n, h = 2000, 1 / rig.rate_hz
    u = 5e-3 * np.sin(2 * np.pi * 0.5 * np.arange(n) * h)
    device = open_rig(rig, {"noise": False})
    device.actuator.configure(DeviceLoop("y", 0.0, 1e9, 1e9, 1e9))
    device.actuator.write(CommandBlock(0, u, np.zeros_like(u)))
    device.clock.sleep(n * h)
    seen = device.sensor.read().values

    def slope(x: np.ndarray, torque: float) -> np.ndarray:
        pulled = torque - c * x[1] - m * G * r * np.sin(x[0])
        return np.array([x[1], pulled / (I + m * r**2)])

    x, out, (v_column, y_column) = np.zeros(2), [], V_AND_Y
    for v in seen[:, v_column]:
        out.append(x[0])
        for _ in range(4):
            k1 = slope(x, v)
            k2 = slope(x + h / 8 * k1, v)
            k3 = slope(x + h / 8 * k2, v)
            k4 = slope(x + h / 4 * k3, v)
            x = x + h / 24 * (k1 + 2 * k2 + 2 * k3 + k4)
    assert np.max(np.abs(seen[:, y_column] - out)) < 1e-5 * np.max(np.abs(out))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("gravity = 0.0", "pose: without gravity; expected gravity"),
        ('base = "free"', "base 'free' carries no weight; expected base"),
        ('pose = { value = 3.0, unit = "m" }', "unit 'm'; expected 'rad' or 'deg'"),
        ("gravity = -9.81", "greater than or equal to 0"),
    ],
)
def test_what_has_no_meaning_is_refused_in_one_line(change: str, said: str, tmp_path: Path) -> None:
    lines = {
        "base": 'base = "clamped"',
        "gravity": "gravity = 9.81",
        "pose": 'pose = { value = 30.0, unit = "deg" }',
    }
    lines[change.split()[0]] = change
    text = (files("samii_rig.rig.data") / "samii.toml").read_text()
    head, tail = text.split('base = "clamped"', 1)
    path = tmp_path / "bench.toml"
    path.write_text(head + "\n".join(lines.values()) + tail)
    with pytest.raises(InputError) as error:
        load_rig(str(path))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_pose_in_degrees_is_kept_as_it_was_written() -> None:
    rig = hanging(arm(), pose=60.0)
    assert rig.pull == pytest.approx(G / 2, rel=1e-15)
    assert rig.pose
    assert (rig.pose.unit, rig.pose.written) == ("rad", "deg")
    assert Rig.model_validate(rig.model_dump(exclude_defaults=True)) == rig


@pytest.mark.parametrize("plant", [concealed, assumed_modes])
def test_a_plant_of_the_proof_without_gravity_refuses_a_rig_with_it(plant: Plant) -> None:
    text = load_rig("samii")[1]
    hung = text.replace('base = "clamped"', 'base = "clamped"\ngravity = 9.81')
    assert plant.refuses("one", text) == ""
    assert "gravity is 9.81; expected none for this plant" in plant.refuses("one", hung)
