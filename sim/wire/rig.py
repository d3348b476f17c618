"""The simulated rig on a pseudo-terminal, in real time, with faults on command.

Commands, one a line, on standard input or in a script (each with its time in s before it):

    line up|down loss|flip|duplicate|reorder P   the line to or from the node gets worse
    stall S          nothing passes for S seconds, then everything that waited
    unplug | plug    the port vanishes; comes back, under another name
    reboot [SAMPLE [CLOCK]]   the node starts again, counting from SAMPLE, its clock from CLOCK us
    clock US         the node's clock jumps by so much
    rest             the same, and the rig itself at rest
    emergency 0|1    the emergency input
    jump COUNTS      the first encoder reads so much more from now on
    rail INDEX 0|1   an analogue input is at the end of its range, or no longer
    offset NAME COUNTS   a sensor or monitor reads so much more from now on
    drift NAME COUNTS    it reads so much more every second
    freeze NAME 0|1      it repeats one value, or no longer
    supply 0|1       the node's supply line is broken, or works again (no image has that)
    stray COUNTS [OUTPUT]  the converter of an output, or of the first, holds so much more than the
                     node puts out (no image has that)
    image WHAT       of a node that is an image: it hangs, faults, ... (sim/wire/emulator.py)
    history          one line of JSON: what the output did
    quit
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import select
import stat
import sys
import time
import tty
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np

from samii_rig.devices.channels import centring_name
from samii_rig.errors import InputError
from samii_rig.rig.schema import Rig
from sim.settings import SimSettings
from sim.wire.emulator import WRONG, Emulator
from sim.wire.image import ImageNode
from sim.wire.line import FAULTS, Line
from sim.wire.node import Node
from sim.wire.plant import NULLS, Board, Plant, board
from sim.wire.protocol import RAILS, WORD, NodeConfig, OutputConfig

KEPT = 20_000  # samples of the output's history
MAX_JUMP = 0.05  # rad a sample of the first encoder beyond which the node trips
READ = 4096  # bytes


class WireRig:
    """Plant, node and port; `run` paces them."""

    def __init__(
        self,
        rig: Rig,
        settings: SimSettings,
        link: Path | None,
        *,
        supply: bool = False,
        image: Path | None = None,
    ) -> None:
        self.board: Board = board(self._wired(rig))
        if supply:
            self.board = replace(self.board, supply=True)
        self._link = link
        self._plant = Plant(rig, self.board, settings)
        n_encoder = 1 + max((w.index for w in self.board.encoder.values()), default=-1)
        n_adc = 1 + max((w.index for w in self.board.adc.values()), default=-1)
        first, *beside = self._outputs(rig)
        self._config = NodeConfig(
            period_ns=round(1e9 / rig.rate_hz),
            deadman_ms=round((rig.actuator[0].deadman or 0.05) * 1e3),
            n_encoder=n_encoder,
            n_adc=n_adc,
            null=first.null,
            max_jump=first.max_jump,
            beside=tuple(beside),
        )
        self._nulls = tuple(o.null for o in self._config.outputs)
        self._emulator = Emulator(image) if image else None
        self._node = self._booted(1, 0)
        self.pace = 1.0  # of real time in one second of the node's clock
        self._due = 0  # ns, host's time at which the newest sample was due
        self._late = 0  # ns by which the latest sample was late
        self._clock = 0  # us at the node's boot
        up, down = np.random.SeedSequence(settings.seed).spawn(2)
        self._lines = {
            "up": Line(np.random.default_rng(up)),
            "down": Line(np.random.default_rng(down)),
        }
        self._stalled = 0.0
        self._emergency, self._jump = False, 0
        self._rails: set[int] = set()
        self._offset: dict[str, float] = {}
        self._drift: dict[str, float] = {}
        self._frozen: dict[str, int | None] = {}
        self._stray: dict[int, int] = {}
        self._relay = True
        self._taken = 0  # samples since boot
        self._told = 0  # sample at which a command was carried out last
        self._history: deque[tuple[int, tuple[int, ...], int]] = deque(maxlen=KEPT)
        self._master = self._slave = -1
        self.port = ""
        self.plug()

    # Port

    def plug(self) -> None:
        """A port, under a name that the system chooses; `link` leads to it."""
        if self._master >= 0:
            return
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self.port)

    def unplug(self) -> None:
        """The port vanishes under whoever has it open; the node runs on."""
        if self._master >= 0:
            os.close(self._slave)
            os.close(self._master)
            self._master = self._slave = -1
        if self._link is not None:
            self._link.unlink(missing_ok=True)

    def close(self) -> None:
        """The port vanishes for good."""
        self.unplug()
        if self._emulator is not None:
            self._emulator.close()

    # Time

    def run(self, script: list[tuple[float, str]]) -> None:
        """Until `quit`, or the end of standard input where that is a pipe."""
        period = round(self._config.period_ns * self.pace)
        start, n = time.monotonic_ns(), 0
        waiting = sorted(script)
        stdin = [sys.stdin.fileno()]
        text = b""
        while True:
            due = start + n * period
            wait = max(0.0, (due - time.monotonic_ns()) * 1e-9)
            ports = [fd for fd in self._ports() if fd >= 0]
            ready, _, _ = select.select(ports + stdin, [], [], wait)
            if self._master in ready:
                self._receive()
            if stdin and stdin[0] in ready:
                got = os.read(stdin[0], READ)
                if not got:
                    if stat.S_ISFIFO(os.fstat(stdin[0]).st_mode):
                        return
                    stdin = []
                *lines, text = (text + got).split(b"\n")
                for line in lines:
                    if not self.obey(line.decode()):
                        return
            while time.monotonic_ns() >= start + n * period:
                self._due = start + n * period
                self._late = max(self._late, time.monotonic_ns() - self._due)
                n += 1
                self._step()
            while waiting and (time.monotonic_ns() - start) * 1e-9 >= waiting[0][0]:
                if not self.obey(waiting.pop(0)[1]):
                    return
            self._transmit()

    def _booted(self, boot: int, sample: int) -> Node:
        if self._emulator is None:
            return Node(self._config, boot, sample)
        return ImageNode(self._emulator, self._config, boot, sample)

    def _wired(self, rig: Rig) -> Rig:
        """The rig as the node's board sees it."""
        return rig

    def _outputs(self, rig: Rig) -> list[OutputConfig]:
        """What the node has, up to the last one that an actuator is wired to."""
        encoders = self.board.encoder
        usual = next(iter(encoders.values()))
        n = 1 + max(o.index for o in self.board.output.values())
        made = [OutputConfig(null=NULLS[i]) for i in range(n)]
        for a in rig.actuator:
            put = self.board.output[a.name]
            angle = encoders.get(centring_name(rig, a.name), usual)
            jump = round(MAX_JUMP * abs(angle.counts_per_unit))
            made[put.index] = OutputConfig(null=put.null, max_jump=jump)
        return made

    def _ports(self) -> list[int]:
        return [self._master]

    def _step(self) -> None:
        encoders, adcs = self._plant.sense()
        if self._jump:
            encoders = (encoders[0] + self._jump, *encoders[1:])
        if self._offset or self._drift or self._frozen:
            encoders, adcs = self._spoilt(encoders, adcs)
        if self._rails:
            adcs = tuple(RAILS[1] if i in self._rails else a for i, a in enumerate(adcs))
        clock = (self._clock + self._taken * self._config.period_ns // 1000) % WORD
        sample = self._node.sample
        self._node.stray, self._node.relay = self._stray, self._relay
        dac = self._node.take(clock, encoders, adcs, self._emergency)
        self._taken += 1
        dumped = self.board.supply and not self._node.supply
        self._plant.move(self._nulls if dumped else dac)
        v = tuple(d - null for d, null in zip(dac, self._nulls, strict=True))
        self._history.append((sample, v, time.monotonic_ns()))

    def _spoilt(
        self, encoders: tuple[int, ...], adcs: tuple[int, ...]
    ) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The inputs with what is wrong with single sensors."""
        counts = {True: list(encoders), False: list(adcs)}
        period = self._config.period_ns * 1e-9
        for name, change in self._drift.items():
            self._offset[name] = self._offset.get(name, 0.0) + change * period
        for kind, wired in ((True, self.board.encoder), (False, self.board.adc)):
            for name, w in wired.items():
                n = counts[kind][w.index] + round(self._offset.get(name, 0.0))
                if name in self._frozen:
                    held = self._frozen[name]
                    n = self._frozen[name] = n if held is None else held
                counts[kind][w.index] = n if kind else min(max(n, RAILS[0]), RAILS[1])
        return tuple(counts[True]), tuple(counts[False])

    def _receive(self) -> None:
        try:
            data = os.read(self._master, READ)
        except OSError as error:
            if error.errno not in (errno.EIO, errno.EAGAIN):
                raise
            return
        self._node.receive(self._lines["up"].pass_on(data, held=self._held))

    def _transmit(self) -> None:
        self._node.receive(self._lines["up"].pass_on(b"", held=self._held))
        out = self._lines["down"].pass_on(self._node.transmit(), held=self._held)
        if out and self._master >= 0:
            # Nobody reads: the bytes are gone, as on a real line.
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, out)

    @property
    def _held(self) -> bool:
        return time.monotonic() < self._stalled

    # Commands

    def _rest(self) -> None:
        """Plant, wires and history as at the start, no fault anywhere."""
        self._emergency, self._jump, self._rails = False, 0, set()
        self._offset, self._drift, self._frozen = {}, {}, {}
        self._stray, self._relay = {}, True
        self._plant.rest()
        self._history.clear()
        self._late, self._stalled = 0, 0.0
        for line in self._lines.values():
            line.drop()

    def obey(self, line: str) -> bool:
        """Carry out one command; False for quit. InputError for what is none."""
        words = line.split()
        if words and words[0] != "history":
            self._told = self._node.sample
        try:
            match words:
                case []:
                    pass
                case ["quit"]:
                    return False
                case ["line", ("up" | "down") as way, name, p] if name in FAULTS:
                    setattr(self._lines[way], name, float(p))
                case ["stall", seconds]:
                    self._stalled = time.monotonic() + float(seconds)
                case ["unplug"]:
                    self.unplug()
                case ["plug"]:
                    self.plug()
                    self.say(self.hello())
                case ["reboot" | "rest" as what, *start] if len(start) <= 2:
                    sample, self._clock = [*map(int, start), 0, 0][:2] if start else (0, 0)
                    self._node = self._booted(self._node.boot % 0xFFFF + 1, sample)
                    self._taken = 0
                    if what == "rest":
                        self._rest()
                case ["clock", change]:
                    self._clock += int(change)
                case ["emergency", level]:
                    self._emergency = bool(int(level))
                case ["jump", counts]:
                    self._jump += int(counts)
                case ["rail", index, level]:
                    (self._rails.add if int(level) else self._rails.discard)(int(index))
                case ["offset" | "drift" as what, name, change] if name in self.board.names:
                    now = self._offset if what == "offset" else self._drift
                    now[name] = now.get(name, 0.0) + float(change)
                case ["freeze", name, level] if name in self.board.names:
                    self._frozen.pop(name, None)
                    if int(level):
                        self._frozen[name] = None
                case ["supply", level] if self._emulator is None:
                    self._relay = bool(int(level))
                case ["stray", counts, *output] if self._emulator is None and len(output) <= 1:
                    self._stray = {int(output[0]) if output else 0: int(counts)}
                case ["image", what] if isinstance(self._node, ImageNode) and what in WRONG:
                    self._node.wrong(what)
                case ["history"]:
                    self.say(self.history())
                case _:
                    raise ValueError(line)
        except ValueError as error:
            raise InputError(
                "wire rig", "command", line, "one of those in sim/wire/rig.py"
            ) from error
        return True

    def hello(self) -> dict[str, object]:
        """What a program needs to know to open the port."""
        return {"port": self.port, "settings": self.board.settings(self.port)}

    def history(self) -> dict[str, object]:
        """What the output did. fed : sample at which a stream was accepted last; told : the next
        one when a command came last; live : the last sample with another output than null, and its
        time on the system's monotonic clock; ended : the last such sample of each output; most :
        the largest output kept; late : ns by which this process was late at most; v : the output
        that is furthest from null."""
        node, live = self._node, [h for h in self._history if any(h[1])]
        last = live[-1] if live else (-1, (), 0)
        n = len(self._nulls)
        ended = [max((h[0] for h in live if h[1][j]), default=-1) for j in range(n)]
        return {
            "sample": node.sample,
            "state": node.state.name,
            "boot": node.boot,
            "rejected": node.rejected,
            "fed": node.fed,
            "told": self._told,
            "most": max((abs(v) for h in self._history for v in h[1]), default=0),
            "live": last[0],
            "live_ns": last[2],
            "late": self._late,
            "ended": ended,
            "v": max(self._history[-1][1], key=abs) if self._history else 0,
        }

    @staticmethod
    def say(answer: dict[str, object]) -> None:
        """One line of JSON to whoever started this."""
        print(json.dumps(answer), flush=True)
