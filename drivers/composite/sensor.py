"""The samples of all devices as those of the main one."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from drivers.resampling import Track
from samii_rig.devices.protocols import DeviceEvent, OpenRig, Reports
from samii_rig.devices.timebase import ClockFit, ClockModel, Timed
from samii_rig.errors import DeviceError, SamiiRigError
from samii_rig.signal.skew import KEY, Skew, to_text
from samii_rig.types import Float, Int, SampleBlock

MAIN = "main"
# s that a sample waits for the others beyond the longest gap that is bridged: two samples.
LOOK_AGAIN = 0.005
GRACE = 0.03  # s past a channel's age limit after which silence ends the run, if no gate did
TELL = 30.0  # s between events that say how the clocks stand


class Clocks:
    """The main device's clock and another's, each against the host's monotonic one.

    A device whose sensor is not `Timed` stamps its samples on the host's clock, and knows how
    well: its `timing`, s.
    """

    def __init__(self, main: ClockModel | None, sensor: object) -> None:
        self._main = main
        self._sensor = sensor
        self._own = ClockModel(sensor.latency) if isinstance(sensor, Timed) else None

    def listen(self) -> None:
        """Take the pairs that came."""
        if self._own is not None and isinstance(self._sensor, Timed):
            self._own.add(self._sensor.arrivals())

    @property
    def ready(self) -> bool:
        """Whether both are known."""
        return all(c is None or c.ready for c in (self._main, self._own))

    def on_main(self, times: Int) -> Int:
        """The main device's times of this device's times, ns."""
        host = times if self._own is None else self._own.fit().host(times)
        return host if self._main is None else self._main.fit().device(host)

    def fits(self) -> tuple[ClockFit | None, ClockFit | None]:
        """Of the main device's clock and of this one's; None for the host's own."""
        both = [c.fit() if c is not None else None for c in (self._main, self._own)]
        return both[0], both[1]

    @property
    def sigma(self) -> float:
        """s, standard deviation of the time between the two devices."""
        own = 0.0 if self._own is not None else float(getattr(self._sensor, "timing", 0.0))
        parts = [f.sigma for f in self.fits() if f is not None]
        return float(np.sqrt(own**2 + sum(s**2 for s in parts)))


@dataclass(slots=True)
class Side:
    """A device that only measures.

    age : s without a sample after which the run ends. sigma : s, the largest of its clock since
        the device is open.
    """

    name: str
    opened: OpenRig
    clocks: Clocks
    track: Track
    age: float
    sigma: float = 0.0
    trouble: str = ""
    told: bool = False

    def take(self, now: int) -> None:
        """Samples that came, on the main device's time."""
        if self.trouble:
            return
        try:
            block = self.opened.sensor.read()
        except SamiiRigError as error:
            self.trouble = f"{self.name}: {error}"
            return
        self.clocks.listen()
        self.track.add(self.clocks.on_main(block.time), block, now)

    def check(self, now: int) -> None:
        """DeviceError, once, when no more will come."""
        silent = (now - self.track.heard) * 1e-9
        if not self.trouble and silent > self.age + GRACE:
            words = getattr(self.opened.sensor, "words", str)()
            why = f"its status says: {words}" if words else "is it powered, is its bus up?"
            self.trouble = f"{self.name}: no good sample for {silent:.3g} s; {why}"
        if self.trouble and not self.told:
            self.told = True
            raise DeviceError(self.trouble)


