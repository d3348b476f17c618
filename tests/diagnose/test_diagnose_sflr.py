"""The diagnosis on real recordings: a part taken out of the author's model is put back."""

import pytest

from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.record.importer import import_file
from samii_rig.record.maps import load_map
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate

RIVALS = (
    "torsional_compliance",
    "translational_compliance",
    "added_mass",
    "ground_spring",
    "velocity_feedback",
    "actuator_lag",
    "sensor_delay",
    "beam_property",
)


@pytest.fixture(scope="module")
def responses(recordings):
    files = sorted(recordings.glob("*full-robot*amp-75*"))
    return estimate([import_file(path, load_map("sflr")[0]) for path in files])


def without(rig, name):
    return rig.model_copy(update={"element": tuple(e for e in rig.element if e.name != name)})


def test_the_clamp_that_gives_is_put_back_where_it_was(responses):
    rig = without(load_rig("sflr")[0], "clamp")
    rivals = [e for e in table(rig, 1, 24) if e.physics in RIVALS]
    found = diagnose(responses, rig, band=(1, 24), effects=rivals)
    names = {n for c in found.causes for n in ((c.physics, c.site), *c.equivalents)}
    assert ("torsional_compliance", "base_mass") in names
    assert ("torsional_compliance", "beam") in names
    # The real robot has friction too, which no linear effect explains.
    assert found.verdict in ("named", "ambiguous")
    assert found.gap.value > 0.5
    assert found.gap.low > 0
