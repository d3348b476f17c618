"""The force/torque driver on a bus of this process: what it reads, and what it says."""

import errno
import os
import threading
import time
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import can
import numpy as np
import pytest
from can_kit import moment_rig, until

from drivers.force_torque import bus as bus_module
from drivers.force_torque.device import ForceTorqueRig, check_matrix, open_rig
from drivers.force_torque.frames import AXES, MATRIX, NEEDED, Frames
from drivers.force_torque.reader import Reader
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Monitor
from samii_rig.types import Quality
from sim.wire.can_sensor import Sensor, calibration

BASE = 0x20
LOADS = np.array([3.0, -20.0, 100.0, 1.0, -4.0, 60.0])


class Bench:
    """A sensor on a virtual bus, served by a thread."""

    def __init__(self, name: str) -> None:
        self.loads = LOADS.copy()
        self.sensor = Sensor(BASE, lambda: self.loads, 400.0)
        self.bus = can.Bus(interface="virtual", channel=name)
        self.name = name
        self.hold = False
        self.ending = threading.Event()
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self) -> None:
        while not self.ending.is_set():
            frame = self.bus.recv(0.02)
            if frame is not None and not self.hold:
                for identifier, data in self.sensor.answer(frame.arbitration_id, bytes(frame.data)):
                    self.say(identifier, data)

    def say(self, identifier: int, data: bytes = b"", **more: bool) -> None:
        self.bus.send(
            can.Message(arbitration_id=identifier, is_extended_id=False, data=data, **more)
        )

    def open(self, rig, **changes) -> ForceTorqueRig:
        settings = {
            "interface": "virtual",
            "channel": self.name,
            "axes": {"M_2": {"axis": "Tz"}},
            "rate_hz": 200.0,
            **changes,
        }
        opened = open_rig(rig, settings)
        assert isinstance(opened, ForceTorqueRig)
        return opened


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    whole = load_rig(str(moment_rig(tmp_path_factory.mktemp("rig"))))[0]
    own = tuple(s for s in whole.sensor if s.name == "M_2")
    return whole.model_copy(update={"sensor": own})


@pytest.fixture
def bench(request) -> Iterator[Bench]:
    b = Bench(request.node.name)
    yield b
    b.ending.set()
    b.thread.join()
    b.bus.shutdown()


@pytest.fixture
def opened(bench, rig) -> Iterator[ForceTorqueRig]:
    device = bench.open(rig)
    yield device
    device.close()


def taken(device, n: int = 10):
    """At least n samples in one block."""
    found = []
    until(lambda: found.append(device.sensor.read()) or sum(len(b) for b in found) >= n, 5.0)
    values = np.concatenate([b.values for b in found])
    quality = np.concatenate([b.quality for b in found])
    sequence = np.concatenate([b.sequence for b in found])
    when = np.concatenate([b.time for b in found])
    return when, sequence, values, quality


# What it reads


def test_the_loads_come_out_as_they_are_with_the_sensors_own_calibration(bench, rig):
    extra = tuple(
        Monitor(name=f"axis_{a}", unit="N" if a[0] == "F" else "N m", usual=0.0)
        for a in AXES
        if a != "Tz"
    )
    axes = {"M_2": {"axis": "Tz", "sign": -1}} | {x.name: {"axis": x.name[5:]} for x in extra}
    device = bench.open(rig.model_copy(update={"monitor": extra}), axes=axes)
    before = time.monotonic_ns()
    when, sequence, values, quality = taken(device, 20)
    device.close()
    names = [c.name for c in device.sensor.channels]
    assert names == ["M_2", *(x.name for x in extra)]
    expected = [-LOADS[5], *LOADS[:5]]
    # One count of each gauge.
    step = [c.resolution for c in device.sensor.channels]
    assert np.abs(values - expected).max(axis=0) == pytest.approx(0.0, abs=max(step))
    assert not quality.any()
    assert (np.diff(sequence) >= 1).all()
    assert (np.diff(when) > 0).all()
    assert before - 2e9 < when[0] < time.monotonic_ns()
    assert device.metadata["serial"] == "FT-00017"
    assert device.metadata["can_foreign"] == "0"
    assert int(device.metadata["can_replies"]) >= 20


