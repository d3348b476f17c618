"""Wherever another sender's frame falls between the sensor's own, it never becomes a sample, and
where the sensor's own are lost beside, nothing but whole pairs does."""

import random
from types import SimpleNamespace
from unittest.mock import patch

import can
import numpy as np
from can_fuzz_kit import sensor, stepped_clock
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.force_torque.frames import MATRIX, Frames
from drivers.force_torque.reader import GIVE_UP, SYNCS, Reader
from sim.wire.can_sensor import Sensor

BASE = 0x20
FRAMES = Frames(BASE)
QUESTIONS = [FRAMES.identifier(name) for name in SYNCS]
PERIOD = 2_000_000
OWN, FOREIGN = 60.0, -300.0  # N m
SENSOR = Sensor(BASE, lambda: np.array([0, 0, 0, 0, 0, OWN]), 400.0)
OTHER = Sensor(BASE, lambda: np.array([0, 0, 0, 0, 0, FOREIGN]), 400.0)


def message(identifier: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=identifier, is_extended_id=False, data=data)


def pair(sensor: Sensor) -> list[can.Message]:
    return [message(*frame) for frame in sensor.answer(0x200, b"")]


TRUE = FRAMES.gauges(*(bytes(m.data) for m in pair(SENSOR))).counts.tolist()
FALSE = FRAMES.gauges(*(bytes(m.data) for m in pair(OTHER))).counts.tolist()
STRANGERS = [*pair(OTHER), message(0x200, bytes(3)), message(0x207, bytes(8)), message(0x20C, b"")]


class Bus:
    """Takes requests; `asked` tells that one for a sample came, `sync` which question after a lost
    reply, 0 for none."""

    channel_info = "a bus"

    def __init__(self) -> None:
        self.asked, self.sync = False, 0

    def send(self, frame: can.Message, timeout: float) -> None:
        self.asked = frame.arbitration_id == 0x200
        self.sync = frame.arbitration_id if frame.arbitration_id in QUESTIONS else 0


def play(script: list[tuple[int | None, int | None, int | None, bool, bool]]) -> Reader:
    """One request after the other: strangers before, between and after the two frames of each
    reply, of which the first or the second may be lost."""
    clock = stepped_clock()
    with patch("drivers.force_torque.reader.time", clock):
        return carried_out(script, clock)


def carried_out(script, clock) -> Reader:
    bus = Bus()
    reader = Reader(bus, FRAMES, PERIOD)  # type: ignore[arg-type]
    for before, between, after, first, second in script:
        now = clock.now = clock.now + PERIOD
        bus.asked, bus.sync = False, 0
        reader._go_on(now)
        if bus.sync:
            reader._take(message(*SENSOR.answer(bus.sync, b"")[0]), now)
        frames: list[can.Message] = []
        own = pair(SENSOR) if bus.asked else []
        for stranger, mine, kept in ((before, 0, first), (between, 1, second)):
            frames += [STRANGERS[stranger]] if stranger is not None else []
            frames += own[mine : mine + 1] if kept else []
        frames += [STRANGERS[after]] if after is not None else []
        for frame in frames:
            reader._take(frame, now)
            if reader.trouble:
                return reader
        if not (first and second):
            clock.now += GIVE_UP
    clock.now += GIVE_UP
    reader._go_on(clock.now)
    return reader


stranger = st.none() | st.integers(0, len(STRANGERS) - 1)


@settings(max_examples=300)
@given(st.lists(st.tuples(stranger, stranger, stranger, st.just(True), st.just(True)), max_size=8))
def test_a_foreign_frame_is_never_a_part_of_a_sample(script):
    reader = play(script)
    assert all(r.gauges.counts.tolist() == TRUE for r in reader.samples)
    if any(x is not None for row in script for x in row[:3]):
        assert "another sender" in reader.trouble
        assert reader.counts.foreign == 1
    else:
        assert not reader.trouble
        assert len(reader.samples) == len(script)


@settings(max_examples=300)
@given(
    st.lists(st.tuples(st.none(), st.none(), st.none(), st.booleans(), st.booleans()), max_size=12)
)
def test_frames_that_are_lost_are_counted_and_blamed_on_nobody(script):
    reader = play(script)
    assert not reader.trouble
    assert reader.counts.foreign == 0
    assert all(r.gauges.counts.tolist() == TRUE for r in reader.samples)
    # The newest request has no reply yet.
    assert reader.counts.requests - len(reader.samples) - reader.counts.lost in (0, 1)
    assert TRUE != FALSE


