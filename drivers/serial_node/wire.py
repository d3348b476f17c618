"""Frames and messages of the serial I/O node, protocol versions 1 and 2.

The protocol is docs/reference/serial-node-frames.md. A node with one output speaks version
1, a node with several version 2.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

from cobs import cobs

ONE, SEVERAL = 1, 2  # versions, of a node with one output and with several
MAX_PAYLOAD = 512  # bytes of a frame before COBS
MAX_ENCODED = MAX_PAYLOAD + MAX_PAYLOAD // 254 + 1
MAX_STREAM = 64  # references that this driver puts in one STREAM, of all outputs; 401 bytes
WORD, HALF = 1 << 32, 1 << 31

_HEAD = struct.Struct("<BBHI")
_CRC = struct.Struct("<I")
_HELLO = struct.Struct("<IHBBBBhhhHHHiI16s16s")
_OUTPUT = struct.Struct("<hhhHHi")  # of HELLO in version 2, of each output beside the first
_SAMPLES = struct.Struct("<IIBBHH")
_EVENT = struct.Struct("<IBB")
_CONFIGURE = struct.Struct("<BBHiHHiii")
# Of a node: the CONFIGURE of all is one frame, so that it is taken whole or not at all.
MOST_OUTPUTS = (MAX_PAYLOAD - _HEAD.size - _CRC.size) // _CONFIGURE.size
REPORTED = 9  # bytes of one output in a sample of SAMPLES
OVERHEAD = _HEAD.size + _SAMPLES.size + _CRC.size  # bytes of a SAMPLES frame beside its samples


class Type(IntEnum):
    """Of a frame; below 16 from the node, from there on to it."""

    HELLO = 1
    SAMPLES = 2
    EVENT = 3
    ANSWER = 4
    IDENTIFY = 16
    CONFIGURE = 17
    STREAM = 18
    ZERO = 19
    CLEAR = 20


class State(IntEnum):
    """What the node's output does."""

    IDLE = 0
    LIVE = 1
    DRY = 2
    DEAD = 3
    TRIPPED = 4


class Code(IntEnum):
    """What became of a request."""

    OK = 0
    NOT_NULL = 1
    LIMIT = 2
    STATE = 3
    LATE = 4
    QUEUE = 5
    CAUSE = 6


class Flag(IntFlag):
    """Of one sample."""

    LIMITED = 1
    REFERENCE = 2
    ADC = 4
    JUMP = 8
    ANGLE = 16
    EMERGENCY = 32
    NULL = 64
    SUPPLY = 128


REASONS = (
    "nothing",
    "a reference began",
    "the reference ran out",
    "its deadman: no reference came",
    "the angle is beyond its limit",
    "the encoder jumped",
    "an analogue input is at the end of its range",
    "the emergency input",
    "zero was asked for",
    "it was cleared",
    "it was configured",
)


def reason_text(code: int) -> str:
    """The reason of an EVENT in words."""
    return REASONS[code] if code < len(REASONS) else f"reason {code}"


@dataclass(frozen=True, slots=True)
class Limits:
    """One output of a node and the node's own limits of it; counts are counted from `null`."""

    dac_low: int
    dac_high: int
    null: int
    max_output: int
    max_step: int
    max_jump: int


@dataclass(frozen=True, slots=True)
class Hello:
    """What a node says of itself."""

    boot: int
    period_ns: int
    deadman_ms: int
    n_encoder: int
    n_adc: int
    batch: int
    state: State
    queue: int
    host_seq: int
    firmware: str
    serial: str
    outputs: tuple[Limits, ...]

    @property
    def version(self) -> int:
        """Of the protocol that it speaks."""
        return ONE if len(self.outputs) == 1 else SEVERAL

    @property
    def sample_bytes(self) -> int:
        """Of one sample in SAMPLES."""
        return REPORTED * len(self.outputs) + 4 * self.n_encoder + 2 * self.n_adc


