"""Work that takes more than a moment, in processes beside the service's own.

The service's loop must be free for a stop at any moment: what is in `questions` is answered here.
Every function takes and gives plain data; what a person did wrong comes back as a line, as an
exception of ours cannot pass between processes.
"""

from __future__ import annotations

import asyncio
import os
import resource
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from samii_rig import errors
from samii_rig.errors import SamiiRigError
from samii_rig.plain import plain
from samii_rig.serve.loaded import CONTEXT
from samii_rig.serve.places import Places
from samii_rig.workers import ends_with_its_parent

WORKERS = 2  # processes for whoever looks
ONE_ASKER = 8  # pieces of work of one asker at once: a page that opens a recording asks for four
WAITS = 20.0  # s for a place: longer than a report takes, and a person looks elsewhere by then
WITHIN = 120.0  # s that a piece of work may take
MEMORY = 8 << 30  # bytes of address space of one of them
# Steps behind the service, whose session they share. Run and listener have sessions of their own,
# to which Linux gives the same share as to this one whatever the steps.
NICE = 5


class Desk:
    """Hands work to the processes; they are started when there is some.

    One place is kept for whoever drives, so that a run never waits for those who look.
    """

    def __init__(self) -> None:
        self._kept = _Workers(1, WITHIN)
        self._open = _Workers(WORKERS, WAITS)

    async def do(
        self, work: Callable[..., dict[str, Any]], *arguments: Any, by: str, kept: bool = False
    ) -> dict[str, Any]:
        """The answer; raises what the work raised, RecordingError if it broke or took too long,
        BusyError if it had no place.

        by : who asks. kept : in the place of whoever drives.
        """
        answer = await (self._kept if kept else self._open).do(work, arguments, by)
        if "raised" in answer:
            kind = getattr(errors, answer["raised"])
            again: SamiiRigError = kind.__new__(kind)
            Exception.__init__(again, answer["line"])
            raise again
        found: dict[str, Any] = answer["found"]
        return found

    def close(self) -> None:
        """End them."""
        self._kept.close()
        self._open.close()


class _Workers:
    """So many processes. Each is a pool of its own: one that breaks takes no other with it."""

    def __init__(self, many: int, waits: float) -> None:
        self._places = Places(many, ONE_ASKER, waits)
        self._all = [_pool() for _ in range(many)]
        self._idle = list(self._all)

    async def do(
        self, work: Callable[..., dict[str, Any]], arguments: tuple[Any, ...], by: str
    ) -> dict[str, Any]:
        async with self._places.place(by):
            pool = self._idle.pop()
            try:
                return await asyncio.wait_for(_asked(pool, work, arguments), WITHIN)
            except (BrokenProcessPool, TimeoutError, asyncio.CancelledError) as error:
                # It is broken, or still works on what nobody waits for.
                _end(pool)
                self._all.remove(pool)
                pool = _pool()
                self._all.append(pool)
                if isinstance(error, asyncio.CancelledError):
                    raise
                raise errors.RecordingError(
                    f"it took more than {WITHIN:g} s or {MEMORY >> 30} GB; "
                    "expected a smaller question"
                ) from error
            finally:
                self._idle.append(pool)

    def close(self) -> None:
        for pool in self._all:
            _end(pool)


def _end(pool: ProcessPoolExecutor) -> None:
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.kill()


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, CONTEXT, _begin)


async def _asked(
    pool: ProcessPoolExecutor, work: Callable[..., dict[str, Any]], arguments: tuple[Any, ...]
) -> dict[str, Any]:
    # In a thread: the first who asks waits until there is a process to be copied (see `loaded`).
    answer = await asyncio.to_thread(pool.submit, _answered, work, arguments)
    return await asyncio.wrap_future(answer)


def _begin() -> None:
    ends_with_its_parent()
    os.nice(NICE)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def _answered(work: Callable[..., dict[str, Any]], arguments: tuple[Any, ...]) -> dict[str, Any]:
    try:
        return {"found": plain(work(*arguments))}
    except SamiiRigError as error:
        return {"raised": type(error).__name__, "line": str(error)}
    except MemoryError:
        return {"raised": "RecordingError", "line": "it does not fit into the memory"}
    except SystemExit as error:
        # Some package's own; it would end whoever waits for this answer.
        return {"raised": "RecordingError", "line": f"it ended its process ({error})"}
