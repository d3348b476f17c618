"""Forces of contact in the simulated rig: dry friction of a guide, play of a spring.

Plan: closed forms (a mass that swings out, one that slides steadily, one that sticks, one that
crosses its gap); integrators written by hand, and one that is exact between stops; no force is the
linear rig; what is set wrongly; the diagnosis.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig, parameters
from samii_rig.signal.estimate import estimate
from samii_rig.signal.excitation import swept_sine
from samii_rig.types import Channel, Float, Recording, Segment
from sim.rig import check_rig, open_rig

FORCE = 1.5  # N
GAP = 0.4e-3  # m


def bench(name: str, **values: float) -> Rig:
    """A shipped bench without steps and ranges of its sensors, some parameters at these values."""
    return bare(load_rig(name)[0], **values)


def bare(rig: Rig, **values: float) -> Rig:
    elements = tuple(
        e.model_copy(
            update={
                s: p.model_copy(update={"value": values[f"{e.name}_{s}"]})
                for s, p in parameters(e).items()
                if f"{e.name}_{s}" in values
            }
        )
        for e in rig.element
    )
    free = {"resolution": 0.0, "low": -1e9, "high": 1e9}
    sensors = tuple(s.model_copy(update=free) for s in rig.sensor)
    return rig.model_copy(update={"element": elements, "sensor": sensors})


def run(rig: Rig, u: Float, **settings: object) -> dict[str, Float]:
    """Every column of an open loop, without noise."""
    device = open_rig(rig, {"seed": 1, "noise": False, **settings})
    far = 1e9
    device.actuator.configure(DeviceLoop(rig.sensor[0].name, 0.0, far, far, far))
    device.actuator.write(CommandBlock(0, u, 0 * u))
    device.clock.sleep(len(u) / rig.rate_hz)
    values = device.sensor.read().values
    return {c.name: values[:, i] for i, c in enumerate(device.sensor.channels)}


@pytest.mark.parametrize("inner", [8, 32])
def test_a_mass_on_a_spring_loses_four_f_over_k_a_cycle_and_sticks(inner):
    """Without a damper the turning points of a free swing fall by 2 F/k each (Den Hartog 1956)."""
    k = 6000.0
    rig = bench("one_mass", spring_c=0.0)
    u = np.zeros(4000)
    u[:2000] = 8.0 * np.minimum(np.arange(2000) / 1000, 1.0)
    x = run(rig, u, guide_friction={"mass": FORCE}, inner=inner)["x"][2010:]
    step = np.diff(x)
    at = np.flatnonzero(step[1:] * step[:-1] < 0) + 1
    # The vertex of the parabola through each turning point and its neighbours.
    a, b, c = x[at - 1], x[at], x[at + 1]
    turning = np.abs(b - (c - a) ** 2 / (8 * (a - 2 * b + c)))
    moving = turning[:-1][-np.diff(turning) > 0.5 * FORCE / k]
    assert len(moving) >= 6
    assert -np.diff(moving) == pytest.approx(2 * FORCE / k, rel=0.01)
    assert abs(x[-1]) <= FORCE / k * (1 + 1e-6)
    assert np.ptp(x[-1000:]) < 1e-9


def test_a_carriage_that_slides_steadily_pulls_its_belt_by_damper_and_friction():
    rig = bench("carriage")
    y = run(rig, np.ones(1500), guide_friction={"carriage": FORCE})
    speed = np.diff(y["x"][-100:]).mean() * rig.rate_hz
    assert speed == pytest.approx(0.02, rel=1e-3)
    assert abs(y["F"][-1]) == pytest.approx(60.0 * speed + FORCE, rel=1e-6)


def test_a_carriage_that_is_pulled_less_than_its_friction_stays():
    u = 1e-3 * np.sin(2 * np.pi * np.arange(1500) / 500)
    y = run(bench("carriage"), u, guide_friction={"carriage": 4.0})
    assert np.max(np.abs(y["x_spindle"])) > 5e-6
    assert np.max(np.abs(y["x"])) < 1e-4 * np.max(np.abs(y["x_spindle"]))


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        ("one_mass", {"guide_friction": {"mass": 1e-9}}),
        ("carriage", {"guide_friction": {"carriage": 1e-9}}),
        ("one_mass", {"play": {"spring": 1e-12}}),
        ("carriage", {"play": {"belt": 1e-12}}),
        ("flexible_joint", {"play": {"joint": 1e-12}}),
    ],
)
def test_next_to_no_force_is_the_linear_rig(name, setting):
    u = np.sin(2 * np.pi * np.arange(1500) / 80)
    linear, touched = run(bench(name), u), run(bench(name), u, **setting)
    for column, values in linear.items():
        assert touched[column] == pytest.approx(values, abs=1e-6 * np.max(np.abs(values)) + 1e-12)


def by_hand(u: Float, rate: float, every: int) -> Float:
    """x of the carriage: a lag and an integrator pull a belt and a mass that dry friction holds."""
    K, p, k, c, m, d = 0.02, 2 * np.pi * 10.0, 25e3, 15.0, 2.8, 60.0
    h = 1 / (rate * every)
    speed = pulled = x = v = 0.0
    out = np.zeros(len(u))
    for n, command in enumerate(u):
        out[n] = x
        for _ in range(every):
            speed += h * p * (K * command - speed)
            pulled += h * speed
            force = k * (pulled - x) + c * (speed - v) - d * v
            free = v + h * force / m
            v = np.sign(free) * max(abs(free) - h * FORCE / m, 0.0)
            x += h * v
    return out


def test_a_carriage_that_goes_to_and_fro_does_as_an_integrator_written_by_hand():
    rig = bench("carriage")
    u = 0.8 * np.sin(2 * np.pi * np.arange(500) * 4.0 / rig.rate_hz)
    x = run(rig, u, guide_friction={"carriage": FORCE})["x"]
    linear = run(rig, u)
    expected = by_hand(linear["v"], rig.rate_hz, 400)  # v as the converter rounds it
    off = np.max(np.abs(x - expected))
    assert off < 2e-3 * np.max(np.abs(expected))
    assert np.max(np.abs(linear["x"] - expected)) > 20 * off


def from_stop_to_stop(u: Float, T: float, force: float) -> tuple[Float, Float]:
    """x_1 in m and the speed of mass_2 of two masses, dry friction on mass_2.

    Exact between two stops: each phase slides to one side or sticks, is linear, and ends where a
    root is found.
    """
    k, c, m, K, p = (12e3, 8e3), (8.0, 5.0), (1.5, 0.8), 6.0, 2 * np.pi * 120.0
    A = np.zeros((6, 6))  # x_1, v_1, x_2, v_2, the coil's force, and 1
    A[0, 1] = A[2, 3] = 1.0
    A[1, :5] = np.array([-k[0] - k[1], -c[0] - c[1], k[1], c[1], 1.0]) / m[0]
    A[3, :4] = np.array([k[1], c[1], -k[1], -c[1]]) / m[1]
    A[4, 4] = -p
    z, side, out = np.array([0, 0, 0, 0, 0, 1.0]), 0, []
    for volts in u:
        out.append((z[0], z[3]))
        A[4, 5], left = p * K * volts, T
        while left > 0:
            free = A[3].copy()  # acceleration of mass_2 without friction
            if side == 0 and m[1] * abs(free @ z) > force:
                side = int(np.sign(free @ z))
            M = A.copy()
            M[3] = 0.0 if side == 0 else free
            M[3, 5] -= side * force / m[1]

            def until(t, M=M, z=z, side=side, free=free):
                y = expm(M * t) @ z
                return side * y[3] if side else force - m[1] * abs(free @ y)

            times = np.linspace(0.0, left, 9)
            ends = [t for t in times[1:] if until(t) < 0]
            if not ends:
                z, left = expm(M * left) @ z, 0.0
                break
            first = times[list(times).index(ends[0]) - 1]
            t = brentq(until, max(first, 1e-9 * T), ends[0], xtol=1e-15)
            z, left = expm(M * t) @ z, left - t
            if side:
                z[3], side = 0.0, 0
            else:
                side = int(np.sign(free @ z))
    return np.array(out).T


def test_a_mass_that_sticks_and_slides_does_as_an_integration_that_is_exact_between_stops():
    rig, n = bench("two_masses"), np.arange(300)
    u = sum(0.35 * np.sin(2 * np.pi * f * n / rig.rate_hz + f) for f in (3.1, 7.3, 11.9, 17.0))
    v = run(rig, u)["v"]  # as the converter rounds it
    x, speed = from_stop_to_stop(v, 1 / rig.rate_hz, FORCE)
    assert np.mean(speed == 0) > 0.1
    off = [
        np.max(np.abs(run(rig, u, guide_friction={"mass_2": FORCE}, inner=inner)["x_1"] - x))
        for inner in (8, 64)
    ]
    assert off[0] < 0.01 * np.max(np.abs(x))
    assert off[1] < 0.3 * off[0]


def test_friction_of_a_mass_whose_motion_a_source_sets_is_refused():
    rig = load_rig("carriage")[0]
    rigid = rig.model_copy(
        update={
            "element": tuple(e for e in rig.element if e.name != "belt"),
            "sensor": tuple(s for s in rig.sensor if s.name != "F"),
        }
    )
    with pytest.raises(InputError, match="a mass that gives way"):
        check_rig(rigid, {"guide_friction": {"carriage": 1.0}})


@pytest.mark.parametrize(
    ("name", "setting", "said"),
    [
        ("carriage", {"guide_friction": {"belt": 1.0}}, "a mass of a chain that slides: carriage"),
        ("carriage", {"guide_friction": {"carriage": -1.0}}, "greater than or equal to 0"),
        (
            "two_masses",
            {"guide_friction": {"mass_1": 1.0, "mass_2": 1.0}},
            "one body with friction, or one spring with play",
        ),
        ("samii", {"guide_friction": {"link_1": 1.0}}, "it has none"),
        ("carriage", {"play": {"carriage": 1e-4}}, "is 'carriage'; expected a spring with k: belt"),
        ("carriage", {"play": {"guide": 1e-4}}, "a spring with k: belt"),
        ("carriage", {"play": {"belt": -1.0}}, "greater than or equal to 0"),
        (
            "carriage",
            {"play": {"belt": 1e-4}, "guide_friction": {"carriage": 1.0}},
            "one body with friction, or one spring with play",
        ),
        ("samii_two_joints", {"play": {"joint_2": 1e-4}}, "none with several outputs"),
    ],
)  # fmt: skip
def test_a_contact_that_cannot_be_is_refused_in_one_line(name, setting, said):
    with pytest.raises(InputError) as error:
        check_rig(load_rig(name)[0], setting)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_play_of_a_spring_that_swings_faster_than_the_inner_steps_show_is_refused():
    stiff = bench("carriage", belt_k=2.5e7)
    with pytest.raises(InputError, match="a softer spring, or inner = 30"):
        check_rig(stiff, {"play": {"belt": GAP}})
    check_rig(stiff, {"play": {"belt": GAP}, "inner": 30})


def test_a_mass_that_is_pushed_rests_half_the_gap_further_than_its_spring():
    u = np.full(4000, 2.0)
    x = run(bench("one_mass"), u, play={"spring": GAP})["x"]
    assert x[-1] == pytest.approx(4.0 * 2.0 / 6000.0 + GAP / 2, rel=1e-4)  # a step of the converter


@pytest.mark.parametrize("inner", [8, 32])
def test_a_free_swing_takes_longer_by_four_times_the_way_across_half_the_gap(inner):
    """T = 2 pi/omega + 4 (b/2)/(omega (A - b/2)), A the turning point (Den Hartog 1956)."""
    k, m = 6000.0, 1.2
    rig = bench("one_mass", spring_c=0.0)
    u = np.zeros(3000)
    u[:1500] = 8.0 * np.minimum(np.arange(1500) / 1000, 1.0)
    x = run(rig, u, play={"spring": GAP}, inner=inner)["x"][1510:]
    up = np.flatnonzero((x[:-1] < 0) & (x[1:] >= 0))
    crossing = up - x[up] / (x[up + 1] - x[up])
    T = np.diff(crossing).mean() / rig.rate_hz
    speed = np.sqrt(np.mean((np.gradient(x)[up] * rig.rate_hz) ** 2))  # across the gap
    omega = np.sqrt(k / m)
    assert 2 * np.pi / omega + 4 * (GAP / 2) / speed == pytest.approx(T, rel=1e-3)
    assert T * omega > 1.02 * 2 * np.pi


def crossed(u: Float, rate: float) -> tuple[Float, Float]:
    """x in m and the belt's tension in N of the carriage whose belt has play, by a solver."""
    K, p, k, c, m, d = 0.02, 2 * np.pi * 10.0, 25e3, 15.0, 2.8, 60.0

    def pull(y: Float) -> float:
        way = y[1] - y[2]
        return k * (way - np.clip(way, -GAP / 2, GAP / 2)) + c * (y[0] - y[3])

    def slope(_t: float, y: Float, volts: float) -> list[float]:
        return [p * (K * volts - y[0]), y[0], y[3], (pull(y) - d * y[3]) / m]

    y, out = np.zeros(4), []
    for volts in u:
        out.append((y[2], pull(y)))
        y = solve_ivp(slope, (0, 1 / rate), y, args=(volts,), rtol=1e-9, atol=1e-13).y[:, -1]
    return np.array(out).T


