"""Process time of a diagnosis by plant and kind, and how it grows.

    python benchmarks/bench_diagnose.py DIR [--trials 5] [--seed 1] [--kind nothing one force]

Makes trials of every plant on drawn rigs in DIR, or finds them made, and diagnoses each.
Prints median, mean and longest by plant and kind, and the exponents of samples, channels and
records in a least-squares fit of the time's logarithm. OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from samii_rig.errors import SamiiRigError
from samii_rig.prove.jobs import jobs, pairs, plant, plants
from samii_rig.prove.reader import diagnose_folder
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig
from samii_rig.rig.shipped import shipped
from samii_rig.signal.groups import segments_of

GROWS_WITH = ("samples", "channels", "records")


def size(folder: Path) -> tuple[int, int, int]:
    """Samples, channels and records of a trial."""
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    samples = sum(len(run.values) for run in runs)
    return samples, runs[0].values.shape[1], sum(len(segments_of(run)) for run in runs)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", nargs="+", default=["nothing", "one", "force"])
    args = parser.parse_args()
    rigs = {name: load_rig(name)[1] for name in shipped()}
    took: dict[tuple[str, str], list[float]] = defaultdict(list)
    sizes, seconds = [], []
    for name in plants():
        having, _ = pairs([name], rigs, args.kind, asked=())
        counts = {kind: args.trials for kind in args.kind if having[kind]}
        for job in jobs(counts, args.seed, having):
            folder = plant(name)(job.kind, job.seed, args.out, rigs[job.rig])
            start = time.process_time()
            try:
                diagnose_folder(folder)
            except SamiiRigError as error:
                print(f"{name} {job.name}: {error}")
                continue
            took[name, job.kind].append(time.process_time() - start)
            sizes.append(size(folder))
            seconds.append(took[name, job.kind][-1])
    for (name, kind), each in took.items():
        print(
            f"{name:15} {kind:8} {len(each):3} trials: median {statistics.median(each):6.2f} s, "
            f"mean {statistics.mean(each):6.2f} s, longest {max(each):6.2f} s"
        )
    if len(seconds) > len(GROWS_WITH) + 1:
        A = np.column_stack([np.log(sizes), np.ones(len(sizes))])
        power = np.linalg.lstsq(A, np.log(seconds), rcond=None)[0]
        print(", ".join(f"{n}^{p:.2f}" for n, p in zip(GROWS_WITH, power[:-1], strict=True)))


if __name__ == "__main__":
    main()
