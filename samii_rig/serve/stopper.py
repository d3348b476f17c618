"""The stop, in a process of its own with a port of its own.

    python -m samii_rig.serve.stopper JOBS LOCK LISTENING [--tokens FILE] [--tls CERT KEY]

JOBS is the folder of the jobs, LOCK the file into which the service that works on them writes its
process, LISTENING the descriptor of a socket. It needs nothing of the service: neither its event
loop nor its memory nor its descriptors, so that nothing that keeps the service busy keeps a run
from being stopped. It does what the service's own stop does, to whatever runs, and leaves word for
the queue. When the service dies it stays as long as a run goes on; when another service begins to
work on the folder it makes way.

    POST /api/stop[?name=WHO]   zero output now; {"stopped": whether a run was there, "moving"}
    GET /api/stop               {"moving": whether a run may still drive the rig}
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from samii_rig.errors import SamiiRigError
from samii_rig.serve.access import MAX_HEAD, STOP, Person, Tokens, claimed, token_of
from samii_rig.serve.door import Door, Guest
from samii_rig.serve.job import ask_all_to_stop, moving

if TYPE_CHECKING:
    from samii_rig.serve.settings import Settings  # loads much that is not needed here

STOPS_AT_ONCE = 64  # connections at once: stops, of which one is enough
STILL_NEEDED = 0.1  # s between looks at whether it is still needed
AGAIN = 0.5  # s between looks at whether it still runs
LEAVES_WITHIN = 1.0  # s in which it ends after the service, where there is no run to stay for
REASONS = {200: "OK", 204: "No Content", 400: "Bad Request", 404: "Not Found", 431: "Too Large"}


class Stopper(asyncio.Protocol):
    """One connection: one request, one answer, the end."""

    def __init__(self, guest: Guest, jobs: Path, tokens: Callable[[], Tokens | None]) -> None:
        self._guest, self._jobs, self._tokens = guest, jobs, tokens
        self._head = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """It is open."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Answer once the head is whole; there is nothing in a body."""
        if self._guest.since is None:
            return
        self._head += data
        if b"\r\n\r\n" not in self._head:
            if len(self._head) > MAX_HEAD:
                self._answer(431, {"error": f"expected a head of at most {MAX_HEAD} bytes"}, "")
            return
        first, *lines = self._head.decode("latin-1").split("\r\n\r\n")[0].split("\r\n")
        headers = dict(_header(line) for line in lines)
        method, _, rest = first.partition(" ")
        self._answer(*self._done(method, rest.partition(" ")[0], headers), _origin(headers))

    def _done(
        self, method: str, target: str, headers: dict[str, str]
    ) -> tuple[int, dict[str, object]]:
        """Status and answer of a request, once it is carried out."""
        try:
            where = urlsplit(target)
        except ValueError:
            return 400, {"error": "expected a path"}
        if where.path != STOP or method not in ("POST", "GET", "OPTIONS"):
            return 404, {"error": f"expected POST {STOP}"}
        if method == "OPTIONS":
            return 204, {}
        if method == "GET":
            return 200, {"moving": moving(self._jobs)}
        name = parse_qs(where.query).get("name", [""])[0]
        stopped = ask_all_to_stop(self._jobs, self._who(headers, name).signed)
        return 200, {"stopped": stopped, "moving": moving(self._jobs)}

    def _who(self, headers: dict[str, str], name: str) -> Person:
        address = self._guest.address
        # A file that cannot be read, a token that is none: whoever it is may stop.
        with suppress(SamiiRigError):
            tokens = self._tokens()
            if tokens is None:
                return claimed(name, address)
            if found := tokens.person(token_of(headers), address):
                return found
        return claimed("", address)

    def _answer(self, status: int, found: dict[str, object], origin: str) -> None:
        self._guest.owes(False)
        body = json.dumps(found).encode() if status != 204 else b""
        lines = [
            f"HTTP/1.1 {status} {REASONS[status]}",
            "Content-Type: application/json",
            f"Content-Length: {len(body)}",
            "Cache-Control: no-store",
            "Connection: close",
        ]
        if origin:
            # Any page may stop, and see whether it did.
            lines += [
                f"Access-Control-Allow-Origin: {origin}",
                "Access-Control-Allow-Credentials: true",
                "Access-Control-Allow-Headers: authorization",
                "Vary: Origin",
            ]
        self._transport.write("\r\n".join([*lines, "", ""]).encode("latin-1") + body)
        self._transport.close()


def _header(line: str) -> tuple[str, str]:
    name, _, value = line.partition(":")
    return name.strip().lower(), value.strip()


def _origin(headers: dict[str, str]) -> str:
    """The page that asks; one that is no plain text is none."""
    origin = headers.get("origin", "")
    return origin if origin.isascii() and origin.isprintable() else ""


@contextmanager
def stopper(settings: Settings, listening: socket.socket) -> Iterator[None]:
    """Have it run meanwhile, again if something kills it. It outlives us where a run does."""
    over, process = threading.Event(), _begun(settings, listening)

    def watch() -> None:
        nonlocal process
        while not over.wait(AGAIN):
            if process.poll() is not None:
                _let_go(process)
                process = _begun(settings, listening)

    watching = threading.Thread(target=watch, daemon=True)
    watching.start()
    try:
        yield
    finally:
        over.set()
        watching.join()
        listening.close()
        _let_go(process)
        with suppress(subprocess.TimeoutExpired):
            process.wait(LEAVES_WITHIN)


def _begun(settings: Settings, listening: socket.socket) -> subprocess.Popen[bytes]:
    handle = listening.fileno()
    places = [str(settings.jobs), str(settings.lock), str(handle)]
    command = [sys.executable, "-m", "samii_rig.serve.stopper", *places]
    if settings.tokens is not None:
        command += ["--tokens", str(settings.tokens.path)]
    if settings.tls is not None:
        command += ["--tls", *map(str, settings.tls)]
    return subprocess.Popen(
        command,
        pass_fds=(handle,),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        # Neither Ctrl-C at our terminal nor a hang-up of it ends it.
        start_new_session=True,
    )


def _let_go(process: subprocess.Popen[bytes]) -> None:
    """It sees by its input that we are gone, and stays where it is needed."""
    assert process.stdin is not None
    process.stdin.close()


async def _serve(arguments: argparse.Namespace) -> None:
    tls = None
    if arguments.tls:
        tls = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        tls.load_cert_chain(*arguments.tls)

    def tokens() -> Tokens | None:
        return Tokens(arguments.tokens) if arguments.tokens else None

    listening = socket.socket(fileno=arguments.listening)
    door = Door(listening, lambda g: Stopper(g, arguments.jobs, tokens), STOPS_AT_ONCE, tls=tls)
    opened = asyncio.create_task(door.open())
    await _needed(arguments.jobs, arguments.lock)
    opened.cancel()


async def _needed(jobs: Path, lock: Path) -> None:
    """Return once nobody needs us: the service ended, and no run goes on or another one came."""
    served_by = _text(lock)
    loop = asyncio.get_running_loop()
    ended = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(ended), sys.stdin)
    await ended.read()
    while moving(jobs) and _text(lock) == served_by:
        await asyncio.sleep(STILL_NEEDED)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser()
    parser.add_argument("jobs", type=Path)
    parser.add_argument("lock", type=Path)
    parser.add_argument("listening", type=int)
    parser.add_argument("--tokens", type=Path)
    parser.add_argument("--tls", nargs=2, type=Path)
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # Ahead of what else this machine does, where we may.
    with suppress(OSError):
        os.nice(-5)
    asyncio.run(_serve(parser.parse_args()))


if __name__ == "__main__":
    main()
