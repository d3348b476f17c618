"""A state machine over gate and loop: commands, faults, clock steps, in whatever order.

No reachable state may have output without RUNNING, fresh sensors and a live heartbeat; with two
outputs (`GateAndPair`), no output of either.
"""

from __future__ import annotations

from threading import Event

import numpy as np
from fake_device import RATE, FakeDevice, fake_rig
from fake_pair import FakePair, pair_rig
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from samii_rig.devices.protocols import CommandBlock
from samii_rig.errors import DeviceError, GateError, RecordingError
from samii_rig.rig.schema import Rig
from samii_rig.run.client import Client
from samii_rig.run.interrupts import Interrupts
from samii_rig.run.loop import _Run
from samii_rig.run.pace import LoopSettings
from samii_rig.run.plan import Output, Plan, PlannedSegment
from samii_rig.safety.judgement import State, violation
from samii_rig.safety.latest import Latest
from samii_rig.types import Quality, SampleBlock

RIG = fake_rig()
HEARTBEAT = 0.3  # s
TICK = 0.02
STALE = 0.05


def plan_of(level: float) -> Plan:
    u = level * np.sin(2 * np.pi * np.arange(1000) / 125)
    part = PlannedSegment("s", "burst", level, "V", 0, u, 0 * u, (4.0, 4.0), 0 * u)
    return Plan("machine", RATE, "v", 4.0, "theta", (part,), 0)


class Spoilt(FakeDevice):
    """A device with faults that can be switched."""

    def __init__(self) -> None:
        super().__init__(self.spoiled)
        self.clock_step = self.count_step = 0
        self.flag, self.value, self.stray = 0, None, 0.0
        self.lost = False
        self.frozen: float | None = None
        self.raising: Exception | None = None

    def spoiled(self, block: SampleBlock) -> SampleBlock:
        if self.raising:
            raise self.raising
        values, quality = block.values.copy(), block.quality.copy()
        if self.value is not None:
            values[:1, 1] = self.value
        if self.frozen is not None:
            values[:, 1] = self.frozen
        # What the converter puts out too much, it puts out while it puts out anything.
        values[:, 0] += np.where(values[:, 0] != 0.0, self.stray, 0.0)
        quality[:, 0] |= np.uint8(self.flag & Quality.LIMITED)
        quality[:, 1] |= np.uint8(self.flag & ~Quality.LIMITED)
        kept = np.ones(len(block), dtype=bool)
        kept[1::3] = not self.lost
        return SampleBlock(
            block.channels,
            (block.time + self.clock_step)[kept],
            (block.sequence + self.count_step)[kept],
            values[kept],
            quality[kept],
        )


class Sunk:
    """A recorder that may be full."""

    def __init__(self) -> None:
        self.full = False

    def _take(self, *_: object) -> None:
        if self.full:
            raise RecordingError("recording failed: no space left")

    write = event = segment = _take


