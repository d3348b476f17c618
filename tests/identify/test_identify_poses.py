"""One set of parameters from recordings in several poses: gravity tells a spring from a weight."""

import numpy as np
import pytest
from elements_kit import part
from gravity_kit import arm, hanging
from identify_kit import drawn

from samii_rig.errors import InputError
from samii_rig.identify.maximum_likelihood import identify
from samii_rig.identify.poses import HANGING, at_pose, given_poses, poses_of, read_pose
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.types import Recording

FREE = ("hinge.k", "arm.m", "arm.I")
POSES = ("0 deg", "75 deg", "3 rad")


def joint() -> Rig:
    """A body on a spring: k + m g r cos(pose) + (I + m r^2) s^2."""
    spring = part("torsional_ground_spring", "hinge", k=40.0, c=0.2)
    return hanging(spring, arm(), pose=0.0, rate_hz=100.0)


def weaker(rig: Rig) -> Rig:
    """The rig with every free parameter wrong."""
    hinge, body = (next(e for e in rig.element if e.name == n) for n in ("hinge", "arm"))
    k = hinge.k.model_copy(update={"value": 30.0})
    m, turned = (p.model_copy(update={"value": v}) for p, v in ((body.m, 2.5), (body.I, 0.2)))
    changed = {
        "hinge": hinge.model_copy(update={"k": k}),
        "arm": body.model_copy(update={"m": m, "I": turned}),
    }
    return rig.model_copy(update={"element": tuple(changed.get(e.name, e) for e in rig.element)})


def test_two_poses_tell_a_spring_a_mass_and_an_inertia_which_one_pose_does_not() -> None:
    rig, poses = joint(), [read_pose(text) for text in POSES]
    seen = [drawn(at_pose(rig, pose), i, n=80, band=(0.1, 5.0)) for i, pose in enumerate(poses)]
    one = identify(seen[:1], weaker(rig), FREE, starts=2, poses=poses[:1])
    assert one.identifiability.weak == 1
    all_ = identify(seen, weaker(rig), FREE, starts=2, poses=poses)
    assert all_.identifiability.weak == 0
    assert all_.fit.holds
    low, high = all_.interval(0.999)
    assert np.all((low < [40.0, 2.0, 0.3]) & (high > [40.0, 2.0, 0.3]))
    assert all_.values == pytest.approx([40.0, 2.0, 0.3], rel=0.02)
    # With one pose for all of them nothing fits.
    assert not identify(seen, weaker(rig), FREE, starts=2).fit.holds


def test_a_bent_arm_has_one_set_of_parameters_in_several_poses() -> None:
    """Each of its parts has its own pose, and the elbow is at another angle in each."""
    elbow = {"name": "bent", "kind": "bend", "angle": {"value": 60.0, "unit": "deg"}}
    spring = part("torsional_ground_spring", "hinge", k=40.0, c=0.2)
    fore = arm("fore", L=0.4, r=0.2, m=0.8, I=0.012)
    wrist = part("torsional_spring", "wrist", k=15.0, c=0.02)
    rig = hanging(spring, arm(), elbow, wrist, fore, pose=0.0, rate_hz=100.0)
    bends = ("", ", bent -20 deg", ", bent 0 deg")
    poses = given_poses(3, rig, [a + b for a, b in zip(POSES, bends, strict=True)])
    seen = [drawn(at_pose(rig, pose), i, n=80, band=(0.1, 5.0)) for i, pose in enumerate(poses)]
    found = identify(seen, weaker(rig), FREE, starts=2, poses=poses)
    assert found.fit.holds
    assert found.values == pytest.approx([40.0, 2.0, 0.3], rel=0.03)
    # With the elbow at one angle in all of them nothing fits.
    alike = given_poses(3, rig, POSES)
    assert not identify(seen, weaker(rig), FREE, starts=2, poses=alike).fit.holds


def blank(rig_toml: str = "") -> Recording:
    empty = np.zeros((0, 0))
    none = np.zeros(0, np.int64)
    return Recording((), 100.0, none, none, empty, empty.astype(np.int64), rig_toml=rig_toml)


def test_a_recording_has_the_pose_of_the_rig_file_that_it_carries() -> None:
    rig, text = load_rig("samii")
    tilted = text.replace(
        'base = "clamped"', 'base = "clamped"\ngravity = 9.81\npose = { value = 30, unit = "deg" }'
    )
    assert tilted != text
    hung = rig.model_copy(update={"gravity": 9.81})
    found = poses_of([blank(tilted), blank(text), blank()], hung, ())
    assert [round(np.degrees(p.value), 9) for p in found] == [30.0, 0.0, 0.0]
    assert poses_of([blank(text)], rig, ()) == [HANGING]
    assert at_pose(rig, HANGING) == rig  # without gravity there is no pose


@pytest.mark.parametrize(
    ("given", "gravity", "said"),
    [
        (["30 deg"], 0.0, "has no gravity"),
        (["30 deg", "60 deg"], 9.81, "one --pose for each of 1 recordings"),
        (["30"], 9.81, "an angle with its unit"),
        (["30 m"], 9.81, "an angle with its unit"),
        (["1.2.3 deg"], 9.81, "an angle with its unit"),
    ],
)
def test_a_wrong_pose_is_refused_in_one_line(given: list[str], gravity: float, said: str) -> None:
    rig = joint().model_copy(update={"gravity": gravity})
    with pytest.raises(InputError, match=said) as error:
        poses_of([blank()], rig, given)
    assert "\n" not in str(error.value)


def test_poses_and_responses_are_as_many() -> None:
    seen = drawn(joint(), n=20, band=(0.1, 5.0))
    with pytest.raises(InputError, match="one for each response"):
        identify([seen], joint(), FREE, poses=[HANGING, HANGING])
