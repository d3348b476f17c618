"""The inputs of the board: encoders and analogue inputs on one sample clock, and what its output
was, read back."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any

import numpy as np

from drivers.ni_daq.output import Playout
from drivers.ni_daq.settings import NiSettings
from drivers.sensing import taken
from samii_rig.devices.channels import command_channel, reference_channels
from samii_rig.errors import DeviceError
from samii_rig.rig.schema import Rig
from samii_rig.types import Channel, Flags, Float, Int, Quality, SampleBlock

LOOK = 0.002  # s between looks at the board's buffer
LOOKS_KEPT = 4096  # looks that wait for read()
WITHIN = 10.0  # s that one call of the driver may take


class Board:
    """The sensor. Times are the board's: its count of samples over its rate.

    tasks : the analogue one first. Its first rows are the read-backs of the outputs.
    """

    def __init__(
        self, rig: Rig, settings: NiSettings, tasks: list[Any], output: Playout | None
    ) -> None:
        own = (*rig.sensor, *rig.monitor)
        self._settings, self._tasks, self._output = settings, tasks, output
        self._rate = settings.rate(rig)
        self.latency = (0.0, settings.latency)
        self._specs = rig.actuator
        self._wires = settings.output.wires(rig) if settings.output else ()
        self.channels = tuple(
            Channel(
                x.name,
                x.unit,
                "sensor" if x in rig.sensor else "monitor",
                x.low,
                x.high,
                x.resolution,
                x.calibration,
            )
            for x in own
        )
        self._inputs = self.channels
        if output:
            self.channels = (
                *reference_channels(rig),
                *(
                    command_channel(spec, spec.resolution, "read back, in steps of its resolution")
                    for spec in self._specs
                ),
                *self._inputs,
            )
        # A task gives its rows in the order in which its channels were added.
        rows = [*settings.analogue, *settings.encoder]
        self._order = [rows.index(x.name) for x in own]
        self._count = 0
        self._held: Float | None = None  # a sample whose read-back comes with the next one
        self._trouble = ""
        self._came: deque[tuple[int, Float, Flags, int]] = deque(maxlen=LOOKS_KEPT)
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=LOOKS_KEPT)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reader of the board", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """What ended the samples or the output, "" if nothing did."""
        return self._trouble or (self._output.trouble if self._output else "")

    def read(self) -> SampleBlock:
        """All samples since the last call; DeviceError, after the last one, when the board says
        no more."""
        trouble = self.trouble
        came = [self._came.popleft() for _ in range(len(self._came))]
        if not came and trouble:
            raise DeviceError(trouble)
        m = len(self.channels)
        sequence: Int = np.concatenate(
            [np.zeros(0, np.int64), *(first + np.arange(len(x)) for first, x, _, _ in came)]
        )
        values = np.concatenate([np.zeros((0, m)), *(x for _, x, _, _ in came)])
        quality = np.concatenate([np.zeros((0, m), np.uint8), *(q for _, _, q, _ in came)])
        times: Int = np.rint(sequence * (1e9 / self._rate)).astype(np.int64)
        self._arrivals += [
            (round((first + len(x) - 1) * 1e9 / self._rate), at) for first, x, _, at in came
        ]
        return SampleBlock(self.channels, times, sequence, values, quality)

    def arrivals(self) -> Int:
        """(n, 2) ns: board's and host's time of the samples given since the last call."""
        return taken(self._arrivals)

    def close(self) -> None:
        """End the reader; may be called twice."""
        self._ending.set()
        self._thread.join()

    def _scaled(self, raw: Float) -> tuple[Float, Flags]:
        """(n, m) values and flags of the inputs from (rows, n)."""
        s = self._settings
        values, clipped = np.empty_like(raw), np.zeros(raw.shape, dtype=bool)
        for i, a in enumerate(s.analogue.values()):
            values[i] = (raw[i] - a.offset) / a.volts_per_unit
            clipped[i] = (raw[i] <= a.low) | (raw[i] >= a.high)
        for i, e in enumerate(s.encoder.values(), start=len(s.analogue)):
            values[i] = e.sign * (raw[i] - e.offset)
        out, ends = values[self._order].T, clipped[self._order].T
        for i, c in enumerate(self._inputs):
            ends[:, i] |= (out[:, i] <= c.low) | (out[:, i] >= c.high)
        quality = np.where(ends, Quality.CLIPPED, Quality.GOOD).astype(np.uint8)
        quality[~np.isfinite(out)] = Quality.MISSING
        return out, quality

    def _driven(self, output: Playout, raw: Float) -> tuple[Float, Flags]:
        """The same with the references and the outputs before them, one sample behind: at its
        instant an input still sees the output as it was."""
        joined = raw if self._held is None else np.concatenate([self._held, raw], axis=1)
        self._held = joined[:, -1:]
        k = len(self._wires)
        values, quality = self._scaled(joined[k:])
        most = np.abs(values).max(axis=0).tolist()
        output.look(dict(zip([c.name for c in self._inputs], most, strict=True)))
        n = joined.shape[1] - 1
        told = output.told(self._count, n)
        columns, flags = np.empty((n, 3 * k)), np.zeros((n, 3 * k), np.uint8)
        for j, (w, spec) in enumerate(zip(self._wires, self._specs, strict=True)):
            v, step = (joined[j, 1:] - w.null) / w.volts_per_unit, spec.resolution
            v = np.rint(v / step) * step if step else v
            columns[:, 2 * j : 2 * j + 2], columns[:, 2 * k + j] = told[:, j, :2], v
            flags[told[:, j, 2] != 0.0, 2 * k + j] = Quality.LIMITED
            flags[~np.isfinite(v), 2 * k + j] = Quality.MISSING
        return np.column_stack([columns, values[:n]]), np.column_stack([flags, quality[:n]])

    def _run(self) -> None:
        """The reader: whatever ends it is trouble, and so never only silence."""
        try:
            while not self._ending.wait(LOOK):
                n = min(int(t.in_stream.avail_samp_per_chan) for t in self._tasks)
                now = time.monotonic_ns()
                if not n:
                    if self._output:
                        self._output.look({})
                    continue
                got = [np.atleast_2d(t.read(n, timeout=WITHIN)) for t in self._tasks]
                raw = np.concatenate(got).astype(float)
                values, quality = (
                    self._driven(self._output, raw) if self._output else self._scaled(raw)
                )
                if len(values):
                    self._came.append((self._count, values, quality, now))
                self._count += len(values)
        except BaseException as error:
            if self._output:
                self._output.end()
            line = " ".join(str(error).split())
            self._trouble = f"{self._settings.board}: {type(error).__name__}: {line}"
