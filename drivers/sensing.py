"""What devices that measure have in common."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.schema import Rig
from samii_rig.types import Int


def taken(pairs: deque[tuple[int, int]]) -> Int:
    """(n, 2) of what a sensor's `arrivals()` gives; `pairs` is empty then."""
    found = np.array([pairs.popleft() for _ in range(len(pairs))], dtype=np.int64)
    return found.reshape(-1, 2)


def only_measures(rig: Rig, settings: Mapping[str, object]) -> None:
    """InputError: a rig cannot be driven through a device without an output."""
    raise InputError(
        rig.name,
        "device.driver",
        rig.device.driver,
        "one that drives; this one only measures, beside another (docs/reference/composite.md)",
    )


class NoOutput:
    """The actuator of a device that has none. Without a deadman, no gate arms it."""

    deadman: float | None = None

    def __init__(self, name: str) -> None:
        self.name = name

    def configure(self, loop: DeviceLoop) -> None:
        """There is nothing to configure: DeviceError."""
        raise DeviceError(f"{self.name} only measures; it has no loop to close on {loop.sensor}")

    def write(self, block: CommandBlock) -> None:
        """There is nothing to drive: DeviceError."""
        raise DeviceError(f"{self.name} only measures; {len(block)} samples were meant for it")

    def zero(self) -> None:
        """It is."""
