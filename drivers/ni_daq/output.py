"""The analogue output: a buffer that the board plays out, one sample at each of its inputs'.

There is no loop in a board, so there is none here: v = u. Three things end the output, each by
itself: the gate's zero(), a look every 2 ms at deadman, angle and the play-out (with this program
alive), and the board's watchdog or an interlock (with it dead or hung, or a null that the board
does not take).
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.ni_daq.settings import NiSettings, Output
from drivers.ni_daq.watchdog import SquareWave, Watchdog
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError
from samii_rig.rig.schema import ActuatorSpec
from samii_rig.types import Float

BUFFER = 10.0  # s of samples that the board's buffer holds
# s of null that is always ahead while no reference is, so that the buffer never runs dry before
# the deadman; well under the 0.1 s by which a first reference comes ahead.
REST = 0.04
PART = 0.9  # of the deadman's time, after which its end is made here, before the watchdog's
TRIES = 50  # to start between two samples
WRITE = 0.02  # s that a write may wait for room
TAKEN = 0.05  # s that zero() waits for a look that is under way


class AnalogueOutput:
    """The actuator. Sample numbers are the board's, as its inputs count them.

    acquired : how many samples the inputs have taken.
    """

    def __init__(
        self, ni: Any, settings: NiSettings, o: Output, spec: ActuatorSpec, rate: float
    ) -> None:
        self._ni, self._s, self._o, self._rate = ni, settings, o, rate
        self.name = spec.name
        self.deadman = spec.deadman if o.watchdog or o.interlock else None
        self._not_null = self._ended = ""
        self._lock = threading.RLock()
        self._task: Any = None  # plays out while configured
        self._loop: DeviceLoop | None = None
        self._live = self._dead = False
        self._next = 0  # sample that the next write begins with
        self._last = self._ref = 0.0
        self._fed = 0.0
        # By sample: u, theta_ref and whether v is another one.
        self._told: dict[int, tuple[float, float, bool]] = {}
        self.acquired: Callable[[], int] = lambda: 0
        self.watchdog: Watchdog | None = None
        self._wave: SquareWave | None = None
        if o.watchdog:
            # An expired one of an earlier program would refuse everything.
            ni.system.Device(o.watchdog).reset_device()
        self._null()
        if self.trouble:
            raise DeviceError(self.trouble)
        if o.watchdog and spec.deadman is not None:
            self.watchdog = Watchdog(ni, o.watchdog, settings.at(o.channel), o.null, spec.deadman)
        if o.interlock:
            try:
                self._wave = SquareWave(ni, settings.at(o.interlock.line))
            except BaseException:
                self.close()
                raise

    @property
    def trouble(self) -> str:
        """Why the output may not be at null, or what ended it; "" if nothing."""
        return self._not_null or self._ended or (self.watchdog.trouble if self.watchdog else "")

    # Actuator

    def configure(self, loop: DeviceLoop) -> None:
        """Set the limits, and play out null; DeviceError for a loop, or while it is live."""
        if loop.kp != 0.0 or loop.feedback:
            raise DeviceError(
                f"{self.name}: a board that plays out a buffer closes no loop; take [centring] and "
                "[[feedback]] out of the rig file, or let a serial node drive"
            )
        numbers = (loop.max_output, loop.max_rate, loop.max_angle)
        if not all(x >= 0.0 for x in numbers):
            raise DeviceError(f"{self.name}: negative or missing number in {loop}")
        with self._lock:
            if self._live:
                raise DeviceError(f"{self.name}: the output is live")
            self._rest(dead=False)
            if self._not_null:
                raise DeviceError(self._not_null)
            try:
                self._start()
            except Exception as error:
                self._rest(dead=True)
                raise DeviceError(f"{self._s.board}: the output does not start: {error}") from error
            self._loop = loop

    def write(self, block: CommandBlock) -> None:
        """Queue reference samples; feeds the deadman. What comes too late, or while the output is
        ended, is ignored."""
        u, ref = block.u, block.theta_ref
        if u.shape != ref.shape or u.ndim != 1:
            raise DeviceError(f"{self.name}: u and theta_ref of a block differ in length")
        if not (np.isfinite(u).all() and np.isfinite(ref).all()):
            raise DeviceError(f"{self.name}: a reference sample is not a finite number")
        with self._lock:
            late = max(0, self._next - block.first)
            if self._task is None or late >= len(u):
                return
            if block.first + len(u) - self.acquired() > BUFFER * self._rate:
                raise DeviceError(f"{self.name}: a reference further ahead than {BUFFER:g} s")
            try:
                if self.watchdog is not None:
                    self.watchdog.feed()
                if self._wave is not None:
                    self._wave.edge()
                self._live, self._fed = True, time.monotonic()
                self._fill(block.first)
                self._play(u[late:], ref[late:])
            except Exception as error:
                self._rest(dead=True)
                raise DeviceError(f"{self._s.board}: the output has ended: {error}") from error

    def zero(self) -> None:
        """Output at null, nothing queued. What the board does not take, its watchdog or the
        interlock ends."""
        taken = self._lock.acquire(timeout=TAKEN)
        try:
            self._rest(dead=False)
        finally:
            if taken:
                self._lock.release()

    def close(self) -> None:
        """At null; the watchdog ends where that is sure. May be called twice."""
        self.zero()
        if self.watchdog is not None and not self._not_null:
            self.watchdog.close()
        if self._wave is not None:
            self._wave.close()

    # For the reader of the inputs

    def look(self, angle: float) -> None:
        """What a device does by itself: deadman, angle, null ahead. angle : largest |theta| that
        is new."""
        with self._lock:
            if self._task is None or self._loop is None:
                return
            late = self._live and time.monotonic() - self._fed > PART * (self.deadman or 0.0)
            if late or not angle <= self._loop.max_angle:
                self._rest(dead=True)
                return
            try:
                self._fill(self.acquired() + math.ceil(REST * self._rate))
            except Exception as error:
                self._rest(dead=True)
                self._ended = f"{self._s.board}: the output has ended: {error}"

    def end(self) -> None:
        """At null, until it is configured again: the inputs have ended."""
        with self._lock:
            self._rest(dead=True)

    def told(self, first: int, n: int) -> Float:
        """(n, 3): u and theta_ref of the samples from `first`, and whether v is another one."""
        with self._lock:
            nothing = (0.0, self._ref, self._dead)
            rows = [self._told.pop(first + i, nothing) for i in range(n)]
        return np.array(rows, dtype=float).reshape(n, 3)

    # The board

    def _start(self) -> None:
        """Play out, beginning with a sample that is known: NI's count of the inputs must be the
        same before and after the start."""
        n = math.ceil(REST * self._rate)
        for _ in range(TRIES):
            task = self._made()
            try:
                task.out_stream.regen_mode = (
                    self._ni.constants.RegenerationMode.DONT_ALLOW_REGENERATION
                )
                task.out_stream.output_buf_size = math.ceil(BUFFER * self._rate)
                task.write(np.full(n, self._o.null), auto_start=False, timeout=WRITE)
                task.control(self._ni.constants.TaskMode.TASK_COMMIT)
                before = self.acquired()
                until = time.monotonic() + 1.0
                while (first := self.acquired()) == before and time.monotonic() < until:
                    pass
                task.start()
                if first != before and self.acquired() == first:
                    self._task, self._next, self._last, self._ref = task, first + n, 0.0, 0.0
                    self._told.clear()
                    return
            except BaseException:
                _closed(task)
                raise
            _closed(task)
        raise DeviceError("it cannot be started between two samples")

    def _made(self) -> Any:
        task = self._ni.Task()
        o, mode = self._o, self._ni.constants.AcquisitionType.CONTINUOUS
        task.ao_channels.add_ao_voltage_chan(self._s.at(o.channel), min_val=o.low, max_val=o.high)
        size = math.ceil(BUFFER * self._rate)
        task.timing.cfg_samp_clk_timing(
            self._rate, source=self._s.clock, sample_mode=mode, samps_per_chan=size
        )
        return task

    def _fill(self, upto: int) -> None:
        """Rest up to this sample: u = 0."""
        if upto > self._next:
            n = upto - self._next
            self._play(np.zeros(n), np.full(n, self._ref))

    def _play(self, u: Float, ref: Float) -> None:
        assert self._loop is not None
        o, most, step = self._o, self._loop.max_output, self._loop.max_rate / self._rate
        ends = sorted((x - o.null) / o.volts_per_unit for x in (o.low, o.high))
        low, high = max(-most, ends[0]), min(most, ends[1])
        v = np.empty_like(u)
        for i, wanted in enumerate(u.tolist()):
            least, largest = max(self._last - step, low), min(self._last + step, high)
            v[i] = self._last = min(max(wanted, least), largest)
        volts = o.null + o.volts_per_unit * v
        self._task.write(volts, auto_start=False, timeout=WRITE)
        changed = (v != u).tolist()
        for i, row in enumerate(zip(u.tolist(), ref.tolist(), changed, strict=True)):
            self._told[self._next + i] = row
        self._next += len(u)
        self._ref = float(ref[-1])

    def _rest(self, *, dead: bool) -> None:
        """At null, whatever state the task is in."""
        _closed(self._task)
        self._task, self._live, self._dead = None, False, dead
        self._null()
        # What was queued does not come out; what is on its way back did.
        with contextlib.suppress(Exception):
            taken = self.acquired()
            self._told = {n: row for n, row in self._told.items() if n < taken}

    def _null(self) -> None:
        """One sample of null, on demand; unless it is taken the watchdog is left to expire. The
        interlock opens in any case."""
        o, task = self._o, None
        try:
            task = self._ni.Task()
            task.ao_channels.add_ao_voltage_chan(
                self._s.at(o.channel), min_val=o.low, max_val=o.high
            )
            task.write(o.null, auto_start=True, timeout=WRITE)
        except Exception as error:
            line = " ".join(str(error).split())
            self._not_null = f"{self._s.board}: the output could not be set to null: {line}"
        else:
            self._not_null = ""
        finally:
            _closed(task)
        if self.watchdog is not None:
            self.watchdog.rest(at_null=not self._not_null)


def describe(o: Output, deadman: float | None) -> dict[str, str]:
    """What ends the output when this program is dead, for the recording."""
    lock, told = o.interlock, {}
    if o.watchdog:
        told["watchdog"] = f"{o.watchdog}, {deadman:g} s"
    if lock:
        told["interlock"] = f"{lock.name} at {lock.line}: {lock.reason}"
    return told


def _closed(task: Any) -> None:
    if task is not None:
        with contextlib.suppress(Exception):
            task.close()
