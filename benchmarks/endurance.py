"""Run the wire-level rig for a long time, on a loaded machine or under faults from a seed.

    python benchmarks/endurance.py load --rate 1000 --seconds 600     # both cores busy
    python benchmarks/endurance.py load --rate 1000 --image build/qemu/node.bin   # both idle
    python benchmarks/endurance.py faults --seconds 3600 --seed 1     # a fault in every run

`load` reports lateness of the ticks and latency of the samples (p50, p99, p99.9, worst), what was
lost, and CPU. Latency is the time from a sample's instant to its arrival at the gate, beyond that
of the promptest one. `faults` checks after each run that the output is at null, that it was so
within the deadman's time of its last feed, that no reference was beyond the plan's, that a fault is
latched, and that the recording verifies or recovers; and that memory, threads and open files do
not grow. A run that was refused before its recording was opened has none and is listed with the
reason. Exit code 1 if anything does not hold.
"""

import argparse
import errno
import gc
import multiprocessing
import os
import random
import resource
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))
from fault_host import VOLTS, plan_of
from faults_kit import PATIENCE, Hosts
from wire_kit import Wire

from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import SamiiRigError
from samii_rig.record.appender import Appender
from samii_rig.record.reader import read_recording
from samii_rig.record.recover import recover
from samii_rig.record.verify import verify
from samii_rig.record.writer import PARTIAL, RunWriter
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.run import campaign
from samii_rig.run.client import Client
from samii_rig.run.dryrun import DryRun, predict
from samii_rig.run.order import RunOrder
from samii_rig.run.outcome import Outcome
from samii_rig.run.plan import Plan
from samii_rig.safety.latch import Latch
from samii_rig.types import Float, Int, SampleBlock

WARM = 5  # runs until memory counts
GROWTH = 64 << 20  # bytes that memory may grow by after that
TELL = 300.0  # s between lines that say how it goes
STEP = 1e-3  # V, more than a step of the node's converter
LINE = ("loss", "flip", "duplicate", "reorder")
STRAY = "stray 500"  # the converter by itself, which can be seen and not ended
LATCHED = ("tripped", "failed")
DISK, KILLED = "disk full", "program killed"
ADD_CHUNK = Appender.add_chunk
# What ends every run in which it begins, and what may end one.
ENDING = (
    "emergency 1",
    "jump 5000",
    "rail 0 1",
    "offset a_2 26400",
    "drift a_0 2e5",
    "stall 0.3",
    STRAY,
    "reboot",
    "clock -3000000",
    "unplug",
    DISK,
)
FAULTS = (
    "",
    *ENDING,
    KILLED,
    "freeze theta_2 1",
    "freeze a_0 1",
    "line down flip 2e-3",
    "line down loss 2e-3",
    "line down duplicate 0.5",
    "line up loss 0.02",
    "line up reorder 0.5",
)


class Timed:
    """A device that notes how late each sleep of its clock ends, s, and how long after its instant
    each sample is given, ns plus something that is the same for all."""

    def __init__(self, device: OpenRig) -> None:
        self.late: list[float] = []
        self.ages: list[Int] = []
        self._sleep, self._read = device.clock.sleep, device.sensor.read
        object.__setattr__(device, "clock", self)
        device.sensor.read = self.read
        self.now = time.monotonic_ns

    def sleep(self, seconds: float) -> None:
        due = time.monotonic() + max(0.0, seconds)
        self._sleep(seconds)
        self.late.append(time.monotonic() - due)

    def read(self) -> SampleBlock:
        block = self._read()
        self.ages.append(time.monotonic_ns() - block.time)
        return block


def burn() -> None:
    while True:
        sum(i * i for i in range(10_000))


def timed_run(wire: Wire, plan: Plan, predicted: DryRun, path: Path) -> tuple[Outcome, Timed]:
    opens, made = campaign.open_device, []

    def opening(rig: Rig, settings: dict[str, object]) -> OpenRig:
        device = opens(rig, settings)
        made.append(Timed(device))
        return device

    campaign.open_device = opening
    try:
        return campaign.carry_out(RunOrder(wire.rig, "", "", plan, predicted), path), made[0]
    finally:
        campaign.open_device = opens


def wired(rate: float, folder: Path, seed: int, *more: str) -> Wire:
    text = load_rig("samii")[1].replace("rate_hz = 500.0", f"rate_hz = {rate}")
    if "--image" in more:  # an emulator may be late by tens of ms, as no board is
        late = "stale_after = 0.2\n"
        text = text.replace("deadman = 0.05", "deadman = 0.2").replace("stale_after = 0.05\n", "")
        text = text.replace("[[sensor]]\n", f"[[sensor]]\n{late}")
    path = folder / "rig.toml"
    path.write_text(text)
    return Wire("--seed", str(seed), *more, rig=str(path))


