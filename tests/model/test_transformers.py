"""Gears and spindles: what turns slower or slides behind them, against the chain reduced by hand,
finite elements and differences."""

import math
import re
from typing import Any

import numpy as np
import pytest
from axial_kit import place

from samii_rig.fem.model import Fem
from samii_rig.model.elements import J, matrix
from samii_rig.model.modes import natural_frequencies
from samii_rig.model.realise import realise
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig, elements
from samii_rig.rig.schema.elements import AXIAL, TURNING, input_unit, quantities
from samii_rig.safety.limits import gate_limits

F = np.geomspace(0.3, 120.0, 30)
KINDS = {
    word: kind
    for kind in (*AXIAL, *TURNING, elements.Spindle, elements.Inertia)
    for word in kind.model_fields["kind"].annotation.__args__
}
LEAD = 0.005 / (2 * math.pi)  # m/rad, 5 mm a turn


def part(kind: str, name: str = "", **values: float) -> dict[str, Any]:
    units = {symbol: q.unit for symbol, q in quantities(KINDS[kind]).items()}
    out: dict[str, Any] = {"kind": kind, "name": name or kind}
    if "source" in kind:
        out["input"] = "v"
        units["K"] = input_unit(kind, "V")
    for symbol, value in values.items():
        out[symbol] = {"value": value, "unit": units[symbol], "source": "test"}
    return out


def rig(*parts: dict[str, Any], sensor: Any, motion: str = "axial", **more: Any) -> Rig:
    return Rig.model_validate(
        {
            "name": "test", "motion": motion, "base": "clamped", "tip": "free", "rate_hz": 500.0,
            "element": list(parts), "sensor": sensor,
            "actuator": [{"name": "v", "unit": "V", "low": -1.0, "high": 1.0}], **more,
        }
    )  # fmt: skip


ROTOR = part("inertia", "rotor", I=2e-4)
ANGLE = {"name": "theta", "kind": "absolute_angle", "after": "rotor", "unit": "rad"}
MOMENT = {"name": "M", "kind": "moment", "after": "shaft", "unit": "N m"}
SLIDING = [
    part("spindle", lead=LEAD), part("spring", "nut", k=4e6, c=300.0), part("mass", "table", m=8.0),
    part("ground_damper", c=200.0),
]  # fmt: skip
SENSORS = [
    ANGLE,
    place("displacement", "table", "x"),
    place("acceleration", "table", "a"),
    place("force", "nut", "F"),
]


def drive(kind: str, base: str) -> Rig:
    """A motor, a shaft, a gear, a spindle with a table on a nut that gives."""
    shaft = part("torsional_spring", "shaft", k=60.0, c=0.02)
    motor = {
        "torque_source": part("torque_source", "motor", K=0.3, p=300.0),
        "angular_velocity_source": part("angular_velocity_source", "motor", K=3.0, p=80.0),
    }[kind]
    gear = part("gear", n=3.0)
    bearing = part("torsional_ground_spring", "bearing", k=0.0, c=0.01)
    first = [motor, ROTOR] if kind == "angular_velocity_source" else [ROTOR, bearing, motor]
    more = part("inertia", "pulley", I=5e-5)
    return rig(*first, shaft, gear, more, *SLIDING, sensor=[*SENSORS, MOMENT], base=base)


@pytest.mark.parametrize(
    ("kind", "base"),
    [("torque_source", "free"), ("angular_velocity_source", "clamped")],
)
def test_responses_are_those_of_finite_elements(kind: str, base: str) -> None:
    made = drive(kind, base)
    H, expected = Chain(made).response(F), Fem(made).response(F)
    size = np.maximum(np.abs(expected), 1e-12 * np.abs(expected).max(axis=0) + 1e-30)
    assert np.max(np.abs(H - expected) / size) < 1e-6
    assert realise(made).error.max() < 1e-6


