"""Concealed trials, made and diagnosed on all cores or on a cluster, resumable at any point.

    OUT/recordings/<trial>/*.mcap      what the diagnosis reads
    OUT/truth/<trial>.json             what it must not read, written before
    OUT/answers/<trial>.json           what it said
    OUT/sizes/<trial>.json             how large the effect is in the data (`prove.size`)

The plant that makes the recordings is found by its entry point (`samii_rig.plants`), as devices
are: nothing here knows it. A process that diagnoses refuses to open a truth (an audit hook, which
nothing in the process can take back), and checks that the recordings carry the truth's hash.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future, as_completed
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from samii_rig.diagnose.stated import Evidence
from samii_rig.errors import InputError, SamiiRigError
from samii_rig.prove.calibrate import places, row
from samii_rig.prove.trial import Answer, Hidden, Trial, Truth
from samii_rig.record.export import replacing
from samii_rig.record.reader import read_notes, read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig

if TYPE_CHECKING:
    from samii_rig.prove.size import Sized

GROUP = "samii_rig.plants"
KINDS = ("nothing", "one", "two", "outside", "joints")


@dataclass(frozen=True, slots=True)
class Job:
    """One trial to be made and diagnosed."""

    kind: str
    seed: int


@dataclass(frozen=True, slots=True)
class Campaign:
    """Where the trials are, the rig that they hide something in, the plant that makes them.

    keep : whether recordings stay once they have been diagnosed.
    """

    out: Path
    rig_toml: str
    plant: str = "concealed"
    keep: bool = False


def jobs(counts: Mapping[str, int], seed: int) -> list[Job]:
    """`counts` trials of each kind with seeds from `seed` on, kinds in turn, so that a
    campaign that is stopped early has some of each."""
    rows = [[Job(k, seed + i) for i in range(counts.get(k, 0))] for k in KINDS]
    place = [
        ((i + 0.5) / len(row), k, job) for k, row in enumerate(rows) for i, job in enumerate(row)
    ]
    return [job for _, _, job in sorted(place, key=lambda x: x[:2])]


def carry_out(
    campaign: Campaign,
    todo: Iterable[Job],
    executor: Executor,
    progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> list[str]:
    """Make and diagnose every trial that has no answer yet; returns what failed, in words.

    A trial that fails leaves no answer, and is done again by the next call.
    """
    waiting: dict[Future[None], Job] = {
        executor.submit(_one, campaign, job.kind, job.seed): job for job in todo
    }
    failures = []
    for n, future in enumerate(as_completed(waiting), 1):
        job = waiting[future]
        try:
            future.result()
        except SamiiRigError as error:
            failures.append(f"{job.kind} {job.seed}: {error}")
        progress(n, len(waiting))
    return failures


def _one(campaign: Campaign, kind: str, seed: int) -> None:
    """Make one trial, then have a process that sees no truth diagnose it."""
    folder = plant(campaign.plant)(kind, seed, campaign.out, campaign.rig_toml)
    answer = campaign.out / "answers" / f"{folder.name}.json"
    if answer.exists():
        return
    truth = campaign.out / "truth" / f"{folder.name}.json"
    _check_hash(folder, truth)
    said = _Reader.of(campaign.out / "truth").diagnose(folder)
    if "error" in said:
        raise SamiiRigError(said["error"])
    _write(campaign.out / "sizes" / answer.name, asdict(_sized(folder, truth, said)))
    _write(answer, said)
    if not campaign.keep:
        for log in folder.glob("*.mcap"):
            log.unlink()


def _sized(folder: Path, truth: Path, said: Mapping[str, Any]) -> Sized:
    """Sigma that the best simpler explanation leaves; the drawn one where nothing was recorded
    to compute it from."""
    from samii_rig.prove.size import Sized, size_of

    told = json.loads(truth.read_text("utf-8"))
    arrays = truth.with_suffix(".npz")
    if not arrays.exists():
        return Sized(float(told["size"]))
    log = min(folder.glob("*.mcap"))
    rig = parse(Rig, read_recording(log).rig_toml, str(log))
    causes = Answer.of(said).causes
    with np.load(arrays) as held:
        return size_of(told, held, rig, causes[0].names if causes else ())


def _write(path: Path, data: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        part.write_text(json.dumps(data, indent=1), encoding="utf-8")


def plant(name: str) -> Callable[[str, int, Path, str], Path]:
    """The plant of this name: (kind, seed, out, rig file's text) -> folder of the recordings."""
    known = {point.name: point for point in metadata.entry_points(group=GROUP)}
    if name not in known:
        raise InputError("samii-rig prove", "--plant", name, f"one of {', '.join(sorted(known))}")
    loaded: Callable[[str, int, Path, str], Path] = known[name].load()
    return loaded


def _check_hash(folder: Path, truth: Path) -> None:
    digest = hashlib.sha256(truth.read_bytes()).hexdigest()
    for log in folder.glob("*.mcap"):
        if read_notes(log).get("truth_sha256") != digest:
            raise SamiiRigError(f"{log}: its truth is not the one that it was made with")


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
        stdin.write(f"{folder}\n")
        stdin.flush()
        line = stdout.readline()
        if not line:
            raise SamiiRigError(f"{folder}: the diagnosis ended without an answer")
        said: dict[str, Any] = json.loads(line)
        return said


def results(out: Path) -> list[Trial]:
    """Every trial that has an answer, in the order of kind and seed."""
    trials = [Trial(truth, Answer.of(said)) for truth, said in _answers(out)]
    return sorted(trials, key=lambda t: (KINDS.index(t.truth.kind), t.truth.seed))


def evidence(out: Path) -> list[tuple[Evidence, bool]]:
    """Of every trial in which an effect was found: its evidence, and whether it was right."""
    return [found for truth, said in _answers(out) if (found := row(truth, said)) is not None]


def place_evidence(out: Path) -> list[tuple[Evidence, bool]]:
    """The same of each cause's place."""
    return [found for truth, said in _answers(out) for found in places(truth, said)]


def truth_of(out: Path, trial: str) -> Truth:
    """What a trial conceals, at the size that a refit leaves of it where that was found."""
    truth = json.loads((out / "truth" / f"{trial}.json").read_text("utf-8"))
    effects = tuple(Hidden(e["physics"], e["site"], e["parameters"]) for e in truth["effects"])
    file = out / "sizes" / f"{trial}.json"
    sized = json.loads(file.read_text("utf-8")) if file.exists() else {"size": truth["size"]}
    return Truth(truth["kind"], truth["seed"], effects, **sized)


def _answers(out: Path) -> Iterator[tuple[Truth, dict[str, Any]]]:
    for answer in sorted((out / "answers").glob("*.json")):
        yield truth_of(out, answer.stem), json.loads(answer.read_text("utf-8"))
