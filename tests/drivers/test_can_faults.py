"""Faults of the CAN bus with the real drivers on real ports: FAULT and the output at null, whatever
the gate was doing, within the channel's age limit and 50 ms."""

import re
import time
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from can_kit import CanWire, moment_rig, until
from wait_kit import patient

import drivers.composite.rig as composite
from samii_rig.devices.opening import open_device
from samii_rig.devices.protocols import CommandBlock, OpenRig
from samii_rig.errors import DeviceError, GateError, InputError
from samii_rig.rig.schema import Device, Rig
from samii_rig.safety.gate import Gate, GateEvent
from samii_rig.safety.judgement import State
from samii_rig.safety.limits import gate_limits
from samii_rig.types import Quality

AGE = 0.3  # s, the sensors' limit here: a loaded machine is late by less
WITHIN = AGE + 0.05
TRIES = 5  # a loaded machine may be late; the promptest counts
TICK = 0.004
AHEAD = 50  # samples


@pytest.fixture(scope="module")
def wire(tmp_path_factory) -> Iterator[CanWire]:
    # A slow machine may feed late; how soon the deadman acts is tested in test_wire_faults.py.
    w = CanWire("--seed", "5", rig=str(moment_rig(tmp_path_factory.mktemp("rig"), 0.2)))
    with pytest.MonkeyPatch.context() as patch:
        # What a fault leads to does not hang on how well the clocks are known.
        patch.setattr(composite, "LISTEN", 0.3)
        yield w
    w.close()


@pytest.fixture
def device(wire) -> Iterator[OpenRig]:
    wire.rest()
    d = open_device(wire.rig, {})
    yield d
    d.close()


