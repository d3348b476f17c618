"""Forces between a body and the ground: where they may act, and what they drive."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.diagnose.forces.place import EXTRA, Part, parts
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.vocabulary import hypotheses
from samii_rig.errors import InputError
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig

F = np.geomspace(2.0, 200.0, 30)


def strip(mid: float) -> Rig:
    """The strip on a shaker with an accelerometer at `mid` (m) along it, no filter before any."""
    _, text = load_rig("beam_on_shaker")
    text = "\n".join(line for line in text.splitlines() if not line.startswith("antialias"))
    more = f'name = "a_mid"\nkind = "acceleration"\non = "strip"\nposition = {mid}\nunit = "m/s^2"'
    return parse(Rig, text.replace("[[actuator]]", f"[[sensor]]\n{more}\n[[actuator]]"), "strip")


def test_bodies_and_sensors_on_a_beam_are_places() -> None:
    assert list(parts(strip(0.12))) == [
        Part("strip", (), "strip", 0.12),
        Part("tip_mass", ("strip",), "tip_mass"),
    ]


def test_a_body_on_a_spring_to_the_ground_is_held_as_that_holds_it() -> None:
    for name, held in (("cylinder", (True, False)), ("two_masses", (False, False))):
        rig = load_rig(name)[0]
        grounded = [e.kind for e in rig.element if "ground" in e.kind]
        assert any(p.held == held for p in parts(rig)), (name, grounded)


@pytest.mark.parametrize("position", [0.12, None])
def test_a_force_there_moves_what_a_sensor_there_shows(position: float | None) -> None:
    """What drives the force is the way of the very place that it pushes at."""
    rig = strip(0.12)
    place = next(p for p in parts(rig) if p.position == position).to_ground(slides=True)
    wide = place.augmented(rig)
    names, inputs = [x.name for x in wide.sensor], [a.name for a in wide.actuator]
    G = Chain(wide).response(F)
    there = "a_tip" if position is None else "a_mid"
    s2 = -((2 * np.pi * F) ** 2)
    for on in range(len(inputs)):
        shown = G[:, names.index(there), on]
        # The part before a sensor on a beam is no shorter than half a ten-thousandth of it.
        off = np.abs(s2 * G[:, names.index(EXTRA), on] - shown)
        assert np.max(off) < 1e-3 * np.max(np.abs(shown))
    assert np.all(G[:, names.index(EXTRA), inputs.index(EXTRA)] != 0)
    plain = Chain(rig).response(F)
    np.testing.assert_allclose(G[:, : len(rig.sensor), : len(rig.actuator)], plain, rtol=1e-6)


def test_one_part_stands_along_a_beam() -> None:
    rig = strip(0.12)
    along = next(
        e
        for e in hypotheses(rig, 2.0, 200.0)
        if e.physics == "added_mass" and e.site == "strip" and e.pieces
    )
    place = next(p for p in parts(rig) if p.position is not None).to_ground(slides=True)
    with pytest.raises(InputError, match="strip"):
        place.augmented(Model(rig, (along,)).built)
