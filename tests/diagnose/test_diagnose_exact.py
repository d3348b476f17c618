"""A length of the rig file that is wrong, and has no tolerance.

Plan: a strip of 0.30 m held against a file that says 0.45 m; the file as it should be; a mass that
one effect explains is no length.
"""

from __future__ import annotations

import pytest
from sweep_kit import swept

from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.diagnose.fit.exact import lengths
from samii_rig.diagnose.result import Diagnosis
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
    few = [e for e in table(rig, 0.8, 35.0) if e.physics in PHYSICS]
    return diagnose(estimate([run]), rig, runs=[run], effects=few)


def test_a_length_that_is_wrong_in_the_rig_file_is_told_with_the_right_one(run):
    assert lengths(RIG) == ("strip.L",)
    found = found_by(TOML.replace("value = 300.0", "value = 450.0"), run)
    assert found.verdict == "unknown"
    assert found.exact is not None
    assert found.exact.parameter == "strip.L"
    assert found.exact.stated == pytest.approx(0.45)
    assert found.exact.value.low < 0.3 < found.exact.value.high
    assert found.exact.value.value == pytest.approx(0.3, rel=0.03)
    assert found.with_causes[1] < 1.3 < found.nominal[1]
    assert found.lines()[0].startswith("A number of the rig file is wrong: strip.L = 0.")
    assert found.plain()["exact"]["parameter"] == "strip.L"
    strip = next(e for e in found.rig.element if e.name == "strip")
    assert parameters(strip)["L"].value == found.exact.value.value


@pytest.mark.parametrize("tip", [20.0, 40.0])  # g in the file; 20 on the rig
def test_no_length_is_blamed_for_what_one_effect_explains_or_for_nothing(run, tip):
    found = found_by(TOML.replace("value = 20.0, unit", f"value = {tip}, unit"), run)
    assert found.exact is None
    assert found.verdict == "no_mismatch" if tip == 20.0 else "named"
