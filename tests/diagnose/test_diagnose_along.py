"""Effects at a place along a body: their model, their derivative, and the error of the place."""

import math

import numpy as np
import pytest
from elements_kit import ANGLE, BEAM, SOURCE, part
from elements_kit import rig as made_of
from table_kit import Effects, table_of

from samii_rig.diagnose.fit.intervals import Drawn
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.rigfile import explained, toml
from samii_rig.diagnose.physics.along import Along, stretches
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.rows import PHYSICS
from samii_rig.diagnose.result import Value
from samii_rig.errors import InputError
from samii_rig.fem.model import Fem
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig

LINK = {"L": 0.1, "r": 0.05, "m": 0.3, "I": 0.002}
BAND = (0.5, 40.0)
F = np.geomspace(*BAND, 40)
L = BEAM["L"]
SENSORS = {"a_mid": ("beam", 0.4 * L), "a_end": ("beam", L), "a_link": ("link", 0.08)}


def _acceleration(name: str, on: str, position: float) -> dict[str, object]:
    return {
        "name": name, "kind": "acceleration", "on": on, "position": position, "unit": "m/s^2",
    }  # fmt: skip


def _rig(*elements: dict[str, object], sensors: dict[str, tuple[str, float]]) -> Rig:
    some = [_acceleration(name, *where) for name, where in sensors.items()]
    return made_of(*elements, base="clamped", tip="free", sensor=[ANGLE, *some])


RIG = _rig(
    part("beam", **BEAM, tau=2e-4), SOURCE, part("rigid_link", "link", **LINK), sensors=SENSORS
)
TABLE = Effects(lambda: table_of(RIG, *BAND))
# What stands at a place, values of its unknowns, and the same part in a rig file.
PARTS = {
    "added_mass": ([0.2], part("lumped_mass", "part", m=0.2)),
    "added_inertia": ([0.05], part("lumped_mass", "part", m=0.0, I=0.05)),
    "ground_spring": ([900.0, 0.05], None),
    "viscous_damping": ([7.0], part("translational_ground_spring", "part", k=0.0, c=7.0)),
}
WHERE = {"beam before a sensor": ("beam", 0.25 * L), "beam behind": ("beam", 0.7 * L)}


def effect(physics: str, on: str, position: float, states: tuple[str, str] = ("V", "w")):
    """The effect whose stretch holds this place, and its unknown there."""
    body = next(e for e in RIG.element if e.name == on)
    along = next(a for a in stretches(RIG, body) if a.start < position < a.end)
    found = next(
        e for e in TABLE
        if e.name == (physics, on) and e.jump and e.jump.fixed and e.jump.states == states
        and along.place() in e.jump.place
    )  # fmt: skip
    return found, math.exp((position - along.start) / (along.end - along.start))


def response(found, values: list[float]) -> np.ndarray:
    model = Model(RIG, (found,))
    x = np.append(np.zeros(model.n_nominal), np.log(values))
    return model.plain(x).response(F)


@pytest.mark.parametrize("where", WHERE.values(), ids=WHERE)
@pytest.mark.parametrize("physics", ["added_mass", "added_inertia", "viscous_damping"])
def test_a_part_along_a_beam_is_that_of_the_finite_elements(physics, where) -> None:
    """Against a mesh that has a node there: the beam's own accelerometers read the same."""
    on, position = where
    values, what = PARTS[physics]
    states = ("M", "theta") if physics == "added_inertia" else ("V", "w")
    found, u = effect(physics, on, position, states)
    ours = response(found, [*values, u])
    ends = sorted({position, 0.4 * L, L})
    pieces = [
        part("beam", f"beam_{i}", **{**BEAM, "L": b - a}, tau=2e-4)
        for i, (a, b) in enumerate(zip([0.0, *ends], ends, strict=False))
    ]
    at = ends.index(position) + 1
    sensors = {
        "a_mid": (f"beam_{ends.index(0.4 * L) + 1}", 0.0),
        "a_end": (f"beam_{len(ends) - 1}", ends[-1] - ends[-2]),
        "a_link": ("link", 0.08),
    }
    theirs = Fem(
        _rig(*pieces[:at], what, *pieces[at:], SOURCE, part("rigid_link", "link", **LINK),
             sensors=sensors),
        elements=24,
    ).response(F)  # fmt: skip
    size = np.abs(theirs) + 1e-3 * np.abs(theirs).max(axis=0)
    assert np.max(np.abs(ours - theirs) / size) < 1e-3
    assert np.max(np.abs(ours - Chain(RIG).response(F)) / size) > 0.05


@pytest.mark.parametrize("physics", ["added_mass", "ground_spring", "viscous_damping"])
def test_a_part_on_a_link_is_one_between_two_links(physics) -> None:
    """A massless arm from where the link begins, or the link's own m, r and I, do the same."""
    values = {"added_mass": [0.2], "ground_spring": [900.0, 0.05], "viscous_damping": [7.0]}
    found, u = effect(physics, "link", 0.03)
    ours = response(found, [*values[physics], u])
    told = found.report(np.array([*values[physics], u]))
    own = {
        "added_mass": part("lumped_mass", "part", m=told[0]),
        "ground_spring": part("translational_ground_spring", "part", k=told[0], c=told[1]),
        "viscous_damping": part("translational_ground_spring", "part", k=0.0, c=told[0]),
    }[physics]
    assert told[-1] == pytest.approx(0.03)
    rest = part("rigid_link", "rest", L=0.07, r=0.0, m=0.0, I=0.0)
    first = part("rigid_link", "link", **{**LINK, "L": 0.03})
    two = _rig(
        part("beam", **BEAM, tau=2e-4), SOURCE, first, own, rest,
        sensors={**SENSORS, "a_link": ("rest", 0.05)},
    )  # fmt: skip
    np.testing.assert_allclose(ours, Chain(two).response(F), rtol=1e-9)


