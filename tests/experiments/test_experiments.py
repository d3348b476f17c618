"""Swept sine files: what a plan holds, and one clear line for whatever is wrong in a file."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from experiments_kit import toml
from fake_device import fake_rig
from hypothesis import given
from hypothesis import strategies as st

from experiments.swept_sine import SweptSine
from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig, parse
from samii_rig.run import catalogue, experiments
from samii_rig.run.experiments import fitting, load_experiment, shipped
from samii_rig.run.plan import Experiment

RIG = fake_rig()
GOOD = {
    "experiment": "swept_sine",
    "name": "sweep",
    "actuator": "v",
    "unit": "V",
    "sweep": "logarithmic",
    "start_hz": 0.5,
    "stop_hz": 40.0,
    "duration": 10.0,
    "amplitudes": [0.5, 1.0],
    "repeats": 2,
    "ramp": 0.5,
    "lead_in": 0.2,
    "ring_down": 1.0,
}


def sweep(**changes):
    return parse(SweptSine, toml({**GOOD, **changes}), "sweep.toml")


def test_a_plan_holds_every_level_and_repeat_at_the_rigs_rate():
    plan = sweep().plan(RIG)
    assert [(s.level, s.repeat) for s in plan.segments] == [(0.5, 0), (0.5, 1), (1.0, 0), (1.0, 1)]
    assert {len(s.u) for s in plan.segments} == {5600}
    assert plan.duration == pytest.approx(4 * 11.2)
    assert (plan.kp, plan.centring_sensor, plan.actuator) == (4.0, "theta", "v")
    assert isinstance(sweep(), Experiment)
    for s in plan.segments:
        assert 0.9 * s.level < np.abs(s.u).max() <= s.level
        assert not s.theta_ref.any()
        assert s.band_hz == (0.5, 40.0)


def test_repeats_of_a_level_have_the_very_same_reference():
    a, b, *_ = sweep().plan(RIG).segments
    np.testing.assert_array_equal(a.u, b.u)


def test_driving_the_reference_sweeps_the_set_point_alone():
    plan = sweep(drive="reference", unit="rad", amplitudes=[0.1]).plan(RIG)
    assert not plan.segments[0].u.any()
    assert np.abs(plan.segments[0].theta_ref).max() == pytest.approx(0.1, rel=0.01)
    assert plan.segments[0].unit == "rad"


@pytest.mark.parametrize(
    ("order", "expected"),
    [
        ("by_level", [(0.5, 0), (0.5, 1), (1.0, 0), (1.0, 1)]),
        ("by_repeat", [(0.5, 0), (1.0, 0), (0.5, 1), (1.0, 1)]),
    ],
)
def test_the_order_is_as_asked(order, expected):
    plan = sweep(order=order).plan(RIG)
    assert [(s.level, s.repeat) for s in plan.segments] == expected


@given(seed=st.integers(0, 2**32), repeats=st.integers(1, 5))
def test_a_random_order_is_the_seeds_and_loses_nothing(seed, repeats):
    def done():
        e = SweptSine.model_validate(
            {**GOOD, "order": "random", "seed": seed, "repeats": repeats, "duration": 1.0}
        )
        return [(s.level, s.repeat) for s in e.plan(RIG).segments]

    first = done()
    assert first == done()
    assert sorted(first) == [(a, r) for a in (0.5, 1.0) for r in range(repeats)]
    for level in (0.5, 1.0):
        assert [r for a, r in first if a == level] == list(range(repeats))


def test_a_schedule_lowers_the_level_where_it_says():
    plan = sweep(schedule=[[5.0, 1.0], [10.0, 0.1]], amplitudes=[2.0]).plan(RIG)
    s = plan.segments[0]
    assert np.abs(s.u[s.frequency > 10.0]).max() == pytest.approx(0.2, rel=0.01)
    assert np.abs(s.u[s.frequency < 5.0]).max() == pytest.approx(2.0, rel=0.01)


def test_without_centring_the_loop_is_open():
    rig = RIG.model_copy(update={"centring": None})
    assert sweep().plan(rig).kp == 0.0
    assert sweep(kp=0.0).plan(RIG).kp == 0.0


WRONG_IN_THE_FILE = [
    ({"duration": 0.0}, "duration", "greater than 0"),
    ({"duration": -1.0}, "duration", "greater than 0"),
    ({"amplitudes": [-1.0]}, "amplitudes", "greater than 0"),
    ({"amplitudes": []}, "amplitudes", "at least 1"),
    ({"amplitudes": [1.0, 1.0]}, "amplitudes", "each level once"),
    ({"start_hz": 0.0}, "start_hz", "greater than 0"),
    ({"stop_hz": float("nan")}, "stop_hz", "greater than 0|finite"),
    ({"sweep": "quadratic"}, "sweep", "one of linear, logarithmic"),
    ({"ramp": 6.0}, "", "do not fit"),
    ({"kp": -1.0}, "kp", "0 or more"),
    ({"repeats": 0}, "repeats", "greater than or equal to 1"),
    ({"levels": 3}, "levels", "no such field; expected one of description, "),
    ({"schedule": [[5.0, 1.0], [5.0, 0.5]]}, "", "must increase"),
    ({"schedule": [[5.0, 1.5]]}, "schedule", "less than or equal to 1"),
    ({"schedule": [[5.0, 0.0]]}, "", "needs interpolation"),
    ({"experiment": "torque"}, "experiment", "swept_sine"),
]


@pytest.mark.parametrize(("change", "field", "words"), WRONG_IN_THE_FILE)
def test_what_is_wrong_in_a_file_is_said_in_one_line(change, field, words):
    with pytest.raises(InputError, match=words) as wrong:
        sweep(**change)
    assert "\n" not in str(wrong.value)
    assert "sweep.toml" in str(wrong.value)
    assert field in str(wrong.value)


WRONG_FOR_THE_RIG = [
    ({"actuator": "valve"}, "actuator is 'valve'; expected an actuator of pendulum: v"),
    ({"unit": "count"}, "unit is 'count'; expected 'V', the unit of actuator v"),
    ({"drive": "reference"}, "unit is 'V'; expected 'rad', the unit of sensor theta"),
    ({"drive": "reference", "unit": "rad", "kp": 0.0}, "acts through kp alone"),
    ({"stop_hz": 226.0}, "stop_hz is 226.0; expected at most 225 Hz, 0.45 of the rate"),
    ({"start_hz": 400.0}, "start_hz is 400.0; expected at most 225 Hz"),
    ({"duration": 0.003, "ramp": 0.0}, "expected at least two samples, 0.004 s"),
    ({"duration": 1e9}, "a plan of at most 3 hours"),
]


@pytest.mark.parametrize(("change", "words"), WRONG_FOR_THE_RIG)
def test_what_the_rig_cannot_do_is_said_in_one_line(change, words):
    with pytest.raises(InputError) as wrong:
        sweep(**change).plan(RIG)
    assert words in str(wrong.value)
    assert "\n" not in str(wrong.value)


@pytest.mark.parametrize(
    ("change", "words"), [({"drive": "reference", "unit": "rad"}, "centres"), ({"kp": 1.0}, "kp")]
)
def test_a_rig_that_does_not_centre_cannot_be_asked_to(change, words):
    with pytest.raises(InputError, match=words):
        sweep(**change).plan(RIG.model_copy(update={"centring": None}))


json_like = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.integers(-5, 5),
    lambda x: st.lists(x, max_size=3),
    max_leaves=5,
)


@given(st.dictionaries(st.sampled_from(sorted(GOOD)), json_like, max_size=4))
def test_any_values_give_a_plan_or_one_line(changes):
    try:
        e = SweptSine.model_validate({**GOOD, **changes})
    except ValueError:
        return
    said = ""
    try:
        plan = e.plan(RIG)
    except InputError as wrong:
        said = str(wrong)
    assert "\n" not in said
    assert said or all(np.isfinite(s.u).all() for s in plan.segments)


# Finding files


@pytest.mark.parametrize(
    ("rig", "kind"),
    [
        ("samii", "swept_sine"),
        ("samii_joint_3", "swept_sine_joint_3"),
        ("samii_braced", "swept_sine_braced"),
        ("sflr", "swept_sine_sflr"),
    ],
)
def test_each_rig_has_its_swept_sine(rig, kind):
    loaded, _ = load_rig(rig)
    experiment, text = load_experiment("swept_sine", loaded)
    assert experiment.name == kind
    assert tomllib.loads(text)["experiment"] == "swept_sine"
    assert experiment.plan(loaded).segments


def test_the_shipped_campaign_takes_ten_minutes():
    rig, _ = load_rig("samii")
    plan = load_experiment("swept_sine", rig)[0].plan(rig)
    assert 560 < plan.duration <= 600
    assert len({s.level for s in plan.segments}) == 3
    assert len(plan.segments) == 9


def test_every_shipped_file_is_found_and_loads():
    kinds = {"mode_scan", "multisine", "stepped_sine", "swept_sine", "torque_test"}
    assert set(shipped()) >= {*kinds, "swept_sine_sflr", "swept_sine_samii_braced"}
    for name in shipped():
        load_experiment(name, RIG)


def test_a_rig_is_offered_its_own_variants_and_no_other_s():
    for rig in ("samii", "sflr", "samii_braced"):
        loaded, _ = load_rig(rig)
        offered = fitting(loaded)
        assert not [name for name in offered if "sflr" in name or "samii" in name]
        for name, file in offered.items():
            assert file.read_text("utf-8") == load_experiment(name, loaded)[1]
    assert fitting(load_rig("sflr")[0])["swept_sine"].name == "swept_sine_sflr.toml"


def test_a_file_is_loaded_by_its_path(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(toml(GOOD))
    experiment, text = load_experiment(str(path), RIG)
    assert (experiment.name, text) == ("sweep", toml(GOOD))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "experiment is missing; expected one of mode_scan, multisine"),
        ('experiment = "braced"', "experiment is 'braced'; expected one of mode_scan, multisine"),
        ("experiment = 3", "experiment is 3"),
        ("experiment = ", "valid TOML"),
    ],
)
def test_a_file_of_no_known_experiment_is_said_in_one_line(tmp_path, text, words):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError) as wrong:
        load_experiment(str(path), RIG)
    assert words in str(wrong.value)


def test_a_name_that_is_nothing_lists_what_there_is():
    with pytest.raises(InputError, match="swept_sine"):
        load_experiment("no_such_thing", RIG)


@pytest.mark.parametrize("value", ["math:pi", "samii_rig.rig.schema:Limit"])
def test_an_entry_point_to_something_else_is_refused(monkeypatch, tmp_path, value):
    from importlib.metadata import EntryPoint

    point = EntryPoint("odd", value, catalogue.GROUP)
    monkeypatch.setattr(experiments, "kinds", lambda: {"odd": point})
    monkeypatch.setattr(experiments, "shipped", dict)
    path = tmp_path / "odd.toml"
    path.write_text('experiment = "odd"')
    with pytest.raises(InputError):
        load_experiment(str(path), RIG)
