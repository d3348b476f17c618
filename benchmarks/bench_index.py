"""The index of recordings beside a plain scan of the folder.

    python benchmarks/bench_index.py [--recordings 10000] [--folder DIR]

Makes a folder of small recordings (200 that differ, copied), builds the index, and prints the
times of the first build, of a refresh with nothing new, of searches by each field (median and
worst of 50), and of what a program without an index does: open every recording and look.
"""

import argparse
import shutil
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from samii_rig.index.query import Query
from samii_rig.index.remarks import add_note, set_tags
from samii_rig.index.store import Index
from samii_rig.record.reader import read_notes
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.types import Channel, SampleBlock, StopRecord

KINDS = 200  # recordings that differ; the others are copies of them
RIGS = ("SAMII", "SAMII braced", "SFLR", "Bench beam")
EXPERIMENTS = ("swept_sine", "stepped_sine", "multisine", "torque_test")
OPERATORS = ("Ada", "Bo", "Cleo")
STATUSES = ("completed", "completed", "completed", "stopped", "tripped")
CHANNELS = (Channel("u", "V", "reference"), Channel("theta", "rad"))
QUESTIONS = {
    "everything, newest 100": Query(),
    "rig": Query(rig="SFLR"),
    "experiment and operator": Query(experiment="multisine", operator="bo"),
    "since": Query(since="2026-06-01"),
    "status": Query(status="tripped"),
    "tag": Query(tag="paper"),
    "two words of text": Query(text="joint squeaks"),
    "words that are nowhere": Query(text="xyzzy"),
}


def make(folder: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    made = []
    for i in range(min(KINDS, count)):
        path = folder / f"{i:05d}.mcap"
        day = f"2026-{1 + i % 12:02d}-{1 + i % 28:02d}T{i % 24:02d}:00:00+00:00"
        notes = {
            "experiment": EXPERIMENTS[i % 4],
            "operator": OPERATORS[i % 3],
            "started": day,
            "seed": str(i),
        }
        rig = f'name = "{RIGS[int(rng.integers(4))]}"\n'
        with RunWriter(path, CHANNELS, 500.0, Origin(rig, metadata=notes)) as writer:
            n = np.arange(50)
            values = rng.standard_normal((50, 2))
            quality = np.zeros((50, 2), np.uint8)
            writer.write(SampleBlock(CHANNELS, n * 2_000_000, n, values, quality))
            writer.close(StopRecord(STATUSES[i % 5], "all segments done"))  # type: ignore[arg-type]
        if i % 10 == 0:
            set_tags(path, ["paper"])
            add_note(path, "Ada", "joint 2 squeaks")
        made.append(path)
    for i in range(len(made), count):
        shutil.copy2(made[i % KINDS], folder / f"{i:05d}.mcap")


def milliseconds(call, repeats: int = 50) -> tuple[float, float]:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times), max(times)


def scan(folder: Path, rig: str) -> int:
    return sum(read_notes(p).get("operator") == rig for p in folder.rglob("*.mcap"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recordings", type=int, default=10_000)
    parser.add_argument("--folder", type=Path, help="where they are made; kept")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        make(folder, arguments.recordings)
        index = Index(folder)
        start = time.perf_counter()
        done = index.refresh()
        print(f"{done.recordings} recordings, first build {time.perf_counter() - start:.1f} s")
        middle, worst = milliseconds(index.refresh, 5)
        print(f"{'refresh, nothing new':28} {middle:8.1f} ms, worst {worst:8.1f} ms")
        for name, query in QUESTIONS.items():
            total = index.search(query).total
            middle, worst = milliseconds(lambda query=query: index.search(query))
            print(f"{name:28} {middle:8.1f} ms, worst {worst:8.1f} ms, finds {total}")
        middle, worst = milliseconds(lambda: scan(folder, "Bo"), 1)
        print(f"{'folder scan without index':28} {middle:8.1f} ms")


if __name__ == "__main__":
    main()
