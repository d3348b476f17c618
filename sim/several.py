"""A simulated rig with several outputs: what `sim.rig` says of one holds for each of them.

A reference comes for all outputs at once, their deadman is the shortest of the rig file's, and a
trip of one loop (an angle beyond its limit, a lost sensor) drops all of them to zero.
"""

from __future__ import annotations

import numpy as np

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError
from samii_rig.model.realise import Realisation
from samii_rig.rig.schema import Rig
from sim import kernel
from sim.base import SimulatedRig
from sim.electronics import check_block, control, converters, drive, filters, references
from sim.lanes import Lane, advance
from sim.plant import tabulate
from sim.settings import SimSettings


def plant_of(
    rig: Rig, made: Realisation, settings: SimSettings, i: int, patience: int = -1
) -> Lane:
    """What output i moves, at rest, its loop open."""
    tables = tabulate(rig, made, settings.inner, i)
    return Lane(
        tables,
        converters(rig, settings, i),
        kernel.Control(0, 0.0, 0.0, np.inf, np.inf, patience),
        filters(rig, ()),
        drive(rig, settings, i),
        kernel.free(tables),
        kernel.rest(tables),
    )


class SimulatedOutputs(SimulatedRig):
    """Actuators, sensor and clock of a simulated rig with several outputs."""

    def __init__(self, rig: Rig, settings: SimSettings) -> None:
        super().__init__(rig, settings)
        self.names = tuple(a.name for a in rig.actuator)
        self._lanes = tuple(
            plant_of(rig, self.realisation, settings, i, self._patience())
            for i in range(len(rig.actuator))
        )
        self._queue: list[tuple[CommandBlock, ...]] = []

    def configure(self, loops: tuple[DeviceLoop, ...]) -> None:
        """Set loops and limits; DeviceError while one is closed or if it cannot be closed."""
        for name, lane in zip(self.names, self._lanes, strict=True):
            if lane.state.flag[kernel.LIVE] and lane.state.number[kernel.LAST_V] != 0.0:
                raise DeviceError(f"{name}: configured while the output is not zero")
        if len(loops) != len(self.names):
            raise DeviceError(f"{len(loops)} loops for {', '.join(self.names)}")
        # All of them, before any is changed.
        closed = [
            (control(self._rig, name, loop, self._patience()), filters(self._rig, loop.feedback))
            for name, loop in zip(self.names, loops, strict=True)
        ]
        self._lanes = tuple(
            lane._replace(control=own, filters=cascades)
            for lane, (own, cascades) in zip(self._lanes, closed, strict=True)
        )
        for lane in self._lanes:
            lane.state.flag[kernel.TRIPPED] = lane.state.flag[kernel.DEAD] = 0

    def write(self, blocks: tuple[CommandBlock, ...]) -> None:
        """Queue reference samples; where two overlap, the later one counts."""
        for name, block in zip(self.names, blocks, strict=True):
            check_block(name, block)
        if len({(b.first, len(b)) for b in blocks}) != 1:
            raise DeviceError(f"{', '.join(self.names)}: references of different samples")
        self._queue.append(blocks)

    def zero(self) -> None:
        """v = 0 of all outputs from this moment, nothing queued, the loops open."""
        self._queue.clear()
        for lane in self._lanes:
            state = lane.state
            state.flag[kernel.LIVE] = state.flag[kernel.DRY] = state.flag[kernel.DEAD] = 0
            state.waiting[:] = 0.0
            lane.filters.memory[:] = 0.0
            state.number[kernel.LAST_V] = state.number[kernel.APPLIED] = 0.0

    def _advance(self, first: int, n: int) -> None:
        k, m = len(self._lanes), len(self._rig.sensor)
        own = [references([b[j] for b in self._queue], first, n) for j in range(k)]
        self._queue = [b for b in self._queue if b[0].first + len(b[0]) > first + n]
        values = np.empty((n, 3 * k + m))
        quality = np.empty((n, 3 * k + m), dtype=np.uint8)
        pushed = self._lanes[0].drive.disturbance > 0.0
        size = (k, n, self._settings.inner) if pushed else (0, 0, 0)
        advance(
            self._lanes,
            np.stack([u for u, _, _ in own], axis=1),
            np.stack([ref for _, ref, _ in own], axis=1),
            own[0][2],
            self._draw(n),
            self._disturbance.standard_normal(size),
            values,
            quality,
        )
        self._keep(first, values, quality)
