"""The driver's decoder: of what comes damaged, doubled, late or foreign, nothing is accepted."""

import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from serial_frames_kit import raw
from wire_fuzz_kit import CONFIG, node

from drivers.serial_node.wire import (
    Answer,
    Decoder,
    Event,
    Hello,
    OtherVersion,
    Reboot,
    Samples,
    Type,
    frame,
)
from sim.wire.node import Node


def hello(boot=7):
    return Node(CONFIG, boot).transmit()


def test_a_node_says_what_it_is():
    (said,) = Decoder().feed(hello())
    assert isinstance(said, Hello)
    assert (said.boot, said.period_ns, said.deadman_ms) == (7, CONFIG.period_ns, CONFIG.deadman_ms)
    assert (said.n_encoder, said.n_adc, said.batch) == (1, 3, CONFIG.batch)
    (own,) = said.outputs
    assert (own.null, own.max_jump, said.queue) == (CONFIG.null, CONFIG.max_jump, 256)
    assert (said.firmware, said.serial) == ("simulated 1", "SIM-0001")


@settings(max_examples=300)
@given(st.lists(st.binary(max_size=700), max_size=5), st.booleans())
def test_bytes_that_mean_nothing_do_nothing(parts, greeted):
    d = Decoder()
    if greeted:
        list(d.feed(hello()))
    assert [m for part in parts for m in d.feed(part)] == []


@settings(max_examples=200)
@given(st.binary(min_size=1, max_size=200), st.lists(st.integers(0, 400), max_size=6))
def test_where_the_bytes_are_cut_does_not_matter(body, cuts):
    data = hello() + raw(1, Type.EVENT, 7, 1, struct.pack("<IBB", 5, 1, 1)) + body + b"\0" + hello()
    whole = list(Decoder().feed(data))
    d, got, at = Decoder(), [], 0
    for cut in [*sorted(c for c in cuts if c < len(data)), len(data)]:
        got += d.feed(data[at:cut])
        at = cut
    assert got == whole


def test_a_frame_that_comes_twice_or_late_counts_once():
    d = Decoder()
    list(d.feed(hello()))
    one, two = (raw(1, Type.EVENT, 7, n, struct.pack("<IBB", n, 1, 1)) for n in (1, 2))
    assert list(d.feed(two + one + two)) == [Event(2, 1, 1)]
    assert (d.lost, d.stale) == (1, 2)


def test_frame_numbers_go_on_past_32_bits():
    node, d = Node(CONFIG, 7), Decoder()
    node.transmit()
    node.seq = 2**32 - 1
    node._hello()
    node.receive(frame(Type.ZERO, 7, 1))
    assert [type(m) for m in d.feed(node.transmit())] == [Hello, Answer]
    assert (d.lost, d.stale) == (0, 0)


def test_another_boot_and_another_version_are_told_and_nothing_else_of_them():
    d = Decoder()
    list(d.feed(hello()))
    assert list(d.feed(hello(8))) == [Reboot(8)]
    for version in (2, 3):
        assert list(d.feed(raw(version, Type.SAMPLES, 7, 1, b"anything"))) == [
            OtherVersion(version)
        ]


def test_nothing_is_read_before_hello():
    node = Node(CONFIG, 7)
    node.transmit()
    for _ in range(CONFIG.batch):
        node.take(0, (0,), (0, 0, 0), False)
    assert list(Decoder().feed(node.transmit())) == []


@pytest.mark.parametrize("length", [0, 13, 14, 15, 500])
def test_a_whole_frame_of_a_wrong_length_is_corrupt(length):
    d = Decoder()
    list(d.feed(hello()))
    assert list(d.feed(raw(1, Type.SAMPLES, 7, 1, bytes(length)))) == []
    assert d.corrupt == 1


def test_no_wrong_sample_is_ever_accepted():
    counted = node(random.Random(1), 20_000)
    assert counted.wrong == 0
    assert counted.accepted > 5_000
    assert counted.damaged > 5_000


def test_a_sample_is_what_the_node_took():
    node, d = Node(CONFIG, 7, 41), Decoder()
    for i in range(CONFIG.batch):
        node.take(1000 + i, (i - 5,), (1, -2, i), False)
    said, samples = d.feed(node.transmit())
    assert isinstance(said, Hello)
    assert isinstance(samples, Samples)
    assert (samples.first, samples.clock_us, samples.n) == (41, 1000, CONFIG.batch)
    rows = list(struct.iter_unpack("<hhiBi3h", samples.data))
    assert [r[4:] for r in rows] == [(i - 5, 1, -2, i) for i in range(CONFIG.batch)]
