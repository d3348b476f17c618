"""Who asks, and whether they may: tokens, origins, rates and sizes.

Everything passes the `Guard` before any route sees it, WebSockets too. It is closed by default:
a path that is not named as open wants a token where there are any.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import secrets
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qs, unquote

from samii_rig.errors import InputError

Role = Literal["viewer", "operator"]
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

STOP = "/api/stop"
# What needs no token: the page, which shows nothing before it is given one, and the stop.
OPEN = ("/", "/api/login", STOP)
OPEN_FOLDER = "/page/"
COOKIE = "samii_rig_token"
# Of every page of ours, beside its own policy.
PLAIN_PAGE = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
MAX_HEAD = 32 << 10  # bytes of a request's head
MAX_BODY = 64 << 10  # bytes of a request that is no upload
BODY_WITHIN = 30.0  # s for the next bytes of a body
MAX_UPLOAD = 2 << 30  # bytes of an uploaded recording: an hour of ten channels at 5 kHz
UPLOAD = ("POST", "/api/recordings")
RATE, BURST = 40.0, 200.0  # requests/s and at once, of one address
GUESSES, GUESS_BURST = 0.2, 10.0  # wrong tokens/s and at once, of one address
MOST_ADDRESSES = 4096
MAX_NAME = 40  # characters
DRIVES = "who drives"  # as whom requests with the lease are counted


@dataclass(frozen=True, slots=True)
class Person:
    """Who asks, and from where. role : None for somebody who showed no token. name : "" for
    somebody who gave none."""

    name: str
    role: Role | None
    address: str = ""

    @property
    def signed(self) -> str:
        """Who it was, for what is written down."""
        return f"{self.name or 'somebody'} at {self.address}" if self.address else self.name

    @property
    def drives(self) -> bool:
        """Whether they may move the rig."""
        return self.role == "operator"


class Tokens:
    """Names, roles and SHA-256 of tokens, in a file of JSON.

    A token is 256 random bits, so that a plain hash of it cannot be guessed back.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known = self._read()

    def _read(self) -> list[dict[str, str]]:
        try:
            found = json.loads(self.path.read_text(encoding="utf-8"))
            for item in found:
                if set(item) != {"name", "role", "sha256"} or item["role"] not in (
                    "viewer",
                    "operator",
                ):
                    raise ValueError(item)
        except FileNotFoundError:
            return []
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                "--tokens", "", str(self.path), "a file that --new-token made"
            ) from error
        return list(found)

    def add(self, name: str, role: Role) -> str:
        """A new token, which is shown this once; InputError if it cannot be kept."""
        if not 0 < len(name) <= 40 or not name.isprintable():
            raise InputError("--new-token", "", name, "a name of 1 to 40 characters")
        token = secrets.token_urlsafe(32)
        self.known.append({"name": name, "role": role, "sha256": _hash(token)})
        try:
            self.path.touch(mode=0o600)
            self.path.write_text(json.dumps(self.known, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            expected = f"a file that can be written ({error.strerror})"
            raise InputError("--tokens", "", str(self.path), expected) from error
        return token

    def person(self, token: str, address: str = "") -> Person | None:
        """Whose token it is; every one is compared, in constant time."""
        given, found = _hash(token), None
        for item in self.known:
            if hmac.compare_digest(given, item["sha256"]):
                found = item
        if found is None:
            return None
        role: Role = "operator" if found["role"] == "operator" else "viewer"
        return Person(found["name"], role, address)


def claimed(name: str, address: str) -> Person:
    """Somebody of this machine, where no tokens tell who it is: by the name that they give."""
    name = "".join(c for c in name if c.isprintable()).strip()[:MAX_NAME]
    return Person(name, "operator", address)


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


class Buckets:
    """So many at once and so many a second, by address."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def left(self, address: str) -> float:
        """What this address has left."""
        left, at = self._left.get(address, (self._burst, 0.0))
        return min(self._burst, left + self._rate * (time.monotonic() - at))

    def take(self, address: str) -> bool:
        """Take one; False if there is none."""
        left = self.left(address)
        self._left[address] = (max(0.0, left - 1.0), time.monotonic())
        self._left.move_to_end(address)
        while len(self._left) > MOST_ADDRESSES:
            self._left.popitem(last=False)
        return left >= 1.0


class Guard:
    """Lets through what may pass, with who asks as `scope["state"]["person"]`, and as whom what
    they ask is counted as `scope["state"]["counted"]`.

    hosts : names and ports under which the service may be called; a browser that was led here
    by another name (DNS rebinding) is refused.
    crowded : whether this address has so many connections that only a stop is served.
    proxies : addresses whose X-Forwarded-For is believed; nobody else's is.
    holds : whether this is the secret of who drives.
    """

    def __init__(
        self,
        app: App,
        tokens: Tokens | None,
        hosts: frozenset[str],
        tls: bool,
        *,
        crowded: Callable[[str], bool] = lambda address: False,
        proxies: frozenset[str] = frozenset(),
        holds: Callable[[str], bool] = lambda secret: False,
    ) -> None:
        self._app, self._tokens, self._hosts = app, tokens, hosts
        self._crowded, self._proxies, self._holds = crowded, proxies, holds
        self._scheme = "https" if tls else "http"
        self._asked = Buckets(RATE, BURST)
        self._guessed = Buckets(GUESSES, GUESS_BURST)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Judge one request or WebSocket."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        refused = self._judged(scope, headers)
        if refused is not None:
            await _refuse(scope, send, *refused)
            return
        if scope["type"] == "http":
            most = MAX_UPLOAD if (scope["method"], scope["path"]) == UPLOAD else MAX_BODY
            length = headers.get("content-length", "0")
            if not length.isdecimal() or int(length) > most:
                await _refuse(
                    scope, send, 413, f"a request of {length} bytes; expected at most {most}"
                )
                return
            receive = _bounded(receive, most)
        await self._app(scope, receive, send)

    def _judged(self, scope: Scope, headers: dict[str, str]) -> tuple[int, str] | None:
        """Status and line of a refusal; None to let it pass."""
        peer = scope["client"][0] if scope.get("client") else ""
        address = self._came_from(peer, headers)
        path, token = scope["path"], token_of(headers)
        known = self._tokens.person(token, address) if self._tokens and token else None
        person = known or self._unknown(scope, headers, address)
        scope.setdefault("state", {})["person"] = person
        # The stop is for everybody, always: no token, no rate, whoever called us by what name.
        if path == STOP:
            return None
        if self._crowded(peer):
            return 503, "too many connections; expected a try in some seconds"
        if (size := _head(scope)) > MAX_HEAD:
            return 431, f"a head of {size} bytes; expected at most {MAX_HEAD}"
        host = headers.get("host", "").lower()
        if host not in self._hosts:
            return 421, f"called as {host[:80]!r}; expected one of {', '.join(sorted(self._hosts))}"
        # A token of 256 bits is not guessed, at whatever rate: who shows a right one is heard, and
        # counted by their name, whatever others at the same address do. So is who drives.
        if self._tokens is not None and token and known is None and not self._guessed.take(address):
            return 429, "too many wrong tokens; wait a minute"
        counted = f"token of {known.name}" if known else address
        if self._holds(headers.get("x-lease", "")):
            counted = DRIVES
        scope["state"]["counted"] = counted
        if not self._asked.take(counted):
            return 429, "too many requests; expected fewer than 40 a second"
        origin = headers.get("origin")
        if origin is not None and origin.lower() not in {f"{s}://{host}" for s in self._schemes()}:
            return 403, f"a page of {origin[:80]!r}; expected one of this service"
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return 403, "asked by a page of another site; expected one of this service"
        if person.role is None and path not in OPEN and not path.startswith(OPEN_FOLDER):
            return 401, "no valid token; expected Authorization: Bearer TOKEN"
        return None

    def _came_from(self, peer: str, headers: dict[str, str]) -> str:
        """The address behind the proxies that are ours: the last that one of them was told by
        somebody else, as what stands before it may be made up."""
        if peer not in self._proxies:
            return peer
        hops = [hop.strip() for hop in headers.get("x-forwarded-for", "").split(",")]
        outside = [hop for hop in hops if hop and hop not in self._proxies]
        return outside[-1][:MAX_NAME] if outside else peer

    def _unknown(self, scope: Scope, headers: dict[str, str], address: str) -> Person:
        """Somebody without a valid token."""
        if self._tokens is not None:
            return Person("", None, address)
        query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
        name = query.get("name", [""])[0] if scope["path"] == STOP else ""
        return claimed(name or unquote(headers.get("x-name", "")), address)

    def _schemes(self) -> tuple[str, ...]:
        # Behind a proxy that ends TLS the page comes by https, and we are asked by http.
        return (self._scheme,) if self._scheme == "https" else ("http", "https")


def _head(scope: Scope) -> int:
    """Bytes of a request's head, within a few: one that comes at once is whole before the
    parser's own limit sees it."""
    lines = sum(len(name) + len(value) + 4 for name, value in scope["headers"])
    return lines + len(scope.get("raw_path") or b"") + len(scope.get("query_string") or b"")


def token_of(headers: dict[str, str]) -> str:
    """The token that a request shows, "" for none."""
    kind, _, token = headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return token.strip()
    for part in headers.get("cookie", "").split(";"):
        name, _, value = part.strip().partition("=")
        if name == COOKIE:
            return value
    return ""


def _bounded(receive: Receive, most: int) -> Receive:
    """A body that claims nothing and goes on for ever ends here, and one that stalls."""
    taken, more = 0, True

    async def bounded() -> MutableMapping[str, Any]:
        nonlocal taken, more
        try:
            # Once the body is whole this waits for the end of the connection.
            message = await asyncio.wait_for(receive(), BODY_WITHIN if more else None)
        except TimeoutError:
            return {"type": "http.disconnect"}
        more = bool(message.get("more_body"))
        taken += len(message.get("body", b""))
        if taken > most:
            return {"type": "http.disconnect"}
        return message

    return bounded


async def _refuse(scope: Scope, send: Send, status: int, line: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 4000 + status, "reason": line[:120]})
        return
    body = json.dumps({"error": line}).encode()
    headers = [(b"content-type", b"application/json"), (b"connection", b"close")]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
