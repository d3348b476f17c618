"""What the node keeps by itself, sample by sample: deadman, limits, trips, boots, order."""

import struct

import pytest

from drivers.serial_node.wire import (
    Answer,
    Code,
    Decoder,
    Event,
    Flag,
    Samples,
    State,
    Type,
    configure_body,
    frame,
    stream_body,
)
from sim.wire.node import Node
from sim.wire.protocol import NodeConfig

CONFIG = NodeConfig(2_000_000, 50, 1, 1, batch=1, null=37, max_output=20000, max_jump=5000)
PATIENCE = 25  # samples in the deadman's 50 ms
LOOP = {
    "encoder": 0,
    "adc_mask": 1,
    "kp_q16": 0,
    "max_output": 16000,
    "max_step": 16000,
    "max_angle": 30000,
    "max_jump": 5000,
    "centre": 0,
}


class Desk:
    """A node on a desk: its inputs by hand, its frames decoded."""

    def __init__(self, **loop: int) -> None:
        self.node, self.decoder, self.seq = Node(CONFIG, 9), Decoder(), 0
        self.theta, self.adc, self.emergency = 0, 0, False
        self.got: list = list(self.decoder.feed(self.node.transmit()))
        assert self.ask(Type.CONFIGURE, configure_body(**{**LOOP, **loop})) is Code.OK

    def send(self, kind: Type, body: bytes = b"", boot: int = 9) -> None:
        self.seq += 1
        self.node.receive(frame(kind, boot, self.seq, body))

    def ask(self, kind: Type, body: bytes = b"") -> Code:
        self.send(kind, body)
        self.got += self.decoder.feed(self.node.transmit())
        return Code(next(m.code for m in reversed(self.got) if isinstance(m, Answer)))

    def stream(self, n: int, u: int = 1000, ahead: int = 0, ref: int = 0) -> None:
        self.send(Type.STREAM, stream_body(self.node.sample + ahead, [u] * n, [ref] * n))

    def run(self, n: int) -> list[int]:
        """The counts that n samples put out, without the null."""
        out = []
        for _ in range(n):
            (counts,) = self.node.take(0, (self.theta,), (self.adc,), self.emergency)
            out.append(counts - CONFIG.null)
            self.got += self.decoder.feed(self.node.transmit())
        return out

    @property
    def flags(self) -> int:
        data = next(m.data for m in reversed(self.got) if isinstance(m, Samples))
        return struct.unpack_from("<hhiB", data)[3]

    @property
    def reasons(self) -> list[int]:
        return [m.reason for m in self.got if isinstance(m, Event)]


def test_without_a_stream_the_output_is_null_at_the_deadman_whatever_is_queued():
    desk = Desk()
    desk.stream(60)
    out = desk.run(60)
    assert out == [1000] * (PATIENCE - 1) + [0] * (60 - PATIENCE + 1)
    assert desk.node.state == State.DEAD
    assert desk.flags & Flag.LIMITED


def test_after_the_deadman_only_configure_leads_back():
    desk = Desk()
    desk.stream(5)
    desk.run(60)
    desk.stream(20)
    assert desk.run(20) == [0] * 20
    desk.ask(Type.CONFIGURE, configure_body(**LOOP))
    desk.stream(5)
    assert desk.run(5) == [1000] * 5


def test_a_queue_that_was_sent_ahead_dies_with_its_host():
    desk = Desk()
    desk.stream(20, ahead=40)
    assert not any(desk.run(100))


@pytest.mark.parametrize("late", [0, 5, 10, 20])
def test_a_host_that_is_40_ms_late_changes_nothing(late):
    """Ticks of 8 ms with 58 ms sent ahead; one tick comes up to 40 ms late."""
    desk, sent, out = Desk(), 0, []
    for tick in range(20):
        n = len(out) + 29 - sent
        desk.send(Type.STREAM, stream_body(sent, [500] * n, [0] * n))
        sent += n
        out += desk.run(4 + (late if tick == 10 else 0))
    assert out == [500] * len(out)
    assert desk.reasons == [1]


def test_a_dry_queue_keeps_centring_until_the_deadman():
    desk = Desk(kp_q16=1 << 16)
    desk.theta = 100
    desk.stream(2, u=1000)
    out = desk.run(40)
    assert out == [900] * 2 + [-100] * (PATIENCE - 3) + [0] * (40 - PATIENCE + 1)


