"""A force in a rig with two inputs, SAMII's joints 2 and 3: what it does, and that it is found."""

from __future__ import annotations

import numpy as np
import pytest
from table_kit import Effects, table_of
from two_joints_kit import BAND, INPUTS, RIG, in_turn, recorded, together
from weak_forces_kit import weak_ones

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.diagnose.diagnose import case_of, diagnose
from samii_rig.diagnose.forces import laws
from samii_rig.diagnose.forces.laws import Force
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.forces.way import Way
from samii_rig.diagnose.physics.effect import Effect, Unknown
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.likelihood.contour import EXACT, Contour
from samii_rig.model.sampled import hold_at, sensors_at
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Float, Recording
from sim.rig import open_rig

RUBS = 0.05  # V, of sweeps of 0.2 and 0.4 V
FEW = Effects(lambda: table_of(RIG, *BAND, "transport_delay", "torsional_compliance"))


def fine(*late: float) -> Rig:
    """The rig with outputs without steps that come later, s."""
    actuators = tuple(
        a.model_copy(update={"resolution": 0.0, "delay": delay})
        for a, delay in zip(RIG.actuator, late, strict=True)
    )
    return RIG.model_copy(update={"actuator": actuators})


def chirps(n: int = 3000) -> Float:
    """(n, 2) V, one slow and one fast."""
    t = np.arange(n) / RIG.rate_hz
    return 0.5 * np.stack([np.sin(2 * np.pi * (a * t + 1.5 * t**2)) for a in (0.5, 1.3)], axis=1)


def sensors(rig: Rig, v: Float, **settings: object) -> Float:
    """(n, q) of the simulated rig under commands v (n, 2), no loop closed, without noise."""
    device = open_rig(rig, {"noise": False, **settings})
    loops = [rig.centring_of(n) for n in INPUTS]
    far = 1e9  # limits that nothing reaches
    device.actuator.configure(tuple(DeviceLoop(c.sensor, 0.0, far, far, far) for c in loops))
    device.actuator.write(tuple(CommandBlock(0, x, np.zeros_like(x)) for x in v.T))
    device.clock.sleep(len(v) / rig.rate_hz)
    return device.sensor.read().values[:, -len(rig.sensor) :]


def added(rig: Rig, force: Force, strengths: tuple[float, ...], v: Float) -> Float:
    """(n, q) what a force adds to the sensors, no loop closed."""
    unknowns = tuple(Unknown(f"p{i}", "1", p / 10, 10 * p, (p,)) for i, p in enumerate(strengths))
    model = ForceModel(rig, (Effect("force", "here", unknowns, force=force),))
    x = np.append(np.zeros(model.n - len(strengths)), np.log(strengths))
    way = Way.of(model, x, acting=(0, 1))
    return way.sensed.of(way.force(model, v, model.numbers(x), model.seeds(x, ()))[0])


def rms(x: Float) -> Float:
    return np.sqrt(np.mean(x**2, axis=0))


@pytest.mark.parametrize("joint", [2, 3])
def test_friction_in_one_drive_adds_what_the_simulated_rig_says(joint: int) -> None:
    """Dead times that differ: each command comes when its own output is late."""
    rig, v = fine(0.0, 0.006), chirps()
    rubs = {f"v_{joint}": RUBS}
    want = sensors(rig, v, coulomb_friction=rubs, inner=32) - sensors(rig, v)
    force = Force(Place("drive", (f"joint_{joint}_source",)), laws.FRICTION)
    got = added(rig, force, (RUBS,), v)
    assert np.all(rms(want) > 0)
    assert np.all(rms(got - want) < 0.03 * rms(want)), rms(got - want) / rms(want)


def test_hysteresis_that_never_slips_is_a_stiffer_joint_under_both_commands() -> None:
    """Against transfer matrices of the stiffer joint, by the contour."""
    k, rig, v = 2e3, fine(0.004, 0.0), chirps()
    got = added(rig, Force(Place("joint", ("joint_1",)), laws.HYSTERESIS), (1e9, k), v)
    contour = Contour.over(len(v), rig.rate_hz, EXACT)
    s = contour.s
    chain = Chain(rig)
    own = chain.values()[chain.parameters.index(("joint_1", "k"))]
    change = chain.with_values({("joint_1", "k"): own + k}).evaluate(s) - chain.evaluate(s)
    seen = sensors_at(rig.sensor, s)
    each = [
        change[:, :, j] * seen * hold_at(s, rig.rate_hz, a.delay)[:, None]
        for j, a in enumerate(rig.actuator)
    ]
    want = sum(
        contour.record(H * contour.damped(x)[:, None], len(v))
        for H, x in zip(each, v.T, strict=True)
    )
    on = rms(want) > 1e-9 * np.max(rms(want))
    assert np.all(rms(got - want)[on] < 0.02 * rms(want)[on]), rms(got - want) / rms(want)


def found_in(runs: list[Recording]) -> Diagnosis:
    """With a table of few linear effects, and all forces."""
    return diagnose(estimate(runs), RIG, runs=runs, effects=FEW)


@pytest.mark.slow  # a minute each; the search is that of one input, which test_diagnose_forces asks
@pytest.mark.parametrize(("how", "joint"), [(together, 3), (in_turn, 2)])
def test_friction_in_one_drive_is_named_there_and_not_at_the_other(how, joint: int) -> None:
    found = found_in(recorded(RIG, how(), coulomb_friction={f"v_{joint}": RUBS}))
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("coulomb_friction", f"joint_{joint}_source")
    T_c = cause.parameters["T_c"]
    assert T_c.low < RUBS < T_c.high
    assert T_c.value == pytest.approx(RUBS, rel=0.03)
    assert found.with_causes[0] < found.threshold


@pytest.mark.slow  # that of one input is test_diagnose_forces
def test_a_weak_force_at_either_input_does_to_first_order_what_it_does_in_time() -> None:
    """By the contour and each loop's answer against the march and the likelihood of the records."""
    runs = recorded(RIG, together())
    linear = on_records(case_of(estimate(runs), RIG, None, FEW, runs))
    assert linear is not None
    search = ForceSearch(linear)
    each = list(weak_ones(search))
    told = {(law.tag, site) for law, site, _, _ in each}
    sources = {"joint_2_source", "joint_3_source"}
    assert {site for tag, site in told if tag == "clipped"} == sources
    assert {site for tag, site in told if tag == "orifice"} == sources
    for law, site, first_order, in_time in each:
        # Harmonics above the third fold back at the low rate.
        assert in_time == pytest.approx(first_order, rel=0.2), (law.tag, site)
