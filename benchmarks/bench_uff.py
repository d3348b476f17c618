"""A universal file of a gigabyte: opened, and one of its sets read, beside pyuff.

    python benchmarks/bench_uff.py [--mb 1000] [--folder /tmp]

Writes two files, 58 (text) and 58b (binary), of time responses of a million samples each.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyuff

from samii_rig.record.uff.channels import function_fields
from samii_rig.record.uff.file import DataSet, UffFile, write_uff

SAMPLES = 1_000_000  # of one set: 13 MB as single text, 8 MB as double binary


def sets(mb: int, *, binary: bool) -> Iterator[DataSet]:
    """Time responses that together take about `mb` megabytes."""
    rng = np.random.default_rng(1)
    data = rng.standard_normal(SAMPLES)
    a_set = 8 if binary else 13
    for i in range(max(1, mb // a_set)):
        fields = function_fields(f"channel {i}", x_step=1e-3, data=data, unit="m/s^2")
        yield DataSet(58, fields | {"data_type": 4 if binary else 2}, binary)


def timed(what: str, work: Callable[[], object]) -> None:
    began = time.perf_counter()
    work()
    print(f"{what:42} {time.perf_counter() - began:8.2f} s", flush=True)


def measure(name: str, path: Path, mb: int, *, binary: bool) -> None:
    timed(f"{name}: written", lambda: write_uff(path, sets(mb, binary=binary)))
    print(f"{name}: {path.stat().st_size / 1e6:.0f} MB")
    timed(f"{name}: opened", lambda: UffFile(path))
    file = UffFile(path)
    middle = len(file) // 2
    timed(f"{name}: heads of {len(file)} sets", lambda: [file.head(i) for i in range(len(file))])
    timed(f"{name}: one set of {SAMPLES:,} samples read", lambda: file[middle])
    timed(f"{name}: opened by pyuff", lambda: pyuff.UFF(str(path)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mb", type=int, default=1000)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    given = parser.parse_args()
    for name in ("58", "58b"):
        path = given.folder / f"bench_uff_{name}.uff"
        measure(name, path, given.mb, binary=name == "58b")
        path.unlink()


if __name__ == "__main__":
    main()
