"""Drive gate and loop through many sequences of commands, faults and clock steps.

    python benchmarks/gate_machine.py --examples 10000 --seed 1 [--outputs 2]

Ends with exit code 1 and the shortest sequence if one leaves output without RUNNING, fresh sensors
and a live heartbeat.
"""

import argparse
import random
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))
from gate_machine import GateAndLoop, GateAndPair
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test

ENDS: Counter[str] = Counter()


class Counted:
    """Counts how the sequences ended."""

    def teardown(self) -> None:
        super().teardown()
        if hasattr(self, "device"):
            ENDS[self.ended[0] if self.ended else "not begun"] += 1


class One(Counted, GateAndLoop):
    """With one output."""


class Two(Counted, GateAndPair):
    """With two, of which one is at fault."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--examples", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--outputs", type=int, choices=(1, 2), default=1)
    chosen = parser.parse_args()
    start = time.perf_counter()
    how = settings(
        max_examples=chosen.examples,
        stateful_step_count=25,
        deadline=None,
        database=None,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )
    machine = One if chosen.outputs == 1 else Two
    random.seed(chosen.seed)
    try:
        run_state_machine_as_test(seed(chosen.seed)(machine), settings=how)
    except AssertionError as error:
        print(f"FOUND: {error}")
        return 1
    took = time.perf_counter() - start
    ends = ", ".join(f"{n} {name}" for name, n in ENDS.most_common())
    print(f"{sum(ENDS.values())} sequences in {took:.0f} s: {ends}; no output without RUNNING")
    return 0


if __name__ == "__main__":
    sys.exit(main())
