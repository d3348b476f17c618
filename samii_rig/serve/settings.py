"""How the service is started, checked before it listens."""

from __future__ import annotations

import errno
import fcntl
import ipaddress
import os
import socket
import ssl
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from samii_rig.errors import InputError
from samii_rig.index.store import PRIVATE
from samii_rig.rig.schema import Rig
from samii_rig.serve.access import Tokens
from samii_rig.serve.job import JOBS

WHERE = "samii-rig serve"
LOCK = "service.lock"
MAKES_WAY = 3.0  # s in which the stop's listener of a service before us sees that we are there


@dataclass(frozen=True, slots=True)
class Settings:
    """All that the service needs to know. folder : of the recordings.

    tls : certificate and key, None without. tokens : None where everybody who reaches the service
    may drive: on this machine alone. names : under which it may be called, beside its host.
    pace : of a simulated rig, times real time; 0 for as fast as it can.
    foxglove : port of this machine that shows runs to Foxglove, 0 for any; None for none. Its
    protocol has no token: where others must show one, `foxglove_open` says that this is meant.
    stop_port : of the stop's own listener; None for the one after `port`, 0 for any.
    proxies : addresses that bring others' requests, and whose word counts on whose they are.
    """

    rig: Rig
    rig_toml: str
    folder: Path
    host: str = "127.0.0.1"
    port: int = 8340
    tls: tuple[Path, Path] | None = None
    tokens: Tokens | None = None
    names: tuple[str, ...] = ()
    pace: float = 1.0
    foxglove: int | None = None
    foxglove_open: bool = False
    stop_port: int | None = None
    proxies: frozenset[str] = frozenset()

    @property
    def jobs(self) -> Path:
        """The folder of the jobs."""
        return self.folder / PRIVATE / JOBS

    @property
    def lock(self) -> Path:
        """The file that holds the number of the process that works on the folder."""
        return self.folder / PRIVATE / LOCK

    def check(self) -> None:
        """InputError for what cannot work or would let strangers drive."""
        if not 0 <= self.port <= 65535:
            raise InputError(WHERE, "--port", self.port, "0 to 65535")
        if self.stop_port is not None and not 0 <= self.stop_port <= 65535:
            raise InputError(WHERE, "--stop-port", self.stop_port, "0 to 65535")
        for proxy in self.proxies:
            try:
                ipaddress.ip_address(proxy)
            except ValueError as error:
                expected = "the address of a proxy, such as 127.0.0.1"
                raise InputError(WHERE, "--proxy", proxy, expected) from error
        if not is_local(self.host) and self.tls is None:
            expected = "127.0.0.1, or --tls-cert and --tls-key to be reached from elsewhere"
            raise InputError(WHERE, "--host", self.host, expected)
        if (not is_local(self.host) or self.names) and not (self.tokens and self.tokens.known):
            expected = "a file with at least one token, as others than this machine can reach it"
            raise InputError(WHERE, "--tokens", None, expected)
        if self.foxglove is not None and self.tokens is not None and not self.foxglove_open:
            expected = "--foxglove-open beside --tokens, as Foxglove can show no token"
            raise InputError(WHERE, "--foxglove", self.foxglove, expected)
        if self.tls is not None:
            try:
                ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(*self.tls)
            except (OSError, ssl.SSLError) as error:
                said = error.strerror or str(error)
                expected = f"a certificate and its key in PEM ({said})"
                raise InputError(WHERE, "--tls-cert", str(self.tls[0]), expected) from error
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.folder):
                pass
        except OSError as error:
            expected = f"a folder that can be written ({error.strerror})"
            raise InputError(WHERE, "--folder", str(self.folder), expected) from error

    @contextmanager
    def alone(self) -> Iterator[None]:
        """No other service works on this folder meanwhile; InputError if one does already.

        Two would start each other's runs and stop them.
        """
        path = self.lock
        path.parent.mkdir(exist_ok=True)
        with path.open("a+", encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                file.seek(0)
                expected = f"a folder that no other service works on ({file.read(80).strip()} does)"
                raise InputError(WHERE, "--folder", str(self.folder), expected) from error
            file.truncate(0)
            print(f"process {os.getpid()}", file=file, flush=True)
            yield

    def bound(self) -> socket.socket:
        """The socket that listens; InputError if the port is taken or the host is not ours."""
        return self._bound("--port", self.port)

    def bound_for_stop(self) -> socket.socket:
        """That of the stop's own listener, likewise. One that outlived a service makes way."""
        asked = self.stop_port
        if asked is None:
            asked = self.port + 1 if 0 < self.port < 65535 else 0
        until = time.monotonic() + MAKES_WAY
        while True:
            try:
                return self._bound("--stop-port", asked)
            except InputError:
                if time.monotonic() > until:
                    raise
            time.sleep(0.1)

    def _bound(self, option: str, port: int) -> socket.socket:
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        listening = socket.socket(family, socket.SOCK_STREAM)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((self.host, port))
            listening.listen(128)
        except OSError as error:
            listening.close()
            ours = error.errno in (errno.EADDRINUSE, errno.EACCES)
            if ours:
                expected = f"a free port of {self.host} ({error.strerror})"
                raise InputError(WHERE, option, port, expected) from error
            expected = f"an address of this machine ({error.strerror})"
            raise InputError(WHERE, "--host", self.host, expected) from error
        return listening


def is_local(host: str) -> bool:
    """Whether only this machine reaches what listens there."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
