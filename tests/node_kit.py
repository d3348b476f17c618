"""The node's portable C core, compiled for this machine, with the Python node's interface."""

from __future__ import annotations

import ctypes
import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sim.wire.protocol import NodeConfig

SOURCE = Path(__file__).resolve().parent.parent / "drivers" / "serial_node"
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
    c.node_sample.restype = ctypes.c_int16
    return c


class _Config(ctypes.Structure):
    _fields_ = (
        ("period_ns", ctypes.c_uint32),
        ("deadman_ms", ctypes.c_uint16),
        ("n_encoder", ctypes.c_uint8),
        ("n_adc", ctypes.c_uint8),
        ("batch", ctypes.c_uint8),
        ("dac_low", ctypes.c_int16),
        ("dac_high", ctypes.c_int16),
        ("null", ctypes.c_int16),
        ("max_output", ctypes.c_uint16),
        ("max_step", ctypes.c_uint16),
        ("max_jump", ctypes.c_int32),
        ("firmware", ctypes.c_uint8 * 16),
        ("serial", ctypes.c_uint8 * 16),
    )


class CompiledNode:
    """`sim.wire.node.Node`, as far as its bytes and counts go."""

    def __init__(self, c: ctypes.CDLL, config: NodeConfig, boot: int, sample: int) -> None:
        self._c, self._node = c, ctypes.create_string_buffer(c.node_size())
        values = [getattr(config, name) for name, _ in _Config._fields_[:-2]]
        text = [(ctypes.c_uint8 * 16)(*x) for x in (config.firmware, config.serial)]
        c.node_init(self._node, ctypes.byref(_Config(*values, *text)), ctypes.c_uint16(boot))
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
    ) -> int:
        e, a = (ctypes.c_int32 * 4)(*encoders), (ctypes.c_int16 * 8)(*adcs)
        return int(self._c.node_sample(self._node, ctypes.c_uint32(clock_us), e, a, int(emergency)))
