"""The portable C core and the simulated node: the same in, the same counts and bytes out."""

import random
import struct
import zlib

import pytest
from cobs import cobs
from node_kit import CompiledNode, build

from sim.wire.node import Node
from sim.wire.protocol import NodeConfig, Type

CONFIG = NodeConfig(
    2_000_000, 50, 2, 3, null=37, max_output=20000, max_step=9000, max_jump=5000, dac_low=-15000
)


@pytest.fixture(scope="module")
def core(tmp_path_factory):
    return build(tmp_path_factory.mktemp("core"))


def frame(kind, boot, seq, body=b"", version=1):
    p = struct.pack("<BBHI", version, kind, boot, seq) + body
    return cobs.encode(p + struct.pack("<I", zlib.crc32(p))) + b"\0"


class Host:
    """Requests of every kind, sensible ones and others, sometimes damaged."""

    def __init__(self, rng: random.Random, node: Node) -> None:
        self.rng, self.node, self.seq = rng, node, rng.choice([0, 0, 2**31 - 3])

    def speak(self) -> bytes:
        rng = self.rng
        kind = rng.choices(
            [Type.STREAM, Type.CONFIGURE, Type.ZERO, Type.CLEAR, Type.IDENTIFY, 77],
            [20, 6, 1, 2, 1, 1],
        )[0]
        self.seq = (self.seq + rng.choices([1, 0, -3, 2**30], [40, 1, 1, 0.2])[0]) % 2**32
        boot = self.node.boot if rng.random() < 0.97 else rng.randrange(2**16)
        version = 1 if rng.random() < 0.98 else rng.randrange(256)
        data = frame(kind, boot, self.seq, self.body(kind), version)
        if rng.random() < 0.15:
            data = damaged(rng, data)
        return data

    def body(self, kind: int) -> bytes:
        rng, node = self.rng, self.node
        if rng.random() < 0.03:
            return rng.randbytes(rng.randrange(700))
        if kind == Type.CONFIGURE:
            usual = rng.random() < 0.8
            return struct.pack(
                "<BBHiHHiii",
                rng.randrange(2 if usual else 256),
                0 if usual else rng.randrange(3),
                rng.choice([0, 5, 7] if usual else [8, 65535]),
                rng.choice([0, 32942, -70000, 2**31 - 1, -(2**31), rng.randrange(-(2**20), 2**20)]),
                rng.choice([20000, 5000, 0] if usual else [20001]),
                rng.choice([9000, 300, 0] if usual else [65535]),
                rng.choice([2**31 - 1, 40000, 100] if usual else [-1]),
                rng.choice([5000, 900] if usual else [5001, -1]),
                rng.choice([0, 100, -(2**31)]),
            )
        if kind == Type.STREAM:
            n = rng.choice([1, 5, 10, 30, 64])
            first = (
                node.sample + rng.choices([0, 3, 20, 200, 250, -10, -(2**31)], [9] * 4 + [1] * 3)[0]
            )
            body = struct.pack("<IB", first % 2**32, n)
            for _ in range(n):
                body += struct.pack(
                    "<hi", rng.randrange(-9000, 9000), rng.choice([0, 500, -(2**31), 2**31 - 1])
                )
            return body
        return b""


def damaged(rng: random.Random, data: bytes) -> bytes:
    """Lost, flipped, added, doubled."""
    b = bytearray(data)
    what = rng.randrange(5)
    at = rng.randrange(len(b))
    if what == 0:
        del b[at]
    elif what == 1:
        b[at] ^= 1 << rng.randrange(8)
    elif what == 2:
        b.insert(at, rng.randrange(256))
    elif what == 3:
        b += data
    else:
        del b[at:]
    return bytes(b)


def compare(core, seed: int, steps: int) -> set[int]:
    """Run both side by side; the states that were seen."""
    rng = random.Random(seed)
    boot = rng.randrange(1, 2**16)
    sample = rng.choice([0, 2**32 - 50, 2**31 - 20])
    node, c = Node(CONFIG, boot, sample), CompiledNode(core, CONFIG, boot, sample)
    host, seen = Host(rng, node), set()
    encoder, clock = 0, rng.choice([0, 2**32 - 5000])
    for _ in range(steps):
        if rng.random() < 0.25:
            data = host.speak() if rng.random() < 0.97 else rng.randbytes(rng.randrange(900))
            cut = rng.randrange(len(data) + 1)
            for part in (data[:cut], data[cut:]):
                node.receive(part)
                c.receive(part)
        encoder += (
            rng.randrange(-300, 301) if rng.random() < 0.995 else rng.randrange(-(2**30), 2**30)
        )
        encoder = max(min(encoder, 2**31 - 1), -(2**31)) if rng.random() < 0.99 else 0
        adcs = tuple(
            rng.choice([-32768, 32767]) if rng.random() < 0.002 else rng.randrange(-999, 999)
            for _ in range(3)
        )
        clock = (clock + 2000) % 2**32
        inputs = clock, (encoder, -encoder // 2), adcs, rng.random() < 0.002
        assert node.take(*inputs) == c.take(*inputs)
        assert node.supply == c.supply == node.live
        if rng.random() < 0.5:
            room = rng.choice([1, 50, 2048])
            assert node.transmit(room) == c.transmit(room)
        seen.add(int(node.state))
    assert node.transmit() == c.transmit()
    return seen


def test_the_c_core_does_what_the_simulated_node_does(core):
    seen = set().union(*(compare(core, seed, 1500) for seed in range(20)))
    assert seen == {0, 1, 2, 3, 4}, "a state that was never reached is not compared"
