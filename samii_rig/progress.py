"""How far long work is: what is tried, how many of how many, and the time left once it can be said.

    progress("nominal model")                                  # a stage begins
    for draw in counted(draws, progress, "draws"):             # it says 0 of 50, 1 of 50, ...
        ...

Who shows it (`samii_rig.report.summary.working`) asks a `Pace` for the words.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Self, TypeVar

Progress = Callable[[str], None]
T = TypeVar("T")

SOON = 1.0  # s of work before a time left is more than a guess
LEAST = 0.1  # s: the shortest time that is told


class Counted(str):
    """The words of a stage of which `done` of `of` parts are done; a plain text for who shows only
    words. stage : without its count. within : of what the time left is, "" for the whole stage."""

    stage: str
    done: int
    of: int
    at: str
    within: str

    def __new__(cls, stage: str, done: int, of: int, at: str = "", within: str = "") -> Self:
        """at : what is tried now."""
        head = f"{stage}, {within}" if within else stage
        made = super().__new__(cls, f"{head}: {done} of {of}" + (f", {at}" if at else ""))
        made.stage, made.done, made.of, made.at, made.within = stage, done, of, at, within
        return made


def counted(
    parts: Sequence[T],
    progress: Progress,
    stage: str,
    at: Callable[[T], str] = lambda _part: "",
    within: str = "",
) -> Iterator[T]:
    """The parts, one after the other, each said before it is done."""
    for done, part in enumerate(parts):
        progress(Counted(stage, done, len(parts), at(part), within))
        yield part


def ahead(words: str, stage: str) -> str:
    """The same stage, as a part of something larger that is named before it."""
    if isinstance(stage, Counted):
        return Counted(words + stage.stage, stage.done, stage.of, stage.at, stage.within)
    return words + stage


class Pace:
    """The time that is left of what is counted, by what was done since it began."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._what: tuple[str, str, int] = ("", "", 0)
        self._first, self._begun = 0, clock()

    def words(self, stage: str) -> str:
        """The stage, with the time left where it can be said."""
        if not isinstance(stage, Counted):
            return stage
        now, what = self.clock(), (stage.stage, stage.within, stage.of)
        if what != self._what or stage.done < self._first:
            self._what, self._first, self._begun = what, stage.done, now
        done, spent = stage.done - self._first, now - self._begun
        if done < 1 or spent < SOON:
            return str(stage)
        left = duration((stage.of - stage.done) * spent / done)
        return f"{stage}, {left} left" + (" of this round" if stage.within else "")


def duration(seconds: float) -> str:
    """`0.1 s` and less, `7.4 s`, `48 s`, `3 min 20 s`, `1 h 5 min`."""
    whole = round(seconds)
    if whole < 120:
        # Less than a tenth of a second is told to nobody's use.
        return f"{max(seconds, LEAST):.2g} s" if seconds < 9.95 else f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 120:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"
