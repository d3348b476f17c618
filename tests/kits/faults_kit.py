"""The gate and the loop on the wire-level rig, held in a state, for tests of faults."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event

from fault_host import Nowhere, plan_of
from wire_kit import Wire

from samii_rig.run.client import NOBODY
from samii_rig.run.ending import attempt
from samii_rig.run.interrupts import Interrupts
from samii_rig.run.loop import _Run
from samii_rig.run.pace import LoopSettings
from samii_rig.run.plan import Plan
from samii_rig.safety.judgement import State

STATES = ("safe", "armed", "running")
PATIENCE = 60  # samples in the deadman's 0.12 s: wire_kit.slow_deadman
TICK = 0.003  # s, which a deadman of 50 ms asks for


class Held:
    """A host in this process, in a state until something ends it."""

    def __init__(self, wire: Wire, plan: Plan | None = None, **settings: object) -> None:
        self.wire, self.device = wire, wire.open(**settings)
        self.sink = Memory()
        plan = plan or plan_of(wire.rig, 20.0)
        self.job = _Run(plan, wire.rig, self.device, self.sink, NOBODY, LoopSettings(TICK))
        self.stop, self.signals = Event(), Interrupts()
        self.state = "safe"
        self.ended: tuple[str, str] | None = None
        self.at = 0.0

    @property
    def gate_state(self) -> State:
        return self.job.gate.state

    @property
    def fault(self) -> str:
        return self.job.gate.fault

    def become(self, state: str) -> Held:
        self._guard(lambda: self._become(state))
        assert self.ended is None, self.ended
        return self

    def _become(self, state: str) -> None:
        while self.job.newest < 0:
            time.sleep(0.004)
            self.job._read()
        self.state = state
        if state == "armed":
            self.job.gate.arm(self.job.clock.now())
            self.job._read()
        elif state == "running":
            self.job.begin()
            end = time.monotonic() + 0.25
            while time.monotonic() < end:
                self.job.tick_on(self.stop, self.signals)

    def _guard(self, step: Callable[[], object]) -> None:
        try:
            step()
        except BaseException as error:
            self.at = time.monotonic()
            self.ended = self.job.ended_by(error)

    def on(self, seconds: float) -> Held:
        """Go on for so long, or until it ends."""
        until = time.monotonic() + seconds
        while time.monotonic() < until and self.ended is None:
            self._guard(self._tick)
        return self

    def _tick(self) -> None:
        if self.state == "running":
            self.job.tick_on(self.stop, self.signals)
        else:
            time.sleep(0.004)
            self.job._read()

    def close(self) -> None:
        # The recorder's thread ends whatever became of the device.
        if self.job.queued is not None:
            attempt(self.job.queued.close)
        attempt(self.device.close)


class Memory(Nowhere):
    """What a recorder would get."""

    def __init__(self) -> None:
        self.blocks: list = []
        self.events: list[tuple[str, dict]] = []

    def write(self, block: object) -> None:
        self.blocks.append(block)

    def event(self, time: int, name: str, payload: dict) -> None:
        self.events.append((name, payload))

    def named(self, name: str) -> list[dict]:
        return [p for n, p in self.events if n == name]


@contextmanager
def held(wire: Wire, state: str, **settings: object) -> Iterator[Held]:
    wire.rest()
    host = Held(wire, **settings)
    try:
        yield host.become(state)
    finally:
        host.close()


class Hosts:
    """Host processes that can be killed."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).parent / "fault_host.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parent,
        )

    def start(self, wire: Wire, state: str, path: Path) -> int:
        """Its process, once it is in that state."""
        rig = json.loads(wire.rig.model_dump_json())
        self._ask({"rig": rig, "state": state, "path": str(path)})
        pid, said = "", {}
        while pid not in said:
            line = self._line()
            assert line, "the hosts' own process ended"
            word, who, *more = line.split(maxsplit=2)
            if word == "pid":
                pid = who
            else:  # an earlier host may speak up late
                said[who] = " ".join((word, *more))
        assert said[pid] == "ready", said[pid]
        return int(pid)

    def wait(self, pid: int) -> int:
        """How it ended."""
        self._ask({"wait": pid})
        while not (line := self._line()).startswith(f"exit {pid} "):
            assert line, "the hosts' own process ended"
        return int(line.split()[2])

    def _ask(self, what: dict) -> None:
        assert self.process.stdin
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()

    def _line(self) -> str:
        assert self.process.stdout
        return self.process.stdout.readline().strip()

    def close(self) -> None:
        self.process.communicate("")


def null_of(wire: Wire) -> dict:
    """What the output did, once it is at null."""
    until = time.monotonic() + 3.0
    while (h := wire.history())["v"] != 0:
        assert time.monotonic() < until, h
        time.sleep(0.005)
    return h
