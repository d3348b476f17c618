"""A node with several outputs: whatever happens to one of them, all end at null together."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from serial_desk_kit import Desk
from serial_frames_kit import raw
from serial_pair_kit import BOARD, BOOT, CONFIG, LOOPS, NULLS, PATIENCE, PLAIN, RIG, TICK, Joints

from drivers.serial_node.settings import read_settings
from drivers.serial_node.wire import (
    MAX_PAYLOAD,
    MOST_OUTPUTS,
    OVERHEAD,
    REPORTED,
    Answer,
    Code,
    Decoder,
    Flag,
    Hello,
    Samples,
    State,
    Type,
    configure_body,
    frame,
    stream_body,
)
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device
from samii_rig.types import Quality
from sim.wire.node import Node
from sim.wire.plant import board
from sim.wire.protocol import NodeConfig

BOTH = [0, 1]
LIMITS = {
    "encoder": 0,
    "adc_mask": 0,
    "kp_q16": 0,
    "max_output": 16000,
    "max_step": 16000,
    "max_angle": 30000,
    "max_jump": 1304,
    "centre": 0,
}


@pytest.fixture
def joints(monkeypatch):
    return Joints(monkeypatch.setattr)


def changed(**settings):
    device = Device(driver="serial_node", settings={**RIG.device.settings, **settings})
    return RIG.model_copy(update={"device": device})


# What passes


def test_each_output_follows_its_own_loop_in_its_own_unit(joints):
    joints.live()
    joints.drive(20)
    block = joints.blocks[-1]
    names = [c.name for c in block.channels]
    for name, angle, loop in zip(("v_2", "v_3"), ("theta_2", "theta_3"), LOOPS, strict=True):
        x = {n: block.values[:, names.index(n)] for n in (name, angle, f"u_{name}")}
        np.testing.assert_allclose(x[name], x[f"u_{name}"] - loop.kp * x[angle], atol=4e-4)
        assert np.abs(x[name]).min() > 0.1
    assert not block.quality.any()


def test_its_columns_are_those_of_the_simulated_rig(joints):
    from sim.rig import open_rig

    mine, other = joints.device.sensor.channels, open_rig(PLAIN, {}).sensor.channels
    assert [(c.name, c.unit, c.role) for c in mine] == [(c.name, c.unit, c.role) for c in other]


def test_what_a_node_says_of_its_outputs_is_read_back():
    (hello,) = Decoder().feed(Node(CONFIG, 7).transmit())
    assert isinstance(hello, Hello)
    assert hello.version == 2
    assert tuple(o.null for o in hello.outputs) == NULLS
    assert hello.sample_bytes == 2 * 9 + 2 * 4 + 3 * 2


# Ways to null, of all outputs


def test_a_host_that_dies_leaves_both_at_null_at_the_deadman_in_one_sample(joints):
    joints.live()
    fed = joints.node.fed
    out = joints.run(60)
    last = [max(i for i, v in enumerate(out) if v[j]) for j in BOTH]
    assert last[0] == last[1] == fed + PATIENCE - 2 - (joints.node.sample - 60)
    assert joints.node.state == State.DEAD


def test_a_queue_that_was_sent_ahead_of_both_dies_with_its_host(joints):
    joints.running()
    first = joints.node.sample + PATIENCE + 1
    blocks = tuple(CommandBlock(first, np.full(9, v), np.zeros(9)) for v in (0.1, 0.1))
    joints.device.actuator.write(blocks)
    assert not any(any(v) for v in joints.run(80))


@pytest.mark.parametrize("pushed", BOTH)
def test_an_output_that_is_not_what_it_was_told_ends_both(joints, pushed):
    joints.live()
    joints.node.stray = {pushed: 500}
    said = joints.refused(lambda: joints.drive(3))
    assert f"{('v_2', 'v_3')[pushed]} read back is 0.1" in said
    joints.node.stray = {}
    assert joints.ended(1) == 0


@pytest.mark.parametrize("limited", BOTH)
def test_an_output_that_the_node_limits_by_itself_ends_both(joints, limited):
    joints.live()
    joints.node.loops[limited].max_output = 100
    joints.refused(lambda: joints.drive(3))
    assert joints.ended(1) == 0


def test_a_node_that_restarts_is_at_null_and_what_the_old_run_sends_moves_nothing(joints):
    joints.live()
    joints.port.node = Node(CONFIG, BOOT + 1)
    assert not any(any(v) for v in joints.run(8))
    with pytest.raises(DeviceError, match="the node has rebooted"):
        joints.look()
    blocks = tuple(CommandBlock(joints.node.sample, np.ones(60), np.zeros(60)) for _ in BOTH)
    joints.device.actuator.write(blocks)
    assert not any(any(v) for v in joints.run(80))
    assert joints.node.rejected > 0


@pytest.mark.parametrize("output", BOTH)
@pytest.mark.parametrize(("what", "reason"), [("jump", 5), ("angle", 4), ("adc", 6), ("em", 7)])
def test_what_trips_one_output_trips_both_in_its_sample(joints, output, what, reason):
    joints.live()
    if what == "jump":
        joints.encoders[output] += 1400
    elif what == "angle":
        joints.node.loops[output].max_angle = 1
        joints.node.loops[output].centre = 0
    elif what == "adc":
        joints.adcs[0] = 2**16  # the end of its range
        for j, loop in enumerate(joints.node.loops):
            loop.adc_mask = 1 if j == output else 0
    else:
        joints.emergency = True
    (v,) = joints.run(1)
    assert v == (0, 0)
    assert joints.node.state == State.TRIPPED
    joints.run(7)
    block = joints.device.sensor.read()
    assert (block.quality[-1, 4:6] & Quality.LIMITED).all()
    events = [e.fields for e in joints.device.sensor.events() if e.name == "node"]
    assert events[-1]["state"] == "TRIPPED"
    assert (
        str(events[-1]["reason"])
        == {
            5: "the encoder jumped",
            4: "the angle is beyond its limit",
            6: "an analogue input is at the end of its range",
            7: "the emergency input",
        }[reason]
    )


def test_the_flag_of_a_trip_is_that_of_the_output_that_caused_it():
    node, decoder = Node(replace(CONFIG, batch=1), BOOT), Decoder()
    both = configure_body(**LIMITS) + configure_body(**{**LIMITS, "encoder": 1})
    node.receive(frame(Type.CONFIGURE, BOOT, 1, both, 2))
    body = stream_body(0, [900, -700] * 9, [0] * 18, 2)
    node.receive(frame(Type.STREAM, BOOT, 2, body, 2))
    node.take(0, (0, 0), (0, 0, 0), False)
    node.take(0, (0, 1400), (0, 0, 0), False)
    samples = [m for m in decoder.feed(node.transmit()) if isinstance(m, Samples)]
    rows = [list(struct.iter_unpack("<hhiB", m.data[:18])) for m in samples]
    assert [r[:2] for r in rows[0]] == [(900, 900), (-700, -700)]
    assert [r[0] for r in rows[1]] == [0, 0]
    assert [bool(r[3] & Flag.JUMP) for r in rows[1]] == [False, True]
    assert all(r[3] & Flag.LIMITED and r[3] & Flag.NULL for r in rows[1])


def test_zero_is_zero_of_both(joints):
    joints.live()
    joints.gate.stop("enough", joints.now)
    assert joints.ended(1) == 0
    assert joints.node.state == State.IDLE


def test_closing_ends_both(joints):
    joints.live()
    joints.device.close()
    assert not any(any(v) for v in (joints.node.v,))
    assert joints.node.state == State.IDLE


# A line that drops


@pytest.mark.parametrize("kind", [Type.STREAM, Type.CONFIGURE, Type.ZERO])
def test_a_frame_that_is_cut_anywhere_changes_no_output(kind):
    """What is left of it is never taken for one output's part: both go on as without it."""
    both = configure_body(**LIMITS) + configure_body(**{**LIMITS, "encoder": 1})
    bodies = {Type.STREAM: stream_body(5, [900, -700] * 9, [50] * 18, 2), Type.CONFIGURE: both}
    whole = frame(kind, BOOT, 2, bodies.get(kind, b""), 2)
    for cut in range(1, len(whole) - 1):
        node = Node(CONFIG, BOOT)
        node.receive(frame(Type.CONFIGURE, BOOT, 1, both, 2))
        before = repr((node.loops, node.queue, node.state))
        # The next frame begins with a delimiter, which ends what was cut short.
        node.receive(whole[:cut] + frame(Type.IDENTIFY, 0, 0))
        assert repr((node.loops, node.queue, node.state)) == before
        assert node.rejected == (cut > 1)


