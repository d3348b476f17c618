"""The simulated rig: the transfer matrix model in the time domain, behind a device's Protocols.

Time stands still until the clock is told to sleep; then the plant, its converters and the
device's own loop run up to the new time, many times faster than real time. Sample n is taken
at n / rate on the device's clock.

The device, at each sample:

- With a reference queued for it: v = u + kp (theta_ref - theta) + feedback, theta and the
  feedback's sensors as measured. The filters start from zero state when the output goes live.
- Queue dry: u = 0 and the last theta_ref stay, the loop keeps centring; after `deadman` s of
  that v = 0, until a new reference comes. Samples that come too late are ignored.
- |v| and its rate are kept within the limits of `DeviceLoop` and the converter's range;
  |theta| beyond max_angle (or theta lost, or a sensor of a feedback) drops v to zero until it
  is configured again. A changed v is flagged `Quality.LIMITED`.

A rig with several outputs is `sim.several`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from samii_rig.devices.protocols import CommandBlock, DeviceLoop, OpenRig
from samii_rig.errors import DeviceError
from samii_rig.rig.schema import Rig
from sim import kernel
from sim.base import SimulatedRig, device_channels
from sim.contact import check_contact, tables_of
from sim.electronics import check_block, control, converters, drive, filters, references
from sim.settings import SimSettings, read_settings
from sim.several import SimulatedOutputs


class SimulatedDevice(SimulatedRig):
    """A simulated rig with one output."""

    def __init__(self, rig: Rig, settings: SimSettings) -> None:
        super().__init__(rig, settings)
        (spec,) = rig.actuator
        self.name = spec.name
        self._tables, self._contact = tables_of(rig, self.realisation, settings)
        self._converters = converters(rig, settings)
        self._drive = drive(rig, settings)
        self._state = kernel.rest(self._tables)
        self._control = kernel.Control(0, 0.0, 0.0, np.inf, np.inf, self._patience())
        self._filters = filters(rig, ())
        self._queue: list[CommandBlock] = []

    def configure(self, loop: DeviceLoop) -> None:
        """Set loops and limits; DeviceError while one is closed or if its sensor is none."""
        if self._state.flag[kernel.LIVE] and self._state.number[kernel.LAST_V] != 0.0:
            raise DeviceError(f"{self.name}: configured while the output is not zero")
        self._control = control(self._rig, self.name, loop, self._patience())
        self._filters = filters(self._rig, loop.feedback)
        self._state.flag[kernel.TRIPPED] = 0
        self._state.flag[kernel.DEAD] = 0

    def write(self, block: CommandBlock) -> None:
        """Queue reference samples; where two blocks overlap, the later one counts."""
        check_block(self.name, block)
        self._queue.append(block)

    def zero(self) -> None:
        """v = 0 from this moment, nothing queued, the loop open."""
        self._queue.clear()
        state = self._state
        state.flag[kernel.LIVE] = state.flag[kernel.DRY] = state.flag[kernel.DEAD] = 0
        state.waiting[:] = 0.0
        self._filters.memory[:] = 0.0
        state.number[kernel.LAST_V] = state.number[kernel.APPLIED] = 0.0

    def _advance(self, first: int, n: int) -> None:
        u, theta_ref, given = references(self._queue, first, n)
        self._queue = [b for b in self._queue if b.first + len(b) > first + n]
        columns = len(self.channels) - self._usual.size
        values = np.empty((n, columns))
        quality = np.empty((n, columns), dtype=np.uint8)
        none = np.zeros((0, 0))
        noise = self._draw(n)
        pushed = self._drive.disturbance > 0.0
        inner = self._tables.inner
        disturbance = self._disturbance.standard_normal((n, inner)) if pushed else none
        kernel.advance(
            self._tables,
            self._converters,
            self._control,
            self._filters,
            self._drive,
            self._contact,
            self._state,
            u,
            theta_ref,
            given,
            noise,
            disturbance,
            values,
            quality,
        )
        self._keep(first, values, quality)


def check_rig(rig: Rig, settings: Mapping[str, object]) -> None:
    """InputError for a wrong setting, or a channel with the name of a reference."""
    check_contact(rig, read_settings(rig, settings))
    device_channels(rig)


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The simulated rig, open and at rest; see `SimSettings` for what can be set.

    InputError for an unknown or wrong setting, or a chain that cannot be simulated.
    """
    chosen = read_settings(rig, settings)
    check_contact(rig, chosen)
    device: SimulatedDevice | SimulatedOutputs
    device = (
        SimulatedDevice(rig, chosen) if len(rig.actuator) == 1 else SimulatedOutputs(rig, chosen)
    )
    made = device.realisation
    errors = {s.name: f"{e:.1e}" for s, e in zip(rig.sensor, made.error, strict=True)}
    return OpenRig(
        device,
        device,
        device,
        f"simulated {rig.name}: {made.poles.size} modes, {chosen.inner} steps a sample",
        {
            "device": "simulated",
            "clock": "simulated",
            "device_settings": chosen.model_dump_json(exclude_defaults=True),
            "seed": str(chosen.seed),
            "poles_counted": str(made.structure.count),
            "model_error": ", ".join(f"{k} {v}" for k, v in errors.items()),
        },
    )
