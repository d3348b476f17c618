"""The node's portable C core, compiled for this machine, with the Python node's interface; and a
host that asks a node for everything, sensible or not."""

from __future__ import annotations

import ctypes
import importlib.util
import random
import shutil
import struct
import subprocess
import sys
import zlib
from dataclasses import astuple, replace
from pathlib import Path

import pytest
from cobs import cobs

from sim.wire.node import Node
from sim.wire.protocol import MAX_OUTPUTS, NodeConfig, OutputConfig, Type

SOURCE = Path(__file__).resolve().parents[2] / "drivers" / "serial_node"
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
# What a test needs to hold a node without knowing its layout.
SHIM = """
#include "node.h"
size_t node_size(void);
void node_at(node_t *node, uint32_t sample);
size_t node_size(void) { return sizeof(node_t); }
void node_at(node_t *node, uint32_t sample) { node->sample = sample; }
"""


def compiler() -> list[str] | None:
    """The command of a C compiler: ziglang's, else the system's; None if there is none."""
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "cc"]
    found = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    return [found] if found else None


def build(folder: Path) -> ctypes.CDLL:
    """Compile the core; skips the test where there is no compiler."""
    command = compiler()
    if command is None:
        pytest.skip("no C compiler: pip install ziglang, or any cc in the PATH")
    shim, library = folder / "shim.c", folder / "node.so"
    shim.write_text(SHIM)
    sources = [shim, *sorted(SOURCE.glob("*.c"))]
    flags = [*WARNINGS, "-O1", "-fPIC", "-shared", f"-I{SOURCE}"]
    made = subprocess.run(
        [*command, *flags, *map(str, sources), "-o", str(library)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    c = ctypes.CDLL(str(library))
    c.node_size.restype = c.node_tx.restype = ctypes.c_size_t
    c.node_sample.restype = None
    return c


class _Output(ctypes.Structure):
    _fields_ = (
        ("dac_low", ctypes.c_int16),
        ("dac_high", ctypes.c_int16),
        ("null", ctypes.c_int16),
        ("max_output", ctypes.c_uint16),
        ("max_step", ctypes.c_uint16),
        ("max_jump", ctypes.c_int32),
    )


class _Config(ctypes.Structure):
    _fields_ = (
        ("period_ns", ctypes.c_uint32),
        ("deadman_ms", ctypes.c_uint16),
        ("n_output", ctypes.c_uint8),
        ("n_encoder", ctypes.c_uint8),
        ("n_adc", ctypes.c_uint8),
        ("batch", ctypes.c_uint8),
        ("output", _Output * MAX_OUTPUTS),
        ("firmware", ctypes.c_uint8 * 16),
        ("serial", ctypes.c_uint8 * 16),
    )


class CompiledNode:
    """`sim.wire.node.Node`, as far as its bytes and counts go."""

    def __init__(self, c: ctypes.CDLL, config: NodeConfig, boot: int, sample: int) -> None:
        self._c, self._node = c, ctypes.create_string_buffer(c.node_size())
        outputs = (_Output * MAX_OUTPUTS)(*(_Output(*astuple(o)) for o in config.outputs))
        self._n = len(config.outputs)
        numbers = config.period_ns, config.deadman_ms, self._n, config.n_encoder, config.n_adc
        text = [(ctypes.c_uint8 * 16)(*x) for x in (config.firmware, config.serial)]
        told = _Config(*numbers, config.batch, outputs, *text)
        c.node_init(self._node, ctypes.byref(told), ctypes.c_uint16(boot))
        c.node_at(self._node, ctypes.c_uint32(sample))

    def receive(self, data: bytes) -> None:
        self._c.node_rx(self._node, data, ctypes.c_size_t(len(data)))

    def transmit(self, room: int = 2048) -> bytes:
        out = ctypes.create_string_buffer(room)
        n = self._c.node_tx(self._node, out, ctypes.c_size_t(room))
        return out.raw[:n]

    @property
    def supply(self) -> bool:
        return bool(self._c.node_supply(self._node))

    def take(
        self, clock_us: int, encoders: tuple[int, ...], adcs: tuple[int, ...], emergency: bool
    ) -> tuple[int, ...]:
        e, a = (ctypes.c_int32 * 4)(*encoders), (ctypes.c_int16 * 8)(*adcs)
        counts = (ctypes.c_int16 * MAX_OUTPUTS)()
        clock = ctypes.c_uint32(clock_us)
        self._c.node_sample(self._node, clock, e, a, int(emergency), counts)
        return tuple(counts[: self._n])


CONFIG = NodeConfig(
    2_000_000, 50, 2, 3, null=37, max_output=20000, max_step=9000, max_jump=5000, dac_low=-15000
)
SECOND = OutputConfig(-9000, 20000, -12, 15000, 8000, 4000)
THIRD = OutputConfig(null=0, max_output=30000, max_jump=2**31 - 1)
# Nodes with one output, with two, and with as many as there are.
CONFIGS = (CONFIG, replace(CONFIG, beside=(SECOND,)), replace(CONFIG, beside=(SECOND, THIRD)))


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
        own = self.node.config.version
        version = own if rng.random() < 0.98 else rng.choice([1, 2, rng.randrange(256)])
        data = frame(kind, boot, self.seq, self.body(kind), version)
        if rng.random() < 0.15:
            data = damaged(rng, data)
        return data

    def body(self, kind: int) -> bytes:
        rng, node = self.rng, self.node
        if rng.random() < 0.03:
            return rng.randbytes(rng.randrange(700))
        if kind == Type.CONFIGURE:
            bad = rng.randrange(len(node.config.outputs)) if rng.random() < 0.2 else -1
            return b"".join(
                self.limits(o, usual=j != bad) for j, o in enumerate(node.config.outputs)
            )
        if kind == Type.STREAM:
            n = rng.choice([1, 5, 10, 30, 64]) // len(node.config.outputs) or 1
            first = (
                node.sample + rng.choices([0, 3, 20, 200, 250, -10, -(2**31)], [9] * 4 + [1] * 3)[0]
            )
            body = struct.pack("<IB", first % 2**32, n)
            for _ in range(n * len(node.config.outputs)):
                body += struct.pack(
                    "<hi", rng.randrange(-9000, 9000), rng.choice([0, 500, -(2**31), 2**31 - 1])
                )
            return body
        return b""

    def limits(self, o: OutputConfig, *, usual: bool) -> bytes:
        rng = self.rng
        return struct.pack(
            "<BBHiHHiii",
            rng.randrange(2 if usual else 256),
            0 if usual else rng.randrange(3),
            rng.choice([0, 5, 7] if usual else [8, 65535]),
            rng.choice([0, 32942, -70000, 2**31 - 1, -(2**31), rng.randrange(-(2**20), 2**20)]),
            rng.choice([o.max_output, 5000, 0] if usual else [o.max_output + 1]),
            rng.choice([min(9000, o.max_step), 300, 0] if usual else [65535]),
            rng.choice([2**31 - 1, 40000, 100] if usual else [-1]),
            rng.choice([min(5000, o.max_jump), 900] if usual else [-1]),
            rng.choice([0, 100, -(2**31)]),
        )


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