def told(what: str, ms: Float) -> None:
    p = np.percentile(ms, [50, 99, 99.9])
    print(
        f"{what} {p[0]:.2f} ms p50, {p[1]:.2f} p99, {p[2]:.2f} p99.9, {ms.max():.2f} at worst, "
        f"of {len(ms)}"
    )


def load(chosen: argparse.Namespace, folder: Path) -> int:
    image = ("--image", str(chosen.image.resolve())) if chosen.image else ()
    wire = wired(chosen.rate, folder, chosen.seed, *image)
    plan = plan_of(wire.rig, chosen.seconds)
    # A sine does not change: what is predicted of two seconds of it holds for all.
    predicted = predict(plan_of(wire.rig, 2.0), wire.rig)
    # An emulator needs a core for itself, of which a board has one.
    busy = 0 if chosen.image else os.cpu_count() or 1
    burners = [multiprocessing.Process(target=burn, daemon=True) for _ in range(busy)]
    for b in burners:
        b.start()
    wire.rest()
    before, start = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
    outcome, timed = timed_run(wire, plan, predicted, folder / "load.mcap")
    took, after = time.monotonic() - start, resource.getrusage(resource.RUSAGE_SELF)
    for b in burners:
        b.kill()
        b.join()
    node = wire.history()["late"]
    wire.close()
    # What came first had waited while the recording was opened.
    age = np.concatenate([a for a in timed.ages if len(a)][1:])
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(
        f"{chosen.rate:g} Hz, {took:.0f} s, {outcome.stop.status}: {outcome.stop.reason}; "
        f"{len(outcome.recording)} samples, {outcome.stop.missing_samples} lost, "
        f"{outcome.stop.late_ticks} ticks over 10 ms late"
    )
    told("ticks late by", 1e3 * np.array(timed.late))
    told("samples' latency", 1e-6 * (age - age.min()))
    print(f"CPU {cpu / took:.0%} of a core, estimate included; node late by {node * 1e-6:.1f} ms")
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


