"""Frames of a node and of a quadrature counter, damaged in every way, past the driver's decoder."""

from __future__ import annotations

import random
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import serial
from cobs import cobs

from drivers.quadrature.device import Counter as Input
from drivers.quadrature.device import CounterSettings, Quadrature
from drivers.serial_node.wire import Decoder, Samples
from samii_rig.rig.load import load_rig
from samii_rig.types import Quality
from sim.wire.counter import Counter
from sim.wire.node import Node
from sim.wire.protocol import NodeConfig

CONFIG = NodeConfig(2_000_000, 50, 1, 3, null=37, max_jump=10**6)
SCALE, OFFSET = 26000.0, 1000
BLOCK = 64  # frames between two reads of the counter
KEPT = 400  # frames after which a sample is not waited for any more


@dataclass(slots=True)
class Counted:
    """Frames sent, and what became of them. wrong : accepted and not what was sent, or not in
    order, or twice."""

    sent: int = 0
    damaged: int = 0
    accepted: int = 0
    wrong: int = 0


def node(rng: random.Random, frames: int, board: Node | None = None) -> Counted:
    """A node's batches of samples, of the simulated one if no other is given."""
    board, decoder = board or Node(CONFIG, 3), Decoder()
    for _ in range(CONFIG.batch):
        board.take(0, (0,), (0, 0, 0), False)
    list(decoder.feed(board.transmit()))
    truth: dict[int, tuple[int, bytes]] = {}
    newest = -1

    def send() -> bytes:
        first = board.sample
        for _ in range(CONFIG.batch):
            adcs = (rng.randrange(-999, 999), rng.randrange(-999, 999), rng.randrange(-999, 999))
            board.take(board.sample * 2000 % 2**32, (rng.randrange(-(2**31), 2**31),), adcs, False)
        data = board.transmit()
        same = _plain(data)
        truth[first] = (same.clock_us, same.data)
        truth.pop(first - KEPT, None)
        return data

    def judge(data: bytes) -> Iterator[bool]:
        nonlocal newest
        for m in decoder.feed(data):
            if isinstance(m, Samples):
                yield m.first > newest and truth.get(m.first) == (m.clock_us, m.data)
                newest = m.first
            else:
                yield False

    return _passed(rng, frames, send, judge)


def quadrature(rng: random.Random, frames: int) -> Counted:
    """A counter's samples, from its bytes to the values of `read`; its number and its clock wrap
    on the way."""
    board, device = Counter(seq=2**32 - 500, clock_us=2**32 - 300_000), _counter()
    truth: dict[int, tuple[int, float | None]] = {}
    n, newest, fed = board.seq, -1, 0

    def send() -> bytes:
        nonlocal n
        counts = rng.randrange(-(2**31), 2**31), rng.randrange(-(2**31), 2**31)
        missed = rng.choice((0, 0, 0, 1, 2, 3))
        clock = 2**32 - 300_000 + (n - 2**32 + 500) * board.period_us
        truth[n] = clock * 1000, None if missed & 1 else (counts[0] - OFFSET) / SCALE
        truth.pop(n - KEPT, None)
        n += 1
        return board.sample(counts, missed)

    def judge(data: bytes) -> Iterator[bool]:
        nonlocal newest, fed
        for m in device.decoder.feed(data):
            device._take(m, 0)
        fed += 1
        if fed % BLOCK and fed < frames:
            return
        block = device.read()
        for number, when, value, quality in zip(
            block.sequence.tolist(),
            block.time.tolist(),
            block.values[:, 0].tolist(),
            block.quality[:, 0].tolist(),
            strict=True,
        ):
            told = when, None if quality & Quality.MISSING else value
            yield number > newest and truth.get(number) == told
            newest = number

    try:
        return _passed(rng, frames, send, judge)
    finally:
        device.close()


class _Silent(serial.Serial):
    """A port on which nothing comes."""

    in_waiting = 0

    def read(self, size: int = 1) -> bytes:
        time.sleep(0.1)
        return b"" * size


def _counter() -> Quadrature:
    """The device, after it was told who is there."""
    rig = load_rig("samii")[0]
    rig = rig.model_copy(update={"sensor": rig.sensor[:1]})
    name = rig.sensor[0].name
    inputs = {name: Input(index=0, counts_per_unit=SCALE, offset=OFFSET)}
    # Most frames are damaged here: how many end it is another test's.
    settings = CounterSettings(port="x", counters=inputs, max_bad_frames=1e9)
    device = Quadrature(rig, settings, _Silent())
    identify = cobs.encode(_sealed(struct.pack("<BBHI", 1, 16, 0, 1))) + b"\0"
    for told in device.decoder.feed(Counter().receive(identify)):
        device._take(told, 0)
        device._boot = told.boot
    return device


def _sealed(payload: bytes) -> bytes:
    return payload + struct.pack("<I", zlib.crc32(payload))


def _passed(
    rng: random.Random,
    frames: int,
    send: Callable[[], bytes],
    judge: Callable[[bytes], Iterator[bool]],
) -> Counted:
    """Half of the frames pass as they are; the others lose, gain or turn bytes, come twice, late,
    cut short, with another's tail, or as noise. judge : of each that is accepted, if rightly."""
    counted, late = Counted(), b""
    while counted.sent < frames:
        data = send()
        counted.sent += 1
        if rng.random() < 0.5:
            counted.damaged += 1
            data, late = bent(rng, data, late)
        for good in judge(data):
            counted.accepted += 1
            counted.wrong += not good
    return counted


def _plain(data: bytes) -> Samples:
    """What is in an undamaged frame, without the decoder."""
    p = cobs.decode(data[:-1])
    return Samples(*struct.unpack_from("<IIBBHH", p, 8), p[22:-4])


def bent(rng: random.Random, data: bytes, late: bytes) -> tuple[bytes, bytes]:
    """What comes of a frame, with what came of `late` ones; and which is late now."""
    b = bytearray(data)
    at = rng.randrange(len(b))
    what = rng.randrange(9)
    if what == 0:
        del b[at]
    elif what == 1:
        b[at] ^= 1 << rng.randrange(8)
    elif what == 2:
        for _ in range(rng.randrange(2, 30)):
            b[rng.randrange(len(b))] ^= 1 << rng.randrange(8)
    elif what == 3:
        b.insert(at, rng.randrange(256))
    elif what == 4:
        b += data
    elif what == 5:
        return late, data
    elif what == 6:
        b = b[:at] + (late[at:] if late else b"")
    elif what == 7:
        b[at] = 0
    else:
        b += rng.randbytes(rng.randrange(40))
    return bytes(b), late
