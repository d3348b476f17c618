"""A stand-in for nidaqmx and a board behind it: sample clock, buffer, watchdog, in real time.

Only what NI documents is there, with the names of the package; what a board refuses it refuses in
NI's words. An output turns an encoder: ao0 ctr0, ao1 ctr1.
"""

from __future__ import annotations

import threading
import time
from types import ModuleType, SimpleNamespace

import numpy as np

TURN = 0.5  # rad/s that one volt at an output turns its encoder
PLACES = 2  # outputs, and encoders
HOLD = 0.1  # s after the last edge at port0/line0 that the interlock stays closed
# s of a deadman whose end by the device, at nine tenths, comes 50 ms before the watchdog's: so late
# a loaded machine may be.
PATIENT = 0.5
UNDERFLOW = "-200290: The generation has stopped to prevent the regeneration of old samples."
EXPIRED = "-200678: Writing failed, because the watchdog timer expired."
CONSTANTS = SimpleNamespace(
    AcquisitionType=SimpleNamespace(CONTINUOUS="continuous"),
    EncoderType=SimpleNamespace(X_4="x4"),
    AngleUnits=SimpleNamespace(RADIANS="rad"),
    RegenerationMode=SimpleNamespace(DONT_ALLOW_REGENERATION="once"),
    TaskMode=SimpleNamespace(TASK_COMMIT="commit"),
    WatchdogAOExpirState=SimpleNamespace(VOLTAGE="voltage"),
)