class Endured:
    """The rig under one fault after the other; `wrong` is what did not hold, `refused` which runs
    ended before their recording was opened, in words."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.rng = folder, random.Random(seed)
        self.wire, self.hosts = wired(500.0, folder, seed), Hosts()
        self.plan = plan_of(self.wire.rig, 3.0)
        self.predicted = predict(self.plan, self.wire.rig)
        self.latch = Latch(self.wire.rig.name, self.wire.rig.device.driver)
        self.wrong: list[str] = []
        self.refused: list[str] = []
        self.opened = False  # the recording of the run at hand
        self.began = False  # its fault, or the wait for it, once it ran
        self.ends: Counter[tuple[str, str]] = Counter()
        self.samples = 0

    def one(self, n: int) -> None:
        """A run with a fault from a random moment on, while it runs; of five one at any moment."""
        self.wire.rest()
        self.wire.tell(*(f"line {way} {what} 0" for way in ("up", "down") for what in LINE))
        if self.latch.fault:
            self.latch.clear("endurance", "the next run")
        fault, path = self.rng.choice(FAULTS), self.folder / f"{n}.mcap"
        # At first the output is still at rest: it begins 0.1 s ahead.
        running, delay = self.rng.random() < 0.8, self.rng.uniform(0.2, 2.0)
        boot, self.opened, self.began = self.wire.history()["boot"], False, False
        status, reason = (
            self._host(fault, delay, path)
            if fault == KILLED
            else self._run(fault, delay, path, running=running)
        )
        self.ends[fault, status] += 1
        if running and status == "completed" and fault in ENDING:
            self.wrong.append(f"run {n}: {fault} ended nothing")
        # What was refused before it was armed, by a late machine too, has nothing to latch.
        if (self.began or status == "tripped") and status in LATCHED and not self.latch.fault:
            self.wrong.append(f"run {n}, {fault}: {status}, and nothing is latched")
        if fault == "unplug":
            self.wire.rig.device.settings["port"] = self.wire.plug()
        time.sleep(0.1)
        h = self.wire.history()
        stray = fault == STRAY
        # A run that ended before its fault began has no stray voltage either.
        if h["v"] not in ((0, 500) if stray else (0,)) or h["state"] in ("LIVE", "DRY"):
            self.wrong.append(f"run {n}, {fault}: output {h}")
        if not stray and h["boot"] == boot and h["live"] - h["fed"] >= PATIENCE:
            self.wrong.append(f"run {n}, {fault}: the output outlived its gate: {h}")
        if not self.opened:
            self.refused.append(f"run {n}, {fault}: {reason}")
            return
        try:
            self._check(path)
        except (SamiiRigError, AssertionError) as error:
            self.wrong.append(f"run {n}, {fault}: {error}")

    def close(self) -> None:
        self.hosts.close()
        self.wire.close()

    def _run(self, fault: str, delay: float, path: Path, *, running: bool) -> tuple[str, str]:
        """How it ended and why; a fault of the disk is in this process, others in the rig's."""
        chunks = iter(range(6 if fault == DISK else 1 << 30))

        def add_chunk(appender: Appender, pieces: object) -> None:
            if next(chunks, None) is None:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            ADD_CHUNK(appender, pieces)

        def opening(*given: object, **named: object) -> RunWriter:
            writer = RunWriter(*given, **named)
            self.opened = True
            return writer

        timer = threading.Timer(delay, self._inject, [fault])

        def progress(_: object) -> None:
            if running and not self.began:
                self.began = True
                timer.start()

        if not running:
            timer.start()
        Appender.add_chunk, campaign.RunWriter = add_chunk, opening
        try:
            outcome = campaign.carry_out(
                RunOrder(self.wire.rig, "", "", self.plan, self.predicted), path, Client(progress)
            )
            return outcome.stop.status, outcome.stop.reason
        except SamiiRigError as error:
            return type(error).__name__, str(error)
        finally:
            Appender.add_chunk, campaign.RunWriter = ADD_CHUNK, RunWriter
            timer.cancel()
            if timer.ident is not None:
                timer.join()

    def _inject(self, fault: str) -> None:
        if fault not in ("", DISK):
            self.wire.tell(fault)

    def _host(self, fault: str, delay: float, path: Path) -> tuple[str, str]:
        """A program that is killed while it runs: how it ended and why."""
        try:
            pid = self.hosts.start(self.wire, "running", path)
        except AssertionError as ended:  # by this machine's own lateness
            # An error may have come before there was a recording.
            made = path.exists() or partial_of(path).exists()
            self.opened = made or not str(ended).startswith("error")
            return "ended before it was killed", str(ended)
        self.opened = True
        time.sleep(1.0 + delay)  # there is something on the disk after a second
        os.kill(pid, signal.SIGKILL)
        return f"{fault}: {self.hosts.wait(pid)}", ""

    def _check(self, path: Path) -> None:
        partial = partial_of(path)
        if partial.exists():
            path = path.with_stem("recovered")
            recover(partial, path)
        found = verify(path)
        assert found.status == "whole", found.problems
        recording = read_recording(path)
        assert (np.diff(recording.sequence) >= 1).all(), "samples out of order"
        u = np.abs(recording.values[:, 0]).max(initial=0.0)
        assert u <= VOLTS + STEP, f"a reference of {u} V that nobody sent"
        self.samples += len(recording)
        path.unlink()
        partial.unlink(missing_ok=True)


def partial_of(path: Path) -> Path:
    return path.with_name(path.name + PARTIAL)


def faults(chosen: argparse.Namespace, folder: Path) -> int:
    endured = Endured(folder, chosen.seed)
    began, runs, first, tell = time.monotonic(), 0, None, 0.0
    while (since := time.monotonic() - began) < chosen.seconds:
        endured.one(runs)
        runs += 1
        if runs == WARM:
            first = state()
        if since >= tell:
            tell += TELL
            print(
                f"{since:.0f} s, {runs} runs, {grown(state())}",
                *endured.wrong,
                *endured.refused,
                sep="\n",
                flush=True,
            )
    last = state()
    endured.close()
    for (fault, status), n in sorted(endured.ends.items()):
        print(f"{n:5d}  {fault or 'no fault'}: {status}")
    print(f"{runs} runs, {endured.samples} samples; {grown(first or last)} -> {grown(last)}")
    if first and (last[0] - first[0] > GROWTH or last[1] > first[1] or last[2] > first[2]):
        endured.wrong.append("memory, threads or open files grew")
    print(f"{len(endured.refused)} refused before they began", *endured.refused, sep="\n")
    print(*endured.wrong, sep="\n")
    return 1 if endured.wrong else 0


def grown(s: tuple[int, int, int]) -> str:
    return f"{s[0] >> 20} MB, {s[1]} threads, {s[2]} files"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("load", "faults"))
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--rate", type=float, default=500.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--image", type=Path, help="of load: firmware in QEMU as the node")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        os.environ["SAMII_RIG_STATE"] = str(Path(name) / "state")
        return {"load": load, "faults": faults}[chosen.what](chosen, Path(name))


if __name__ == "__main__":
    sys.exit(main())
