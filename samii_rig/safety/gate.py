"""The safety gate: the one way from any intent to the actuators.

`judgement` decides, `Gate` alone holds the actuators and does what was decided, nothing
else. Every way out but RUNNING's "go on" ends with all outputs at zero. The gate knows no
experiment and no estimator, only limits, samples and requests.

Several outputs of one device are one state: each is judged by itself (`lane.Lane`), all are let
through or none, and what is wrong with one ends all at zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from samii_rig.devices.protocols import Actuator, Actuators, Alone, CommandBlock
from samii_rig.errors import GateError
from samii_rig.safety.judgement import (
    Act,
    Arm,
    Check,
    Clear,
    Decision,
    Fail,
    Request,
    Start,
    State,
    Stop,
    Write,
    decide_all,
)
from samii_rig.safety.lane import Lane
from samii_rig.safety.latest import Latest
from samii_rig.safety.limits import GateLimits
from samii_rig.safety.readback import Sent
from samii_rig.types import Channel, SampleBlock


@dataclass(frozen=True, slots=True)
class GateEvent:
    """A decision as the recording keeps it; time in ns of the host's clock."""

    time: int
    request: str
    decision: Decision


class Gate:
    """Holds the actuators and does what `decide_all` says.

    Parameters
    ----------
    actuator : driven by nobody else from here on.
    limits : of its output; of several, of each in the device's own order.
    channels : of the device's samples; GateError if one that the limits need is not there, or if
        the limits are not those of all its outputs.
    log : gets every decision that changes the state or refuses, after it was carried out.
        (Commands that pass are in the recording themselves.)

    Every method takes `now`, ns on the host's clock. Those that ask raise GateError when
    refused, with all outputs already at zero.

    FAULT is latched as long as this object lives; `samii_rig.safety.latch` carries it on to the
    next run.
    """

    def __init__(
        self,
        actuator: Actuator | Actuators,
        limits: GateLimits | Sequence[GateLimits],
        channels: tuple[Channel, ...],
        log: Callable[[GateEvent], None],
    ) -> None:
        each = (limits,) if isinstance(limits, GateLimits) else tuple(limits)
        self._lanes = tuple(Lane(one, channels, i) for i, one in enumerate(each))
        self._actuator = actuator if isinstance(actuator, Actuators) else Alone(actuator)
        judged = tuple(lane.name for lane in self._lanes)
        if len(self._actuator.names) != len(judged) or (
            len(judged) > 1 and self._actuator.names != judged
        ):
            raise GateError(
                f"the device drives {', '.join(self._actuator.names)}, and the limits are those "
                f"of {', '.join(judged)}; expected the same outputs in the same order"
            )
        self._log = log
        self._state = State.SAFE
        self.fault = ""

    @property
    def state(self) -> State:
        """Where the gate stands."""
        return self._state

    @property
    def _latest(self) -> Latest:
        return self._lanes[0].latest

    @property
    def _sent(self) -> Sent:
        return self._lanes[0].sent

    def beat(self, now: int) -> None:
        """A sign of life from the operator's client."""
        for lane in self._lanes:
            lane.beat(now)

    def arm(self, now: int) -> None:
        """Hand the device its limits and be ready."""
        self._ask(self._alike(Arm(self._actuator.deadman)), now)

    def start(self, now: int) -> None:
        """Let commands through from now on."""
        self._ask(self._alike(Start()), now)

    def observe(self, block: SampleBlock, now: int) -> None:
        """Take in all samples that arrived, perhaps none, and judge them."""
        with self._fault_on_error():
            for lane in self._lanes:
                lane.observe(block, now)
        self._ask(self._alike(Check()), now)

    def write(self, block: CommandBlock | tuple[CommandBlock, ...], now: int) -> None:
        """Send a reference; of several outputs a block each, of the same samples."""
        blocks = (block,) if isinstance(block, CommandBlock) else block
        # One block too few or too many is for the judgement to refuse.
        sent = [lane.sent for lane in self._lanes] + [Sent()] * len(blocks)
        self._ask(tuple(Write(b, s) for b, s in zip(blocks, sent, strict=False)), now)

    def stop(self, reason: str, now: int) -> None:
        """End at zero; allowed at any time, more than once."""
        self._ask(self._alike(Stop(reason)), now)

    def fail(self, reason: str, now: int) -> None:
        """End at zero and in FAULT; allowed at any time."""
        self._ask(self._alike(Fail(reason)), now)

    def clear(self, person: str, reason: str, now: int) -> None:
        """Leave FAULT on a person's word."""
        self._ask(self._alike(Clear(person, reason)), now)

    def margin(self) -> tuple[str, float]:
        """The channel nearest to its limit in the newest block, and 1 - |value|/limit."""
        worst, name = max(lane.nearest() for lane in self._lanes)
        return name, 1.0 - worst

    def _alike(self, request: Request) -> tuple[Request, ...]:
        return (request,) * len(self._lanes)

    @contextmanager
    def _fault_on_error(self) -> Iterator[None]:
        """Whatever breaks in here, the device or we, the answer is zero and FAULT."""
        try:
            yield
        except BaseException as error:
            self._state = State.FAULT
            self.fault = f"the gate or its actuator failed: {error!r}"
            self._zero()
            raise

    def _ask(self, requests: tuple[Request, ...], now: int) -> None:
        before = self._state
        with self._fault_on_error():
            known = [(lane.latest, lane.limits) for lane in self._lanes]
            decision = decide_all(before, requests, known, now)
            self._do(requests, decision)
        self._state = decision.state
        if before is State.FAULT and decision.state is State.SAFE:
            # Only a clear does this. Start afresh, so that arming needs new samples.
            for lane in self._lanes:
                lane.afresh()
            self.fault = ""
        elif before is not State.FAULT and decision.state is State.FAULT:
            self.fault = decision.reason
        if not decision.accepted or decision.state is not before:
            what = type(requests[0]).__name__.lower() if requests else "write"
            self._log(GateEvent(now, what, decision))
        if not decision.accepted:
            raise GateError(decision.reason)

    def _do(self, requests: tuple[Request, ...], decision: Decision) -> None:
        if decision.act is Act.ZERO:
            self._zero()
        elif decision.act is Act.CONFIGURE:
            self._actuator.configure(tuple(lane.limits.device_loop() for lane in self._lanes))
            for lane in self._lanes:
                lane.configured()
        elif decision.act is Act.WRITE:
            self._send(tuple(r.block for r in requests if isinstance(r, Write)))

    def _send(self, blocks: tuple[CommandBlock, ...]) -> None:
        self._actuator.write(blocks)
        for lane, block in zip(self._lanes, blocks, strict=True):
            lane.wrote(block)

    def _zero(self) -> None:
        try:
            self._actuator.zero()
        finally:
            # Twice costs nothing and covers a first call that a second Ctrl-C cut short.
            self._actuator.zero()
            for lane in self._lanes:
                lane.zeroed()
