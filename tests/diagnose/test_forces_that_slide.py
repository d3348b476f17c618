"""Forces on springs that slide and against the ground, against the equation of motion itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from samii_rig.diagnose.forces import laws
from samii_rig.diagnose.forces.laws import Force
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.way import Way
from samii_rig.diagnose.physics.effect import Effect, Unknown
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.types import Float

TEXT = load_rig("one_mass")[1]
GUIDED = """
[[element]]
name = "guide"
kind = "ground_damper"
c = { value = 2.0, unit = "N s/m", source = "a guide" }

[[sensor]]
"""
RATE, N = 500.0, 2500
M, K, C, GAIN, CORNER = 1.2, 6000.0, 6.0, 4.0, 2 * np.pi * 120.0
STICKS = 2e-4  # m/s below which the reference's friction turns over


def command() -> Float:
    t = np.arange(N) / RATE
    return np.sin(2 * np.pi * (1.0 + 2.0 * t) * t)


def moved(rig: Rig, force: Force, strengths: tuple[float, ...]) -> Float:
    """(N,) mm that a force adds to x."""
    unknowns = tuple(Unknown(f"p{i}", "1", p / 10, 10 * p, (p,)) for i, p in enumerate(strengths))
    model = ForceModel(rig, (Effect("force", "here", unknowns, force=force),))
    x = np.append(np.zeros(model.n - len(strengths)), np.log(strengths))
    way = Way.of(model, x)
    e = way.force(model, command(), model.numbers(x), model.seeds(x, ()))[0]
    return 1e3 * way.sensed.of(e)[:, 0]


def solved(damping: float, force: str = "", p: float = 0.0) -> Float:
    """(N,) mm by an ordinary solver, sample by sample as the command is held."""
    out, y = np.zeros(N), np.zeros(3)

    def slope(_t: float, y: Float, v: float) -> list[float]:
        x, speed, F = y
        own = -p * np.tanh(speed / STICKS) if force == "friction" else 0.0
        own -= p * x**3 if force == "hardening" else 0.0
        rate = (F - K * x - damping * speed + own) / M
        return [speed, rate, CORNER * (GAIN * v - F)]

    for n, v in enumerate(command()):
        out[n] = y[0]
        y = solve_ivp(slope, (0, 1 / RATE), y, "LSODA", args=(v,), rtol=1e-7, atol=1e-10).y[:, -1]
    return 1e3 * out


@pytest.mark.parametrize(
    ("law", "p", "place", "damping"),
    [
        (laws.FRICTION, 0.1, Place("joint", ("spring",), slides=True), C),
        (laws.HARDENING, 3e8, Place("joint", ("spring",), slides=True), C),
        (laws.FRICTION, 0.1, Place("ground", ("guide",), slides=True), C + 2.0),
    ],
)
def test_a_sliding_force_moves_the_mass_as_newton_says(
    law: laws.Law, p: float, place: Place, damping: float
) -> None:
    text = TEXT if place.kind == "joint" else TEXT.replace("\n[[sensor]]\n", GUIDED, 1)
    rig = parse(Rig, text, "one mass")
    want = solved(damping, law.tag, p) - solved(damping)
    off = moved(rig, Force(place, law), (p,)) - want
    assert np.std(want) > 1e-3
    assert np.std(off) < 0.05 * np.std(want)


def test_a_force_has_the_units_of_its_place() -> None:
    assert Place("joint", ("spring",), slides=True).units == ("N", "m")
    assert Place("joint", ("joint_1",)).units == ("N m", "rad")
