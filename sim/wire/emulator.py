"""QEMU with the firmware's image, and what stands for the parts of the chip that it has not.

It runs `node.bin` of `make board=qemu` (drivers/serial_node/board) on an STM32F405. The image's
serial port is a socket, its converters and inputs are two pipes: the board tells what it put out,
then waits for the inputs of the next sample. So the rig paces, and how fast the machine is does not
matter.

QEMU has no independent watchdog: `Watchdog` stands in for it. It sees the image's own writes to the
watchdog's registers.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import socket
import struct
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass
from pathlib import Path
from tempfile import mkdtemp
from typing import NamedTuple

from samii_rig.errors import DeviceError, InputError
from samii_rig.run.priority import prioritised
from sim.wire.protocol import MAX_OUTPUTS, WORD, NodeConfig, OutputConfig

QEMU = "qemu-system-arm"
MACHINE = "netduinoplus2"  # the one board with an STM32F405 in QEMU 7.2
WITHIN = 20.0  # s until an image that says nothing hangs; a sample takes 0.2 ms
SILENT = 0.05  # s in which one that was made to hang says nothing
N_ENCODER, N_ADC = 4, 8  # of node.h
# node_config, first sample, boot
TOLD = struct.Struct(f"<IHBBBBxx{'hhhHHxxi' * MAX_OUTPUTS}16s16sIHxx")
INPUTS = struct.Struct(f"<II{N_ENCODER}i{N_ADC}hBBxx")
OUTPUTS = struct.Struct(f"<II{MAX_OUTPUTS}hHBBxx")
READ_AT_ONCE = 1 << 16  # bytes
# What the image is told to do to itself: board_qemu.c.
WRONG = {"reset": 1, "hang": 2, "fault": 3, "supply": 4, "stack": 5}
LSI_HZ = 17_000  # slowest of the watchdog's own clock, by the chip's datasheet
# QEMU 7.2 has the watchdog's registers under the name of its neighbour.
IWDG = b"I2S2ext: unimplemented device write", b"IWDG: unimplemented device write"
KEY_START, KEY_FEED = 0xCCCC, 0xAAAA


class Outputs(NamedTuple):
    """What the board says at the end of a sample.

    went : bytes that it has sent since its start. counts : of each output. handler : whether its
    handler of what is wrong says it, after which it runs no samples.
    """

    went: int
    samples: int
    counts: tuple[int, ...]
    boot: int
    supply: int
    handler: int


@dataclass(slots=True)
class Watchdog:
    """The independent watchdog, as the image's writes set it: RM0090, 21.4."""

    started: bool = False
    divisor: int = 4
    reload: int = 0xFFF
    feeds: int = 0

    def write(self, offset: int, value: int) -> None:
        """One write to a register."""
        if offset == 4:
            self.divisor = 4 << value
        elif offset == 8:
            self.reload = value
        elif value == KEY_START:
            self.started = True
        elif value == KEY_FEED:
            self.feeds += 1

    @property
    def seconds(self) -> float:
        """After which it resets at the latest."""
        return self.divisor * self.reload / LSI_HZ


