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
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from samii_rig.devices.protocols import CommandBlock, DeviceLoop, OpenRig
from samii_rig.errors import DeviceError, InputError
from samii_rig.model.feedback import sections
from samii_rig.model.realise import Realisation, realise
from samii_rig.model.sampled import filter_response
from samii_rig.rig.schema import (
    SOURCES,
    AccelerationSource,
    AngularVelocitySource2,
    DisplacementSource,
    Feedback,
    Rig,
)
from samii_rig.types import Channel, Flags, Float, Int, SampleBlock
from sim import kernel
from sim.plant import tabulate
from sim.settings import SimSettings, read_settings

SECOND_ORDER = (AngularVelocitySource2, DisplacementSource, AccelerationSource)
NEVER = np.iinfo(np.int64).max  # a sample that does not come
CHUNK = 4096  # samples in one call of the inner loop, so that memory stays bounded
NS = 1_000_000_000
# To the continuous response.
UNRELATED = {"description", "limit", "centring", "feedback", "monitor", "device", "service"}


class SimulatedDevice:
    """Actuator, sensor and clock of one simulated rig.

    Attributes as the Protocols say; `realisation` is the state space that it runs.
    """

    def __init__(self, rig: Rig, settings: SimSettings) -> None:
        if len(rig.actuator) != 1:
            raise InputError(rig.name, "actuator", len(rig.actuator), "one actuator to simulate")
        self._rig, self._settings = rig, settings
        spec = rig.actuator[0]
        self.name, self.deadman = spec.name, spec.deadman
        self.channels = device_channels(rig)
        self._usual = np.array([m.usual for m in rig.monitor])
        self.realisation = realised(rig.model_dump_json(exclude=UNRELATED), settings.band_hz)
        self._tables = tabulate(rig, self.realisation, settings.inner)
        self._converters = converters(rig, settings)
        self._drive = drive(rig, settings)
        self._state = kernel.rest(self._tables)
        self._control = kernel.Control(0, 0.0, 0.0, np.inf, np.inf, self._patience())
        self._filters = _filters(rig, ())
        noise, disturbance = np.random.SeedSequence(settings.seed).spawn(2)
        self._noise = np.random.default_rng(noise)
        self._disturbance = np.random.default_rng(disturbance)
        self._queue: list[CommandBlock] = []
        self._now = 0
        self._began = time.monotonic()
        self._arrived: list[tuple[int, Float, Flags]] = []

    # Actuator

    def configure(self, loop: DeviceLoop) -> None:
        """Set loops and limits; DeviceError while one is closed or if its sensor is none."""
        if self._state.flag[kernel.LIVE] and self._state.number[kernel.LAST_V] != 0.0:
            raise DeviceError(f"{self.name}: configured while the output is not zero")
        names = [s.name for s in self._rig.sensor]
        for sensor in (loop.sensor, *(f.sensor for f in loop.feedback)):
            if sensor not in names:
                raise DeviceError(f"{self.name}: no sensor {sensor!r} to close the loop on")
        for f in loop.feedback:
            if f.actuator != self.name:
                raise DeviceError(f"{self.name}: feedback {f.name} drives {f.actuator}, not this")
        numbers = (loop.kp, loop.max_output, loop.max_rate, loop.max_angle)
        if not all(x >= 0.0 for x in numbers) or not np.isfinite(loop.kp):
            raise DeviceError(f"{self.name}: negative or missing number in {loop}")
        self._control = kernel.Control(
            names.index(loop.sensor),
            float(loop.kp),
            float(loop.max_output),
            float(loop.max_rate) / self._rig.rate_hz,
            float(loop.max_angle),
            self._patience(),
        )
        self._filters = _filters(self._rig, loop.feedback)
        self._state.flag[kernel.TRIPPED] = 0
        self._state.flag[kernel.DEAD] = 0

    def write(self, block: CommandBlock) -> None:
        """Queue reference samples; where two blocks overlap, the later one counts."""
        if block.u.shape != block.theta_ref.shape or block.u.ndim != 1:
            raise DeviceError(f"{self.name}: u and theta_ref of a block differ in length")
        if not (np.isfinite(block.u).all() and np.isfinite(block.theta_ref).all()):
            raise DeviceError(f"{self.name}: a reference sample is not a finite number")
        self._queue.append(block)

    def zero(self) -> None:
        """v = 0 from this moment, nothing queued, the loop open."""
        self._queue.clear()
        state = self._state
        state.flag[kernel.LIVE] = state.flag[kernel.DRY] = state.flag[kernel.DEAD] = 0
        state.waiting[:] = 0.0
        self._filters.memory[:] = 0.0
        state.number[kernel.LAST_V] = state.number[kernel.APPLIED] = 0.0

    # Sensor

    def read(self) -> SampleBlock:
        """All samples since the last call."""
        if len(self._arrived) == 1:
            first, values, quality = self._arrived[0]
            sequence = np.arange(first, first + len(values), dtype=np.int64)
        else:
            sequence, values, quality = self._join()
        self._arrived.clear()
        if self._settings.drop and sequence.size:
            kept = ~np.isin(sequence, self._settings.drop)
            sequence, values, quality = sequence[kept], values[kept], quality[kept]
        time = np.rint(sequence * (NS / self._rig.rate_hz)).astype(np.int64)
        return SampleBlock(self.channels, time, sequence, values, quality)

    def _join(self) -> tuple[Int, Float, Flags]:
        width = len(self.channels)
        firsts = [np.arange(n, n + len(v), dtype=np.int64) for n, v, _ in self._arrived]
        sequence = np.concatenate([np.zeros(0, dtype=np.int64), *firsts])
        values = np.concatenate([np.zeros((0, width)), *(v for _, v, _ in self._arrived)])
        quality = np.concatenate(
            [np.zeros((0, width), dtype=np.uint8), *(q for _, _, q in self._arrived)]
        )
        return sequence, values, quality

    # Clock

    def now(self) -> int:
        """Simulated time, ns."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Move time on, and with it everything else: all samples before the new time."""
        if seconds > 0.0:
            self._now += round(seconds * NS)
            if self._settings.pace > 0.0:
                self._wait()
        due = -(-self._now * self._rig.rate_hz // NS)
        while (taken := int(self._state.flag[kernel.SAMPLE])) < due:
            self._advance(taken, min(int(due) - taken, CHUNK))

    def _wait(self) -> None:
        """Let real time catch up with simulated time, divided by the pace."""
        behind = self._now * 1e-9 / self._settings.pace - (time.monotonic() - self._began)
        if behind > 0.0:
            time.sleep(behind)

    def _advance(self, first: int, n: int) -> None:
        u, theta_ref, given = self._references(first, n)
        columns = len(self.channels) - self._usual.size
        values = np.empty((n, columns))
        quality = np.empty((n, columns), dtype=np.uint8)
        none = np.zeros((0, 0))
        noisy = self._settings.noise
        noise = self._noise.standard_normal((n, len(self._rig.sensor))) if noisy else none
        pushed = self._drive.disturbance > 0.0
        inner = self._tables.inner
        disturbance = self._disturbance.standard_normal((n, inner)) if pushed else none
        kernel.advance(
            self._tables,
            self._converters,
            self._control,
            self._filters,
            self._drive,
            self._state,
            u,
            theta_ref,
            given,
            noise,
            disturbance,
            values,
            quality,
        )
        if self._usual.size:
            values = np.column_stack([values, np.tile(self._usual, (n, 1))])
            quality = np.pad(quality, ((0, 0), (0, self._usual.size)))
        self._arrived.append((first, values, quality))

    def _references(self, first: int, n: int) -> tuple[Float, Float, Flags]:
        u, theta_ref, given = np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.uint8)
        for block in self._queue:
            low, high = max(block.first, first), min(block.first + len(block), first + n)
            if low < high:
                here, there = slice(low - first, high - first), slice(low - block.first, None)
                u[here] = block.u[there][: high - low]
                theta_ref[here] = block.theta_ref[there][: high - low]
                given[here] = 1
        self._queue = [b for b in self._queue if b.first + len(b) > first + n]
        return u, theta_ref, given

    def _patience(self) -> int:
        """Samples without reference that the deadman allows; -1 for ever."""
        return -1 if self.deadman is None else int(self.deadman * self._rig.rate_hz + 1e-9)


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The simulated rig, open and at rest; see `SimSettings` for what can be set.

    InputError for an unknown or wrong setting, or a chain that cannot be simulated.
    """
    chosen = read_settings(rig, settings)
    device = SimulatedDevice(rig, chosen)
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


@lru_cache(maxsize=16)
def realised(rig_json: str, band_hz: float | None) -> Realisation:
    """Campaigns open the same rig many times; the pole search is the slow part of that."""
    return realise(Rig.model_validate_json(rig_json), band_hz)


def device_channels(rig: Rig) -> tuple[Channel, ...]:
    """Columns of the device: u, theta_ref, the command under the actuator's name, sensors."""
    spec = rig.actuator[0]
    centring = rig.centring.sensor if rig.centring else rig.sensor[0].name
    units = rig.units()
    for name in ("u", "theta_ref"):
        if name in units:
            raise InputError(rig.name, "name", name, "another; the references have this name")
    return (
        Channel("u", spec.unit, "reference", description="reference of the excitation"),
        Channel("theta_ref", units[centring], "reference", description=f"reference of {centring}"),
        Channel(
            spec.name,
            spec.unit,
            "command",
            spec.low,
            spec.high,
            spec.resolution,
            "output as held by the converter",
        ),
        *(
            Channel(s.name, s.unit, "sensor", s.low, s.high, s.resolution, s.calibration)
            for s in rig.sensor
        ),
        *(
            Channel(m.name, m.unit, "monitor", m.low, m.high, m.resolution, m.calibration)
            for m in rig.monitor
        ),
    )


