"""What the routes share: one object that holds all parts of the service."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fastapi import Request, WebSocket

from samii_rig.errors import GateError, InputError, SamiiRigError
from samii_rig.index.entry import Entry
from samii_rig.index.store import Index
from samii_rig.safety.latch import Latch
from samii_rig.serve import questions
from samii_rig.serve.access import Person
from samii_rig.serve.analysis import Analysis
from samii_rig.serve.desk import Desk
from samii_rig.serve.foxglove import Foxglove
from samii_rig.serve.job import RESPONSES
from samii_rig.serve.lease import Lease
from samii_rig.serve.places import BusyError
from samii_rig.serve.settings import Settings
from samii_rig.serve.supervisor import Supervisor
from samii_rig.serve.viewers import PERIOD, Viewers

LOOK_AFTER = 0.2  # s between looks at the jobs
STATE_PERIOD = 0.25  # s between states
BEAT = 0.5  # s between signs of life to the run
REFRESH = 10.0  # s between looks at the folder, for recordings that others put there

log = logging.getLogger("samii_rig.serve")


class NotThereError(SamiiRigError):
    """There is no such thing."""


class Rooms:
    """The service's parts, and the work that it does by itself.

    progress : of reading the folder, which takes a while where there is no index yet.
    stop_port : of the stop's own listener, 0 where there is none.
    """

    def __init__(
        self,
        settings: Settings,
        progress: Callable[[int, int], None] | None = None,
        stop_port: int = 0,
    ) -> None:
        self.settings, self.stop_port = settings, stop_port
        self.started = datetime.now(UTC).isoformat(timespec="seconds")
        self.index = Index(settings.folder)
        self.index.refresh(progress)
        self.supervisor = Supervisor(settings.rig, settings.rig_toml, self.index, settings.pace)
        self.analysis = Analysis(settings.folder)
        self.lease = Lease()
        self.desk = Desk()
        self.viewers = Viewers()
        self.latch = Latch(settings.rig.name)
        self._drawn: asyncio.Task[dict[str, Any]] | None = None
        at = settings.foxglove
        # Last: nothing of ours fails after its port is open.
        self.foxglove = None if at is None else Foxglove(at, settings.rig)

    async def work(self) -> None:
        """Look after run, lease and viewers until cancelled."""
        loop = asyncio.get_running_loop()
        due = dict.fromkeys(("jobs", "state", "beat", "refresh"), loop.time())
        refreshing: asyncio.Task[Any] | None = None
        while True:
            await asyncio.sleep(PERIOD)
            now = loop.time()
            state = None
            with _said("the service's own work"):
                if now >= due["beat"]:
                    due["beat"] = now + BEAT
                    self.supervisor.beat()
                gone = self.lease.lost()
                if gone and self.supervisor.current is not None:
                    self.supervisor.stop(f"the service: {gone} gave no sign of life")
                if now >= due["jobs"]:
                    due["jobs"] = now + LOOK_AFTER
                    self.supervisor.turn()
                    self._analyse()
                if now >= due["state"]:
                    due["state"] = now + STATE_PERIOD
                    state = self.state()
                self.viewers.show(self.supervisor.reader(), state)
                self._foxglove()
                if now >= due["refresh"] and (refreshing is None or refreshing.done()):
                    due["refresh"] = now + REFRESH
                    refreshing = asyncio.create_task(asyncio.to_thread(self._refresh))

    def _analyse(self) -> None:
        """Look after what is known of the run; end it early where the order allows it."""
        job, reader = self.supervisor.current, self.supervisor.reader()
        self.analysis.turn(job)
        if job is not None and job.request.stop_when_certain and self.analysis.certain and reader:
            reader.enough()

    async def drawn(self) -> dict[str, Any]:
        """The rig as `questions.rig` gives it. It does not change and takes seconds: all who ask
        wait for the same."""
        found = self._drawn
        if found is None or (found.done() and (found.cancelled() or found.exception())):
            work = self.desk.do(questions.rig, self.settings.rig_toml, by="the page")
            self._drawn = found = asyncio.create_task(work)
        return await asyncio.shield(found)

    async def ready(self) -> None:
        """Have what the first page asks for, and who predicts the first run awake."""
        with _said("the drawing"):
            await self.drawn()
        with _said("the first prediction"):
            await self.desk.do(questions.awake, by="the service", kept=True)

    def _foxglove(self) -> None:
        """Show Foxglove what is new. It is a display: one that fails is taken away."""
        if self.foxglove is None:
            return
        job = self.supervisor.current
        try:
            self.foxglove.show(self.supervisor.reader(), job.folder / RESPONSES if job else None)
        except Exception:
            log.exception("Foxglove failed and is off until the service is started again")
            failed, self.foxglove = self.foxglove, None
            with contextlib.suppress(Exception):
                failed.close()

    def _refresh(self) -> None:
        with _said("the index"):
            self.index.refresh()

    def state(self) -> dict[str, Any]:
        """All that everybody sees of run, queue, lease and faults."""
        real = not self.supervisor.simulated
        fault = self.latch.fault if real else None
        return {
            **self.supervisor.state(),
            "so_far": self.analysis.state() if self.supervisor.current else None,
            "rig": self.settings.rig.name,
            "started": self.started,
            "stop_port": self.stop_port,
            "real": real,
            "pace": 1.0 if real else self.settings.pace,
            "fault": asdict(fault) if fault else None,
            "operator": self.lease.holder if self.lease.alive else "",
            "viewers": len(self.viewers),
            "last": self.supervisor.last,
        }

    def entry(self, id_: str) -> tuple[Entry, Path]:
        """A recording and its file by its id, the only name for a file that a client has."""
        entry = self.index.get(id_)
        if entry is None:
            raise NotThereError(f"no recording {id_[:40]!r}; expected the id of one in the list")
        path = self.index.path_of(entry)
        if not path.is_file():
            raise NotThereError(f"{entry.path} is no file (any more); expected a recording")
        return entry, path

    def drives(self, request: Request) -> Person:
        """Who asks, if they hold the lease; GateError or ForbiddenError otherwise."""
        who = operator(request)
        self.lease.check(request.headers.get("x-lease", ""))
        return who


class ForbiddenError(SamiiRigError):
    """Who asks may look, but not do this."""


def person(request: Request | WebSocket) -> Person:
    """Who asks, as the guard found."""
    found: Person = request.scope["state"]["person"]
    return found


def counted(request: Request) -> str:
    """As whom the guard counts what is asked: by token, by lease, or by address."""
    found: str = request.scope["state"]["counted"]
    return found


def operator(request: Request) -> Person:
    """Who asks, if they may change something; ForbiddenError if they are a viewer."""
    who = person(request)
    if not who.drives:
        raise ForbiddenError(f"{who.signed} is a viewer; expected an operator")
    return who


@contextlib.contextmanager
def _said(what: str) -> Any:
    """The service goes on; what went wrong stands in its log."""
    try:
        yield
    except asyncio.CancelledError:
        raise
    except Exception:
        log.exception("%s failed", what)


STATUS: dict[type[SamiiRigError], int] = {
    NotThereError: 404,
    ForbiddenError: 403,
    GateError: 409,
    InputError: 422,
    BusyError: 503,
}
