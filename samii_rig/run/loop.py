"""The loop that carries out a plan: reference out ahead of time, samples in, zero at the end.

The device's clock paces. Each tick reads what arrived, lets the gate judge it, sends the
reference on so that it stays ahead, and hands the samples to the recorder. Whatever ends
the run, the first thing done is the output at zero; the recording is closed after that.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable
from contextlib import nullcontext
from threading import Event

import numpy as np

from samii_rig.devices.protocols import CommandBlock, OpenRig, Reports
from samii_rig.errors import DeviceError, GateError, RecordingError, SamiiRigError
from samii_rig.rig.schema import Rig
from samii_rig.run.client import NOBODY, Client
from samii_rig.run.dwell import Reference, Watch
from samii_rig.run.ending import Status, Zero, attempt, with_troubles
from samii_rig.run.interrupts import Interrupts
from samii_rig.run.outputs import columns, completed, plan_limits
from samii_rig.run.pace import COUNTS_AS_LATE, LoopSettings, choose_ahead, choose_tick
from samii_rig.run.plan import Plan
from samii_rig.run.progress import Progress, nearer
from samii_rig.run.sink import Collector, QueuedSink, Sink, pair_clocks
from samii_rig.safety.gate import Gate, GateEvent
from samii_rig.safety.judgement import State
from samii_rig.safety.latest import CLOCK_DRIFT
from samii_rig.types import Quality, SampleBlock, Segment, StopRecord

FIRST_SAMPLE = 1.0  # s to wait for the device's first sample
GATHER = 0.25  # s of samples in one message to the recorder
# s that a late tick waits before it reads: a host that was stopped as a whole finds what arrived
# meanwhile still with the driver's reader.
CATCH_UP = 0.0005


def run(
    plan: Plan,
    rig: Rig,
    device: OpenRig,
    sink: Sink,
    client: Client = NOBODY,
    *,
    settings: LoopSettings | None = None,
    interrupts: Interrupts | None = None,
    latch: Callable[[str], None] | None = None,
) -> StopRecord:
    """Carry out `plan`; always returns, with the output at zero.

    A device whose output cannot be zeroed, or does not show zero, makes the status `failed`
    and the reason begin with that.

    Parameters
    ----------
    sink : the recorder. On real time it works in a thread of its own; on simulated time
        (`device.metadata["clock"] == "simulated"`) it is called directly.
    client : of the operator.
    interrupts : signals that end the run, if the caller handles them already; they are left
        with `ending` set.
    latch : gets the reason when the gate has ended in FAULT, with the output at zero.

    Returns
    -------
    StopRecord with status completed, stopped, tripped (by the gate) or failed (by anything
    else; the traceback of a defect goes to the sink as an event).

    Raises
    ------
    InputError if the settings do not fit the device, GateError if the device lacks a channel
    that the limits need: both before anything moves.
    """
    job = _Run(plan, rig, device, sink, client, settings or LoopSettings())
    with nullcontext(interrupts) if interrupts else Interrupts() as signals:
        status, reason = job.until_the_end(client.stop or Event(), signals)
        signals.ending = True
        if latch is not None and job.gate.state is State.FAULT:
            fault = job.gate.fault
            status, reason = with_troubles(status, reason, [attempt(lambda: latch(fault))])
        return job.close(status, reason)


class _Run:
    """One run; each method is one phase of it."""

    def __init__(
        self,
        plan: Plan,
        rig: Rig,
        device: OpenRig,
        sink: Sink,
        client: Client,
        settings: LoopSettings,
    ) -> None:
        plan = completed(plan, rig)
        self.plan, self.rig, self.device, self.settings = plan, rig, device, settings
        self.progress, self.alive = client.progress, client.alive
        self.clock, self.sensor = device.clock, device.sensor
        simulated = device.metadata.get("clock") == "simulated"
        self.tick = choose_tick(settings, device, plan.rate_hz, simulated)
        self.ahead = math.ceil((choose_ahead(settings, simulated) + self.tick) * plan.rate_hz)
        self.reports = self.sensor if isinstance(self.sensor, Reports) else None
        self.reference = Reference(plan)
        self.collector = Collector(
            rig, plan, self.reference, self.sensor.channels, max(1, round(GATHER * plan.rate_hz))
        )
        limits = plan_limits(plan, rig, settings.heartbeat_age)
        # Samples past the newest one that the gate takes.
        self.most_ahead = math.floor(min(one.max_ahead for one in limits) * plan.rate_hz)
        self.gate = Gate(device.actuator, limits, self.sensor.channels, self._log)
        self.zero = Zero(device, *(one.output for one in limits))
        self.watch = Watch(self.reference, self.sensor.channels, plan.actuator)
        # Last: it starts a thread.
        self.queued = None if simulated else QueuedSink(sink)
        self.sink: Sink = self.queued or sink
        self.newest = -1  # newest sample that arrived
        self.reckoned, self.reckoned_at = 0.0, 0  # the device's sample by the host's clock, ns
        self.apart = 0  # ns, host's clock minus the device's, as the newest sample has it
        # The same as the promptest block of late has it, and when that came.
        self.promptly, self.promptly_at = 0, -1
        self.zeroed = 0  # ns on the device's clock, when zero() had returned
        self.start = -1  # sample at which the plan begins
        self.sent = 0  # samples of the plan that were sent, and of the rest after it
        self.done = 0  # segments that are whole and reported
        self.late = self.missing = 0
        self.latest = 0.0  # s, of the tick that was the latest
        self.due = self.report = 0  # ns, next tick and next progress report
        self.margin = self.worst = ("", math.inf)

    def until_the_end(self, stop: Event, interrupts: Interrupts) -> tuple[Status, str]:
        """Run; when this returns the output is at zero, whatever happened."""
        try:
            self.begin()
            ended = None
            while ended is None:
                ended = self.tick_on(stop, interrupts)
            self._zero(ended[1])
        except BaseException as error:
            return self.ended_by(error)
        return ended

    def ended_by(self, error: BaseException) -> tuple[Status, str]:
        """The output at zero first, then how a run ends that raised this."""
        if isinstance(error, GateError):
            self._zero(str(error))
            # Refused before it was armed: nothing tripped, nothing moved.
            return "tripped" if self.gate.state is State.FAULT else "failed", str(error)
        if isinstance(error, KeyboardInterrupt):
            reason = "KeyboardInterrupt (Ctrl-C)"
            self._zero(reason)
            return "stopped", reason
        if isinstance(error, RecordingError):
            # The disk is full or broken, the rig is well: a controlled stop.
            self._zero(str(error))
            return "failed", str(error)
        if isinstance(error, SamiiRigError):
            self._zero(str(error), failed=True)
            return "failed", str(error)
        reason = f"{type(error).__name__}: {error}"
        self._zero(reason, failed=True)
        text = "".join(traceback.format_exception(error))
        attempt(lambda: self._event("error", traceback=text))
        return "failed", reason

    def close(self, status: Status, reason: str) -> StopRecord:
        """The output is at zero: take what still arrives, and finish the recording."""
        late, missing = self.late, self.missing
        troubles = [attempt(self._tail), attempt(self._flush)]
        if self.zero.trouble:
            status, reason = "failed", f"{self.zero.trouble}; the run had ended: {reason}"
        status, reason = with_troubles(status, reason, troubles)
        attempt(
            lambda: self._event(
                "stop",
                status=status,
                reason=reason,
                late_ticks=late,
                latest_tick=self.latest,
                missing_samples=missing,
                # Against the event's own stamp: how far the device's clock has drifted.
                **({} if self.queued is None else {"wall_ns": time.time_ns()}),
            )
        )
        if self.queued is not None:
            status, reason = with_troubles(status, reason, [attempt(self.queued.close)])
        return StopRecord(status, reason, late, missing)

    def begin(self) -> None:
        """Wait for the first sample, arm, start."""
        give_up = self.clock.now() + round(FIRST_SAMPLE * 1e9)
        while self.newest < 0:
            if self.clock.now() > give_up:
                raise DeviceError(f"the device gave no sample in {FIRST_SAMPLE:g} s")
            self.clock.sleep(self.tick)
            self._read()
        self.gate.arm(self.clock.now())
        self._read()
        self.gate.start(self.clock.now())
        self.start = self.newest + 1 + self.ahead
        self.collector.start_at(self.start)
        self._event("plan", start=self.start, samples=len(self.reference.u))
        self.due = self.report = self.reckoned_at = self.clock.now()

    def tick_on(self, stop: Event, interrupts: Interrupts) -> tuple[Status, str] | None:
        """One tick: send, wait, read; how the run ended, None if it goes on."""
        if self.newest >= self.start + len(self.reference.u) - 1:
            self.gate.stop("the plan is done", self.clock.now())
            self._report_segments()
            return "completed", f"all {len(self.plan.segments)} segments done"
        if interrupts.reason or stop.is_set():
            by = interrupts.reason
            reason = f"stopped by {by}" if by else "stopped on request"
            self._zero(reason)
            # The stop may have come in the tick in which a segment's last sample did.
            self._report_segments()
            return "stopped", reason
        self._send()
        self._report_segments()
        self.due = self._wait(self.due + round(self.tick * 1e9))
        self._read()
        if self.collector.full:
            self._flush()
        if self.progress is not None and self.clock.now() >= self.report:
            self.report = self.clock.now() + round(self.settings.report * 1e9)
            self.progress(self._progress())
            self.margin = ("", math.inf)
        return None

    def _wait(self, due: int) -> int:
        """Sleep until `due`, and notice when it got later; when it is now."""
        self.clock.sleep((due - self.clock.now()) * 1e-9)
        late = (self.clock.now() - due) * 1e-9
        self.latest = max(self.latest, late)
        if late > max(0.5 * self.tick, COUNTS_AS_LATE):
            self.late += 1
            self.clock.sleep(CATCH_UP)
        return due if late < 0.5 * self.tick else self.clock.now()

    def _read(self) -> None:
        """Take what arrived; the gate sees it first."""
        if self.alive is not None and self.alive():
            self.gate.beat(self.clock.now())
        block = self.sensor.read()
        if len(block):
            # Before anything that logs an event, whose time follows from it.
            now = self.clock.now()
            self.apart = now - int(block.time[-1])
            drift = round(CLOCK_DRIFT * (now - self.promptly_at))
            if self.promptly_at < 0 or self.apart < self.promptly + drift:
                self.promptly, self.promptly_at = self.apart, now
            if self.newest < 0:
                pair_clocks(self.sink, int(block.time[-1]), time.time_ns())
        self.collector.add(block)
        self.gate.observe(block, self.clock.now())
        self._tell()
        if len(block):
            self._count(block)
            self._shorten(block)
            self.margin = nearer(self.margin, self.gate.margin())
            self.worst = nearer(self.worst, self.margin)

    def _shorten(self, block: SampleBlock) -> None:
        """Leave a dwell that has measured enough."""
        if self.start < 0:
            return
        left = self.watch.take(block, self.start, self.sent)
        if left is not None:
            self._event("dwell", name=left.name, blocks=left.blocks, relative=left.relative)

    def _count(self, block: SampleBlock) -> None:
        """Notice samples that were lost or came without values."""
        first, last = int(block.sequence[0]), int(block.sequence[-1])
        before = first - 1 if self.newest < 0 else self.newest
        lost = last - before - len(block)
        self.newest = last
        if lost > 0:
            self._event("gap", after=before, lost=lost)
        self.missing += lost
        if block.quality.any():
            self.missing += int(((block.quality & Quality.MISSING) != 0).any(axis=1).sum())

    def _tell(self) -> None:
        """What the device says beside its samples, into the recording."""
        if self.reports is not None:
            for event in self.reports.events():
                self.sink.event(event.time, event.name, dict(event.fields))

    def _send(self) -> None:
        """Send the reference up to `ahead` past the newest sample. After the plan's end stay at its
        last set point, so that the deadman stays fed until the last sample has arrived.

        Samples come in blocks. In between they are reckoned on by the clock, so that every tick
        sends, and thus feeds the deadman. Where they stay out for long, nothing is sent beyond what
        the gate takes: the age of the sensors and the deadman are then what judges.
        """
        now = self.clock.now()
        # A little slower than its clock may be, and from the promptest block on: a block that is
        # late itself must not hold up what is sent.
        since = (now - self.reckoned_at) * 1e-9 * self.plan.rate_hz * (1.0 - CLOCK_DRIFT)
        self.reckoned = max(float(self.newest), self.reckoned + since)
        self.reckoned_at = now
        last = min(int(self.reckoned) + self.ahead, self.newest + self.most_ahead)
        upto = last + 1 - self.start
        n = upto - self.sent
        if n <= 0:
            return
        part = slice(self.sent, min(upto, len(self.reference.u)))
        blocks = []
        for of_u, of_ref in zip(
            columns(self.reference.u).T, columns(self.reference.theta_ref).T, strict=True
        ):
            u, theta_ref = np.zeros(n), np.full(n, of_ref[-1])
            if part.start < part.stop:
                u[: part.stop - part.start] = of_u[part]
                theta_ref[: part.stop - part.start] = of_ref[part]
            blocks.append(CommandBlock(self.start + self.sent, u, theta_ref))
        self.gate.write(tuple(blocks), self.clock.now())
        self.sent = upto

    def _report_segments(self) -> None:
        """Tell the sink of segments whose last sample has arrived, after their samples."""
        ends = self.reference.ends
        while self.done < len(ends) and self.newest + 1 >= self.start + ends[self.done]:
            self._flush()
            s = self.reference.segments[self.done]
            begin = self.start + self.reference.begin(self.done)
            first, last = s.recorded or (0, len(s.u))
            self.sink.segment(
                Segment(
                    s.name,
                    s.kind,
                    begin + first,
                    begin + last,
                    s.level,
                    s.unit,
                    s.repeat,
                    s.excited,
                )
            )
            self.done += 1

    def _progress(self) -> Progress:
        total = len(self.reference.u)
        at = min(max(self.newest - self.start, 0), total - 1)
        i = self.reference.at(at)
        s = self.reference.segments[i]
        inside = at - self.reference.begin(i)
        return Progress(
            segment=i + 1,
            n_segments=len(self.reference.ends),
            name=s.name,
            level=s.level,
            unit=s.unit,
            repeat=s.repeat,
            time_left=(self.start + total - 1 - self.newest) / self.plan.rate_hz,
            frequency=float(s.frequency[inside]),
            channel=self.margin[0],
            margin=self.margin[1],
            worst_channel=self.worst[0],
            worst_margin=self.worst[1],
            late_ticks=self.late,
            missing_samples=self.missing,
        )

    def _zero(self, reason: str, *, failed: bool = False) -> None:
        """Output at zero. What goes wrong after that (its log) must not hide the cause."""
        try:
            (self.gate.fail if failed else self.gate.stop)(reason, self.clock.now())
        except BaseException:
            self.zero.force()
        self.zeroed = self.clock.now() - self.promptly

    def _tail(self) -> None:
        """The samples after the end, which must show the output at zero."""
        self.zero.check(self.tick, self.collector.add, self.zeroed, spoke=self.newest >= 0)
        self._tell()

    def _flush(self) -> None:
        block = self.collector.take()
        if block is not None:
            self.sink.write(block)

    def _log(self, event: GateEvent) -> None:
        d = event.decision
        numbers = {"number": d.number, "limit": d.limit}
        self.sink.event(
            event.time - self.apart,
            "gate",
            {
                "request": event.request,
                "state": d.state.value,
                "accepted": int(d.accepted),
                "what": d.what,
                "reason": d.reason,
                **{k: v for k, v in numbers.items() if math.isfinite(v)},
                **({"unit": d.unit} if d.unit else {}),
            },
        )

    def _event(self, kind: str, **fields: str | int | float) -> None:
        self.sink.event(self.clock.now() - self.apart, kind, fields)
