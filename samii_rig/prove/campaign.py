"""Concealed trials, made and diagnosed on all cores or on a cluster, resumable at any point.

    OUT/campaign.json                  plants, rigs and code of the first call
    OUT/recordings/<trial>/*.mcap      what the diagnosis reads
    OUT/truth/<trial>.json             what it must not read, written before
    OUT/answers/<trial>.json           what it said
    OUT/sizes/<trial>.json             how large the effect is in the data (`prove.size`)
    OUT/outcomes/<kind>_<seed>.json    which trial that was, its plant and rig, s of each part

The plants that make the recordings are found by their entry points (`prove.jobs`), as devices are:
nothing here knows them. A process that diagnoses refuses to open a truth (an audit hook, which
nothing in the process can take back); the recordings must carry the truth's hash.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED as FIRST
from concurrent.futures import Executor, Future, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.prove.jobs import Job, plant
from samii_rig.record.export import replacing
from samii_rig.record.reader import read_notes, read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig

if TYPE_CHECKING:
    from samii_rig.prove.size import Sized

LONGEST = 900.0  # s of a diagnosis, thirty times its goal: then it is ended and counts as failed
AT_ONCE = 4  # trials handed out for each one that was asked for, so that a stop ends soon


@dataclass(frozen=True, slots=True)
class Campaign:
    """Where the trials are, and the rig files (text by name) that they hide something in.

    keep : whether recordings stay once they have been diagnosed.
    """

    out: Path
    rigs: Mapping[str, str]
    keep: bool = False


Progress = Callable[[int, int], None]


def claim(out: Path, made: Mapping[str, Any]) -> None:
    """Note in `out` what its trials are made of, or check that it is that.

    InputError for a folder whose trials are of other plants or rigs.
    """
    file = out / "campaign.json"
    if not file.exists():
        _write(file, made)
        return
    first = json.loads(file.read_text("utf-8"))
    for key in ("plants", "rigs"):
        if sorted(first[key]) != sorted(made[key]):
            had = ", ".join(first[key])
            raise InputError("samii-rig prove", f"--{key[:-1]}", ", ".join(made[key]), had)


def carry_out(
    campaign: Campaign,
    todo: Iterable[Job],
    executor: Executor,
    progress: Progress = lambda _done, _failed: None,
    until: float = float("inf"),
) -> list[str]:
    """Make and diagnose every trial that has no answer yet; returns what failed, in words.

    A trial that fails leaves no answer, and is done again by the next call. until : instant of
    `time.monotonic` after which none is begun. progress : called with trials done and failed.
    """
    left = [job for job in todo if not _done(campaign.out, job)]
    running: set[Future[str]] = set()
    failures: list[str] = []
    done = 0
    try:
        while left or running:
            room = AT_ONCE * _size(executor) - len(running)
            while left and room > 0 and time.monotonic() < until:
                running.add(executor.submit(one, campaign, left.pop(0)))
                room -= 1
            if not running:
                break
            ended, running = wait(running, return_when=FIRST)
            for future in ended:
                done += 1
                failures += [said] if (said := _outcome(future)) else []
                progress(done, len(failures))
            if time.monotonic() >= until:
                running = {f for f in running if not f.cancel()}
    except KeyboardInterrupt:
        for future in running:
            future.cancel()
    return failures


def _size(executor: Executor) -> int:
    return int(getattr(executor, "_max_workers", 32))


def _outcome(future: Future[str]) -> str:
    try:
        return future.result()
    except Exception as error:  # a worker that was killed ends no campaign
        return f"{type(error).__name__}: {error}"


def _done(out: Path, job: Job) -> bool:
    file = out / "outcomes" / f"{job.name}.json"
    return file.exists() and "error" not in json.loads(file.read_text("utf-8"))


def one(campaign: Campaign, job: Job) -> str:
    """Make one trial, then have a process that sees no truth diagnose it; "" or what failed."""
    outcome: dict[str, Any] = {"plant": job.plant, "rig": job.rig, "kind": job.kind,
                               "seed": job.seed, "seconds": {}}  # fmt: skip
    try:
        _carried(campaign, job, outcome)
    except Exception as error:  # whatever ends a trial is said on the page, and ends no campaign
        outcome["error"] = str(error) if isinstance(error, SamiiRigError) else repr(error)
    _write(campaign.out / "outcomes" / f"{job.name}.json", outcome)
    return f"{job.kind} {job.seed}: {outcome['error']}" if "error" in outcome else ""


def _carried(campaign: Campaign, job: Job, outcome: dict[str, Any]) -> None:
    seconds = outcome["seconds"]
    outcome["at"] = "plant"
    start = time.process_time()
    folder = plant(job.plant)(job.kind, job.seed, campaign.out, campaign.rigs[job.rig])
    seconds["plant"] = time.process_time() - start
    truth = campaign.out / "truth" / f"{folder.name}.json"
    outcome |= {"trial": folder.name, "truth_sha256": _checked_hash(folder, truth)}
    outcome["at"] = "diagnosis"
    said = _Reader.of(campaign.out / "truth").diagnose(folder)
    seconds["diagnosis"] = said.get("seconds", LONGEST)
    if "error" in said:
        raise SamiiRigError(said["error"])
    outcome["at"] = "size"
    start = time.process_time()
    _write(campaign.out / "sizes" / f"{folder.name}.json", asdict(_sized(folder, truth)))
    seconds["size"] = time.process_time() - start
    _write(campaign.out / "answers" / f"{folder.name}.json", said["answer"])
    outcome["at"] = "end"
    if not campaign.keep:
        for log in folder.glob("*.mcap"):
            log.unlink()


def _sized(folder: Path, truth: Path) -> Sized:
    """Sigma that the best simpler explanation leaves; the truth's own where it holds no responses
    to compute it from."""
    from samii_rig.prove.size import Sized, size_of

    told = json.loads(truth.read_text("utf-8"))
    arrays = truth.with_suffix(".npz")
    if not arrays.exists():
        return Sized(float(told["size"]))
    log = min(folder.glob("*.mcap"))
    rig = parse(Rig, read_recording(log).rig_toml, str(log))
    with np.load(arrays) as held:
        return size_of(told, held, rig)


def _write(path: Path, data: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        part.write_text(json.dumps(data, indent=1), encoding="utf-8")


def _checked_hash(folder: Path, truth: Path) -> str:
    digest = hashlib.sha256(truth.read_bytes()).hexdigest()
    for log in folder.glob("*.mcap"):
        if read_notes(log).get("truth_sha256") != digest:
            raise SamiiRigError(f"{log}: its truth is not the one that it was made with")
    return digest


class _Reader:
    """The diagnosing process of this thread (a worker of a cluster may have several); one serves
    many trials, as its imports take long."""

    _running: ClassVar[dict[tuple[Path, int], _Reader]] = {}

    def __init__(self, truths: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "samii_rig.prove.reader", str(truths)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )

    @classmethod
    def of(cls, truths: Path) -> _Reader:
        """The one that must not see `truths`; started when there is none or it has died."""
        key = truths, threading.get_ident()
        reader = cls._running.get(key)
        if reader is None or reader._process.poll() is not None:
            reader = cls._running[key] = cls(truths)
        return reader

    def diagnose(self, folder: Path) -> dict[str, Any]:
        """What it says of a folder of recordings."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        watch = threading.Timer(LONGEST, self._process.kill)
        watch.start()
        try:
            stdin.write(f"{folder}\n")
            stdin.flush()
            line = stdout.readline()
        finally:
            watch.cancel()
        if not line:
            self._process.wait()
            return {"error": f"ended without an answer (within {LONGEST:g} s one is expected)"}
        # Names of files alone: what is kept of a trial is the same wherever it was made.
        where = json.dumps(f"{folder}{os.sep}")[1:-1]
        said: dict[str, Any] = json.loads(line.replace(where, ""))
        return said
