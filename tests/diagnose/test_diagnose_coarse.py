"""A loop around an encoder whose single step is more than most of its motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from concealed_kit import SAMII_TOML
from cut_kit import DESIGN, cut_sweeps
from table_kit import Effects, table_of

from samii_rig.diagnose.diagnose import case_of, diagnose
from samii_rig.diagnose.fit import record_search
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.physics.vocabulary import hypotheses
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.likelihood.pieces import wiring
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

# Of the joint's encoder; a sweep of 1 V moves it by less than half of that, root mean square.
STEP = 0.1  # rad
FINE = "resolution = 3.834951969714103e-5"
assert FINE in SAMII_TOML
TOML = SAMII_TOML.replace(FINE, f"resolution = {STEP}", 1)
RIG = parse(Rig, TOML, "coarse")
FEW = Effects(lambda: table_of(RIG, 0.5, 40.0, "actuator_lag", "added_mass", "viscous_damping"))
SHORT = replace(DESIGN, levels=(1.0,), burst=20.0, high_hz=20.0)


@pytest.fixture(scope="module")
def nothing(tmp_path_factory: pytest.TempPathFactory) -> list[Recording]:
    return cut_sweeps(tmp_path_factory.mktemp("nothing"), design=SHORT, toml=TOML)


def test_the_encoder_is_left_out_and_the_command_is_what_was_recorded(
    nothing: list[Recording],
) -> None:
    assert 0 < np.std(nothing[0].values_of("theta_2")) < STEP
    assert wiring(nothing, RIG).only.kp > 0
    assert wiring(nothing, RIG, hidden=["theta_2"]).only.kp == 0
    case = case_of(estimate(nothing), RIG, None, FEW, nothing)
    assert case.clean.hidden == {"theta_2"}
    assert case.whole is not None
    assert case.whole.wired.sensors == ("a_0", "a_1", "a_2")
    ((channel, why),) = case.whole.left_out  # no record is
    assert channel == "theta_2"
    assert "so its rounding hides the response" in why
    every = hypotheses(RIG, 0.5, 40.0)
    for aligned in (True, False):
        told = replace(case.clean, aligned=aligned).competing(every)
        assert ("columns_shifted" in {e.physics for e in told}) != aligned
    assert case.clean.aligned  # by the steps that the encoder took
    search = on_records(case)
    assert search is not None
    assert search.ratio(search.nominal.fitted) == pytest.approx(1.0, abs=0.1)


def test_the_nominal_model_is_found_at_some_of_many_lines_and_stands_at_all(
    nothing: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    case = case_of(estimate(nothing), RIG, None, FEW, nothing)
    assert case.whole is not None
    few = case.whole.thinned(500)
    assert 400 < few.lines < 550
    assert few.thinned(200).lines < 220
    k = few.records.lines(few.records.pieces[0]).k
    assert all(np.any(k % n == 0) for n in range(2, 11))  # of any multisine some are excited
    assert case.whole.thinned(case.whole.lines) is case.whole
    low = case.whole.up_to(10.0)
    assert low.of_levels is not None
    assert {high for one in (low.records, low.of_levels) for _, high in one.bands} == {10.0}
    assert replace(case.whole, asked=True).up_to(10.0).lines == case.whole.lines
    at_once = on_records(case)
    monkeypatch.setattr(record_search, "FIRST_LINES", case.whole.lines // 3)
    by_few = on_records(case)
    assert at_once is not None
    assert by_few is not None
    assert isinstance(by_few.whole, Whole)
    # Up to where the response shows: it is driven to 20 Hz.
    (top,) = {high for _, high in by_few.whole.records.bands}
    assert by_few.whole.shown_to(by_few.nominal.fitted, by_few.reduced) == pytest.approx(top, 0.1)
    a, b = at_once.nominal.fitted, by_few.nominal.fitted
    assert b.away(a) < 0.5
    assert by_few.ratio(b) == pytest.approx(at_once.ratio(a), abs=0.02)


def test_nothing_is_found_where_nothing_is_missing(nothing: list[Recording]) -> None:
    found = diagnose(estimate(nothing), RIG, runs=nothing, effects=FEW)
    assert found.verdict == "no_mismatch"
    assert any("which is taken as it was recorded" in said for said in found.not_physics)


def test_what_is_missing_is_named_by_the_other_sensors(tmp_path: Path) -> None:
    runs = cut_sweeps(tmp_path, "actuator_lag joint_2_source p=150", design=SHORT, toml=TOML)
    found = diagnose(estimate(runs), RIG, runs=runs, effects=FEW)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("actuator_lag", "joint_2_source")
    assert found.sigma > 10


def test_an_encoder_that_moves_by_two_steps_hides_no_mass_from_the_other_sensors(
    tmp_path: Path,
) -> None:
    """It moves by more than one step, root mean square. In the loop its rounding took 1.6 times
    the noise for half of it."""
    toml = SAMII_TOML.replace(FINE, "resolution = 0.02", 1)
    rig = parse(Rig, toml, "coarse")
    runs = cut_sweeps(tmp_path, "added_mass link_0 m=3", design=SHORT, toml=toml)
    case = case_of(estimate(runs), rig, None, FEW, runs)
    assert case.clean.hidden == set()
    assert case.whole is not None
    assert "theta_2" in case.whole.wired.sensors
    found = diagnose(estimate(runs), rig, runs=runs, effects=FEW)
    assert found.verdict == "named"
    assert {(c.physics, c.site) for c in found.causes} == {("added_mass", "link_0")}
    assert found.with_causes[1] == pytest.approx(1.0, abs=0.2)
    ((channel, why),) = found.used.left_out
    assert channel == "theta_2"
    assert why.startswith("it moves by 3 of its steps or less")
