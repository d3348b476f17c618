"""Recordings of two states of a rig, given as if they were of one.

Plan: the same sweep on two rigs whose spring differs, which passes for noise among repeats; on one
rig, with other noise; who is odd among three, though repeats that differ are left out; one side of
two states; one pose of two; responses that were kept without their samples.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from poses_kit import in_pose, loaded, two_links
from poses_kit import recorded as swept_in_pose
from sweep_kit import swept
from table_kit import table_of
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.diagnose.changed import State, changed
from samii_rig.diagnose.diagnose import case_of, diagnose, table
from samii_rig.diagnose.fit.agreeing import Given, SeveralStates, several_states
from samii_rig.diagnose.posed import in_poses
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.verdict import by_record
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.errors import InputError
from samii_rig.identify.poses import at_pose
from samii_rig.record.derived import save_frequency_responses
from samii_rig.record.reader import read_saved_responses
from samii_rig.record.store import write_recording
from samii_rig.report.diagnosis.words import banner
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

RIG, TOML = load_rig("two_masses")
STIFFER = TOML.replace("value = 12.0", "value = 15.6")  # its first spring by 30 %


def recorded(toml: str, seed: int, name: str) -> Recording:
    return swept(
        parse(Rig, toml, name), 1.0, repeats=3, duration=6.0, ring_down=3.0, seed=seed,
        actuator="v", source=f"{name}.mcap",
    )  # fmt: skip


@pytest.fixture(scope="module")
def runs() -> dict[str, Recording]:
    each = {"one": (TOML, 1), "again": (TOML, 2), "stiffer": (STIFFER, 3)}
    return {name: recorded(*how, name) for name, how in each.items()}


def several(*runs: Recording) -> SeveralStates | None:
    case = case_of(estimate(runs), RIG, None, None, runs)
    search = on_records(case)
    assert search is not None
    found = several_states([Given.of(search, case.runs, case.clean.samples)])
    return found[0] if found else None


def test_effects_are_looked_for_where_the_records_reach_and_no_response_does(runs) -> None:
    """Below the first line of a response, where a transient looks the same, whole records say
    something too."""
    one = [runs["one"]]
    case = case_of(estimate(one, band=(5.0, 20.0)), RIG, None, None, one)
    assert case.whole is not None
    low, high = case.whole.records.band
    assert low < 2.0 < 25.0 < high
    hung = next(e for e in case.search.table if e.physics == "attached_oscillator")
    assert hung.unknowns[1].low <= 2 * np.pi * low * (1 + 1e-9)
    assert hung.unknowns[1].high >= 2 * np.pi * high


def test_a_spring_that_differs_between_two_recordings_is_told_at_its_place(runs):
    both = [runs["one"], runs["stiffer"]]
    few = table_of(RIG, 0.8, 35.0, "attached_oscillator", "added_mass")
    found = diagnose(estimate(both), RIG, runs=both, effects=few)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("stiffness_variation", "spring_1")
    spread = cause.parameters["spread"]
    assert spread.low is not None
    assert spread.low < 0.3 / 2**0.5  # of 12 and 15.6 N/m
    assert spread.high is None or spread.high > 0.3 / 2**0.5
    assert "spread" in found.lines()[0]


def test_forces_that_could_not_be_searched_for_are_told(runs, monkeypatch):
    def double(*_):
        raise InputError(RIG.name, "element", "double pole at -42 rad/s", "simple poles")

    monkeypatch.setattr(by_record, "compete_on_records", double)
    one = [runs["one"]]
    found = diagnose(estimate(one), RIG, runs=one, effects=table_of(RIG, 0.8, 35.0, "added_mass"))
    (told,) = [line for line in found.not_physics if "forces that depend on amplitude" in line]
    assert "double pole at -42 rad/s" in told


def test_recordings_of_one_rig_agree_as_well_as_their_own_noise_lets_them(runs):
    assert several(runs["one"], runs["again"]) is None
    assert several(runs["one"]) is None


def test_the_odd_one_of_three_is_told_though_its_repeats_are_foreign_to_the_others(runs):
    found = several(*runs.values())
    assert found is not None
    assert found.states == (("one.mcap", "again.mcap"), ("stiffer.mcap",))
    assert found.differing > 100
    assert 0.5 < found.part <= 1


def between(before: list[Recording], after: list[Recording]) -> Diagnosis:
    few = table_of(RIG, 0.8, 35.0, "added_mass", signed=True)
    states = (State(estimate(runs), runs) for runs in (before, after))
    return changed(*states, RIG, effects=few)


def test_a_state_that_is_two_is_told_before_what_changed(runs):
    one, again, stiffer = (runs[name] for name in ("one", "again", "stiffer"))
    found = between([one], [again, stiffer])
    assert found.verdict == "unknown"
    assert found.states == (("again.mcap",), ("stiffer.mcap",))
    what, _, next_ = found.lines()
    assert what.startswith("The recordings of one of the two states are themselves of several")
    assert "The recordings after differ from each other" in next_
    assert "--before again.mcap --after stiffer.mcap" in next_
    found = between([one, stiffer], [again])
    assert found.states == (("one.mcap",), ("stiffer.mcap",))
    assert "The recordings before differ from each other" in found.lines()[2]


def test_states_of_recordings_that_agree_among_themselves_are_no_others(runs):
    assert between([runs["one"], runs["again"]], [recorded(TOML, 5, "third")]).states == ()


def test_recordings_of_one_pose_that_are_of_two_states_are_told():
    arm = two_links()
    few = [e for e in table(arm, 0.6, 25.0) if e.name == ("added_mass", "upper")]
    hanging, level = in_pose(arm, "0 deg", 1), in_pose(arm, "110 deg", 2)
    assert in_poses([hanging, level], arm, effects=few).states == ()
    heavier = loaded(0.1)(at_pose(arm, level.pose))
    # Two of each: of three one would be left out as foreign, and told.
    runs = [*level.runs, *(swept_in_pose(heavier, seed) for seed in (98, 99))]
    mixed = replace(level, runs=runs, responses=estimate(runs))
    found = in_poses([hanging, mixed], arm, effects=few)
    assert found.verdict == "unknown"
    assert found.states == (("run_20.mcap", "run_21.mcap"), ("run_98.mcap", "run_99.mcap"))
    assert found.lines()[0].startswith("The recordings are not of one state of the rig")
    assert "The recordings in pose 110 deg differ from each other" in found.lines()[2]
    assert banner(found).title == "The recordings are not of one state of the rig"


def test_responses_of_two_states_are_told_without_their_samples(runs, tmp_path):
    paths = []
    for name in ("one", "again", "stiffer"):
        paths.append(tmp_path / f"{name}.mcap")
        save_frequency_responses(paths[-1], estimate([runs[name]]), [], rig_toml=TOML)
    kept = [read_saved_responses(path) for path in paths]
    few = table_of(RIG, 0.8, 35.0, "added_mass")

    def found_by(some):
        files = [(file.source, file.responses) for file in some]
        return diagnose([r for _, own in files for r in own], RIG, effects=few, files=files)

    assert found_by(kept[:2]).states == ()
    found = found_by(kept)
    one, again, stiffer = (str(p) for p in paths)
    assert found.states == ((one, again), (stiffer,))
    assert found.verdict == "unknown"
    assert f"those behind {stiffer}: samii-rig diagnose with --before and --after" in (
        found.experiment
    )
    said = CliRunner().invoke(app, ["diagnose", *map(str, (paths[0], paths[2])), "--json"])
    assert json.loads(said.stdout)["states"] == [[one], [stiffer]]


def test_recordings_of_two_states_are_not_saved_as_one_file(runs, tmp_path):
    for name, run in runs.items():
        write_recording(tmp_path / f"{name}.mcap", run)
    saved = tmp_path / "all.mcap"
    args = ["frf", "--rig", "two_masses", "--save", str(saved)]
    both = [str(tmp_path / f"{name}.mcap") for name in ("one", "stiffer")]
    found = CliRunner().invoke(app, [*args, *both])
    assert isinstance(found.exception, InputError)
    said = str(found.exception)
    assert said.startswith("--save: the recordings are of 2 states of the rig (")
    assert said.endswith("stiffer.mcap); expected those of one in a file")
    assert "\n" not in said
    assert not saved.exists()
    both = [str(tmp_path / f"{name}.mcap") for name in ("one", "again")]
    assert CliRunner().invoke(app, [*args, *both]).exit_code == 0
    assert saved.exists()
