"""The new elements in the simulated rig: poles and residues against the transfer matrices."""

from typing import Any

import numpy as np
import pytest
from elements_kit import BEAM, SOURCE, branch, part, rig

from samii_rig.errors import InputError
from samii_rig.model.realise import Realisation, realise
from samii_rig.model.sampled import (
    feedthrough,
    filter_poles,
    filter_residues,
    filter_response,
    hold_response,
    sampled_response,
    sensor_response,
)
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import AbsoluteAngle, Rig

DAMPED = {**BEAM, "tau": 2e-4}
BODY = part("rigid_link", "body", L=0.1, r=0.05, m=0.3, I=0.002)
JOINT = part("torsional_spring", "joint", k=40.0, c=0.4)
ACROSS = {"name": "theta", "kind": "relative_angle", "across": ["source", "joint"], "unit": "rad"}
TIP = {
    "name": "a",
    "kind": "acceleration",
    "on": "body",
    "position": 0.0,
    "unit": "m/s^2",
    "antialias": {"order": 2, "corner_hz": 100.0},
}
TURN = {"name": "turn", "kind": "absolute_angle", "after": "body", "unit": "rad"}


def deviation(r: Rig, made: Realisation) -> float:
    """Largest relative deviation of the partial fractions from the transfer matrices to 50 Hz."""
    f = np.geomspace(0.1, 50, 60)
    s = 2j * np.pi * f
    filters = np.stack([filter_response(x, s) for x in r.sensor], axis=1)
    exact = Chain(r).response(f) * filters[:, :, None]
    exact = exact * np.exp(s[:, None] * made.late)[:, None, :]
    return float(np.max(np.abs(made.response(f) / exact - 1)))


THICK = part("timoshenko_beam", "thick", EI=3.0, mu=0.2, L=0.7, GA=2e4, J=1e-4, tau=5e-5)
SHORT_LINE = part(
    "hydraulic_line", "line", source="source", D=1e-3, L=1.5, A=1e-3, rho=870.0, B=2e7, R=4e5
)
SECOND = part("angular_velocity_source_2", "source", K=0.5, omega=90.0, zeta=0.5)
CHAINS: dict[str, list[Any]] = {
    "thick beam": [SOURCE, JOINT, THICK, BODY],
    "branch": [
        SOURCE,
        JOINT,
        part("beam", **DAMPED),
        branch(
            part("torsional_spring", "s", k=2.0, c=0.01),
            part("beam", "side_beam", EI=0.3, mu=0.1, L=0.3, tau=2e-4),
        ),
        BODY,
    ],
    "second-order source": [SECOND, JOINT, part("beam", **DAMPED), BODY],
    "springs to ground": [
        SOURCE,
        JOINT,
        part("beam", **DAMPED),
        part("translational_ground_spring", k=30.0, c=0.2),
        part("torsional_ground_spring", k=3.0, c=0.02),
        part("gravity_stiffness", k=0.3),
        BODY,
    ],
    "slide": [
        SOURCE,
        JOINT,
        part("translational_spring", k=900.0, c=2.0),
        part("beam", **DAMPED),
        BODY,
    ],
    "velocity feedback": [
        SOURCE,
        part("torsional_spring", "joint", k=0.0, c=2.0),
        part("beam", **DAMPED),
        BODY,
    ],
    "oil": [SOURCE, part("oil_column", "joint", D=1e-3, C_h=2e-8), part("beam", **DAMPED), BODY],
    "torque": [part("beam", **DAMPED), part("torque_source", "source", K=1.0, p=200.0), BODY],
}


@pytest.mark.parametrize("name", CHAINS)
def test_a_realised_chain_is_the_chain(name: str) -> None:
    sensors = [TIP, TURN] if name == "torque" else [ACROSS, TIP]
    r = rig(*CHAINS[name], base="clamped", tip="free", sensor=sensors)
    made = realise(r)
    assert deviation(r, made) < 2e-4
    assert made.poles.real.max() < 1e-9


def test_a_realised_line_is_the_line() -> None:
    across = {**ACROSS, "across": ["source", "line"]}
    r = rig(
        SOURCE,
        SHORT_LINE,
        part("beam", **DAMPED),
        BODY,
        base="clamped",
        tip="free",
        sensor=[across, TIP],
    )
    assert deviation(r, realise(r)) < 5e-4


def test_a_dead_time_is_a_delay_of_the_input() -> None:
    late = part("angular_velocity_source", "source", K=0.5, p=150.0, tau=3e-3)
    r, at_once = (
        rig(
            s, JOINT, part("beam", **DAMPED), BODY, base="clamped", tip="free", sensor=[ACROSS, TIP]
        )
        for s in (late, SOURCE)
    )
    made = realise(r)
    assert made.late == pytest.approx([3e-3])
    assert deviation(r, made) < 1e-4
    f = np.array([0.5, 5.0, 40.0])
    later = at_once.model_copy(
        update={"actuator": (at_once.actuator[0].model_copy(update={"delay": 3e-3}),)}
    )
    np.testing.assert_allclose(sampled_response(r, f), sampled_response(later, f), rtol=1e-4)


def test_two_dead_times_of_one_input_cannot_be_simulated() -> None:
    late = part("angular_velocity_source", "late", K=0.5, p=150.0, tau=3e-3)
    r = rig(SOURCE, late, part("beam", **DAMPED), base="clamped", tip="free")
    with pytest.raises(InputError, match=r"v: tau is \[0\.0, 0\.003\]; expected one value"):
        realise(r)


def test_gain_and_lag_of_a_sensor_are_in_its_filter() -> None:
    sensor = AbsoluteAngle(
        name="y",
        kind="absolute_angle",
        after="x",
        unit="rad",
        gain=0.9,
        lag=4e-3,
        highpass_hz=0.5,
        antialias={"order": 3, "corner_hz": 90.0},  # type: ignore[arg-type]
    )
    s = np.array([3j, 200j, -5 + 700j])
    ideal = sensor.model_copy(update={"gain": 1.0, "lag": 0.0})
    expected = 0.9 / (1 + 4e-3 * s) * filter_response(ideal, s)
    np.testing.assert_allclose(filter_response(sensor, s), expected, rtol=1e-12)
    fractions = (filter_residues(sensor) / (s[:, None] - filter_poles(sensor))).sum(axis=1)
    np.testing.assert_allclose(fractions, expected, rtol=1e-9)


def test_a_sensor_behind_a_lag_is_realised_and_sampled_with_it() -> None:
    lagging = {**TIP, "antialias": None, "lag": 5e-3, "gain": 1.1}
    r = rig(
        SOURCE, JOINT, part("beam", **DAMPED), BODY, base="clamped", tip="free", sensor=[lagging]
    )
    assert deviation(r, realise(r)) < 1e-4
    f = np.array([0.5, 5.0])
    near = hold_response(f, 500.0) * sensor_response(r.sensor, f)[:, 0]
    H = sampled_response(r, f)[:, 0, 0] / (Chain(r).response(f)[:, 0, 0] * near)
    np.testing.assert_allclose(H, 1.0, atol=0.01)
    assert feedthrough(Chain(r))[0, 0] == 0.0
