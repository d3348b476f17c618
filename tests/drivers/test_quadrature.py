"""The quadrature counter on a pseudo-terminal: its counts, its clock, and how it fails."""

import contextlib
import os
import random
import threading
import time
import tty
from collections.abc import Iterator

import numpy as np
import pytest
from wire_fuzz_kit import quadrature
from wire_kit import until

from drivers.quadrature.device import QuadratureRig, open_rig
from drivers.quadrature.wire import Decoder
from samii_rig.devices.timebase import ClockModel, Timed
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.types import Quality
from sim.wire.counter import Counter

SCALE, OFFSET = 26000.0, 1000


class Bench:
    """A board on a pseudo-terminal, served by a thread in about real time."""

    def __init__(self) -> None:
        self.board = Counter(clock_us=2**32 - 200_000, seq=2**32 - 50)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.port = os.ttyname(self.slave)
        self.counts, self.missed = [OFFSET, 0], 0
        self.lose = self.twice = False
        self.ending = threading.Event()
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self) -> None:
        due = time.monotonic()
        while not self.ending.is_set():
            try:
                asked = os.read(self.master, 4096)
            except OSError:
                asked = b""
            out = self.board.receive(asked)
            while time.monotonic() >= due:
                due += self.board.period_us * 1e-6
                frame = self.board.sample(tuple(self.counts), self.missed)
                self.counts[0] += 1
                out += b"" if self.lose else frame * (2 if self.twice else 1)
                self.lose = self.twice = False
            if out:
                with contextlib.suppress(OSError):
                    os.write(self.master, out)
            time.sleep(0.001)

    def close(self) -> None:
        self.ending.set()
        self.thread.join()
        for fd in (self.master, self.slave):
            os.close(fd)


@pytest.fixture
def bench() -> Iterator[Bench]:
    b = Bench()
    yield b
    b.close()


@pytest.fixture(scope="module")
def rig():
    whole = load_rig("samii")[0]
    return whole.model_copy(update={"sensor": whole.sensor[:1]})


def opened(bench, rig, **changes) -> QuadratureRig:
    counter = {"index": 0, "counts_per_unit": SCALE, "offset": OFFSET}
    given = {"port": bench.port, "counters": {"theta_2": counter}, **changes}
    device = open_rig(rig, given)
    assert isinstance(device, QuadratureRig)
    return device


@pytest.fixture
def device(bench, rig) -> Iterator[QuadratureRig]:
    d = opened(bench, rig)
    yield d
    d.close()


def taken(device, n=100):
    blocks = []
    until(lambda: blocks.append(device.sensor.read()) or sum(map(len, blocks)) >= n, 10.0)
    join = [np.concatenate([getattr(b, x) for b in blocks]) for x in ("time", "sequence")]
    return *join, *(np.concatenate([getattr(b, x) for b in blocks]) for x in ("values", "quality"))


def test_counts_come_out_in_the_sensors_unit_over_every_wrap(device):
    when, sequence, values, quality = taken(device, 150)
    assert sequence[0] < 2**32 < sequence[-1]
    assert (np.diff(sequence) == 1).all()
    assert (np.diff(when) == 2_000_000).all()
    np.testing.assert_allclose(np.diff(values[:, 0]), 1 / SCALE, rtol=1e-6)
    assert not quality.any()
    assert device.metadata["serial"] == "QC-0003"
    assert device.sensor.channels[0].resolution == pytest.approx(1 / SCALE)


def test_its_clock_can_be_held_against_the_hosts(device):
    assert isinstance(device.sensor, Timed)
    low, high = device.sensor.latency
    assert low == 0.0
    assert 0.0 < high < 1.0
    model = ClockModel(device.sensor.latency)
    until(lambda: (device.sensor.read(), model.add(device.sensor.arrivals()), model.ready)[2], 10.0)
    fit = model.fit()
    newest = taken(device, 5)[0][-1:]
    # On a loaded machine a sample may be old before it is read here.
    assert -0.05e9 < time.monotonic_ns() - fit.host(newest)[0] < 1e9


def test_what_comes_twice_or_not_at_all_is_counted(bench, device):
    taken(device, 5)
    bench.twice = True
    until(lambda: (device.sensor.read(), device.device.stale)[1] == 1)
    bench.lose = True
    until(lambda: (device.sensor.read(), device.device.lost)[1] == 1)
    _, sequence, *_ = taken(device)
    assert (np.diff(sequence) == 1).all()


