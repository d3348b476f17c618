"""A run always ends, whatever ends its threads, its memory or the operator's patience.

Plan: a thread that dies or hangs is an error of whoever waits for it, soon; a key held down is one
press; a driver whose zero() does nothing is not called at rest because its deadman was.
"""

from __future__ import annotations

import ctypes
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from burst_kit import PLAN, PREDICTED, RIG
from fake_device import RATE, FakeDevice
from record_kit import CHANNELS, STOP, block

from samii_rig.errors import DiskError
from samii_rig.record import disk
from samii_rig.record import writer as writer_module
from samii_rig.record.recover import recover
from samii_rig.record.writer import RunWriter
from samii_rig.run import campaign
from samii_rig.run.interrupts import PAUSE, Interrupts, one_press_counts
from samii_rig.run.order import RunOrder
from samii_rig.run.sink import QueuedSink

raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc  # an exception in another thread


def ends(*_: object) -> None:
    raise SystemExit


def test_a_disk_thread_that_is_gone_is_said_and_not_waited_for(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run.mcap", CHANNELS, RATE) as writer:
        writer.write(block(0, 50))
        writer.flush()
        writer._put(ends)
        for call in (writer.flush, lambda: writer.write(block(50, 50)), lambda: writer.close(STOP)):
            with pytest.raises(DiskError, match="cannot be written"):
                call()
    assert recover(writer.partial_path).samples == 50


def test_a_disk_that_never_answers_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk, "ANSWERS_WITHIN", 0.2)
    held = threading.Event()
    writer = RunWriter(tmp_path / "run.mcap", CHANNELS, RATE)
    writer._put(lambda appender: held.wait(20.0) and None)
    with pytest.raises(DiskError, match="did not answer"):
        writer.flush()
    for _ in range(disk.MAX_WAITING):
        writer._disk._queue.put(lambda appender: None)
    with pytest.raises(DiskError, match="did not answer"):
        writer.event(0, "x")
    held.set()
    writer.abort()


@pytest.mark.parametrize("gone", [1, 2])
def test_compressors_that_are_gone_are_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gone: int
) -> None:
    monkeypatch.setattr(writer_module, "ANSWERS_WITHIN", 0.2)
    writer = RunWriter(tmp_path / "run.mcap", CHANNELS, RATE)
    writer.write(block(0, 50))
    writer.flush()
    for thread in list(writer._pool._threads)[:gone]:
        raise_in(ctypes.c_ulong(thread.ident or 0), ctypes.py_object(SystemExit))
    began = time.monotonic()
    with suppress(DiskError):  # whoever is left may have done the work
        writer.write(block(50, 50))
        writer.close(STOP)
    writer.abort()
    assert time.monotonic() - began < 10.0
    assert recover(writer.partial_path if writer.partial_path.exists() else writer.path).samples


@pytest.mark.parametrize("error", [SystemExit(0), MemoryError()])
def test_a_recorder_that_is_gone_makes_the_run_a_failed_one(error: BaseException) -> None:
    class Ending:
        def event(self, *_: object) -> None:
            raise error

    queued = QueuedSink(Ending())  # type: ignore[arg-type]
    queued.event(0, "x", {})
    for _ in range(2):
        with pytest.raises((DiskError, MemoryError)):
            queued.close()
    with pytest.raises((DiskError, MemoryError)):
        queued.event(0, "x", {})


def test_a_run_whose_recorder_is_ended_fails_at_zero(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = FakeDevice()
    monkeypatch.setattr(campaign, "open_device", lambda rig, settings: device.open())
    monkeypatch.setattr(RunWriter, "segment", ends)
    outcome = campaign.carry_out(RunOrder(RIG, "", "", PLAN, PREDICTED), tmp_path / "run.mcap")
    assert outcome.stop.status == "failed"
    assert "SystemExit" in outcome.stop.reason
    assert not device.live


@pytest.fixture
def own_handler() -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


def presses(n: int) -> int:
    """How many of n presses in a row raise."""
    raised = 0
    for _ in range(n):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raised += 1
    return raised


def test_a_key_that_is_held_down_is_one_press(own_handler: None) -> None:
    with Interrupts() as interrupts:
        assert presses(200) == 0
        assert interrupts.reason
        time.sleep(PAUSE)
        assert presses(200) == 1
    one_press_counts()
    assert presses(200) == 1


def test_a_press_while_the_compiler_calls_back_counts_afterwards(own_handler: None) -> None:
    def _raw_object_cache_notify() -> int:
        return presses(1)

    one_press_counts()
    assert _raw_object_cache_notify() == 0
    with pytest.raises(KeyboardInterrupt):
        time.sleep(10.0)


@pytest.mark.parametrize("obeys", [True, False])
def test_a_zero_that_does_nothing_is_said_although_the_deadman_ends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, obeys: bool
) -> None:
    """Until the deadman's time is over the loop goes on to answer the sensor's noise."""
    device = FakeDevice()
    rng = np.random.default_rng(1)
    device.noise = lambda: float(1e-3 * rng.normal())
    monkeypatch.setattr(campaign, "open_device", lambda rig, settings: device.open())
    if not obeys:
        monkeypatch.setattr(device, "zero", lambda: None)
    stop = campaign.carry_out(RunOrder(RIG, "", "", PLAN, PREDICTED), tmp_path / "run.mcap").stop
    assert stop.status == ("completed" if obeys else "failed")
    assert ("after zero(), which did nothing" in stop.reason) is not obeys
