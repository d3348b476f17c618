"""Names and numbers of the serial node's protocol, and what a board is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

VERSION_ONE, VERSION_SEVERAL = 1, 2  # of a node with one output, and with several
MAX_OUTPUTS = 3
MAX_PAYLOAD = 512  # bytes of a frame before COBS
MAX_ENCODED = MAX_PAYLOAD + MAX_PAYLOAD // 254 + 1
QUEUE = 256  # samples of reference
TX = 2048  # bytes that wait for the port
WORD = 1 << 32
HALF = 1 << 31
RAILS = (-(1 << 15), (1 << 15) - 1)  # of an ADC


class State(IntEnum):
    """What the output does."""

    IDLE = 0
    LIVE = 1
    DRY = 2
    DEAD = 3
    TRIPPED = 4


class Type(IntEnum):
    """Of a frame."""

    HELLO = 1
    SAMPLES = 2
    EVENT = 3
    ANSWER = 4
    IDENTIFY = 16
    CONFIGURE = 17
    STREAM = 18
    ZERO = 19
    CLEAR = 20


class Code(IntEnum):
    """What became of a request."""

    OK = 0
    NOT_NULL = 1
    LIMIT = 2
    STATE = 3
    LATE = 4
    QUEUE = 5
    CAUSE = 6


class Reason(IntEnum):
    """Why the state changed."""

    STARTED = 1
    RAN_DRY = 2
    DEADMAN = 3
    ANGLE = 4
    JUMP = 5
    ADC = 6
    EMERGENCY = 7
    ZEROED = 8
    CLEARED = 9
    CONFIGURED = 10


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


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """What an output is. Its limits are hard; it is counted from `null`."""

    dac_low: int = -32768
    dac_high: int = 32767
    null: int = 0
    max_output: int = 32767
    max_step: int = 32767
    max_jump: int = (1 << 31) - 1


@dataclass(frozen=True, slots=True)
class NodeConfig:
    """What the board is, with the numbers of its first output; `beside` are its others."""

    period_ns: int
    deadman_ms: int
    n_encoder: int
    n_adc: int
    batch: int = 4
    dac_low: int = -32768
    dac_high: int = 32767
    null: int = 0
    max_output: int = 32767
    max_step: int = 32767
    max_jump: int = (1 << 31) - 1
    firmware: bytes = b"simulated 1"
    serial: bytes = b"SIM-0001"
    beside: tuple[OutputConfig, ...] = ()

    @property
    def outputs(self) -> tuple[OutputConfig, ...]:
        """All of them."""
        first = OutputConfig(
            self.dac_low,
            self.dac_high,
            self.null,
            self.max_output,
            self.max_step,
            self.max_jump,
        )
        return first, *self.beside

    @property
    def version(self) -> int:
        """The protocol's, that a node with these outputs speaks."""
        return VERSION_SEVERAL if self.beside else VERSION_ONE
