"""What every device with several outputs must do, as tests; see `contract` for one output.

In a driver's own test file:

    from contract_several import OutputsContract

    class TestMyDevice(OutputsContract):
        rig = load_rig("mine")[0]

        def open(self) -> OpenRig:
            return open_my_device(self.rig, {})

What ends one output must end all of them, in the same sample, whichever it is.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import numpy as np
import pytest

from samii_rig.devices.protocols import Actuators, Clock, CommandBlock, DeviceLoop, OpenRig, Sensor
from samii_rig.errors import DeviceError
from samii_rig.rig.schema import Rig
from samii_rig.run.outputs import at_rest, plan_limits
from samii_rig.run.plan import Plan
from samii_rig.types import Float, Quality, SampleBlock

AHEAD = 0.15  # s between a reference and its first sample; a loaded machine may be late
FLIGHT = 0.03  # s for which samples from before a command may still arrive after it
BOTH = [0, 1]  # which of its first two outputs is at fault


class OutputsContract:
    """The kit; subclass it, set `rig`, define `open`."""

    rig: Rig
    level = 0.05  # of the largest output

    def open(self) -> OpenRig:
        """The device, opened and at rest."""
        raise NotImplementedError

    @pytest.fixture
    def bench(self) -> Iterator[OutputsBench]:
        device = self.open()
        yield OutputsBench(self.rig, device, self.level)
        device.close()

    # What it is

    def test_it_has_the_protocols(self, bench: OutputsBench) -> None:
        assert isinstance(bench.device.actuator, Actuators)
        assert isinstance(bench.device.sensor, Sensor)
        assert isinstance(bench.device.clock, Clock)

    def test_its_outputs_are_those_of_the_rig_file_in_its_order(self, bench: OutputsBench) -> None:
        assert bench.actuators.names == tuple(a.name for a in self.rig.actuator)
        told = {c.name: (c.role, c.unit) for c in bench.device.sensor.channels}
        for a in self.rig.actuator:
            assert told[a.name] == ("command", a.unit)

    def test_its_deadman_is_no_longer_than_that_of_any_output(self, bench: OutputsBench) -> None:
        assert bench.actuators.deadman == min(a.deadman for a in self.rig.actuator)

    # Outputs

    def test_they_are_at_zero_until_something_is_written(self, bench: OutputsBench) -> None:
        bench.configure()
        bench.wait(0.2)
        assert not bench.v.any()

    def test_each_reference_comes_out_of_its_own_output(self, bench: OutputsBench) -> None:
        bench.configure(0.0)
        u = np.stack([(1 - 2 * j) * bench.wave(0.2, j) for j in range(bench.k)], axis=1)
        first = bench.play(u)
        np.testing.assert_allclose(bench.v_at(first, len(u)), u, atol=bench.step)

    def test_each_loop_closes_on_its_own_angle(self, bench: OutputsBench) -> None:
        bench.configure(1.0)
        u = np.stack([bench.wave(0.3, j) for j in range(bench.k)], axis=1)
        first = bench.play(u)
        v = bench.v_at(first, len(u))
        for j, output in enumerate(bench.outputs):
            theta = bench.at(first, len(u), output.centring_sensor)
            np.testing.assert_allclose(v[:, j], u[:, j] - output.kp * theta, atol=2 * bench.step)

    def test_each_loop_follows_its_own_set_point(self, bench: OutputsBench) -> None:
        if not all(o.kp for o in bench.outputs):
            pytest.skip("it closes no loop")
        bench.configure(1.0)
        ref = np.stack(
            [bench.wave(0.3, j) / o.kp * (1 + j) / bench.k for j, o in enumerate(bench.outputs)],
            axis=1,
        )
        first = bench.play(0.0 * ref, ref)
        v = bench.v_at(first, len(ref))
        for j, output in enumerate(bench.outputs):
            theta = bench.at(first, len(ref), output.centring_sensor)
            wanted = output.kp * (ref[:, j] - theta)
            np.testing.assert_allclose(v[:, j], wanted, atol=2 * bench.step)

    # Ways to zero, of all

    def test_zero_is_zero_of_all_from_then_on(self, bench: OutputsBench) -> None:
        bench.live()
        bench.zero()
        at = int(bench.sequence[-1])
        bench.wait(0.3)
        after = bench.sequence > at + math.ceil(FLIGHT * self.rig.rate_hz)
        assert after.any()
        assert not bench.v[after].any()

    def test_zero_may_be_called_at_any_time_and_twice(self, bench: OutputsBench) -> None:
        for _ in range(2):
            bench.zero()
        bench.live()
        for _ in range(2):
            bench.zero()
        bench.wait(0.2)
        assert not bench.v[-1].any()

    def test_the_deadman_drops_all_by_itself_in_one_sample(self, bench: OutputsBench) -> None:
        deadman = bench.actuators.deadman
        bench.configure(1.0)
        u = np.tile(bench.size, (round(0.1 * self.rig.rate_hz), 1))
        first = bench.start(u)
        bench.wait(0.1 + AHEAD + deadman + 0.5)
        last = [int(bench.sequence[np.flatnonzero(v)[-1]]) for v in bench.v.T]
        assert len(set(last)) == 1
        assert last[0] < first + len(u) + math.ceil(deadman * self.rig.rate_hz) + 1

    @pytest.mark.parametrize("pushed", BOTH)
    def test_an_angle_beyond_its_limit_drops_all_in_one_sample(
        self, bench: OutputsBench, pushed: int
    ) -> None:
        bench.configure(0.0)
        n = round(0.3 * self.rig.rate_hz)
        u = np.tile(bench.size, (n, 1))
        bench.play(u)
        sensor = bench.outputs[pushed].centring_sensor
        reached = float(np.abs(bench.column(sensor)).max())
        assert reached > 0.0
        bench.zero()
        bench.wait(0.1)
        angles = [math.inf] * bench.k
        angles[pushed] = reached / 4
        bench.configure(0.0, max_angle=angles)
        before = len(bench.sequence)
        bench.play(u)
        v = bench.v[before:]
        last = [int(np.flatnonzero(x)[-1]) for x in v.T if x.any()]
        assert len(set(last)) <= 1
        assert not v[-1].any()
        assert (bench.flags[-1] & Quality.LIMITED).all()

    def test_closing_ends_all_at_zero(self, bench: OutputsBench) -> None:
        bench.live()
        bench.device.close()
        bench.device.close()

    # Own limits

    @pytest.mark.parametrize("limited", BOTH)
    def test_each_keeps_its_own_output_limit_and_says_so(
        self, bench: OutputsBench, limited: int
    ) -> None:
        most = [one.output.max for one in bench.limits]
        most[limited] = bench.size[limited] / 2
        bench.configure(0.0, max_output=most)
        u = np.stack([bench.wave(0.2, j) for j in range(bench.k)], axis=1)
        first = bench.play(u)
        v, flags = bench.v_at(first, len(u)), bench.flags_at(first, len(u))
        assert np.abs(v[:, limited]).max() <= most[limited] + bench.step
        over = np.abs(u[:, limited]) > most[limited] + bench.step
        assert (flags[over, limited] & Quality.LIMITED).all()
        free = [j for j in range(bench.k) if j != limited]
        np.testing.assert_allclose(v[:, free], u[:, free], atol=bench.step)

    @pytest.mark.parametrize("limited", BOTH)
    def test_each_keeps_its_own_rate_limit(self, bench: OutputsBench, limited: int) -> None:
        rates = [math.inf] * bench.k
        rates[limited] = bench.size[limited] * self.rig.rate_hz / 4
        bench.configure(0.0, max_rate=rates)
        shape = np.concatenate((np.zeros(4), np.ones(20), np.zeros(20)))
        u = shape[:, None] * bench.size
        first = bench.play(u)
        v = bench.v_at(first, len(u))
        steps = np.abs(np.diff(v, axis=0)).max(axis=0)
        assert steps[limited] <= rates[limited] / self.rig.rate_hz + 2 * bench.step
        free = [j for j in range(bench.k) if j != limited]
        np.testing.assert_allclose(v[:, free], u[:, free], atol=bench.step)

    def test_they_take_no_new_limits_while_one_is_live(self, bench: OutputsBench) -> None:
        for live in BOTH:
            bench.zero()
            bench.wait(0.1)
            bench.configure(0.0)
            u = np.zeros((round(0.5 * self.rig.rate_hz), bench.k))
            u[:, live] = bench.size[live]
            bench.start(u)
            bench.wait(0.2)
            assert bench.v[-1, live] != 0.0
            with pytest.raises(DeviceError):
                bench.configure(0.0)

    def test_they_refuse_loops_that_are_not_one_for_each(self, bench: OutputsBench) -> None:
        loops = bench.loops(1.0)
        with pytest.raises(DeviceError):
            bench.actuators.configure(loops[:1])
        bench.wait(0.1)
        assert not bench.v.any()

    # What they are given

    @pytest.mark.parametrize("place", BOTH)
    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_what_is_not_a_number_comes_out_of_none(
        self, bench: OutputsBench, place: int, value: float
    ) -> None:
        bench.configure(0.0)
        u = np.zeros((3, bench.k))
        u[1, place] = value
        with contextlib.suppress(DeviceError):
            bench.start(u)
        bench.u = np.zeros((0, bench.k))
        bench.wait(0.2)
        assert np.isfinite(bench.v).all()
        assert not bench.v.any()

    def test_references_of_different_samples_come_out_of_none(self, bench: OutputsBench) -> None:
        bench.configure(0.0)
        first, x = int(bench.sequence[-1]) + math.ceil(AHEAD * self.rig.rate_hz), np.ones(5)
        blocks = tuple(CommandBlock(first + j, bench.size[j] * x, 0.0 * x) for j in range(bench.k))
        with pytest.raises(DeviceError):
            bench.actuators.write(blocks)
        bench.wait(0.4)
        assert not bench.v.any()


class OutputsBench:
    """A device with k outputs, and every sample that it gave."""

    def __init__(self, rig: Rig, device: OpenRig, level: float) -> None:
        self.rig, self.device = rig, device
        assert isinstance(device.actuator, Actuators)
        self.actuators = device.actuator
        self.outputs = tuple(at_rest(rig, a.name) for a in rig.actuator)
        first, *beside = self.outputs
        plan = Plan("kit", rig.rate_hz, *_parts(first), (), 0, tuple(beside))
        self.limits = plan_limits(plan, rig)
        self.k = len(self.outputs)
        self.step = max(*(a.resolution for a in rig.actuator), 1e-9)
        self.size = np.array([level * one.output.max for one in self.limits])
        self.blocks: list[SampleBlock] = []
        self.first = self.sent = 0
        self.u = self.theta_ref = np.zeros((0, self.k))
        self.wait(0.05)

    def loops(self, scale: float, **changes: list[float]) -> tuple[DeviceLoop, ...]:
        """Of the rig's own kp times `scale`; changes : a number for each output."""
        made = []
        for j, one in enumerate(self.limits):
            own = one.device_loop()
            numbers = {
                "max_output": own.max_output,
                "max_rate": own.max_rate,
                "max_angle": own.max_angle,
                **{name: values[j] for name, values in changes.items()},
            }
            made.append(DeviceLoop(own.sensor, scale * own.kp, **numbers))
        return tuple(made)

    def configure(self, scale: float = 1.0, **changes: list[float]) -> None:
        self.actuators.configure(self.loops(scale, **changes))

    def wait(self, seconds: float) -> None:
        """Let time pass, keep what arrives, send on what is due."""
        clock = self.device.clock
        tick = 0.02 if self.device.metadata.get("clock") == "simulated" else 0.005
        until = clock.now() + round(seconds * 1e9)
        while clock.now() < until:
            clock.sleep(min(tick, (until - clock.now()) * 1e-9))
            self.blocks.append(self.device.sensor.read())
            if self.sent < len(self.u):
                self.feed(tick)

    def feed(self, tick: float) -> None:
        ahead = math.ceil((AHEAD + tick) * self.rig.rate_hz)
        upto = max(int(self.sequence[-1]) + ahead - self.first, self.sent)
        part = slice(self.sent, upto)
        blocks = tuple(
            CommandBlock(self.first + self.sent, self.u[part, j], self.theta_ref[part, j])
            for j in range(self.k)
        )
        self.sent += len(blocks[0])
        if len(blocks[0]):
            self.actuators.write(blocks)

    def wave(self, seconds: float, place: int) -> Float:
        """(n,) one period of a sine that starts and ends at zero."""
        n = round(seconds * self.rig.rate_hz)
        return self.size[place] * np.sin(2 * np.pi * np.arange(n) / n)

    def start(self, u: Float, theta_ref: Float | None = None) -> int:
        """Send references (n, k) for a moment a little ahead; the first sample."""
        self.first = int(self.sequence[-1]) + math.ceil(AHEAD * self.rig.rate_hz)
        self.sent = 0
        self.u, self.theta_ref = u, np.zeros_like(u) if theta_ref is None else theta_ref
        self.feed(0.02)
        return self.first

    def play(self, u: Float, theta_ref: Float | None = None) -> int:
        """Send references, and rest after them, and wait until they are over."""
        rest = np.zeros((math.ceil(2 * AHEAD * self.rig.rate_hz), self.k))
        ref = np.zeros_like(u) if theta_ref is None else theta_ref
        first = self.start(np.concatenate((u, rest)), np.concatenate((ref, rest)))
        self.wait(len(u) / self.rig.rate_hz + AHEAD + 0.04)
        return first

    def live(self) -> None:
        """All outputs away from zero."""
        self.configure(1.0)
        self.start(np.tile(self.size, (round(self.rig.rate_hz), 1)))
        self.wait(0.3)
        assert self.v[-1].all()

    def zero(self) -> None:
        """Zero, and nothing more is sent."""
        self.u = self.theta_ref = np.zeros((0, self.k))
        self.actuators.zero()

    def column(self, name: str) -> Float:
        i = [c.name for c in self.device.sensor.channels].index(name)
        return np.concatenate([b.values[:, i] for b in self.blocks])

    @property
    def v(self) -> Float:
        """(n, k)."""
        return np.stack([self.column(o.actuator) for o in self.outputs], axis=1)

    @property
    def flags(self) -> np.ndarray:
        names = [c.name for c in self.device.sensor.channels]
        at = [names.index(o.actuator) for o in self.outputs]
        return np.concatenate([b.quality[:, at] for b in self.blocks])

    @property
    def sequence(self) -> np.ndarray:
        return np.concatenate([b.sequence for b in self.blocks])

    def _inside(self, first: int, n: int) -> np.ndarray:
        inside = (self.sequence >= first) & (self.sequence < first + n)
        assert inside.sum() == n
        return inside

    def at(self, first: int, n: int, name: str) -> Float:
        return self.column(name)[self._inside(first, n)]

    def v_at(self, first: int, n: int) -> Float:
        return self.v[self._inside(first, n)]

    def flags_at(self, first: int, n: int) -> np.ndarray:
        return self.flags[self._inside(first, n)]


def _parts(output) -> tuple[str, float, str]:
    return output.actuator, output.kp, output.centring_sensor
