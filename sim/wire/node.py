"""A serial I/O node in Python: the same integers and the same bytes as the portable C core.

It is written from the protocol's page (docs/serial-node.md), not from the C core, and held to
it by differential fuzzing: the same bytes and samples in, the same counts and bytes out.
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
    VERSION,
    WORD,
    Code,
    Flag,
    NodeConfig,
    Reason,
    State,
    Type,
)


@dataclass(slots=True)
class Loop:
    """What CONFIGURE sets."""

    encoder: int = 0
    adc_mask: int = 0
    kp_q16: int = 0
    max_output: int = 0
    max_step: int = 0
    max_angle: int = 0
    max_jump: int = 0
    centre: int = 0


@dataclass(slots=True)
class Node:
    """One node since its boot number `boot`.

    sample : number of the next sample. state, rejected, host_seq : as the protocol has them.
    fed : sample at which the deadman was fed last. stray : counts by which the converter is
    off what it was told, relay : whether the supply line works: defects that a test can have.
    """

    config: NodeConfig
    boot: int
    sample: int = 0
    state: State = State.IDLE
    configured: bool = False
    rejected: int = 0
    seq: int = 0
    host_seq: int = 0
    loop: Loop = field(default_factory=Loop)
    queue: dict[int, tuple[int, int]] = field(default_factory=dict)
    age: int = 0
    fed: int = 0
    v: int = 0
    stray: int = 0
    relay: bool = True
    theta_ref: int = 0
    encoders: tuple[int, ...] | None = None
    emergency: bool = False
    adc_out: bool = False
    batch: list[bytes] = field(default_factory=list)
    batch_head: tuple[int, int] = (0, 0)
    rx: bytearray = field(default_factory=bytearray)
    tx: bytearray = field(default_factory=bytearray)

    def __post_init__(self) -> None:
        self._hello()

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
        payload = struct.pack("<BBHI", VERSION, kind, self.boot, self.seq) + body
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
        body = p[8:-4]
        if kind == Type.IDENTIFY and not body:
            self._hello()
            return True
        fits = (
            not body
            if kind in (Type.ZERO, Type.CLEAR)
            else len(body) == 24
            if kind == Type.CONFIGURE
            else kind == Type.STREAM and len(body) > 5 and len(body) == 5 + 6 * body[4]
        )
        newer = 0 < (seq - self.host_seq) % WORD < HALF
        if not (version == VERSION and fits and boot == self.boot and newer):
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
        self._send(Type.HELLO, body)

    # Requests

    def _configure(self, body: bytes) -> Code:
        encoder, zero, mask, kp, most, step, angle, jump, centre = struct.unpack("<BBHiHHiii", body)
        if self.live:
            return Code.NOT_NULL
        if self.state == State.TRIPPED:
            return Code.STATE
        c = self.config
        good = (
            encoder < c.n_encoder
            and zero == 0
            and mask < 1 << c.n_adc
            and most <= c.max_output
            and step <= c.max_step
            and angle >= 0
            and 0 <= jump <= c.max_jump
        )
        if not good:
            return Code.LIMIT
        self.loop = Loop(encoder, mask, kp, most, step, angle, jump, centre)
        self.theta_ref = centre
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
        for i, pair in enumerate(struct.iter_unpack("<hi", body[5:])):
            number = (first + i) % WORD
            if (number - self.sample) % WORD < QUEUE:
                self.queue[number] = pair
            else:
                code = Code.LATE
        self.age, self.fed = 0, self.sample
        return code

    # Samples

    @property
    def live(self) -> bool:
        """Whether the output follows the loop."""
        return self.state in (State.LIVE, State.DRY)

    @property
    def supply(self) -> bool:
        """Whether the supply line is on."""
        return self.live and self.relay

    def take(
        self, clock_us: int, encoders: tuple[int, ...], adcs: tuple[int, ...], emergency: bool
    ) -> int:
        """One sample; the counts to put out."""
        flags, reason = self._judge(encoders, adcs)
        self.emergency = emergency
        if emergency:
            flags |= Flag.EMERGENCY
            self._to_null(State.TRIPPED, Reason.EMERGENCY)
        if self.live or self.queue:
            self.age += 1
            if self.age >= self.config.deadman_ms * 1_000_000 // self.config.period_ns:
                self._to_null(State.DEAD, Reason.DEADMAN)
        u = 0
        if self.sample in self.queue:
            u, self.theta_ref = self.queue.pop(self.sample)
            flags |= Flag.REFERENCE
            self._change(State.LIVE, Reason.STARTED)
        elif self.state == State.LIVE:
            self._change(State.DRY, Reason.RAN_DRY)
        if self.live and reason:
            self._to_null(State.TRIPPED, reason)
        if self.live:
            wanted = self._wanted(u, encoders)
            self.v = self._limited(wanted)
            flags |= Flag.LIMITED if self.v != wanted else 0
            flags |= Flag.SUPPLY if self.supply else 0
        else:
            flags |= Flag.NULL | (0 if self.state == State.IDLE else Flag.LIMITED)
        self._report(clock_us, u, flags, encoders, adcs)
        self.sample = (self.sample + 1) % WORD
        return self.v + self.stray + self.config.null

    def _wanted(self, u: int, encoders: tuple[int, ...]) -> int:
        error = self.theta_ref - encoders[self.loop.encoder]
        return u + ((self.loop.kp_q16 * error + (1 << 15)) >> 16)

    def _limited(self, wanted: int) -> int:
        c, step, most = self.config, self.loop.max_step, self.loop.max_output
        v = min(max(wanted, self.v - step), self.v + step)
        v = min(max(v, -most), most)
        return min(max(v, c.dac_low - c.null), c.dac_high - c.null)

    def _judge(self, encoders: tuple[int, ...], adcs: tuple[int, ...]) -> tuple[int, int]:
        flags, reason = 0, 0
        self.adc_out = False
        for i, a in enumerate(adcs):
            if a in RAILS:
                flags |= Flag.ADC
                if self.loop.adc_mask >> i & 1:
                    self.adc_out, reason = True, Reason.ADC
        if self.configured:
            theta = encoders[self.loop.encoder]
            if abs(theta - self.loop.centre) > self.loop.max_angle:
                flags, reason = flags | Flag.ANGLE, Reason.ANGLE
            before = theta if self.encoders is None else self.encoders[self.loop.encoder]
            if abs(theta - before) > self.loop.max_jump:
                flags, reason = flags | Flag.JUMP, Reason.JUMP
        self.encoders = encoders
        return flags, reason

    def _report(
        self, clock: int, u: int, flags: int, encoders: tuple[int, ...], adcs: tuple[int, ...]
    ) -> None:
        c = self.config
        if not self.batch:
            self.batch_head = self.sample, clock
        layout = f"<hhiB{c.n_encoder}i{c.n_adc}h"
        held = self.v + self.stray
        self.batch.append(struct.pack(layout, held, u, self.theta_ref, flags, *encoders, *adcs))
        if len(self.batch) == c.batch:
            numbers = len(self.batch), self.state, self.rejected, len(self.queue)
            head = struct.pack("<IIBBHH", *self.batch_head, *numbers)
            self._send(Type.SAMPLES, head + b"".join(self.batch))
            self.batch.clear()

    # States

    def _to_null(self, state: State, reason: int) -> None:
        self.queue.clear()
        self.v = 0
        if state in (State.DEAD, State.TRIPPED):
            self.configured = False
        self._change(state, reason)

    def _change(self, state: State, reason: int) -> None:
        if state != self.state:
            self.state = state
            self._send(Type.EVENT, struct.pack("<IBB", self.sample, state, reason))
