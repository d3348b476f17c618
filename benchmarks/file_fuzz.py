"""Damage TOML files, recordings or DBC files, and see that the loaders give only their own errors.

    python benchmarks/file_fuzz.py toml --inputs 100000 --seed 1
    python benchmarks/file_fuzz.py mcap --inputs 100000 --seed 1
    python benchmarks/file_fuzz.py dbc --inputs 100000 --seed 1

Ends with exit code 1 if an error escaped, an input took more than a second of CPU, or the memory
grew by more than 200 MB.
"""

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))
from file_fuzz_kit import buses, count, recordings, tables

LONGEST = 1.0  # s of CPU
GROWN = 200.0  # MB


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("toml", "mcap", "dbc"))
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    rng, start = random.Random(chosen.seed), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        match chosen.what:
            case "toml":
                made = tables(rng)
            case "mcap":
                made = recordings(rng, Path(folder))
            case _:
                made = buses(rng, Path(folder))
        c = count(made, chosen.inputs)
    took = time.process_time() - start
    print(
        f"{chosen.inputs} inputs in {took:.0f} s of CPU: {c.loaded} loaded, {c.refused} refused, "
        f"slowest {c.worst * 1e3:.0f} ms, memory grew by {c.grown:.0f} MB"
    )
    for what, n in c.escaped.most_common():
        print(f"ESCAPED {n} x {what}")
    return 1 if c.escaped or c.worst > LONGEST or c.grown > GROWN else 0


if __name__ == "__main__":
    sys.exit(main())
