"""Places at the desk: who has one, who waits, and who is told to come again.

Plan: whose turn it is, by who has the fewest; the share of one asker; how long anybody waits; who
leaves while waiting or while working gives the place back.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from samii_rig.serve.places import BusyError, Places


def within(work: Callable[[], Awaitable[None]]) -> None:
    async def go() -> None:
        await work()

    asyncio.run(go())


class Visit:
    """One who takes a place, and keeps it until sent away."""

    def __init__(self, places: Places, by: str) -> None:
        self.by, self.has, self._leave = by, False, asyncio.Event()
        self.task = asyncio.create_task(self._stay(places))

    async def _stay(self, places: Places) -> None:
        async with places.place(self.by):
            self.has = True
            await self._leave.wait()

    async def leave(self) -> None:
        self._leave.set()
        await self.task
        await settled()


async def settled() -> None:
    """All that can go on without time passing has gone on."""
    for _ in range(10):
        await asyncio.sleep(0)


async def came(places: Places, *people: str) -> list[Visit]:
    found = [Visit(places, by) for by in people]
    await settled()
    return found


def test_a_free_place_goes_to_who_has_the_fewest() -> None:
    async def go() -> None:
        places = Places(2, 4, 60.0)
        eve = await came(places, "Eve", "Eve", "Eve", "Eve")
        (bob,) = await came(places, "Bob")
        assert [v.has for v in (*eve, bob)] == [True, True, False, False, False]
        await eve[0].leave()
        assert [v.has for v in (*eve, bob)] == [True, True, False, False, True]
        await bob.leave()
        assert eve[2].has  # who came first among her own
        assert not eve[3].has
        for visit in eve[1:]:
            await visit.leave()

    within(go)


def test_nobody_has_more_than_their_share() -> None:
    async def go() -> None:
        places = Places(1, 2, 60.0)
        kept = await came(places, "Eve", "Eve", "Eve", "Bob")
        with pytest.raises(BusyError, match=r"^2 questions of yours wait; expected one after"):
            await kept.pop(2).task
        for visit in kept:
            await visit.leave()

    within(go)


def test_nobody_waits_longer_than_told() -> None:
    async def go() -> None:
        places = Places(1, 2, 0.0)
        first, second = await came(places, "Eve", "Bob")
        assert first.has
        with pytest.raises(BusyError, match=r"^others had all 1 places for 0 s; expected a try"):
            await second.task
        await first.leave()
        (third,) = await came(places, "Bob")
        assert third.has
        await third.leave()

    within(go)


@pytest.mark.parametrize("gone", [0, 1], ids=["working", "waiting"])
def test_who_goes_away_keeps_no_place(gone: int) -> None:
    async def go() -> None:
        places = Places(1, 1, 60.0)
        visits = await came(places, "Eve", "Bob")
        visits[gone].task.cancel()
        await settled()
        (stays,) = (v for v in visits if not v.task.done())
        assert stays.has
        await stays.leave()
        (last,) = await came(places, "Eve")
        assert last.has
        await last.leave()

    within(go)
