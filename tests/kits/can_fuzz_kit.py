"""Frames on a CAN bus behind an slcan adapter, damaged in every way, past the force/torque
sensor's reader."""

from __future__ import annotations

import random
import re
import struct
from collections import deque
from queue import SimpleQueue
from types import SimpleNamespace
from unittest.mock import patch

import can
from wire_fuzz_kit import Counted, bent

from drivers.force_torque.bus import Slcan
from drivers.force_torque.frames import MATRIX, Frames
from drivers.force_torque.reader import Reader, Reading
from samii_rig.errors import DeviceError

BASE = 0x20
PERIOD = 2_000_000  # ns
TRAVEL = 100_000  # ns from one frame to the next
# Of the status word; written from the protocol, apart from the driver's DBC file.
BITS = {
    0: "WatchdogReset",
    1: "ExcitationHigh",
    2: "ExcitationLow",
    3: "AnalogueGround",
    4: "SupplyHigh",
    5: "SupplyLow",
    7: "Eeprom",
    8: "Configuration",
    9: "GaugeSupplyHigh",
    10: "GaugeSupplyLow",
    11: "ThermistorHigh",
    12: "ThermistorLow",
    13: "Converter",
}
GAUGES, MATRIX_ROW = 0x200, 0x202
# Serial number, counts per unit, units and firmware: what may be asked after a lost reply.
FIXED = {0x205: b"FT-00017", 0x207: bytes(7) + b"d", 0x208: b"\2\3", 0x20F: b"\1\2\0\3"}
SHAPES = {GAUGES: 8, 0x201: 6, MATRIX_ROW: 8, 0x203: 8, 0x204: 8}
SHAPES |= {identifier: len(data) for identifier, data in FIXED.items()}
OURS = range(0x200, 0x210)


def stepped_clock() -> SimpleNamespace:
    """In the place of the module `time`: it is `now`, ns, until somebody moves that."""
    clock = SimpleNamespace(now=0)
    clock.monotonic, clock.monotonic_ns = lambda: clock.now * 1e-9, lambda: clock.now
    return clock


class Bus:
    """The adapter's lines, the sensor behind it, and what happens to its frames on the way.

    truth : of each request, counts and names of status bits that the sensor answered with.
    """

    channel_info = "a bus"

    def __init__(self, rng: random.Random, counted: Counted, frames: int) -> None:
        self.rng, self.counted, self.frames = rng, counted, frames
        self.clock = stepped_clock()
        self.rows = [[rng.randbytes(8) for _ in MATRIX] for _ in range(6)]
        self.begin()

    def begin(self) -> Reader:
        """The bus as new, with a new reader."""
        self.line = _Line()
        self.coming: deque[tuple[int, bytes | can.Message]] = deque()
        self.truth: dict[int, tuple[list[int], set[str]]] = {}
        self.asked = 0
        self.whole = True  # nothing was lost so far
        self.doomed = False  # a frame came that ends the reader
        self.bent: set[int] = set()  # requests after which bytes of the lines were damaged
        self.heard: dict[int, bytes] = {}  # bytes that came after each request
        self.reader = Reader(self, FRAMES, PERIOD)  # type: ignore[arg-type]
        return self.reader

    def send(self, frame: can.Message, timeout: float) -> None:
        """A request, and what comes of it."""
        del timeout
        if frame.arbitration_id == GAUGES:
            self._sample()
        elif (said := FIXED.get(frame.arbitration_id)) is not None:
            self._put([(frame.arbitration_id, said)] if self.rng.random() < 0.8 else [])
        else:
            self._row(frame.data[0])

    def recv(self, seconds: float) -> can.Message | None:
        """As python-can's, on this clock."""
        if self.counted.sent >= self.frames:
            self.reader._ending.set()
        found = self.line._recv_internal(0)[0]
        until = self.clock.now + round(seconds * 1e9) + 1
        if found is not None:
            return found
        if not self.coming or self.coming[0][0] > until:
            self.clock.now = until
            return None
        when, what = self.coming.popleft()
        self.clock.now = max(self.clock.now, when)
        if isinstance(what, can.Message):
            return what
        self.heard[self.asked] = self.heard.get(self.asked, b"") + what
        self.line.serialPortOrig.waiting += what
        return self.line._recv_internal(0)[0]

    def good(self, r: Reading) -> bool:
        """Whether it is what the sensor answered to this request, or, as slcan has no checksum,
        what its damaged bytes spell."""
        around = {r.number - 1, r.number}
        lines = b"".join(self.heard.get(n, b"") for n in sorted(around))
        counts, names = r.gauges.counts.tolist(), set(r.gauges.status)
        if self.truth.get(r.number) == (counts, names):
            return True
        status = sum(1 << bit for bit, name in BITS.items() if name in names)
        unnamed = sum(1 << bit for bit in range(16) if bit not in BITS)
        first, second = struct.pack(">3h", *counts[::2]), struct.pack(">3h", *counts[1::2])
        spelt = {
            int(word, 16) & ~unnamed
            for word in re.findall(rb"t2008([0-9A-Fa-f]{4})(?i:%s)" % first.hex().encode(), lines)
        }
        return (
            not around.isdisjoint(self.bent)
            and status in spelt
            and re.search(rb"t2016(?i:%s)" % second.hex().encode(), lines) is not None
        )

    def _sample(self) -> None:
        rng = self.rng
        self.counted.wrong += self.doomed  # and it goes on
        self.asked += 1
        status = rng.choice((0, 0, 0, rng.randrange(1 << 16)))
        g = [rng.choice((rng.randrange(-32768, 32768), 32767, -32768)) for _ in range(6)]
        self.truth[self.asked] = g, {name for bit, name in BITS.items() if status >> bit & 1}
        own = [
            (GAUGES, struct.pack(">H3h", status, *g[::2])),
            (GAUGES + 1, struct.pack(">3h", *g[1::2])),
        ]
        if rng.random() < 0.5:
            self._put(own)
            return
        self.counted.damaged += 2
        at = rng.randrange(2)
        frames: list[tuple[int, bytes] | bytes | can.Message] = list(own)
        delay = 0
        match rng.randrange(8):
            case 0:
                del frames[at]
                if rng.random() < 0.3:
                    frames.clear()
                self.whole = False
            case 1:
                identifier, data = _stranger(rng)
                frames.insert(rng.randrange(3), (identifier, data))
                self.doomed = self.whole and identifier in OURS
            case 2:
                frames.insert(rng.randrange(at, 3), own[at])
                self.doomed = self.whole
            case 3:
                frames.reverse()
                self.whole = False
            case 4:
                frames[at] = _other_form(rng, *own[at])
                self.whole = False
            case 5:
                delay = rng.randrange(15_000_000, 90_000_000)
                self.whole = False
            case 6:
                lines = b"".join(_line("t", *frame) for frame in own)
                frames = [bent(rng, lines, _line("t", *own[at]))[0]]
                self.bent.add(self.asked)
                self.whole = False
            case _:
                frames.insert(rng.randrange(3), _error(rng))
                self.doomed = True
        self._put(frames, delay)

    def _row(self, i: int) -> None:
        rng = self.rng
        own = [(MATRIX_ROW + k, data) for k, data in enumerate(self.rows[i])]
        frames: list[tuple[int, bytes] | bytes | can.Message] = list(own)
        match rng.randrange(8):
            case 0:
                del frames[rng.randrange(3)]
            case 1:
                at = rng.randrange(3)
                frames[at] = _other_form(rng, *own[at])
            case 2:
                frames.insert(rng.randrange(3), _error(rng))
            case _:
                pass
        self._put(frames)

    def _put(self, frames: list, delay: int = 0) -> None:
        when = self.clock.now + delay
        for frame in frames:
            when = max(when + TRAVEL, self.coming[-1][0] if self.coming else 0)
            what = _line("t", *frame) if isinstance(frame, tuple) else frame
            self.coming.append((when, what))
            self.counted.sent += 1


