"""Recordings of two states of a rig, given as if they were of one.

Plan: the same sweep on two rigs whose spring differs, which passes for noise among repeats; on one
rig, with other noise; who is odd among three, though repeats that differ are left out.
"""

from __future__ import annotations

import pytest
from sweep_kit import swept

from samii_rig.diagnose.diagnose import case_of, diagnose, table
from samii_rig.diagnose.fit.agreeing import Apart, states_apart
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

RIG, TOML = load_rig("two_masses")
STIFFER = TOML.replace("value = 12.0", "value = 15.6")  # its first spring by 30 %


def recorded(toml: str, seed: int, name: str) -> Recording:
    return swept(
        parse(Rig, toml, name), 1.0, repeats=3, duration=10.0, ring_down=3.0, seed=seed,
        actuator="v", source=f"{name}.mcap",
    )  # fmt: skip


@pytest.fixture(scope="module")
def runs() -> dict[str, Recording]:
    each = {"one": (TOML, 1), "again": (TOML, 2), "stiffer": (STIFFER, 3)}
    return {name: recorded(*how, name) for name, how in each.items()}


def apart(*runs: Recording) -> Apart | None:
    case = case_of(estimate(runs), RIG, None, None, runs)
    search = on_records(case, None)
    assert search is not None
    return states_apart(search, case.runs, case.clean.samples)


def test_a_spring_that_differs_between_recordings_is_no_cause_that_both_have(runs):
    both = [runs["one"], runs["stiffer"]]
    few = [e for e in table(RIG, 0.8, 35.0) if e.physics in ("attached_oscillator", "added_mass")]
    found = diagnose(estimate(both), RIG, runs=both, effects=few)
    assert found.verdict == "unknown"
    assert found.states == (("one.mcap",), ("stiffer.mcap",))
    assert not found.causes
    assert not found.sites
    what, _, next_ = found.lines()
    assert what.startswith("The recordings are not of one state of the rig")
    assert "stiffer.mcap as if of another state of the rig than one.mcap" in next_
    assert "--before one.mcap --after stiffer.mcap" in next_
    assert found.plain()["states"] == [["one.mcap"], ["stiffer.mcap"]]


def test_recordings_of_one_rig_agree_as_well_as_their_own_noise_lets_them(runs):
    assert apart(runs["one"], runs["again"]) is None
    assert apart(runs["one"]) is None


def test_the_odd_one_of_three_is_told_though_its_repeats_are_foreign_to_the_others(runs):
    found = apart(*runs.values())
    assert found is not None
    assert found.states == (("one.mcap", "again.mcap"), ("stiffer.mcap",))
    assert found.differing > 100
    assert 0.5 < found.part <= 1