def test_a_line_that_drops_in_the_midst_of_a_frame_ends_both_at_the_deadman(joints):
    joints.live()
    fed, joints.port.cut = joints.node.fed, lambda data: data[: len(data) // 2]
    joints.device.actuator.write(
        tuple(CommandBlock(joints.next, np.full(9, 0.3), np.zeros(9)) for _ in BOTH)
    )
    joints.port.cut = lambda data: b""
    start = joints.node.sample
    out = joints.run(60)
    last = {max(i for i, v in enumerate(out) if v[j]) for j in BOTH}
    assert last == {fed + PATIENCE - 2 - start}


# Limits of each, all or none


@pytest.mark.parametrize("wide", BOTH)
def test_limits_of_which_one_is_too_wide_are_taken_for_none(wide):
    node = Node(CONFIG, BOOT)
    bodies = [configure_body(**LIMITS), configure_body(**{**LIMITS, "encoder": 1})]
    bodies[wide] = configure_body(**{**LIMITS, "max_jump": 1305})
    before = repr(node.loops)
    node.receive(frame(Type.CONFIGURE, BOOT, 1, b"".join(bodies), 2))
    answers = [m for m in Decoder().feed(node.transmit()) if isinstance(m, Answer)]
    assert [m.code for m in answers] == [Code.LIMIT]
    assert repr(node.loops) == before
    assert not node.configured


@pytest.mark.parametrize("wide", BOTH)
def test_limits_that_the_node_cannot_keep_leave_both_at_null(joints, wide):
    joints.live()
    joints.device.actuator.zero()
    joints.run(4)
    loops = list(LOOPS)
    loops[wide] = replace(loops[wide], max_output=11.0)
    with pytest.raises(DeviceError, match=rf"{('v_2', 'v_3')[wide]}: a limit of 11 is beyond"):
        joints.device.actuator.configure(tuple(loops))
    assert joints.ended(0) == 0


def test_an_output_that_the_rig_file_does_not_have_is_held_at_null(monkeypatch):
    one = load_rig("samii")[0]
    inputs = {"theta_2": {"index": 0, "counts_per_unit": 26075.945876, "offset": 1000}}
    settings = {
        "output": {"v_2": {"index": 1, "counts_per_unit": 3276.8, "null": NULLS[1]}},
        "encoder": inputs,
        "adc": {f"a_{i}": {"index": i, "counts_per_unit": 640.0} for i in range(3)},
    }
    rig = one.model_copy(update={"device": Device(driver="serial_node", settings=settings)})
    desk = Desk(rig, Node(CONFIG, BOOT), monkeypatch.setattr)
    desk.encoders[0] = 1000
    desk.run(8)
    desk.device.actuator.configure(DeviceLoop("theta_2", 4.0, 5.0, 2000.0, 0.35))
    first = desk.node.sample
    desk.device.actuator.write(CommandBlock(first, np.ones(20), np.zeros(20)))
    assert desk.run(20) == [(0, 3277)] * 20
    desk.run(8)
    block = desk.device.sensor.read()
    inside = (block.sequence >= first) & (block.sequence < first + 20)
    assert block.values[inside, 2] == pytest.approx(1.0, abs=1e-3)
    assert not any(any(v) for v in desk.run(60)[PATIENCE:])
    desk.device.close()


def test_references_of_other_samples_or_of_one_output_alone_are_refused(joints):
    joints.running()
    first, x = joints.node.sample + 6, np.full(9, 0.1)
    a, b = CommandBlock(first, x, 0 * x), CommandBlock(first + 1, x, 0 * x)
    for blocks, said in (((a, b), "different samples"), ((a,), "1 given"), ((a, a, a), "3 given")):
        with pytest.raises(DeviceError, match=said):
            joints.device.actuator.write(blocks)
    assert not any(any(v) for v in joints.run(40))


# Versions


@pytest.mark.parametrize("kind", [Type.CONFIGURE, Type.STREAM, Type.ZERO, Type.CLEAR])
@pytest.mark.parametrize(("config", "version"), [(CONFIG, 1), (replace(CONFIG, beside=()), 2)])
def test_a_frame_of_the_other_version_moves_nothing(config, version, kind):
    """A host that knows one output never drives a node with two, nor the other way round."""
    k = len(config.outputs)
    bodies = {Type.CONFIGURE: configure_body(**LIMITS), Type.STREAM: stream_body(0, [9000], [0])}
    for n in {1, k}:
        node = Node(config, BOOT)
        node.receive(frame(kind, BOOT, 1, bodies.get(kind, b"") * n, version))
        assert (node.rejected, node.configured, node.queue) == (1, False, {})


def test_a_node_whose_version_changes_ends_the_run(joints):
    joints.live()
    joints.port.say(raw(1, Type.SAMPLES, BOOT, 10**6, bytes(40)))
    joints.run(TICK)
    joints.device.sensor.read()
    with pytest.raises(DeviceError, match="version 1 now; its firmware was changed"):
        joints.device.sensor.read()


# What is said when it does not open


OUTPUT = BOARD.settings("desk")["output"]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"output": {}}, r"output is .*; expected v_2, v_3, each with its index"),
        ({"output": {"v_2": OUTPUT["v_2"]}}, r"output is \['v_2'\]; expected v_2, v_3, each once"),
        ({"output": {**OUTPUT, "v_3": {**OUTPUT["v_3"], "index": 0}}}, "an index of its own"),
        ({"output": {**OUTPUT, "v_3": {**OUTPUT["v_3"], "counts_per_unit": 0.0}}}, "than 0"),
        ({"null": 37}, "null is 37; expected left out"),
        ({"max_jump": 0.05}, "max_jump is 0.05; expected left out"),
        ({"output_counts_per_unit": 3276.8}, "output_counts_per_unit is 3276.8; expected left out"),
    ],
)
def test_a_wrong_table_of_outputs_is_one_line(settings, said):
    rig = changed(**settings)
    with pytest.raises(InputError, match=said) as caught:
        read_settings(rig, rig.device.settings)
    assert "\n" not in str(caught.value)


