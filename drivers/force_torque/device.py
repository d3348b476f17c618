"""A force/torque sensor as a device: newtons and newton metres, on the host's clock.

It drives nothing: its actuator has no deadman, so that no gate arms it. Beside a node that
drives, it is part of a composite rig (docs/reference/composite.md).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import can
import numpy as np

from drivers.force_torque.bus import open_bus, shut
from drivers.force_torque.frames import AXES, GAUGES, MATRIX, Frames
from drivers.force_torque.reader import Reader, Reading
from drivers.force_torque.settings import CanSettings, read_settings
from drivers.sensing import NoOutput
from samii_rig.devices.clock import MonotonicClock
from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.schema import Rig
from samii_rig.types import Channel, Float, Int, Quality, SampleBlock

# Largest ratio of singular values of a calibration matrix whose rows and columns were brought
# to one size. Real ones are below 100; at 1e6 the float32 in which it comes is used up.
MOST_CONDITION = 1e6
FIRST = 16  # samples whose round trips say what is usual
SLOW = 2_000_000  # ns beyond the usual round trip: a reply that says too little of its instant
BIAS_MOST = 6.0  # scatters by which the two halves of a bias may differ before it was no rest


@dataclass(frozen=True, slots=True)
class Calibration:
    """F = matrix (gauges - bias)/counts: (6, 6), and (6,) counts per N and per N m."""

    matrix: Float
    counts: Float

    def loads(self, gauges: Float) -> Float:
        """(n, 6) N and N m of (n, 6) counts."""
        loads: Float = gauges @ self.matrix.T / self.counts
        return loads


class ForceTorque:
    """The sensor. Times are the host's; the instant lies between request and reply.

    timing : s, standard deviation of what all samples are late or early together: an even
        distribution over the mean round trip.
    """

    def __init__(
        self, rig: Rig, settings: CanSettings, reader: Reader, calibration: Calibration
    ) -> None:
        self._reader, self._calibration = reader, calibration
        own = (*rig.sensor, *rig.monitor)
        self._columns = [AXES.index(settings.axes[x.name].axis) for x in own]
        self._signs = np.array([settings.axes[x.name].sign for x in own], dtype=float)
        self.bias = np.zeros(GAUGES)
        self.status: tuple[str, ...] = ()
        self.flagged = 0
        self._low = np.array([x.low for x in own])
        self._high = np.array([x.high for x in own])
        steps = self._steps()
        self.channels = tuple(
            Channel(x.name, x.unit, "sensor", x.low, x.high, float(step), x.calibration)
            for x, step in zip(own, steps, strict=True)
        )

    @property
    def timing(self) -> float:
        """See above; known once samples came."""
        total, n = self._reader.round_trips
        return total / max(n, 1) * 1e-9 / math.sqrt(12.0)

    def read(self) -> SampleBlock:
        """All samples since the last call. A value whose status says that it is wrong is MISSING,
        one with a saturated gauge CLIPPED. DeviceError, after the last sample, when the reader
        has ended."""
        readings = [self._reader.samples.popleft() for _ in range(len(self._reader.samples))]
        if not readings:
            self._reader.check()
        return self._block(readings)

    def take_bias(self, seconds: float) -> None:
        """The mean of what comes now is zero from here on; DeviceError if it does not stand still
        or is no number."""
        end = time.monotonic() + seconds
        seen: list[Reading] = []
        while time.monotonic() < end or len(seen) < 2:
            time.sleep(0.005)
            self._reader.check()
            seen += [self._reader.samples.popleft() for _ in range(len(self._reader.samples))]
            if time.monotonic() > end + 1.0:
                raise DeviceError(f"{self._reader.name}: no sample came to take the bias from")
        wrong = next((r.gauges for r in seen if r.gauges.status or r.gauges.saturated), None)
        if wrong is not None:
            why = ", ".join(wrong.status) or "a gauge is saturated"
            raise DeviceError(f"{self._reader.name}: no bias can be taken: {why}")
        counts = np.array([r.gauges.counts for r in seen], dtype=float)
        half = len(counts) // 2
        apart = np.abs(counts[:half].mean(axis=0) - counts[half:].mean(axis=0))
        # From one sample to the next, so that a slow change is no scatter; half a count is what
        # rounding alone may do.
        scatter = np.diff(counts, axis=0).std(axis=0) / np.sqrt(2.0)
        error = np.hypot(scatter * np.sqrt(2.0 / half), 0.5)
        if (apart > BIAS_MOST * error).any():
            raise DeviceError(
                f"{self._reader.name}: the load changed while the bias was taken; let the rig "
                "come to rest"
            )
        self.bias = counts.mean(axis=0)

    def words(self) -> str:
        """What the newest status word said, "" for nothing."""
        return ", ".join(self.status)

    def _block(self, readings: list[Reading]) -> SampleBlock:
        n = len(readings)
        times: Int = np.array([(r.asked + r.answered) // 2 for r in readings], dtype=np.int64)
        sequence: Int = np.array([r.number for r in readings], dtype=np.int64)
        counts = np.array([r.gauges.counts for r in readings], dtype=float).reshape(n, GAUGES)
        values = self._calibration.loads(counts - self.bias)[:, self._columns] * self._signs
        quality = np.zeros(values.shape, dtype=np.uint8)
        quality[(values <= self._low) | (values >= self._high)] = Quality.CLIPPED
        for i, r in enumerate(readings):
            self.status = r.gauges.status
            if r.gauges.status:
                self.flagged += 1
                values[i], quality[i] = np.nan, Quality.MISSING
            elif r.gauges.saturated:
                quality[i] = Quality.CLIPPED
        return SampleBlock(self.channels, times, sequence, values, quality)

    def _steps(self) -> Float:
        """Of each channel, what one count of the gauges changes: the root of the squares."""
        steps = np.sqrt((self._calibration.matrix**2).sum(axis=1)) / self._calibration.counts
        return np.asarray(steps[self._columns])


@dataclass(frozen=True, slots=True)
class ForceTorqueRig(OpenRig):
    """Ends the reader and gives the bus back."""

    device: ForceTorque
    reader: Reader
    bus: can.BusABC

    def close(self) -> None:
        """May be called twice."""
        self.reader.close()
        counts = asdict(self.reader.counts)
        self.metadata.update({f"can_{name}": str(n) for name, n in counts.items()})
        self.metadata["can_flagged"] = str(self.device.flagged)
        shut(self.bus)


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The sensor of the settings, sampling.

    InputError for a wrong setting, DBC or calibration, DeviceError if bus or sensor do not
    answer; one line each, with the remedy.
    """
    chosen = read_settings(rig, settings)
    frames = Frames(chosen.base_id, chosen.dbc)
    bus = open_bus(chosen)
    reader = Reader(bus, frames, round(1e9 / (chosen.rate_hz or rig.rate_hz)))
    try:
        about = _about(rig, chosen, frames, reader)
        calibration = about[0]
        device = ForceTorque(rig, chosen, reader, calibration)
        reader.start()
        if chosen.bias:
            device.take_bias(chosen.bias)
        _first(reader, 1.0 / (chosen.rate_hz or rig.rate_hz))
    except BaseException:
        reader.close()
        shut(bus)
        raise
    _, serial, firmware = about
    return ForceTorqueRig(
        NoOutput("force_torque"),
        device,
        MonotonicClock(),
        f"force/torque sensor {serial} at {chosen.interface} {chosen.channel}, firmware {firmware}",
        {
            "device": "force_torque",
            "clock": "host",
            "serial": serial,
            "firmware": firmware,
            "device_settings": chosen.model_dump_json(),
            "calibration": str(np.round(calibration.matrix, 6).tolist()),
            "counts_per_unit": str(calibration.counts.tolist()),
            "bias_counts": str(np.round(device.bias, 3).tolist()),
        },
        device,
        reader,
        bus,
    )


