"""The NI-DAQmx driver against a stand-in for nidaqmx: inputs on one clock, and no output."""

import sys

import numpy as np
import pytest
from ni_kit import installed
from wire_kit import until

from drivers.ni_daq import NiRig, open_rig
from samii_rig.devices.protocols import CommandBlock
from samii_rig.devices.timebase import ClockModel, Timed
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.types import Quality

SETTINGS = {
    "board": "Dev1",
    "analogue": {"a_0": {"input": "ai3", "volts_per_unit": 0.1, "offset": 0.5}},
    "encoder": {"theta_2": {"counter": "ctr0", "pulses_per_rev": 1000, "sign": -1, "offset": 0.25}},
}


@pytest.fixture
def ni(monkeypatch):
    return installed(monkeypatch)


@pytest.fixture(scope="module")
def rig():
    whole = load_rig("samii")[0]
    return whole.model_copy(update={"sensor": whole.sensor[:2]})


@pytest.fixture
def device(ni, rig):
    opened = open_rig(rig, SETTINGS)
    assert isinstance(opened, NiRig)
    yield opened
    opened.close()
    opened.close()
    assert not any(t.open for t in ni.tasks)


def taken(device, n=50):
    blocks = []
    until(lambda: blocks.append(device.sensor.read()) or sum(map(len, blocks)) >= n, 10.0)
    return [
        np.concatenate([getattr(b, x) for b in blocks])
        for x in ("time", "sequence", "values", "quality")
    ]


def test_encoders_and_inputs_are_taken_on_one_sample_clock(ni, device):
    assert [(t.kind, t.rows) for t in ni.tasks] == [("ai", ["Dev1/ai3"]), ("ci", ["Dev1/ctr0"])]
    assert ("ci", "/Dev1/ai/SampleClock") in ni.calls
    # The clock begins when all others wait for it.
    assert ni.calls[-2:] == [("start", "ci"), ("start", "ai")]
    ni.outs, ni.volts, ni.theta = [0.0, 0.0], 1.5, [-0.75, 0.0]
    until(lambda: (device.sensor.read().values == [1.0, 10.0]).all(axis=1).any())
    when, sequence, values, quality = taken(device)
    np.testing.assert_allclose(values, np.tile([1.0, 10.0], (len(values), 1)))
    assert (np.diff(sequence) == 1).all()
    assert (np.diff(when) == 2_000_000).all()
    assert not quality.any()


def test_its_clock_can_be_held_against_the_hosts(device):
    assert isinstance(device.sensor, Timed)
    model = ClockModel(device.sensor.latency)
    until(lambda: (device.sensor.read(), model.add(device.sensor.arrivals()), model.ready)[2], 10.0)
    assert model.fit().sigma >= 0.005 / np.sqrt(12)


def test_an_input_at_its_end_is_clipped_and_what_is_no_number_missing(ni, device):
    ni.volts = 10.0
    until(lambda: (device.sensor.read().quality[:, 1] == Quality.CLIPPED).any())
    ni.volts = float("nan")
    until(lambda: (device.sensor.read().quality[:, 1] == Quality.MISSING).any())
    ni.outs, ni.theta = [0.0, 0.0], [5.0, 0.0]
    until(lambda: (device.sensor.read().quality[:, 0] == Quality.CLIPPED).any())


def test_no_gate_arms_it(device):
    assert device.actuator.deadman is None
    with pytest.raises(DeviceError, match="only measures"):
        device.actuator.write(CommandBlock(0, np.zeros(2), np.zeros(2)))


def test_what_the_board_says_ends_it(ni, device):
    taken(device, 5)
    ni.broken = {"ai", "ci"}
    ni.error = "-200279: The application is not able to keep up\nwith the hardware acquisition."
    with pytest.raises(DeviceError, match=r"Dev1: RuntimeError: -200279: .*up with the") as caught:
        until(lambda: device.sensor.read() is None, 5.0)
    assert "\n" not in str(caught.value)


def test_a_board_that_is_not_there_is_one_line(ni, rig):
    ni.broken = {"made"}
    ni.error = "-200220: Device identifier is invalid.\n\nDevice Specified: Dev1"
    with pytest.raises(DeviceError, match=r"Dev1: NI-DAQmx refuses: -200220: .* Device Spec"):
        open_rig(rig, SETTINGS)


def test_without_the_package_the_remedy_is_named(rig, monkeypatch):
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    with pytest.raises(InputError, match=r"pip install 'samii-rig\[nidaqmx\]'"):
        open_rig(rig, SETTINGS)


def changed(table, name, **values):
    return {table: {name: {**SETTINGS[table][name], **values}}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"colour": 1}, "colour is 1; expected one of board"),
        ({"board": ""}, "board is ''"),
        ({"encoder": {}}, r"analogue and encoder is \['a_0'\]; expected theta_2, a_0, each once"),
        (changed("analogue", "a_0", volts_per_unit=0.0), "volts_per_unit is 0.0"),
        (changed("analogue", "a_0", low=10.0), "a_0.low is 10.0; expected below high, 10"),
        (changed("encoder", "theta_2", sign=0), "theta_2.sign is 0; expected 1 or -1"),
        (
            {
                "analogue": {"theta_2": SETTINGS["analogue"]["a_0"]},
                "encoder": {"a_0": SETTINGS["encoder"]["theta_2"]},
            },
            "encoder.a_0 is 'm/s.2'; expected a channel in rad",
        ),
    ],
)
def test_a_wrong_setting_is_one_line(ni, rig, changes, said):
    with pytest.raises(InputError, match=said) as caught:
        open_rig(rig, {**SETTINGS, **changes})
    assert "\n" not in str(caught.value)
    assert not ni.tasks


def test_encoders_alone_have_no_clock(ni, rig):
    only = rig.model_copy(update={"sensor": rig.sensor[:1]})
    with pytest.raises(InputError, match="at least one: its sample clock"):
        open_rig(only, {**SETTINGS, "analogue": {}})
    with pytest.raises(InputError, match=r"board: is missing; see docs/reference/ni-daq\.md"):
        open_rig(rig, {})
