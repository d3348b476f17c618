"""Damage what others write, and see that all ends well or with an error of ours.

    python benchmarks/red_team.py --seed 3                  # all attacks
    python benchmarks/red_team.py files --tries 5000

    files    a recording: read, verified, recovered, listed, estimated
    bodies   any JSON at the routes of the API, damaged experiments among it
    index    the file of the index, between two looks and under one that is open
    jobs     the files of a run's folder, the clock set by years at each look: the state is told,
             the stop is heard and goes to the run's process alone
    live     the live data in memory

Damaged rig files, recordings in more forms and DBC files: file_fuzz.py. Frames on the wire:
wire_fuzz.py. The service killed in runs, and how long a stop takes under attack: bench_serve.py.

Ends with exit code 1 if an error escaped or a try took more than 5 s of CPU.
"""

import argparse
import logging
import random
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))
import red_kit
from file_fuzz_kit import count

# What one try costs, in ms of CPU: 5, 5, 15, 70 and 0.5. These are some minutes in all.
TRIES = {"files": 2000, "bodies": 2000, "index": 1000, "jobs": 1000, "live": 10_000}
LONGEST = 5.0  # s of CPU


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=[[], *TRIES], nargs="*")
    parser.add_argument("--tries", type=int, help="of each attack [default: 1,000 to 10,000]")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    logging.disable()  # what the service writes into its log about damaged files
    failed = False
    for what in chosen.what or TRIES:
        tries, start = chosen.tries or TRIES[what], time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            c = count(getattr(red_kit, what)(random.Random(chosen.seed), Path(folder)), tries)
        took = time.process_time() - start
        print(
            f"{what}: {tries} tries in {took:.0f} s of CPU: {c.loaded} well, {c.refused} refused, "
            f"slowest {c.worst * 1e3:.0f} ms",
            flush=True,
        )
        for which, n in c.escaped.most_common():
            print(f"ESCAPED {n} x {which}")
        failed |= bool(c.escaped) or c.worst > LONGEST
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
