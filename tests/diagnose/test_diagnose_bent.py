"""What is missing beyond a joint at rest at an angle, on recordings of the simulated rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from poses_kit import BAND, in_pose, loaded, named_mass, two_links
from table_kit import Effects, table_of

from samii_rig.diagnose.fit.rigfile import toml
from samii_rig.diagnose.physics.poses import in_pose as in_the_pose
from samii_rig.diagnose.posed import in_poses, same_rig
from samii_rig.errors import InputError
from samii_rig.identify.poses import at_pose, poses_of
from samii_rig.rig.pose import in_words, read_whole_pose
from samii_rig.rig.schema import Rig

KINDS = ("added_mass", "gravity_stiffness", "rigid_ground_spring", "ground_spring")


def bent(angle: float) -> Rig:
    """The arm of two links, its forearm at an angle (deg)."""
    data = two_links().model_dump(exclude_defaults=True)
    elbow = {"name": "bent", "kind": "bend", "angle": {"value": angle, "unit": "deg"}}
    at = [e["name"] for e in data["element"]].index("elbow")
    data["element"] = [*data["element"][:at], elbow, *data["element"][at:]]
    return Rig.model_validate(data)


RIG = bent(60.0)
FEW = Effects(lambda: table_of(RIG, *BAND, *KINDS))


def test_a_mass_beyond_a_bend_has_its_place_and_size() -> None:
    """The bend carries it along, which a mass at its place alone would not tell."""
    found = in_poses([in_pose(RIG, "20 deg", 1, loaded(0.1))], RIG, effects=FEW)
    named_mass(found, 0.1)
    whole = in_poses([in_pose(RIG, "20 deg", 2)], RIG, effects=FEW)
    assert whole.verdict == "no_mismatch"


def test_masses_have_places_of_their_own_where_a_bend_carries_them() -> None:
    level = RIG.model_copy(update={"gravity": 0.0, "pose": None})
    places = {
        kind: {e.jump.place for e in table_of(level, *BAND, kind) if e.jump}
        for kind in ("added_mass", "viscous_damping")
    }
    assert places["added_mass"]
    assert not places["added_mass"] & places["viscous_damping"]


# The arm turned at its base and at its elbow from one pose to the other.
POSES = ("20 deg, bent 60 deg", "80 deg, bent -30 deg")


@pytest.mark.slow  # two whole diagnoses
def test_a_mass_beyond_a_bend_is_found_over_poses_in_which_both_joints_turn() -> None:
    each = [in_pose(RIG, pose, i, loaded(0.1)) for i, pose in enumerate(POSES, 1)]
    found = in_poses(each, RIG, effects=FEW)
    named_mass(found, 0.1)
    assert found.not_physics[0].startswith(
        "one set of parameters in 2 poses (20 deg, bent 60 deg, 80 deg, bent -30 deg)"
    )


def test_a_weight_beyond_a_bend_turns_with_the_bend() -> None:
    weights = table_of(RIG, *BAND, "gravity_stiffness")
    rig = at_pose(RIG, read_whole_pose("30 deg, bent 45 deg", RIG))
    beyond = {e.name: i > 2 for i, e in enumerate(RIG.element)}
    assert {beyond[e.site] for e in weights} == {False, True}
    for effect in weights:
        (hanging,) = effect.parameters(np.array([3.0]), {}).values()
        (posed,) = in_the_pose(effect, rig).parameters(np.array([3.0]), {}).values()
        at = [30.0, 75.0] if effect.site == "elbow" else [75.0 if beyond[effect.site] else 30.0]
        assert any(posed == pytest.approx(hanging * np.cos(np.radians(a))) for a in at)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("30 deg, elbow 20 deg", "a bend and its angle: one of bent"),
        ("30 deg, bent 90 deg", "at least 0.1 deg from a right angle"),
        ("30 deg, bent", 'an angle with its unit, for example "30 deg"'),
    ],
)
def test_a_pose_that_the_chain_cannot_have_is_refused_in_one_line(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        read_whole_pose(text, RIG)
    assert "\n" not in str(error.value)


def test_a_recording_tells_the_pose_of_its_bend_too() -> None:
    """By the rig file that it carries; a rig without that bend is another."""
    turned = at_pose(RIG, read_whole_pose("75 deg, bent 10 deg", RIG))
    run = replace(in_pose(RIG, "20 deg", 1, repeats=1).runs[0], rig_toml=toml(turned))
    (pose,) = poses_of([run], RIG, ())
    assert in_words(pose) == "75 deg, bent 10 deg"
    assert at_pose(RIG, pose) == turned
    assert same_rig(run.rig_toml, RIG)
    with pytest.raises(InputError, match="a bend: one of none"):
        at_pose(two_links(), pose)
