"""Damage a node's frames, a million by default, and count what the driver's decoder accepts.

    python benchmarks/wire_fuzz.py --frames 1000000 --seed 1

Ends with exit code 1 if a single wrong sample was accepted.
"""

import argparse
import random
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from wire_fuzz_kit import fuzz


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    start = time.perf_counter()
    c = fuzz(random.Random(chosen.seed), chosen.frames)
    rate = c.sent / (time.perf_counter() - start)
    print(
        f"{c.sent} frames, {c.damaged} damaged, {c.accepted} accepted, {c.wrong} of them wrong; "
        f"{rate:.0f} frames/s"
    )
    return 1 if c.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
