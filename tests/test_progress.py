"""What long work says of itself.

Plan: the time left is that of the pace so far, and is not said before there is a pace; another
round has its own; a diagnosis says what it tries and how many of how many, in each of its stages.
"""

from __future__ import annotations

import pytest

from samii_rig.progress import Counted, Pace, ahead, counted, duration


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
