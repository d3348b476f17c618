"""Run the wire-level rig for a long time, on a loaded machine or under faults from a seed.

    python benchmarks/endurance.py load --rate 1000 --seconds 600     # both cores busy
    python benchmarks/endurance.py faults --seconds 3600 --seed 1     # a fault in every run

`load` reports lateness of the ticks (p50, p99, p99.9, worst), lost samples and CPU. `faults` checks
after each run that the output is at null, that the recording verifies or recovers, and that
memory, threads and open files do not grow. Exit code 1 if anything does not hold.
"""

import argparse
import gc
import multiprocessing
import os
import random
import resource
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from fault_host import plan_of
from wire_kit import Wire

from samii_rig.errors import SamiiRigError
from samii_rig.record.reader import read_recording
from samii_rig.record.recover import recover
from samii_rig.rig.load import load_rig
from samii_rig.run import campaign
from samii_rig.run.dryrun import predict
from samii_rig.run.latch import Latch

WARM = 5  # runs until memory counts
GROWTH = 64 << 20  # bytes that memory may grow by after that
FAULTS = (
    "",
    "emergency 1",
    "jump 5000",
    "rail 0 1",
    "offset a_2 26400",
    "drift a_0 2e5",
    "freeze theta_2 1",
    "freeze a_0 1",
    "stall 0.3",
    "stray 500",
    "reboot",
    "clock -3000000",
    "line down flip 2e-3",
    "line down loss 2e-3",
    "line down duplicate 0.5",
    "line up reorder 0.5",
    "unplug",
)


class Timed:
    """A clock that notes how late each sleep ends."""

    def __init__(self, clock: object) -> None:
        self.clock, self.late = clock, []
        self.now = clock.now

    def sleep(self, seconds: float) -> None:
        due = time.monotonic() + max(0.0, seconds)
        self.clock.sleep(seconds)
        self.late.append(time.monotonic() - due)


def burn() -> None:
    while True:
        sum(i * i for i in range(10_000))


def carried_out(wire: Wire, plan, predicted, path: Path, clocks: list) -> object:
    """A run whose clock is timed."""
    opens = campaign.open_device

    def timed(rig, settings):
        device = opens(rig, settings)
        clocks.append(Timed(device.clock))
        object.__setattr__(device, "clock", clocks[-1])
        return device

    campaign.open_device = timed
    try:
        return campaign.carry_out(wire.rig, "", "", plan, predicted, path)
    finally:
        campaign.open_device = opens


def wired(rate: float, folder: Path, seed: int) -> Wire:
    text = load_rig("samii")[1].replace("rate_hz = 500.0", f"rate_hz = {rate}")
    path = folder / "rig.toml"
    path.write_text(text)
    return Wire("--seed", str(seed), rig=str(path))


def load(chosen: argparse.Namespace, folder: Path) -> int:
    wire = wired(chosen.rate, folder, chosen.seed)
    plan = plan_of(wire.rig, chosen.seconds)
    # A sine does not change: what is predicted of two seconds of it holds for all.
    predicted = predict(plan_of(wire.rig, 2.0), wire.rig)
    burners = [
        multiprocessing.Process(target=burn, daemon=True) for _ in range(os.cpu_count() or 1)
    ]
    for b in burners:
        b.start()
    clocks: list[Timed] = []
    before, start = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
    outcome = carried_out(wire, plan, predicted, folder / "load.mcap", clocks)
    took, after = time.monotonic() - start, resource.getrusage(resource.RUSAGE_SELF)
    for b in burners:
        b.terminate()
    wire.close()
    late = 1e3 * np.array(clocks[0].late)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    p = np.percentile(late, [50, 99, 99.9])
    print(
        f"{chosen.rate:g} Hz, {took:.0f} s, {outcome.stop.status}: {outcome.stop.reason}; "
        f"{len(outcome.recording)} samples, {outcome.stop.missing_samples} lost, "
        f"{outcome.stop.late_ticks} ticks over 10 ms late"
    )
    print(
        f"{len(late)} sleeps, late by {p[0]:.2f} ms p50, {p[1]:.2f} p99, {p[2]:.2f} p99.9, "
        f"{late.max():.1f} at worst; CPU {cpu / took:.0%} of a core, estimate included"
    )
    return 0 if outcome.stop.status == "completed" and not outcome.stop.missing_samples else 1


def state() -> tuple[int, int, int]:
    """Resident memory, threads, open files of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return (
        pages * os.sysconf("SC_PAGE_SIZE"),
        threading.active_count(),
        len(list(Path("/proc/self/fd").iterdir())),
    )


def faults(chosen: argparse.Namespace, folder: Path) -> int:
    wire = wired(500.0, folder, chosen.seed)
    rng, wrong, ends = random.Random(chosen.seed), [], {}
    plan = plan_of(wire.rig, 3.0)
    predicted = predict(plan, wire.rig)
    latch = Latch(wire.rig.name, wire.rig.device.driver)
    began, runs, first = time.monotonic(), 0, None
    while time.monotonic() - began < chosen.seconds:
        wire.rest()
        wire.tell(
            *(
                f"line {w} {f} 0"
                for w in ("up", "down")
                for f in ("loss", "flip", "duplicate", "reorder")
            )
        )
        if latch.fault:
            latch.clear("endurance", "the next run")
        fault, path = rng.choice(FAULTS), folder / f"{runs}.mcap"
        timer = threading.Timer(rng.uniform(0.2, 2.5), wire.tell, [fault] if fault else [])
        timer.start()
        try:
            status = carried_out(wire, plan, predicted, path, []).stop.status
        except SamiiRigError as error:
            status = type(error).__name__
        timer.join()
        ends[status] = ends.get(status, 0) + 1
        if fault == "unplug":
            wire.rig.device.settings["port"] = wire.plug()
        partial = path.with_name(f"{path.name}.partial")
        time.sleep(0.1)
        h = wire.history()
        if h["v"] != (500 if fault == "stray 500" else 0) or h["state"] in ("LIVE", "DRY"):
            wrong.append(f"run {runs}, {fault}: output {h}")
        try:
            if partial.exists():
                recover(partial, path)
            sequence = read_recording(path).sequence
            if (np.diff(sequence) < 1).any():
                wrong.append(f"run {runs}, {fault}: samples out of order")
        except SamiiRigError as error:
            wrong.append(f"run {runs}, {fault}: {error}")
        path.unlink(missing_ok=True)
        partial.unlink(missing_ok=True)
        runs += 1
        if runs == WARM:
            first = state()
    wire.close()
    print(f"{runs} runs: {ends}")
    if first:
        last = state()
        print(
            f"memory {first[0] >> 20} -> {last[0] >> 20} MB, threads {first[1]} -> {last[1]}, "
            f"files {first[2]} -> {last[2]}"
        )
        if last[0] - first[0] > GROWTH or last[1] > first[1] or last[2] > first[2]:
            wrong.append("memory, threads or open files grew")
    print(*wrong, sep="\n")
    return 1 if wrong else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("load", "faults"))
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--rate", type=float, default=500.0)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        os.environ["SAMII_RIG_STATE"] = str(Path(name) / "state")
        return {"load": load, "faults": faults}[chosen.what](chosen, Path(name))


if __name__ == "__main__":
    sys.exit(main())
