"""Stated probabilities: evidence counts as it did on trials, and the regression finds how."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from samii_rig.diagnose.fit.stated import ANSWER, PLACE, Evidence, probability, weights
from samii_rig.errors import InputError
from samii_rig.prove.calibrate import FEWEST, balanced, fit, places, row, write
from samii_rig.prove.trial import Hidden, Truth

SURE = Evidence(9.0, 1.0, 1.0, 1, False, False, 200.0, 400.0, 1, False, 1.0)


def test_a_clear_single_effect_is_sure_and_an_ill_fitting_one_is_not_named():
    assert probability(SURE) > 0.8
    assert probability(replace(SURE, left=4.0, held=6.0)) < 0.8
    assert probability(replace(SURE, left=20.0, held=20.0)) < 0.5


def test_a_force_that_time_confirms_is_surer_than_one_that_it_does_not():
    force = replace(SURE, forced=True)
    assert probability(replace(force, confirmed=True)) > probability(force)


@given(st.floats(-20, 20), st.floats(0.5, 1e4), st.floats(0.5, 1e4))
def test_a_probability_is_one_whatever_the_evidence(odds, left, held):
    assert 0 < probability(replace(SURE, odds=odds, left=left, held=held)) < 1


@pytest.mark.parametrize("of", [ANSWER, PLACE])
def test_every_feature_has_its_weight(of):
    assert set(weights(of)) == set(SURE.features())


def drawn(n: int, rng: np.random.Generator) -> list[tuple[Evidence, bool]]:
    rows = []
    for _ in range(n):
        odds, left = rng.uniform(-8, 8), np.exp(rng.uniform(0, 2))
        e = replace(SURE, odds=odds, left=left)
        score = 5.0 * odds / 8 - 3.0 * np.log(left) + 1.0
        rows.append((e, bool(rng.uniform() < 1 / (1 + np.exp(-score)))))
    return rows


def test_the_regression_states_the_frequency_with_which_answers_are_right():
    rng = np.random.default_rng(3)
    w = fit(drawn(3000, rng))
    fresh = drawn(3000, rng)
    stated = np.array([1 / (1 + np.exp(-sum(w[k] * x for k, x in e.features().items())))
                       for e, _ in fresh])  # fmt: skip
    right = np.array([r for _, r in fresh])
    for low in np.arange(0, 1, 0.2):
        inside = (stated >= low) & (stated < low + 0.2)
        assert abs(stated[inside].mean() - right[inside].mean()) < 0.06


def test_too_few_trials_are_refused_in_one_line():
    with pytest.raises(InputError, match=f"at least {FEWEST}"):
        fit(drawn(FEWEST - 1, np.random.default_rng(0)))


def test_an_answer_is_held_against_the_truth_whether_it_was_told_or_not():
    cause = {"physics": "actuator_lag", "site": "v_2", "probability": 0.2, "parameters": {},
             "equivalent_to": [{"physics": "transport_delay", "site": "v_2"}]}  # fmt: skip
    said = {"verdict": "unknown", "causes": [], "sites": [], "fit": {},
            "evidence": {**SURE.plain(), "beyond": False, "causes": [cause]}}  # fmt: skip
    held = row(Truth("one", 1, (Hidden("transport_delay", "v_2"),)), said)
    assert held == (SURE, True)
    assert row(Truth("one", 1, (Hidden("added_mass", "beam"),)), said) == (SURE, False)
    said["evidence"]["causes"] = []
    assert row(Truth("nothing", 1, ()), said) is None


def answered(*names, **told):
    """An answer that names nothing aloud, whose evidence rests on these causes."""
    causes = [
        {"physics": p, "site": s, "probability": 0.2, "parameters": {}, "equivalent_to": []}
        for p, s in names
    ]
    evidence = {**SURE.plain(), "beyond": False, "causes": causes, **told}
    return {"verdict": "unknown", "causes": [], "sites": [], "fit": {}, "evidence": evidence}


def test_a_place_may_be_right_where_the_name_is_not_and_each_cause_counts():
    truth = Truth("one", 1, (Hidden("added_mass", "beam"),))
    said = answered(("added_inertia", "beam"), ("added_mass", "link_1"))
    assert places(truth, said) == [(SURE, True), (SURE, False)]
    assert row(truth, said) == (SURE, False)


@pytest.mark.parametrize("told", [{"beyond": True}, {"drop": 10.0}])
def test_answers_that_rest_on_something_else_calibrate_nothing(told):
    truth = Truth("one", 1, (Hidden("added_mass", "beam"),))
    said = answered(("added_mass", "beam"), **told)
    assert places(truth, said) == []
    assert row(truth, said) is None


def test_weights_are_written_as_they_are_read(tmp_path):
    file = tmp_path / "w.toml"
    write(file, {"one": 0.25, "odds": -3.0}, "from 2 trials")
    assert tomllib.loads(file.read_text()) == {ANSWER: {"one": 0.25, "odds": -3}}
    write(file, {"one": 0.25}, "from 2 trials", {"one": 2.0})
    assert tomllib.loads(file.read_text()) == {ANSWER: {"one": 0.25}, PLACE: {"one": 2.0}}


def test_every_plant_and_style_counts_alike_in_the_regression():
    groups = ["a, cut"] * 300 + ["b, bursts"] * 100
    each = balanced(groups)
    assert each[:300].sum() == pytest.approx(200)
    assert each[300:].sum() == pytest.approx(200)
    # In one group answers are right 9 times in 10, in the other never: 0.45 of both alike.
    rows = [(SURE, i % 10 > 0) for i in range(300)] + [(SURE, False)] * 100
    w = fit(rows, groups)
    score = sum(w[k] * x for k, x in SURE.features().items())
    assert 1 / (1 + np.exp(-score)) == pytest.approx(0.45, abs=0.02)