def test_a_carriage_with_play_in_its_belt_does_as_a_solver_of_its_equation():
    """And the error falls with the square of the inner step."""
    rig = bench("carriage")
    u = 0.8 * np.sin(2 * np.pi * np.arange(400) * 4.0 / rig.rate_hz)
    linear = run(rig, u)
    x, tension = crossed(linear["v"], rig.rate_hz)  # v as the converter rounds it
    off = []
    for inner in (4, 16):
        y = run(rig, u, play={"belt": GAP}, inner=inner)
        off.append((np.max(np.abs(y["x"] - x)), np.std(np.abs(y["F"]) - np.abs(tension))))
    assert off[1][0] < 1e-4 * np.max(np.abs(x))
    assert off[1][1] < 0.01 * np.std(tension)
    assert off[0][0] > 6 * off[1][0]
    assert np.max(np.abs(linear["x"] - x)) > 100 * off[1][0]


def turned(u: Float, rate: float, gap: float) -> Float:
    """x in m of the spindle drive whose coupling has play, by a solver."""
    K, p, k, c = 100 * 2 * np.pi / 60, 2 * np.pi * 25.0, 3.0, 0.002
    lead, n = 0.01 / (2 * np.pi), 2.0
    inertia, damper = 0.8e-4 + 12.0 * lead**2, 150.0 * lead**2

    def slope(_t: float, y: Float, volts: float) -> list[float]:
        way, speed = y[1] / n - y[2], y[0] / n - y[3]
        torque = k * (way - np.clip(way, -gap / 2, gap / 2)) + c * speed
        return [p * (K * volts - y[0]), y[0], y[3], (torque - damper * y[3]) / inertia]

    y, out = np.zeros(4), []
    for volts in u:
        out.append(lead * y[2])
        y = solve_ivp(slope, (0, 1 / rate), y, args=(volts,), rtol=1e-9, atol=1e-13).y[:, -1]
    return np.array(out)


