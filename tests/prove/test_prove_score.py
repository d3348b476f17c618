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

from samii_rig.prove.score import (
    auroc,
    by_group,
    by_size,
    confusion,
    frequency,
    kept,
    median,
    parameter_errors,
    scores,
)
from samii_rig.prove.trial import Answer, Hidden, Trial, Truth


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


def test_every_joint_has_to_come_back_and_nothing_beside() -> None:
    names = (SPRING, MASS)
    all_ = trial("joints", diagnosis("named", *((*n, 0.9) for n in names)), *names)
    less = trial("joints", diagnosis("named", (*SPRING, 0.9)), *names)
    found = {s.what: s for s in scores([all_, less])}
    assert found["every joint gives: all found"].value == 0.5


def test_a_name_that_the_plant_says_means_the_same_is_right() -> None:
    hidden = Hidden(*SPRING, {"k": 1.0}, frozenset([("torsional_compliance", "link_1")]))
    said = Answer.of(diagnosis("named", ("torsional_compliance", "link_1", 0.9)))
    assert Trial(Truth("one", 1, (hidden,), 50.0), said).right
    assert Trial(Truth("one", 1, (hidden,), 50.0), said).place_right


def test_sigma_kept_is_what_the_causes_explain_of_whole_records() -> None:
    data = {**diagnosis("named", (*SPRING, 0.9)), "evidence": {"sigma": 45.0}}
    one = trial("one", data, SPRING, size=50.0)
    whole = replace(one, truth=replace(one.truth, whole=True))
    assert kept([one, whole]) == [0.9]


def test_a_ratio_is_held_against_the_truth_however_it_is_written() -> None:
    data = diagnosis("named", ("beam_property", "beam", 0.9))
    data["causes"][0]["parameters"] = {"EI ratio": {"value": 1.1, "low": 1.0, "high": 1.2}}
    hidden = Hidden("beam_property", "beam", {"EI_ratio": 1.1})
    assert parameter_errors([Trial(Truth("one", 1, (hidden,), 50.0), Answer.of(data))])[1] == [True]


def test_a_refusal_is_a_miss_and_no_alarm() -> None:
    refused = {"verdict": "refused", "sites": [], "causes": [], "fit": {}, "evidence": {}}
    trials = [trial("one", refused, SPRING), trial("nothing", refused)]
    found = {s.what: s for s in scores(trials)}
    assert found["false alarms where nothing is missing"].value == 0.0
    assert found["name right up to its class, from 10 sigma"].value == 0.0
    assert found["refused, with a reason in one line"].value == 1.0


def test_each_group_has_its_figures() -> None:
    right = trial("one", diagnosis("named", (*SPRING, 0.9)), SPRING)
    wrong = trial("one", diagnosis("named", (*MASS, 0.95)), SPRING)
    trials = [
        replace(t, truth=replace(t.truth, styles=styles))
        for t, styles in ((right, ("cut",)), (right, ("bursts", "hum")), (wrong, ("cut", "hum")))
    ]
    rows = {
        name: {s.what: s for s in some} for name, some in by_group(trials, lambda t: t.truth.styles)
    }
    assert rows["cut"]["name, 10"].value == 0.5
    assert rows["bursts"]["name, 10"].value == 1.0
    assert rows["hum"]["confidently wrong"].value == 0.5


def test_a_diagnosis_that_broke_is_counted_and_a_slow_one_misses() -> None:
    slow = replace(trial("nothing", NOTHING), seconds=40.0)
    found = {s.what: s for s in scores([slow] * 3, failed=1)}
    assert found["no answer, the diagnosis broke"].value == 0.25
    assert found["s of a core, longest"].met is False
    assert found["s of a core where nothing is missing, median"].value == 40.0
