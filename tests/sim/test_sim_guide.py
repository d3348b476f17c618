"""Dry friction of a guide in the simulated rig.

Plan: closed forms (a mass that swings out, one that slides steadily, one that sticks); an
integrator written by hand, and one that is exact between stops; no friction is the linear rig; what
is set wrongly; the diagnosis.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig, parameters
from samii_rig.signal.estimate import estimate
from samii_rig.signal.excitation import swept_sine
from samii_rig.types import Channel, Float, Recording, Segment
from sim.rig import check_rig, open_rig

FORCE = 1.5  # N


def bench(name: str, **values: float) -> Rig:
    """A shipped bench without steps and ranges of its sensors, some parameters at these values."""
    rig = load_rig(name)[0]
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


@pytest.mark.parametrize("name", ["one_mass", "carriage"])
def test_next_to_no_friction_is_the_linear_rig(name):
    u = np.sin(2 * np.pi * np.arange(1500) / 80)
    body = {"one_mass": "mass", "carriage": "carriage"}[name]
    linear, rubbed = (run(bench(name), u, guide_friction=made) for made in ({}, {body: 1e-9}))
    for column, values in linear.items():
        assert rubbed[column] == pytest.approx(values, abs=1e-6 * np.max(np.abs(values)) + 1e-12)


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
        ("carriage", {"belt": 1.0}, "a mass of a chain that slides: carriage"),
        ("carriage", {"carriage": -1.0}, "greater than or equal to 0"),
        ("two_masses", {"mass_1": 1.0, "mass_2": 1.0}, "one body with friction"),
        ("samii", {"link_1": 1.0}, "it has none"),
    ],
)
def test_friction_of_what_does_not_slide_is_refused_in_one_line(name, setting, said):
    with pytest.raises(InputError) as error:
        check_rig(load_rig(name)[0], {"guide_friction": setting})
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def swept(level: float, seed: int) -> Recording:
    """A sweep of the carriage in its loop, with noise and the converters' steps."""
    rig = load_rig("carriage")[0]
    device = open_rig(rig, {"seed": seed, "guide_friction": {"carriage": 1.0}})
    far = 1e9
    device.actuator.configure(DeviceLoop(rig.centring.sensor, rig.centring.kp, far, far, far))
    u = level * swept_sine(rig.rate_hz, 1.0, 40.0, 12.0, ramp=0.5)[0]
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


@pytest.mark.slow  # a whole diagnosis: 90 s
def test_the_diagnosis_finds_the_friction_of_the_guide_and_its_size():
    runs = [swept(level, seed) for seed, level in enumerate((1.0, 1.0, 2.0, 2.0))]
    found = diagnose(estimate(runs), load_rig("carriage")[0], runs=runs)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("coulomb_friction", "guide")
    assert cause.parameters["T_c"].low < 1.0 < cause.parameters["T_c"].high
    assert cause.parameters["T_c"].value == pytest.approx(1.0, rel=0.03)