def test_units_of_another_system_become_si(bench, rig, monkeypatch):
    monkeypatch.setattr("sim.wire.can_sensor.NEWTON_METRE", 1)  # lbf in
    device = bench.open(rig)
    *_, values, _ = taken(device)
    device.close()
    assert values.mean() == pytest.approx(60.0 * 4.4482216152605 * 0.0254, rel=1e-3)


def test_a_calibration_of_the_rig_file_takes_the_place_of_the_sensors(bench, rig):
    twice = (2.0 * calibration(400.0)).tolist()
    device = bench.open(rig, calibration=twice)
    *_, values, _ = taken(device)
    device.close()
    assert values.mean() == pytest.approx(120.0, rel=1e-3)


def test_the_bias_is_what_stands_there_at_the_start(bench, rig):
    device = bench.open(rig, bias=0.1)
    bench.loads = LOADS + np.array([0, 0, 0, 0, 0, 5.0])
    time.sleep(0.05)
    taken(device, 12)
    *_, values, _ = taken(device)
    device.close()
    assert values[-1, 0] == pytest.approx(5.0, abs=0.05)
    assert device.metadata["bias_counts"] != str([0.0] * 6)


def test_no_bias_is_taken_of_a_load_that_changes(bench, rig):
    start = time.monotonic()

    def ramp():
        return LOADS * (1.0 + time.monotonic() - start)

    bench.sensor.loads = ramp
    with pytest.raises(DeviceError, match="let the rig come to rest"):
        bench.open(rig, bias=0.1)
    bench.sensor.loads = lambda: LOADS
    bench.sensor.status = 1 << 5
    with pytest.raises(DeviceError, match="SupplyLow"):
        bench.open(rig, bias=0.1)


def test_a_status_word_makes_values_missing_and_a_gauge_at_its_end_clips_them(bench, opened):
    taken(opened)
    bench.sensor.status = (1 << 12) | 1
    until(lambda: (opened.sensor.read(), opened.device.status)[1])
    *_, values, quality = taken(opened)
    assert np.isnan(values).all()
    assert (quality == Quality.MISSING).all()
    assert opened.device.words() == "ThermistorLow, WatchdogReset"
    bench.sensor.status = 0
    bench.loads = LOADS * 20
    until(lambda: (opened.sensor.read().quality == Quality.CLIPPED).any())
    *_, values, quality = taken(opened)
    assert np.isfinite(values).all()
    assert (quality == Quality.CLIPPED).all()


def test_it_drives_nothing_and_no_gate_arms_it(opened):
    assert opened.actuator.deadman is None
    opened.actuator.zero()
    with pytest.raises(DeviceError, match="only measures"):
        opened.actuator.configure(DeviceLoop("M_2", 0.0, 1.0, 1.0, 1.0))
    with pytest.raises(DeviceError, match="only measures"):
        opened.actuator.write(CommandBlock(0, np.zeros(3), np.zeros(3)))


# What happens to it


def fails(device, said: str) -> float:
    """read() raises, and goes on to; s until then."""
    start = time.monotonic()
    with pytest.raises(DeviceError, match=said):
        until(lambda: device.sensor.read() is None, 5.0)
    with pytest.raises(DeviceError):
        device.sensor.read()
    return time.monotonic() - start


@pytest.mark.parametrize(
    ("identifier", "data"),
    [
        (0x200, bytes(8)),  # like the first frame of a reply
        (0x201, bytes(6)),  # like the second
        (0x200, bytes(3)),  # of a wrong length
        (0x205, bytes(8)),  # the answer to what nobody asked
        (0x20F, b""),
    ],
)
def test_a_foreign_frame_on_the_sensors_identifiers_ends_it_and_is_never_a_sample(
    bench, opened, identifier, data
):
    taken(opened)
    values = []

    def read() -> None:
        # One that comes at the very moment of a reply's second frame is told from it by what
        # follows; one that takes the place of a lost frame never is.
        bench.say(identifier, data)
        values.append(opened.sensor.read().values)

    with pytest.raises(DeviceError, match="another sender"):
        until(read, 5.0)
    assert np.abs(np.concatenate(values) - 60.0).max(initial=0.0) < 0.1
    assert opened.reader.counts.foreign == 1