def test_the_loop_is_rounded_to_the_nearest_count():
    desk = Desk(kp_q16=1 << 15)
    desk.theta = 3
    desk.stream(1, u=0)
    assert desk.run(1) == [-1]  # -1.5, halves up


def test_the_output_and_its_step_are_limited_and_it_says_so():
    desk = Desk(max_output=700, max_step=300)
    desk.stream(4)
    assert desk.run(4) == [300, 600, 700, 700]
    assert desk.flags & Flag.LIMITED


def test_the_converters_end_is_a_limit_around_the_null():
    desk = Desk()
    desk.node.config = NodeConfig(2_000_000, 50, 1, 1, null=37, dac_low=-500, dac_high=500)
    desk.stream(2, u=-9000)
    assert desk.run(1) == [-537]


@pytest.mark.parametrize(
    ("what", "reason"), [("theta", 4), ("jump", 5), ("adc", 6), ("emergency", 7)]
)
def test_it_trips_in_the_very_sample_and_stays_so(what, reason):
    desk = Desk()
    desk.stream(20)
    assert desk.run(3) == [1000] * 3
    if what == "theta":
        for _ in range(7):
            desk.theta += 4900
            out = desk.run(1)
        assert out == [0]
    else:
        desk.theta = 5001 if what == "jump" else 0
        desk.adc = 32767 if what == "adc" else 0
        desk.emergency = what == "emergency"
        assert desk.run(1) == [0]
    assert desk.node.state == State.TRIPPED
    assert desk.reasons[-1] == reason
    desk.theta = desk.adc = 0
    desk.emergency = False
    desk.stream(5)
    assert not any(desk.run(5))
    assert desk.ask(Type.CONFIGURE, configure_body(**LOOP)) is Code.STATE
    assert desk.ask(Type.ZERO) is Code.OK
    assert desk.node.state == State.TRIPPED
    assert desk.ask(Type.CLEAR) is Code.OK
    assert desk.ask(Type.CONFIGURE, configure_body(**LOOP)) is Code.OK
    desk.stream(5)
    assert desk.run(5) == [1000] * 5


@pytest.mark.parametrize("what", ["emergency", "adc"])
def test_it_is_not_cleared_while_the_cause_is_there(what):
    desk = Desk()
    desk.stream(20)
    desk.emergency, desk.adc = what == "emergency", -32768 if what == "adc" else 0
    desk.run(2)
    assert desk.ask(Type.CLEAR) is Code.CAUSE


def test_the_emergency_input_latches_with_no_host_at_all():
    desk = Desk()
    desk.emergency = True
    desk.run(1)
    desk.emergency = False
    desk.run(1)
    assert desk.node.state == State.TRIPPED


def test_a_stream_from_before_the_reboot_moves_nothing():
    desk = Desk()
    desk.node = Node(CONFIG, 10)
    desk.stream(20)
    assert not any(desk.run(20))
    assert desk.node.rejected == 1


def test_a_doubled_or_late_frame_acts_once():
    desk = Desk()
    old = frame(Type.STREAM, 9, desk.seq + 1, stream_body(5, [9000], [0]))
    desk.seq += 1
    desk.stream(3)
    desk.node.receive(old + old)
    assert desk.run(3) == [1000] * 3
    desk.run(3)
    assert desk.node.rejected == 2
    assert desk.node.state == State.DRY


def test_samples_that_are_over_do_not_come_out_later():
    desk = Desk()
    desk.run(30)
    desk.stream(10, ahead=-20)
    assert not any(desk.run(300))


@pytest.mark.parametrize(
    "over",
    [
        {"encoder": 1},
        {"adc_mask": 2},
        {"max_output": 20001},
        {"max_angle": -1},
        {"max_jump": 5001},
    ],
)
def test_limits_beyond_its_own_are_refused(over):
    desk = Desk()
    assert desk.ask(Type.CONFIGURE, configure_body(**{**LOOP, **over})) is Code.LIMIT


def test_limits_are_not_changed_while_the_output_is_live():
    desk = Desk()
    desk.stream(10)
    desk.run(2)
    assert desk.ask(Type.CONFIGURE, configure_body(**LOOP)) is Code.NOT_NULL


def test_nothing_moves_before_it_is_configured():
    node = Node(CONFIG, 1)
    node.receive(frame(Type.STREAM, 1, 1, stream_body(0, [1000] * 9, [0] * 9)))
    assert [node.take(0, (0,), (0,), False) for _ in range(9)] == [(CONFIG.null,)] * 9
