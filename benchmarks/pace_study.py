"""How long a diagnosis takes, and the rest of it at each of its stages: what its progress says.

    samii-rig prove --out trials --keep --nothing 10 --one 14 --two 5 --outside 4 \
        --joints 2 --force 5
    python benchmarks/pace_study.py trials [--lines] [--out paces.jsonl]
    python benchmarks/states_study.py make states --rig samii --seeds 100 106
    python benchmarks/pace_study.py states --states [--out paces.jsonl]
    python benchmarks/pace_study.py --poses 10 [--out paces.jsonl]

Each trial is diagnosed as `samii-rig prove` does, of its responses alone (--lines), or asked what
changed between its two states (--states). With --poses so many arms of two links, with something
hidden in two of three, are recorded in two poses. Of the whole the time of a processor is told for
a thousand samples (lines with --lines). At each stage, and at rounds of it, the time that was left
is divided by that since all began. The tenth and the ninetieth percentile of these are the numbers
of `samii_rig.diagnose.fit.usual`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))

import numpy as np
from poses_kit import held, in_pose, loaded, two_links

from samii_rig.diagnose.changed import State, changed
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.posed import in_poses
from samii_rig.errors import SamiiRigError
from samii_rig.progress import Counted
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

POSES = ("0 deg", "110 deg")
ROUNDS = (1, 2, 4, 8, 16)
LEAST = 5  # diagnoses that came to a stage, below which it is not told


Note = Callable[[str], None]
# How much there is to diagnose, and the diagnosis.
Work = tuple[int, Callable[[Note], object]]


def stamped(work: Callable[[Note], object]) -> list[tuple[float, str]]:
    """When each stage and each round of it began, and the end, in s of a processor."""
    begun: list[tuple[float, str]] = []
    start = time.process_time()

    def note(stage: str) -> None:
        counted = isinstance(stage, Counted)
        words = f"{stage.stage}, {stage.within}" if counted else str(stage)
        if not begun or begun[-1][1] != words:
            begun.append((time.process_time() - start, words))

    work(note)
    return [*begun, (time.process_time() - start, "end")]


def one_state(folder: Path, lines: bool) -> Work:
    """The diagnosis of all recordings in a folder."""
    runs = read(folder)
    rig = parse(Rig, runs[0].rig_toml, "the rig file")
    responses = estimate(runs, gaps="model")
    size = sum(len(r.frequency) for r in responses) if lines else sum(map(len, runs))
    held = () if lines else runs
    return size, lambda note: diagnose(responses, rig, runs=held, progress=note)


def two_states(folder: Path) -> Work:
    """What changed between the recordings of a folder's two."""
    rig = parse(Rig, (folder / "rig.toml").read_text("utf-8"), "the rig file")
    before, after = (State(estimate(r), r) for r in (read(folder / n) for n in ("before", "after")))
    size = sum(map(len, [*before.runs, *after.runs]))
    return size, lambda note: changed(before, after, rig, progress=note)


def two_poses(seed: int) -> Work:
    """What is missing over two poses."""
    hidden = [(), (loaded(0.02 * (seed + 1)),), (held(0.5 * (seed + 1)),)][seed % 3]
    each = [in_pose(two_links(), pose, 2 * seed + k, *hidden) for k, pose in enumerate(POSES, 1)]
    size = sum(len(run) for one in each for run in one.runs)
    return size, lambda note: in_poses(each, two_links(), progress=note)


def read(folder: Path) -> list[Recording]:
    """All recordings of a folder."""
    return [read_recording(path) for path in sorted(folder.glob("*.mcap"))]


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
    parser.add_argument("trials", type=Path, nargs="?")
    parser.add_argument("--lines", action="store_true")
    parser.add_argument("--states", action="store_true")
    parser.add_argument("--poses", type=int, default=0)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    every: list[list[tuple[float, str]]] = []
    sizes: list[int] = []
    works: Iterator[Callable[[], Work]]
    if asked.poses:
        works = (partial(two_poses, seed) for seed in range(asked.poses))
    elif asked.states:
        works = (partial(two_states, folder) for folder in sorted(asked.trials.glob("*/*")))
    else:
        folders = sorted(asked.trials.glob("recordings/*"))
        works = (partial(one_state, folder, asked.lines) for folder in folders)
    for work in works:
        try:
            size, one = work()
            every.append(stamped(one))
            sizes.append(size)
        except (SamiiRigError, IndexError):
            continue
        if asked.out:
            with asked.out.open("a") as out:
                out.write(json.dumps({"size": size, "stages": every[-1]}) + "\n")
    took = [1e3 * one[-1][0] / size for one, size in zip(every, sizes, strict=True)]
    print("s for each thousand: {:.3g} to {:.3g}".format(*np.quantile(took, [0.1, 0.9])))
    print(f"{len(every)} diagnoses, {np.median([e[-1][0] for e in every]):.1f} s in the median")
    for words, found in sorted(rests(every).items(), key=lambda x: -len(x[1])):
        head, _, number = words.rpartition(" ")
        if len(found) < LEAST or (head.endswith("round") and int(number) not in ROUNDS):
            continue
        low, high = np.quantile(found, [0.1, 0.9])
        print(f"{words:45s} {len(found):4d} {low:6.2f} {high:6.2f}")


if __name__ == "__main__":
    main()