def test_frames_of_other_identifiers_are_the_buss_own_business(bench, opened):
    for _ in range(5):
        bench.say(0x123, b"hello")
        bench.say(0x1FF)
    until(lambda: opened.reader.counts.others == 10)
    *_, quality = taken(opened)
    assert not quality.any()


def test_a_controller_that_reports_an_error_ends_it(bench, opened):
    bench.say(0x040, bytes(8), is_error_frame=True)
    fails(opened, "bus off")


def test_an_error_with_the_identifier_of_a_reply_is_no_reply():
    """SocketCAN's 0x204: a problem of the controller, with its counters."""
    bus = can.Bus(interface="virtual", channel="errors")
    other = can.Bus(interface="virtual", channel="errors")
    for identifier, data in Sensor(BASE, lambda: LOADS, 400.0).answer(0x202, b"\0"):
        other.send(
            can.Message(
                arbitration_id=identifier,
                is_extended_id=False,
                is_error_frame=identifier == 0x204,
                data=data,
            )
        )
    with pytest.raises(DeviceError, match="the CAN controller reports an error"):
        Reader(bus, Frames(BASE), 2_000_000).ask(*MATRIX, data=b"\0")
    bus.shutdown()
    other.shutdown()


def test_replies_that_stay_away_are_counted_and_late_ones_are_not_foreign(bench, opened):
    taken(opened)
    bench.hold = True
    until(lambda: opened.reader.counts.lost == 1)
    for identifier, data in bench.sensor.answer(0x200, b""):
        bench.say(identifier, data)
    until(lambda: opened.reader.counts.late == 2)
    bench.hold = False
    before = opened.reader.counts.replies
    until(lambda: opened.reader.counts.replies > before + 5)
    opened.sensor.read()
    assert opened.reader.counts.foreign == 0
    assert not opened.reader.trouble


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENETDOWN, "network is down"), "the bus is gone.*network is down"),
        (can.CanOperationError("odd"), "the bus is gone: odd"),
        (SystemExit(), "the reader has ended: SystemExit"),
    ],
)
def test_whatever_ends_the_reader_is_an_event(opened, monkeypatch, error, said):
    def broken(*_):
        raise error

    monkeypatch.setattr(opened.bus, "recv", broken)
    assert fails(opened, said) < 1.0


def test_a_reader_that_hangs_or_was_ended_from_outside_is_one_too(opened, monkeypatch):
    monkeypatch.setattr("drivers.force_torque.reader.HANG", 0.1)
    monkeypatch.setattr(opened.bus, "recv", lambda *_: time.sleep(0.4))
    fails(opened, "hangs")


def test_a_bus_that_takes_nothing_is_one_too(opened, monkeypatch):
    def full(*_, **__):
        raise can.CanOperationError("transmit buffer full")

    monkeypatch.setattr(opened.bus, "send", full)
    fails(opened, "takes nothing: transmit buffer full")


def test_a_damaged_line_of_an_adapter_is_counted_and_goes_by(opened, monkeypatch):
    taken(opened)
    recv, seen = opened.bus.recv, []

    def once(timeout=None):
        if not seen:
            seen.append(1)
            raise ValueError("invalid literal for int()")
        return recv(timeout)

    monkeypatch.setattr(opened.bus, "recv", once)
    taken(opened)
    assert opened.reader.counts.corrupt == 1


# What is said when it does not open


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"interface": "pcan"}, "interface is 'pcan'; expected 'slcan', 'socketcan' or 'virtual'"),
        ({"colour": 1}, "colour is 1; expected one of interface, channel"),
        ({"axes": {}}, r"axes is \[\]; expected M_2 among them"),
        ({"axes": {"M_9": {"axis": "Tz"}}}, "axes is 'M_9'; expected one of M_2"),
        ({"axes": {"M_2": {"axis": "Fz"}}}, "axes.M_2.axis is 'Fz in N'; expected an axis in N m"),
        ({"axes": {"M_2": {"axis": "Mz"}}}, "axes.M_2.axis is 'Mz'"),
        ({"base_id": 300}, "base_id is 300"),
        ({"calibration": [[1.0] * 6] * 5}, "calibration"),
        ({"calibration": [[1.0] * 6] * 6}, "is singular"),
        ({"calibration": [[0.0] * 6] * 6}, "row Fx is all 0"),
        ({"channel": ""}, "channel is ''"),
        ({"dbc": "no_such.dbc"}, "dbc is 'no_such.dbc'; expected a DBC file that can be read"),
        (
            {"interface": "slcan", "channel": "/dev/no_such_port"},
            "/dev/no_such_port: no such port",
        ),
        (
            {"interface": "slcan", "channel": os.devnull, "bitrate": 123456},
            "bitrate = 123456 is none of slcan's: 10000, 20000",
        ),
        ({"interface": "socketcan", "channel": "can77"}, "can77: .*(CAN|kernel modules)"),
        ({"base_id": 0x21}, "the bus is silent, nothing answers on 0x215; .*bitrate"),
    ],
)
def test_a_wrong_setting_is_one_line(bench, rig, monkeypatch, changes, said):
    monkeypatch.setattr("drivers.force_torque.reader.ANSWER_WITHIN", 0.02)
    with pytest.raises((InputError, DeviceError), match=said) as caught:
        bench.open(rig, **changes)
    assert "\n" not in str(caught.value)


