"""The firmware's image beside the simulated node, ten minutes at 1 kHz: the same counts and bytes.

    make -C drivers/serial_node/board board=qemu
    python benchmarks/board_same.py drivers/serial_node/board/build/qemu/node.bin

A host streams a sine as a run does, a tick of 4 ms each, with one request of any other kind,
sensible, wrong or damaged, every second; inputs trip the node now and then. The node's time is
counted in samples, so the machine's speed does not matter. Exit code 1 at the first difference.
"""

import argparse
import math
import random
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))
from node_kit import CONFIG, Host

from drivers.serial_node.wire import Type, configure_body, frame, stream_body
from samii_rig.errors import DeviceError
from sim.wire.emulator import Emulator
from sim.wire.image import ImageNode
from sim.wire.protocol import State

RATE, TICK, AHEAD = 1000, 4, 58  # Hz; samples
LOOP = {
    "encoder": 0,
    "adc_mask": 7,
    "kp_q16": 32942,
    "max_output": 20000,
    "max_step": 9000,
    "max_angle": 40000,
    "max_jump": 5000,
    "centre": 0,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("image", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    rng, emulator = random.Random(chosen.seed), Emulator(chosen.image)
    node = ImageNode(emulator, replace(CONFIG, period_ns=10**9 // RATE), 1)
    host, states, sent, total, began = Host(rng, node), Counter(), 0, 0, time.monotonic()

    def ask(kind: Type, body: bytes = b"") -> None:
        host.seq = node.host_seq + 1
        node.receive(frame(kind, node.boot, host.seq, body))

    try:
        for i in range(round(chosen.seconds * RATE)):
            if i % TICK == 0:
                if not node.configured:
                    ask(Type.CLEAR)
                    ask(Type.CONFIGURE, configure_body(**LOOP))
                    sent = i
                n = i + AHEAD - sent
                u = [round(9000 * math.sin(0.03 * (sent + k))) for k in range(n)]
                ask(Type.STREAM, stream_body(sent, u, [0] * n))
                sent += n
            if rng.random() < 1 / RATE:
                node.receive(host.speak())
            trip = rng.random() < 1e-4
            adcs = (32767 if trip else rng.randrange(-999, 999), 2, 3)
            theta = round(300 * math.sin(0.01 * i))
            node.take(i * 1000 % 2**32, (theta, -theta), adcs, rng.random() < 1e-4)
            total += len(node.transmit())
            states[State(node.state).name] += 1
    except DeviceError as error:
        print(error)
        return 1
    finally:
        emulator.close()
    took = time.monotonic() - began
    print(
        f"{sum(states.values())} samples at {RATE} Hz and {total} bytes, all the same; "
        f"{', '.join(f'{k} {n}' for k, n in sorted(states.items()))}; "
        f"{emulator.watchdog.feeds} feeds of the watchdog; {took:.0f} s"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