def converters(rig: Rig, settings: SimSettings) -> kernel.Converters:
    """What stands between the analogue values and the numbers."""
    sensors, spec = rig.sensor, rig.actuator[0]
    ideal = 0.0 if not settings.noise else 1.0

    def sample(times: Mapping[str, float], name: str) -> int:
        return int(np.ceil(times[name] * rig.rate_hz)) if name in times else NEVER

    hum, hum_rate = np.zeros(len(sensors)), np.zeros(len(sensors))
    for i, s in enumerate(sensors):
        if s.name in settings.hum:
            tone = settings.hum[s.name]
            passed = filter_response(s, np.array([2j * np.pi * tone.frequency_hz]))
            hum[i] = tone.amplitude * abs(passed[0])
            hum_rate[i] = 2 * np.pi * tone.frequency_hz / rig.rate_hz
    return kernel.Converters(
        np.array([s.resolution * ideal for s in sensors]),
        np.array([s.low for s in sensors]),
        np.array([s.high for s in sensors]),
        np.array([s.noise_rms * ideal for s in sensors]),
        np.array([s.offset * ideal for s in sensors]),
        hum,
        hum_rate,
        np.array([sample(settings.stuck, s.name) for s in sensors], dtype=np.int64),
        np.array([sample(settings.nan, s.name) for s in sensors], dtype=np.int64),
        spec.resolution,
        spec.low,
        spec.high,
    )


