"""Damage frames, a million by default, and count what a driver takes of them: of a node, of the
force/torque sensor on CAN, or of the quadrature counter.

    python benchmarks/wire_fuzz.py node --frames 1000000 --seed 1
    python benchmarks/wire_fuzz.py can
    python benchmarks/wire_fuzz.py quadrature

Ends with exit code 1 if a single wrong sample was accepted.
"""

import argparse
import random
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))
from can_fuzz_kit import sensor
from wire_fuzz_kit import node, quadrature

WIRES = {"node": node, "can": sensor, "quadrature": quadrature}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=WIRES, nargs="?", default="node")
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    start = time.process_time()
    c = WIRES[chosen.what](random.Random(chosen.seed), chosen.frames)
    took = time.process_time() - start
    print(
        f"{c.sent} frames, {c.damaged} damaged, {c.accepted} accepted, {c.wrong} of them wrong; "
        f"{took:.0f} s of CPU"
    )
    return 1 if c.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