def test_outputs_with_deadmen_of_their_own_are_refused_before_the_node_is_asked():
    v_2, v_3 = RIG.actuator
    rig = RIG.model_copy(update={"actuator": (v_2, v_3.model_copy(update={"deadman": 0.1}))})
    with pytest.raises(InputError, match=r"deadman is \[0.05, 0.1\]; expected one for all"):
        read_settings(rig, rig.device.settings)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"v_3": {**OUTPUT["v_3"], "null": 5}}, r"output.v_3.null is 5; expected -12, the null"),
        ({"v_3": {**OUTPUT["v_3"], "index": 2}}, r"output.v_3.index is 2; expected below 2"),
    ],
)
def test_outputs_that_are_not_the_nodes_are_one_line(monkeypatch, changes, said):
    rig = changed(output={**OUTPUT, **changes})
    with pytest.raises(InputError, match=said):
        Desk(rig, Node(CONFIG, BOOT), monkeypatch.setattr)


def test_a_rig_of_several_outputs_is_refused_by_a_node_with_one(monkeypatch):
    node = Node(NodeConfig(2_000_000, 50, 2, 3, null=37, max_jump=1304), BOOT)
    with pytest.raises(InputError, match=r"output.v_3.index is 1; expected below 1"):
        Desk(RIG, node, monkeypatch.setattr)


