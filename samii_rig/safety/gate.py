"""The safety gate: the one way from any intent to the actuator.

`judgement` decides, `Gate` alone holds the actuator and does what was decided, nothing
else. Every way out but RUNNING's "go on" ends with the output at zero. The gate knows no
experiment and no estimator, only limits, samples and requests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.devices.protocols import Actuator, CommandBlock
from samii_rig.errors import GateError
from samii_rig.safety.agreement import Followed, apart
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
    decide,
)
from samii_rig.safety.latest import Latest, observe
from samii_rig.safety.limits import GateLimits
from samii_rig.safety.readback import Places, Sent, stray
from samii_rig.types import Channel, SampleBlock

FLIGHT = 0.05  # s that a sample may take from the device to here


@dataclass(frozen=True, slots=True)
class GateEvent:
    """A decision as the recording keeps it; time in ns of the host's clock."""

    time: int
    request: str
    decision: Decision


class Gate:
    """Holds the actuator and does what `decide` says.

    Parameters
    ----------
    actuator : driven by nobody else from here on.
    channels : of the device's samples; GateError if one that the limits need is not there.
    log : gets every decision that changes the state or refuses, after it was carried out.
        (Commands that pass are in the recording themselves.)

    Every method takes `now`, ns on the host's clock. Those that ask raise GateError when
    refused, with the output already at zero.

    FAULT is latched as long as this object lives; `samii_rig.safety.latch` carries it on to the
    next run.
    """

    def __init__(
        self,
        actuator: Actuator,
        limits: GateLimits,
        channels: tuple[Channel, ...],
        log: Callable[[GateEvent], None],
    ) -> None:
        names = [c.name for c in channels]
        for needed in limits.channels:
            if needed.channel not in names:
                raise GateError(
                    f"the device reports no channel {needed.channel}, which the gate needs; "
                    f"it has {', '.join(names)}"
                )
        self._actuator, self._limits, self._log = actuator, limits, log
        self._columns = np.array([names.index(c.channel) for c in limits.channels])
        self._rates = tuple(
            i
            for i, c in enumerate(limits.channels)
            if math.isfinite(c.max_rate) or c.channel == limits.centring_sensor
        )
        self._places = Places.among(channels, limits.output.channel, limits.centring_sensor)
        self._pairs = [(names.index(a.sensor), names.index(a.other)) for a in limits.agreements]
        self._followed = [Followed() for _ in limits.agreements]
        self._sent = Sent()
        self._latest = Latest.nothing(len(self._columns))
        self._state = State.SAFE
        self.fault = ""

    @property
    def state(self) -> State:
        """Where the gate stands."""
        return self._state

    def beat(self, now: int) -> None:
        """A sign of life from the operator's client."""
        self._latest = replace(self._latest, heartbeat=now)

    def arm(self, now: int) -> None:
        """Hand the device its limits and be ready."""
        self._ask(Arm(self._actuator.deadman), now)

    def start(self, now: int) -> None:
        """Let commands through from now on."""
        self._ask(Start(), now)

    def observe(self, block: SampleBlock, now: int) -> None:
        """Take in all samples that arrived, perhaps none, and judge them."""
        with self._fault_on_error():
            latest = observe(self._latest, block, self._columns, self._rates, now)
            if len(block):  # nothing new takes nothing back
                strayed = stray(self._sent, block, self._places, self._limits.kp)
                latest = replace(latest, stray=strayed, apart=self._apart(block))
            self._latest = latest
            self._sent = self._sent.after(latest.sequence)
        self._ask(Check(), now)

    def write(self, block: CommandBlock, now: int) -> None:
        """Send a reference."""
        self._ask(Write(block, self._sent), now)

    def stop(self, reason: str, now: int) -> None:
        """End at zero; allowed at any time, more than once."""
        self._ask(Stop(reason), now)

    def fail(self, reason: str, now: int) -> None:
        """End at zero and in FAULT; allowed at any time."""
        self._ask(Fail(reason), now)

    def clear(self, person: str, reason: str, now: int) -> None:
        """Leave FAULT on a person's word."""
        self._ask(Clear(person, reason), now)

    def margin(self) -> tuple[str, float]:
        """The channel nearest to its limit in the newest block, and 1 - |value|/limit."""
        used = [
            (p / c.max, c.channel)
            for p, c in zip(self._latest.peak, self._limits.channels, strict=True)
        ]
        worst, name = max(used)
        return name, 1.0 - worst

    def _apart(self, block: SampleBlock) -> tuple[float, ...]:
        found = [
            apart(a, columns, before, block)
            for a, columns, before in zip(
                self._limits.agreements, self._pairs, self._followed, strict=True
            )
        ]
        self._followed = [followed for followed, _ in found]
        return tuple(way for _, way in found)

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

    def _ask(self, request: Request, now: int) -> None:
        before = self._state
        with self._fault_on_error():
            decision = decide(before, request, self._latest, self._limits, now)
            self._do(request, decision)
        self._state = decision.state
        if before is State.FAULT and decision.state is State.SAFE:
            # Only a clear does this. Start afresh, so that arming needs new samples.
            beat = self._latest.heartbeat
            self._latest = replace(Latest.nothing(len(self._columns)), heartbeat=beat)
            self._followed = [Followed() for _ in self._followed]
            self.fault = ""
        elif before is not State.FAULT and decision.state is State.FAULT:
            self.fault = decision.reason
        if not decision.accepted or decision.state is not before:
            self._log(GateEvent(now, type(request).__name__.lower(), decision))
        if not decision.accepted:
            raise GateError(decision.reason)

    def _do(self, request: Request, decision: Decision) -> None:
        if decision.act is Act.ZERO:
            self._zero()
        elif decision.act is Act.CONFIGURE:
            self._actuator.configure(self._limits.device_loop())
            # From here on the device must change nothing by itself, but for what was under way.
            first = self._latest.sequence + 1 + math.ceil(FLIGHT * self._limits.rate_hz)
            self._latest = replace(self._latest, first=first)
        elif decision.act is Act.WRITE and isinstance(request, Write):
            self._send(request.block)

    def _send(self, block: CommandBlock) -> None:
        self._actuator.write(block)
        self._sent = self._sent.then(block)
        self._latest = replace(
            self._latest,
            first=min(block.first, self._latest.first),
            next=block.first + len(block),
            u=float(block.u[-1]),
            theta_ref=float(block.theta_ref[-1]),
        )

    def _zero(self) -> None:
        try:
            self._actuator.zero()
        finally:
            # Twice costs nothing and covers a first call that a second Ctrl-C cut short.
            self._actuator.zero()
            self._sent = Sent()
            self._latest = replace(self._latest, first=-1, next=-1, u=0.0, theta_ref=0.0)