class CompositeSensor:
    """The samples of all devices as those of the main one.

    metadata : of the rig; what is stated of the clocks in it is kept up to date.
    """

    def __init__(
        self,
        main: OpenRig,
        model: ClockModel | None,
        sides: list[Side],
        metadata: dict[str, str],
    ) -> None:
        self._main, self._model, self._sides = main, model, sides
        self._metadata = metadata
        self.channels = main.sensor.channels + tuple(c for s in sides for c in s.track.channels)
        self._held: list[tuple[int, SampleBlock]] = []
        self._told = -TELL

    def read(self) -> SampleBlock:
        """All samples that are whole, or have waited long enough. DeviceError when a device says
        no more, once: after that its channels are MISSING, and the output can still be seen."""
        now = time.monotonic_ns()
        for side in self._sides:
            side.take(now)
            side.check(now)
        self.state()
        block = self._main.sensor.read()
        self.listen()
        if len(block):
            self._held.append((now, block))
        longest = max((s.track.gap + LOOK_AGAIN for s in self._sides if not s.trouble), default=0.0)
        late = now - round(longest * 1e9)
        known = min((s.track.known for s in self._sides if not s.trouble), default=2**62)
        out: list[SampleBlock] = []
        while self._held:
            since, block = self._held[0]
            n = len(block) if since <= late else int(np.searchsorted(block.time, known, "right"))
            if n:
                out.append(self._whole(_rows(block, 0, n)))
            if n < len(block):
                self._held[0] = (since, _rows(block, n, len(block)))
                break
            self._held.pop(0)
        return _joined(out) if out else self._whole(_rows(block, 0, 0))

    def state(self) -> None:
        """How well the clocks are known, at the worst moment so far, into the metadata."""
        now = [side.clocks.sigma for side in self._sides]
        if any(sigma > side.sigma for side, sigma in zip(self._sides, now, strict=True)):
            for side, sigma in zip(self._sides, now, strict=True):
                side.sigma = max(side.sigma, sigma)
            skews = {c.name: Skew(s.name, s.sigma) for s in self._sides for c in s.track.channels}
            # The prefix is added where the metadata goes into the recording.
            self._metadata[KEY.removeprefix("device_")] = to_text(skews)

    def listen(self) -> None:
        """Take the main device's pairs of times."""
        if self._model is not None and isinstance(self._main.sensor, Timed):
            self._model.add(self._main.sensor.arrivals())

    def events(self) -> list[DeviceEvent]:
        """The devices' own, and how the clocks stand."""
        found: list[DeviceEvent] = []
        for opened in (self._main, *(s.opened for s in self._sides)):
            if isinstance(opened.sensor, Reports):
                found += opened.sensor.events()
        now = time.monotonic()
        if now - self._told > TELL:
            self._told = now
            found += [self._standing(side) for side in self._sides]
        return found

    def _standing(self, side: Side) -> DeviceEvent:
        at = int(side.clocks.on_main(np.array([time.monotonic_ns()]))[0])
        fields: dict[str, str | int | float] = {"device": side.name, "sigma": side.clocks.sigma}
        for name, fit in zip((MAIN, side.name), side.clocks.fits(), strict=True):
            if fit is not None:
                fields[f"{name}_drift"] = fit.drift
                fields[f"{name}_drift_sigma"] = fit.drift_sigma
                fields[f"{name}_scatter"] = fit.scatter
        return DeviceEvent(at, "clock", fields)

    def _whole(self, block: SampleBlock) -> SampleBlock:
        """The rows with the others' columns."""
        values, quality = [block.values], [block.quality]
        for side in self._sides:
            v, q = side.track.at(block.time)
            values.append(v)
            quality.append(q)
        return SampleBlock(
            self.channels,
            block.time,
            block.sequence,
            np.concatenate(values, axis=1),
            np.concatenate(quality, axis=1),
        )


def _rows(block: SampleBlock, start: int, stop: int) -> SampleBlock:
    part = slice(start, stop)
    return SampleBlock(
        block.channels,
        block.time[part],
        block.sequence[part],
        block.values[part],
        block.quality[part],
    )


def _joined(blocks: list[SampleBlock]) -> SampleBlock:
    if len(blocks) == 1:
        return blocks[0]
    values: Float = np.concatenate([b.values for b in blocks])
    return SampleBlock(
        blocks[0].channels,
        np.concatenate([b.time for b in blocks]),
        np.concatenate([b.sequence for b in blocks]),
        values,
        np.concatenate([b.quality for b in blocks]),
    )
