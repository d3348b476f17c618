"""The service as an ASGI application, and the process that serves it."""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from importlib import resources
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from uvicorn.protocols.http.h11_impl import H11Protocol

import samii_rig
from samii_rig.errors import SamiiRigError
from samii_rig.rig.schema import Rig
from samii_rig.serve import driving, library
from samii_rig.serve.access import MAX_HEAD, PLAIN_PAGE, STOP, App, Guard, Receive, Scope, Send
from samii_rig.serve.door import Door, Guest, room
from samii_rig.serve.job import LOST_AFTER, Job
from samii_rig.serve.rooms import STATUS, NotThereError, Rooms
from samii_rig.serve.settings import Settings, is_local
from samii_rig.serve.stopper import stopper

MAX_MESSAGE = 4 << 10  # bytes of a WebSocket message to us; none is expected
PING = 10.0  # s; a viewer that does not answer for that long is let go
GRACE = 2.0  # s that what is asked has to be answered once the service shall end
ABORTED = 0.1  # s after which a request knows that its connection is gone
LAST = 10  # s; a thread that still works then is left
MANY = 500  # recordings whose reading takes seconds, and is told
# Nothing from elsewhere, nothing that is not a file of ours, in nobody's frame.
# But for the stop's own listener, which may be asked from the page.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self' {stop}; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'none'"
)
TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}


def application(rooms: Rooms) -> FastAPI:
    """The routes; `guarded` puts the guard before them."""

    @asynccontextmanager
    async def life(app: FastAPI) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(w) for w in (rooms.work(), rooms.ready())]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            rooms.analysis.close()
            rooms.desk.close()
            if rooms.foxglove is not None:
                rooms.foxglove.close()

    app = FastAPI(
        title="samii-rig",
        description=__doc__,
        version=samii_rig.__version__,
        lifespan=life,
        # Their pages come from another host.
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/openapi.json",
    )
    app.add_exception_handler(SamiiRigError, _said)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)
    app.include_router(driving.routes(rooms))
    app.include_router(library.routes(rooms))
    _page(app, rooms)
    return app


def guarded(
    rooms: Rooms,
    port: int,
    app: FastAPI | None = None,
    crowded: Callable[[str], bool] = lambda address: False,
) -> App:
    """What is served: the routes (or those of `app`) behind their guard.

    crowded : whether only a stop is served to this address now (see `Door`).
    """
    s = rooms.settings
    names = {"127.0.0.1", "localhost", "[::1]"} if is_local(s.host) else set()
    names |= {f"[{s.host}]" if ":" in s.host else s.host}
    hosts = {f"{name}:{port}" for name in names} | set(s.names)
    hosts |= {f"{name}:{port}" for name in s.names}
    if port == (443 if s.tls else 80):
        hosts |= names
    return Guard(
        app or application(rooms),
        s.tokens,
        frozenset(h.lower() for h in hosts),
        s.tls is not None,
        crowded=crowded,
        proxies=s.proxies,
        holds=rooms.lease.holds,
    )


def _page(app: FastAPI, rooms: Rooms) -> None:
    folder = resources.files("samii_rig.serve") / "page"
    files = {f.name: f.read_bytes() for f in folder.iterdir() if f.is_file()}

    def served(request: Request, name: str) -> Response:
        if name not in files:
            raise NotThereError(f"no file {name[:40]!r}")
        kind = TYPES.get(name.rpartition(".")[2], "application/octet-stream")
        # By the name by which we were called, which the guard knows: the page's own.
        host = request.headers.get("host", "").rpartition(":")[0] or "127.0.0.1"
        scheme = "https" if rooms.settings.tls else "http"
        policy = POLICY.format(stop=f"{scheme}://{host}:{rooms.stop_port}")
        headers = {**PLAIN_PAGE, "Content-Security-Policy": policy}
        return Response(files[name], media_type=kind, headers=headers)

    @app.get("/", include_in_schema=False)
    def index(request: Request) -> Response:
        return served(request, "index.html")

    @app.get("/page/{name}", include_in_schema=False)
    def file(request: Request, name: str) -> Response:
        return served(request, name)


async def _said(request: Request, error: Exception) -> JSONResponse:
    kinds = (STATUS[k] for k in type(error).__mro__ if k in STATUS)
    return JSONResponse({"error": str(error)}, next(kinds, 400))


