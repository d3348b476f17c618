"""One line about a campaign that goes on: how many trials, how many failed, the time left."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TextIO

EVERY = 30.0  # s between two lines where there is no terminal
REDRAWN = 0.5  # s between two states of the line on a terminal


class Progress:
    """`say(done, failed)` after every trial; on a terminal one line is written over."""

    def __init__(
        self, total: int, to: TextIO | None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.total, self.to, self.clock = total, to, clock
        self.begun = self.last = clock()
        self.all = total

    def __call__(self, done: int, failed: int) -> None:
        """Say it, unless it was said just now."""
        if self.to is None:
            return
        terminal, now = self.to.isatty(), self.clock()
        if now - self.last < (REDRAWN if terminal else EVERY) and done < self.total:
            return
        self.last = now
        end = "\r" if terminal and done < self.total else "\n"
        self.to.write(f"{line(done, self.total, failed, now - self.begun):<72}{end}")
        self.to.flush()


def line(done: int, total: int, failed: int, seconds: float) -> str:
    """Trials done of all, failures, time left at the pace so far."""
    left = (total - done) * seconds / max(done, 1)
    said = f"{done} of {total} trials, {clocked(left)} left"
    return f"{said}, {failed} failed" if failed else said


def clocked(seconds: float) -> str:
    """Hours and minutes, or minutes and seconds."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 60} min {whole % 60:02d} s"
