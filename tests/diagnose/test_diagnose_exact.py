"""Lengths of the rig file that are wrong, and have no tolerance.

Plan: a strip of 0.30 m held against a file that says 0.45 m; the file as it should be; a mass that
one effect explains is no length; two links of SAMII that are longer in the file; a table for a link
that has hardly any inertia about its middle.
"""

from __future__ import annotations

import pytest
from sweep_kit import swept
from table_kit import table_of

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit.exact import _exact
from samii_rig.diagnose.result import Diagnosis
from samii_rig.report.diagnosis.words import banner
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig, parameters
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

RIG, TOML = load_rig("beam_on_shaker")
PHYSICS = ("added_mass", "beam_property")


@pytest.fixture(scope="module")
def run() -> Recording:
    return swept(RIG, 1.0, repeats=3, duration=10.0, ring_down=3.0, actuator="v")


def found_by(toml: str, run: Recording) -> Diagnosis:
    rig = parse(Rig, toml, "the rig file")
    few = table_of(rig, 0.8, 35.0, *PHYSICS)
    return diagnose(estimate([run]), rig, runs=[run], effects=few)


def test_a_length_that_is_wrong_in_the_rig_file_is_told_with_the_right_one(run):
    assert tuple(_exact(RIG)) == ("strip",)
    found = found_by(TOML.replace("value = 300.0", "value = 450.0"), run)
    assert found.verdict == "unknown"
    (wrong,) = found.exact
    assert wrong.parameter == "strip.L"
    assert wrong.stated == pytest.approx(0.45)
    assert wrong.value.low < 0.3 < wrong.value.high
    assert wrong.value.value == pytest.approx(0.3, rel=0.03)
    assert found.with_causes[1] < 1.3 < found.nominal[1]
    assert found.lines()[0].startswith("A number of the rig file is wrong: strip.L = 0.")
    assert [one["parameter"] for one in found.plain()["exact"]] == ["strip.L"]
    assert banner(found).title == "A number of the rig file is wrong"
    strip = next(e for e in found.rig.element if e.name == "strip")
    assert parameters(strip)["L"].value == wrong.value.value


@pytest.mark.parametrize("tip", [20.0, 40.0])  # g in the file; 20 on the rig
def test_no_length_is_blamed_for_what_one_effect_explains_or_for_nothing(run, tip):
    found = found_by(TOML.replace("value = 20.0, unit", f"value = {tip}, unit"), run)
    assert found.exact == ()
    assert found.verdict == "no_mismatch" if tip == 20.0 else "named"


SAMII, SAMII_TOML = load_rig("samii")
LONGER = {
    "link_1": ("value = 0.1969", "value = 0.25"),
    "link_2": ("value = 0.4001", "value = 0.48"),
}


def longer(*links: str) -> Rig:
    toml = SAMII_TOML
    for link in links:
        assert toml.count(LONGER[link][0]) == 1
        toml = toml.replace(*LONGER[link])
    return parse(Rig, toml, "the rig file")


def test_a_link_with_hardly_any_inertia_about_its_middle_has_a_table():
    names = {e.name for e in table_of(longer("link_2"), 0.8, 35.0)}
    assert ("added_mass", "link_2") in names


@pytest.mark.slow  # a minute of a core: modes of SAMII that both lengths move
def test_two_lengths_that_are_wrong_are_told_together():
    assert tuple(_exact(SAMII)) == ("link_0", "link_1", "link_2", "link_3_6")
    run = swept(SAMII, 0.5, repeats=3, duration=10.0, ring_down=8.0)
    rig = longer("link_1", "link_2")
    few = [e for e in table_of(rig, 0.8, 35.0) if e.name == ("added_mass", "link_0")]
    found = diagnose(estimate([run]), rig, runs=[run], effects=few)
    assert found.verdict == "unknown"
    one, other = found.exact
    assert (one.parameter, other.parameter) == ("link_1.L", "link_2.L")
    for wrong, true in ((one, 0.1969), (other, 0.4001)):
        assert wrong.value.low < true < wrong.value.high
        assert wrong.value.value == pytest.approx(true, rel=2e-3)
    assert found.lines()[0].startswith("Two numbers of the rig file are wrong: link_1.L = 0.1969 m")
    assert "measure link_1.L and link_2.L" in found.lines()[2]
    assert banner(found).title == "Two numbers of the rig file are wrong"
