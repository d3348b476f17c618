"""Who has work done at once, and who waits for it: so many places, each asker no more than a share.

A place that comes free goes to whoever has the fewest, and among these to the first who came. So
one asker who floods the queue holds up nobody but themselves for longer than one piece of work.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from samii_rig.errors import SamiiRigError


class BusyError(SamiiRigError):
    """All places are taken; a try in some seconds may find one."""


@dataclass(eq=False, slots=True)
class _Asked:
    by: str
    turn: asyncio.Future[None] = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )


class Places:
    """many : places. each : that one asker may have or wait for. within : s that anybody waits."""

    def __init__(self, many: int, each: int, within: float) -> None:
        self._many, self._each, self._within = many, each, within
        self._working: list[_Asked] = []
        self._waiting: list[_Asked] = []

    @asynccontextmanager
    async def place(self, by: str) -> AsyncIterator[None]:
        """One of them until the end; BusyError for who has their share, or waited too long."""
        if _of(by, self._working) + _of(by, self._waiting) >= self._each:
            raise BusyError(f"{self._each} questions of yours wait; expected one after the other")
        asked = _Asked(by)
        self._waiting.append(asked)
        self._give()
        try:
            await asyncio.wait([asked.turn], timeout=self._within)
            if not asked.turn.done():
                raise BusyError(
                    f"others had all {self._many} places for {self._within:g} s; "
                    "expected a try in some seconds"
                )
            yield
        finally:
            (self._working if asked in self._working else self._waiting).remove(asked)
            self._give()

    def _give(self) -> None:
        while self._waiting and len(self._working) < self._many:
            asked = min(self._waiting, key=lambda a: _of(a.by, self._working))
            self._waiting.remove(asked)
            self._working.append(asked)
            asked.turn.set_result(None)


def _of(by: str, among: list[_Asked]) -> int:
    return sum(a.by == by for a in among)