def test_a_counter_that_missed_an_edge_knows_its_place_no_more(bench, device):
    bench.missed = 0b10
    assert not taken(device, 20)[3].any()
    bench.missed = 0b01
    until(lambda: (device.sensor.read().quality == Quality.MISSING).any())
    *_, values, quality = taken(device, 5)
    assert np.isnan(values).all()
    assert (quality == Quality.MISSING).all()


def test_counts_beyond_the_sensors_range_are_clipped(bench, device):
    bench.counts[0] = OFFSET + int(1.6 * SCALE)
    until(lambda: (device.sensor.read().quality == Quality.CLIPPED).any())


def reboot(bench):
    bench.board = Counter(boot=2)


def jump(bench):
    bench.board.clock_us = (bench.board.clock_us + 3_000_000) % 2**32


@pytest.mark.parametrize(
    ("fault", "said"), [(reboot, r"rebooted \(boot 2\)"), (jump, "clock jumped by 3 s")]
)
def test_a_board_that_begins_anew_ends_it(bench, device, fault, said):
    taken(device, 5)
    fault(bench)
    with pytest.raises(DeviceError, match=said):
        until(lambda: device.sensor.read() is None, 5.0)
    with pytest.raises(DeviceError):
        device.sensor.read()


def test_a_port_that_is_gone_and_a_reader_that_dies_are_events(device, monkeypatch):
    def dies(*_):
        raise SystemExit

    monkeypatch.setattr(device.device._port, "read", dies)
    with pytest.raises(DeviceError, match="the port is gone: SystemExit"):
        until(lambda: device.sensor.read() is None, 5.0)


def test_a_bad_line_ends_it(bench, rig):
    device = opened(bench, rig, max_bad_frames=0)
    taken(device, 5)
    bench.lose = True
    with pytest.raises(DeviceError, match=r"1 frames lost or damaged .* allowed 0"):
        until(lambda: device.sensor.read() is None, 5.0)
    device.close()
    assert device.metadata["frames_lost"] == "1"


COUNTER = {"index": 0, "counts_per_unit": 1.0}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"port": "/dev/no_such_port"}, "no such port"),
        ({"port": ""}, "port is ''"),
        ({"colour": 1}, "colour is 1; expected one of port, baud"),
        ({"counters": {}}, r"counters is \[\]; expected theta_2, and no other"),
        ({"counters": {"theta_2": {**COUNTER, "index": 5}}}, "index is 5; expected below 2, what"),
        ({"counters": {"theta_2": {**COUNTER, "counts_per_unit": 0}}}, "counts_per_unit is 0.0"),
    ],
)
def test_a_wrong_setting_is_one_line(bench, rig, changes, said):
    with pytest.raises((InputError, DeviceError), match=said) as caught:
        opened(bench, rig, **changes)
    assert "\n" not in str(caught.value)


def test_a_setting_that_is_missing_points_to_the_page(rig):
    with pytest.raises(InputError, match=r"counters: is missing; see docs/reference/quad"):
        open_rig(rig, {"port": "x"})


@pytest.mark.parametrize(
    ("board", "said"),
    [
        (Counter(version=2), "speaks protocol version 2, this driver version 1"),
        (None, "nothing answers in 0.3 s; is the counter powered"),
    ],
)
def test_what_is_no_counter_of_this_version_is_named(bench, rig, monkeypatch, board, said):
    monkeypatch.setattr("drivers.quadrature.device.HELLO_WITHIN", 0.3)
    if board is None:
        bench.ending.set()
        bench.thread.join()
    else:
        bench.board = board
    with pytest.raises(DeviceError, match=said):
        opened(bench, rig)


def test_no_bytes_make_a_sample_that_was_not_sent():
    """A million of them: benchmarks/wire_fuzz.py."""
    counted = quadrature(random.Random(1), 10_000)
    assert counted.wrong == 0
    assert counted.accepted > 2_500
    assert counted.damaged > 2_500


def test_noise_without_an_end_of_frame_is_not_kept():
    decoder = Decoder()
    for _ in range(100):
        assert not list(decoder.feed(b"x" * 300))
    assert len(decoder._rx) < 200
