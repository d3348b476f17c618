"""Analogue inputs and encoders of a National Instruments board, through NI-DAQmx; docs/ni-daq.md.

It measures only. A board that plays out a buffer closes no loop and, when the buffer runs dry,
holds its last voltage, so it has none of what an output here must have; no gate arms it.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationError

from drivers.sensing import NoOutput
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.schema import Finite, Name, Positive, Rig, Strict
from samii_rig.run.clock import MonotonicClock
from samii_rig.run.protocols import OpenRig
from samii_rig.types import Channel, Float, Int, Quality, SampleBlock

LOOK = 0.002  # s between looks at the board's buffer
BUFFER = 10.0  # s of samples that the board's buffer holds
KEPT = 4096  # looks that wait for read()
WITHIN = 10.0  # s that one call of the driver may take


class Analogue(Strict):
    """value = (volts - offset)/volts_per_unit at an input such as ai0, of the range low to high."""

    input: str = Field(min_length=1)
    volts_per_unit: Finite
    offset: Finite = 0.0
    low: Finite = -10.0
    high: Finite = 10.0


class Encoder(Strict):
    """value = sign (angle - offset), rad, at a counter such as ctr0; four edges a pulse."""

    counter: str = Field(min_length=1)
    pulses_per_rev: Annotated[int, Field(ge=1)]
    offset: Finite = 0.0
    sign: Annotated[int, Field(ge=-1, le=1)] = 1


class NiSettings(Strict):
    """Settings of the driver; an unknown one is an error.

    board : as NI MAX names it, Dev1. rate_hz : left out, the rig's. analogue, encoder : by the
    name of a sensor or monitor; each of the rig's has one. latency : s, the longest way of a
    sample to this program on a quiet machine: 1 ms inside a computer, 5 ms over USB.
    """

    board: str = Field(min_length=1)
    rate_hz: Positive | None = None
    analogue: dict[Name, Analogue] = Field(default_factory=dict)
    encoder: dict[Name, Encoder] = Field(default_factory=dict)
    latency: Positive = 0.005


class Board:
    """The sensor. Times are the board's: its count of samples over its rate."""

    def __init__(self, rig: Rig, settings: NiSettings, tasks: list[Any]) -> None:
        own = (*rig.sensor, *rig.monitor)
        self._settings, self._tasks = settings, tasks
        self._rate = settings.rate_hz or rig.rate_hz
        self.latency = (0.0, settings.latency)
        self.channels = tuple(
            Channel(x.name, x.unit, "sensor", x.low, x.high, x.resolution, x.calibration)
            for x in own
        )
        # A task gives its rows in the order in which its channels were added.
        rows = [*settings.analogue, *settings.encoder]
        self._order = [rows.index(x.name) for x in own]
        self._count = 0
        self.trouble = ""
        self._came: deque[tuple[int, Float, int]] = deque(maxlen=KEPT)
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=KEPT)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reader of the board", daemon=True)
        self._thread.start()

    def read(self) -> SampleBlock:
        """All samples since the last call; DeviceError, after the last one, when the board says
        no more."""
        trouble = self.trouble
        came = [self._came.popleft() for _ in range(len(self._came))]
        if not came and trouble:
            raise DeviceError(trouble)
        sequence: Int = np.concatenate(
            [np.zeros(0, np.int64), *(first + np.arange(x.shape[1]) for first, x, _ in came)]
        )
        raw = np.concatenate([np.zeros((len(self._order), 0)), *(x for _, x, _ in came)], axis=1)
        times: Int = np.rint(sequence * (1e9 / self._rate)).astype(np.int64)
        ends = [first + x.shape[1] - 1 for first, x, _ in came]
        self._arrivals += [
            (round(end * 1e9 / self._rate), at) for end, (_, _, at) in zip(ends, came, strict=True)
        ]
        values, clipped = self._scaled(raw)
        quality = np.where(clipped, Quality.CLIPPED, Quality.GOOD).astype(np.uint8)
        quality[~np.isfinite(values)] = Quality.MISSING
        return SampleBlock(self.channels, times, sequence, values, quality)

    def arrivals(self) -> Int:
        """(n, 2) ns: board's and host's time of the samples given since the last call."""
        pairs = np.array(self._arrivals, dtype=np.int64).reshape(-1, 2)
        self._arrivals.clear()
        return pairs

    def close(self) -> None:
        """End the tasks; may be called twice."""
        self._ending.set()
        self._thread.join()
        _end(self._tasks)
        self._tasks.clear()

    def _scaled(self, raw: Float) -> tuple[Float, Any]:
        s = self._settings
        values, clipped = np.empty_like(raw), np.zeros(raw.shape, dtype=bool)
        for i, a in enumerate(s.analogue.values()):
            values[i] = (raw[i] - a.offset) / a.volts_per_unit
            clipped[i] = (raw[i] <= a.low) | (raw[i] >= a.high)
        for i, e in enumerate(s.encoder.values(), start=len(s.analogue)):
            values[i] = e.sign * (raw[i] - e.offset)
        out, flags = values[self._order].T, clipped[self._order].T
        for i, c in enumerate(self.channels):
            flags[:, i] |= (out[:, i] <= c.low) | (out[:, i] >= c.high)
        return out, flags

    def _run(self) -> None:
        """The reader: whatever ends it is trouble, and so never only silence."""
        try:
            while not self._ending.wait(LOOK):
                n = min(int(t.in_stream.avail_samp_per_chan) for t in self._tasks)
                now = time.monotonic_ns()
                if n:
                    got = [np.atleast_2d(t.read(n, timeout=WITHIN)) for t in self._tasks]
                    self._came.append((self._count, np.concatenate(got).astype(float), now))
                    self._count += n
        except BaseException as error:
            line = " ".join(str(error).split())
            self.trouble = f"{self._settings.board}: {type(error).__name__}: {line}"