def test_a_table_whose_coupling_has_play_does_as_a_solver_of_its_equation():
    rig, gap = bench("spindle_drive"), 0.05
    n = np.arange(600)
    u = np.sin(2 * np.pi * n * 11.0 / rig.rate_hz) + np.sin(2 * np.pi * n * 5.0 / rig.rate_hz)
    linear = run(rig, u)
    x = turned(linear["v"], rig.rate_hz, gap)
    off = np.max(np.abs(run(rig, u, play={"coupling": gap}, inner=16)["x"] - x))
    assert off < 1e-4 * np.max(np.abs(x))
    assert np.max(np.abs(linear["x"] - x)) > 100 * off


def test_play_of_a_spring_against_the_ground_is_that_of_one_between():
    """A spring to the clamped base is one to the ground."""
    text = load_rig("one_mass")[1]
    text = text.replace('kind = "spring"', 'kind = "ground_spring"', 1)
    ground = bare(parse(Rig, text.replace('base = "clamped"', 'base = "free"'), "ground"))
    u = 4.0 * np.sin(2 * np.pi * np.arange(1000) * 6.0 / 500)
    between, against = (run(r, u, play={"spring": GAP})["x"] for r in (bench("one_mass"), ground))
    assert against == pytest.approx(between, abs=1e-8 * np.max(np.abs(between)))


