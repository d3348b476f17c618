"""Three devices with clocks of their own, off by seconds and by hundreds of ppm: every value of the
rig is of its sample's own time, to what is stated."""

import json
import time

import numpy as np
import pytest

from drivers.composite import rig as composite
from drivers.sensing import NoOutput
from samii_rig.devices.clock import MonotonicClock
from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import DeviceError
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device
from samii_rig.types import Channel, Quality, SampleBlock

FLOOR = (2e-4, 1.2e-3)  # s, shortest way of a sample, somewhere in between
TONE = 5.0  # Hz


def tone(host):
    """What every sensor sees, at host's times in ns."""
    return np.sin(2 * np.pi * TONE * (host % 10**12) * 1e-9)


class Fake:
    """A sensor of the tone on a clock of its own: device = (host - offset)/(1 + drift)."""

    def __init__(self, names, period, offset, drift, floor, seed, *, timed=True):
        self.channels = tuple(Channel(n, "rad") for n in names)
        self.latency = FLOOR
        self.timing = 1e-4
        self._period, self._offset, self._drift, self._floor = period, offset, drift, floor
        self._rng = np.random.default_rng(seed)
        self._k = int(self.device(time.monotonic_ns())) // period
        self._pairs: list = []
        self._timed = timed
        self.dead = False

    def device(self, host):
        return (host - self._offset) / (1 + self._drift)

    def host(self, device):
        return device * (1 + self._drift) + self._offset

    def read(self):
        last = int(self.device(time.monotonic_ns() - 3e6)) // self._period
        k = np.arange(self._k, self._k if self.dead else max(last, self._k))
        self._k = int(k[-1]) + 1 if len(k) else self._k
        when = k * self._period
        host = self.host(when)
        way = self._floor + self._rng.exponential(3e-4, len(k))
        self._pairs += np.column_stack([when, (host + way * 1e9).astype(np.int64)]).tolist()
        values = np.column_stack([tone(host)] * len(self.channels))
        stamps = when if self._timed else host.astype(np.int64)
        quality = np.zeros(values.shape, np.uint8)
        return SampleBlock(self.channels, stamps.astype(np.int64), k, values, quality)


class TimedFake(Fake):
    def arrivals(self):
        pairs, self._pairs = np.array(self._pairs, np.int64).reshape(-1, 2), []
        return pairs


@pytest.fixture
def opened(monkeypatch):
    whole = load_rig("samii")[0]
    made = {
        "main": TimedFake(("theta_2", "a_0"), 2_000_000, 7.7e9, 3e-4, 9e-4, 1),
        "board": TimedFake(("a_1",), 1_300_000, -4.2e12, -2e-4, 5e-4, 2),
        "host": Fake(("a_2",), 2_500_000, 0.0, 0.0, 5e-4, 3, timed=False),
    }

    def opening(sub, settings):
        name = sub.device.driver
        assert tuple(s.name for s in sub.sensor) == tuple(c.name for c in made[name].channels)
        return OpenRig(NoOutput(name), made[name], MonotonicClock(), name, {"device": name})

    monkeypatch.setattr(composite, "open_device", opening)
    settings = {
        "main": {"driver": "main"},
        "board": {"driver": "board", "sensors": ["a_1"]},
        "host": {"driver": "host", "sensors": ["a_2"]},
    }
    patient = tuple(s.model_copy(update={"stale_after": 1.0}) for s in whole.sensor)
    update = {"sensor": patient, "device": Device(driver="composite", settings=settings)}
    device = composite.open_rig(whole.model_copy(update=update), settings)
    yield device, made
    device.close()


def taken(device, seconds):
    blocks = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.005)
        blocks.append(device.sensor.read())
    return [
        np.concatenate([getattr(b, x) for b in blocks])
        for x in ("time", "sequence", "values", "quality")
    ]


def test_every_value_is_of_its_samples_own_time_to_what_is_stated(opened):
    device, made = opened
    when, sequence, values, quality = taken(device, 0.7)
    known = json.loads(device.metadata["timing"])
    assert {n: c for n, (c, _) in known.items()} == {"a_1": "board", "a_2": "host"}
    assert (np.diff(sequence) == 1).all()
    truth = tone(made["main"].host(when))
    assert np.abs(values[:, 0] - truth).max() < 1e-9
    inside = slice(10, None)
    assert not quality[inside].any()
    names = [c.name for c in device.sensor.channels]
    for name, (_, sigma) in known.items():
        # Stated: the ways of two devices, each even over 1 ms, and what the fit adds.
        assert 1e-4 < sigma < 6e-4
        wrong = np.abs(values[inside, names.index(name)] - truth[inside]).max()
        assert wrong < 2 * np.pi * TONE * 3 * sigma + 1e-3
    told = {e.fields["device"]: e.fields for e in device.sensor.events()}
    assert told["board"]["sigma"] == pytest.approx(known["a_1"][1], rel=0.5)
    assert set(told["host"]) >= {"main_drift", "main_drift_sigma", "main_scatter", "sigma"}
    assert not device.sensor.events()


def test_what_is_stated_of_a_clock_is_the_worst_of_the_run(opened):
    device, made = opened
    taken(device, 0.1)
    before = json.loads(device.metadata["timing"])["a_2"][1]
    made["host"].timing = 10.0 * before
    taken(device, 0.1)
    made["host"].timing = before
    taken(device, 0.1)
    clock, after = json.loads(device.metadata["timing"])["a_2"]
    assert (clock, after) == ("host", pytest.approx(10.0 * before, rel=0.2))


def test_one_device_that_falls_silent_says_so_once_and_the_others_go_on(opened):
    device, made = opened
    taken(device, 0.05)
    made["board"].dead = True
    with pytest.raises(DeviceError, match=r"board: no good sample for 1\.\d"):
        taken(device, 5.0)
    _, sequence, values, quality = taken(device, 0.1)
    assert (np.diff(sequence) == 1).all()
    assert np.isfinite(values[-1, [0, 1, 3]]).all()
    assert np.isnan(values[-1, 2])
    assert quality[-1].tolist() == [0, 0, Quality.MISSING, 0]
