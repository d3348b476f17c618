"""The firmware's image in an emulator: it does what the simulated node does, and ends at null when
the processor itself goes wrong. The whole kits on it: pytest -m slow.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator

import pytest
import wire_fuzz_kit
from board_kit import image, made
from chip_kit import SECTOR
from node_kit import CONFIG, CONFIGS, Host

from drivers.serial_node.wire import Type, configure_body, frame, stream_body
from samii_rig.errors import DeviceError, InputError
from sim.wire.emulator import Emulator
from sim.wire.image import ImageNode
from sim.wire.node import Node
from sim.wire.protocol import NodeConfig

STEPS = 600  # samples a seed: half a second where the emulator has a core to itself
N_VECTORS = 16 + 82  # of the core and of the STM32F405
WAYS = ["hang", "fault", "stack", "supply"]
LOOP = {
    "encoder": 0,
    "adc_mask": 0,
    "kp_q16": 0,
    "max_output": 16000,
    "max_step": 9000,
    "max_angle": 30000,
    "max_jump": 5000,
    "centre": 0,
}


@pytest.fixture(scope="module")
def emulator() -> Iterator[Emulator]:
    e = Emulator(image())
    yield e
    e.close()


def compared(emulator: Emulator, config: NodeConfig, seed: int, steps: int) -> set[int]:
    """Run the image under every kind of request and input; it compares itself. The states seen."""
    rng = random.Random(seed)
    sample = rng.choice([0, 2**32 - 50, 2**31 - 20])
    node = ImageNode(emulator, config, rng.randrange(1, 2**16), sample)
    host, seen, encoder = Host(rng, node), set(), 0
    for i in range(steps):
        if rng.random() < 0.15:
            node.receive(host.speak())
        encoder += rng.randrange(-300, 301)
        adcs = tuple(rng.randrange(-999, 999) for _ in range(3))
        rail = rng.random() < 0.002
        inputs = (encoder, -encoder), ((32767, *adcs[1:]) if rail else adcs), rng.random() < 0.002
        counts = node.take(2000 * i % 2**32, *inputs)
        nulls = [o.null for o in config.outputs]
        assert [c - null for c, null in zip(counts, nulls, strict=True)] == list(node.v)
        node.transmit()
        seen.add(int(node.state))
    return seen


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{len(c.outputs)} outputs")
def test_the_image_does_what_the_simulated_node_does_byte_for_byte(emulator, config):
    seen = set().union(*(compared(emulator, config, seed, STEPS) for seed in range(3)))
    assert seen == {0, 1, 2, 3, 4}, "a state that was never reached is not compared"


def test_a_difference_is_seen(emulator, monkeypatch):
    node = ImageNode(emulator, CONFIG, 5)
    node.take(0, (0, 0), (0, 0, 0), False)
    monkeypatch.setattr(Node, "_wanted", lambda self, loop, u, encoders: u + 1)
    with pytest.raises(DeviceError, match="the image is not the simulated node at sample"):
        live(node)


def test_of_the_images_own_frames_no_wrong_sample_is_ever_accepted(emulator):
    node = ImageNode(emulator, wire_fuzz_kit.CONFIG, 3)
    counted = wire_fuzz_kit.node(random.Random(1), 300, node)
    assert counted.wrong == 0
    assert counted.accepted > 80
    assert counted.damaged > 80


def live(node: ImageNode) -> None:
    """Its output at 1000 counts, its supply on."""
    node.receive(frame(Type.CONFIGURE, node.boot, 1, configure_body(**LOOP)))
    first = node.sample
    node.receive(frame(Type.STREAM, node.boot, 2, stream_body(first, [1000] * 60, [0] * 60)))
    for _ in range(3):
        assert node.take(0, (0, 0), (0, 0, 0), False) == (1000 + CONFIG.null,)
    assert node.supply


@pytest.mark.parametrize("way", WAYS)
def test_a_processor_that_goes_wrong_is_at_null_when_the_watchdog_has_reset_it(emulator, way):
    node = ImageNode(emulator, CONFIG, 7)
    live(node)
    fed = emulator.watchdog.feeds
    node.wrong(way)
    held = [node.take(0, (0, 0), (0, 0, 0), False)]
    # A handler puts null out at once; what hangs holds its output until the watchdog acts.
    assert held[0] == (CONFIG.null + (1000 if way == "hang" else 0),)
    assert node.supply == (way == "hang")
    assert emulator.watchdog.feeds == fed, "it was fed by what is wrong"
    while node.boot == 7:
        held.append(node.take(0, (0, 0), (0, 0, 0), False))
        assert len(held) * CONFIG.period_ns <= CONFIG.deadman_ms * 1e6
    assert not node.supply
    # What the old host still sends is of the wrong boot.
    node.receive(frame(Type.STREAM, 7, 3, stream_body(0, [1000] * 60, [0] * 60)))
    assert [node.take(0, (0, 0), (0, 0, 0), False) for _ in range(40)] == [(CONFIG.null,)] * 40
    live(node)


@pytest.fixture(scope="module")
def flashed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return made(tmp_path_factory.mktemp("chip"), "stm32f405").read_bytes()


def test_the_same_sources_make_the_same_bytes_wherever_they_are_made(flashed, tmp_path):
    assert made(tmp_path / "elsewhere", "stm32f405").read_bytes() == flashed


def test_the_image_begins_as_the_chip_expects_it_and_leaves_the_boots_alone(flashed):
    stack, *handlers = struct.unpack_from(f"<{N_VECTORS}I", flashed)
    assert stack == 0x2000_2000, "the stack lies lowest: below it is no memory"
    assert all(0x0800_0000 < h < 0x0800_0000 + len(flashed) and h & 1 for h in handlers)
    # All but the reset, the sample and the port lead to the handler of what is wrong.
    wrong = max(set(handlers), key=handlers.count)
    own = [1 + i for i, h in enumerate(handlers) if h != wrong]
    assert own == [1, 16 + 30, 16 + 38]
    assert len(flashed) < SECTOR - 0x0800_0000, "the sector that counts the boots"


@pytest.mark.parametrize(
    "wrong", ["RATE_HZ=333", "DEADMAN_MS=4", "ADCS=9", "BATCH=6", "CRYSTAL_HZ=25000000"]
)
def test_a_wrong_number_ends_the_making_with_what_would_be_right(wrong, tmp_path):
    with pytest.raises(AssertionError, match=rf'static assertion failed: "{wrong.split("=")[0]}: '):
        made(tmp_path, "stm32f405", wrong)
    assert not (tmp_path / "node.bin").exists()


def test_an_image_or_an_emulator_that_is_not_there_is_one_line(tmp_path, monkeypatch):
    firmware = image()
    with pytest.raises(InputError, match="board=qemu"):
        Emulator(tmp_path / "node.bin")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(DeviceError, match="apt install qemu-system-arm"):
        Emulator(firmware)
