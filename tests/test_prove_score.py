"""The proof's score says what happened, on trials made up so that the right figures are known.

Plan: single trials are judged right or wrong as a person would; frequencies carry Wilson's
interval; a diagnosis that states honest probabilities has a small calibration error and one
that boasts has a large one; intervals that cover nine in ten score nine in ten.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from prove_kit import MASS, NOTHING, SPRING, UNKNOWN, diagnosis, trial

from samii_rig.prove.score import auroc, by_size, confusion, frequency, median, scores
from samii_rig.prove.size import bearers
from samii_rig.prove.trial import Answer, Trial


def test_a_name_is_right_at_its_place_or_up_to_its_class() -> None:
    assert trial("one", diagnosis("named", (*SPRING, 0.9)), SPRING).right
    elsewhere = trial("one", diagnosis("named", (SPRING[0], "clamp", 0.9)), SPRING)
    assert not elsewhere.right
    assert not elsewhere.place_right
    twin = diagnosis("ambiguous", (SPRING[0], "clamp", 0.9), twins=(SPRING,))
    assert trial("one", twin, SPRING).right
    assert trial("one", twin, SPRING).place_right


def test_abstaining_on_an_effect_is_a_miss_but_may_know_the_place() -> None:
    silent = trial("one", UNKNOWN, SPRING)
    assert not silent.right
    assert silent.place_right
    assert silent.confidence == 0.0
    assert not trial("one", NOTHING, SPRING).right
    assert trial("nothing", NOTHING).right


def test_a_site_has_as_many_names_as_the_effect_has_structural_twins() -> None:
    silent = {**UNKNOWN, "sites": [{"site": "link_1", "probability": 0.7}]}
    told = trial("one", silent, SPRING)
    assert not told.place_right
    assert not told.place_in_set
    known = replace(told, truth=replace(told.truth, twins=("link_1",)))
    assert known.place_right
    assert known.place_in_set


def test_names_count_as_the_fewest_effects_that_bear_them() -> None:
    between = {("compliance", "clamp"), ("compliance", "beam")}
    alone, other = {("compliance", "clamp")}, {("mass", "beam")}
    effects = [alone, between, other]
    assert bearers(between, effects) == [1]
    assert bearers(between | other, effects) == [1, 2]
    assert bearers({("lag", "v")}, effects) == []
    assert bearers(between, []) == []


def test_two_effects_need_two_names_and_no_third() -> None:
    both = diagnosis("named", (*SPRING, 0.9), (*MASS, 0.8))
    assert trial("two", both, MASS, SPRING).right
    assert not trial("two", diagnosis("named", (*SPRING, 0.9)), SPRING, MASS).right
    three = diagnosis("named", (*SPRING, 0.9), (*MASS, 0.8), ("added_mass", "link_1", 0.8))
    assert not trial("two", three, SPRING, MASS).right


def test_the_set_of_sites_holds_nine_tenths() -> None:
    data = diagnosis("named", ("a", "x", 0.6), ("b", "y", 0.35), ("c", "z", 0.05))
    assert Answer.of(data).site_set() == ("x", "y")
    several = diagnosis("named", ("a", "x", 0.95), ("b", "y", 0.9), ("c", "z", 0.05))
    assert Answer.of(several).site_set() == ("x", "y")


@pytest.mark.parametrize(("hits", "n"), [(0, 300), (3, 300), (95, 100), (10, 10)])
def test_a_frequency_lies_in_its_interval_and_never_beyond_certainty(hits: int, n: int) -> None:
    s = frequency("x", [True] * hits + [False] * (n - hits))
    assert 0 <= s.low <= s.value <= s.high <= 1
    assert s.high - s.low > 0


def test_wilson_covers_nine_times_in_ten() -> None:
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(2000):
        s = frequency("x", list(rng.random(200) < 0.1))
        inside += s.low <= 0.1 <= s.high
    assert 0.87 < inside / 2000 < 0.93


def test_the_interval_of_a_median_covers_nine_times_in_ten() -> None:
    rng = np.random.default_rng(4)
    inside = 0
    for _ in range(2000):
        s = median("x", list(rng.exponential(size=51)))
        inside += s.low <= math.log(2) <= s.high
    assert 0.88 < inside / 2000 < 0.95


def test_auroc_of_separate_and_of_equal_scores() -> None:
    assert auroc([2, 3], [0, 1]) == 1.0
    assert auroc([1, 1], [1, 1]) == 0.5
    assert math.isnan(auroc([], [1]))


def _many(boast: float) -> list[Trial]:
    rng = np.random.default_rng(5)
    out = []
    for p in rng.uniform(0.5, 1.0, 2000):
        site = "joint_1" if rng.random() < p else "clamp"
        stated = min(1.0, p + boast)
        out.append(trial("one", diagnosis("named", (SPRING[0], site, stated)), SPRING))
    return out


def test_honest_probabilities_score_low_and_boasting_ones_high() -> None:
    def error(trials: list[Trial]) -> float:
        return next(s.value for s in scores(trials) if "calibration" in s.what)

    assert error(_many(0.0)) < 0.03
    assert error(_many(0.2)) > 0.1


def test_scores_meet_and_miss_their_goals() -> None:
    found = {s.what: s for s in scores([trial("nothing", NOTHING)] * 300)}
    assert found["false alarms where nothing is missing"].met
    alarmed = [trial("nothing", UNKNOWN)] * 10 + [trial("nothing", NOTHING)] * 290
    found = {s.what: s for s in scores(alarmed)}
    assert found["false alarms where nothing is missing"].met is False
    assert found["two effects: both found"].met is None


def test_sizes_and_confusion_count_every_single_effect_once() -> None:
    trials = [
        trial("one", diagnosis("named", (*SPRING, 0.9)), SPRING, size=s) for s in (1, 5, 20, 200)
    ]
    assert [rows[0].n for _, rows in by_size(trials)] == [1, 1, 1, 0, 1]
    assert confusion(trials) == {(SPRING[0], SPRING[0]): 2}
    wrong = trial("one", diagnosis("named", (SPRING[0], "clamp", 0.9)), SPRING)
    assert confusion([wrong]) == {(SPRING[0], "torsional_compliance, elsewhere"): 1}


def test_a_class_is_held_against_the_names_that_the_data_cannot_tell_apart() -> None:
    right = trial("one", diagnosis("named", (*SPRING, 0.9)), SPRING, size=50)
    truth = replace(right.truth, names=2, sites=1, said=3)
    found = {s.what: s for s in scores([replace(right, truth=truth)] * 5)}
    assert found["names in a class over those an oracle would give, from 10 sigma"].value == 1.5
    assert found["sites in the 90 % set over those an oracle would give, from 10 sigma"].value == 1


def test_every_joint_has_to_come_back_and_nothing_beside() -> None:
    names = (SPRING, MASS)
    all_ = trial("joints", diagnosis("named", *((*n, 0.9) for n in names)), *names)
    less = trial("joints", diagnosis("named", (*SPRING, 0.9)), *names)
    found = {s.what: s for s in scores([all_, less])}
    assert found["every joint gives: all found"].value == 0.5
