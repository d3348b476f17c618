"""What long work says of itself.

Plan: the time left is that of the pace so far, and is not said before there is a pace; another
round has its own; what is left of all work is that of most such work, first by its size, and no
less than of a part of it; the service tells it once a second.
"""

from __future__ import annotations

import pytest
from states_kit import RIG, effects, recorded

from samii_rig.diagnose.changed import changed
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit.usual import LINES, POSES, RECORDS, STATES, takes
from samii_rig.diagnose.forces import fits
from samii_rig.progress import (
    START,
    Aside,
    Begun,
    Counted,
    Pace,
    ahead,
    counted,
    duration,
    reporting,
)


def test_the_time_left_is_that_of_the_pace_so_far() -> None:
    now = [0.0]
    pace = Pace(lambda: now[0])
    assert pace.words(Counted("trials", 0, 100)) == "trials: 0 of 100"
    now[0] = 100.0
    assert pace.words(Counted("trials", 10, 100, "1 failed")) == (
        "trials: 10 of 100, 1 failed, 15 min left"
    )
    now[0] = 110.0
    assert pace.words(Counted("trials", 20, 100)) == "trials: 20 of 100, 7 min 20 s left"


def test_no_time_is_left_of_what_has_no_pace_yet() -> None:
    now = [0.0]
    pace = Pace(lambda: now[0])
    pace.words(Counted("poles", 0, 3))
    now[0] = 0.5  # too soon for more than a guess
    assert pace.words(Counted("poles", 1, 3)) == "poles: 1 of 3"
    assert pace.words("best of them") == "best of them"


def test_another_round_has_a_pace_of_its_own_and_is_said_to_be_one() -> None:
    now = [0.0]
    pace = Pace(lambda: now[0])
    pace.words(Counted("what is missing", 0, 30, within="round 1"))
    now[0] = 60.0
    assert pace.words(Counted("what is missing", 15, 30, within="round 1")).endswith(
        "round 1: 15 of 30, 60 s left of this round"
    )
    assert "left" not in pace.words(Counted("what is missing", 1, 6, within="round 2"))
    now[0] = 64.0
    assert pace.words(Counted("what is missing", 3, 6, within="round 2")).endswith(
        "round 2: 3 of 6, 6 s left of this round"
    )


def test_who_only_shows_words_has_them_and_a_part_of_more_keeps_its_count() -> None:
    said: list[str] = []
    assert list(counted("ab", said.append, "letters", str.upper)) == ["a", "b"]
    assert said == ["letters: 0 of 2, A", "letters: 1 of 2, B"]
    whole = ahead("before: ", said[1])
    assert isinstance(whole, Counted)
    assert (whole, whole.done, whole.of) == ("before: letters: 1 of 2, B", 1, 2)
    assert ahead("before: ", "nominal model") == "before: nominal model"


@pytest.mark.parametrize(
    ("s", "said"),
    [(0.000293, "0.1 s"), (0.2, "0.2 s"), (7.45, "7.5 s"), (9.97, "10 s"), (48, "48 s"),
     (200, "3 min 20 s")],
)  # fmt: skip
def test_durations_are_said_as_people_say_them(s: float, said: str) -> None:
    assert duration(s) == said


def test_the_time_to_the_end_is_that_of_most_such_work() -> None:
    now = [0.0]
    pace = Pace(lambda: now[0])
    assert pace.words(Begun("nominal model")) == "nominal model"
    now[0] = 90.0  # whatever came before does not count
    assert pace.words(Begun("what is missing", (0.0, 0.0))) == "what is missing"
    now[0] = 100.0
    assert pace.words(Begun("in pairs", (0.5, 4.0))) == "in pairs, 5 s to 40 s to the end"
    pairs = [Counted("in pairs", done, 20, within="round 1") for done in (0, 2, 4)]
    assert pace.words(pairs[0]).endswith("0 of 20, 5 s to 40 s to the end")
    now[0] = 104.0
    # A round that takes longer than the rest usually does is the least that there is to wait.
    assert pace.words(pairs[1]).endswith("36 s left of this round, up to 35 s to the end")
    now[0] = 150.0
    assert pace.words(pairs[2]).endswith("left of this round, longer than most")
    now[0] = 151.0
    assert pace.words(Begun("apart", (0.01, 0.02))) == "apart, up to 1 s to the end"
    assert pace.words(Begun("another search")) == "another search"


