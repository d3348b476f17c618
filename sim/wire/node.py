"""A serial I/O node in Python: the same integers and the same bytes as the portable C core.

It is written from the protocol's page (docs/reference/serial-node-frames.md), not from the C core,
and held to it by differential fuzzing: the same bytes and samples in, the same counts and bytes
out.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field

from cobs import cobs

from sim.wire.protocol import (
    HALF,
    MAX_ENCODED,
    MAX_PAYLOAD,
    QUEUE,
    RAILS,
    TX,
    WORD,
    Code,
    Flag,
    NodeConfig,
    OutputConfig,
    Reason,
    State,
    Type,
)


@dataclass(slots=True)
class Loop:
    """What CONFIGURE sets for one output, and what that output did last."""

    encoder: int = 0
    adc_mask: int = 0
    kp_q16: int = 0
    max_output: int = 0
    max_step: int = 0
    max_angle: int = 0
    max_jump: int = 0
    centre: int = 0
    theta_ref: int = 0
    v: int = 0


@dataclass(slots=True)
class Node:
    """One node since its boot number `boot`.

    sample : number of the next sample. state, rejected, host_seq : as the protocol has them.
    loops : one for each output. fed : sample at which the deadman was fed last. stray : counts by
    which an output's converter is off what it was told, relay : whether the supply line works:
    defects that a test can have.
    """

    config: NodeConfig
    boot: int
    sample: int = 0
    state: State = State.IDLE
    configured: bool = False
    rejected: int = 0
    seq: int = 0
    host_seq: int = 0
    loops: list[Loop] = field(default_factory=list)
    queue: dict[int, tuple[int, ...]] = field(default_factory=dict)
    age: int = 0
    fed: int = 0
    stray: dict[int, int] = field(default_factory=dict)
    relay: bool = True
    encoders: tuple[int, ...] | None = None
    emergency: bool = False
    adc_out: bool = False
    batch: list[bytes] = field(default_factory=list)
    batch_head: tuple[int, int] = (0, 0)
    rx: bytearray = field(default_factory=bytearray)
    tx: bytearray = field(default_factory=bytearray)

    def __post_init__(self) -> None:
        self.loops = [Loop() for _ in self.config.outputs]
        self._hello()

    @property
    def v(self) -> tuple[int, ...]:
        """Counts of each output less its null."""
        return tuple(loop.v for loop in self.loops)

    # Bytes

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""
        *ends, rest = data.split(b"\0")
        for part in ends:
            self.rx += part
            if self.rx:
                self._frame(bytes(self.rx))
            self.rx.clear()
        # One byte over the longest is as bad as many.
        self.rx += rest[: MAX_ENCODED + 1 - len(self.rx)]

    def transmit(self, room: int = TX) -> bytes:
        """At most `room` bytes to the host."""
        out = bytes(self.tx[:room])
        del self.tx[:room]
        return out

    def _send(self, kind: Type, body: bytes) -> None:
        payload = struct.pack("<BBHI", self.config.version, kind, self.boot, self.seq) + body
        self.seq = (self.seq + 1) % WORD
        payload += struct.pack("<I", zlib.crc32(payload))
        n = len(payload)
        # Room for the worst that COBS makes of it; without it the frame is lost whole.
        if len(self.tx) + n + n // 254 + 2 <= TX:
            self.tx += cobs.encode(payload) + b"\0"

    def _frame(self, stuffed: bytes) -> None:
        if len(stuffed) > MAX_ENCODED or not self._accepted(stuffed):
            self.rejected = (self.rejected + 1) % (1 << 16)

    def _accepted(self, stuffed: bytes) -> bool:
        try:
            p = cobs.decode(stuffed)
        except cobs.DecodeError:
            return False
        if not 12 <= len(p) <= MAX_PAYLOAD or p[-4:] != struct.pack("<I", zlib.crc32(p[:-4])):
            return False
        version, kind, boot, seq = struct.unpack_from("<BBHI", p)
        body, k = p[8:-4], len(self.loops)
        if kind == Type.IDENTIFY and not body:
            self._hello()
            return True
        fits = (
            not body
            if kind in (Type.ZERO, Type.CLEAR)
            else len(body) == 24 * k
            if kind == Type.CONFIGURE
            else kind == Type.STREAM and len(body) > 5 and len(body) == 5 + 6 * k * body[4]
        )
        newer = 0 < (seq - self.host_seq) % WORD < HALF
        if not (version == self.config.version and fits and boot == self.boot and newer):
            return False
        self.host_seq = seq
        code = self._act(Type(kind), body)
        if kind != Type.STREAM or code:
            self._send(Type.ANSWER, struct.pack("<IBB", seq, kind, code))
        return True

    def _act(self, kind: Type, body: bytes) -> Code:
        if kind == Type.CONFIGURE:
            return self._configure(body)
        if kind == Type.STREAM:
            return self._stream(body)
        if kind == Type.ZERO:
            after = State.TRIPPED if self.state == State.TRIPPED else State.IDLE
            self._to_null(after, Reason.ZEROED)
        elif self.state == State.TRIPPED:
            if self.emergency or self.adc_out:
                return Code.CAUSE
            self._to_null(State.IDLE, Reason.CLEARED)
        return Code.OK

    def _hello(self) -> None:
        c = self.config
        body = struct.pack(
            "<IHBBBBhhhHHHiI16s16s",
            c.period_ns,
            c.deadman_ms,
            c.n_encoder,
            c.n_adc,
            c.batch,
            self.state,
            c.dac_low,
            c.dac_high,
            c.null,
            c.max_output,
            c.max_step,
            QUEUE,
            c.max_jump,
            self.host_seq,
            c.firmware,
            c.serial,
        )
        if c.beside:
            body += struct.pack("<B", len(c.outputs))
        for o in c.beside:
            numbers = o.dac_low, o.dac_high, o.null, o.max_output, o.max_step, o.max_jump
            body += struct.pack("<hhhHHi", *numbers)
        self._send(Type.HELLO, body)

    # Requests

    def _configure(self, body: bytes) -> Code:
        if self.live:
            return Code.NOT_NULL
        if self.state == State.TRIPPED:
            return Code.STATE
        asked = []
        for o, numbers in zip(
            self.config.outputs, struct.iter_unpack("<BBHiHHiii", body), strict=True
        ):
            encoder, zero, mask, kp, most, step, angle, jump, centre = numbers
            good = (
                encoder < self.config.n_encoder
                and zero == 0
                and mask < 1 << self.config.n_adc
                and most <= o.max_output
                and step <= o.max_step
                and angle >= 0
                and 0 <= jump <= o.max_jump
            )
            if not good:
                return Code.LIMIT
            asked.append(Loop(encoder, mask, kp, most, step, angle, jump, centre, centre))
        self.loops = asked
        self.configured = True
        self._to_null(State.IDLE, Reason.CONFIGURED)
        return Code.OK

    def _stream(self, body: bytes) -> Code:
        first, n = struct.unpack_from("<IB", body)
        if not self.configured:
            return Code.STATE
        last = (first + n - 1 - self.sample) % WORD
        if last >= HALF:
            return Code.LATE
        if last >= QUEUE:
            return Code.QUEUE
        code = Code.OK
        layout = f"<{'hi' * len(self.loops)}"
        for i, pairs in enumerate(struct.iter_unpack(layout, body[5:])):
            number = (first + i) % WORD
            if (number - self.sample) % WORD < QUEUE:
                self.queue[number] = pairs
            else:
                code = Code.LATE
        self.age, self.fed = 0, self.sample
        return code

    # Samples

    @property
    def live(self) -> bool:
        """Whether the outputs follow their loops."""
        return self.state in (State.LIVE, State.DRY)

    @property
    def supply(self) -> bool:
        """Whether the supply line is on."""
        return self.live and self.relay

    def take(
        self, clock_us: int, encoders: tuple[int, ...], adcs: tuple[int, ...], emergency: bool
    ) -> tuple[int, ...]:
        """One sample; the counts to put out of each output."""
        common, own, reason = self._judge(encoders, adcs)
        self.emergency = emergency
        if emergency:
            common |= Flag.EMERGENCY
            self._to_null(State.TRIPPED, Reason.EMERGENCY)
        if self.live or self.queue:
            self.age += 1
            if self.age >= self.config.deadman_ms * 1_000_000 // self.config.period_ns:
                self._to_null(State.DEAD, Reason.DEADMAN)
        u = [0] * len(self.loops)
        if self.sample in self.queue:
            pairs = self.queue.pop(self.sample)
            u = list(pairs[::2])
            for loop, ref in zip(self.loops, pairs[1::2], strict=True):
                loop.theta_ref = ref
            common |= Flag.REFERENCE
            self._change(State.LIVE, Reason.STARTED)
        elif self.state == State.LIVE:
            self._change(State.DRY, Reason.RAN_DRY)
        if self.live and reason:
            self._to_null(State.TRIPPED, reason)
        if self.live:
            common |= Flag.SUPPLY if self.supply else 0
            for j, (loop, o) in enumerate(zip(self.loops, self.config.outputs, strict=True)):
                wanted = self._wanted(loop, u[j], encoders)
                loop.v = self._limited(loop, o, wanted)
                own[j] |= Flag.LIMITED if loop.v != wanted else 0
        else:
            common |= Flag.NULL | (0 if self.state == State.IDLE else Flag.LIMITED)
        held = [v + self.stray.get(j, 0) for j, v in enumerate(self.v)]
        told = zip(held, u, [loop.theta_ref for loop in self.loops], own, strict=True)
        rows = [struct.pack("<hhiB", v, x, ref, common | flags) for v, x, ref, flags in told]
        self._report(clock_us, b"".join(rows), encoders, adcs)
        self.sample = (self.sample + 1) % WORD
        return tuple(v + o.null for v, o in zip(held, self.config.outputs, strict=True))

    @staticmethod
    def _wanted(loop: Loop, u: int, encoders: tuple[int, ...]) -> int:
        error = loop.theta_ref - encoders[loop.encoder]
        return u + ((loop.kp_q16 * error + (1 << 15)) >> 16)

    @staticmethod
    def _limited(loop: Loop, o: OutputConfig, wanted: int) -> int:
        step, most = loop.max_step, loop.max_output
        v = min(max(wanted, loop.v - step), loop.v + step)
        v = min(max(v, -most), most)
        return min(max(v, o.dac_low - o.null), o.dac_high - o.null)

    def _judge(
        self, encoders: tuple[int, ...], adcs: tuple[int, ...]
    ) -> tuple[int, list[int], int]:
        """Flags of all outputs, flags of each, and a reason to trip: one output's ends all."""
        common, own, reason = 0, [0] * len(self.loops), 0
        self.adc_out = False
        for i, a in enumerate(adcs):
            if a in RAILS:
                common |= Flag.ADC
                if any(loop.adc_mask >> i & 1 for loop in self.loops):
                    self.adc_out, reason = True, Reason.ADC
        for j, loop in enumerate(self.loops if self.configured else ()):
            theta = encoders[loop.encoder]
            if abs(theta - loop.centre) > loop.max_angle:
                own[j], reason = own[j] | Flag.ANGLE, Reason.ANGLE
            before = theta if self.encoders is None else self.encoders[loop.encoder]
            if abs(theta - before) > loop.max_jump:
                own[j], reason = own[j] | Flag.JUMP, Reason.JUMP
        self.encoders = encoders
        return common, own, reason

    def _report(
        self, clock: int, outputs: bytes, encoders: tuple[int, ...], adcs: tuple[int, ...]
    ) -> None:
        c = self.config
        if not self.batch:
            self.batch_head = self.sample, clock
        inputs = struct.pack(f"<{c.n_encoder}i{c.n_adc}h", *encoders, *adcs)
        self.batch.append(outputs + inputs)
        if len(self.batch) == c.batch:
            numbers = len(self.batch), self.state, self.rejected, len(self.queue)
            head = struct.pack("<IIBBHH", *self.batch_head, *numbers)
            self._send(Type.SAMPLES, head + b"".join(self.batch))
            self.batch.clear()

    # States

    def _to_null(self, state: State, reason: int) -> None:
        self.queue.clear()
        for loop in self.loops:
            loop.v = 0
        if state in (State.DEAD, State.TRIPPED):
            self.configured = False
        self._change(state, reason)

    def _change(self, state: State, reason: int) -> None:
        if state != self.state:
            self.state = state
            self._send(Type.EVENT, struct.pack("<IBB", self.sample, state, reason))
