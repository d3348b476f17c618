"""How long the rest of a diagnosis takes, once its first stage has begun: what its progress says.

    samii-rig prove --out trials --keep --nothing 10 --one 14 --two 5 --outside 4 \
        --joints 2 --force 5
    python benchmarks/pace_study.py trials [--lines] [--out paces.jsonl]

Each trial is diagnosed as `samii-rig prove` does, or of its responses alone (--lines). At each
stage, and at rounds of it, the time that was left is divided by that since "what is missing" began.
The tenth and the ninetieth percentile of these are the numbers of `samii_rig.diagnose.fit.usual`.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import defaultdict
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.errors import SamiiRigError
from samii_rig.progress import Counted
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate

FIRST = "what is missing"
ROUNDS = (1, 2, 4, 8, 16)
LEAST = 5  # diagnoses that came to a stage, below which it is not told


def stamped(folder: Path, *, lines: bool) -> list[tuple[float, str]]:
    """When each stage and each round of it began, and the end, in s from `FIRST` on."""
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    rig = parse(Rig, runs[0].rig_toml, "the rig file")
    begun: list[tuple[float, str]] = []

    def note(stage: str) -> None:
        counted = isinstance(stage, Counted)
        words = f"{stage.stage}, {stage.within}" if counted else str(stage)
        if not begun or begun[-1][1] != words:
            begun.append((time.monotonic(), words))

    responses = estimate(runs, gaps="model")
    diagnose(responses, rig, runs=() if lines else runs, progress=note)
    begun.append((time.monotonic(), "end"))
    start = next(t for t, words in begun if words.partition(",")[0] == FIRST)
    return [(t - start, words) for t, words in begun if t >= start]


def rests(every: list[list[tuple[float, str]]]) -> dict[str, list[float]]:
    """Of each stage the time left over the time spent, one value a diagnosis that came to it."""
    out = defaultdict(list)
    for one in every:
        end, seen = one[-1][0], set()
        for t, words in one[:-1]:
            if words not in seen and t > 0:
                out[words].append((end - t) / t)
            seen.add(words)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("trials", type=Path)
    parser.add_argument("--lines", action="store_true")
    parser.add_argument("--step", type=int, default=1, help="2 for every second trial alone")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    every = []
    for folder in sorted((asked.trials / "recordings").iterdir())[:: asked.step]:
        try:
            every.append(stamped(folder, lines=asked.lines))
        except (SamiiRigError, StopIteration, IndexError):
            continue
        if asked.out:
            with asked.out.open("a") as out:
                out.write(json.dumps({"trial": folder.name, "stages": every[-1]}) + "\n")
    print(f"{len(every)} diagnoses, {np.median([e[-1][0] for e in every]):.1f} s in the median")
    for words, found in sorted(rests(every).items(), key=lambda x: -len(x[1])):
        head, _, number = words.rpartition(" ")
        if len(found) < LEAST or (head.endswith("round") and int(number) not in ROUNDS):
            continue
        low, high = np.quantile(found, [0.1, 0.9])
        print(f"{words:45s} {len(found):4d} {low:6.2f} {high:6.2f}")


if __name__ == "__main__":
    main()