class Board:
    """One sample clock. `outs` are the voltages at the terminals, `out` that at ao0, `volts` that
    at all inputs but the read-backs; `broken` says which task's calls fail: ai, ci, ao (what is
    played out), null (a single value), do (the line), made (that there is a task at all), or the
    name of an output's channel. stray : V by which a terminal is off."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.rate, self.begun, self.k = 500.0, 0.0, 0
        self.outs, self.strays = [3.0, -2.0], [0.0] * PLACES  # a board keeps its last voltages
        self.volts, self.theta = 0.5, [0.0] * PLACES
        # At each sample: outputs before it, angles.
        self.seen: list[tuple[list[float], list[float]]] = []
        self.player: Task | None = None
        self.tasks: list[Task] = []
        self.watchdog: Watchdog | None = None
        self.broken: set[str] = set()
        self.resets = 0
        self.level, self.edge = False, -np.inf  # of the line, and when it was last, s
        self.calls: list[tuple[str, str]] = []
        self.error = "-50405: No transfer is in progress\nbecause the board is gone."

    @property
    def out(self) -> float:
        return self.outs[0]

    @property
    def stray(self) -> float:
        return self.strays[0]

    @stray.setter
    def stray(self, volts: float) -> None:
        self.strays[0] = volts

    def advance(self) -> None:
        """Up to now."""
        now = time.monotonic()
        w = self.watchdog
        due = int((now - self.begun) * self.rate) if self.begun else 0
        while self.k < due:
            self._watch(self.begun + self.k / self.rate)
            off = [v + more for v, more in zip(self.outs, self.strays, strict=True)]
            self.seen.append((off, list(self.theta)))
            self.k += 1
            if self.player is not None:
                self.player.edge()
            for i, v in enumerate(self.outs):
                self.theta[i] += TURN * v / self.rate
        if w is not None:
            self._watch(now)

    @property
    def closed(self) -> bool:
        """Whether the interlock lets the valve have its power."""
        return time.monotonic() - self.edge < HOLD

    def _watch(self, now: float) -> None:
        w = self.watchdog
        if w is not None and w.running and not w.expired and now - w.reset > w.timeout:
            w.expired, self.player = True, None
            for place, volts in w.states.items():
                self.outs[place] = volts

    def check(self, kind: str, rows: list[str] | tuple[()] = ()) -> None:
        self.advance()
        if self.watchdog is not None and self.watchdog.expired:
            raise RuntimeError(EXPIRED)
        if kind in self.broken or self.broken & set(rows):
            raise RuntimeError(self.error)


class Task:
    board: Board

    def __init__(self) -> None:
        self.board.check("made")
        self.kind, self.open, self.rows, self.given = "", True, [], 0
        self.buffer: list[list[float]] = []  # a row of all channels for each sample
        self.error, self.timed = "", False
        chans = {
            "ai": ("ai_channels", "add_ai_voltage_chan"),
            "ci": ("ci_channels", "add_ci_ang_encoder_chan"),
            "ao": ("ao_channels", "add_ao_voltage_chan"),
            "do": ("do_channels", "add_do_chan"),
        }
        for kind, (group, add) in chans.items():
            add_one = lambda name, kind=kind, **more: self.add(kind, name)  # noqa: E731
            setattr(self, group, SimpleNamespace(**{add: add_one}))
        self.timing = SimpleNamespace(cfg_samp_clk_timing=self.clock)
        self.out_stream = OutStream()
        self.in_stream = InStream(self)
        self.board.tasks.append(self)

    def add(self, kind: str, name: str) -> None:
        self.kind = "null" if kind == "ao" else kind
        self.rows.append(name)

    def clock(self, rate, source="", sample_mode="", samps_per_chan=0) -> None:
        assert sample_mode == "continuous"
        assert rate == self.board.rate
        assert (source == "") == (self.kind == "ai")
        self.board.calls.append((self.kind, source))
        self.timed = True
        self.kind = "ao" if self.kind == "null" else self.kind

    def control(self, mode: str) -> None:
        assert mode == "commit"

    def start(self) -> None:
        b = self.board
        with b.lock:
            b.check(self.kind)
            b.calls.append(("start", self.kind))
            if self.kind == "ao":
                assert self.out_stream.regen_mode == "once"
                assert self.buffer
                assert b.player is None, "two tasks play out"
                b.player = self
            elif self.kind == "ai":
                b.begun = time.monotonic()

    def edge(self) -> None:
        """The sample clock, where this task plays out."""
        if self.buffer:
            self.put(self.buffer.pop(0))
        else:
            self.error, self.board.player = UNDERFLOW, None

    def put(self, volts: list[float]) -> None:
        for name, v in zip(self.rows, volts, strict=True):
            self.board.outs[place(name)] = v

    def write(self, data, auto_start, timeout) -> None:
        b = self.board
        with b.lock:
            b.check(self.kind, self.rows)
            if self.error:
                raise RuntimeError(self.error)
            if self.kind == "do":
                assert auto_start
                assert self.rows == ["Dev1/port0/line0"]
                if data is not b.level:
                    b.level, b.edge = data, time.monotonic()
            elif not self.timed:
                assert auto_start
                assert b.player is None, "the output is reserved by what plays out"
                # A number for one channel, a list for several.
                assert np.ndim(data) == (len(self.rows) > 1)
                self.put(np.atleast_1d(data).tolist())
            else:
                assert np.isfinite(data).all()
                assert np.ndim(data) == (1 if len(self.rows) == 1 else 2)
                each = np.atleast_2d(data)
                assert len(each) == len(self.rows), (
                    "-200524: the data of another number of channels"
                )
                self.buffer += each.T.tolist()

    def read(self, n: int, timeout: float):
        b = self.board
        with b.lock:
            b.check(self.kind)
            part = b.seen[self.given : self.given + n]
            self.given += n
            if self.kind == "ci":
                return [theta[place(self.rows[0])] for _, theta in part]
            rows = [
                [v[place(name)] if "ao" in name else b.volts for v, _ in part] for name in self.rows
            ]
            return rows if len(rows) > 1 else rows[0]

    def close(self) -> None:
        with self.board.lock:
            self.board.advance()
            self.open = False
            if self.board.player is self:
                self.board.player = None  # the terminal keeps its voltage


def place(name: str) -> int:
    """Of an output, a read-back or a counter."""
    return next(i for i in range(PLACES) if f"ao{i}" in name or f"ctr{i}" in name)


class OutStream:
    __slots__ = ("output_buf_size", "regen_mode")


class InStream:
    def __init__(self, task: Task) -> None:
        self.task = task

    @property
    def total_samp_per_chan_acquired(self) -> int:
        with self.task.board.lock:
            self.task.board.check(self.task.kind)
            return self.task.board.k

    @property
    def avail_samp_per_chan(self) -> int:
        return self.total_samp_per_chan_acquired - self.task.given


class Watchdog:
    board: Board

    def __init__(self, device_name: str, timeout: float) -> None:
        self.name, self.timeout = device_name, timeout
        self.states: dict[int, float] = {}
        self.running = self.expired = False
        self.reset = 0.0
        self.board.watchdog = self

    def cfg_watchdog_ao_expir_states(self, states) -> None:
        for channel, volts, kind in states:
            assert kind == "voltage"
            self.states[place(channel)] = volts

    def start(self) -> None:
        assert not any(t.open for t in self.board.tasks), "-201477: tasks are reserved"
        assert self.states
        self.running, self.reset = True, time.monotonic()

    @property
    def volts(self) -> float:
        return self.states[0]

    def reset_timer(self) -> None:
        with self.board.lock:
            self.board.advance()
            if self.expired:
                raise RuntimeError("-200644: The watchdog timer has expired.")
            self.reset = time.monotonic()

    def close(self) -> None:
        with self.board.lock:
            self.board.advance()
            self.running = False
            self.board.watchdog = None


def installed(monkeypatch) -> Board:
    """The package, in the place of the real one; what hangs on it."""
    import sys

    board = Board()

    def reset_device() -> None:
        board.resets += 1
        board.outs, board.watchdog = [0.0] * PLACES, None

    modules = {name: ModuleType(f"nidaqmx.{name}") for name in ("types", "system")}
    modules["constants"] = CONSTANTS
    modules["system.watchdog"] = ModuleType("nidaqmx.system.watchdog")
    modules["types"].AOExpirationState = lambda *fields: fields
    modules["system"].Device = lambda name: SimpleNamespace(reset_device=reset_device)
    modules["system"].watchdog = modules["system.watchdog"]
    modules["system.watchdog"].WatchdogTask = type("W", (Watchdog,), {"board": board})
    top = ModuleType("nidaqmx")
    top.Task = type("T", (Task,), {"board": board})
    for name in ("constants", "types", "system"):
        setattr(top, name, modules[name])
    monkeypatch.setitem(sys.modules, "nidaqmx", top)
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, f"nidaqmx.{name}", module)
    return board
