"""The loop: every way out of a run ends at zero volts with what was measured in the sink."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from fake_device import RATE, FakeDevice, fake_rig
from loop_kit import Broken, Memory, RealTime, after, patient_rig, plan

from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import DeviceError, GateError, InputError
from samii_rig.run.client import Client
from samii_rig.run.dwell import Reference
from samii_rig.run.interrupts import PAUSE, Interrupts
from samii_rig.run.loop import run
from samii_rig.run.pace import LoopSettings
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.run.session import Move
from samii_rig.run.sink import Collector, QueuedSink, recorded_channels
from samii_rig.types import Channel, Quality, StopRecord

RIG = fake_rig()


def go(device=None, sink=None, the_plan=None, **how):
    device, sink = device or FakeDevice(), sink or Memory()
    stop = run(the_plan or plan(), RIG, device.open(), sink, **how)
    assert not device.live
    assert device.v == 0.0
    assert device.zeros >= 1
    device.sleep(1.0)
    assert device.rows[-1][1] == 0.0
    return stop, device, sink


def test_a_plan_is_done_to_its_end():
    stop, _, sink = go()
    assert (stop.status, stop.reason) == ("completed", "all 2 segments done")
    assert (stop.late_ticks, stop.missing_samples) == (0, 0)
    assert [s.name for s in sink.segments] == ["burst_0", "burst_1"]
    names = [name for name, _ in sink.events]
    assert names == ["gate", "gate", "plan", "gate", "stop"]
    sequence = sink.column("sequence")
    assert np.array_equal(sequence, np.arange(sequence[0], sequence[0] + len(sequence)))


def test_the_recording_holds_the_reference_exactly_where_it_acted():
    _, _, sink = go()
    the_plan = plan()
    sequence, u, v, theta = (sink.column(n) for n in ("sequence", "u", "v", "theta"))
    for planned, segment in zip(the_plan.segments, sink.segments, strict=True):
        inside = (sequence >= segment.start) & (sequence < segment.stop)
        np.testing.assert_array_equal(u[inside], planned.u)
    np.testing.assert_allclose(
        v[sequence < sink.segments[-1].stop],
        (u - 4.0 * theta)[sequence < sink.segments[-1].stop],
        atol=1e-15,
    )
    assert not u[sequence < sink.segments[0].start].any()
    assert sink.segments[0].stop == sink.segments[1].start


def test_the_reference_stays_ahead_and_never_breaks_off():
    _, device, _ = go(the_plan=plan(segments=1))
    firsts = [b.first for b in device.written]
    ends = [b.first + len(b) for b in device.written]
    assert firsts[1:] == ends[:-1]


def test_the_tail_shows_the_output_at_zero():
    _, _, sink = go(FakeDevice(), client=Client(stop=after(0.5)))
    assert sink.column("v")[-1] == 0.0
    assert np.abs(sink.column("v")).max() > 0.1


def test_progress_tells_the_segment_the_frequency_and_the_margin():
    seen = []
    stop, _, _ = go(client=Client(seen.append), settings=LoopSettings(report=0.1))
    assert stop.status == "completed"
    assert [p.segment for p in seen] == sorted(p.segment for p in seen)
    assert {p.n_segments for p in seen} == {2}
    assert {p.segment for p in seen} == {1, 2}
    left = [p.time_left for p in seen]
    assert left == sorted(left, reverse=True)
    assert left[-1] < 0.2
    moving = [p.frequency for p in seen if not np.isnan(p.frequency)]
    assert 2.0 <= min(moving) < max(moving) <= 20.0
    assert min(p.worst_margin for p in seen) == seen[-1].worst_margin
    assert all(0 < p.worst_margin <= p.margin for p in seen)
    assert seen[-1].worst_channel == "v"


# Every way out


def test_a_stop_event_ends_at_zero():
    stop, _, sink = go(client=Client(stop=after(0.5)))
    assert (stop.status, stop.reason) == ("stopped", "stopped on request")
    assert sink.segments == []
    assert sink.events[-1][1]["status"] == "stopped"


def test_a_segment_whose_last_sample_is_there_is_recorded_however_soon_the_stop_comes():
    asked = threading.Event()

    def enough(now):
        if now.segment == 2:
            asked.set()

    stop, _, sink = go(client=Client(enough, asked), settings=LoopSettings(report=0.0))
    assert (stop.status, stop.reason) == ("stopped", "stopped on request")
    assert [s.name for s in sink.segments] == ["burst_0"]
    assert sink.column("sequence")[-1] >= sink.segments[0].stop


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_at_zero_with_a_whole_recording(number):
    def spoil(block):
        if len(block) and block.sequence[-1] == 400:
            os.kill(os.getpid(), number)
        return block

    before = signal.getsignal(number)
    stop, _, sink = go(FakeDevice(spoil))
    assert stop.status == "stopped"
    assert number.name in stop.reason
    assert sink.column("sequence")[-1] >= 400
    assert signal.getsignal(number) is before


def spoiled(change, at=400):
    """A device whose block with sample `at` is changed, or raises."""

    def spoil(block):
        if len(block) and block.sequence[0] <= at <= block.sequence[-1]:
            return change(block)
        return block

    return FakeDevice(spoil)


def raising(error):
    def change(_):
        raise error

    return change


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (DeviceError("cable out"), "failed", "cable out"),
        (OSError("bus off"), "failed", "OSError: bus off"),
        (KeyboardInterrupt(), "stopped", "Ctrl-C"),
        (SystemExit(3), "failed", "SystemExit"),
        (MemoryError("none left"), "failed", "MemoryError"),
    ],
)
def test_an_exception_while_reading_ends_at_zero(error, status, words):
    stop, _, sink = go(spoiled(raising(error)))
    assert stop.status == status
    assert words in stop.reason
    assert sink.column("sequence")[-1] > 300


def test_a_defect_leaves_its_traceback_in_the_recording():
    _, _, sink = go(spoiled(raising(ZeroDivisionError("ours"))))
    (text,) = [p["traceback"] for name, p in sink.events if name == "error"]
    assert "ZeroDivisionError: ours" in text


def value(x, channel=1):
    def change(block):
        values = block.values.copy()
        values[0, channel] = x
        return replace(block, values=values)

    return change


def flag(quality, channel):
    def change(block):
        flags = block.quality.copy()
        flags[:, channel] = quality
        return replace(block, quality=flags)

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (value(np.nan), "not a number"),
        (value(0.4), "theta at 0.4 rad is over its limit of 0.35 rad"),
        (value(5.5, 0), "v at 5.5 V is over its limit of 5 V"),
        (flag(Quality.CLIPPED, 1), "end of its range"),
        (flag(Quality.LIMITED, 0), "the device itself changed v"),
        (lambda b: replace(b, sequence=b.sequence - 300), "out of order"),
        (lambda b: replace(b, time=b.time - 10**9), "out of order"),
    ],
)
def test_what_the_gate_sees_trips_the_run(change, words):
    stop, _, sink = go(spoiled(change))
    assert stop.status == "tripped"
    assert words in stop.reason
    assert sink.column("sequence")[-1] > 300


def test_a_sensor_that_falls_silent_trips_the_run():
    def spoil(block):
        if len(block) and block.sequence[0] > 400:
            return replace(
                block,
                time=block.time[:0],
                sequence=block.sequence[:0],
                values=block.values[:0],
                quality=block.quality[:0],
            )
        return block

    stop, _, _ = go(FakeDevice(spoil))
    assert stop.status == "tripped"
    assert "nothing new" in stop.reason


@pytest.mark.parametrize(
    ("silence", "status", "words"),
    [(0.22, "completed", "segments done"), (0.6, "tripped", "nothing new")],
)
def test_samples_that_stay_out_are_waited_for_as_long_as_a_sensor_may_be_silent(
    silence, status, words
):
    """On real time, by a clock that is stepped: the host reckons on, but never past its gate."""

    class Late(FakeDevice):
        def read(self):
            out = 0.0 < self.time * 1e-9 - 1.0 < silence
            rows, self.rows = self.rows, [] if out else self.rows
            block = super().read()
            self.rows = rows if out else []
            return block

        def open(self):
            return OpenRig(self, self, self, "fake", {})

    device, sink = Late(), Memory()
    device.deadman = 0.5
    stop = run(plan(), patient_rig(), device.open(), sink)
    assert stop.status == status
    assert words in stop.reason
    assert not device.live


def test_a_plan_over_the_limit_trips_before_the_wire():
    stop, device, sink = go(the_plan=plan(level=6.0))
    assert stop.status == "tripped"
    assert "over its limit of 5 V" in stop.reason
    assert max(np.abs(b.u).max() for b in device.written) <= 5.0
    assert np.abs(sink.column("v")).max() <= 5.0
    (trip,) = [p for name, p in sink.events if p.get("state") == "fault"]
    assert trip["number"] > trip["limit"] == 5.0


def test_a_client_that_falls_silent_trips_the_run():
    asked = []

    def alive():
        asked.append(1)
        return len(asked) < 12

    stop, _, _ = go(client=Client(alive=alive), settings=LoopSettings(heartbeat_age=0.2))
    assert stop.status == "tripped"
    assert "operator's client" in stop.reason
    stop, _, _ = go(client=Client(alive=lambda: True), settings=LoopSettings(heartbeat_age=0.2))
    assert stop.status == "completed"


@pytest.mark.parametrize("method", ["write", "segment", "gate", "plan"])
def test_a_recorder_that_fails_ends_at_zero(method):
    stop, _, _ = go(sink=Broken(method, OSError("disk full")))
    assert stop.status == "failed"
    assert "disk full" in stop.reason


def test_a_recorder_that_fails_at_the_very_end_does_not_hide_why_the_run_ended():
    sink = Broken("write", OSError("disk full"))
    stop, _, _ = go(spoiled(raising(DeviceError("cable out")), at=300), sink)
    assert stop.status == "failed"
    assert "cable out" in stop.reason


def test_a_display_that_fails_ends_at_zero():
    stop, _, _ = go(client=Client(raising(RuntimeError("no terminal"))))
    assert (stop.status, stop.reason) == ("failed", "RuntimeError: no terminal")


@pytest.mark.parametrize("method", ["write", "configure", "sleep", "now"])
def test_a_device_that_fails_ends_at_zero(method, monkeypatch):
    device = FakeDevice()
    works, calls = getattr(device, method), []

    def breaks(*args):
        calls.append(1)
        if len(calls) == {"write": 5, "configure": 1, "sleep": 9, "now": 60}[method]:
            raise DeviceError("bus off")
        return works(*args)

    monkeypatch.setattr(device, method, breaks)
    stop, _, _ = go(device)
    assert stop.status in ("failed", "tripped")
    assert "bus off" in stop.reason


def test_a_device_without_deadman_is_not_armed():
    device = FakeDevice()
    device.deadman = None
    stop, _, sink = go(device)
    assert stop.status == "failed"
    assert "deadman" in stop.reason
    assert device.written == []
    assert not np.abs(sink.column("v")).any()


def test_a_device_that_never_speaks_is_given_up():
    device = FakeDevice()
    device.silent = True
    stop, _, _ = go(device)
    assert (stop.status, stop.reason) == ("failed", "the device gave no sample in 1 s")


def test_a_device_without_a_needed_channel_is_refused_before_anything_moves():
    device = FakeDevice()
    device.channels = (Channel("v", "V", "command"),)
    with pytest.raises(GateError, match="theta"):
        run(plan(), RIG, device.open(), Memory())
    assert device.written == []


def test_lost_samples_are_counted_and_told():
    def spoil(block):
        kept = ~np.isin(block.sequence, [300, 301, 407])
        return replace(
            block,
            time=block.time[kept],
            sequence=block.sequence[kept],
            values=block.values[kept],
            quality=block.quality[kept],
        )

    stop, _, sink = go(FakeDevice(spoil))
    assert stop.status == "completed"
    assert stop.missing_samples == 3
    assert sum(p["lost"] for name, p in sink.events if name == "gap") == 3


def test_values_that_are_marked_missing_are_counted():
    def change(block):
        values, flags = block.values.copy(), block.quality.copy()
        values[0, 1], flags[0, 1] = np.nan, Quality.MISSING
        return replace(block, values=values, quality=flags)

    stop, _, _ = go(spoiled(change))
    assert (stop.status, stop.missing_samples) == ("completed", 1)


def test_late_ticks_are_counted(monkeypatch):
    device = FakeDevice()
    works, calls = device.sleep, []

    def slow(seconds):
        calls.append(1)
        works(seconds + (0.025 if len(calls) in (20, 30) else 0.0))

    monkeypatch.setattr(device, "sleep", slow)
    stop, _, _ = go(device)
    assert (stop.status, stop.late_ticks) == ("completed", 2)


@pytest.mark.parametrize(
    "settings",
    [
        LoopSettings(tick=0.045),
        LoopSettings(tick=0.0),
        LoopSettings(ahead=0.01),
        LoopSettings(ahead=0.2),
    ],
)
def test_a_pace_that_would_starve_the_device_is_refused(settings):
    with pytest.raises(InputError, match="loop"):
        run(plan(), RIG, FakeDevice().open(), Memory(), settings=settings)


# Zero, and that it happened


def test_an_output_that_reads_back_other_than_zero_at_the_end_is_a_failure():
    device = FakeDevice()

    def still_on(block):
        values = block.values.copy()
        values[:, 0] = 3.0 if device.zeros else values[:, 0]
        return replace(block, values=values)

    device.spoil = still_on
    stop, _, sink = go(device)
    assert stop.status == "failed"
    assert stop.reason.startswith("THE OUTPUT IS NOT AT ZERO: v read 3 V")
    assert sink.events[-1][1]["status"] == "failed"


def test_a_zero_that_is_late_by_a_block_is_no_failure():
    device, held = FakeDevice(), []

    def one_late(block):
        held.append(block)
        return held[-2] if len(held) > 1 else replace_rows(block)

    device.spoil = one_late
    stop, _, _ = go(device)
    assert stop.status == "completed"


def replace_rows(block):
    return replace(
        block,
        time=block.time[:0],
        sequence=block.sequence[:0],
        values=block.values[:0],
        quality=block.quality[:0],
    )


def test_a_device_that_falls_silent_after_zero_is_a_failure():
    device = FakeDevice()
    device.spoil = lambda block: replace_rows(block) if device.zeros else block
    stop, _, _ = go(device)
    assert stop.status == "failed"
    assert "no sample shows v at zero" in stop.reason


@pytest.mark.parametrize("error", [OSError("bus off"), KeyboardInterrupt()])
def test_an_output_that_cannot_be_zeroed_is_told_first(error, monkeypatch):
    device = FakeDevice()
    monkeypatch.setattr(device, "zero", raising_always(error))
    stop = run(plan(), RIG, device.open(), Memory())
    assert stop.status == "failed"
    assert stop.reason.startswith("the output could not be zeroed: ")


def test_a_zero_that_fails_at_first_is_tried_again(monkeypatch):
    device = FakeDevice()
    works, calls = device.zero, []

    def breaks():
        calls.append(1)
        if len(calls) <= 5:
            raise OSError("bus off")
        works()

    monkeypatch.setattr(device, "zero", breaks)
    stop, _, _ = go(device)
    assert stop.status in ("failed", "tripped")
    assert "bus off" in stop.reason


def raising_always(error):
    def breaks():
        raise error

    return breaks


# Real time


@pytest.mark.real_time
def test_on_real_time_a_slow_recorder_does_not_slow_the_output():
    class Slow(Memory):
        def write(self, block):
            time.sleep(0.1)
            super().write(block)

    device, sink = RealTime(), Slow()
    stop = run(plan(duration=0.4), patient_rig(), device.open(), sink)
    assert stop.status == "completed", stop.reason
    assert not device.live
    assert [s.name for s in sink.segments] == ["burst_0", "burst_1"]
    sequence = sink.column("sequence")
    assert np.array_equal(sequence, np.arange(sequence[0], sequence[0] + len(sequence)))


def test_a_queue_hands_on_what_its_thread_raised():
    queued = QueuedSink(Broken("gate", OSError("disk full")))
    queued.event(0, "gate", {})
    with pytest.raises(OSError, match="disk full"):
        queued.close()


def test_what_the_recorders_thread_raised_comes_out_of_every_later_call():
    queued = QueuedSink(Broken("gate", OSError("disk full")))
    queued.event(0, "gate", {})
    with contextlib.suppress(OSError):
        for _ in range(100):
            time.sleep(0.01)
            queued.event(0, "x", {})
    for _ in range(2):
        with pytest.raises(OSError, match="disk full"):
            queued.event(0, "x", {})
    with pytest.raises(OSError, match="disk full"):
        queued.close()


@pytest.mark.real_time
def test_a_recorder_that_lost_samples_makes_a_stopped_run_a_failed_one():
    stop = run(
        plan(duration=0.4),
        patient_rig(),
        RealTime().open(),
        Broken("stop", OSError("disk full")),
        Client(stop=after(0.3)),
    )
    assert stop.status == "failed"
    assert stop.reason == "stopped on request; then OSError: disk full"


@pytest.mark.parametrize("depth", [1, 8])
def test_a_disk_that_hangs_is_reported_and_not_waited_for(depth):
    hang = threading.Event()

    class Hangs(Memory):
        def event(self, time, name, payload):
            hang.wait(20.0)

    queued = QueuedSink(Hangs(), depth, close_within=0.2)
    with contextlib.suppress(DeviceError):
        for _ in range(2):
            queued.event(0, "x", {})
    started = time.monotonic()
    with pytest.raises(DeviceError, match=r"did not finish in 0\.2 s"):
        queued.close()
    assert time.monotonic() - started < 2.0
    hang.set()


def test_a_queue_that_is_full_ends_the_run_instead_of_waiting():
    gate = threading.Event()

    class Stuck(Memory):
        def event(self, time, name, payload):
            gate.wait(5.0)

    queued = QueuedSink(Stuck(), depth=2)
    for _ in range(2):
        queued.event(0, "x", {})
    # The thread may have taken one of them.
    with contextlib.suppress(DeviceError):
        queued.event(0, "x", {})
    with pytest.raises(DeviceError, match="behind"):
        queued.event(0, "x", {})
    gate.set()
    queued.close()


def test_a_later_signal_breaks_a_hang_and_none_disturbs_the_ending():
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGINT)
        assert interrupts.reason == "SIGINT (Ctrl-C)"
        signal.raise_signal(signal.SIGTERM)  # at once: the flag may not have been looked at yet
        time.sleep(PAUSE)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        interrupts.ending = True
        signal.raise_signal(signal.SIGINT)


def test_what_can_be_left_out_is_given_up_on_the_first_signal_only():
    with Interrupts() as interrupts:
        interrupts.ending = True
        with pytest.raises(KeyboardInterrupt), interrupts.give_up():
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        assert interrupts.ending


def test_outside_the_main_thread_signals_are_left_alone():
    before = signal.getsignal(signal.SIGINT)
    result = []

    def work():
        with Interrupts():
            result.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert result == [before]


def test_a_device_that_echoes_its_reference_is_believed():
    channels = (Channel("ref", "V", "reference"), *FakeDevice.channels)
    assert recorded_channels(RIG, plan(), channels) == channels
    added = recorded_channels(RIG, plan(), FakeDevice.channels)[2:]
    assert [(c.name, c.unit, c.role) for c in added] == [
        ("u", "V", "reference"),
        ("theta_ref", "rad", "reference"),
    ]
    assert Collector(RIG, plan(), Reference(plan()), channels, 10).take() is None


def test_the_joint_ends_where_the_centring_loop_holds_it():
    _, _, sink = go()
    theta = sink.column("theta")
    assert abs(theta[-1]) < 0.5 * np.abs(theta).max()


def test_a_plan_that_ends_off_centre_is_not_pulled_back_before_the_output_is_zero():
    """A set point that fell to 0 with the plan would be a step of the output."""
    n = 1000
    theta_ref = 0.1 * (0.5 - 0.5 * np.cos(np.pi * np.minimum(np.arange(2 * n) / n, 1.0)))
    move = PlannedSegment(
        "move", "transient", 0.1, "V", 0, 0 * theta_ref, theta_ref, (0.0, 1.0), 0 * theta_ref
    )
    device, sink = FakeDevice(), Memory()
    stop = run(Plan("move", RATE, "v", 4.0, "theta", (move,), 0), RIG, device.open(), sink)
    assert stop.status == "completed"
    end = np.searchsorted(sink.column("sequence"), move.u.size)
    v, theta = sink.column("v")[end:], sink.column("theta")[end:]
    assert theta[-1] == pytest.approx(theta[0], abs=0.001)
    assert np.abs(v).max() < 0.1 * 4.0 * 0.1


@pytest.mark.parametrize(
    ("after", "status", "reached"),
    [(0.0499, "completed", True), (0.0461, "completed", False), (0.05, "tripped", False)],
)
def test_a_move_is_done_where_it_was_to_go(after, status, reached, tmp_path):
    move = Move(0.0, after, "rad", StopRecord(status, ""), tmp_path, to=0.05, within=0.001)
    assert move.reached is reached