class _Line(Slcan):
    """The driver's reader of lines, without a port."""

    def __init__(self) -> None:
        self._queue, self._buffer, self._is_shutdown = SimpleQueue(), bytearray(), True
        self.serialPortOrig = _Port()


class _Port:
    def __init__(self) -> None:
        self.waiting = b""

    @property
    def in_waiting(self) -> int:
        return len(self.waiting)

    def read(self, size: int) -> bytes:
        came, self.waiting = self.waiting[:size], self.waiting[size:]
        return came


def sensor(rng: random.Random, frames: int) -> Counted:
    """A row of the calibration is asked, then samples, until something ends it; then anew. Frames
    are lost, come twice, late, in another order, of another length or kind, from another sender,
    as errors of the controller, or as lines with other bytes.

    wrong : also a row that is not the sensor's, a reader that goes on after a frame of another
    sender or an error, and one that ends by an error that is not ours.
    """
    counted = Counted()
    bus = Bus(rng, counted, frames)
    with patch("drivers.force_torque.reader.time", bus.clock):
        while counted.sent < frames:
            reader = bus.begin()
            row = rng.randrange(6)
            try:
                counted.wrong += reader.ask(*MATRIX, data=bytes([row])) != bus.rows[row]
            except DeviceError:
                continue
            newest = -1
            reader._thread = SimpleNamespace(start=reader._run)  # type: ignore[assignment]
            reader.start()
            counted.wrong += "the reader has ended" in reader.trouble or "\n" in reader.trouble
            for r in reader.samples:
                counted.accepted += 1
                counted.wrong += not (r.number > newest and bus.good(r))
                newest = r.number
    return counted


def _line(kind: str, identifier: int, data: bytes) -> bytes:
    """slcan's; a remote frame has a length and no data."""
    digits = 8 if kind in "TR" else 3
    text = "" if kind in "rR" else data.hex().upper()
    return f"{kind}{identifier:0{digits}X}{len(data)}{text}\r".encode()


def _stranger(rng: random.Random) -> tuple[int, bytes]:
    identifier = rng.choice(
        (rng.choice(OURS), rng.choice((GAUGES, GAUGES + 1)), rng.randrange(2048))
    )
    length = SHAPES.get(identifier, 8) if rng.random() < 0.5 else rng.randrange(9)
    return identifier, rng.randbytes(length)


def _other_form(rng: random.Random, identifier: int, data: bytes) -> bytes:
    """The frame as another: remote, extended, of CAN FD, of another length or identifier."""
    match rng.randrange(4):
        case 0:
            return _line(rng.choice("rRTdb"), identifier, data)
        case 1:
            length = rng.choice([n for n in range(9) if n != len(data)])
            return _line("t", identifier, (data + data)[:length])
        case 2:
            return _line("T", rng.randrange(1 << 29), data)
        case _:
            return _line("t", rng.choice([i for i in range(0x1F8, 0x218) if i != identifier]), data)


def _error(rng: random.Random) -> can.Message:
    """Its identifier says what is wrong, and may be one of the sensor's."""
    identifier = rng.choice((rng.choice(OURS), rng.randrange(1 << 29)))
    return can.Message(
        arbitration_id=identifier, is_extended_id=False, is_error_frame=True, data=rng.randbytes(8)
    )


FRAMES = Frames(BASE)
