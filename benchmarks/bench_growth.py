"""How the cost of each work grows over 10 and 100 times of it, with the exponent.

    python benchmarks/bench_growth.py [--rounds 5] [--page docs/evidence/growth.md]

Process time, medians of rounds in which all works take turns: a busy machine hardly changes it.
Of workers it is the time that passes, by a clock, as that is what they are for. The exponent is the
slope of the logarithms between the last two sizes: 1 where ten times the work costs ten times as
much. `--page` writes the table with the commit that made it. OPENBLAS_NUM_THREADS=1 is set.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported

import argparse
import math
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from samii_rig.index.query import Query
from samii_rig.index.store import Index
from samii_rig.model.modes import natural_frequencies
from samii_rig.model.study import study
from samii_rig.model.tmm import Chain
from samii_rig.model.vary import vary
from samii_rig.prove import outcomes
from samii_rig.prove.score import scores
from samii_rig.record.reader import read_recording
from samii_rig.record.writer import RunWriter
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.signal import welch
from samii_rig.types import Channel, Float, SampleBlock, StopRecord
from samii_rig.workers import workers

ROOT = Path(__file__).resolve().parent.parent
TIMES = (1, 10, 100)
RATE = 500.0  # Hz
SEGMENT = 1024  # samples of a window of H1
BLOCK = 4096  # rows that a device hands over at once
LINES = 200  # frequencies at which a chain of many elements is evaluated
POINTS = 64  # of the parameter study that is divided among workers

Call = Callable[[], object]


@dataclass(frozen=True, slots=True)
class Work:
    """What is measured: its name, what of it grows, and each size with its call."""

    what: str
    of: str
    sizes: tuple[tuple[int, Call], ...]
    clock: Callable[[], float] = time.process_time


def noise(rows: int, columns: int) -> Float:
    """(rows, columns), white; the first column is the input."""
    return np.random.default_rng(0).standard_normal((rows, columns))


def h1(samples: int, outputs: int) -> Call:
    data = noise(samples, 1 + outputs)
    return lambda: welch.frequency_response([data], RATE, nperseg=SEGMENT)


def record(path: Path, values: Float) -> None:
    """Write all rows as a run writes them."""
    path.unlink(missing_ok=True)
    channels = tuple(Channel(f"a{i}", "m/s^2") for i in range(values.shape[1]))
    with RunWriter(path, channels, RATE) as writer:
        for start in range(0, len(values), BLOCK):
            part = values[start : start + BLOCK]
            n = np.arange(start, start + len(part))
            good = np.zeros(part.shape, np.uint8)
            writer.write(SampleBlock(channels, n * 2_000_000, n, part, good))
        writer.close(StopRecord("completed", "benchmark"))


def recorded(path: Path, rows: int, channels: int) -> tuple[Call, Call]:
    """Calls that record such a file, and that read it."""
    values = noise(rows, channels)
    record(path, values)
    return (lambda: record(path, values)), (lambda: read_recording(path))


def pieces(n: int) -> Rig:
    """SAMII with its beam in n pieces: the same robot, of more elements."""
    data = load_rig("samii")[0].model_dump()
    data["element"] = list(data["element"])
    at = next(i for i, e in enumerate(data["element"]) if e["name"] == "beam")
    beam = data["element"][at]
    part = beam | {"L": beam["L"] | {"value": beam["L"]["value"] / n, "tolerance": 0.0}}
    data["element"][at : at + 1] = [part | {"name": f"beam_{i}"} for i in range(n)]
    return Rig.model_validate(data)


def response(rig: Rig, lines: int) -> Call:
    chain, f = Chain(rig), np.geomspace(0.1, 100.0, lines)
    return lambda: chain.response(f)


def folder(where: Path, count: int) -> Path:
    """A folder with so many recordings of 50 rows."""
    where.mkdir(parents=True)
    first = where / "0.mcap"
    record(first, noise(50, 2))
    data = first.read_bytes()
    for i in range(1, count):
        (where / f"{i}.mcap").write_bytes(data)
    return where


def indexed(where: Path, count: int) -> tuple[Call, Call, Call]:
    """Calls that index such a folder anew, that look for what is new, and that search."""
    made = folder(where, count)
    index = Index(made)
    index.refresh()

    def anew() -> None:
        for file in (made / ".samii-rig").glob("index*"):
            file.unlink()
        Index(made).refresh()

    return anew, index.refresh, lambda: index.search(Query(text="benchmark"))


def scored(times: int) -> tuple[int, Call]:
    """The trials of the kept proof, so many times over, and a call that scores them."""
    _, found = outcomes.read(ROOT / "docs" / "evidence" / "proof-trials.jsonl.xz")
    trials = outcomes.trials(found) * times
    return len(trials), lambda: scores(trials, 0)


def divided(n: int) -> Call:
    """A parameter study on so many processes, from their start to their end."""
    rig, text = load_rig("samii")
    varied = [vary(rig, f"joint_1.k=6800:27200:{POINTS}:log")]

    def call() -> None:
        with workers(n) as pool:
            study(text, varied, (0.0, 50.0), pool)

    return call


def works(where: Path) -> Iterator[Work]:
    """Every work with its sizes; what they need is made here, and not timed."""
    yield Work("H1, 4 outputs", "samples", tuple((n, h1(n, 4)) for n in sizes(50_000)))
    yield Work("H1, 20,000 samples", "outputs", tuple((n, h1(20_000, n)) for n in sizes(2)))
    long = {n: recorded(where / f"{n}_rows.mcap", n, 8) for n in sizes(10_000)}
    wide = {n: recorded(where / f"{n}_wide.mcap", 2_000, n) for n in sizes(8)}
    for i, what in enumerate(("recording", "reading")):
        yield Work(f"{what}, 8 channels", "samples", tuple((n, c[i]) for n, c in long.items()))
        yield Work(f"{what}, 2,000 samples", "channels", tuple((n, c[i]) for n, c in wide.items()))
    samii = load_rig("samii")[0]
    few = tuple((n, response(samii, n)) for n in sizes(500))
    yield Work("transfer matrices, SAMII", "frequencies", few)
    chains = {len(rig.element): rig for rig in map(pieces, sizes(2))}
    many = tuple((n, response(rig, LINES)) for n, rig in chains.items())
    yield Work(f"transfer matrices, {LINES} frequencies", "elements", many)
    found = tuple((n, partial(natural_frequencies, rig, 0.3, 20.0)) for n, rig in chains.items())
    yield Work("natural frequencies to 20 Hz", "elements", found)
    files = {n: indexed(where / f"{n}", n) for n in sizes(30)}
    for i, what in enumerate(("index, built", "index, nothing new", "index, searched")):
        yield Work(what, "recordings", tuple((n, c[i]) for n, c in files.items()))
    yield Work("scores of a campaign", "trials", tuple(scored(n) for n in TIMES))
    alone = tuple((n, divided(n)) for n in (1, 2, 4, 8))
    yield Work(f"study of {POINTS} points, passed", "workers", alone, time.perf_counter)


def sizes(first: int) -> tuple[int, ...]:
    return tuple(first * n for n in TIMES)


def measured(all_works: list[Work], rounds: int) -> list[list[float]]:
    """Median s of each size of each work."""
    took: list[list[list[float]]] = [[[] for _ in work.sizes] for work in all_works]
    for turn in range(rounds + 1):
        for work, each in zip(all_works, took, strict=True):
            for (_, call), seconds in zip(work.sizes, each, strict=True):
                start = work.clock()
                call()
                if turn:  # the first compiles, and fills caches
                    seconds.append(work.clock() - start)
    return [[statistics.median(seconds) for seconds in each] for each in took]


def exponent(work: Work, seconds: list[float]) -> float:
    """Slope of the logarithms between the last two sizes."""
    (a, _), (b, _) = work.sizes[-2:]
    return math.log(seconds[-1] / seconds[-2]) / math.log(b / a)


def row(work: Work, seconds: list[float]) -> str:
    """A line of the table."""
    each = ", ".join(f"{n:,}: {told(s)}" for (n, _), s in zip(work.sizes, seconds, strict=True))
    return f"| {work.what} | {work.of} | {each} | {exponent(work, seconds):.2f} |"


def told(seconds: float) -> str:
    """Three digits, in a unit that a person reads."""
    for unit, factor in (("s", 1.0), ("ms", 1e3)):
        if seconds * factor >= 1:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"


PAGE = """# How cost grows

Made with the code of commit {commit} by
`python benchmarks/bench_growth.py --rounds {rounds} --page docs/evidence/growth.md`.
Process time on one core, medians of {rounds} rounds, on a shared machine of {cores} cores
(load {load:.1f} meanwhile). Of workers it is the time that passes, by a clock.
An exponent of 1 means that ten times the work costs ten times as much.

| work | grows with | cost | exponent |
|---|---|---|---|
{table}

"""


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--page", type=Path, help="the page to write the table into")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        all_works = list(works(Path(temporary)))
        found = measured(all_works, options.rounds)
    table = "\n".join(row(w, s) for w, s in zip(all_works, found, strict=True))
    print(table)
    if options.page is None:
        return
    ask = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(ask, capture_output=True, text=True, check=True).stdout.strip()
    kept = options.page.read_text("utf-8") if options.page.exists() else ""
    said = kept[kept.find("## ") :] if "## " in kept else ""  # what a person wrote below
    load, cores = os.getloadavg()[0], os.cpu_count()
    page = PAGE.format(commit=commit, rounds=options.rounds, cores=cores, load=load, table=table)
    options.page.write_text(page + said if said else page.rstrip("\n") + "\n", "utf-8")


if __name__ == "__main__":
    main()