@contextlib.contextmanager
def _on(cores: Callable[[set[int]], set[int]]) -> Iterator[None]:
    """What is started or runs meanwhile is on some of this process's cores, where there are any."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores(mine) or mine)
    try:
        yield
    finally:
        os.sched_setaffinity(0, mine)


def last_core() -> contextlib.AbstractContextManager[None]:
    """For the emulator: its threads hand each byte to each other, which takes 30 us on one core and
    60 us across two."""
    return _on(lambda mine: {max(mine)})


def other_cores() -> contextlib.AbstractContextManager[None]:
    """For who runs in real time beside it: together they would use up what a core gives to them."""
    return _on(lambda mine: mine - {max(mine)})


class Emulator:
    """One QEMU with the image; `watchdog` is that of the chip, by its registers."""

    def __init__(self, image: Path) -> None:
        qemu = shutil.which(QEMU)
        if qemu is None:
            raise DeviceError(f"no {QEMU}; apt install qemu-system-arm")
        if not image.is_file():
            raise InputError("--image", "", str(image), "node.bin of make board=qemu")
        self._folder = Path(mkdtemp(prefix="samii_rig_node_"))
        names = ("from_rig", "to_rig", "log")
        pipes = {name: self._folder / name for name in names}
        for path in pipes.values():
            os.mkfifo(path)
        # Both ends here, so that nobody waits for the other to open his.
        self._to, self._from, self._log = (os.open(pipes[n], os.O_RDWR) for n in names)
        os.set_blocking(self._log, False)
        listening = [self._listening(name) for name in ("wire", "control")]
        with last_core(), prioritised():
            self._process = subprocess.Popen(
                [
                    *(qemu, "-M", MACHINE, "-kernel", str(image), "-display", "none"),
                    *("-nodefaults", "-serial", "null", "-serial", "chardev:wire"),
                    *("-chardev", f"socket,id=wire,path={self._folder}/wire"),
                    *("-qmp", f"unix:{self._folder}/control"),
                    *("-d", "unimp", "-D", str(pipes["log"])),
                    "-semihosting-config",
                    f"enable=on,target=native,arg={pipes['from_rig']},arg={pipes['to_rig']}",
                ],
                stdin=subprocess.DEVNULL,
            )
        self.wire, self._control = (self._accepted(s) for s in listening)
        self.watchdog = Watchdog()
        self._outputs = 1  # of the node that it is told to be
        self._line = b""
        self.sent = self.came = 0
        self._arrived = b""
        self.booted = self._asked = False

    def _listening(self, name: str) -> socket.socket:
        s = socket.socket(socket.AF_UNIX)
        s.bind(str(self._folder / name))
        s.listen(1)
        s.settimeout(WITHIN)
        return s

    @staticmethod
    def _accepted(s: socket.socket) -> socket.socket:
        with s:
            accepted = s.accept()[0]
        accepted.settimeout(WITHIN)
        return accepted

    @property
    def ended(self) -> str:
        """How QEMU ended, "" while it runs."""
        code = self._process.poll()
        return "" if code is None else f"; QEMU ended with {code}"

    def boot(self, config: NodeConfig, boot: int, sample: int) -> None:
        """What the board is, to an image that starts; `boot` 0: one more than before."""
        c = config
        self.watchdog, self.sent, self.came = Watchdog(), 0, 0
        while select.select([self.wire], [], [], 0.0)[0]:
            self.wire.recv(READ_AT_ONCE)  # of the boot before
        self._arrived = b""
        self._outputs = len(c.outputs)
        numbers = c.period_ns, c.deadman_ms, self._outputs, c.n_encoder, c.n_adc, c.batch
        more = (*c.outputs, *(OutputConfig(),) * (MAX_OUTPUTS - self._outputs))
        limits = [x for o in more for x in astuple(o)]
        os.write(self._to, TOLD.pack(*numbers, *limits, c.firmware, c.serial, sample, boot))
        self.booted = True

    def reset(self) -> None:
        """The chip's reset pin. Only of an image that hangs: one that waits for inputs holds the
        emulator up."""
        commands = ("system_reset",) if self._asked else ("qmp_capabilities", "system_reset")
        self._asked, answered = True, b""
        for command in commands:
            self._control.sendall(json.dumps({"execute": command}).encode())
        while answered.count(b'"return"') < len(commands):
            answered += self._control.recv(READ_AT_ONCE)
        self._listen()

    def send(self, data: bytes) -> None:
        """Bytes to the image's serial port."""
        self.wire.sendall(data)
        self.sent = (self.sent + len(data)) % WORD

    def receive(self, went: int) -> bytes:
        """Bytes from it, up to the last of `went` since its start."""
        n = (went - self.came) % WORD
        while len(self._arrived) < n:
            self._arrived += self.wire.recv(READ_AT_ONCE)
        data, self._arrived = self._arrived[:n], self._arrived[n:]
        self.came = went
        return data

    def sample(
        self,
        clock_us: int,
        encoders: tuple[int, ...],
        adcs: tuple[int, ...],
        emergency: bool,
        wrong: str = "",
    ) -> None:
        """The inputs of one sample; `wrong` : of WRONG, what the image does to itself then."""
        counts = *encoders, *(0,) * (N_ENCODER - len(encoders)), *adcs, *(0,) * (N_ADC - len(adcs))
        what = WRONG[wrong] if wrong else 0
        os.write(self._to, INPUTS.pack(clock_us, self.sent, *counts, emergency, what))

    def outputs(self, within: float) -> Outputs | None:
        """What the image said next, None if it says nothing."""
        wire, ready = self.wire.fileno(), [-1]
        while self._from not in ready:
            ready, _, _ = select.select([self._from, wire], [], [], within)
            # It sends byte by byte, and waits where nobody reads: a socket holds 280 such bytes.
            data = self.wire.recv(READ_AT_ONCE) if wire in ready else b""
            self._arrived += data
            if not data and self._from not in ready:
                return None
        went, samples, *counts, boot, supply, handler = OUTPUTS.unpack(
            os.read(self._from, OUTPUTS.size)
        )
        put = tuple(counts[: self._outputs])
        said = Outputs(went, samples, put, boot, supply, handler)
        self._listen()
        return said

    def _listen(self) -> None:
        """Hand to the watchdog what was written to it."""
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._log, READ_AT_ONCE):
                *lines, self._line = (self._line + data).split(b"\n")
                for line in lines:
                    if line.startswith(IWDG):
                        offset, value = line.rstrip(b")").split(b"offset ")[1].split(b", value ")
                        self.watchdog.write(int(offset, 16), int(value, 16))

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        self.wire.close()
        self._control.close()
        for fd in (self._to, self._from, self._log):
            os.close(fd)
        shutil.rmtree(self._folder)