def test_the_first_stage_tells_it_by_how_much_there_is_to_do() -> None:
    now = [0.0]
    pace = Pace(lambda: now[0])
    assert takes((0.08, 0.7), 40_000) == pytest.approx((3.2, 28.0))
    assert takes((0.08, 0.7), 10) == (0.5, 1.0)
    first = Begun("nominal model", takes=takes((0.08, 0.7), 100_000))
    assert pace.words(first) == "nominal model, 8 s to 70 s to the end"
    now[0] = 5.0  # and all the way to where there is a pace
    said = "nominal model of whole records, fit 2 of at most 6"
    assert pace.words(said) == f"{said}, 3 s to 65 s to the end"
    assert pace.words(Begun("what is missing", START)).endswith("3 s to 65 s to the end")
    now[0] = 80.0  # a busy machine, of which the size says nothing
    assert pace.words("fit 3") == "fit 3"
    now[0] = 9.0
    assert pace.words(Begun("round 2", (1.0, 5.0))) == "round 2, 4 s to 20 s to the end"


def test_what_is_done_aside_counts_for_nothing() -> None:
    now = [0.0]
    pace = Pace(lambda: now[0])
    pace.words(Begun("nominal model", START, (10.0, 20.0)))
    now[0] = 2.0
    assert pace.words(Aside("compiling the kernels")) == "compiling the kernels"
    now[0] = 32.0
    assert pace.words("fit 1").endswith("fit 1, 8 s to 18 s to the end")
    assert pace.words(Begun("round 2", (2.0, 3.0))) == "round 2, 4 s to 6 s to the end"


def test_a_part_of_more_tells_the_end_of_all_where_that_is_known() -> None:
    usual = {"before: what is missing": (3.0, 9.0)}
    stage = Begun("what is missing", (1.0, 2.0), (5.0, 6.0))
    whole, part = ahead("before: ", stage, whole=True), ahead("before: ", stage, usual=usual)
    assert part == whole == "before: what is missing"
    assert isinstance(part, Begun)
    assert isinstance(whole, Begun)
    assert (part.rest, part.takes) == ((3.0, 9.0), None)
    assert (whole.rest, whole.takes) == ((1.0, 2.0), (5.0, 6.0))
    # What nobody counted leaves what was told.
    assert not isinstance(ahead("before: ", Begun("in pairs", (1.0, 2.0)), usual=usual), Begun)


@pytest.mark.parametrize("several", [False, True])
def test_a_diagnosis_tells_its_end_from_its_first_stage_on(
    several: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one state, and of two while the state before is diagnosed."""
    monkeypatch.setattr(fits, "forces", lambda *_: [])  # the stage has a name without any
    state, said = recorded(0), []

    def say(stage: str) -> None:
        said.append(stage)

    few = effects("added_mass", site="link_1")
    if several:
        changed(state, recorded(1), RIG, effects=few, progress=say)
    else:
        diagnose(state.responses, RIG, runs=state.runs, effects=few, progress=say)
    assert isinstance(said[0], Begun)
    assert said[0].takes is not None
    pace = Pace(iter(0.01 * k for k in range(10**6)).__next__)
    words = [pace.words(stage) for stage in said]
    whole = [w for w in words if "nominal model of whole records" in w]
    assert whole
    before = [w for w in words if w.startswith("before: ")]
    assert bool(before) == several
    for told in (*whole[:1], *before):
        assert told.endswith("to the end")


def test_the_rest_of_a_diagnosis_is_known_at_its_stages() -> None:
    for usual in (RECORDS, LINES, STATES, POSES):
        assert usual[next(iter(usual))] == START
        assert "what cannot be distinguished" in usual
        assert all(0 <= low <= high for low, high in usual.values())


def test_the_service_tells_it_once_a_second_whatever_the_disk_says() -> None:
    now, told = [0.0], []

    def tell(words: str) -> None:
        told.append(words)
        raise OSError("no space")

    say = reporting(tell, lambda: now[0])
    for tenths in range(25):
        now[0] = tenths / 10
        say(Counted("what is missing", tenths, 25))
    assert told[0] == "what is missing: 0 of 25"
    assert len(told) == 3
    assert told[2] == "what is missing: 20 of 25, 0.5 s left"