class GateAndLoop(RuleBasedStateMachine):
    """One run, tick by tick, and what goes wrong meanwhile."""

    @initialize(
        level=st.sampled_from([0.1, 1.0, 3.0, 6.0]),
        beat=st.sampled_from([True, True, False]),
        ticks=st.sampled_from([-1, 0, 1, 5, 20]),
    )
    def open(self, level: float, beat: bool, ticks: int) -> None:
        self.begin_with(Spoilt(), RIG, plan_of(level), beat, ticks)

    def begin_with(
        self, device: Spoilt | SpoiltPair, rig: Rig, plan: Plan, beat: bool, ticks: int
    ) -> None:
        self.device, self.sink = device, Sunk()
        self.beating, self.beaten = beat, -(10**12)
        self.stop, self.signals = Event(), Interrupts()
        self.job = _Run(
            plan,
            rig,
            self.device.open(),
            self.sink,
            Client(alive=self.alive),
            LoopSettings(tick=TICK, heartbeat_age=HEARTBEAT),
        )
        self.begun = False
        self.ended: tuple[str, str] | None = None
        if ticks >= 0:
            self.begin()
            for _ in range(ticks):
                if self.ended is None:
                    self.step(lambda: self.job.tick_on(self.stop, self.signals))

    def alive(self) -> bool:
        if self.beating:
            self.beaten = self.device.now()
        return self.beating

    def step(self, what) -> None:
        """As the loop itself does it."""
        try:
            self.ended = what()
        except BaseException as error:
            self.ended = self.job.ended_by(error)
        else:
            self.judged = self.device.now()
            if self.ended:
                self.job._zero(self.ended[1])
        if self.ended:
            assert not self.device.live

    @precondition(lambda self: not self.begun)
    @rule()
    def begin(self) -> None:
        self.begun = True
        self.step(self.job.begin)

    @precondition(lambda self: self.begun and self.ended is None)
    @rule(n=st.integers(1, 12))
    def ticks(self, n: int) -> None:
        for _ in range(n):
            if self.ended is None:
                self.step(lambda: self.job.tick_on(self.stop, self.signals))
                self.output_only_while_running()

    @rule(seconds=st.sampled_from([0.004, 0.03, 0.2]))
    def late(self, seconds: float) -> None:
        """The host does nothing for so long; the device's deadman counts on."""
        self.device.sleep(seconds)

    @rule(step=st.sampled_from([-(10**9), -1, 10**6, 10**10]), what=st.booleans())
    def clock_step(self, step: int, what: bool) -> None:
        if what:
            self.device.clock_step += step
        else:
            self.device.count_step += step // 10**6 or -3

    @rule(silent=st.booleans())
    def silence(self, silent: bool) -> None:
        self.device.silent = silent

    @rule(flag=st.sampled_from([0, 0, *(q.value for q in Quality if q)]))
    def quality(self, flag: int) -> None:
        self.device.flag = flag

    @rule(value=st.sampled_from([None, None, float("nan"), float("inf"), 0.34, 0.36, -2.0]))
    def sensor_reads(self, value: float | None) -> None:
        self.device.value = value

    @rule(frozen=st.sampled_from([None, 0.0, 0.1]))
    def sensor_freezes(self, frozen: float | None) -> None:
        self.device.frozen = frozen

    @rule(stray=st.sampled_from([0.0, 0.04, 0.06, -1.0]))
    def converter_strays(self, stray: float) -> None:
        self.device.stray = stray

    @rule(lost=st.booleans())
    def samples_get_lost(self, lost: bool) -> None:
        self.device.lost = lost

    @rule(angle=st.sampled_from([0.0, 0.3, 0.5, -0.5]))
    def joint_is_pushed(self, angle: float) -> None:
        self.device.theta = angle

    @rule(broken=st.booleans())
    def cable(self, broken: bool) -> None:
        self.device.raising = DeviceError("cable out") if broken else None

    @rule(full=st.booleans())
    def disk(self, full: bool) -> None:
        self.sink.full = full

    @rule(beating=st.booleans())
    def client(self, beating: bool) -> None:
        self.beating = beating

    @rule()
    def asked_to_stop(self) -> None:
        self.stop.set()

    @rule()
    def ctrl_c(self) -> None:
        self.signals.reason = "SIGINT (Ctrl-C)"

    @precondition(lambda self: self.begun and self.ended is None)
    @rule(level=st.sampled_from([0.0, 5.5, float("nan")]), gap=st.sampled_from([0, 1, -1, 300]))
    def something_else_writes(self, level: float, gap: int) -> None:
        """A defect above the gate: a block that is not the loop's."""
        gate, before = self.job.gate, len(self.device.written)
        block = CommandBlock(self.job.start + self.job.sent + gap, np.full(3, level), np.zeros(3))
        try:
            gate.write(block, self.device.now())
        except (GateError, RecordingError):
            assert len(self.device.written) == before
            assert not self.device.live
        else:
            self.job.sent += 3

    @precondition(lambda self: self.ended is not None)
    @rule(person=st.sampled_from(["Ada", ""]))
    def clear(self, person: str) -> None:
        gate = self.job.gate
        was = gate.state
        try:
            gate.clear(person, "looked", self.device.now())
        except (GateError, RecordingError):
            pass
        else:
            assert person
            assert was is State.FAULT
        assert not self.device.live

    @precondition(lambda self: self.ended is not None)
    @rule()
    def arm_again(self) -> None:
        """After a clear the gate may be armed; nothing moves by that."""
        try:
            self.job.gate.observe(self.device.read(), self.device.now())
            self.job.gate.arm(self.device.now())
        except (GateError, DeviceError, RecordingError):
            pass
        # Its reference of before is gone, and no new one passes.
        assert not self.device.live

    @invariant()
    def output_only_while_running(self) -> None:
        if not hasattr(self, "device") or not self.device.live:
            return
        gate = self.job.gate
        assert self.begun
        assert self.ended is None
        assert gate.state is State.RUNNING
        assert self.device.deadman is not None
        # What has been judged last; the time since then the device's own deadman watches.
        self.judged_well()
        assert (self.judged - self.beaten) * 1e-9 <= HEARTBEAT

    def judged_well(self) -> None:
        self.fresh(self.job.gate._latest, self.judged)

    def fresh(self, latest: Latest, judged: int) -> None:
        assert all(latest.age(i, judged) <= STALE for i in range(len(latest.peak)))
        assert all(angle <= 0.35 for angle in latest.peak[1:])
        assert latest.peak[0] <= 5.0
        assert not latest.disorder
        assert latest.stray <= 0.05

    def teardown(self) -> None:
        if not hasattr(self, "device"):
            return
        if self.begun and self.ended is None:
            self.stop.set()
            self.ticks(1)
        if self.ended:
            self.device.raising = None
            self.job.close(*self.ended)
        assert not self.device.live


