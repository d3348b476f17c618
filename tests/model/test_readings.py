"""Strain gauges and motor currents against statics, equations of motion, finite elements, the
second plant and differences."""

import numpy as np
import pytest
from axial_kit import axial, part, place

from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.along import cut, stretches
from samii_rig.errors import InputError
from samii_rig.fem.model import Fem
from samii_rig.fem.reduce import reduce
from samii_rig.model.modes import natural_frequencies
from samii_rig.model.realise import realise
from samii_rig.model.shapes import mode_shape
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import parse
from samii_rig.rig.schema import LumpedMass, Rig
from samii_rig.types import Float
from sim.assumed_modes.parts import setup_of
from sim.assumed_modes.plant import plant

F = np.geomspace(0.3, 120.0, 40)
EI, MU, L, AT, HEIGHT = 5.0, 0.62, 0.5, 0.07, 1e-3
GAUGED = f"""
name = "beam"
base = "clamped"
tip = "free"
rate_hz = 500.0
[[element]]
name = "motor"
kind = "angular_velocity_source"
input = "v"
K = {{ value = 1.0, unit = "rad/(s V)", source = "test" }}
p = {{ value = 80.0, unit = "rad/s", source = "test" }}
[[element]]
name = "beam"
kind = "beam"
EI = {{ value = {EI}, unit = "N m^2", source = "test" }}
mu = {{ value = {MU}, unit = "kg/m", source = "test" }}
L = {{ value = {L}, unit = "m", source = "test" }}
DAMPING
[[sensor]]
name = "e"
kind = "strain"
on = "beam"
position = {AT}
height = {HEIGHT}
unit = "m/m"
[[sensor]]
name = "e_root"
kind = "strain"
on = "beam"
height = -1.0
unit = "um/m"
[[sensor]]
name = "i"
kind = "current"
of = "motor"
constant = 0.1
unit = "mA"
[[actuator]]
name = "v"
unit = "V"
low = -10.0
high = 10.0
[device]
driver = "simulated"
"""
TAU = 'tau = { value = 4e-4, unit = "s", source = "test" }'
ETA = 'eta = { value = 0.02, unit = "1", source = "test" }'
TIMOSHENKO = (
    'GA = { value = 3e4, unit = "N", source = "test" }\n'
    'J = { value = 1e-4, unit = "kg m", source = "test" }\n' + TAU
)


def gauged(damping: str = "") -> Rig:
    text = GAUGED.replace("DAMPING", damping)
    if "GA" in damping:
        text = text.replace('kind = "beam"', 'kind = "timoshenko_beam"')
    return parse(Rig, text, "beam.toml")


def by_differences(rig: Rig, f: Float) -> float:
    """How far the gradient is off differences, over its size."""
    chain, worst = Chain(rig), 0.0
    H, dH = chain.gradient(f)
    assert np.array_equal(H, chain.response(f))
    for i, (key, value) in enumerate(zip(chain.parameters, chain.values(), strict=True)):
        step = 1e-5 * value if value else 1e-6
        more = chain.with_values({key: value + step}).response(f)
        less = chain.with_values({key: max(value - step, 0.0)}).response(f)
        found = (more - less) / (value + step - max(value - step, 0.0))
        size = np.abs(found).max(axis=0) + 1e-3 * np.abs(H).max(axis=0) / max(value, 1e-3)
        if value:
            worst = max(worst, float(np.max(np.abs(found - dH[..., i]) / size)))
    return worst


def test_a_beam_that_is_turned_slowly_bends_by_its_own_inertia() -> None:
    # Each piece needs the force mu s^2 x theta, whose moment at a is mu s^2 theta (L^3/3 - a L^2/2
    # + a^3/6), against theta; so far below the first mode.
    f = np.array([0.01])
    s = 2j * np.pi * f[0]
    theta = 80.0 / (s * (s + 80.0))
    lever = L**3 / 3 - AT * L**2 / 2 + AT**3 / 6
    bend = -MU * s**2 * theta * lever / EI
    torque = MU * s**2 * theta * L**3 / 3
    H = Chain(gauged()).response(f)[0, :, 0]
    assert H[0] == pytest.approx(-HEIGHT * bend, rel=1e-5)
    assert H[1] == pytest.approx(-MU * s**2 * theta * L**3 / 3 / EI, rel=1e-5)
    assert H[2] == pytest.approx(torque / 0.1, rel=1e-5)


