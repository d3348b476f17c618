"""Routes that concern the rig: plan, start, stop, queue, lease, faults, live data."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Request, Response, WebSocket, WebSocketDisconnect
from pydantic import BaseModel, ConfigDict, Field

from samii_rig.errors import LimitError
from samii_rig.rig.load import MAX_BYTES
from samii_rig.run.experiments import fitting
from samii_rig.serve import questions
from samii_rig.serve.access import COOKIE, DRIVES, STOP
from samii_rig.serve.job import DIAGNOSIS, ESTIMATE, RESPONSES, SO_FAR
from samii_rig.serve.lease import EVERY, LASTS
from samii_rig.serve.rooms import NotThereError, Rooms, counted, operator, person
from samii_rig.serve.supervisor import Order
from samii_rig.serve.viewers import MOST_VIEWERS

Answer = dict[str, Any]


class Body(BaseModel):
    """A request's body: a field that is not known is an error."""

    model_config = ConfigDict(extra="forbid")


class Asked(Body):
    """An experiment: the name of a shipped one, or the text of a file. pose : that the rig stands
    in, such as "30 deg"; without it that of the rig file."""

    experiment: Annotated[str, Field(max_length=80)] = ""
    experiment_toml: Annotated[str, Field(max_length=min(MAX_BYTES, 48_000))] = ""
    pose: Annotated[str, Field(max_length=40)] = ""


class Start(Asked):
    """An experiment to run."""

    operator: Annotated[str, Field(max_length=80)] = ""
    diagnosis: bool = True
    seed: Annotated[int | None, Field(ge=0, le=2**53)] = None
    stop_when_certain: bool = False


class Word(Body):
    """Why a fault may be cleared."""

    name: Annotated[str, Field(max_length=80)]
    reason: Annotated[str, Field(max_length=400)]


def routes(rooms: Rooms) -> APIRouter:
    """All of them."""
    router = APIRouter(prefix="/api")
    _describe(router, rooms)
    _drive(router, rooms)
    _queue(router, rooms)
    _lease(router, rooms)
    _live(router, rooms)
    return router


def _describe(router: APIRouter, rooms: Rooms) -> None:
    @router.get("/rig")
    async def rig() -> Answer:
        """The rig file as data, as text and as a drawing."""
        return await rooms.drawn()

    @router.get("/state")
    async def state(request: Request) -> Answer:
        """Run, queue, time left, lease, fault; and who asks."""
        who = person(request)
        return {**rooms.state(), "you": {"name": who.name, "role": who.role}}

    @router.get("/experiments")
    async def experiments() -> Answer:
        """The shipped experiments for this rig with the text of their files."""
        files = fitting(rooms.settings.rig)
        found = {name: file.read_text("utf-8") for name, file in files.items()}
        return {"experiments": found}

    @router.post("/dry-run")
    async def dry_run(request: Request, asked: Asked) -> Answer:
        """What an experiment would do: margins to every limit, expected errors, duration."""
        return await _predicted(rooms, request, asked)


async def _predicted(rooms: Rooms, request: Request, asked: Asked) -> Answer:
    """The dry run; in a process beside, as an experiment's module may take seconds to load."""
    given = (rooms.settings.rig_toml, asked.experiment, asked.experiment_toml, asked.pose)
    by = counted(request)
    return await rooms.desk.do(questions.dry_run, *given, by=by, kept=by == DRIVES)


async def _posed(rooms: Rooms, request: Request, pose: str) -> str:
    """The rig file's text in a pose; as it is without one."""
    if not pose:
        return rooms.settings.rig_toml
    by = counted(request)
    given = (rooms.settings.rig_toml, pose)
    found = await rooms.desk.do(questions.in_pose, *given, by=by, kept=by == DRIVES)
    return str(found["text"])


def _drive(router: APIRouter, rooms: Rooms) -> None:
    @router.post("/runs", status_code=202)
    async def start(request: Request, asked: Start) -> Answer:
        """Queue an experiment; it starts at once if nothing runs. Wants the lease."""
        who = rooms.drives(request)
        if not rooms.supervisor.simulated:
            rooms.latch.refuse()
        planned = await _predicted(rooms, request, asked)
        rig_toml = await _posed(rooms, request, asked.pose)
        if planned["refused"]:
            raise LimitError(planned["refused"])
        # The lease may have gone to another while it was predicted.
        rooms.drives(request)
        order = Order(
            planned["experiment"],
            planned["text"],
            planned["runs"],
            asked.operator or who.name or who.signed,
            asked.diagnosis,
            asked.seed,
            asked.stop_when_certain,
            rig_toml,
            asked.pose,
        )
        return {"jobs": [rooms.supervisor.plain(j) for j in rooms.supervisor.add(order)]}

    @router.get("/jobs/{id_}")
    async def job(id_: str) -> Answer:
        """One run that was asked for, and how it stands."""
        found = rooms.supervisor.job(id_)
        if found is None:
            raise NotThereError(f"no job {id_[:40]!r}; expected the id of one")
        return found

    @router.get("/jobs/{id_}/responses")
    def responses(id_: str) -> Response:
        """The frequency responses of a run so far, with 90 % bands, and the model's."""
        return _told(rooms, id_, ESTIMATE, RESPONSES)

    @router.get("/jobs/{id_}/diagnosis")
    def diagnosis(id_: str) -> Response:
        """The diagnosis of a run so far; `next_toml` is the experiment that it asks for."""
        return _told(rooms, id_, DIAGNOSIS, SO_FAR)


