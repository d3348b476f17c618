"""The diagnosis on real recordings: a part taken out of the author's model is put back."""

from dataclasses import replace

import pytest

from samii_rig.diagnose.diagnose import case_of, diagnose, table
from samii_rig.record.importer import import_file
from samii_rig.record.maps import load_map
from samii_rig.rig.load import load_rig
from samii_rig.signal.columns import is_aligned, shift_of
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
def runs(recordings):
    files = sorted(recordings.glob("*full-robot*amp-75*"))
    return [import_file(path, load_map("sflr")[0]) for path in files]


@pytest.fixture(scope="module")
def responses(runs):
    return estimate(runs)


def test_the_robot_s_own_loop_tells_that_its_columns_stand_together(runs, responses):
    """So that a lag of the motor is not told as a logger's shift."""
    rig, text = load_rig("sflr")
    made = [replace(run, rig_toml=text) for run in runs]
    assert is_aligned(made)
    assert all(shift_of(run) == 0 for run in made)
    case = case_of(responses, rig, (1, 24), None, made)
    assert "columns_shifted" not in {e.physics for e in case.search.table}


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
