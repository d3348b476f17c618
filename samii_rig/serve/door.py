"""Who is let in, before a byte of what they say is understood.

A `Door` accepts connections itself, in place of the web framework: it knows how many there are and
who still owes the end of a request's head. When it is full the oldest of those goes, so that
someone who comes with a whole request, such as a stop, always gets in.
"""

from __future__ import annotations

import asyncio
import resource
import socket
import ssl
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress

HEAD_WITHIN = 10.0  # s that a head may take: a phone's line at its worst needs two
LOOK = 0.5  # s between looks at who owes a head
ACCEPT_AGAIN = 0.05  # s until the next try where the system has no descriptor to accept with
BACKLOG = 1024  # connections that wait in the system: those of an attack, all at once
# A page holds up to 6 connections and a WebSocket; 64 viewers are let in (see `viewers`).
MOST = 512
EACH = 256  # of one address: a lab behind one router
RESERVE = 32  # of either, which only a stop may use
# Descriptors that are no connection's: workers' pipes, the index, recordings that are read.
OTHERS = 256
OF_A_GUEST = 2  # descriptors: its socket, and a file that is sent to it
WISHED = 4096  # descriptors, where the system lets us have them


def room() -> int:
    """How many connections the descriptors of this process allow, after asking for more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wished = WISHED if hard == resource.RLIM_INFINITY else min(WISHED, hard)
    if soft != resource.RLIM_INFINITY and soft < wished:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wished, hard))
            soft = wished
    if soft == resource.RLIM_INFINITY:
        return MOST
    return max(2 * RESERVE, min(MOST, (soft - OTHERS) // OF_A_GUEST))


class Guest:
    """One connection.

    since : s, monotonic, from when it owes the whole head of a request, be it that it has begun
    one or that it idles; None while it is served.
    """

    def __init__(self, connection: socket.socket, address: str) -> None:
        self.connection, self.address = connection, address
        self.since: float | None = time.monotonic()
        self.transport: asyncio.BaseTransport | None = None
        self.entering: asyncio.Task[None] | None = None

    def owes(self, head: bool) -> None:
        """Note whether it owes one now."""
        if not head:
            self.since = None
        elif self.since is None:
            self.since = time.monotonic()

    @property
    def gone(self) -> bool:
        """Its descriptor is free again."""
        return self.connection.fileno() < 0

    def leave(self) -> None:
        """Cut it off."""
        if isinstance(self.transport, asyncio.WriteTransport):
            self.transport.abort()
        elif self.entering is not None:
            self.entering.cancel()  # which closes it, see `Door._enter`


class Door:
    """Lets guests in at a listening socket, each to a protocol that `made` makes for it.

    most : connections at once. each : of one address; those of `trusted` addresses, proxies that
    bring everybody, count only among all. tls : for each of them, None without.
    """

    def __init__(
        self,
        listening: socket.socket,
        made: Callable[[Guest], asyncio.Protocol],
        most: int,
        *,
        each: int = EACH,
        trusted: frozenset[str] = frozenset(),
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._listening, self._made, self._tls = listening, made, tls
        self._most, self._each, self._trusted = most, min(each, most), trusted
        self._guests: dict[Guest, None] = {}  # in the order in which they came

    async def open(self) -> None:
        """Let guests in until cancelled."""
        self._listening.setblocking(False)
        self._listening.listen(BACKLOG)
        loop = asyncio.get_running_loop()
        looking = asyncio.create_task(self._look())
        try:
            while True:
                try:
                    connection, peer = await loop.sock_accept(self._listening)
                except OSError:
                    # No descriptor is left, or who knocked is gone.
                    self._forget()
                    await asyncio.sleep(ACCEPT_AGAIN)
                    continue
                self._admit(connection, str(peer[0]) if peer else "")
                # Those who are inside are heard between any two who come.
                await asyncio.sleep(0)
        finally:
            looking.cancel()
            for guest in self._guests:
                if guest.transport is None:
                    guest.leave()

    def crowded(self, address: str) -> bool:
        """Whether only a stop is still served: those who are heard leave the reserve alone."""
        self._forget()
        heard = [g for g in self._guests if g.since is None]
        mine = sum(g.address == address for g in heard)
        limited = address not in self._trusted
        return len(heard) > self._most - RESERVE or (limited and mine > self._each - RESERVE)

    def _admit(self, connection: socket.socket, address: str) -> None:
        if not self._place_for(address):
            connection.close()
            return
        guest = Guest(connection, address)
        self._guests[guest] = None
        guest.entering = asyncio.create_task(self._enter(guest))

    def _place_for(self, address: str) -> bool:
        """Whether there is a place, if need be that of one who owes a head for longest."""
        by = Counter(g.address for g in self._guests)
        if address not in self._trusted and by[address] >= self._each:
            crowd = address
        elif len(self._guests) >= self._most:
            owing = Counter(g.address for g in self._guests if g.since is not None)
            crowd = owing.most_common(1)[0][0] if owing else ""
        else:
            return True
        before = len(self._guests)
        self._forget()
        if len(self._guests) < before:
            return self._place_for(address)
        oldest = next((g for g in self._guests if g.address == crowd and g.since is not None), None)
        if oldest is None:
            return False
        oldest.leave()
        del self._guests[oldest]
        return True

    async def _enter(self, guest: Guest) -> None:
        loop = asyncio.get_running_loop()
        try:
            # Who does not speak TLS, or leaves in the midst of it, is no defect of ours.
            with suppress(OSError):
                guest.transport, _ = await loop.connect_accepted_socket(
                    lambda: self._made(guest),
                    guest.connection,
                    ssl=self._tls,
                    ssl_handshake_timeout=HEAD_WITHIN if self._tls else None,
                )
        finally:
            if guest.transport is None:
                guest.connection.close()

    async def _look(self) -> None:
        while True:
            await asyncio.sleep(LOOK)
            self._forget()
            late = time.monotonic() - HEAD_WITHIN
            for guest in list(self._guests):
                if guest.since is not None and guest.since < late:
                    guest.leave()

    def _forget(self) -> None:
        self._guests = {g: None for g in self._guests if not g.gone}