def _queue(router: APIRouter, rooms: Rooms) -> None:
    @router.post(STOP.removeprefix("/api"))
    async def stop(request: Request) -> Answer:
        """Zero output now. Works for everybody, always: no token, no lease."""
        stopped = rooms.supervisor.stop(person(request).signed)
        return {"stopped": stopped, "moving": rooms.supervisor.moving}

    @router.get(STOP.removeprefix("/api"))
    async def stopped() -> Answer:
        """Whether a run may still drive the rig: whoever asked for a stop sees that it is done."""
        return {"moving": rooms.supervisor.moving}

    @router.delete("/queue/{id_}")
    async def cancel(request: Request, id_: str) -> Answer:
        """Take a job out of the queue. Wants the lease."""
        rooms.drives(request)
        rooms.supervisor.cancel(id_)
        return {"cancelled": id_}

    @router.post("/queue/resume")
    async def resume(request: Request) -> Answer:
        """Let the queue go on after it was held. Wants the lease."""
        rooms.drives(request)
        rooms.supervisor.resume()
        return rooms.state()

    @router.post("/clear-fault")
    async def clear_fault(request: Request, word: Word) -> Answer:
        """Take a latched fault back, with name and reason. Wants the lease."""
        rooms.drives(request)
        rooms.latch.clear(word.name, word.reason)
        return rooms.state()


def _told(rooms: Rooms, id_: str, *names: str) -> Response:
    """The first of these files that there is."""
    path = next((p for name in names if (p := rooms.supervisor.told(id_, name))), None)
    if path is None:
        raise NotThereError(f"nothing is known yet of job {id_[:40]!r}")
    # Read at once: a file that is replaced while it is sent would have another length than told.
    return Response(path.read_bytes(), media_type="application/json")


def _lease(router: APIRouter, rooms: Rooms) -> None:
    @router.post("/lease")
    async def take(request: Request) -> Answer:
        """Become the one who drives. Silence for `lasts_s` ends it, and the run with it."""
        who = operator(request)
        secret = rooms.lease.take(who.name or who.signed)
        return {"lease": secret, "every_s": EVERY, "lasts_s": LASTS}

    @router.post("/lease/beat")
    async def beat(request: Request) -> Answer:
        """A sign of life of who drives."""
        rooms.lease.beat(request.headers.get("x-lease", ""))
        return {"lasts_s": LASTS}

    @router.delete("/lease")
    async def give_back(request: Request) -> Answer:
        """Hand over in good order: what runs goes on."""
        rooms.lease.give_back(request.headers.get("x-lease", ""))
        return {}

    @router.post("/login")
    async def login(request: Request, response: Response) -> Answer:
        """Keep the token of this request as a cookie that no script can read."""
        who = person(request)
        token = request.headers.get("authorization", "").partition(" ")[2].strip()
        if who.role is not None and token:
            secure = request.url.scheme == "https"
            response.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=secure)
        return {"name": who.name, "role": who.role}


def _live(router: APIRouter, rooms: Rooms) -> None:
    @router.websocket("/live")
    async def live(socket: WebSocket) -> None:
        """Samples as binary frames (see `viewers`), the state as JSON. What comes in is ignored."""
        if len(rooms.viewers) >= MOST_VIEWERS:
            await socket.close(1013, f"{MOST_VIEWERS} viewers are connected")
            return
        await socket.accept()
        viewer = rooms.viewers.add()

        async def send() -> None:
            while True:
                frame = await viewer.next()
                if isinstance(frame, str):
                    await socket.send_text(frame)
                else:
                    await socket.send_bytes(frame)

        async def listen() -> None:
            while (await socket.receive())["type"] != "websocket.disconnect":
                pass

        tasks = [asyncio.create_task(send()), asyncio.create_task(listen())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            rooms.viewers.remove(viewer)
            for task in tasks:
                task.cancel()
            for outcome in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(outcome, Exception) and not isinstance(
                    outcome, (WebSocketDisconnect, RuntimeError)
                ):
                    raise outcome
