"""A quadrature counter on a serial port, that sends its counts unasked.

Its protocol is docs/reference/quadrature.md. It measures only, on a clock of its own; beside
a device that drives it is part of a composite rig.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import serial
from pydantic import Field

from drivers.ports import open_port
from drivers.quadrature.wire import HALF, VERSION, WORD, Decoder, Sample, Told, request
from drivers.sensing import NoOutput, taken
from samii_rig.devices.clock import MonotonicClock
from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import DeviceError
from samii_rig.rig.schema import Finite, Name, NonNegative, Rig, Strict
from samii_rig.rig.settings import checked, wrong
from samii_rig.types import Channel, Int, Quality, SampleBlock

HELLO_WITHIN = 3.0  # s; a board that resets when its port opens needs two to boot
ASK_EVERY = 0.25  # s
ROUND_TRIPS = 4
SAMPLES_KEPT = 65_536  # samples that wait for read()
# How far its clock may be from its own count of samples before one of them was reset.
SLACK = 2.0  # samples
DRIFT = 0.01  # of the time between two frames


class Counter(Strict):
    """value = (counts - offset)/counts_per_unit of counter `index`, in the sensor's unit."""

    index: Annotated[int, Field(ge=0, le=7)]
    counts_per_unit: Finite
    offset: Annotated[int, Field(ge=-HALF, lt=HALF)] = 0


class CounterSettings(Strict):
    """Settings of the driver; an unknown one is an error.

    counters : by the name of a sensor or monitor; each of the rig's has one. max_bad_frames :
    lost, damaged or doubled in one second, more ends the run.
    """

    port: str = Field(min_length=1)
    baud: Annotated[int, Field(ge=9600, le=12_000_000)] = 921_600
    counters: dict[Name, Counter]
    max_bad_frames: NonNegative = 5


class Quadrature:
    """The sensor. Times are the board's clock; `latency` and `arrivals` as `Timed` has them."""

    def __init__(self, rig: Rig, settings: CounterSettings, port: serial.Serial) -> None:
        own = (*rig.sensor, *rig.monitor)
        self._settings, self._port = settings, port
        self._inputs = [settings.counters[x.name] for x in own]
        self.channels = tuple(
            Channel(
                x.name, x.unit, "sensor", x.low, x.high, 1.0 / abs(c.counts_per_unit), x.calibration
            )
            for x, c in zip(own, self._inputs, strict=True)
        )
        self.decoder = Decoder()
        self.lost = self.stale = 0
        self.latency = (0.0, np.inf)
        self.trouble = ""
        self._told: Told | None = None
        self._boot: int | None = None
        self._samples: deque[Sample] = deque(maxlen=SAMPLES_KEPT)
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=SAMPLES_KEPT)
        self._bad: deque[tuple[float, int]] = deque([(time.monotonic(), 0)])
        self._last: tuple[int, int] | None = None  # newest sample's number and clock, us
        self._jumped = False
        self._news = threading.Condition()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"reader of {port.port}")
        self._thread.daemon = True
        self._thread.start()

    def identify(self) -> Told:
        """Ask who is there, and note the shortest time to the answer; DeviceError if nobody is."""
        told = self._ask()
        self._boot = told.boot
        short = np.inf
        for _ in range(ROUND_TRIPS):
            asked = time.monotonic()
            self._ask()
            short = min(short, time.monotonic() - asked)
        self.latency = (0.0, float(short))
        return told

    def read(self) -> SampleBlock:
        """All samples since the last call; an edge that was missed makes a value MISSING for good.
        DeviceError, after the last sample, when the port is gone, the board has rebooted, its
        clock jumped, or the line is bad."""
        trouble = self.trouble
        came = [self._samples.popleft() for _ in range(len(self._samples))]
        if not came and trouble:
            raise DeviceError(trouble)
        rows = [(s, place) for s in came if (place := self._place(s)) is not None]
        self._count_bad()
        sequence: Int = np.array([seq for _, (seq, _) in rows], dtype=np.int64)
        times: Int = np.array([clock * 1000 for _, (_, clock) in rows], dtype=np.int64)
        self._arrivals += [(clock * 1000, s.arrived) for s, (_, clock) in rows]
        values = np.full((len(rows), len(self.channels)), np.nan)
        quality = np.zeros(values.shape, dtype=np.uint8)
        for i, (s, _) in enumerate(rows):
            for j, c in enumerate(self._inputs):
                if s.missed >> c.index & 1:
                    quality[i, j] = Quality.MISSING
                else:
                    values[i, j] = (s.counts[c.index] - c.offset) / c.counts_per_unit
        for j, channel in enumerate(self.channels):
            ends = (values[:, j] <= channel.low) | (values[:, j] >= channel.high)
            quality[ends, j] = Quality.CLIPPED
        return SampleBlock(self.channels, times, sequence, values, quality)

    def arrivals(self) -> Int:
        """(n, 2) ns: board's and host's time of the samples given since the last call."""
        return taken(self._arrivals)

    def close(self) -> None:
        """Stop reading and give the port back; may be called twice."""
        self._ending.set()
        self._thread.join()
        self._port.close()

    def _ask(self) -> Told:
        until = time.monotonic() + HELLO_WITHIN
        seq = 0
        with self._news:
            self._told = None
        while time.monotonic() < until:
            seq += 1
            try:
                self._port.write(request(seq))
            except (OSError, serial.SerialException) as error:
                raise DeviceError(f"{self._port.port}: the port takes nothing: {error}") from error
            with self._news:
                self._news.wait_for(lambda: self._told or self.trouble, ASK_EVERY)
                if self._told is not None:
                    return self._told
            if self.trouble:
                raise DeviceError(self.trouble)
        raise DeviceError(self._nobody())

    def _nobody(self) -> str:
        name = self._port.port
        if self.decoder.version != VERSION:
            return (
                f"{name}: the counter speaks protocol version {self.decoder.version}, this driver "
                f"version {VERSION}; install the firmware that belongs to it"
            )
        if self.decoder.received:
            return (
                f"{name}: {self.decoder.received} bytes came and no answer of a counter among "
                f"them; is device.settings.baud = {self._settings.baud} the counter's?"
            )
        return f"{name}: nothing answers in {HELLO_WITHIN:g} s; is the counter powered?"

    def _run(self) -> None:
        """The reader: whatever ends it is trouble, and so never only silence."""
        try:
            while not self._ending.is_set():
                data = self._port.read(max(1, self._port.in_waiting))
                now = time.monotonic_ns()
                for message in self.decoder.feed(data):
                    self._take(message, now)
        except BaseException as error:
            self._fail(f"{self._port.port}: the port is gone: {type(error).__name__}: {error}")

    def _take(self, message: Told | Sample, now: int) -> None:
        if self._boot is not None and message.boot != self._boot:
            self._fail(
                f"{self._port.port}: the counter has rebooted (boot {message.boot}), its counts "
                "began anew; find out why, then start a new run"
            )
        elif isinstance(message, Told):
            with self._news:
                self._told = message
                self._news.notify_all()
        elif self._boot is not None:
            m = message
            self._samples.append(Sample(m.boot, m.seq, m.clock_us, m.missed, m.counts, now))

    def _fail(self, trouble: str) -> None:
        with self._news:
            self.trouble = self.trouble or trouble
            self._news.notify_all()

    def _place(self, s: Sample) -> tuple[int, int] | None:
        """Number and clock (us) of a sample without their wraps at 2^32; None for one that came
        twice or late, and for all from where the clock jumps against the count."""
        assert self._told is not None
        place = s.seq, s.clock_us
        if self._last is not None:
            seq, clock = self._last
            ahead = (s.seq - seq) % WORD
            if not 0 < ahead < HALF:
                self.stale += 1
                return None
            expected = clock + ahead * self._told.period_us
            off = (s.clock_us - expected + HALF) % WORD - HALF
            if self._jumped or abs(off) > self._told.period_us * (SLACK + DRIFT * ahead):
                self._jumped = True
                self._fail(f"{self._port.port}: the counter's clock jumped by {off * 1e-6:.3g} s")
                return None
            self.lost += ahead - 1
            place = seq + ahead, expected + off
        self._last = place
        return place

    def _count_bad(self) -> None:
        now = time.monotonic()
        self._bad.append((now, self.lost + self.stale))
        while self._bad[0][0] < now - 1.0:
            self._bad.popleft()
        bad = self._bad[-1][1] - self._bad[0][1]
        if bad > self._settings.max_bad_frames:
            self._fail(
                f"{self._port.port}: {bad} frames lost or damaged within a second; allowed "
                f"{self._settings.max_bad_frames:g} (device.settings.max_bad_frames)"
            )