def _filters(rig: Rig, feedback: Sequence[Feedback]) -> kernel.Filters:
    """The loops as tables, from zero state."""
    names = [s.name for s in rig.sensor]
    rows = [sections(f, rig.rate_hz) for f in feedback]
    table = np.concatenate([np.zeros((0, 5)), *rows])
    return kernel.Filters(
        np.array([names.index(f.sensor) for f in feedback], dtype=np.int64),
        np.array([f.max for f in feedback], dtype=np.float64),
        np.cumsum([0, *(len(r) for r in rows)], dtype=np.int64),
        table,
        np.zeros((len(table), 2)),
    )


def drive(rig: Rig, settings: SimSettings) -> kernel.Drive:
    """What acts on the drive beside the command."""
    # The disturbance passes the source's lag; a source without a first-order one lets it through.
    sources = [e for e in rig.element if isinstance(e, SOURCES)]
    own = next(e for e in sources if e.input == rig.actuator[0].name)
    lag = None if isinstance(own, SECOND_ORDER) else own.p
    p = lag.value if lag else np.inf
    return kernel.Drive(
        # White noise: its mean over `inner` steps has this rms.
        settings.disturbance_rms * np.sqrt(settings.inner),
        settings.coulomb_friction,
        float(np.exp(-p / (rig.rate_hz * settings.inner))),
    )
