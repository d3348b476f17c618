"""What every device must do, as tests: a driver passes them or is not one.

In a driver's own test file:

    from contract import DeviceContract

    class TestMyDevice(DeviceContract):
        rig = load_rig("mine")[0]

        def open(self) -> OpenRig:
            return open_my_device(self.rig, {})

Every test opens the device afresh, moves it by at most `level` of the actuator's limit and
leaves it at zero. Time is the device's own clock, so simulated devices take none.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import numpy as np
import pytest
from scipy import signal

from samii_rig.devices.protocols import Actuator, Clock, CommandBlock, DeviceLoop, OpenRig, Sensor
from samii_rig.errors import DeviceError
from samii_rig.model.feedback import sections
from samii_rig.rig.schema import Feedback, Rig
from samii_rig.safety.limits import GateLimits, gate_limits
from samii_rig.types import Float, Quality, SampleBlock

AHEAD = 0.15  # s between a reference and its first sample; a loaded machine may be late
FLIGHT = 0.03  # s for which samples from before a command may still arrive after it
FEEDBACK = 0.5  # of the output: what the kit's feedback would add if it were not clipped


class DeviceContract:
    """The kit; subclass it, set `rig`, define `open`."""

    rig: Rig
    level = 0.05  # of the largest output

    def open(self) -> OpenRig:
        """The device, opened and at rest."""
        raise NotImplementedError

    @pytest.fixture
    def bench(self) -> Iterator[Bench]:
        """The device with all samples that came, and zero at the end."""
        device = self.open()
        bench = Bench(self.rig, device, self.level)
        yield bench
        device.close()

    # What it is

    def test_it_has_the_protocols(self, bench: Bench) -> None:
        assert isinstance(bench.device.actuator, Actuator)
        assert isinstance(bench.device.sensor, Sensor)
        assert isinstance(bench.device.clock, Clock)

    def test_it_declares_the_deadman_of_the_rig_file(self, bench: Bench) -> None:
        assert bench.device.actuator.deadman == bench.spec.deadman

    def test_its_channels_are_those_of_the_rig_file(self, bench: Bench) -> None:
        units = {c.name: (c.role, c.unit) for c in bench.device.sensor.channels}
        assert len(units) == len(bench.device.sensor.channels)
        assert units[bench.spec.name] == ("command", bench.spec.unit)
        for s in self.rig.sensor:
            assert units[s.name] == ("sensor", s.unit)

    def test_what_it_says_of_itself_is_text(self, bench: Bench) -> None:
        assert bench.device.description
        assert all(isinstance(x, str) for kv in bench.device.metadata.items() for x in kv)

    # Samples

    def test_samples_come_without_a_gap_at_the_rate(self, bench: Bench) -> None:
        before, clock = len(bench.sequence), bench.device.clock
        start = clock.now()
        bench.wait(0.5)
        passed = (clock.now() - start) * 1e-9 * self.rig.rate_hz
        sequence, time = bench.sequence, bench.time
        assert np.array_equal(np.diff(sequence), np.ones(len(sequence) - 1))
        flight = FLIGHT * self.rig.rate_hz
        assert len(sequence) - before == pytest.approx(passed, abs=flight)
        step = np.diff(time) * 1e-9 * self.rig.rate_hz
        assert step.min() > 0.5
        assert step.mean() == pytest.approx(1.0, rel=1e-3)

    def test_a_sample_is_given_once(self, bench: Bench) -> None:
        bench.wait(0.1)
        again = bench.device.sensor.read()
        assert len(again) == 0 or again.sequence[0] > bench.sequence[-1]
        assert again.values.shape == (len(again), len(bench.device.sensor.channels))
        assert again.quality.shape == again.values.shape

    def test_the_clock_goes_on(self, bench: Bench) -> None:
        before = bench.device.clock.now()
        bench.device.clock.sleep(0.05)
        assert bench.device.clock.now() - before >= 50_000_000
        bench.device.clock.sleep(-1.0)

    # Output

    def test_it_is_at_zero_until_something_is_written(self, bench: Bench) -> None:
        bench.wait(0.1)
        bench.configure(bench.kp)
        bench.wait(0.2)
        assert not bench.v.any()

    def test_the_reference_comes_out_at_the_samples_that_it_was_meant_for(
        self, bench: Bench
    ) -> None:
        bench.configure(0.0)
        first, u = bench.play(bench.wave(0.2))
        np.testing.assert_allclose(bench.v_at(first, len(u)), u, atol=bench.step)

    def test_it_closes_the_loop_on_the_angle_that_it_reports(self, bench: Bench) -> None:
        bench.configure(bench.kp)
        first, u = bench.play(bench.wave(0.3))
        theta = bench.at(first, len(u), bench.sensor)
        np.testing.assert_allclose(
            bench.v_at(first, len(u)), u - bench.kp * theta, atol=2 * bench.step
        )

    def test_it_follows_the_set_point(self, bench: Bench) -> None:
        bench.configure(bench.kp)
        ref = bench.wave(0.3) / bench.kp if bench.kp else bench.wave(0.3)
        first, _ = bench.play(np.zeros_like(ref), ref)
        theta = bench.at(first, len(ref), bench.sensor)
        np.testing.assert_allclose(
            bench.v_at(first, len(ref)), bench.kp * (ref - theta), atol=2 * bench.step
        )

    # Feedback: run as the rig file states it, or refused

    def test_it_runs_a_feedback_or_refuses_it(self, bench: Bench) -> None:
        """v = u + kp (theta_ref - theta) + clip(F theta, -max, max), F by Tustin's rule from
        zero state; a device that has no filters says so in `configure`, and stays at zero."""
        loop = bench.feedback()
        before = bench.device_now()
        if not bench.takes(loop):
            bench.wait(0.1)
            assert not bench.v[bench.sequence > before].any()
            bench.configure(bench.kp)
            return
        first, u = bench.play(bench.wave(0.4))
        theta = bench.at(first, len(u), bench.sensor)
        added = bench.filtered(loop, theta)
        assert np.abs(added).max() > 4 * bench.step, "too little to be seen"
        assert (np.abs(added) == loop.max).any(), "it was never clipped"
        np.testing.assert_allclose(
            bench.v_at(first, len(u)), u - bench.kp * theta + added, atol=3 * bench.step
        )

    def test_its_feedback_starts_from_zero_state_after_zero(self, bench: Bench) -> None:
        loop = bench.feedback()
        if not bench.takes(loop):
            pytest.skip("runs no feedback and says so")
        bench.start(bench.wave(0.5) + bench.size)
        bench.wait(0.3)
        bench.zero()
        bench.wait(0.1)
        assert bench.v[-1] == 0.0
        assert bench.takes(loop)
        bench.wait(0.1)
        assert bench.v[-1] == 0.0
        first, u = bench.play(np.zeros(round(0.1 * self.rig.rate_hz)))
        theta = bench.at(first, len(u), bench.sensor)
        np.testing.assert_allclose(
            bench.v_at(first, len(u)),
            -bench.kp * theta + bench.filtered(loop, theta),
            atol=3 * bench.step,
        )

    def test_its_deadman_ends_a_feedback_too(self, bench: Bench) -> None:
        deadman = bench.device.actuator.deadman
        if deadman is None or not bench.takes(bench.feedback()):
            pytest.skip("no deadman, or no feedback")
        first, u = bench.start(np.full(round(0.1 * self.rig.rate_hz), bench.size))
        bench.wait(0.1 + AHEAD + deadman + 0.5)
        end = first + len(u) + math.ceil(deadman * self.rig.rate_hz) + 1
        assert bench.v_at(first, len(u)).any()
        assert not bench.v[bench.sequence >= end].any()

    def test_it_refuses_a_feedback_of_a_sensor_that_it_does_not_have(self, bench: Bench) -> None:
        loop = bench.feedback()
        before = bench.device_now()
        for changes in ({"sensor": "no_such_sensor"}, {"actuator": "no_such_output"}):
            assert not bench.takes(loop.model_copy(update=changes))
        bench.wait(0.1)
        assert not bench.v[bench.sequence > before].any()

    # Ways to zero

    def test_zero_is_zero_from_then_on(self, bench: Bench) -> None:
        bench.configure(bench.kp)
        bench.start(bench.wave(1.0) + bench.size)
        bench.wait(0.2)
        assert bench.v[-1] != 0.0
        bench.zero()
        at = bench.device_now()
        bench.wait(0.3)
        flight = math.ceil(FLIGHT * self.rig.rate_hz)
        assert not bench.v[bench.sequence > at + flight].any()

    def test_zero_may_be_called_at_any_time_and_twice(self, bench: Bench) -> None:
        for _ in range(2):
            bench.zero()
        bench.configure(bench.kp)
        bench.zero()
        bench.start(bench.wave(0.5))
        bench.wait(0.1)
        for _ in range(2):
            bench.zero()
        bench.wait(0.2)
        assert bench.v[-1] == 0.0

    def test_after_zero_it_can_be_used_again(self, bench: Bench) -> None:
        bench.configure(0.0)
        bench.start(bench.wave(0.5))
        bench.wait(0.1)
        bench.zero()
        bench.configure(0.0)
        first, u = bench.play(bench.wave(0.2))
        np.testing.assert_allclose(bench.v_at(first, len(u)), u, atol=bench.step)

    def test_its_deadman_drops_the_output_by_itself(self, bench: Bench) -> None:
        deadman = bench.device.actuator.deadman
        if deadman is None:
            pytest.skip("declares no deadman; the gate never arms it")
        bench.configure(bench.kp)
        first, u = bench.start(np.full(round(0.1 * self.rig.rate_hz), bench.size))
        bench.wait(0.1 + AHEAD + deadman + 0.5)
        end = first + len(u) + math.ceil(deadman * self.rig.rate_hz) + 1
        assert bench.v_at(first, len(u)).any()
        assert not bench.v[bench.sequence >= end].any()

    def test_closing_ends_at_zero(self, bench: Bench) -> None:
        bench.configure(bench.kp)
        bench.start(bench.wave(0.5) + bench.size)
        bench.wait(0.1)
        bench.device.close()
        bench.device.close()

    # Its own limits

    def test_it_keeps_the_output_limit_and_says_so(self, bench: Bench) -> None:
        bench.configure(0.0, max_output=bench.size / 2)
        first, u = bench.play(bench.wave(0.2))
        v = bench.v_at(first, len(u))
        assert np.abs(v).max() <= bench.size / 2 + bench.step
        flags = bench.flags_at(first, len(u))
        over = np.abs(u) > bench.size / 2 + bench.step
        assert over.any()
        assert (flags[over] & Quality.LIMITED).all()

    def test_it_keeps_the_rate_limit_and_says_so(self, bench: Bench) -> None:
        rate = bench.size * self.rig.rate_hz / 4
        bench.configure(0.0, max_rate=rate)
        u = np.concatenate((np.zeros(4), np.full(20, bench.size), np.zeros(20)))
        first, _ = bench.play(u)
        v = bench.v_at(first, len(u))
        assert np.abs(np.diff(v)).max() <= rate / self.rig.rate_hz + 2 * bench.step
        assert (bench.flags_at(first, len(u)) & Quality.LIMITED).any()

    def test_it_drops_to_zero_beyond_the_angle_limit(self, bench: Bench) -> None:
        bench.configure(0.0)
        bench.play(np.full(round(0.3 * self.rig.rate_hz), bench.size))
        reached = float(np.abs(bench.column(bench.sensor)).max())
        bench.zero()
        bench.configure(0.0, max_angle=reached / 4)
        first, u = bench.play(np.full(round(0.3 * self.rig.rate_hz), bench.size))
        assert reached > 0.0
        assert bench.v_at(first, len(u))[-1] == 0.0
        assert bench.flags_at(first, len(u))[-1] & Quality.LIMITED

    def test_it_takes_no_new_limits_while_the_output_is_live(self, bench: Bench) -> None:
        bench.configure(0.0)
        bench.start(np.full(round(0.5 * self.rig.rate_hz), bench.size))
        bench.wait(0.2)
        assert bench.v[-1] != 0.0
        with pytest.raises(DeviceError):
            bench.configure(0.0)

    # What it is given

    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_what_is_not_a_number_never_comes_out(self, bench: Bench, value: float) -> None:
        bench.configure(0.0)
        u = np.array([0.0, value, 0.0])
        with contextlib.suppress(DeviceError):
            bench.start(u)
        bench.wait(0.2)
        assert np.isfinite(bench.v).all()
        assert not bench.v.any()

    def test_samples_that_come_too_late_do_not_come_out_later(self, bench: Bench) -> None:
        bench.configure(0.0)
        bench.wait(0.1)
        late = CommandBlock(bench.device_now() - 30, np.full(10, bench.size), np.zeros(10))
        with contextlib.suppress(DeviceError):
            bench.device.actuator.write(late)
        bench.wait(0.2)
        assert not bench.v.any()


class Bench:
    """A device, and every sample that it gave."""

    def __init__(self, rig: Rig, device: OpenRig, level: float) -> None:
        self.rig, self.device = rig, device
        name = device.actuator.name
        self.spec = next(a for a in rig.actuator if a.name == name)
        self.sensor = rig.centring.sensor if rig.centring else rig.sensor[0].name
        self.kp = rig.centring.kp if rig.centring else 0.0
        self.limits: GateLimits = gate_limits(rig, name, self.kp, self.sensor)
        self.step = max(self.spec.resolution, 1e-9)  # how well the output can be set
        self.size = level * self.limits.output.max
        self.blocks: list[SampleBlock] = []
        self.first = 0  # of what is being sent, and how much of it was
        self.sent = 0
        self.u = self.theta_ref = np.zeros(0)
        self.wait(0.05)

    def configure(self, kp: float, feedback: tuple[Feedback, ...] = (), **changes: float) -> None:
        loop = self.limits.device_loop()
        numbers = {
            "max_output": loop.max_output,
            "max_rate": loop.max_rate,
            "max_angle": loop.max_angle,
            **changes,
        }
        self.device.actuator.configure(DeviceLoop(self.sensor, kp, **numbers, feedback=feedback))

    def feedback(self) -> Feedback:
        """A low-pass from the centring sensor that is clipped at a quarter of `size`."""
        corner = 2 * np.pi * self.rig.rate_hz / 50
        unit = next(s.unit for s in self.rig.sensor if s.name == self.sensor)
        most = max(self.size / 4, 8 * self.step)
        return Feedback(
            name="kit",
            sensor=self.sensor,
            actuator=self.spec.name,
            gain=-FEEDBACK * corner * self.size / self.reached(),
            unit=f"{self.spec.unit}/({unit})",
            poles=(-corner,),
            max=most,
        )

    def reached(self) -> float:
        """How far the centring sensor goes when the output is `wave`, centred."""
        self.configure(self.kp)
        first, u = self.play(self.wave(0.4))
        self.zero()
        self.wait(0.1)
        return float(np.abs(self.at(first, len(u), self.sensor)).max())

    def takes(self, loop: Feedback) -> bool:
        """Whether the device can run this loop beside its centring; it is then configured."""
        try:
            self.configure(self.kp, (loop,))
        except DeviceError:
            return False
        return True

    def filtered(self, loop: Feedback, y: Float) -> Float:
        """What the loop adds to the output, from zero state."""
        sos = np.insert(sections(loop, self.rig.rate_hz), 3, 1.0, axis=1)
        return np.clip(signal.sosfilt(sos, y), -loop.max, loop.max)

    def wait(self, seconds: float) -> None:
        """Let time pass and keep what arrives."""
        clock = self.device.clock
        # A late tick must not starve the deadman; simulated time is never late.
        tick = 0.02 if self.device.metadata.get("clock") == "simulated" else 0.005
        until = clock.now() + round(seconds * 1e9)
        while clock.now() < until:
            clock.sleep(min(tick, (until - clock.now()) * 1e-9))
            self.blocks.append(self.device.sensor.read())
            if self.sent < len(self.u):
                self.feed(tick)

    def feed(self, tick: float) -> None:
        """Send on what is due, as the loop does: a deadman may count from the last of it."""
        ahead = math.ceil((AHEAD + tick) * self.rig.rate_hz)
        part = slice(self.sent, max(self.device_now() + ahead - self.first, self.sent))
        block = CommandBlock(self.first + self.sent, self.u[part], self.theta_ref[part])
        self.sent += len(block)
        if len(block):
            self.device.actuator.write(block)

    def device_now(self) -> int:
        """Number of the newest sample."""
        return int(self.sequence[-1])

    def wave(self, seconds: float) -> Float:
        """(n,) one period of a sine that starts and ends at zero."""
        n = round(seconds * self.rig.rate_hz)
        return self.size * np.sin(2 * np.pi * np.arange(n) / n)

    def start(self, u: Float, theta_ref: Float | None = None) -> tuple[int, Float]:
        """Send a reference for a moment a little ahead; its first sample. `wait` sends it on."""
        self.first, self.sent = self.device_now() + math.ceil(AHEAD * self.rig.rate_hz), 0
        self.u, self.theta_ref = u, np.zeros_like(u) if theta_ref is None else theta_ref
        self.feed(0.02)
        return self.first, u

    def zero(self) -> None:
        """Zero, and nothing more is sent."""
        self.u = self.theta_ref = np.zeros(0)
        self.device.actuator.zero()

    def play(self, u: Float, theta_ref: Float | None = None) -> tuple[int, Float]:
        """Send a reference, and rest after it, and wait until it is over."""
        rest = np.zeros(math.ceil(2 * AHEAD * self.rig.rate_hz))
        ref = np.zeros_like(u) if theta_ref is None else theta_ref
        first, _ = self.start(np.concatenate((u, rest)), np.concatenate((ref, rest)))
        self.wait(len(u) / self.rig.rate_hz + AHEAD + 0.04)
        return first, u

    def column(self, name: str) -> Float:
        i = [c.name for c in self.device.sensor.channels].index(name)
        return np.concatenate([b.values[:, i] for b in self.blocks])

    @property
    def v(self) -> Float:
        return self.column(self.spec.name)

    @property
    def sequence(self) -> np.ndarray:
        return np.concatenate([b.sequence for b in self.blocks])

    @property
    def time(self) -> np.ndarray:
        return np.concatenate([b.time for b in self.blocks])

    def at(self, first: int, n: int, name: str) -> Float:
        inside = (self.sequence >= first) & (self.sequence < first + n)
        assert inside.sum() == n
        return self.column(name)[inside]

    def v_at(self, first: int, n: int) -> Float:
        return self.at(first, n, self.spec.name)

    def flags_at(self, first: int, n: int) -> np.ndarray:
        i = [c.name for c in self.device.sensor.channels].index(self.spec.name)
        flags = np.concatenate([b.quality[:, i] for b in self.blocks])
        return flags[(self.sequence >= first) & (self.sequence < first + n)]
