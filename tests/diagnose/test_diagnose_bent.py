"""What is missing beyond a joint at rest at an angle, on recordings of the simulated rig."""

from __future__ import annotations

import pytest
from poses_kit import BAND, in_pose, loaded, two_links
from table_kit import Effects, table_of

from samii_rig.diagnose.posed import in_poses
from samii_rig.errors import InputError
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
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("added_mass", "fore")
    assert cause.parameters["m"].value == pytest.approx(0.1, rel=0.05)
    assert found.with_causes[0] < found.threshold < found.chi2_per_dof
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


def test_recordings_of_a_bent_chain_in_several_poses_are_refused_in_one_line() -> None:
    each = [in_pose(RIG, pose, 1, repeats=1) for pose in ("0 deg", "40 deg")]
    with pytest.raises(InputError, match="expected recordings in one pose") as error:
        in_poses(each, RIG, effects=FEW)
    assert "\n" not in str(error.value)