# How many


def many(k):
    """The rig's first actuator k times."""
    (first, _) = RIG.actuator
    names = [f"v_{i}" for i in range(k)]
    actuators = tuple(first.model_copy(update={"name": name}) for name in names)
    output = {name: {"index": i, "counts_per_unit": 3276.8} for i, name in enumerate(names)}
    return changed(output=output).model_copy(update={"actuator": actuators})


def test_the_limits_of_all_outputs_fit_one_frame_and_those_of_one_more_are_refused():
    body = configure_body(**LIMITS)
    payload = 8 + MOST_OUTPUTS * len(body) + 4  # head and crc
    assert payload <= MAX_PAYLOAD < payload + len(body)
    rig = many(MOST_OUTPUTS)
    assert len(read_settings(rig, rig.device.settings).outputs(rig)) == MOST_OUTPUTS
    rig = many(MOST_OUTPUTS + 1)
    with pytest.raises(InputError, match=r"actuator is 21; expected at most 20") as caught:
        read_settings(rig, rig.device.settings)
    assert "\n" not in str(caught.value)


def test_a_simulated_node_says_how_many_outputs_it_has():
    with pytest.raises(InputError, match=r"actuator is 4; expected at most 3"):
        board(many(4))
    rig = changed(output={**OUTPUT, "v_3": {**OUTPUT["v_3"], "index": 3}})
    with pytest.raises(InputError, match=r"output.v_3.index is 3; expected below 3"):
        board(rig)


def test_samples_of_three_outputs_and_all_inputs_fit_a_frame_and_of_four_do_not():
    """As docs/reference/serial-node-outputs.md reckons it."""
    assert [26 + 8 * (REPORTED * k + 4 * 4 + 2 * 8) for k in (3, 4)] == [498, 570]
    assert OVERHEAD == 26
    assert 498 <= MAX_PAYLOAD < 570