@pytest.mark.parametrize("on", ["beam", "link"])
@pytest.mark.parametrize("physics", ["added_mass", "ground_spring", "attached_oscillator"])
def test_the_derivative_by_the_place_is_that_of_differences(physics, on) -> None:
    at = grid(RIG, F, np.arange(4), np.zeros(4, dtype=np.int64))
    body = next(e for e in RIG.element if e.name == on)
    found, u = effect(physics, on, 0.3 * body.L.value)
    model = Model(RIG, (found,))
    values = [u_.middle for u_ in found.unknowns[:-1]]
    x = np.append(np.zeros(model.n_nominal), np.log([*values, u]))
    slope = model.gradient(x, at)[1][:, :, -1]
    step = 1e-4 * np.eye(model.n)[-1]
    differences = (model.response(x + step, at) - model.response(x - step, at)) / 2e-4
    assert np.max(np.abs(slope - differences)) < 1e-5 * np.max(np.abs(differences))


def test_a_material_that_is_not_as_given_is_so_on_both_sides_of_the_part() -> None:
    """A beam with a mass along it and of another density is one beam, in either order."""
    found, u = effect("added_mass", "beam", 0.25 * L)
    dense = next(e for e in TABLE if e.physics == "beam_property" and e.variant == "mu")
    both = Model(RIG, (found, dense))
    x = np.append(np.zeros(both.n_nominal), np.log([0.2, u, 1.3]))
    elements = tuple(
        e.model_copy(update={"mu": e.mu.model_copy(update={"value": 1.3 * e.mu.value})})
        if e.name == "beam" else e
        for e in RIG.element
    )  # fmt: skip
    heavy = Model(RIG.model_copy(update={"element": elements}), (found,))
    y = np.append(np.zeros(heavy.n_nominal), np.log([0.2, u]))
    np.testing.assert_allclose(both.plain(x).response(F), heavy.plain(y).response(F), rtol=1e-9)


@pytest.mark.parametrize("on", ["beam", "link"])
def test_the_rig_file_written_for_it_has_the_part_at_its_place(on) -> None:
    body = next(e for e in RIG.element if e.name == on)
    found, u = effect("ground_spring", on, 0.6 * body.L.value)
    model = Model(RIG, (found,))
    x = np.append(np.zeros(model.n_nominal), np.log([900.0, 0.05, u]))
    some = np.eye(model.n)
    written = parse(Rig, toml(explained(Fitted(model, x, 0.0, 0.0, some, some))), "written")
    np.testing.assert_allclose(
        Chain(written).response(F), response(found, [900.0, 0.05, u]), rtol=1e-6
    )


def test_one_part_along_a_body_is_all_that_is_looked_for() -> None:
    a, _ = effect("added_mass", "beam", 0.25 * L)
    b, _ = effect("ground_spring", "beam", 0.7 * L)
    with pytest.raises(InputError, match="a body with no other part along it"):
        Model(RIG, (a, b))


def test_every_place_of_a_body_belongs_to_one_stretch() -> None:
    beam = next(e for e in RIG.element if e.name == "beam")
    found = list(stretches(RIG, beam))
    assert [(a.start, a.end) for a in found] == [(0.0, 0.4 * L), (0.4 * L, L)]
    assert sum(a.share for a in found) == pytest.approx(1.0)
    assert all(a.position(math.exp(0.5)) == pytest.approx(0.5 * (a.start + a.end)) for a in found)
    assert isinstance(found[0], Along)


def test_a_beam_s_density_is_in_the_table_as_its_stiffness_is() -> None:
    variants = {e.variant for e in TABLE if e.name == ("beam_property", "beam")}
    assert variants == {"EI", "mu"}


def test_an_interval_holds_the_draws_of_both_explanations_or_has_no_end() -> None:
    never = np.zeros(1000, bool)
    here = Drawn(1.0, "kg", np.full(1000, 1.0), never, never)
    there = Drawn(2.0, "kg", np.full(1000, 2.0), never, ~never)
    assert here.interval() == Value(1.0, "kg", 1.0, 1.0)
    assert here.mixed(there, 0.02).interval() == Value(1.0, "kg", 1.0, 1.0)
    assert here.mixed(there, 0.3).interval() == Value(1.0, "kg", 1.0, None)


def test_every_effect_of_the_table_has_a_row_with_its_words() -> None:
    assert {e.physics for e in TABLE} <= PHYSICS.keys()


@pytest.mark.parametrize("states", [("V", "w"), ("M", "theta")])
def test_the_laws_within_a_spring_along_a_beam_are_those_of_its_ends(states) -> None:
    """At the beam's tip it is the spring that the table has there; without its k a damper."""
    spring, _ = effect("ground_spring", "beam", 0.9 * L, states)
    inside = [e for e in TABLE if e.within(spring)]
    assert {"ground_spring", "viscous_damping"} <= {e.physics for e in inside}
    assert not any(e.within(e) or len(e.unknowns) >= len(spring.unknowns) for e in inside)
    k, loss = 900.0, 0.05
    ours = response(spring, [k, loss, math.e])  # the place's unknown where the stretch ends
    ends = [response(e, [k, loss]) for e in inside if e.physics == "ground_spring"]
    off = min(float(np.max(np.abs(ours / end - 1))) for end in ends)
    none = float(np.max(np.abs(ours / Chain(RIG).response(F) - 1)))
    assert off < 0.02 < 0.2 < none  # a place is kept 1e-4 of the body away from its end
