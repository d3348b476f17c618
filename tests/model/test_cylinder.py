"""The oil in a cylinder against the equations of its chambers, finite elements, differences."""

import numpy as np
import pytest
from axial_kit import axial, part, place

from samii_rig.errors import InputError
from samii_rig.fem.model import Fem
from samii_rig.model.realise import realise
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig

F = np.geomspace(0.3, 150.0, 40)
OIL = {"A_1": 5e-4, "A_2": 3e-4, "V_1": 6e-5, "V_2": 4e-5, "B": 8e8, "leak": 3e-12}
K, P, M, C = 0.016, 380.0, 60.0, 2000.0


def bench(**changes: float) -> Rig:
    """A valve, a cylinder and a mass on a guide; `changes` of the oil."""
    return axial(
        part("velocity_source", "valve", K=K, p=P), part("cylinder", **{**OIL, **changes}),
        part("mass", m=M), part("ground_damper", c=C),
        sensor=[
            place("displacement", "mass", "x"),
            place("force", "cylinder", "F"),
            {"name": "p", "kind": "pressure", "after": "cylinder", "area": 5e-4, "unit": "Pa"},
            *(
                {"name": n, "kind": "pressure", "after": "cylinder", "chamber": i, "unit": "Pa"}
                for i, n in ((1, "p_1"), (2, "p_2"))
            ),
        ],
    )  # fmt: skip


CASES = [{}, {"A_2": 5e-4, "V_2": 6e-5}, {"leak": 0.0}, {"leak": 3e-10}]


@pytest.mark.parametrize("changes", CASES)
def test_the_mass_moves_as_the_equations_of_the_chambers_say(changes: dict[str, float]) -> None:
    p = {**OIL, **changes}
    s = 2j * np.pi * F
    # States x, x', p_1, p_2, and the flow into chamber 1 over A_1, with u = 1.
    flow = K * P / (s + P)
    expected = np.zeros((F.size, 5), complex)
    for i, at in enumerate(s):
        leak = p["leak"]
        A = np.array(
            [
                [at, -1.0, 0.0, 0.0],
                [0.0, M * at + C, -p["A_1"], p["A_2"]],
                [0.0, p["A_1"], p["V_1"] / p["B"] * at + leak, -leak],
                [0.0, -p["A_2"], -leak, p["V_2"] / p["B"] * at + leak],
            ]
        )
        b = np.array([0.0, 0.0, p["A_1"] * flow[i], -p["A_2"] * flow[i]])
        x = np.linalg.solve(A, b)
        push = p["A_1"] * x[2] - p["A_2"] * x[3]
        # Tension is negative while it pushes.
        expected[i] = x[0], -push, push / 5e-4, x[2], x[3]
    H = Chain(bench(**changes)).response(F)[:, :, 0]
    assert np.max(np.abs(H - expected) / np.abs(expected)) < 1e-8


@pytest.mark.parametrize("changes", CASES)
def test_finite_elements_and_partial_fractions_agree(changes: dict[str, float]) -> None:
    rig = bench(**changes)
    H = Chain(rig).response(F)
    assert np.max(np.abs(Fem(rig).response(F) - H) / np.abs(H)) < 1e-6
    assert realise(rig).error.max() < 1e-6


def test_gradients_are_those_of_differences() -> None:
    for changes in CASES:
        chain = Chain(bench(**changes))
        H, dH = chain.gradient(F)
        for i, (key, value) in enumerate(zip(chain.parameters, chain.values(), strict=True)):
            if value == 0.0:
                continue
            step = 1e-5 * value
            more = chain.with_values({key: value + step}).response(F)
            less = chain.with_values({key: value - step}).response(F)
            by_difference = (more - less) / (2 * step)
            size = np.abs(by_difference).max(axis=0) + 1e-3 * np.abs(H).max(axis=0) / value
            assert np.max(np.abs(by_difference - dH[..., i]) / size) < 1e-6, key


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("chamber = 1\n", "", "neither area nor chamber; expected area for the load pressure"),
        ("chamber = 1\n", "chamber = 1\narea = 5e-4\n", "area and chamber; expected"),
        ("chamber = 1\n", "chamber = 3\n", "sensor[p_1].chamber"),
        (
            'after = "cylinder"\nchamber = 1',
            'after = "mass"\nchamber = 1',
            "mass is of kind 'mass'; expected a cylinder, which has chambers",
        ),
        (
            'after = "cylinder"\nchamber = 1',
            'after = "mass"\narea = 5e-4',
            "mass is of kind 'mass'; expected a cylinder, or the velocity source that stands for",
        ),
    ],
)
def test_a_pressure_of_no_chamber_is_refused_in_a_line(old: str, new: str, said: str) -> None:
    _, text = load_rig("cylinder")
    assert text.count(old) == 1
    with pytest.raises(InputError) as caught:
        parse(Rig, text.replace(old, new), "cylinder.toml")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