@dataclass(frozen=True, slots=True)
class NiRig(OpenRig):
    """Ends the board's tasks."""

    device: Board

    def close(self) -> None:
        """May be called twice."""
        self.device.close()


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The board of the settings, sampling: encoders and analogue inputs on one sample clock.

    InputError for a wrong setting or where nidaqmx is not installed, DeviceError for what NI-DAQmx
    refuses.
    """
    s = _read(rig, settings)
    try:
        ni = importlib.import_module("nidaqmx")
        constants = importlib.import_module("nidaqmx.constants")
    except ImportError as error:
        expected = "the package nidaqmx: pip install 'samii-rig[nidaqmx]', and NI-DAQmx of NI"
        raise InputError(rig.name, "device.driver", "ni_daq", expected) from error
    tasks: list[Any] = []
    try:
        _make(ni, constants, s, s.rate_hz or rig.rate_hz, tasks)
    except Exception as error:
        _end(tasks)
        # NI's own errors, and whatever a missing library of NI makes of a call.
        line = " ".join(str(error).split())
        raise DeviceError(f"{s.board}: NI-DAQmx refuses: {line}") from error
    device = Board(rig, s, tasks)
    return NiRig(
        NoOutput("ni_daq"),
        device,
        MonotonicClock(),
        f"NI-DAQmx board {s.board}",
        {"device": "ni_daq", "clock": "device", "device_settings": s.model_dump_json()},
        device,
    )


def _make(ni: Any, constants: Any, s: NiSettings, rate: float, tasks: list[Any]) -> None:
    """The tasks, started; the analogue one last, as its sample clock is that of all."""
    analogue = ni.Task()
    tasks.append(analogue)
    for a in s.analogue.values():
        analogue.ai_channels.add_ai_voltage_chan(
            f"{s.board}/{a.input}", min_val=a.low, max_val=a.high
        )
    source = f"/{s.board}/ai/SampleClock"
    size = math.ceil(BUFFER * rate)
    mode = constants.AcquisitionType.CONTINUOUS
    analogue.timing.cfg_samp_clk_timing(rate, sample_mode=mode, samps_per_chan=size)
    for e in s.encoder.values():
        task = ni.Task()
        tasks.append(task)
        task.ci_channels.add_ci_ang_encoder_chan(
            f"{s.board}/{e.counter}",
            decoding_type=constants.EncoderType.X_4,
            units=constants.AngleUnits.RADIANS,
            pulses_per_rev=e.pulses_per_rev,
        )
        task.timing.cfg_samp_clk_timing(rate, source=source, sample_mode=mode, samps_per_chan=size)
    for task in reversed(tasks):
        task.start()


def _end(tasks: list[Any]) -> None:
    for task in tasks:
        with contextlib.suppress(Exception):
            task.close()


def _read(rig: Rig, given: Mapping[str, object]) -> NiSettings:
    try:
        s = NiSettings.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(map(str, first["loc"]))
        if first["type"] == "missing":
            where = f"device.settings.{name}"
            raise InputError.saying(rig.name, where, "is missing; see docs/ni-daq.md") from error
        expected = first["msg"].removeprefix("Input should be ")
        if first["type"] == "extra_forbidden":
            expected = f"one of {', '.join(NiSettings.model_fields)}"
        raise _wrong(rig, name, first["input"], expected) from error
    units = {x.name: x.unit for x in (*rig.sensor, *rig.monitor)}
    if sorted([*s.analogue, *s.encoder]) != sorted(units):
        found = sorted([*s.analogue, *s.encoder])
        raise _wrong(rig, "analogue and encoder", found, f"{', '.join(units)}, each once")
    if not s.analogue:
        expected = "at least one: its sample clock is that of the encoders"
        raise _wrong(rig, "analogue", [], expected)
    for name, a in s.analogue.items():
        if a.volts_per_unit == 0.0:
            raise _wrong(rig, f"analogue.{name}.volts_per_unit", 0.0, "another number than 0")
        if not a.low < a.high:
            raise _wrong(rig, f"analogue.{name}.low", a.low, f"below high, {a.high:g}")
    for name, e in s.encoder.items():
        if units[name] != "rad":
            raise _wrong(rig, f"encoder.{name}", units[name], "a channel in rad")
        if e.sign == 0:
            raise _wrong(rig, f"encoder.{name}.sign", 0, "1 or -1")
    return s


def _wrong(rig: Rig, name: str, value: object, expected: str) -> InputError:
    return InputError(rig.name, f"device.settings.{name}", value, expected)