@dataclass(frozen=True, slots=True)
class QuadratureRig(OpenRig):
    """Gives the port back."""

    device: Quadrature

    def close(self) -> None:
        """May be called twice."""
        self.device.close()
        d = self.device
        counts = {"lost": d.lost, "stale": d.stale, "corrupt": d.decoder.corrupt}
        self.metadata.update({f"frames_{k}": str(v) for k, v in counts.items()})


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The counter of the settings, sending.

    InputError for a wrong setting, DeviceError if port or board do not answer.
    """
    chosen = _read(rig, settings)
    device = Quadrature(rig, chosen, open_port(chosen.port, chosen.baud))
    try:
        told = device.identify()
        for name, c in chosen.counters.items():
            if c.index >= told.counters:
                expected = f"below {told.counters}, what counter {told.serial} has"
                raise wrong(rig, f"counters.{name}.index", c.index, expected)
    except BaseException:
        device.close()
        raise
    return QuadratureRig(
        NoOutput("quadrature"),
        device,
        MonotonicClock(),
        f"quadrature counter {told.serial} at {chosen.port}, firmware {told.firmware}",
        {
            "device": "quadrature",
            "clock": "device",
            "serial": told.serial,
            "firmware": told.firmware,
            "boot": str(told.boot),
            "device_settings": chosen.model_dump_json(),
        },
        device,
    )


def _read(rig: Rig, given: Mapping[str, object]) -> CounterSettings:
    s = checked(CounterSettings, rig, given, page="docs/reference/quadrature.md")
    names = [x.name for x in (*rig.sensor, *rig.monitor)]
    if sorted(s.counters) != sorted(names):
        raise wrong(rig, "counters", sorted(s.counters), f"{', '.join(names)}, and no other")
    for name, c in s.counters.items():
        if c.counts_per_unit == 0.0:
            raise wrong(rig, f"counters.{name}.counts_per_unit", 0.0, "another number than 0")
    return s
