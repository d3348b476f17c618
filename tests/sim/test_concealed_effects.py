"""Each effect, put into the finite elements, is the physics its name says.

1. Linear ones: the transfer matrix model with the element of that name added answers alike.
2. Sensor and drive: the nominal response times the filter of that name.
3. Laws: describing functions, from the motion they cause; step halving.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from concealed_kit import (
    FREQUENCY,
    SAMII,
    SAMII_TOML,
    added,
    continuous,
    driven,
    modelled,
    quantity,
)

from samii_rig.rig.load import load_rig
from samii_rig.types import Complex, Float
from sim.concealed import linear, nonlinear
from sim.concealed.draw import edited
from sim.concealed.effects import OUTSIDE, ROWS, physics, places
from sim.concealed.modes import poles_of
from sim.concealed.parts import Description, Law, described
from sim.concealed.scales import DISPLACEMENT, RIGID, Concealed, Dose, Scales

S = 2j * np.pi * FREQUENCY
CLOSE = 5e-4  # relative, at every line of every sensor
Values = dict[str, float]


def put(name: str, site: str, x: float, seed: int = 0) -> tuple[Description, Concealed]:
    plant = described(SAMII)
    module = linear if hasattr(linear, name) else nonlinear
    return plant, getattr(module, name)(plant, site, Dose(x, np.random.default_rng(seed)))


def alike(plant: Description, model: Complex, tolerance: float = CLOSE) -> None:
    wrong = np.abs(continuous(plant, FREQUENCY) / model - 1)
    assert wrong.max() < tolerance, wrong.max(axis=0)


def spring(kind: str, angle: bool) -> Callable[[Values], str]:
    k, c = ("N m/rad", "N m s/rad") if angle else ("N/m", "N s/m")

    def element(v: Values) -> str:
        rows = quantity("k", v.get("k", 0.0), k) + quantity("c", v.get("c", 0.0), c)
        return f'kind = "{kind}"\n{rows}'

    return element


def oscillator(v: Values) -> str:
    k, c = quantity("k", v["k"], "N/m"), quantity("c", v["c"], "N s/m")
    return (
        'kind = "branch"\n[[element.element]]\nname = "hanger"\nkind = "translational_spring"\n'
        f"{k}{c}"
        f'[[element.element]]\nname = "bob"\nkind = "lumped_mass"\n{quantity("m", v["m"], "kg")}'
    )


LINEAR = {
    ("compliance", "beam"): spring("torsional_spring", True),
    ("sideways", "clamp"): spring("translational_spring", False),
    ("sideways", "joint_3"): spring("translational_spring", False),
    ("mass", "link_2"): lambda v: 'kind = "lumped_mass"\n' + quantity("m", v["m"], "kg"),
    ("gravity", "link_2"): lambda v: (
        'kind = "gravity_stiffness"\n' + quantity("k", v["k"], "N m/rad")
    ),
    ("damping", "link_0"): spring("translational_ground_spring", False),
    ("oscillator", "link_1"): oscillator,
}


@pytest.mark.parametrize(("name", "site"), LINEAR)
def test_added_part_answers_as_the_model_with_that_element(name: str, site: str) -> None:
    plant, effect = put(name, site, 0.5)
    assert effect.site == site
    alike(
        plant, modelled(added(SAMII_TOML, site, LINEAR[name, site](effect.parameters)), FREQUENCY)
    )


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_ground_spring_turns_or_shifts(seed: int) -> None:
    plant, effect = put("ground_spring", "beam", 1.0, seed)
    element = spring(effect.where, effect.where.startswith("torsional"))(effect.parameters)
    alike(plant, modelled(added(SAMII_TOML, "beam", element), FREQUENCY))


def test_inertia_is_a_link_without_length() -> None:
    plant, effect = put("inertia", "link_0", 1.0)
    element = 'kind = "lumped_mass"\n' + quantity("m", 1e-9, "kg")
    element += quantity("I", effect.parameters["J"], "kg m^2")
    alike(plant, modelled(added(SAMII_TOML, "link_0", element), FREQUENCY))


@pytest.mark.parametrize("site", ["clamp", "joint_1", "joint_3"])
def test_compliance_of_a_joint_is_what_a_rigid_one_lacks(site: str) -> None:
    plant, effect = put("compliance", site, 2.0)
    truth = {(site, s): (v, "test") for s, v in effect.parameters.items()}
    alike(plant, modelled(edited(SAMII_TOML, truth), FREQUENCY))
    nominal = edited(SAMII_TOML, effect.edits)
    assert f"value = {RIGID!r}" in nominal
    assert np.abs(modelled(nominal, FREQUENCY) / continuous(plant, FREQUENCY) - 1).max() > 0.1


def test_damping_of_a_joint_is_what_an_undamped_one_lacks() -> None:
    plant, effect = put("damping", "joint_2", 1.0)
    assert effect.parameters == {"c": 73.6}
    alike(plant, modelled(SAMII_TOML, FREQUENCY))
    assert effect.edits[("joint_2", "c")][0] == 0.0


@pytest.mark.parametrize("symbol", ["EI", "mu"])
def test_beam_property_is_a_ratio(symbol: str) -> None:
    seed = next(s for s in range(20) if symbol in put("beam", "beam", 1.0, s)[1].parameters)
    plant, effect = put("beam", "beam", 1.0, seed)
    value = plant.part("beam").values[symbol]
    assert value / described(SAMII).part("beam").values[symbol] == pytest.approx(
        effect.parameters[symbol]
    )
    alike(plant, modelled(edited(SAMII_TOML, {("beam", symbol): (value, "test")}), FREQUENCY))


def test_velocity_feedback_is_a_damper_in_series_with_the_source() -> None:
    plant, effect = put("give_way", "joint_2_source", 1.0)
    element = spring("torsional_spring", True)({"c": effect.parameters["g_v"]})
    toml = added(SAMII_TOML, "joint_2_source", element, spanned_by="joint_2_source")
    alike(plant, modelled(toml, FREQUENCY))


def test_effects_beside_velocity_feedback_have_the_scale_of_springs_that_hold() -> None:
    plant, _ = put("give_way", "joint_2_source", 1.0)
    assert Scales.of(plant) == Scales.of(described(SAMII))


def test_oil_column_is_a_compliance_in_series_with_the_source() -> None:
    seed = next(s for s in range(20) if put("oil", "joint_2_source", 1.0, s)[1].where == "column")
    plant, effect = put("oil", "joint_2_source", 1.0, seed)
    k = DISPLACEMENT**2 / effect.parameters["C_h"]
    element = spring("torsional_spring", True)({"k": k, "c": 1e-3 * k})
    toml = added(SAMII_TOML, "joint_2_source", element, spanned_by="joint_2_source")
    alike(plant, modelled(toml, FREQUENCY))


def test_oil_line_makes_the_source_second_order() -> None:
    """With the structure braced the encoder sees K p/(s (s + p)) through the line."""
    seed = next(s for s in range(20) if put("oil", "joint_2_source", 1.0, s)[1].where == "line")
    plant = described(SAMII)
    for name in ("joint_2", "joint_3", "joint_1", "clamp"):
        plant.part(name).values["k"] = 1e12
    plant.parts = [p for p in plant.parts if p.name not in ("link_2", "joint_3", "link_3_6")]
    plant.parts.append(described(SAMII).part("link_2"))
    plant.parts[-1].values.update(m=1e-6, I=1e-8)
    plant.push = "link_2"
    plant.sensors = plant.sensors[:1]
    effect = linear.oil(plant, "joint_2_source", Dose(1.0, np.random.default_rng(seed)))
    omega, zeta = effect.parameters["omega"], effect.parameters["zeta"]
    d = plant.drives[0]
    line = omega**2 / (S**2 + 2 * zeta * omega * S + omega**2)
    damped = line * (1 + 2 * zeta * S / omega)  # its damper lies beside the oil's spring
    closed = d.K * d.p / (S * (S + d.p)) * damped
    assert np.abs(continuous(plant, FREQUENCY)[:, 0] / closed - 1).max() < 1e-2


NOMINAL = modelled(SAMII_TOML, FREQUENCY)
FACTORS: dict[tuple[str, str], Callable[[Values], Complex]] = {
    ("lag", "joint_2_source"): lambda v: 1 / (1 + S / v["p"]),
    ("valve", "joint_2_source"): lambda v: (
        v["omega"] ** 2 / (S**2 + 2 * v["zeta"] * v["omega"] * S + v["omega"] ** 2)
    ),
    ("sensor_lag", "a_1"): lambda v: 1 / (1 + S / v["p"]),
    ("sensor_gain", "theta_2"): lambda v: np.full(S.shape, v["gain"] + 0j),
    ("sensor_highpass", "a_2"): lambda v: S / (S + 2 * np.pi * v["corner"]),
}


@pytest.mark.parametrize(("name", "site"), FACTORS)
def test_filter_multiplies_what_it_filters_and_nothing_else(name: str, site: str) -> None:
    plant, effect = put(name, site, 1.0)
    factor = np.ones_like(NOMINAL)
    columns = [s.name for s in SAMII.sensor]
    where = columns.index(site) if site in columns else slice(None)
    factor[:, where] = FACTORS[name, site](effect.parameters).reshape(
        (-1,) if site in columns else (-1, 1)
    )
    alike(plant, NOMINAL * factor)


@pytest.mark.parametrize(
    ("name", "site"), [("dead_time", "joint_2_source"), ("sensor_delay", "a_0")]
)
def test_delay_turns_the_phase(name: str, site: str) -> None:
    plant, effect = put(name, site, 0.7)
    before, after = (
        poles_of(described(SAMII)).sampled(FREQUENCY),
        poles_of(plant).sampled(FREQUENCY),
    )
    turned = np.exp(-S * effect.parameters["tau"])
    ratio = after[:, 1] / before[:, 1]
    assert np.abs(ratio / turned - 1).max() < 5e-3  # but for what lies above half the rate
    if name == "sensor_delay":
        assert after[:, [0, 2, 3]] == pytest.approx(before[:, [0, 2, 3]])


def test_tilted_accelerometer_feels_gravity_by_its_angle() -> None:
    plant, _ = put("tilt", "a_2", 1.0)
    change = continuous(plant, FREQUENCY)[:, 3] - NOMINAL[:, 3]
    angle = SAMII_TOML + (
        '\n[[sensor]]\nname = "tip"\nkind = "absolute_angle"\nafter = "link_3_6"\nunit = "rad"\n'
        "highpass_hz = 0.05\nantialias = { order = 4, corner_hz = 150.0 }\n"
    )
    felt = 9.80665 * modelled(angle, FREQUENCY)[:, 4]
    # Above, it is a small difference of two large accelerations.
    low = FREQUENCY < 10
    assert np.abs(change / felt - 1)[low].max() < 1e-3


def test_noncollocated_encoder_reads_the_perfect_source() -> None:
    plant, _ = put("encoder", "theta_2", 1.0)
    d = plant.drives[0]
    closed = d.K * d.p / (S * (S + d.p))
    assert continuous(plant, FREQUENCY)[:, 0] == pytest.approx(closed, rel=1e-4)


def test_loss_factor_is_constant_over_the_band() -> None:
    eta = 0.02
    plant, effect = put("loss", "beam", 1.0)
    assert effect.parameters == {"eta": eta}
    ladder = plant.part("beam").ladder
    f = np.geomspace(0.5, 40.0, 50)
    s = 2j * np.pi * f
    stiffness = 1 + sum(e * s / (s + r) for e, r in ladder)
    assert stiffness.imag / stiffness.real == pytest.approx(eta, rel=0.06)


def test_loss_factor_damps_the_first_mode_by_half_of_itself() -> None:
    plant, _ = put("loss", "beam", 1.0)
    for name in ("clamp", "joint_1", "joint_2", "joint_3"):
        plant.part(name).values.update(c=0.0)
    for name in ("clamp", "joint_1", "joint_2", "joint_3"):
        plant.part(name).values["k"] = 1e9
    pole = poles_of(plant).pole
    first = pole[(pole.imag > 10) & (pole.imag < 20)][0]
    # tau of the beam adds omega tau/2.
    wanted = 0.5 * 0.02 + 0.5 * abs(first) * 4e-4
    assert -first.real / abs(first) == pytest.approx(wanted, rel=0.08)


def test_fractional_damper_is_a_power_of_s() -> None:
    plant, effect = put("fractional", "joint_1", 1.0)
    ladder = next(p for p in plant.parts if p.kind == "ladder").ladder
    rest = plant.part("joint_1").values["c"] - 46.4
    torque = sum(k * S / (S + r) for k, r in ladder) + rest * S
    c, alpha = effect.parameters["c"], effect.parameters["alpha"]
    slope = np.gradient(np.log(np.abs(torque)), np.log(FREQUENCY))
    middle = (FREQUENCY > 2) & (FREQUENCY < 30)
    assert slope[middle] == pytest.approx(alpha, abs=0.08)
    assert torque.imag[middle] == pytest.approx((c * S**alpha).imag[middle], rel=0.05)


def test_every_row_of_the_vocabulary_has_a_place() -> None:
    plant = described(SAMII)
    assert all(places(plant, row) for row in (*ROWS, *OUTSIDE))
    assert len(list(physics())) == 29


# Laws. A sine at one frequency, held until it is settled, shows the describing function N(A) as
# the stiffness or damping by which the joint's motion differs.

HZ = 4.0
PERIOD = 125  # samples
LAWS: dict[str, tuple[Law, Callable[[Float, Float], Complex]]] = {
    "coulomb": (
        Law("coulomb", "joint_1", (1.0,)),
        lambda A, s: -4 * 1.0 / (np.pi * A) * 1j,
    ),
    "cubic": (Law("cubic", "joint_1", (1e9,)), lambda A, s: -0.75 * 1e9 * A**2 + 0j),
    "slip": (
        Law("slip", "joint_1", (4000.0, 1e9, 1.0, 1e-12)),
        lambda A, s: np.asarray(-4000.0 + 0j),
    ),
    "drag": (
        Law("drag", "joint_1", (2e4,)),
        lambda A, s: -8 / (3 * np.pi) * 2e4 * A * np.abs(s) * s,
    ),
    "one_sided": (Law("one_sided", "joint_1", (1000.0,)), lambda A, s: np.asarray(-500.0 + 0j)),
    # A stop that is met early: half of its stiffness, but for the way to it.
    "stop": (
        Law("stop", "joint_1", (1000.0, 1e-6, 1.0, 0.0)),
        lambda A, s: np.asarray(-500.0 * (1 - 4e-6 / (np.pi * A)) + 0j),
    ),
}


@pytest.mark.parametrize("name", LAWS)
def test_law_acts_as_its_describing_function(name: str) -> None:
    law, N = LAWS[name]
    u = 0.5 * np.sin(2 * np.pi * np.arange(PERIOD) / PERIOD)
    n = 500
    plant = described(SAMII)
    for part in plant.parts:  # more damping than SAMII has: settled sooner
        part.values.update({k: 5 * part.values[k] for k in ("c", "tau") if k in part.values})
    linear_poles = poles_of(plant)
    plant.laws = [law]
    poles = poles_of(plant)
    _, y, peaks = driven(plant, np.tile(u, n))
    line = np.fft.rfft(y[-PERIOD:], axis=0)[1] / np.fft.rfft(u)[1]
    s = 2j * np.pi * np.array([HZ])
    G = poles.continuous(s)[0]
    m = len(plant.sensors)
    # A by a fixed point from the plant's own transfer functions.
    A = np.array(0.5 * abs(G[m, 0]))
    for _ in range(60):
        d = G[m, 0] / (1 - G[m, 2] * N(A, s))
        A = np.sqrt(A * 0.5 * abs(d))
    change = G[:m, 2] * N(A, s) * d
    lag = np.exp(-s[0] * 0.5 / 500.0)
    seen = line - linear_poles.sampled(np.array([HZ]))[0]
    assert np.abs(seen / (change * lag) - 1).max() < 0.06, (name, peaks, A)


def test_deadband_and_clipping_act_as_theirs() -> None:
    u = np.sin(2 * np.pi * np.arange(PERIOD) / PERIOD)
    for width, limit in ((0.4, np.inf), (0.0, 0.5)):
        plant = described(SAMII)
        plant.drives[0].deadband, plant.drives[0].limit = width, limit
        from sim.concealed.integrate import dead_zone

        applied = np.array([dead_zone(min(max(x, -limit), limit), width) for x in u])
        first = 2 * np.abs(np.fft.rfft(applied)[1]) / PERIOD
        r = 0.2 if width else 0.5
        clip = 2 / np.pi * (np.arcsin(r) + r * np.sqrt(1 - r**2))
        assert first == pytest.approx(1 - clip if width else clip, rel=2e-3)


@pytest.mark.parametrize(
    ("law", "order"),
    [
        (Law("cubic", "joint_1", (1e9,)), 3.0),
        (Law("backlash", "joint_1", (1e-3, 1.36e4)), 2.5),
        (Law("drag", "joint_1", (2e4,)), 3.0),
        (Law("stop", "joint_1", (1.36e4, 3e-4, 1.0, 1.0)), 2.5),
        (Law("stop", "beam", (5e3, 1e-3, 1.0, 0.0), ground=True), 2.5),
        (Law("drift", "joint_1", (1.36e4, -0.3, 1.0)), 3.0),
        (Law("coulomb", "joint_2", (2.0,)), 1.7),
        (Law("drive_friction", "joint_2_source", (0.05,)), 1.6),
        (Law("flow_saturation", "joint_2_source", (150.0,)), 1.6),
        (Law("slip", "joint_1", (1000.0, 1.0, 500.0, 2.0)), 1.6),
    ],
    ids=lambda x: x.kind if isinstance(x, Law) else "",
)
def test_halving_the_step_converges(law: Law, order: float) -> None:
    t = np.arange(2500) / 500.0
    u = np.sin(2 * np.pi * (0.5 * t + 1.0 * t**2))
    plant = described(SAMII)
    plant.laws = [law]
    fine = driven(plant, u, 4.0, 64)[1]
    error = [
        np.sqrt(np.mean((driven(plant, u, 4.0, k)[1] - fine) ** 2) / np.mean(fine**2))
        for k in (4, 8, 16)
    ]
    assert error[1] < 5e-3
    assert error[0] / error[2] > order


@pytest.mark.parametrize("k", [0, 1])
def test_friction_in_either_drive_holds_that_drive_alone(k: int) -> None:
    rig, _ = load_rig("samii_two_joints")
    plant = described(rig)
    t = np.arange(1000) / plant.rate_hz
    sources = [drive.element for drive in plant.drives]
    plant.laws = [Law("drive_friction", sources[k], (0.2,))]
    still, moving = np.zeros((1000, 2)), np.zeros((1000, 2))
    still[:, k] = moving[:, 1 - k] = 0.19 * np.sin(2 * np.pi * 2 * t)
    assert np.abs(driven(plant, still)[1]).max() < 1e-9
    held = driven(plant, moving)[1]
    # The held drive is what it is without a command: the other's answers are the linear ones.
    free = driven(described(rig), moving)[1]
    np.testing.assert_allclose(held, free, atol=1e-9 * np.abs(held).max())


@pytest.mark.parametrize("k", [0, 1])
def test_an_effect_of_either_drive_is_in_the_answers_to_its_own_input(k: int) -> None:
    rig, _ = load_rig("samii_two_joints")
    plant, nominal = described(rig), described(rig)
    linear.lag(plant, plant.drives[k].element, Dose(1.0, np.random.default_rng(0)))
    s = 2j * np.pi * FREQUENCY
    G, base = (poles_of(p).continuous(s)[:, :5, :2] for p in (plant, nominal))
    assert np.abs(G[:, :, 1 - k] / base[:, :, 1 - k] - 1).max() < 1e-6
    assert np.abs(G[:, :, k] / base[:, :, k] * (1 + s[:, None] * 1e-3) - 1).max() < 1e-6


def test_friction_that_holds_stops_the_drive() -> None:
    plant = described(SAMII)
    plant.laws = [Law("drive_friction", "joint_2_source", (0.2,))]
    t = np.arange(1000) / 500.0
    _, still, _ = driven(plant, 0.19 * np.sin(2 * np.pi * 2 * t))
    _, moving, _ = driven(plant, 0.3 * np.sin(2 * np.pi * 2 * t))
    assert np.abs(still).max() < 1e-9
    assert np.abs(moving[:, 0]).max() > 1e-4


def test_edits_of_a_rig_file_leave_the_rest_alone() -> None:
    text = edited(SAMII_TOML, {("joint_1", "k"): (RIGID, "test")})
    assert re.sub(r"k = \{ value = 1000000000.0.*\}", "", text) == re.sub(
        r"k = \{ value = 0.136e5.*\}", "", SAMII_TOML
    )
