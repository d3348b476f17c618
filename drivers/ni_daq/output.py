"""The analogue outputs: a buffer that the board plays out, one sample at each of its inputs'.

All outputs are channels of one task: one start, one buffer, one null. So what ends one ends all.

There is no loop in a board, so there is none here: v = u. Three things end the outputs, each by
itself: the gate's zero(), a look every 2 ms at deadman, angle and the play-out (with this program
alive), and the board's watchdog or an interlock (with it dead or hung, or a null that the board
does not take).
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from drivers.ni_daq.settings import NiSettings, Output, Wire
from drivers.ni_daq.watchdog import SquareWave, Watchdog
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError
from samii_rig.rig.schema import Rig
from samii_rig.types import Float

BUFFER = 10.0  # s of samples that the board's buffer holds
# s of null that is always ahead while no reference is, so that the buffer never runs dry before
# the deadman; well under the 0.1 s by which a first reference comes ahead.
REST = 0.04
PART = 0.9  # of the deadman's time, after which its end is made here, before the watchdog's
START_TRIES = 50  # to start between two samples
WRITE = 0.02  # s that a write may wait for room
TAKEN = 0.05  # s that zero() waits for a look that is under way


class Playout:
    """What all outputs of a board are. Sample numbers are the board's, as its inputs count them.

    acquired : how many samples the inputs have taken.
    """

    def __init__(self, ni: Any, settings: NiSettings, o: Output, rig: Rig) -> None:
        self._ni, self._s, self._rate = ni, settings, rig.rate_hz
        self._own = tuple(a.name for a in rig.actuator)
        self._wires = o.wires(rig)
        self._inputs = {x.name for x in (*rig.sensor, *rig.monitor)}
        held = [a.deadman for a in rig.actuator if a.deadman is not None]
        known = len(held) == len(self._own) and bool(o.watchdog or o.interlock)
        self.deadman = min(held) if known else None
        self._not_null = self._ended = ""
        self._lock = threading.RLock()
        self._task: Any = None  # plays out while configured
        self._loops: tuple[DeviceLoop, ...] = ()
        self._live = self._dead = False
        self._next = 0  # sample that the next write begins with
        self._last = self._ref = np.zeros(len(self._own))
        self._fed = 0.0
        # By sample, (k, 3): u, theta_ref and whether v is another one.
        self._told: dict[int, Float] = {}
        self.acquired: Callable[[], int] = lambda: 0
        self.watchdog: Watchdog | None = None
        self._wave: SquareWave | None = None
        if o.watchdog:
            # An expired one of an earlier program would refuse everything.
            ni.system.Device(o.watchdog).reset_device()
        self._null()
        if self.trouble:
            raise DeviceError(self.trouble)
        if o.watchdog and self.deadman is not None:
            nulls = {settings.at(w.channel): w.null for w in self._wires}
            self.watchdog = Watchdog(ni, o.watchdog, nulls, self.deadman)
        if o.interlock:
            try:
                self._wave = SquareWave(ni, settings.at(o.interlock.line))
            except BaseException:
                self.close()
                raise

    @property
    def trouble(self) -> str:
        """Why the outputs may not be at null, or what ended it; "" if nothing."""
        return self._not_null or self._ended or (self.watchdog.trouble if self.watchdog else "")

    # For the actuators

    def take_limits(self, loops: tuple[DeviceLoop, ...]) -> None:
        """Set the limits, and play out null; DeviceError for a loop, or while it is live."""
        self._one_for_each(loops)
        for name, loop in zip(self._own, loops, strict=True):
            self._check_loop(name, loop)
        with self._lock:
            if self._live:
                raise DeviceError(f"{', '.join(self._own)}: the output is live")
            self._rest(dead=False)
            if self._not_null:
                raise DeviceError(self._not_null)
            try:
                self._start()
            except Exception as error:
                self._rest(dead=True)
                raise DeviceError(f"{self._s.board}: the output does not start: {error}") from error
            self._loops = loops

    def queue(self, blocks: tuple[CommandBlock, ...]) -> None:
        """Queue reference samples; feeds the deadman. What comes too late, or while the outputs
        are ended, is ignored."""
        self._one_for_each(blocks)
        for name, block in zip(self._own, blocks, strict=True):
            if block.u.shape != block.theta_ref.shape or block.u.ndim != 1:
                raise DeviceError(f"{name}: u and theta_ref of a block differ in length")
            if not (np.isfinite(block.u).all() and np.isfinite(block.theta_ref).all()):
                raise DeviceError(f"{name}: a reference sample is not a finite number")
        if len({(b.first, len(b)) for b in blocks}) != 1:
            raise DeviceError(f"{', '.join(self._own)}: references of different samples")
        first = blocks[0].first
        u = np.stack([b.u for b in blocks], axis=1)
        ref = np.stack([b.theta_ref for b in blocks], axis=1)
        with self._lock:
            late = max(0, self._next - first)
            if self._task is None or late >= len(u):
                return
            if first + len(u) - self.acquired() > BUFFER * self._rate:
                said = f"a reference further ahead than {BUFFER:g} s"
                raise DeviceError(f"{', '.join(self._own)}: {said}")
            try:
                if self.watchdog is not None:
                    self.watchdog.feed()
                if self._wave is not None:
                    self._wave.edge()
                self._live, self._fed = True, time.monotonic()
                self._fill(first)
                self._play(u[late:], ref[late:])
            except Exception as error:
                self._rest(dead=True)
                raise DeviceError(f"{self._s.board}: the output has ended: {error}") from error

    def zero(self) -> None:
        """All outputs at null, nothing queued. What the board does not take, its watchdog or the
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

    def look(self, most: Mapping[str, float]) -> None:
        """What a device does by itself: deadman, angles, null ahead. most : largest |value| of each
        input that is new; empty where nothing is."""
        with self._lock:
            if self._task is None or not self._loops:
                return
            late = self._live and time.monotonic() - self._fed > PART * (self.deadman or 0.0)
            far = not all(most.get(x.sensor, 0.0) <= x.max_angle for x in self._loops)
            if late or far:
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
        """(n, k, 3): u and theta_ref of the samples from `first`, and whether v is another one."""
        with self._lock:
            k = len(self._own)
            nothing = np.column_stack([np.zeros(k), self._ref, np.full(k, self._dead)])
            rows = [self._told.pop(first + i, nothing) for i in range(n)]
        return np.array(rows, dtype=float).reshape(n, k, 3)

    # The board

    def _start(self) -> None:
        """Play out, beginning with a sample that is known: NI's count of the inputs must be the
        same before and after the start."""
        n = math.ceil(REST * self._rate)
        for _ in range(START_TRIES):
            task = self._made()
            try:
                task.out_stream.regen_mode = (
                    self._ni.constants.RegenerationMode.DONT_ALLOW_REGENERATION
                )
                task.out_stream.output_buf_size = math.ceil(BUFFER * self._rate)
                nulls = np.array([w.null for w in self._wires])
                task.write(_data(np.tile(nulls, (n, 1))), auto_start=False, timeout=WRITE)
                task.control(self._ni.constants.TaskMode.TASK_COMMIT)
                before = self.acquired()
                until = time.monotonic() + 1.0
                while (first := self.acquired()) == before and time.monotonic() < until:
                    pass
                task.start()
                if first != before and self.acquired() == first:
                    self._task, self._next = task, first + n
                    self._last = self._ref = np.zeros(len(self._own))
                    self._told.clear()
                    return
            except BaseException:
                _closed(task)
                raise
            _closed(task)
        raise DeviceError("it cannot be started between two samples")

    def _made(self) -> Any:
        task = self._ni.Task()
        mode = self._ni.constants.AcquisitionType.CONTINUOUS
        self._add(task, self._wires)
        size = math.ceil(BUFFER * self._rate)
        task.timing.cfg_samp_clk_timing(
            self._rate, source=self._s.clock, sample_mode=mode, samps_per_chan=size
        )
        return task

    def _fill(self, upto: int) -> None:
        """Rest up to this sample: u = 0."""
        if upto > self._next:
            n = upto - self._next
            self._play(np.zeros((n, len(self._own))), np.tile(self._ref, (n, 1)))

    def _play(self, u: Float, ref: Float) -> None:
        """References (n, k), each output within its own limits."""
        kept = [
            _kept(w, loop, loop.max_rate / self._rate, last, u[:, j])
            for j, (w, loop, last) in enumerate(
                zip(self._wires, self._loops, self._last.tolist(), strict=True)
            )
        ]
        v = np.stack(kept, axis=1)
        volts = [w.null + w.volts_per_unit * x for w, x in zip(self._wires, kept, strict=True)]
        self._task.write(_data(np.stack(volts, axis=1)), auto_start=False, timeout=WRITE)
        self._last = v[-1]
        for i, row in enumerate(np.stack([u, ref, v != u], axis=2)):
            self._told[self._next + i] = row
        self._next += len(u)
        self._ref = ref[-1]

    def _add(self, task: Any, wires: Sequence[Wire]) -> None:
        """Outputs as channels of one task."""
        for w in wires:
            channel = self._s.at(w.channel)
            task.ao_channels.add_ao_voltage_chan(channel, min_val=w.low, max_val=w.high)

    def _one_for_each(self, given: Sequence[object]) -> None:
        if len(given) != len(self._own):
            said = f"{len(given)} given, one for each is needed"
            raise DeviceError(f"{', '.join(self._own)}: {said}")

    def _check_loop(self, name: str, loop: DeviceLoop) -> None:
        """DeviceError for one that a board cannot close, or limits that it cannot keep."""
        if loop.kp != 0.0 or loop.feedback:
            raise DeviceError(
                f"{name}: a board that plays out a buffer closes no loop; take [centring] and "
                "[[feedback]] out of the rig file, or let a serial node drive"
            )
        if not all(x >= 0.0 for x in (loop.max_output, loop.max_rate, loop.max_angle)):
            raise DeviceError(f"{name}: negative or missing number in {loop}")
        if loop.sensor not in self._inputs:
            raise DeviceError(f"{name}: no input {loop.sensor!r} whose angle ends it")

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
        """One sample of every null, on demand; unless all are taken the watchdog is left to expire.
        The interlock opens in any case."""
        self._not_null = self._put(self._wires)
        if self._not_null and len(self._wires) > 1:
            # A board that refuses one channel refuses the task of all: the others go by themselves.
            for w in self._wires:
                self._put((w,))
        if self.watchdog is not None:
            self.watchdog.rest(at_null=not self._not_null)

    def _put(self, wires: Sequence[Wire]) -> str:
        """These outputs' nulls; what NI-DAQmx said if it did not take them, else ""."""
        task, nulls = None, [w.null for w in wires]
        try:
            task = self._ni.Task()
            self._add(task, wires)
            # NI-DAQmx wants a number for one channel, a list for several.
            data = nulls[0] if len(nulls) == 1 else nulls
            task.write(data, auto_start=True, timeout=WRITE)
        except Exception as error:
            line = " ".join(str(error).split())
            names = "" if len(self._wires) == 1 else f" of {', '.join(self._own)}"
            return f"{self._s.board}: the output{names} could not be set to null: {line}"
        finally:
            _closed(task)
        return ""


def _kept(w: Wire, loop: DeviceLoop, step: float, last: float, u: Float) -> Float:
    """(n,) of the references u within an output's limits, from its `last` value on."""
    ends = sorted((x - w.null) / w.volts_per_unit for x in (w.low, w.high))
    low, high = max(-loop.max_output, ends[0]), min(loop.max_output, ends[1])
    v = np.empty_like(u)
    for i, wanted in enumerate(u.tolist()):
        least, largest = max(last - step, low), min(last + step, high)
        v[i] = last = min(max(wanted, least), largest)
    return v


def _data(volts: Float) -> Float:
    """(n, k) as NI-DAQmx wants it: (n,) for one channel, a row each for several."""
    return volts[:, 0].copy() if volts.shape[1] == 1 else np.ascontiguousarray(volts.T)


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