def _first(reader: Reader, period: float) -> None:
    """Wait until the samples have begun, and say from then on which replies are slow ones."""
    until = time.monotonic() + max(1.0, 2 * FIRST * period)
    while reader.counts.replies < FIRST:
        reader.check()
        if time.monotonic() > until:
            raise DeviceError(
                f"{reader.name}: the sensor answers questions and gives no samples; is another "
                "program asking it?"
            )
        time.sleep(0.005)
    total, n = reader.round_trips
    reader.slowest = round(total / n) + SLOW


def _about(
    rig: Rig, s: CanSettings, frames: Frames, reader: Reader
) -> tuple[Calibration, str, str]:
    """Calibration, serial number and firmware, as the sensor says."""
    number = reader.ask("SerialNumber")[0]
    serial = number.rstrip(b"\0 ").decode("ascii", "replace")
    version = frames.values("Firmware", reader.ask("Firmware")[0])
    per = frames.values("CountsPerUnit", reader.ask("CountsPerUnit")[0])
    newton, newton_metre = frames.units(reader.ask("Units")[0])
    if s.calibration is None:
        where = f"calibration of sensor {serial}"
        rows = [frames.row(reader.ask(*MATRIX, data=bytes([i]))) for i in range(GAUGES)]
        matrix = np.array(rows)
    else:
        where, matrix = f"{rig.name}: device.settings.calibration", np.array(s.calibration)
    counts = np.repeat([per["PerForce"] / newton, per["PerTorque"] / newton_metre], 3)
    if not ((counts > 0) & np.isfinite(counts)).all():
        raise InputError(f"sensor {serial}", "counts per unit", per, "numbers above 0")
    check_matrix(matrix, where)
    firmware = f"{version['Major']:g}.{version['Minor']:g}.{version['Build']:g}"
    return Calibration(matrix, counts), serial, firmware


def check_matrix(matrix: Float, where: str) -> None:
    """InputError unless the six loads can be told apart by the six gauges."""
    if not np.isfinite(matrix).all():
        raise InputError.saying(where, "", "holds what is no number; expected 6x6 numbers")
    rows = np.linalg.norm(matrix, axis=1, keepdims=True)
    if not rows.all():
        axis = AXES[int(np.argmin(rows))]
        raise InputError.saying(where, "", f"row {axis} is all 0; expected a calibration matrix")
    scaled = matrix / rows
    columns = np.linalg.norm(scaled, axis=0)
    if not columns.all():
        gauge = int(np.argmin(columns))
        raise InputError.saying(
            where, "", f"gauge {gauge} counts for nothing; expected a calibration matrix"
        )
    condition = float(np.linalg.cond(scaled / columns))
    if not condition < MOST_CONDITION:
        raise InputError.saying(
            where,
            "",
            f"is singular (condition {condition:.2g}); expected six rows of which none follows "
            "from the others",
        )