@pytest.mark.parametrize("damping", ["", TAU, ETA, TIMOSHENKO])
def test_gauges_and_current_agree_with_finite_elements(damping: str) -> None:
    rig = gauged(damping)
    H = Chain(rig).response(F)
    size = np.abs(H).max(axis=0)
    off = [np.max(np.abs(Fem(rig, elements=n).response(F) - H) / size, axis=0) for n in (10, 40)]
    # A curvature inside an element is less exact than its motion: it falls with h^2, to a 16th.
    # From 80 elements on rounding, which grows with h^-4, hides that.
    assert np.max(off[1][:2]) < 2e-5
    assert np.all(off[1][:2] < 0.1 * off[0][:2])
    assert off[1][2, 0] < 1e-5
    assert by_differences(rig, F) < 2e-5
    if damping:  # without damping the moment of the modes left out is missing
        assert realise(rig).error.max() < 1e-5


def test_the_second_plant_reads_the_same() -> None:
    rig = gauged(TAU)
    p = plant(setup_of(rig, {}))
    s = 2j * np.pi * F[F < 60.0]
    G = np.stack([p.C @ np.linalg.solve(x * np.eye(len(p.A)) - p.A, p.B) + p.D for x in s])
    H = Chain(rig).evaluate(s)
    assert np.max(np.abs(G - H) / np.abs(H).max(axis=0)) < 1e-5


def test_a_mode_shows_each_gauge_what_it_shows_in_a_response() -> None:
    rig = gauged()
    hz = natural_frequencies(rig, 1.0, 100.0).hz[0]
    readings = mode_shape(rig, hz).readings
    near = Chain(rig).response([hz * (1 + 1e-7)])[0, :, 0]
    assert readings["e"] / readings["e_root"] == pytest.approx(near[0] / near[1], rel=1e-5)
    assert readings["i"] / readings["e_root"] == pytest.approx(near[2] / near[1], rel=1e-5)


def pushed() -> Rig:
    """A voice coil that shakes a mass on a spring."""
    return axial(
        part("spring", k=2000.0, c=5.0), part("mass", m=0.8), part("force_source", K=4.0, p=300.0),
        sensor=[
            place("displacement", "mass"),
            {"name": "i", "kind": "current", "of": "force_source", "constant": 8.0, "unit": "A"},
        ],
    )  # fmt: skip


def test_the_current_of_what_pushes_is_its_force_over_its_constant() -> None:
    rig, s = pushed(), 2j * np.pi * F
    H = Chain(rig).response(F)[:, :, 0]
    force = 4.0 / (1 + s / 300.0)
    assert H[:, 1] == pytest.approx(force / 8.0, rel=1e-12)
    assert H[:, 0] == pytest.approx(force / (0.8 * s**2 + 5.0 * s + 2000.0), rel=1e-9)
    assert Fem(rig).response(F)[:, :, 0] == pytest.approx(H, rel=1e-9)
    assert reduce(Fem(rig), 1).response(F)[:, :, 0] == pytest.approx(H, rel=1e-9)
    assert by_differences(rig, F) < 1e-5
    p = plant(setup_of(rig, {}))
    G = np.stack([p.C @ np.linalg.solve(x * np.eye(len(p.A)) - p.A, p.B) + p.D for x in s])
    assert G[:, :, 0] == pytest.approx(H, rel=1e-9)


def test_a_gauge_stays_where_it_is_when_a_part_is_looked_for_along_its_beam() -> None:
    rig = gauged(TAU)
    beam = next(e for e in rig.element if e.name == "beam")
    nothing = LumpedMass(kind="lumped_mass", name="nothing", m=insert.parameter(0.0, "kg"))
    ways = list(stretches(rig, beam))
    assert [(w.start, w.end) for w in ways] == [(0.0, AT), (AT, L)]
    for way in ways:
        cut_there = Chain(cut(rig, way, nothing)).response(F)
        assert cut_there == pytest.approx(Chain(rig).response(F), rel=1e-7)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("position = 0.07", "position = 0.5", "position 0.5 m is not on beam; expected less than"),
        ("height = 0.001", "height = 0.0", "expected the distance from the neutral fibre"),
        ('on = "beam"\nposition', 'on = "motor"\nposition', "expected a beam"),
        ('of = "motor"', 'of = "beam"', "is of kind 'beam'; expected a source"),
        ('unit = "mA"', 'unit = "V"', "is 'V'; expected 'A'"),
    ],
)
def test_what_no_gauge_or_motor_can_be_is_refused_in_a_line(old: str, new: str, said: str) -> None:
    text = GAUGED.replace("DAMPING", "")
    assert text.count(old) == 1
    with pytest.raises(InputError) as caught:
        parse(Rig, text.replace(old, new), "beam.toml")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