PAIR = pair_rig()


def pair_plan(level: float) -> Plan:
    """One output, the other, and both at once."""
    u = level * np.sin(2 * np.pi * np.arange(400) / 125)
    pairs = (np.stack(x, axis=1) for x in ((u, 0 * u), (0 * u, u), (u, -u)))
    parts = tuple(
        PlannedSegment(f"s{i}", "burst", level, "V", 0, x, 0 * x, (4.0, 4.0), 0 * u)
        for i, x in enumerate(pairs)
    )
    beside = (Output("v_b", 2.0, "theta_b"),)
    return Plan("machine", RATE, "v_a", 4.0, "theta_a", parts, 0, beside)


class SpoiltPair(FakePair):
    """Two outputs, of which the faults that can be switched hit one: `place`."""

    def __init__(self, place: int) -> None:
        super().__init__(self.spoiled)
        self.place = place
        self.clock_step = self.count_step = 0
        self.flag, self.value, self.stray = 0, None, 0.0
        self.lost = False
        self.raising: Exception | None = None

    @property
    def frozen(self) -> float | None:
        return self.held.get(self.place)

    @frozen.setter
    def frozen(self, value: float | None) -> None:
        self.held = {} if value is None else {self.place: value}

    def spoiled(self, block: SampleBlock) -> SampleBlock:
        if self.raising:
            raise self.raising
        values, quality = block.values.copy(), block.quality.copy()
        v, theta = self.place, 2 + self.place
        if self.value is not None:
            values[:1, theta] = self.value
        values[:, v] += np.where(values[:, v] != 0.0, self.stray, 0.0)
        quality[:, v] |= np.uint8(self.flag & Quality.LIMITED)
        quality[:, theta] |= np.uint8(self.flag & ~Quality.LIMITED)
        kept = np.ones(len(block), dtype=bool)
        kept[1::3] = not self.lost
        return SampleBlock(
            block.channels,
            (block.time + self.clock_step)[kept],
            (block.sequence + self.count_step)[kept],
            values[kept],
            quality[kept],
        )


class GateAndPair(GateAndLoop):
    """The same run with two outputs, of which one is at fault."""

    @initialize(
        level=st.sampled_from([0.1, 0.3, 1.0, 6.0]),
        beat=st.sampled_from([True, True, True, False]),
        ticks=st.sampled_from([-1, 1, 5, 10, 20, 20, 45]),
        place=st.sampled_from([0, 1]),
    )
    def open(self, level: float, beat: bool, ticks: int, place: int) -> None:
        self.place = place
        self.begin_with(SpoiltPair(place), PAIR, pair_plan(level), beat, ticks)

    @rule(angle=st.sampled_from([0.0, 0.3, 0.5, -0.5]))
    def joint_is_pushed(self, angle: float) -> None:
        self.device.theta[self.place] = angle

    @precondition(lambda self: self.begun and self.ended is None)
    @rule(
        level=st.sampled_from([0.0, 5.5, float("nan")]),
        gap=st.sampled_from([0, 0, 0, 1, -1, 300]),
        apart=st.sampled_from([0, 0, 0, 1]),
        n=st.sampled_from([1, 2, 2, 2, 3]),
    )
    def something_else_writes(self, level: float, gap: int, apart: int, n: int) -> None:
        """A defect above the gate: blocks that are not the loop's, too few, or not together."""
        gate, before = self.job.gate, len(self.device.written)
        first = self.job.start + self.job.sent + gap
        u = [np.zeros(3)] * n
        u[min(self.place, n - 1)] = np.full(3, level)
        blocks = tuple(CommandBlock(first + apart * i, x, np.zeros(3)) for i, x in enumerate(u))
        try:
            gate.write(blocks, self.device.now())
        except (GateError, RecordingError):
            assert len(self.device.written) == before
            assert not self.device.live
        else:
            assert n == 2
            assert apart == 0
            self.job.sent += 3

    def judged_well(self) -> None:
        for lane in self.job.gate._lanes:
            self.fresh(lane.latest, self.judged)
            assert violation(lane.latest, lane.limits, self.judged) is None