class Gated:
    """The device behind a gate, with a host that reads, and sends a tone while it may."""

    def __init__(self, rig: Rig, device: OpenRig) -> None:
        self.device, self.log = device, list[GateEvent]()
        limits = gate_limits(rig, "v_2", 4.0, "theta_2")
        self.gate = Gate(device.actuator, limits, device.sensor.channels, self.log.append)
        self.newest = self.sent = -1
        self.reason = ""
        self.on(0.1)

    def tick(self) -> None:
        time.sleep(TICK)
        now = time.monotonic_ns
        try:
            block = self.device.sensor.read()
            if len(block):
                self.newest = int(block.sequence[-1])
            self.gate.observe(block, now())
            if self.gate.state is State.RUNNING:
                self.send()
        except DeviceError as error:
            self.gate.fail(str(error), now())
        except GateError:
            pass
        self.reason = self.gate.fault

    def send(self) -> None:
        self.sent = self.newest + AHEAD if self.sent < 0 else self.sent
        n = self.newest + AHEAD + 10 - self.sent
        if n > 0:
            u = 0.3 * np.sin(2 * np.pi * 5.0 * (self.sent + np.arange(n)) / 500.0)
            block = CommandBlock(self.sent, u, np.zeros(n))
            self.gate.write(block, time.monotonic_ns())
            self.sent += n

    def on(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and self.gate.state is not State.FAULT:
            self.tick()

    def bring_to(self, state: State) -> bool:
        """Whether the gate got there; a loaded machine may trip it."""
        try:
            if state is not State.SAFE:
                self.gate.arm(time.monotonic_ns())
            if state is State.RUNNING:
                self.gate.start(time.monotonic_ns())
        except GateError:
            return False
        self.on(0.25)
        return self.gate.state is state

    def until_fault(self, seconds: float = 2.0) -> float:
        """s until FAULT."""
        start = time.monotonic()
        while self.gate.state is not State.FAULT and time.monotonic() - start < seconds:
            self.tick()
        return time.monotonic() - start


FAULTS = {
    "bus-off": ("can bus-off 1", "ft: no good sample|M_2 said nothing new"),
    "silent": ("can silent 1", "ft: no good sample|M_2 said nothing new"),
    "foreign": ("can foreign 50", "another sender"),
    "unplugged": ("can unplug", "the bus is gone|takes nothing|M_2 said nothing new"),
    "status": ("can status 0x2000", "M_2 said nothing new|Converter"),
}


@pytest.mark.parametrize("state", [State.ARMED, State.RUNNING])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_on_the_bus_is_a_fault_of_the_gate_and_the_output_at_null(wire, fault, state):
    command, said = FAULTS[fault]
    took: list[float] = []
    rig = patient(wire.rig, AGE)
    for _ in range(TRIES):
        wire.rest()
        device = open_device(rig, {})
        try:
            gated = Gated(rig, device)
            if not gated.bring_to(state):
                continue
            wire.tell(command)
            took.append(gated.until_fault())
        finally:
            device.close()
            if fault == "unplugged":
                wire.tell("can plug")
                rig.device.settings["ft"]["channel"] = wire._answer()["can"]
        assert gated.gate.state is State.FAULT
        until(lambda: wire.history()["v"] == 0)
        assert re.search(said, gated.reason), gated.reason
        if min(took) < WITHIN:
            break
    assert took, "the gate never got there"
    assert min(took) < WITHIN


@pytest.mark.parametrize("fault", ["bus-off", "silent", "status"])
def test_with_a_dead_sensor_nothing_is_armed(wire, device, fault):
    gated = Gated(wire.rig, device)
    wire.tell(FAULTS[fault][0])
    gated.on(AGE + 0.3)
    with pytest.raises(GateError):
        gated.gate.arm(time.monotonic_ns())
    assert wire.history()["v"] == 0


def test_after_the_fault_the_main_device_still_shows_its_output(wire, device):
    gated = Gated(wire.rig, device)
    wire.tell("can unplug")
    try:
        with pytest.raises(DeviceError, match="ft: "):
            until(lambda: device.sensor.read() is None)
        time.sleep(0.05)
        block = device.sensor.read()
        names = [c.name for c in block.channels]
        assert len(block)
        assert not block.values[:, names.index("v_2")].any()
        assert block.quality[-1, names.index("M_2")] == Quality.MISSING
    finally:
        wire.tell("can plug")
        wire.settings["ft"]["channel"] = wire._answer()["can"]
    assert gated.gate.state is State.SAFE


def test_a_reader_that_dies_is_an_event(wire, monkeypatch):
    wire.rest()
    rig = patient(wire.rig, 0.5)  # so that the reader's end is what is seen first

    def dies(*_):
        raise SystemExit

    with closing(open_device(rig, {})) as device:
        gated = Gated(rig, device)
        monkeypatch.setattr(device.parts["ft"].bus, "recv", dies)
        gated.until_fault()
    assert gated.reason.startswith("ft: ")
    assert "the reader has ended: SystemExit" in gated.reason


def test_gauges_that_stand_still_while_the_output_moves_are_a_fault(wire):
    rig = patient(wire.rig, 0.5)
    for _ in range(TRIES):
        wire.rest()
        device = open_device(rig, {})
        gated = Gated(rig, device)
        if gated.bring_to(State.RUNNING):
            wire.tell("can stuck 1")
            gated.until_fault(5.0)
        device.close()
        if "stuck" in gated.reason:
            break
    assert "M_2 is stuck" in gated.reason


def test_frames_that_are_lost_are_never_a_wrong_sample(wire):
    wire.rest()
    # Two seconds without a good sample: only what is taken for a sample is looked at here.
    rig = patient(wire.rig, 2.0)
    with closing(open_device(rig, {})) as device:
        lossy(wire, rig, device)


def lossy(wire: CanWire, rig: Rig, device: OpenRig) -> None:
    gated = Gated(rig, device)
    wire.tell("can loss 0.05", "can other 100")
    seen = []
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        time.sleep(TICK)
        seen.append(device.sensor.read())
    i = [c.name for c in device.sensor.channels].index("M_2")
    values = np.concatenate([b.values[:, i] for b in seen])
    quality = np.concatenate([b.quality[:, i] for b in seen])
    assert (np.isnan(values) == (quality == Quality.MISSING)).all()
    # At rest: the noise of the gauges, whose step is 0.03 N m, and nothing else.
    assert np.nanmax(np.abs(values)) < 0.3
    counts = device.parts["ft"].reader.counts
    assert counts.lost > 0
    assert counts.foreign == 0
    assert counts.others > 0
    assert gated.gate.state is State.SAFE


# What is said when it does not open


@pytest.mark.parametrize(
    ("part", "changes", "said"),
    [
        ("ft", {"bitrate": 500_000}, "the bus is silent, .*bitrate"),
        ("ft", {"sensors": ["theta_2"]}, "ft.sensors is 'theta_2'; expected no theta_2, on which"),
        ("ft", {"sensors": ["M_9"]}, "ft.sensors is 'M_9'; expected one of theta_2"),
        ("ft", {"sensors": None}, "ft.sensors is None; expected the sensors that it measures"),
        ("ft", {"axes": {}}, r"device.settings.ft.axes is \[\]; expected M_2 among them"),
        ("ft", {"driver": "nonesuch"}, "driver is 'nonesuch'; expected one of composite"),
        (
            "ft",
            {"driver": "serial_node"},
            "device.settings.ft.port: is missing; see docs/reference/serial",
        ),
        ("ft", {"driver": ""}, "ft.driver is ''; expected a device"),
        ("main", {"sensors": ["a_0"]}, r"main.sensors is \('a_0',\); expected left out"),
        ("ft", {"gap": 0.03}, "ft.gap is 0.03; expected at most 0.025, half of the least"),
        ("main", {"baud": 9600}, "device.settings.main.baud is 9600"),
        ("main", None, "device.settings is .*; expected main among them"),
    ],
)
def test_a_wrong_setting_is_one_line(wire, monkeypatch, part, changes, said):
    monkeypatch.setattr("drivers.force_torque.reader.ANSWER_WITHIN", 0.05)
    wire.rest()
    settings = {name: dict(given) for name, given in wire.settings.items()}
    if changes is None:
        settings.pop(part)
    else:
        settings[part] |= changes
        settings[part] = {k: v for k, v in settings[part].items() if v is not None}
    rig = wire.rig.model_copy(update={"device": Device(driver="composite", settings=settings)})
    with pytest.raises((InputError, DeviceError), match=said) as caught:
        open_device(rig, {})
    assert "\n" not in str(caught.value)


def test_a_device_on_simulated_time_is_no_part_of_a_rig_in_real_time(wire):
    settings = {**wire.settings, "main": {"driver": "simulated"}}
    rig = wire.rig.model_copy(update={"device": Device(driver="composite", settings=settings)})
    with pytest.raises(InputError, match=r"main\.driver is 'simulated'; expected one in real time"):
        open_device(rig, {})


def test_a_sensor_is_measured_once(wire):
    settings = {**wire.settings, "second": wire.settings["ft"]}
    rig = wire.rig.model_copy(update={"device": Device(driver="composite", settings=settings)})
    with pytest.raises(InputError, match=r"second\.sensors is 'M_2'; expected none that ft"):
        open_device(rig, {})


def test_the_adapter_is_one_programs_alone(wire, device):
    alone = wire.sensor_rig
    alone.device.settings["channel"] = wire.settings["ft"]["channel"]
    with pytest.raises(DeviceError, match="in use by process"):
        open_device(alone, {})
    time.sleep(0.1)
    assert len(device.sensor.read())
    device.close()
    again = open_device(alone, {})
    again.close()