@dataclass(frozen=True, slots=True)
class Samples:
    """n samples from number `first` on, taken at clock_us and every period after; `data` as the
    node packed them. rejected counts frames that the node did not take, mod 2^16."""

    first: int
    clock_us: int
    n: int
    state: int
    rejected: int
    queued: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Event:
    """The node's state changed at a sample."""

    sample: int
    state: int
    reason: int


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of the request that had number `seq`."""

    seq: int
    type: int
    code: int


@dataclass(frozen=True, slots=True)
class OtherVersion:
    """A whole frame of a protocol version that this driver does not speak."""

    version: int


@dataclass(frozen=True, slots=True)
class Reboot:
    """A frame from another boot than the one that said HELLO."""

    boot: int


Message = Hello | Samples | Event | Answer | OtherVersion | Reboot


def frame(kind: Type, boot: int, seq: int, body: bytes = b"", version: int = ONE) -> bytes:
    """A frame to the node. It begins with a delimiter, which ends whatever was cut short."""
    payload = _HEAD.pack(version, kind, boot, seq) + body
    stuffed: bytes = cobs.encode(payload + _CRC.pack(zlib.crc32(payload)))
    return b"\0" + stuffed + b"\0"


def configure_body(
    *,
    encoder: int,
    adc_mask: int,
    kp_q16: int,
    max_output: int,
    max_step: int,
    max_angle: int,
    max_jump: int,
    centre: int,
) -> bytes:
    """Of CONFIGURE, for one output; all in counts, a step and a jump a sample. Those of several
    outputs follow each other."""
    return _CONFIGURE.pack(
        encoder, 0, adc_mask, kp_q16, max_output, max_step, max_angle, max_jump, centre
    )


def stream_body(first: int, u: Sequence[int], theta_ref: Sequence[int], outputs: int = 1) -> bytes:
    """Of STREAM; counts, at most MAX_STREAM of them: of each sample those of all outputs."""
    pairs = b"".join(struct.pack("<hi", a, b) for a, b in zip(u, theta_ref, strict=True))
    return struct.pack("<IB", first % WORD, len(u) // outputs) + pairs


@dataclass(slots=True)
class Decoder:
    """Bytes from the node to messages. What is not whole, ours, of this boot and in order is
    never handed on.

    corrupt : frames with a wrong checksum, stuffing, type or length. lost : frames that are
    missing by number. stale : frames that came twice or late. frames : good ones.
    """

    corrupt: int = 0
    lost: int = 0
    stale: int = 0
    frames: int = 0
    received: int = 0
    _boot: int | None = None
    _next: int = 0
    _version: int = ONE
    _layout: int = 0
    _rx: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> Iterator[Message]:
        """The messages that these bytes complete; other boots and versions are told once each."""
        self.received += len(data)
        *ends, rest = data.split(b"\0")
        for part in ends:
            self._rx += part
            stuffed = bytes(self._rx)
            self._rx.clear()
            if stuffed:
                message = self._message(stuffed)
                if message is not None:
                    yield message
        self._rx += rest[: MAX_ENCODED + 1 - len(self._rx)]

    def _message(self, stuffed: bytes) -> Message | None:
        payload = self._whole(stuffed)
        if payload is None:
            self.corrupt += 1
            return None
        version, kind, boot, seq = _HEAD.unpack_from(payload)
        if version not in (ONE, SEVERAL) or (self._boot is not None and version != self._version):
            return OtherVersion(version)
        body = payload[_HEAD.size : -_CRC.size]
        if self._boot is not None and boot != self._boot:
            return Reboot(boot)
        message = self._parse(version, kind, boot, body)
        if message is None:
            self.corrupt += 1
            return None
        if self._boot is None:
            if not isinstance(message, Hello):
                return None  # Nothing before HELLO can be read.
            self._boot, self._next, self._version = boot, seq, version
            self._layout = message.sample_bytes
        ahead = (seq - self._next) % WORD
        if ahead >= HALF:
            self.stale += 1
            return None
        self.lost += ahead
        self._next = (seq + 1) % WORD
        self.frames += 1
        return message

    @staticmethod
    def _whole(stuffed: bytes) -> bytes | None:
        if len(stuffed) > MAX_ENCODED:
            return None
        try:
            payload: bytes = cobs.decode(stuffed)
        except cobs.DecodeError:
            return None
        if len(payload) < _HEAD.size + _CRC.size:
            return None
        crc: int = _CRC.unpack_from(payload, len(payload) - _CRC.size)[0]
        return bytes(payload) if crc == zlib.crc32(payload[: -_CRC.size]) else None

    def _parse(self, version: int, kind: int, boot: int, body: bytes) -> Message | None:
        n = len(body)
        if kind == Type.HELLO:
            return _hello(version, boot, body)
        if kind == Type.SAMPLES and n > _SAMPLES.size:
            head = _SAMPLES.unpack_from(body)
            if head[2] and (not self._layout or n == _SAMPLES.size + head[2] * self._layout):
                first, clock, count, state, rejected, queued = head
                data = body[_SAMPLES.size :]
                return Samples(first, clock, count, state, rejected, queued, data)
        if kind == Type.EVENT and n == _EVENT.size:
            return Event(*_EVENT.unpack(body))
        if kind == Type.ANSWER and n == _EVENT.size:
            return Answer(*_EVENT.unpack(body))
        return None


def _hello(version: int, boot: int, body: bytes) -> Hello | None:
    """In version 2 the outputs beside the first follow, after the number of all; else None."""
    more = body[_HELLO.size :]
    if len(body) < _HELLO.size or body[9] > max(State):
        return None
    if (version == SEVERAL) != (len(more) > 0):
        return None
    if more and (more[0] < 2 or len(more) != 1 + _OUTPUT.size * (more[0] - 1)):
        return None
    x = _HELLO.unpack_from(body)
    period, deadman, n_encoder, n_adc, batch, state = x[:6]
    low, high, null, most, step, queue, jump, host_seq = x[6:14]
    firmware, serial = (t.rstrip(b"\0").decode("ascii", "replace") for t in x[14:])
    own = Limits(low, high, null, most, step, jump)
    outputs = own, *(Limits(*o) for o in _OUTPUT.iter_unpack(more[1:]))
    return Hello(
        boot,
        period,
        deadman,
        n_encoder,
        n_adc,
        batch,
        State(state),
        queue,
        host_seq,
        firmware,
        serial,
        outputs,
    )