def test_a_setting_that_is_missing_points_to_the_page(rig):
    with pytest.raises(InputError, match=r"axes: is missing; see docs/reference/force-torque\.md"):
        open_rig(rig, {"interface": "virtual", "channel": "x"})


def test_a_bus_that_lives_without_the_sensor_is_told_from_a_dead_one(bench, rig, monkeypatch):
    monkeypatch.setattr("drivers.force_torque.reader.ANSWER_WITHIN", 0.05)
    talking = threading.Event()

    def talk():
        while not talking.wait(0.01):
            bench.say(0x123, b"hello")

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        with pytest.raises(
            DeviceError, match=r"none is the sensor's answer on 0x215; is .*base_id"
        ):
            bench.open(rig, base_id=0x21)
    finally:
        talking.set()
        thread.join()


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.ENODEV, "no such CAN interface; those of this machine: "),
        (errno.EPERM, "no permission"),
        (errno.ENETDOWN, "sudo ip link set can0 up type can bitrate 1000000"),
        (errno.EAFNOSUPPORT, "kernel modules"),
        (errno.EIO, "Input/output error"),
    ],
)
def test_what_the_system_says_of_a_can_interface_is_said_with_the_remedy(
    bench, rig, monkeypatch, number, said
):
    def refused(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(bus_module.can, "Bus", refused)
    with pytest.raises(DeviceError, match=f"can0: .*{said}"):
        bench.open(rig, interface="socketcan", channel="can0")


def dbc(folder: Path, *changes: tuple[str, str]) -> str:
    text = resources.files("drivers.force_torque").joinpath("ati.dbc").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "own.dbc"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ((("BO_ 513 Gauges_1", "BO_ 513 Strain"),), "Gauges_1"),
        (((" SG_ G3 ", " SG_ G7 "),), "Gauges_1.SG_ is .*; expected G3 among them"),
        ((("BO_ 513 Gauges_1", "BO_ 528 Gauges_1"),), "another operation than that of Gauges_0"),
        ((("BO_ 527 Firmware: 4", "BO_ 2147484175 Firmware: 4"),), "Firmware: is extended"),
        ((("BO_ 512", "B0_ 512"),), "is no DBC file"),
        ((("BO_ 519 CountsPerUnit", "BO_ 519 Units"),), "BO_ is 'Units, twice'; expected each"),
        ((("G4 : 55|16@0-", "G4 : 39|16@0-"),), "is no DBC file.*overlap"),
        ((("G0 : 23|16", "G0 : 230000000|16"),), "': 2300' is in no frame"),
        ((("G0 : 23|16", "G0 : 23|160000000"),), "is in no frame"),
        ((("Gauges_0: 8 ", "Gauges_0: 80000000 "),), "is in no frame"),
        ((("G0 : 23|16@0- (1,0)", "G0 : 23|16@0- (2,0)"),), "G0: is not 16 bits with a sign"),
        ((("PerForce : 7|32@0+ (1,0)", "PerForce : 7|32@0+ (1e999,0)"),), "PerForce: has a factor"),
        ((("CM_ BO_ 512", "CM_ " * 20_000),), "expected a DBC file of at most 65536 bytes"),
        (((' 2 "N" 3 "klbf"', ' 3 "klbf"'),), "Units.ForceUnit is 'code 2'; expected one of lbf"),
    ],
)
def test_a_wrong_dbc_is_one_line(bench, rig, tmp_path, changes, said):
    with pytest.raises(InputError, match=said) as caught:
        bench.open(rig, dbc=dbc(tmp_path, *changes))
    assert "\n" not in str(caught.value)
    assert "own.dbc" in str(caught.value)


