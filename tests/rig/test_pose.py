"""A rig in another pose: in the rig, and in the text of its file, which a recording keeps."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from poses_kit import two_links

from samii_rig.diagnose.fit.rigfile import toml
from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.pose import at_pose, posed, posed_text, read_pose
from samii_rig.rig.schema import Rig

RIG = two_links()
TABLE = toml(RIG)  # with a table [pose]
BARE = TABLE.replace(TABLE[TABLE.index("[pose]") : TABLE.index("[[element]]")], "")
LINE = BARE.replace(
    "gravity = 9.81", 'gravity = 9.81  # here\npose = { value = 0.5, unit = "rad" }'
)
FILES = {"table": TABLE, "bare": BARE, "line": LINE}


@pytest.mark.parametrize("file", FILES)
@given(degrees=st.floats(-180, 180))
def test_the_text_in_a_pose_is_the_rig_in_it(file, degrees):
    text = f"{degrees:.6g} deg"
    new = posed_text(FILES[file], text)
    assert parse(Rig, new, "new") == posed(RIG, text) == at_pose(RIG, read_pose(text))


@pytest.mark.parametrize("file", FILES)
def test_nothing_but_the_pose_changes_and_it_can_be_changed_again(file):
    once = posed_text(FILES[file], "75 deg")
    assert 'pose = { value = 75.0, unit = "deg" }' in once
    twice = posed_text(once, "0.5 rad")
    assert twice == once.replace('value = 75.0, unit = "deg"', 'value = 0.5, unit = "rad"')
    same = [line for line in FILES[file].splitlines() if "[[" in line or "k = " in line]
    assert [line for line in once.splitlines() if "[[" in line or "k = " in line] == same
    assert ("# here" in once) == (file == "line")


@pytest.mark.parametrize(
    ("text", "said"),
    [("30", "an angle with its unit"), ("1.2.3 deg", "an angle"), ("3 kg", "an angle"), ("", "an")],
)
def test_what_is_no_angle_is_one_line(text, said):
    for ask in (lambda: posed(RIG, text), lambda: posed_text(BARE, text, "pose")):
        with pytest.raises(InputError, match=said) as caught:
            ask()
        assert "\n" not in str(caught.value)


def test_a_rig_without_gravity_has_no_pose():
    rig, text = load_rig("samii")
    for ask in (lambda: posed(rig, "30 deg"), lambda: posed_text(text, "30 deg")):
        with pytest.raises(InputError, match=r"SAMII has no gravity: expected gravity = 9\.81"):
            ask()