NUT = """
[[element]]
name = "nut_stiffness"
kind = "spring"
k = { value = 2.0, unit = "N/um", tolerance = 0.1, source = "data sheet of the nut" }
c = { value = 2000.0, unit = "N s/m", tolerance = 0.3, source = "guess" }

[[element]]
name = "table"
"""


def spindle() -> Rig:
    """The spindle drive with a nut that gives way, and a scale of 1 um."""
    text = load_rig("spindle_drive")[1].replace('\n[[element]]\nname = "table"\n', NUT)
    return parse(Rig, text.replace("= 0.1e-3\n", "= 1e-3\n"), "spindle")


def swept(
    rig: Rig, level: float, seed: int, stop_hz: float = 40.0, **settings: object
) -> Recording:
    """A sweep of a rig in its loop, with noise and the converters' steps."""
    device = open_rig(rig, {"seed": seed, **settings})
    far = 1e9
    device.actuator.configure(DeviceLoop(rig.centring.sensor, rig.centring.kp, far, far, far))
    u = level * swept_sine(rig.rate_hz, 1.0, stop_hz, 12.0, ramp=0.5)[0]
    u = np.concatenate([u, np.zeros(500)])
    device.actuator.write(CommandBlock(0, u, 0 * u))
    device.clock.sleep(len(u) / rig.rate_hz)
    block = device.sensor.read()
    units = rig.units()
    (output,) = rig.actuator
    channels = (
        Channel("u", "V", "reference"),
        Channel("theta_ref", units[rig.centring.sensor], "reference"),
        Channel(output.name, "V", "command", resolution=output.resolution),
        *(Channel(s.name, units[s.name], resolution=s.resolution) for s in rig.sensor),
    )
    segment = Segment("sweep", "single", 0, len(block.values), level, "V", 0)
    return Recording(
        channels, rig.rate_hz, block.time, block.sequence, block.values, block.quality,
        (segment,), source=f"run_{seed}.mcap",
    )  # fmt: skip


