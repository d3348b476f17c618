"""The driver of the serial node and a simulated node in one process, without a port between them.

Samples are taken when a test says so, and every byte of both ways is kept.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
from wait_kit import WITHIN, found

from drivers.serial_node import open_rig
from drivers.serial_node.rig import SerialRig
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError
from samii_rig.rig.schema import Rig
from sim.wire.node import Node
from sim.wire.plant import Plant
from sim.wire.protocol import RAILS

IDLE = 0.05  # s that a read of the port waits for bytes
LOOP = DeviceLoop("theta_2", 4.0, 5.0, 2000.0, 0.35)


class Port:
    """What the driver takes for its port. `cut` : of what the host sends, what still arrives.

    steps : what passed, in order: ["up", bytes of the host, the node's bytes after it], and
    ["take", inputs, counts, the node's bytes after it]; bytes in hex.
    """

    def __init__(self, node: Node) -> None:
        self.node, self.cut = node, lambda data: data
        self.steps: list[list[Any]] = []
        self.came = 0  # bytes that the driver could read so far
        self._down = bytearray()
        self._news = threading.Condition()

    @property
    def in_waiting(self) -> int:
        return len(self._down)

    def read(self, n: int) -> bytes:
        with self._news:
            self._news.wait_for(lambda: self._down, IDLE)
            data = bytes(self._down[:n])
            del self._down[:n]
            return data

    def write(self, data: bytes) -> None:
        with self._news:
            arrived = self.cut(data)
            self.node.receive(arrived)
            self.steps.append(["up", arrived.hex(), self._answer()])

    def say(self, data: bytes) -> None:
        """Bytes to the host that the node has not sent."""
        with self._news:
            self._down += data
            self.came += len(data)

    def close(self) -> None:
        """Nothing holds it."""

    def take(self, clock: int, *inputs: Any) -> tuple[int, ...]:
        """One sample; the counts of each output."""
        with self._news:
            counts = self.node.take(clock, *inputs)
            self.steps.append(["take", [clock, *inputs], list(counts), self._answer()])
            return counts

    def _answer(self) -> str:
        data = self.node.transmit()
        self._down += data
        self.came += len(data)
        self._news.notify_all()
        return data.hex()


class Desk:
    """A device whose node stands still between two calls of `run`.

    encoders, adcs, emergency : counts at the node's inputs; with a plant, on top of what it has
    there. nulls : counts of each output's null.
    """

    def __init__(
        self,
        rig: Rig,
        node: Node,
        patch: Callable[[str, object], None],
        plant: Plant | None = None,
        **settings: object,
    ) -> None:
        self.plant = plant
        self.port = Port(node)
        patch("drivers.serial_node.link.open_port", lambda *_: self.port)
        given = {**rig.device.settings, **settings, "port": "desk"}
        opened = open_rig(rig, given)
        assert isinstance(opened, SerialRig)
        self.device = opened
        c = node.config
        self.encoders, self.adcs, self.emergency = [0] * c.n_encoder, [0] * c.n_adc, False
        self.nulls = tuple(o.null for o in c.outputs)

    @property
    def node(self) -> Node:
        return self.port.node

    def run(self, n: int) -> list[tuple[int, ...]]:
        """n samples; the counts of each output less its null, and the driver has them all."""
        out = []
        for _ in range(n):
            clock = self.node.sample * self.node.config.period_ns // 1000 % 2**32
            encoders, adcs = self.plant.sense() if self.plant else ((), ())
            analogue = tuple(min(a, RAILS[1]) for a in _sum(self.adcs, adcs))
            inputs = _sum(self.encoders, encoders), analogue, self.emergency
            counts = self.port.take(clock, *inputs)
            if self.plant:
                self.plant.move(counts)
            out.append(tuple(c - n for c, n in zip(counts, self.nulls, strict=True)))
        found(lambda: self.device.link.decoder.received == self.port.came, WITHIN, every=0.002)
        return out


def _sum(a: Sequence[int], b: Sequence[int]) -> tuple[int, ...]:
    return tuple(x + y for x, y in zip_longest(a, b, fillvalue=0))


def session(desk: Desk) -> tuple[np.ndarray, np.ndarray]:
    """A driver and a node with one output, through every state and refusal; what was read, and its
    flags."""
    device, read = desk.device, []
    desk.encoders[0] = 1000
    desk.run(8)
    device.actuator.configure(LOOP)
    first = desk.node.sample
    t = np.arange(90)
    device.actuator.write(CommandBlock(first + 2, np.sin(t / 9.0), 0.01 * np.cos(t / 7.0)))
    for i in range(20):
        desk.encoders[0] = 1000 + 40 * i
        desk.adcs[0] = -300 + 7 * i
        desk.run(1)
    read.append(device.sensor.read())
    with contextlib.suppress(DeviceError):
        device.actuator.configure(LOOP)  # it is live
    device.actuator.zero()
    desk.run(4)
    device.actuator.configure(LOOP)
    first = desk.node.sample
    device.actuator.write(CommandBlock(first, np.full(3, 9.0), np.zeros(3)))  # beyond its limit
    desk.run(34)  # dry, then the deadman
    device.actuator.write(CommandBlock(desk.node.sample, np.ones(3), np.zeros(3)))  # refused
    device.actuator.configure(LOOP)
    device.actuator.write(CommandBlock(desk.node.sample, np.ones(20), np.zeros(20)))
    desk.run(3)
    desk.encoders[0] += 5000  # a jump
    desk.run(4)
    device.actuator.configure(LOOP)  # cleared, and taken
    device.actuator.write(CommandBlock(desk.node.sample, -np.ones(20), np.zeros(20)))
    desk.run(2)
    desk.emergency = True
    desk.run(2)
    with contextlib.suppress(DeviceError):
        device.actuator.configure(LOOP)  # its cause is still there
    desk.emergency = False
    desk.run(4)
    read.append(device.sensor.read())
    device.close()
    return np.concatenate([b.values for b in read]), np.concatenate([b.quality for b in read])
