"""A dwell that is left early: whatever is sent, and whenever enough is known, no sample that was
sent changes, nothing steps that did not step in the plan, and the dry run has looked at it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_device import RATE, FakeDevice, fake_rig
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_kit import Memory, after

from experiments.stepped_sine import SteppedSine
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.run.client import Client
from samii_rig.run.dryrun import predict
from samii_rig.run.dwell import MIXED, Reference, Watch, check_segments, ways
from samii_rig.run.loop import run
from samii_rig.run.pace import LoopSettings
from samii_rig.run.plan import Dwell, Plan, PlannedSegment
from samii_rig.types import Quality, SampleBlock
from sim.rig import open_rig

RIG = fake_rig()
KP = 4.0
FREQUENCIES = (2.0, 3.0, 5.0, 7.3, 11.0, 17.0, 24.0, 31.0)


def plan_of(frequencies=(2.0, 5.0, 11.0), rig=RIG, **changes) -> Plan:
    given_ = {
        "experiment": "stepped_sine", "name": "steps", "unit": "V",
        "actuator": rig.actuator[0].name, "frequencies": frequencies, "amplitudes": [0.5],
        "settle": 0.2, "ramp": 0.1, "block": 0.25, "least": 5, "most": 3.0, "wanted": 0.05,
    }  # fmt: skip
    return SteppedSine.model_validate({**given_, **changes}).plan(rig)


def steepest(u, theta_ref) -> float:
    """Largest step from sample to sample, from rest and back to it."""
    return max(float(np.abs(np.diff(x, prepend=0.0, append=0.0)).max()) for x in (u, theta_ref))


# The reference, sample by sample


@settings(max_examples=20)
@given(
    frequencies=st.lists(st.sampled_from(FREQUENCIES), min_size=1, max_size=2, unique=True),
    drive=st.sampled_from(["output", "reference"]),
    ahead=st.integers(1, 125),
    seed=st.integers(0, 2**32 - 1),
)
def test_what_was_sent_never_changes_and_nothing_steps(frequencies, drive, ahead, seed):
    """The watch is fed blocks of any length, with losses, while any number of samples is ahead."""
    unit = {"output": "V", "reference": "rad"}[drive]
    plan = plan_of(tuple(frequencies), drive=drive, unit=unit, wanted=0.5, most=2.5)
    rng = np.random.default_rng(seed)
    reference = Reference(plan)
    watch = Watch(reference, FakeDevice.channels, "v")
    start, newest, sent = int(rng.integers(0, 1000)), 0, 0
    wire = np.zeros((2, len(reference.u)))
    left = 0
    while newest < len(reference.u):
        upto = min(newest + ahead, len(reference.u))
        wire[:, sent:upto] = reference.u[sent:upto], reference.theta_ref[sent:upto]
        sent = max(sent, upto)
        n = int(min(rng.integers(1, 120), sent - newest, len(reference.u) - newest))
        at = np.arange(newest, newest + n)
        drive_ = wire[0, at] + KP * wire[1, at]
        # Any response will do; some noise so that it takes a while to be known.
        values = np.column_stack([drive_, 0.3 * drive_ + 0.2 * rng.standard_normal(n)])
        quality = np.where(rng.random((n, 2)) < 1e-3, Quality.MISSING, 0).astype(np.uint8)
        time = (at + start) * 2_000_000
        block = SampleBlock(FakeDevice.channels, time, at + start, values, quality)
        newest += n
        left += watch.take(block, start, sent) is not None
        assert np.array_equal(wire[0, :sent], reference.u[:sent])
        assert np.array_equal(wire[1, :sent], reference.theta_ref[:sent])
    assert sent == len(reference.u) == reference.ends[-1]
    assert left <= len(plan.segments)
    assert steepest(reference.u, reference.theta_ref) <= steepest(
        np.concatenate([s.u for s in plan.segments]),
        np.concatenate([s.theta_ref for s in plan.segments]),
    ) * (1 + 1e-9)
    for s, planned in zip(reference.segments, plan.segments, strict=True):
        gone = len(planned.u) - len(s.u)
        assert gone % planned.dwell.block == 0
        assert len(s.u) - (len(planned.u) - planned.dwell.last) >= (
            planned.dwell.first + planned.dwell.least * planned.dwell.block
        )
        assert s.recorded == (planned.recorded[0], planned.recorded[1] - gone)


class Fast(FakeDevice):
    """A fake device whose sensor has noise: a response of 5 % takes about ten blocks."""

    def __init__(self, sd, seed):
        super().__init__()
        rng = np.random.default_rng(seed)
        self.noise = lambda: sd * rng.standard_normal()


@settings(max_examples=8)
@given(
    sd=st.floats(1e-6, 3e-2),
    seed=st.integers(0, 1000),
    tick=st.floats(0.005, 0.024),
    ahead=st.floats(0.05, 0.1),
)
def test_a_run_sends_one_row_without_a_step_whenever_its_dwells_are_left(sd, seed, tick, ahead):
    plan = plan_of((5.0, 11.0), most=2.5)
    device, sink = Fast(sd, seed), Memory()
    stop = run(plan, RIG, device.open(), sink, settings=LoopSettings(tick=tick, ahead=ahead))
    assert stop.status == "completed", stop
    firsts, ends = zip(*((b.first, b.first + len(b)) for b in device.written), strict=True)
    assert firsts[1:] == ends[:-1]
    wire = np.concatenate([b.u for b in device.written])
    whole = np.concatenate([s.u for s in plan.segments])
    assert steepest(wire, 0 * wire) <= steepest(whole, 0 * whole) * (1 + 1e-9)
    # What the recording holds beside the samples is what was on the wire.
    sequence, u = sink.column("sequence"), sink.column("u")
    sent = np.zeros_like(u)
    inside = (sequence >= firsts[0]) & (sequence < ends[-1])
    sent[inside] = wire[sequence[inside] - firsts[0]]
    np.testing.assert_array_equal(u, sent)
    assert not device.live


@pytest.mark.parametrize("seed", range(6))
def test_no_way_through_goes_beyond_what_the_dry_run_said(seed):
    """Dwells left anywhere, with far too little settling beside a mode that rings for a minute:
    with the longest and the shortest way alone peaks came out up to 22 % beyond."""
    rig, _ = load_rig("samii")
    plan = plan_of((1.5, 6.0, 6.2, 12.0), rig, settle=0.2, ramp=0.3, block=0.5, least=6, most=10.0)
    predicted = predict(plan, rig)
    limits = {(m.channel, m.what, m.reason): m.predicted for m in predicted.margins}
    draw = np.random.default_rng(1000 + seed)
    cut = []
    for s in plan.segments:
        blocks = int(draw.integers(s.dwell.least, s.dwell.blocks + 1))
        cut.append(s.shortened(s.dwell.first + blocks * s.dwell.block))
    for m in predict(replace(plan, segments=tuple(cut)), rig).margins:
        assert m.predicted <= 1.03 * limits[m.channel, m.what, m.reason], m


def test_ways_are_the_longest_the_shortest_and_some_between_always_the_same():
    plan = plan_of()
    found = ways(plan)
    assert found[0] is plan
    assert len(found) == 2 + MIXED
    assert found[1].duration == plan.shortest.duration
    assert all(found[1].duration <= w.duration <= plan.duration for w in found)
    assert [w.duration for w in ways(plan)] == [w.duration for w in found]
    bare = replace(plan, segments=tuple(replace(s, dwell=None) for s in plan.segments))
    assert ways(bare) == (bare,)


# Dwells that must not be left, or cannot


def segment(u=None, theta_ref=None, recorded=(50, 450), **dwell) -> PlannedSegment:
    wave = np.sin(2 * np.pi * np.arange(500) / 40) if u is None else u
    values = {"first": 50, "last": 450, "block": 40, "cycles": 1, "least": 4, "outputs": ("theta",)}
    return PlannedSegment(
        "s", "periodic", 1.0, "V", 0, wave, np.zeros(500) if theta_ref is None else theta_ref,
        (12.5, 12.5), np.full(500, 12.5), recorded, Dwell(**{**values, "wanted": 0.05, **dwell}),
    )  # fmt: skip


def plan_with(s: PlannedSegment) -> Plan:
    return Plan("test", RATE, "v", KP, "theta", (s,), 0)


BENT = np.sin(2 * np.pi * np.arange(500) / 40)
BENT[300] += 1e-3
LOST = BENT.copy()
LOST[300] = np.nan


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"block": 41}, "dwell.block is 41; expected a divisor of the 400 samples"),
        ({"block": 0}, "dwell.block is 0"),
        ({"block": 50}, "the same in every block"),
        ({"u": BENT}, "the same in every block"),
        ({"u": LOST}, "the same in every block"),
        ({"theta_ref": BENT}, "the same in every block"),
        ({"last": 510}, "dwell.last"),
        ({"first": -30}, "dwell.last"),
        ({"first": 450}, "dwell.last"),
        ({"least": 1}, "dwell.least is 1; expected 2 to 10"),
        ({"least": 11}, "dwell.least is 11; expected 2 to 10"),
        ({"outputs": ()}, "at least one sensor"),
        ({"recorded": (51, 450)}, "inside what is recorded"),
        ({"recorded": (50, 449)}, "inside what is recorded"),
    ],
)
def test_a_dwell_that_would_leave_a_step_is_refused_before_anything_moves(wrong, said):
    plan = plan_with(segment(**wrong))
    device = FakeDevice()
    for refused in (
        lambda: check_segments(plan),
        lambda: ways(plan),
        lambda: predict(plan, RIG),
        lambda: run(plan, RIG, device.open(), Memory()),
    ):
        with pytest.raises(InputError, match=said) as one:
            refused()
        assert "\n" not in str(one.value)
    assert device.written == []


@pytest.mark.parametrize("row", ["u", "theta_ref", "frequency"])
@pytest.mark.parametrize("shape", [(499,), (500, 1), (0,)])
def test_rows_of_different_length_are_refused(row, shape):
    plan = plan_with(replace(segment(), **{row: np.zeros(shape)}))
    with pytest.raises(InputError, match="of one length"):
        predict(plan, RIG)
    with pytest.raises(InputError, match="of one length"):
        run(plan, RIG, FakeDevice().open(), Memory())


def test_a_plan_of_another_sample_rate_is_refused():
    with pytest.raises(InputError, match=r"rate_hz is 1000.0; expected 500, the rig's own"):
        predict(replace(plan_with(segment()), rate_hz=1000.0), RIG)


def watched(values, quality=None, first=0) -> tuple[Reference, object]:
    """The reference, and what the watch says, after all of these samples (n, 2) at once."""
    reference = Reference(plan_with(segment()))
    watch = Watch(reference, FakeDevice.channels, "v")
    at = np.arange(len(values)) + first
    flags = np.zeros(values.shape, np.uint8) if quality is None else quality
    block = SampleBlock(FakeDevice.channels, at * 2_000_000, at, values, flags)
    return reference, watch.take(block, 0, int(at[-1]) + 20)


SINE = np.column_stack([np.sin(2 * np.pi * np.arange(300) / 40)] * 2)


def test_a_response_without_scatter_leaves_its_dwell_behind_what_was_sent():
    reference, left = watched(SINE)
    assert (left.name, left.blocks) == ("s", 7)  # 319 samples were sent, 50 + 7 * 40 is next
    assert len(reference.u) == 500 - 3 * 40


@pytest.mark.parametrize("flag", [Quality.MISSING, Quality.MISSING | Quality.STALE])
@pytest.mark.parametrize("column", [0, 1])
def test_a_value_that_is_marked_missing_is_not_measured_although_a_number_stands_there(
    flag, column
):
    quality = np.zeros(SINE.shape, np.uint8)
    quality[::40, column] = flag
    reference, left = watched(SINE, quality)
    assert left is None
    assert len(reference.u) == 500


def test_an_output_that_never_moves_leaves_no_dwell_and_breaks_nothing():
    """A drive below half a step of the converter comes out as zero."""
    assert watched(np.zeros((400, 2)))[1] is None


@pytest.mark.parametrize("first", [-400, 480])
def test_samples_before_and_after_the_plan_are_no_ones_dwell(first):
    reference, left = watched(SINE, first=first)
    assert left is None
    assert len(reference.u) == 500


def test_a_dwell_of_whole_blocks_passes_and_a_segment_without_one_is_not_asked():
    check_segments(plan_with(segment()))
    check_segments(plan_with(segment(recorded=None)))
    check_segments(plan_with(replace(segment(), dwell=None, u=BENT)))


# Ways out, right after a dwell was left


class Leaving(Memory):
    """Calls `then` when the first dwell is left."""

    def __init__(self, then):
        super().__init__()
        self.then = then

    def event(self, time, name, payload):
        super().event(time, name, payload)
        if name == "dwell":
            self.then()


class Flag:
    set_ = False

    def is_set(self):
        return self.set_

    def set(self):
        self.set_ = True


def raises():
    raise DeviceError("cable out")


@pytest.mark.parametrize("how", ["stop", "recorder", "nan", "angle"])
def test_every_way_out_right_after_a_dwell_was_left_ends_at_zero(how):
    device, flag = Fast(1e-5, 0), Flag()
    quiet = device.spoil

    def spoil(block):
        block = quiet(block)
        if flag.is_set() and len(block):
            block.values[0, 1] = {"nan": np.nan, "angle": 0.5}[how]
        return block

    device.spoil = spoil if how in ("nan", "angle") else quiet
    sink = Leaving(raises if how == "recorder" else flag.set)
    stop = run(
        plan_of(), RIG, device.open(), sink, Client(stop=flag if how == "stop" else after(100.0))
    )
    wanted = {"stop": "stopped", "recorder": "failed"}.get(how, "tripped")
    assert stop.status == wanted, stop
    assert [name for name, _ in sink.events].count("dwell") == 1
    assert not device.live
    device.sleep(1.0)
    assert device.rows[-1][1] == 0.0


def test_on_the_simulated_rig_a_dwell_left_early_keeps_the_slew_that_was_predicted():
    rig, _ = load_rig("samii")
    plan = plan_of((12.0, 20.0), rig, settle=1.0, ramp=0.3, least=6, most=6.0)
    predicted = predict(plan, rig)
    sink = Memory()
    stop = run(plan, rig, open_rig(rig, {"seed": 1}), sink)
    assert stop.status == "completed"
    assert [name for name, _ in sink.events].count("dwell") == 2
    v = sink.column("v_2")
    step = rig.actuator[0].resolution + 2 * plan.kp * 5 * rig.sensor[0].noise_rms
    assert np.abs(np.diff(v)).max() <= predicted.slew / RATE + step
