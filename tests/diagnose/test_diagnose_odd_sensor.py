"""A sensor that sits elsewhere than the rig file says is told; what moves all of them is not."""

from __future__ import annotations

from identify_kit import drawn, samii

from samii_rig.diagnose.diagnose import case_of
from samii_rig.diagnose.verdict.odd_sensor import odd_sensor
from samii_rig.rig.schema import Rig


def moved(rig: Rig, name: str, by: float) -> Rig:
    """The rig with a sensor so many m farther along its body."""
    sensors = [
        s.model_copy(update={"position": s.position + by}) if s.name == name else s
        for s in rig.sensor
    ]
    return rig.model_copy(update={"sensor": tuple(sensors)})


def told(truth: Rig, seed: int) -> str:
    response = drawn(samii(), seed, truth=truth, relative=0.003)
    return odd_sensor(case_of([response], samii(), None, (), ()))


def test_the_one_that_sits_elsewhere_is_told() -> None:
    for seed, name in enumerate(("a_1", "a_2")):
        assert told(moved(samii(), name, -0.05), seed) == name


def test_none_is_told_where_nothing_is_wrong_or_all_of_them_show_it() -> None:
    assert told(samii(), 2) == ""
    heavier = [
        e.model_copy(update={"k": e.k.model_copy(update={"value": 0.3 * e.k.value})})
        if e.name == "joint_1"
        else e
        for e in samii().element
    ]
    assert told(samii().model_copy(update={"element": tuple(heavier)}), 3) == ""


def test_of_two_that_sit_elsewhere_none_is_told() -> None:
    both = moved(moved(samii(), "a_1", -0.05), "a_2", -0.1)
    assert told(both, 4) == ""
