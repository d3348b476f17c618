"""Sensor and clock of a simulated rig: time, noise, and the samples that have arrived."""

from __future__ import annotations

import time
from functools import lru_cache

import numpy as np

from samii_rig.devices.channels import command_channel, reference_channels
from samii_rig.model.realise import Realisation, realise
from samii_rig.rig.schema import Rig
from samii_rig.types import Channel, Flags, Float, Int, SampleBlock
from sim.settings import SimSettings

CHUNK = 4096  # samples in one call of the inner loop, so that memory stays bounded
NS = 1_000_000_000
# To the continuous response.
UNRELATED = {"description", "limit", "centring", "feedback", "monitor", "device", "service"}


class SimulatedRig:
    """Sensor and clock of a simulated rig, whatever drives it.

    Attributes as the Protocols say; `realisation` is the state space that it runs.
    """

    def __init__(self, rig: Rig, settings: SimSettings) -> None:
        self._rig, self._settings = rig, settings
        held = [a.deadman for a in rig.actuator if a.deadman is not None]
        self.deadman = min(held) if len(held) == len(rig.actuator) else None
        self.channels = device_channels(rig)
        self._usual = np.array([m.usual for m in rig.monitor])
        self.realisation = realised(rig.model_dump_json(exclude=UNRELATED), settings.band_hz)
        noise, disturbance = np.random.SeedSequence(settings.seed).spawn(2)
        self._noise = np.random.default_rng(noise)
        self._disturbance = np.random.default_rng(disturbance)
        self._now = self._taken = 0
        self._began = time.monotonic()
        self._arrived: list[tuple[int, Float, Flags]] = []

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
        while self._taken < due:
            n = min(int(due) - self._taken, CHUNK)
            self._advance(self._taken, n)
            self._taken += n

    def _wait(self) -> None:
        """Let real time catch up with simulated time, divided by the pace."""
        behind = self._now * 1e-9 / self._settings.pace - (time.monotonic() - self._began)
        if behind > 0.0:
            time.sleep(behind)

    def _advance(self, first: int, n: int) -> None:
        """Take the samples first to first + n, and `_keep` them."""
        raise NotImplementedError

    def _draw(self, n: int) -> Float:
        """Noise of n samples, standard normal; empty if there is none."""
        m = len(self._rig.sensor)
        return self._noise.standard_normal((n, m)) if self._settings.noise else np.zeros((0, 0))

    def _keep(self, first: int, values: Float, quality: Flags) -> None:
        if self._usual.size:
            values = np.column_stack([values, np.tile(self._usual, (len(values), 1))])
            quality = np.pad(quality, ((0, 0), (0, self._usual.size)))
        self._arrived.append((first, values, quality))

    def _patience(self) -> int:
        """Samples without reference that the deadman allows; -1 for ever."""
        return -1 if self.deadman is None else int(self.deadman * self._rig.rate_hz + 1e-9)


@lru_cache(maxsize=16)
def realised(rig_json: str, band_hz: float | None) -> Realisation:
    """Campaigns open the same rig many times; the pole search is the slow part of that."""
    return realise(Rig.model_validate_json(rig_json), band_hz)


def device_channels(rig: Rig) -> tuple[Channel, ...]:
    """Columns of the device: u, theta_ref, the command under the actuator's name, sensors.

    Of several actuators u and theta_ref of each, see `reference_names`, and then all commands.
    """
    return (
        *reference_channels(rig),
        *(
            command_channel(a, a.resolution, "output as held by the converter")
            for a in rig.actuator
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