@pytest.mark.parametrize(
    ("kind", "base"),
    [("torque_source", "free"), ("angular_velocity_source", "clamped")],
)
def test_gradients_are_those_of_differences(kind: str, base: str) -> None:
    chain = Chain(drive(kind, base))
    H, dH = chain.gradient(F)
    for i, (key, value) in enumerate(zip(chain.parameters, chain.values(), strict=True)):
        if value == 0.0:
            continue
        step = 1e-5 * value
        more = chain.with_values({key: value + step}).response(F)
        less = chain.with_values({key: value - step}).response(F)
        by_difference = (more - less) / (2 * step)
        # A stiffness that hardly counts is lost in the rounding of a difference.
        size = np.abs(by_difference).max(axis=0) + 1e-3 * np.abs(H).max(axis=0) / abs(value)
        assert np.max(np.abs(by_difference - dH[..., i]) / size) < 1e-6, key


def test_a_spindle_and_a_gear_reflect_inertia_and_stiffness() -> None:
    n, k = 3.0, 60.0
    made = rig(
        part("torsional_spring", "shaft", k=k), ROTOR, part("torque_source", "motor", K=1.0),
        part("gear", n=n), part("spindle", lead=LEAD), part("mass", "table", m=8.0),
        sensor=[ANGLE],
    )  # fmt: skip
    J_all = 2e-4 + 8.0 * (LEAD / n) ** 2
    found = natural_frequencies(made, 1.0, 500.0).hz
    assert found == pytest.approx([math.sqrt(k / J_all) / (2 * math.pi)], rel=1e-8)
    assert Fem(made).modes().omega == pytest.approx([math.sqrt(k / J_all)], rel=1e-8)


def test_a_gear_of_a_turning_chain_has_the_closed_form() -> None:
    made = rig(
        part("angular_velocity_source", "motor", K=3.0, p=80.0), part("gear", n=-4.0),
        part("torsional_spring", "shaft", k=60.0, c=0.02), ROTOR,
        sensor=[ANGLE, {"name": "y", "kind": "relative_angle", "across": ["motor", "gear"],
                        "unit": "rad"}], motion="lateral",
    )  # fmt: skip
    s = 2j * np.pi * F
    turned = 3.0 * 80.0 / (s * (s + 80.0)) / -4.0
    Z = 60.0 + 0.02 * s
    H = Chain(made).response(F)[:, :, 0]
    assert np.allclose(H[:, 1], turned, rtol=1e-12)
    assert np.allclose(H[:, 0], turned * Z / (Z + 2e-4 * s**2), rtol=1e-12)


def test_both_keep_the_symplectic_product_and_the_gate_knows_the_speed() -> None:
    for e in drive("angular_velocity_source", "clamped").element:
        if e.kind in ("gear", "spindle"):
            U = matrix(e, np.array([1j]))[0, :4, :4]
            assert np.allclose(U.T @ J @ U, J, rtol=0, atol=1e-12)
    made = drive("angular_velocity_source", "clamped")
    assert gate_limits(made, "v", 1.0, "x").turning == pytest.approx(3.0 / 3.0 * LEAD)
    assert gate_limits(made, "v", 1.0, "theta").turning == 3.0


@pytest.mark.parametrize(
    ("parts", "sensor", "says"),
    [
        ((part("spindle", lead=LEAD), part("mass", m=1.0)), ANGLE, "nothing turns before it"),
        (
            (part("mass", m=1.0), part("spring", k=1.0), part("spindle", lead=LEAD)),
            ANGLE,
            "element spring: kind 'spring' before the spindle, where the chain turns; expected one",
        ),
        ((ROTOR, *SLIDING), {**ANGLE, "after": "table"}, "which does not turn there"),
        ((ROTOR, *SLIDING), place("force", "rotor"), "kind 'force' before the spindle, where the"),
        ((ROTOR, part("spindle", lead=0.0)), ANGLE, "lead is 0; expected another number"),
        (
            (ROTOR, part("spindle", "one", lead=LEAD), part("spindle", "two", lead=LEAD)),
            ANGLE,
            "element two: kind 'spindle' of a chain with motion 'axial'; expected one of mass",
        ),
    ],
)
def test_what_a_spindle_cannot_do_is_one_line(parts: Any, sensor: Any, says: str) -> None:
    first = [] if parts[0]["kind"] == "spindle" else [part("torque_source", "motor", K=1.0)]
    with pytest.raises(ValueError, match=re.escape(says)):
        rig(*first, *parts, sensor=[sensor])
