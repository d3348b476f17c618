"""The portable C core and the simulated node: the same in, the same counts and bytes out."""

import random

import pytest
from node_kit import CONFIGS, CompiledNode, Host, build

from sim.wire.node import Node


@pytest.fixture(scope="module")
def core(tmp_path_factory):
    return build(tmp_path_factory.mktemp("core"))


def compare(core, config, seed: int, steps: int) -> set[int]:
    """Run both side by side; the states that were seen."""
    rng = random.Random(seed)
    boot = rng.randrange(1, 2**16)
    sample = rng.choice([0, 2**32 - 50, 2**31 - 20])
    node, c = Node(config, boot, sample), CompiledNode(core, config, boot, sample)
    host, seen = Host(rng, node), set()
    encoder, clock = 0, rng.choice([0, 2**32 - 5000])
    for _ in range(steps):
        if rng.random() < 0.25:
            data = host.speak() if rng.random() < 0.97 else rng.randbytes(rng.randrange(900))
            cut = rng.randrange(len(data) + 1)
            for part in (data[:cut], data[cut:]):
                node.receive(part)
                c.receive(part)
        encoder += (
            rng.randrange(-300, 301) if rng.random() < 0.995 else rng.randrange(-(2**30), 2**30)
        )
        encoder = max(min(encoder, 2**31 - 1), -(2**31)) if rng.random() < 0.99 else 0
        adcs = tuple(
            rng.choice([-32768, 32767]) if rng.random() < 0.002 else rng.randrange(-999, 999)
            for _ in range(3)
        )
        clock = (clock + 2000) % 2**32
        inputs = clock, (encoder, -encoder // 2), adcs, rng.random() < 0.002
        assert node.take(*inputs) == c.take(*inputs)
        assert node.supply == c.supply == node.live
        if rng.random() < 0.5:
            room = rng.choice([1, 50, 2048])
            assert node.transmit(room) == c.transmit(room)
        seen.add(int(node.state))
    assert node.transmit() == c.transmit()
    return seen


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{len(c.outputs)} outputs")
def test_the_c_core_does_what_the_simulated_node_does(core, config):
    seeds = range(20)
    seen = set().union(*(compare(core, config, seed, 1500) for seed in seeds))
    assert seen == {0, 1, 2, 3, 4}, "a state that was never reached is not compared"