async def _http(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": str(error.detail)}, error.status_code)


async def _invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first: dict[str, Any] = dict(error.errors()[0])
    where = ".".join(str(part) for part in first["loc"])
    return JSONResponse({"error": f"{where}: {first['msg']}"}, 422)


def _reading(done: int, of: int) -> None:
    if of > MANY:
        print(f"index: {done:,} of {of:,} recordings", file=sys.stderr, flush=True)


class _Http(H11Protocol):
    """A connection that tells the door whether it owes a head."""

    def __init__(self, guest: Guest, **more: Any) -> None:
        super().__init__(**more)
        self._guest = guest

    def data_received(self, data: bytes) -> None:
        """Some bytes of it."""
        super().data_received(data)
        self._tell()

    def on_response_complete(self) -> None:
        """It may ask again."""
        super().on_response_complete()
        self._tell()

    def _tell(self) -> None:
        self._guest.owes(self.conn.their_state is h11.IDLE)


class _Server(uvicorn.Server):
    """Has a door of ours, and cuts off what is asked when `GRACE` is over: uvicorn would tell of
    each as of a defect."""

    def __init__(
        self,
        app: Callable[[Callable[[str], bool]], App],
        listening: socket.socket,
        proxies: frozenset[str],
        **settings: Any,
    ) -> None:
        super().__init__(uvicorn.Config(app(self._crowded), http=_Http, **settings))
        self.config.load()
        self._door = Door(listening, self._entered, room(), trusted=proxies, tls=self.config.ssl)
        self._open: asyncio.Task[None] | None = None

    def _crowded(self, address: str) -> bool:
        return self._door.crowded(address)

    def _entered(self, guest: Guest) -> asyncio.Protocol:
        state = {"server_state": self.server_state, "app_state": self.lifespan.state}
        return _Http(guest, config=self.config, **state)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to serve; uvicorn itself listens nowhere."""
        await super().startup([])
        self._open = asyncio.create_task(self._door.open())

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop listening, wait for what is asked, end."""
        if self._open is not None:
            self._open.cancel()
        cutting = asyncio.create_task(self._cut_off())
        await super().shutdown(sockets)
        cutting.cancel()

    async def _cut_off(self) -> None:
        await asyncio.sleep(GRACE)
        for connection in list(self.server_state.connections):
            connection.transport.abort()
        await asyncio.sleep(ABORTED)
        for task in list(self.server_state.tasks):
            task.cancel()


def _cancellable(app: App) -> App:
    """The same; a request that is cancelled, as only the end of the service does, is over."""

    async def served(scope: Scope, receive: Receive, send: Send) -> None:
        with suppress(asyncio.CancelledError):
            await app(scope, receive, send)

    return served


def serve(settings: Settings) -> None:
    """Check, listen, serve until a signal; InputError for what cannot be."""
    settings.check()
    with settings.alone():
        listening, for_stop = settings.bound(), settings.bound_for_stop()
        stop_port = for_stop.getsockname()[1]
        settings.jobs.mkdir(parents=True, exist_ok=True)
        # First: while the recordings are read, a run may go on.
        with stopper(settings, for_stop):
            _served(settings, listening, stop_port)


def _served(settings: Settings, listening: socket.socket, stop_port: int) -> None:
    port = listening.getsockname()[1]
    rooms = Rooms(settings, _reading, stop_port)
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    scheme = "https" if settings.tls else "http"
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(name)s: %(message)s")
    # What strangers send that is no request is no news, and may be much.
    logging.getLogger("uvicorn.error").addFilter(lambda r: "Invalid HTTP request" not in str(r.msg))
    server = _Server(
        lambda crowded: _cancellable(guarded(rooms, port, crowded=crowded)),
        listening,
        settings.proxies,
        ws="websockets-sansio",
        loop="asyncio",
        ssl_certfile=settings.tls[0] if settings.tls else None,
        ssl_keyfile=settings.tls[1] if settings.tls else None,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        h11_max_incomplete_event_size=MAX_HEAD,
        ws_max_size=MAX_MESSAGE,
        ws_ping_interval=PING,
        ws_ping_timeout=PING,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=LAST,
    )
    print(f"{settings.rig.name}: {scheme}://{host}:{port}", flush=True)
    print(f"stop: {scheme}://{host}:{stop_port}/api/stop", flush=True)
    if rooms.foxglove is not None:
        print(f"Foxglove: ws://127.0.0.1:{rooms.foxglove.port}", flush=True)
    # Once it has ended in good order uvicorn raises the signal again, which would end us without.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        server.run(sockets=[listening])
    finally:
        if (job := rooms.supervisor.current) is not None:
            _leaves(job, settings.rig, f"{scheme}://{host}:{stop_port}{STOP}")


def _leaves(job: Job, rig: Rig, stop: str) -> None:
    """Say what becomes of the run that goes on."""
    stops = rig.service.when_lost == "stop"
    line = (
        f"stops by the rig file, {LOST_AFTER:g} s after the service"
        if stops
        else f"goes on without the service; start it again to see it, or end it at zero output: "
        f"POST to {stop}, or kill {job.written.pid}"
    )
    print(f"{job.request.recording} {line}", file=sys.stderr, flush=True)