@pytest.mark.slow  # whole diagnoses: 30 to 90 s each
@pytest.mark.parametrize(
    ("rig", "level", "setting", "physics", "symbol"),
    [
        ("carriage", 1.0, {"guide_friction": {"carriage": 1.0}}, "coulomb_friction", "T_c"),
        ("carriage", 1.0, {"play": {"belt": 0.2e-3}}, "backlash", "width"),
        ("spindle", 3.0, {"play": {"coupling": 0.01}}, "backlash", "width"),
        ("spindle", 3.0, {"play": {"nut_stiffness": 20e-6}}, "backlash", "width"),
    ],
)
def test_the_diagnosis_names_the_contact_and_its_size(rig, level, setting, physics, symbol):
    """Sites: friction of the carriage is that of its guide, play that of the spring itself.

    Of the spindle a weight of a hundred-thousandth of the coupling's stiffness may be named beside.
    """
    made = spindle() if rig == "spindle" else load_rig(rig)[0]
    levels = (level, level, 2 * level, 2 * level)
    runs = [swept(made, one, seed, **setting) for seed, one in enumerate(levels)]
    found = diagnose(estimate(runs), made, runs=runs)
    ((where, size),) = next(iter(setting.values())).items()
    assert found.verdict == "named"
    (named,) = (c for c in found.causes if c.physics != "gravity_stiffness")
    assert rig == "spindle" or len(found.causes) == 1
    assert (named.physics, named.site) == (physics, {"carriage": "guide"}.get(where, where))
    assert named.parameters[symbol].low < size < named.parameters[symbol].high
    assert named.parameters[symbol].value == pytest.approx(size, rel=0.03)