@settings(max_examples=300)
@given(st.lists(st.tuples(st.integers(0, 3), st.sampled_from([0, 1, GIVE_UP])), max_size=40))
@example([(0, GIVE_UP), (0, GIVE_UP), (2, 0), (0, GIVE_UP), (0, GIVE_UP), (2, 0), (3, 0), (3, 0)])
def test_a_sensor_that_stalls_and_answers_all_in_order_is_no_other_sender(script):
    """What it answers at a time, and how long it then stalls: no answer is that of a later request.
    A reply to one that was given up came behind the answer to the first of two questions."""
    clock = stepped_clock()
    asked: list[int] = []
    bus = SimpleNamespace(
        channel_info="a bus", send=lambda frame, timeout: asked.append(frame.arbitration_id)
    )
    loads = np.zeros(6)
    own = Sensor(BASE, lambda: loads, 400.0)
    with patch("drivers.force_torque.reader.time", clock):
        reader = Reader(bus, FRAMES, PERIOD)  # type: ignore[arg-type]
        for answered, stalls in [*script, *[(3, 0)] * 8]:
            clock.now += PERIOD
            reader._go_on(clock.now)
            for identifier in [asked.pop(0) for _ in range(min(answered, len(asked)))]:
                loads[5] += identifier == 0x200  # a newton metre more with each request
                for frame in own.answer(identifier, b""):
                    reader._take(message(*frame), clock.now)
            clock.now += stalls
    assert not reader.trouble
    assert reader.counts.foreign == 0
    assert len(reader.samples) >= 2
    of_request = {}
    for n in range(1, reader.counts.requests + 1):
        loads[5] = n
        of_request[n] = FRAMES.gauges(*(d for _, d in own.answer(0x200, b""))).counts.tolist()
    assert all(r.gauges.counts.tolist() == of_request[r.number] for r in reader.samples)


def test_a_foreign_second_frame_is_told_also_where_the_next_request_is_overdue():
    clock = stepped_clock()
    with patch("drivers.force_torque.reader.time", clock):
        bus = Bus()
        reader = Reader(bus, FRAMES, PERIOD)  # type: ignore[arg-type]
        clock.now = 9 * PERIOD // 4
        reader._due = PERIOD
        reader._go_on(clock.now)
        own, other = pair(SENSOR), pair(OTHER)
        reader._take(own[0], clock.now)
        reader._take(other[1], clock.now)
        bus.asked = False
        reader._go_on(clock.now)
        assert not bus.asked
        reader._take(own[1], clock.now)
    assert "another sender" in reader.trouble
    assert not reader.samples


def test_a_late_row_of_the_matrix_is_not_taken_for_the_next():
    """Its second try is answered, too, and a reply does not tell of which row it is."""
    clock = stepped_clock()
    coming: list[tuple[int, can.Message]] = []

    def send(frame, timeout):
        when = max(clock.now, 300_000_000)  # ns, after the first try was given up
        answer = SENSOR.answer(frame.arbitration_id, bytes(frame.data))
        coming.extend((when, message(*each)) for each in answer)

    def recv(seconds):
        until = clock.now + round(seconds * 1e9) + 1
        if coming and coming[0][0] <= until:
            when, frame = coming.pop(0)
            clock.now = max(clock.now, when)
            return frame
        clock.now = until
        return None

    bus = SimpleNamespace(channel_info="a bus", send=send, recv=recv)
    with patch("drivers.force_torque.reader.time", clock):
        reader = Reader(bus, FRAMES, PERIOD)  # type: ignore[arg-type]
        for i in range(6):
            true = [data for _, data in SENSOR.answer(0x202, bytes([i]))]
            assert reader.ask(*MATRIX, data=bytes([i])) == true


def test_no_damage_on_the_bus_becomes_a_sample_that_was_not_sent():
    """A million frames: benchmarks/wire_fuzz.py."""
    counted = sensor(random.Random(1), 20_000)
    assert counted.wrong == 0
    assert counted.accepted > 1_500
    assert counted.damaged > 3_000
