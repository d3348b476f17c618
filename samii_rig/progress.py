"""How far long work is: what is tried, how many of how many, and the time left once it can be said.

    progress("nominal model")                                  # a stage begins
    for draw in counted(draws, progress, "draws"):             # it says 0 of 50, 1 of 50, ...
        ...

Who shows it (`samii_rig.report.summary.working`) asks a `Pace` for the words. Where nobody knows
how many rounds there will be, a stage that begins says how long the rest usually takes (`Begun`):
by how much there is to do at first, then by what was spent.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Self, TypeVar

Progress = Callable[[str], None]
T = TypeVar("T")

SOON = 1.0  # s of work before a time left is more than a guess
LEAST = 0.1  # s: the shortest time that is reported
PERIOD = 1.0  # s between words that are reported elsewhere
START = (0.0, 0.0)  # `Begun.rest` of a first stage, when nothing is spent yet
# From how many s on times to the end are reported in steps of so many.
STEPS = ((600.0, 60.0), (120.0, 30.0), (20.0, 5.0), (0.0, 1.0))


class Begun(str):
    """The words of a stage that begins. rest : from here to the end of all work, over what was
    spent since the first stage that has one: the tenth and the ninetieth percentile of such work;
    None where nobody knows. takes : the same in s of a processor, for work of its size, before
    anything is spent that the rest could be estimated from."""

    rest: tuple[float, float] | None
    takes: tuple[float, float] | None

    def __new__(
        cls,
        stage: str,
        rest: tuple[float, float] | None = None,
        takes: tuple[float, float] | None = None,
    ) -> Self:
        """stage : its words."""
        made = super().__new__(cls, stage)
        made.rest, made.takes = rest, takes
        return made


class Aside(str):
    """What is done once, whatever else is done, as the compilation of kernels: the time until the
    next words are reported is none of the work's."""


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


def ahead(
    words: str,
    stage: str,
    *,
    whole: bool = False,
    usual: Mapping[str, tuple[float, float]] | None = None,
) -> str:
    """The same stage, as a part of something larger that is named before it. whole : whether its
    end is that of all work, too. usual : how long the rest of the larger takes from it on; what is
    not in it is reported as any words are."""
    if isinstance(stage, Counted):
        return Counted(words + stage.stage, stage.done, stage.of, stage.at, stage.within)
    said = words + stage
    if isinstance(stage, Begun) and whole:
        return Begun(said, stage.rest, stage.takes)
    if isinstance(stage, Begun) and usual and said in usual:
        return Begun(said, usual[said])
    return said


class Pace:
    """The time that is left of what is counted, by what was done since it began, and of all, by how
    long such work usually takes."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._what: tuple[str, str, int] = ("", "", 0)
        self._first, self._begun = 0, clock()
        self._all_begun: float | None = None
        self._ends: tuple[float, float] | None = None
        self._by_size = False  # that end is estimated by the work's size alone
        self._aside: float | None = None

    def words(self, stage: str) -> str:
        """The stage, with the time left where it can be said."""
        self._goes_on()
        if isinstance(stage, Aside):
            self._aside = self.clock()
            return str(stage)
        if isinstance(stage, Begun):
            self._begins(stage)
        left = self._left(stage) if isinstance(stage, Counted) else 0.0
        said = str(stage)
        if left:
            of = " of this round" if isinstance(stage, Counted) and stage.within else ""
            said += f", {duration(left)} left{of}"
        return said + self._to_the_end(left)

    def _goes_on(self) -> None:
        """What was done aside is over: it counts for nothing."""
        if self._aside is None:
            return
        took, self._aside = self.clock() - self._aside, None
        self._begun += took
        if self._all_begun is not None:
            self._all_begun += took
        if self._ends is not None:
            low, high = self._ends
            self._ends = low + took, high + took

    def _left(self, stage: Counted) -> float:
        """s of what is counted; 0 where that is not known yet."""
        now, what = self.clock(), (stage.stage, stage.within, stage.of)
        if what != self._what or stage.done < self._first:
            self._what, self._first, self._begun = what, stage.done, now
        done, spent = stage.done - self._first, now - self._begun
        if done < 1 or spent < SOON:
            return 0.0
        return max((stage.of - stage.done) * spent / done, LEAST)

    def _begins(self, stage: Begun) -> None:
        now = self.clock()
        if stage.takes is not None:
            low, high = stage.takes
            self._ends, self._by_size = (now + low, now + high), True
        if stage.rest is None or (stage.rest == START and self._all_begun is not None):
            self._ends = None if stage.takes is None else self._ends
        elif self._all_begun is None:
            self._all_begun = now
        elif (spent := now - self._all_begun) >= SOON:
            low, high = stage.rest
            self._ends, self._by_size = (now + low * spent, now + high * spent), False

    def _to_the_end(self, left: float) -> str:
        """Of all work, no less than is left of a part of it."""
        if self._ends is None:
            return ""
        low, high = (end - self.clock() for end in self._ends)
        if high < left:
            # By the size alone it says as much of a busy machine as of the work.
            return "" if self._by_size else ", longer than most"
        low_, high_ = (duration(_rough(max(end, left))) for end in (low, high))
        if low_ == high_ or max(low, left) < SOON:
            return f", up to {high_} to the end"
        return f", {low_} to {high_} to the end"


def reporting(
    report: Callable[[str], None], clock: Callable[[], float] = time.monotonic
) -> Progress:
    """Reports what is tried, and the time left, every `PERIOD` s at most; a disk that is full for
    that is no reason to find nothing."""
    pace, due = Pace(clock), -math.inf

    def say(stage: str) -> None:
        nonlocal due
        words = pace.words(stage)
        if clock() >= due:
            due = clock() + PERIOD
            with suppress(OSError):
                report(words)

    return say


def _rough(seconds: float) -> float:
    """In steps of about a tenth: it is an estimate."""
    step = next(s for least, s in STEPS if seconds >= least)
    return max(round(seconds / step), 1) * step


def duration(seconds: float) -> str:
    """`0.1 s` and less, `7.4 s`, `48 s`, `3 min 20 s`, `1 h 5 min`."""
    whole = round(seconds)
    if whole < 120:
        # Less than a tenth of a second is of nobody's use.
        return f"{max(seconds, LEAST):.2g} s" if seconds < 9.95 else f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 120:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"
