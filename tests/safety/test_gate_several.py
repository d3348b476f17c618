"""The gate over two outputs: each is judged by itself, all are sent or none, and whatever is
wrong with one of them ends both at zero."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_device import FakeDevice, fake_rig
from fake_pair import NAMES, FakePair, pair_rig

from samii_rig.devices.protocols import CommandBlock
from samii_rig.errors import GateError, InputError
from samii_rig.rig.schema import AbsoluteAngle
from samii_rig.run.outputs import completed, plan_limits
from samii_rig.run.plan import Output, Plan
from samii_rig.safety.gate import Gate, GateEvent
from samii_rig.safety.judgement import State, Stop, Write, decide_all
from samii_rig.safety.latest import Latest
from samii_rig.safety.limits import gate_limits
from samii_rig.types import Quality, SampleBlock

RIG = pair_rig()
PLAN = Plan("p", RIG.rate_hz, "v_a", 4.0, "theta_a", (), 0, (Output("v_b", 2.0, "theta_b"),))
LIMITS = plan_limits(PLAN, RIG)
TICK = 0.02
COLUMN = {"v_a": 0, "v_b": 1, "theta_a": 2, "theta_b": 3}


class Pair:
    """A gate over the fake pair, driven tick by tick."""

    def __init__(self, limits=LIMITS, spoil=None) -> None:
        self.device, self.events = FakePair(spoil), list[GateEvent]()
        self.gate = Gate(self.device, limits, self.device.channels, self.events.append)
        self.next: int | None = None

    def tick(self, seconds=TICK) -> None:
        self.device.sleep(seconds)
        self.gate.observe(self.device.read(), self.device.now())

    def armed(self):
        self.tick()
        self.gate.arm(self.device.now())
        return self

    def running(self):
        self.armed().gate.start(self.device.now())
        return self

    def blocks(self, u=(1.0, 0.5), n=10, refs=(0.0, 0.0)):
        first = self.device.taken + 5 if self.next is None else self.next
        return tuple(
            CommandBlock(first, np.full(n, x), np.full(n, r)) for x, r in zip(u, refs, strict=True)
        )

    def write(self, *args, **kwargs) -> None:
        blocks = self.blocks(*args, **kwargs)
        self.gate.write(blocks, self.device.now())
        self.next = blocks[0].first + len(blocks[0])

    def drive(self, ticks, u=(1.0, 0.5), seconds=TICK) -> None:
        for _ in range(ticks):
            self.write(u)
            self.tick(seconds)

    def wait(self, ticks, seconds) -> None:
        for _ in range(ticks):
            self.tick(seconds)

    def moving(self):
        """Both outputs live, and seen to be."""
        self.running().drive(6)
        assert self.device.v.all()
        return self

    def refused(self, *words) -> None:
        """Both outputs at zero now and from now on, in FAULT, which says why."""
        assert self.gate.state is State.FAULT
        assert all(word in self.gate.fault for word in words), self.gate.fault
        self.at_zero()

    def at_zero(self) -> None:
        assert not self.device.live
        assert not self.device.v.any()
        self.device.sleep(0.2)
        self.device.rows.clear()
        self.device.sleep(0.2)
        assert not np.array(self.device.rows)[:, 1:3].any()


def test_both_outputs_move_and_stop_at_zero():
    pair = Pair().moving()
    assert [e.decision.state for e in pair.events] == [State.ARMED, State.RUNNING]
    assert [loop.sensor for loop in pair.device.loops] == ["theta_a", "theta_b"]
    assert [loop.kp for loop in pair.device.loops] == [4.0, 2.0]
    pair.gate.stop("done", pair.device.now())
    assert pair.gate.state is State.SAFE
    pair.at_zero()


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize(
    ("u", "word"), [(5.5, "limit of 5 V"), (np.nan, "not a number"), (np.inf, "not a number")]
)
def test_a_reference_that_one_output_may_not_have_reaches_neither(place, u, word):
    pair = Pair().moving()
    before = len(pair.device.written)
    both = [0.5, 0.5]
    both[place] = u
    with pytest.raises(GateError):
        pair.write(both)
    assert len(pair.device.written) == before
    pair.refused(NAMES[place], word)


@pytest.mark.parametrize("place", [0, 1])
def test_slew_is_judged_of_each_output(place):
    pair = Pair().moving()
    u = [1.0, 0.5]
    u[place] -= 4.05  # in one sample at 500 a second; the limit is 4 V
    with pytest.raises(GateError):
        pair.write(u)
    pair.refused(NAMES[place], "rate")


@pytest.mark.parametrize("place", [0, 1])
def test_a_set_point_beyond_its_own_sensors_limit_reaches_neither(place):
    pair = Pair().moving()
    refs = [0.0, 0.0]
    refs[place] = 0.36
    with pytest.raises(GateError):
        pair.write(refs=refs)
    pair.refused(f"theta_{'ab'[place]}", "set point")


@pytest.mark.parametrize("place", [0, 1])
def test_where_a_reference_would_turn_its_joint_is_judged_of_each(place):
    pair = Pair().running()
    before = len(pair.device.written)
    # 0.23 s of nearly 5 V, which it does not reach in one sample: to more than 0.42 rad.
    push, rest = np.full(115, 4.9), np.zeros(115)
    push[0] = 2.4
    first = pair.device.taken + 5
    blocks = [CommandBlock(first, rest, rest)] * 2
    blocks[place] = CommandBlock(first, push, rest)
    with pytest.raises(GateError, match=f"would turn theta_{'ab'[place]}"):
        pair.gate.write(tuple(blocks), pair.device.now())
    assert len(pair.device.written) == before
    pair.refused("would turn")


@pytest.mark.parametrize(
    ("blocks", "word"),
    [
        (lambda b: b[:1], "1 outputs; expected 2"),
        (lambda b: (), "0 outputs; expected 2"),
        (lambda b: (*b, b[0]), "3 outputs; expected 2"),
        (lambda b: (b[0], replace(b[1], first=b[1].first + 1)), "the same samples"),
        (lambda b: (b[0], replace(b[1], first=b[1].first - 1)), "the same samples"),
        (lambda b: (b[0], CommandBlock(b[1].first, b[1].u[1:], b[1].theta_ref[1:])), "the same"),
    ],
)
def test_a_reference_that_is_not_whole_reaches_no_output(blocks, word):
    pair = Pair().moving()
    before = len(pair.device.written)
    with pytest.raises(GateError):
        pair.gate.write(blocks(pair.blocks()), pair.device.now())
    assert len(pair.device.written) == before
    pair.refused(word)


FAULTS = ("not a number", "clipped", "too large", "stale")
OF_AN_OUTPUT = ("limited", "stray")


@pytest.mark.parametrize(
    ("channel", "fault"),
    [
        *((c, f) for c in COLUMN for f in FAULTS),
        *((c, f) for c in NAMES for f in OF_AN_OUTPUT),
    ],
)
def test_what_is_wrong_with_one_channel_ends_both_outputs(channel, fault):
    spoilt = False

    def spoil(block: SampleBlock) -> SampleBlock:
        if not spoilt:
            return block
        values, quality, i = block.values.copy(), block.quality.copy(), COLUMN[channel]
        match fault:
            case "not a number":
                values[:, i] = np.nan
            case "limited":
                quality[:, i] |= np.uint8(Quality.LIMITED)
            case "clipped":
                quality[:, i] |= np.uint8(Quality.CLIPPED)
            case "too large":
                values[:, i] = 5.1
            case "stale":
                quality[:, i] |= np.uint8(Quality.STALE)
            case "stray":
                values[:, i] += 0.06
        return replace(block, values=values, quality=quality)

    pair = Pair(spoil=spoil).moving()
    spoilt = True
    with pytest.raises(GateError, match=channel):
        pair.drive(10)
    pair.refused(channel)


@pytest.mark.parametrize("place", [0, 1])
def test_an_encoder_that_stands_still_while_its_output_moves_it_ends_both(place):
    pair = Pair().moving()
    pair.device.held[place] = float(pair.device.theta[place])
    u = [0.0, 0.0]
    u[place] = 0.6
    with pytest.raises(GateError):
        pair.drive(60, u, 0.0199)
    pair.refused(f"theta_{'ab'[place]} is stuck")


@pytest.mark.parametrize("place", [0, 1])
def test_an_encoder_may_stand_still_while_the_other_output_moves(place):
    pair = Pair().running()
    for i in range(40):
        u = [0.0, 0.0]
        u[place] = 0.5 * np.sin(i)
        pair.write(u, refs=[0.0, 0.0])
        pair.tick(0.0199)
    assert pair.gate.state is State.RUNNING
    assert pair.device.theta[1 - place] == 0.0


@pytest.mark.parametrize("state", ["safe", "armed", "fault"])
def test_only_running_lets_a_reference_through(state):
    pair = Pair()
    if state == "armed":
        pair.armed()
    else:
        pair.tick()
    if state == "fault":
        pair.gate.fail("broke", pair.device.now())
    with pytest.raises(GateError):
        pair.write()
    assert not pair.device.written
    pair.refused()


@pytest.mark.parametrize("where", ["read", "write", "configure"])
def test_a_device_that_raises_ends_both_outputs(where):
    def broken(*_):
        raise OSError("cable")

    pair = Pair()
    if where == "configure":
        pair.device.configure = broken
        pair.tick()
        with pytest.raises(OSError, match="cable"):
            pair.gate.arm(pair.device.now())
    elif where == "write":
        pair.moving()
        pair.device.write = broken
        with pytest.raises(OSError, match="cable"):
            pair.write()
    else:
        pair.moving()
        pair.device.spoil = lambda _: None
        with pytest.raises(Exception):  # noqa: B017, PT011 (whatever it is)
            pair.tick()
    pair.refused("failed")


@pytest.mark.parametrize("silent", [0.1, 0.3])
def test_silence_ends_both_outputs(silent):
    pair = Pair().moving()
    pair.device.silent = True
    with pytest.raises(GateError, match="nothing new"):
        pair.wait(20, silent / 10)
    pair.refused("v_a")


def test_without_a_deadman_two_outputs_are_not_armed():
    pair = Pair()
    pair.device.deadman = None
    pair.tick()
    with pytest.raises(GateError, match="declares no deadman"):
        pair.gate.arm(pair.device.now())
    assert not pair.device.loops
    assert pair.gate.state is State.SAFE


@pytest.mark.parametrize("place", [0, 1])
def test_arming_is_refused_while_one_angle_is_beyond_its_limit(place):
    pair = Pair()
    pair.device.theta[place] = 0.4
    pair.tick()
    with pytest.raises(GateError, match=f"theta_{'ab'[place]}"):
        pair.gate.arm(pair.device.now())
    assert not pair.device.loops
    assert pair.gate.state is State.SAFE


@pytest.mark.parametrize("place", [0, 1])
def test_arming_is_refused_while_one_output_is_not_at_zero(place):
    def spoil(block: SampleBlock) -> SampleBlock:
        values = block.values.copy()
        values[:, place] = 0.2
        return replace(block, values=values)

    pair = Pair(spoil=spoil)
    pair.tick()
    with pytest.raises(GateError, match=f"{NAMES[place]} read back"):
        pair.gate.arm(pair.device.now())
    assert not pair.device.loops


def test_a_clear_needs_new_samples_for_every_output():
    pair = Pair().moving()
    pair.gate.fail("looked wrong", pair.device.now())
    pair.gate.clear("Ada", "looked", pair.device.now())
    assert pair.gate.state is State.SAFE
    with pytest.raises(GateError, match="said nothing new"):
        pair.gate.arm(pair.device.now())


def test_a_client_that_falls_silent_ends_both_outputs():
    pair = Pair(plan_limits(PLAN, RIG, heartbeat_age=0.1))
    pair.gate.beat(pair.device.now())
    pair.running()
    with pytest.raises(GateError, match="no sign"):
        pair.drive(10)
    pair.refused("client")


def test_the_nearest_limit_is_that_of_any_output():
    pair = Pair().running()
    pair.drive(5, (0.5, 3.0))
    name, margin = pair.gate.margin()
    assert name == "v_b"
    assert margin == pytest.approx(1 - 3.0 / 5.0, abs=0.05)


@pytest.mark.parametrize(
    ("device", "limits"),
    [
        (FakePair(), LIMITS[:1]),
        (FakePair(), LIMITS[::-1]),
        (FakeDevice(), LIMITS),
    ],
)
def test_a_gate_holds_no_output_that_it_does_not_judge(device, limits):
    channels = FakePair.channels
    with pytest.raises(GateError, match="expected the same outputs in the same order"):
        Gate(device, limits, channels, lambda _: None)


def test_an_only_output_may_have_another_name_on_its_device():
    device = FakeDevice()
    assert device.name != LIMITS[0].output.channel
    Gate(device, LIMITS[0], FakePair.channels, lambda _: None)


def test_one_output_is_judged_as_it_is_alone():
    """What is decided of one output does not depend on how many there are."""
    latest, block = Latest.nothing(3), CommandBlock(5, np.zeros(3), np.zeros(3))
    limits = LIMITS[0]
    for state in State:
        for request in (Stop("x"), Write(block)):
            alone = decide_all(state, [request], [(latest, limits)], 0)
            both = decide_all(state, [request] * 2, [(latest, limits)] * 2, 0)
            told = both.reason.removeprefix("v_a: ")
            same = {"number": 0.0, "limit": 0.0}  # NaN is not equal to itself
            assert replace(both, reason=told, **same) == replace(alone, **same)


def absolute(rig):
    """The pair with theta_b measured against the ground: both outputs turn it."""
    (theta_b,) = (s for s in rig.sensor if s.name == "theta_b")
    data = theta_b.model_dump(exclude={"kind", "across"})
    ground = AbsoluteAngle(kind="absolute_angle", after="link_b", **data)
    sensors = tuple(ground if s.name == "theta_b" else s for s in rig.sensor)
    return rig.model_copy(update={"sensor": sensors})


def test_no_loop_centres_by_an_angle_that_another_output_turns_as_well():
    rig = absolute(RIG)
    gate_limits(rig, "v_b", 2.0, "theta_b")
    with pytest.raises(InputError, match="theta_b"):
        gate_limits(rig, "v_b", 2.0, "theta_b", beside=("v_a",))
    loose = gate_limits(rig, "v_b", 0.0, "theta_b", beside=("v_a",))
    assert loose.turning == 0.0
    (theta_b,) = (c for c in loose.sensors if c.channel == "theta_b")
    assert theta_b.stuck.gain == 0.0


def test_a_plan_for_one_output_lets_the_other_rest_in_its_own_loop():
    alone = Plan("p", RIG.rate_hz, "v_b", 1.0, "theta_b", (), 0)
    whole = completed(alone, RIG)
    assert whole.outputs == (Output("v_a", 4.0, "theta_a"), Output("v_b", 1.0, "theta_b"))
    assert completed(whole, RIG) is whole
    plan = Plan("p", 500.0, "v", 4.0, "theta", (), 0)
    assert completed(plan, fake_rig()) is plan
