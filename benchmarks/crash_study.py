"""Kill, cut and corrupt recordings, and count what comes back.

    python benchmarks/crash_study.py [--kills 50] [--flips 3000] [--seed 1]

Three studies, each of which ends the program with exit code 1 when one case fails:
kills   a process that records without pause is killed with SIGKILL at random moments;
        every sample that it had reported as flushed must be recovered, with its value;
cuts    a recording is cut at every byte; exactly the samples of the chunks that lie
        before the cut must be recovered;
flips   single bits of a recording are turned; `verify` must not call one file whole.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from samii_rig.errors import RecordingError
from samii_rig.record import scan
from samii_rig.record.contents import read_contents
from samii_rig.record.reader import read_recording
from samii_rig.record.recover import recover
from samii_rig.record.verify import verify
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.types import Channel, SampleBlock, StopRecord

CHANNELS = tuple(Channel(f"c{i}", "V") for i in range(8))
ROWS = 1000  # samples a block of the process that is killed


def block(start: int, rows: int) -> SampleBlock:
    """Samples start, start + 1, ... whose values can be told from their sequence."""
    sequence = np.arange(start, start + rows)
    values = np.sin(sequence[:, None] * np.arange(1, 9))
    quality = np.zeros((rows, 8), np.uint8)
    return SampleBlock(CHANNELS, sequence * 100_000, sequence, values, quality)


def record_forever(path: Path) -> None:
    """The process that is killed: writes, flushes, says how much is on the disk."""
    writer = RunWriter(path, CHANNELS, 10_000.0)
    start = 0
    while True:
        for _ in range(int(np.random.default_rng(start).integers(1, 20))):
            writer.write(block(start, ROWS))
            start += ROWS
        print(writer.flush(), flush=True)


def kills(folder: Path, count: int, rng: np.random.Generator) -> bool:
    flushed_total = recovered_total = failures = 0
    for number in range(count):
        path = folder / f"run{number}.mcap"
        command = [sys.executable, __file__, "--child", str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            reports = [child.stdout.readline()]
            time.sleep(rng.uniform(0, 0.6))
            child.send_signal(signal.SIGKILL)
            reports += child.stdout.readlines()
        flushed = max(int(r) for r in reports if r.endswith("\n"))
        partial = path.with_name(path.name + ".partial")
        verdict = verify(partial)
        result = recover(partial)
        recording = read_recording(result.path)
        n = len(recording)
        right = np.array_equal(recording.sequence, np.arange(n))
        right = right and np.array_equal(recording.values, block(0, n).values)
        again = verify(result.path).status == "whole"
        if not (right and again and n >= flushed and verdict.status == "lossy"):
            failures += 1
            print(f"kill {number}: flushed {flushed}, recovered {n}, {verdict}")
        flushed_total += flushed
        recovered_total += n
        result.path.unlink()
        partial.unlink()
    print(
        f"kills: {count}, failures {failures}; {flushed_total} samples reported flushed, "
        f"{recovered_total} recovered"
    )
    return failures == 0


def small_recording(path: Path) -> bytes:
    with RunWriter(path, CHANNELS, 500.0, Origin("name = 'rig'\n")) as writer:
        for start in range(0, 100, 25):
            writer.write(block(start, 25))
            writer.flush()
            writer.event(start, "swept", {"to": start})
        writer.close(StopRecord("completed", "all done"))
    return path.read_bytes()


def cuts(folder: Path) -> bool:
    path, output = folder / "cut.mcap", folder / "again.mcap"
    whole = small_recording(path)
    data = scan.mapped(path)
    found = read_contents(data, len(data), strict=False).chunks
    ends = [(c.head.span.end, c.counts[1]) for c in found if 1 in c.counts]
    failures = 0
    for length in range(len(whole)):
        path.unlink()  # a new file, so that `data` keeps the old one
        path.write_bytes(whole[:length])
        rows = sum(n for end, n in ends if end <= length)
        status = verify(path).status
        try:
            got = recover(path, output).samples
            recording = read_recording(output)
            right = np.array_equal(recording.values, block(0, rows).values)
            output.unlink()
        except RecordingError:
            got, right = 0, True
        if got != rows or not right or status != ("lossy" if rows else "nothing"):
            failures += 1
            print(f"cut at {length}: {got} of {rows} samples, {status}")
    print(f"cuts: at each of {len(whole)} bytes, failures {failures}")
    return failures == 0


def flips(folder: Path, count: int, rng: np.random.Generator) -> bool:
    path = folder / "flip.mcap"
    whole = small_recording(path)
    bits = rng.choice(8 * len(whole), size=min(count, 8 * len(whole)), replace=False)
    missed = 0
    for bit in bits:
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << int(bit % 8)
        path.write_bytes(damaged)
        if verify(path).status == "whole":
            missed += 1
            print(f"bit {bit}: called whole")
    print(f"flips: {len(bits)} single bits of {len(whole)} bytes, called whole {missed}")
    return missed == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--flips", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        record_forever(given.child)
    rng = np.random.default_rng(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        passed = [
            kills(Path(folder), given.kills, rng),
            cuts(Path(folder)),
            flips(Path(folder), given.flips, rng),
        ]
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