def test_what_a_dbc_says_beside_its_messages_is_not_read(tmp_path):
    beside = (
        "VAL_ 520 ForceUnit",
        "SG_MUL_VAL_ 512 G0 G2 0-4000000000;\n"
        'BA_DEF_ BO_ "x" INT 0 1e999999999;\nBA_ "x" BO_ 512 1e999999999;\n'
        'CM_ BO_ 512 "BO_ 9 Gauges_0: 99999999 S; \\" BA_";\n'
        "NS_ :\n CM_\n BA_\n VAL_\nBS_:\nVAL_ 520 ForceUnit",
    )
    frames, shipped = Frames(BASE, dbc(tmp_path, beside)), Frames(BASE)
    data = bytes(range(8))
    assert all(frames.length(name) == shipped.length(name) for name in NEEDED)
    assert frames.values("Gauges_0", data) == shipped.values("Gauges_0", data)
    assert frames.units(b"\1\2") == shipped.units(b"\1\2")


def test_a_singular_calibration_is_refused_whatever_its_scale():
    rng = np.random.default_rng(2)
    good = rng.standard_normal((6, 6))
    for scale in (1e-9, 1.0, 1e9):
        check_matrix(good * scale, "x")
        check_matrix(good * np.logspace(-6, 6, 6) * scale, "x")
        bad = good.copy() * scale
        bad[4] = 0.3 * bad[1] + 0.7 * bad[2]
        with pytest.raises(InputError, match="x: is singular"):
            check_matrix(bad, "x")
    lame = good.copy()
    lame[:, 3] = 0.0
    with pytest.raises(InputError, match="gauge 3 counts for nothing"):
        check_matrix(lame, "x")
    lame[0, 3] = np.nan
    with pytest.raises(InputError, match="no number"):
        check_matrix(lame, "x")


def test_a_sensor_with_counts_of_zero_is_refused(bench, rig, monkeypatch):
    monkeypatch.setattr("sim.wire.can_sensor.COUNTS_PER_UNIT", 0)
    with pytest.raises(InputError, match=r"counts per unit is .*; expected numbers above 0"):
        bench.open(rig)


def share(first, more) -> None:
    """Both ask the one sensor; whoever sees a reply that is not its own says so."""
    second = more()
    try:
        until(lambda: (first.sensor.read(), second.sensor.read()) is None, 1.0)
    finally:
        second.close()


def test_a_sensor_that_another_program_asks_is_not_shared(bench, rig, monkeypatch):
    first = bench.open(rig)
    with pytest.raises(DeviceError):
        share(first, lambda: bench.open(rig))
    first.close()


# Every byte


def test_any_bytes_of_the_right_length_are_read_and_no_others():
    frames = Frames(BASE)
    rng = np.random.default_rng(7)
    for _ in range(2000):
        for name in NEEDED:
            data = rng.bytes(frames.length(name))
            values = frames.values(name, data)
            assert set(NEEDED[name]) <= set(values)
        g = frames.gauges(rng.bytes(8), rng.bytes(6))
        assert (np.abs(g.counts) <= 32768).all()


def test_frames_and_the_simulated_sensor_agree_on_every_byte():
    frames = Frames(BASE)
    sensor = Sensor(BASE, lambda: LOADS, 400.0, status=0x0821)
    first, second = sensor.answer(0x200, b"")
    assert (first[0], second[0]) == (frames.identifier("Gauges_0"), frames.identifier("Gauges_1"))
    g = frames.gauges(first[1], second[1])
    assert set(g.status) == {"WatchdogReset", "SupplyLow", "ThermistorHigh"}
    even, odd = np.frombuffer(first[1], ">i2")[1:], np.frombuffer(second[1], ">i2")
    assert g.counts.tolist() == np.column_stack([even, odd]).ravel().tolist()
    rows = [frames.row([d for _, d in sensor.answer(0x202, bytes([i]))]) for i in range(6)]
    np.testing.assert_array_equal(rows, calibration(400.0))
