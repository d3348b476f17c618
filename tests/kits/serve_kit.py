"""What the tests of the service share: one in this process, and one in its own."""

from __future__ import annotations

import json
import os
import signal
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from weakref import WeakKeyDictionary

import httpx
from fastapi import FastAPI
from wait_kit import WITHIN, found

from samii_rig.rig.load import load_rig
from samii_rig.serve.access import Tokens
from samii_rig.serve.app import application, guarded
from samii_rig.serve.rooms import Rooms
from samii_rig.serve.settings import Settings

# The routes of a service are made once; each client has a guard of its own.
_APPS: WeakKeyDictionary[Rooms, FastAPI] = WeakKeyDictionary()
HOST = "127.0.0.1:8340"

# Some seconds of a quiet sweep.
SWEEP = """
experiment = "swept_sine"
name = "short"
actuator = "v_2"
unit = "V"
drive = "output"
sweep = "linear"
start_hz = 1.0
stop_hz = 20.0
duration = {duration}
ramp = 0.5
lead_in = 0.5
ring_down = 1.0
amplitudes = [0.02]
repeats = {repeats}
order = "by_level"
seed = 1
"""


def sweep(duration: float = 4.0, repeats: int = 2) -> str:
    return SWEEP.format(duration=duration, repeats=repeats)


def settings(folder: Path, tokens: Tokens | None = None, **more: Any) -> Settings:
    rig, text = load_rig("samii")
    return Settings(rig, text, folder, tokens=tokens, **more)


def client(rooms: Rooms, headers: dict[str, str] | None = None) -> httpx.AsyncClient:
    """Talks to a service in this process; what it does by itself is not done."""
    if rooms not in _APPS:
        _APPS[rooms] = application(rooms)
    transport = httpx.ASGITransport(app=guarded(rooms, 8340, _APPS[rooms]))  # type: ignore[arg-type]
    return httpx.AsyncClient(transport=transport, base_url=f"http://{HOST}", headers=headers or {})


class Service:
    """`samii-rig serve` in a process of its own, at a free port.

    descriptors : that it may have open at once, 0 for as many as we.
    """

    def __init__(
        self, folder: Path, *options: str, trust: str = "", token: str = "", descriptors: int = 0
    ) -> None:
        self.descriptors = descriptors
        self.folder, self.options, self.port, self.stop_port = folder, options, "0", "0"
        self.trust = ssl.create_default_context(cafile=trust) if trust else True
        self.headers = {"x-name": "Ada"}
        if token:
            self.headers["authorization"] = f"Bearer {token}"
        self.begin()

    def begin(self) -> None:
        program = "from samii_rig.cli import main; main()"
        if most := self.descriptors:
            limited = f"resource.setrlimit(resource.RLIMIT_NOFILE, ({most}, {most}))"
            program = f"import resource; {limited}; {program}"
        ports = ["--port", self.port, "--stop-port", self.stop_port]
        options = ["--folder", str(self.folder), *ports, *self.options]
        self.process = subprocess.Popen(
            [sys.executable, "-c", program, "serve", *options],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the service did not start"
        self.url = line.split(": ", 1)[1].strip()
        self.stop_url = self.process.stdout.readline().split(": ", 1)[1].strip()
        # The same when it is started again.
        self.port, self.stop_port = (str(httpx.URL(u).port) for u in (self.url, self.stop_url))
        self.http = httpx.Client(
            base_url=self.url, timeout=WITHIN, verify=self.trust, headers=self.headers
        )
        self.until(lambda: self.http.get("/api/state").status_code == 200)

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self._gone()

    def _gone(self) -> None:
        self.process.wait(WITHIN)
        assert self.process.stdout is not None
        self.process.stdout.close()
        self.http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.process.poll() is None:
            self.process.terminate()
        self._gone()

    def state(self) -> dict[str, Any]:
        return self.http.get("/api/state").json()

    @contextmanager
    def lease(self, silent: threading.Event | None = None) -> Iterator[dict[str, str]]:
        """Take it, as the headers that show it; signs of life go out until it is given back, or
        until `silent` is set."""
        answer = self.http.post("/api/lease")
        assert answer.status_code == 200, answer.text
        headers = {**self.headers, "x-lease": answer.json()["lease"]}
        done = silent or threading.Event()

        def live() -> None:
            # A client of its own, and one for all: each loads the machine's certificates anew.
            with httpx.Client(base_url=self.url, timeout=WITHIN, verify=self.trust) as client:
                while not done.wait(1.0):
                    # A service that is killed is what some tests are about.
                    with suppress(httpx.TransportError):
                        client.post("/api/lease/beat", headers=headers)

        beats = threading.Thread(target=live, daemon=True)
        beats.start()
        try:
            yield headers
        finally:
            done.set()
            beats.join(WITHIN)
            with suppress(httpx.TransportError, RuntimeError):
                self.http.delete("/api/lease", headers=headers)

    def start(self, lease: dict[str, str], text: str, **more: Any) -> str:
        """Queue a run; its job's id."""
        body = {"experiment_toml": text, "diagnosis": False, "seed": 1, **more}
        answer = self.http.post("/api/runs", headers=lease, json=body)
        assert answer.status_code == 202, answer.text
        return str(answer.json()["jobs"][0]["id"])

    def job(self, id_: str) -> dict[str, Any]:
        return self.http.get(f"/api/jobs/{id_}").json()

    def until(self, what: Any) -> Any:
        """Wait until it is true."""

        def asked() -> Any:
            with suppress(httpx.TransportError, json.JSONDecodeError):
                return what()
            return None

        return found(asked, WITHIN)

    def progressing(self) -> bool:
        """Samples come."""
        running = self.state()["running"]
        return bool(running and running["progress"].get("segment"))


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
