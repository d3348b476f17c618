"""A node with one output speaks protocol version 1: the bytes of both ways are those that were
recorded before there were nodes with several."""

import json
from pathlib import Path

import numpy as np
import pytest
from node_kit import CompiledNode, build
from serial_desk_kit import Desk, session

from drivers.serial_node.wire import Answer, Code, Decoder, Event, State, Type
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device
from sim.wire.node import Node
from sim.wire.protocol import NodeConfig

RECORDED = json.loads(
    (Path(__file__).parents[1] / "data" / "serial_node_one_output.json").read_text()
)
CONFIG = NodeConfig(2_000_000, 50, 1, 3, null=37, max_jump=1304)
BOOT, SAMPLE = 9, 2**32 - 40


def test_the_recorded_node_went_through_every_state():
    down = b"".join(bytes.fromhex(step[-1]) for step in RECORDED["steps"])
    said = list(Decoder().feed(down))
    assert {m.state for m in said if isinstance(m, Event)} == set(State)
    answered = {(m.type, m.code) for m in said if isinstance(m, Answer)}
    refused = [Code.NOT_NULL, Code.STATE]
    assert answered > {(Type.ZERO, Code.OK), (Type.CLEAR, Code.OK), (Type.CLEAR, Code.CAUSE)}
    assert answered > {(Type.CONFIGURE, code) for code in (Code.OK, *refused)}
    assert (Type.STREAM, Code.STATE) in answered


def test_driver_and_node_say_what_was_recorded_byte_for_byte(monkeypatch):
    device = Device(driver="serial_node", settings=RECORDED["settings"])
    rig = load_rig("samii")[0].model_copy(update={"device": device})
    desk = Desk(rig, Node(CONFIG, BOOT, SAMPLE), monkeypatch.setattr)
    values, quality = session(desk)
    assert json.loads(json.dumps(desk.port.steps)) == RECORDED["steps"]
    np.testing.assert_array_equal(values, RECORDED["values"])
    np.testing.assert_array_equal(quality, RECORDED["quality"])


@pytest.mark.parametrize("kind", ["simulated", "compiled"])
def test_a_node_answers_what_was_recorded_byte_for_byte(kind, tmp_path):
    made = CompiledNode(build(tmp_path), CONFIG, BOOT, SAMPLE) if kind == "compiled" else None
    node = made or Node(CONFIG, BOOT, SAMPLE)
    for what, given, *expected in RECORDED["steps"]:
        if what == "up":
            node.receive(bytes.fromhex(given))
        else:
            clock, encoders, adcs, emergency = given
            counts = node.take(clock, tuple(encoders), tuple(adcs), emergency)
            assert list(counts) == expected[0]
        assert node.transmit().hex() == expected[-1]
