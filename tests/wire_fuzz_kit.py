"""Frames of a node, damaged in every way, past the driver's decoder."""

from __future__ import annotations

import random
import struct
from dataclasses import dataclass

from cobs import cobs

from drivers.serial_node.wire import Decoder, Samples
from sim.wire.node import Node
from sim.wire.protocol import NodeConfig

CONFIG = NodeConfig(2_000_000, 50, 1, 3, null=37, max_jump=10**6)


@dataclass(slots=True)
class Counted:
    """Frames sent, and what became of them. wrong : accepted and not what was sent, or not in
    order, or twice."""

    sent: int = 0
    damaged: int = 0
    accepted: int = 0
    wrong: int = 0


def fuzz(rng: random.Random, frames: int) -> Counted:
    """Half of the frames pass as they are; the others lose, gain or turn bytes, come twice, late,
    cut short, with another's tail, or as noise."""
    node, decoder, counted = Node(CONFIG, 3), Decoder(), Counted()
    list(decoder.feed(node.transmit()))
    truth: dict[int, tuple[int, bytes]] = {}
    newest, late = -1, b""
    while counted.sent < frames:
        first = node.sample
        for _ in range(CONFIG.batch):
            adcs = (rng.randrange(-999, 999), rng.randrange(-999, 999), rng.randrange(-999, 999))
            node.take(node.sample * 2000 % 2**32, (rng.randrange(-(2**31), 2**31),), adcs, False)
        data = node.transmit()
        same = _plain(data)
        truth[first] = (same.clock_us, same.data)
        truth.pop(first - 400, None)
        counted.sent += 1
        if rng.random() < 0.5:
            counted.damaged += 1
            data, late = _damaged(rng, data, late)
        for m in decoder.feed(data):
            if isinstance(m, Samples):
                counted.accepted += 1
                good = m.first > newest and truth.get(m.first) == (m.clock_us, m.data)
                counted.wrong += not good
                newest = m.first
            else:
                counted.wrong += 1
    return counted


def _plain(data: bytes) -> Samples:
    """What is in an undamaged frame, without the decoder."""
    p = cobs.decode(data[:-1])
    return Samples(*struct.unpack_from("<IIBBHH", p, 8), p[22:-4])


def _damaged(rng: random.Random, data: bytes, late: bytes) -> tuple[bytes, bytes]:
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
