"""Routes that concern recordings: list, look, download, compare, note, bring in."""

from __future__ import annotations

import os
import secrets
from base64 import b64decode
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse, HTMLResponse
from pydantic import Field
from starlette.requests import ClientDisconnect

from samii_rig.errors import RecordingError
from samii_rig.index.query import MOST, each_by_name
from samii_rig.index.query import Query as Asked
from samii_rig.index.remarks import add_note, read_remarks, set_tags
from samii_rig.index.store import PRIVATE
from samii_rig.serve import questions, upload
from samii_rig.serve.access import PLAIN_PAGE
from samii_rig.serve.driving import Answer, Body
from samii_rig.serve.rooms import Rooms, counted, operator

Short = Annotated[str, Query(max_length=200)]
BOUNDS = {"limit": {"ge": 1, "le": MOST}, "offset": {"ge": 0, "lt": 2**31}}
MEDIA = "application/octet-stream"
# What a recording says is shown in a page of its own that cannot ask us for anything; which
# scripts it runs, the page itself says by their hashes.
REPORT_HEADERS = {
    **PLAIN_PAGE,
    "Content-Security-Policy": "sandbox allow-scripts allow-downloads; frame-ancestors 'none'",
}


class Tags(Body):
    """The tags that a recording shall have."""

    tags: Annotated[list[str], Field(max_length=100)]


class NewNote(Body):
    """A note on a recording."""

    text: Annotated[str, Field(max_length=8000)]


def routes(rooms: Rooms) -> APIRouter:
    """All of them."""
    router = APIRouter(prefix="/api")
    _search(router, rooms)
    _look(router, rooms)
    _change(router, rooms)
    return router


def _bounded(name: str, said: str) -> Any:
    return Query(description=said, **BOUNDS.get(name, {"max_length": 200}))  # type: ignore[arg-type]


def _search(router: APIRouter, rooms: Rooms) -> None:
    @router.get("/recordings")
    @each_by_name(_bounded)
    def recordings(*, query: Asked) -> Answer:
        """Recordings that fit, newest first."""
        found = rooms.index.search(query)
        return {"total": found.total, "recordings": list(found.entries)}

    @router.get("/recordings/words")
    def words() -> Answer:
        """What rigs, experiments, operators, statuses and verdicts there are to search by."""
        return dict(rooms.index.words())

    @router.get("/compare")
    async def compare(request: Request, a: Short, b: Short) -> Answer:
        """The frequency responses of two recordings, in units of their joint uncertainty."""
        first, second = rooms.entry(a), rooms.entry(b)
        found = await rooms.desk.do(
            questions.comparison, str(first[1]), str(second[1]), by=counted(request)
        )
        return {"a": first[0], "b": second[0], **found}


def _look(router: APIRouter, rooms: Rooms) -> None:
    @router.get("/recordings/{id_}")
    def recording(id_: str) -> Answer:
        """One recording, its notes and its diagnosis."""
        entry, path = rooms.entry(id_)
        try:
            remarks: Any = read_remarks(path)
        except RecordingError:
            remarks = None  # the entry's problem says so
        return {"recording": entry, "remarks": remarks}

    @router.get("/recordings/{id_}/file", response_class=FileResponse)
    def file(id_: str) -> FileResponse:
        """The recording itself (MCAP)."""
        _, path = rooms.entry(id_)
        return FileResponse(path, media_type=MEDIA, filename=path.name)

    @router.get("/recordings/{id_}/signals")
    async def signals(
        request: Request,
        id_: str,
        channel: Annotated[list[str] | None, Query(max_length=64)] = None,
        start: Annotated[float, Query(ge=0, allow_inf_nan=False)] = 0.0,
        stop: Annotated[float, Query(ge=0, allow_inf_nan=False)] = 0.0,
        pixels: Annotated[int, Query(ge=1, le=questions.MOST_POINTS // 2)] = 800,
    ) -> Answer:
        """Channels as curves of a few points with the outline of the whole; times in s."""
        _, path = rooms.entry(id_)
        given = (str(path), channel or [], start, stop, pixels)
        return await rooms.desk.do(questions.signals, *given, by=counted(request))

    @router.get("/recordings/{id_}/frames", response_class=Response)
    async def frames(
        request: Request,
        id_: str,
        start: Annotated[float, Query(ge=0, le=1e6)] = 0.0,
        length: Annotated[float, Query(gt=0, le=1e4)] = 10.0,
    ) -> Response:
        """Samples as frames of the live data (see `viewers`), one after the other; times in s."""
        _, path = rooms.entry(id_)
        found = await rooms.desk.do(questions.frames, str(path), start, length, by=counted(request))
        return Response(b64decode(found["frames"]), media_type=MEDIA)

    @router.get("/recordings/{id_}/report", response_class=HTMLResponse)
    async def report(request: Request, id_: str) -> HTMLResponse:
        """The page about a recording, with the diagnosis if one is kept with it: some seconds."""
        entry, path = rooms.entry(id_)
        given = (str(path), bool(entry.verdict))
        found = await rooms.desk.do(questions.report, *given, by=counted(request))
        return HTMLResponse(found["page"], headers=REPORT_HEADERS)

    @router.get("/recordings/{id_}/frf")
    async def frf(request: Request, id_: str) -> Answer:
        """The frequency responses that were logged with the run."""
        _, path = rooms.entry(id_)
        return await rooms.desk.do(questions.responses, str(path), by=counted(request))


def _change(router: APIRouter, rooms: Rooms) -> None:
    @router.put("/recordings/{id_}/tags")
    def tag(request: Request, id_: str, body: Tags) -> Answer:
        """Give a recording these tags."""
        operator(request)
        entry, path = rooms.entry(id_)
        remarks = set_tags(path, body.tags)
        return {"recording": rooms.index.update(entry.path), "remarks": remarks}

    @router.post("/recordings/{id_}/notes")
    def note(request: Request, id_: str, body: NewNote) -> Answer:
        """Add a note to a recording."""
        who = operator(request)
        entry, path = rooms.entry(id_)
        remarks = add_note(path, who.name or who.signed, body.text)
        return {"recording": rooms.index.update(entry.path), "remarks": remarks}

    @router.post("/recordings", status_code=201)
    async def bring(request: Request) -> Answer:
        """Bring in a recording (the MCAP file as the body). It is checked before it is kept."""
        operator(request)
        folder = rooms.index.folder
        # Neither the client's name for it nor a byte that was not checked gets beyond here.
        arriving = folder / PRIVATE / f"arriving-{secrets.token_hex(8)}"
        name = f"uploaded_{datetime.now(UTC):%Y%m%dT%H%M%S}_{secrets.token_hex(3)}.mcap"
        try:
            with arriving.open("xb") as out:
                async for part in request.stream():
                    out.write(part)
                out.flush()
                os.fsync(out.fileno())
            await upload.checked(arriving)
            arriving.rename(folder / name)
        except ClientDisconnect as error:
            raise RecordingError("it did not arrive whole, or is too large") from error
        except OSError as error:
            raise RecordingError(f"it could not be kept: {error.strerror}") from error
        finally:
            arriving.unlink(missing_ok=True)
        return {"recording": rooms.index.update(name)}
