"""A simulated force/torque sensor with CAN: the bytes of its frames, and its faults.

Written from the protocol's page (docs/reference/force-torque.md), apart from the driver.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from samii_rig.types import Float

Frame = tuple[int, bytes]  # identifier, data
GAUGES, MATRIX, SERIAL, PER_UNIT, UNITS, FIRMWARE = 0x0, 0x2, 0x5, 0x7, 0x8, 0xF
NEWTON, NEWTON_METRE = 2, 3  # unit codes
COUNTS_PER_UNIT = 1_000_000
FULL = 30_000  # counts of a gauge at the largest load
NUMBER = b"FT-00017"
RAIL = 32767


def calibration(most: float) -> Float:
    """(6, 6) float32 coefficients: six gauges that mix the loads, none near its end at `most`."""
    mix = np.eye(6) + 0.15 * np.sin(np.arange(36.0)).reshape(6, 6)
    return np.asarray(mix * most * COUNTS_PER_UNIT / FULL, dtype=np.float32)


@dataclass(slots=True)
class Sensor:
    """loads : (6,) N and N m at this moment. most : the largest of them.

    scale : what it delivers over what is there, a wrong calibration. status : its status word.
    stuck : its gauges stand still. silent : it has no power.
    """

    base: int
    loads: Callable[[], Float]
    most: float
    scale: float = 1.0
    status: int = 0
    silent: bool = False
    stuck: bool = False
    _matrix: Float = field(init=False)
    _gauges: Float = field(default_factory=lambda: np.zeros(6))

    def __post_init__(self) -> None:
        self._matrix = calibration(self.most)

    def answer(self, identifier: int, data: bytes) -> list[Frame]:
        """The frames that follow a frame on the bus."""
        operation = identifier - 16 * self.base
        if self.silent:
            return []
        if operation == GAUGES and not data:
            g = self._read()
            return self._reply(
                GAUGES,
                struct.pack(">Hhhh", self.status, g[0], g[2], g[4]),
                struct.pack(">hhh", g[1], g[3], g[5]),
            )
        if operation == MATRIX and len(data) == 1 and data[0] < 6:
            row = self._matrix[data[0]].tolist()
            parts = [struct.pack(">ff", *row[i : i + 2]) for i in (0, 2, 4)]
            return self._reply(MATRIX, *parts)
        fixed = {
            SERIAL: NUMBER,
            PER_UNIT: struct.pack(">II", COUNTS_PER_UNIT, COUNTS_PER_UNIT),
            UNITS: bytes((NEWTON, NEWTON_METRE)),
            FIRMWARE: struct.pack(">BBH", 1, 2, 34),
        }
        return self._reply(operation, fixed[operation]) if operation in fixed and not data else []

    def _reply(self, operation: int, *parts: bytes) -> list[Frame]:
        return [(16 * self.base + operation + i, part) for i, part in enumerate(parts)]

    def _read(self) -> list[int]:
        if not self.stuck:
            loads = self.scale * self.loads() * COUNTS_PER_UNIT
            self._gauges = np.linalg.solve(self._matrix.astype(float), loads)
        return [int(g) for g in np.clip(np.rint(self._gauges), -RAIL - 1, RAIL)]
