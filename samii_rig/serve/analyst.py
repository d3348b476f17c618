"""Estimates and diagnoses a run while it goes on, in processes of its own.

    python -m samii_rig.serve.analyst JOB_FOLDER RECORDINGS

It reads the recording as far as it is on the disk, so that neither the loop nor the service ever
waits for it, and writes two files of JSON into the job's folder, each whole or not at all. The
diagnosis has a process beside, which takes as long as it takes. It ends with whoever started it:
when its standard input is closed.
"""

from __future__ import annotations

import math
import os
import resource
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from samii_rig.errors import RecordingError, SamiiRigError
from samii_rig.progress import reporting
from samii_rig.record.reader import read_events, read_recording
from samii_rig.record.writer import PARTIAL
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.serve.drawn import Drawn
from samii_rig.serve.following import following
from samii_rig.serve.job import DOING, RESPONSES, RIG, SO_FAR, Job
from samii_rig.serve.live import LiveReader
from samii_rig.serve.planned import planned
from samii_rig.serve.sofar import SoFar
from samii_rig.types import FrequencyResponse
from samii_rig.workers import ends_with_its_parent

if TYPE_CHECKING:
    from samii_rig.diagnose.result import Diagnosis

LOOK_EVERY = 1.0  # s between looks
MEMORY = 8 << 30  # bytes of address space
NICE = 5  # steps behind the loop and the service
SITES = 4  # that are told


class Analyst:
    """One run. recordings : the folder in which its recording lies."""

    def __init__(self, job: Job, recordings: Path) -> None:
        self.job = job
        self._path = recordings / job.request.recording
        run = planned(job)
        self._setup, self._text, self._plan = run.setup, run.experiment_toml, run.plan
        self._so_far = SoFar(self._plan)
        self._start: int | None = None
        self._drawn = Drawn(self._setup.rig, self._plan)
        self._diagnoser = Diagnoser(self._setup.rig_toml)
        self._given: list[FrequencyResponse] = []
        self._segment = -1
        self._doing = ""

    def go(self) -> None:
        """Look every second until the run is over."""
        self.job.tell(RESPONSES, self._responses(0.0))
        while self.job.written.phase == "running":
            begun = time.monotonic()
            # It was just renamed, nothing is there yet, or it is too long for a look.
            with suppress(RecordingError, MemoryError):
                self.look()
            self._diagnose()
            took = time.monotonic() - begun
            # Of a long recording each look takes its time: half a processor at most.
            time.sleep(max(LOOK_EVERY - took, took))
        # It may have ended while a look was taken.
        with suppress(RecordingError, MemoryError):
            self.look(last=True)

    def look(self, *, last: bool = False) -> None:
        """Estimate what is new on the disk. last : all of it is there."""
        segment = len(self._plan.segments)
        if not last:
            segment = int(LiveReader(Path(self.job.written.live)).progress().get("segment", 0))
            if segment == self._segment and not self._so_far.growing:
                return
        path = self._path.with_name(self._path.name + PARTIAL)
        path = path if path.exists() else self._path
        if self._start is None:
            told = [e for e in read_events(path, partial=True) if e.name == "plan"]
            self._start = int(told[0].payload["start"]) if told else None
        if self._start is None:
            return
        begun = time.monotonic()
        # What is said of it goes to people who need not know where it lies.
        recording = replace(read_recording(path, partial=True), source=self._path.name)
        if self._so_far.take(recording, self._start):
            self.job.tell(RESPONSES, self._responses(time.monotonic() - begun))
        # A segment that is over counts as looked at once it is on the disk.
        self._segment = segment if self._so_far.done >= segment - 1 else -1

    def _responses(self, took: float) -> dict[str, Any]:
        so_far = self._so_far
        done, trouble = so_far.done, so_far.trouble
        return self._drawn.told(so_far.responses(), done, trouble=trouble, took_s=took)

    def _diagnose(self) -> None:
        """Take what was found, and ask again if there is something new to ask."""
        found = self._diagnoser.taken()
        if self._diagnoser.doing != self._doing:
            self._doing = self._diagnoser.doing
            self.job.tell(DOING, {"doing": self._doing})
        if found is not None:
            next_toml = following(found.get("experiment", ""), self._text)
            self.job.tell(SO_FAR, {**found, "next_toml": next_toml})
        sound = self._so_far.sound
        asked_of = sound or [r for r, _ in self._so_far.responses()]
        if not asked_of or not self._diagnoser.idle:
            return
        # A level's newer estimate is another object; kept, so that no other takes its place.
        if [id(r) for r in asked_of] == [id(r) for r in self._given]:
            return
        self._given = asked_of
        levels, of_levels = self._so_far.levels
        about = {
            "time": time.time(),
            "done": self._so_far.done,
            "of": len(self._plan.segments),
            "repeats": bool(sound),
            "levels": levels,
            "of_levels": of_levels,
            "low_hz": min(float(r.frequency[0]) for r in asked_of),
            "high_hz": max(float(r.frequency[-1]) for r in asked_of),
        }
        self._diagnoser.ask(about, asked_of)


class Diagnoser:
    """Diagnoses in a process beside, one set of responses after the other."""

    def __init__(self, rig_toml: str) -> None:
        context = get_context("spawn")
        self._line, theirs = context.Pipe()
        process = context.Process(target=_diagnosing, args=(theirs, rig_toml), daemon=True)
        process.start()
        theirs.close()
        self.idle, self.doing = True, ""

    def ask(self, about: dict[str, Any], responses: Sequence[FrequencyResponse]) -> None:
        """Begin; `about` comes back with what is found."""
        self._line.send((about, responses))
        self.idle = False

    def taken(self) -> dict[str, Any] | None:
        """What was found since, None if nothing was; meanwhile `doing` says what is tried."""
        while not self.idle and self._line.poll():
            found: dict[str, Any] | str = self._line.recv()
            if isinstance(found, str):
                self.doing = found
                continue
            self.idle, self.doing = True, ""
            return found
        return None


def _diagnosing(line: Connection, rig_toml: str) -> None:
    from samii_rig.diagnose.diagnose import diagnose

    # A diagnosis that nobody waits for any more takes no processor from the next run.
    ends_with_its_parent()
    rig = parse(Rig, rig_toml, RIG)
    # The one who asks is gone when nothing comes any more.
    with suppress(EOFError, OSError):
        while True:
            about, responses = line.recv()
            begun = time.monotonic()
            try:
                found = said(diagnose(responses, rig, progress=reporting(line.send)))
            except SamiiRigError as error:
                found = {"verdict": "", "trouble": str(error)}
            line.send({**about, **found, "took_s": time.monotonic() - begun})


def said(found: Diagnosis) -> dict[str, Any]:
    """A diagnosis as a display shows it. nothing : chance that nothing is missing, None where no
    explanation that was tried describes the data: chances among those say nothing then.

    probability : of the answer, 0 where there is none.
    """
    plain = found.plain()
    # Odds of the first explanation against all others that were looked at.
    first = 1 / (1 + math.exp(-min(max(found.evidence["odds"], -700.0), 700.0)))
    if not found.evidence["causes"]:
        nothing = first
    elif found.verdict == "no_mismatch":
        nothing = 1 - first
    else:
        nothing = sum(p for causes, p in found.alternatives if not causes)
    answer = nothing if found.verdict == "no_mismatch" else 0.0
    if found.causes:
        answer = min(c.probability for c in found.causes)
    return {
        "verdict": found.verdict,
        "lines": list(found.lines()),
        "nothing": None if found.verdict == "unknown" else float(nothing),
        "probability": 0.0 if found.verdict == "unknown" else float(answer),
        "causes": plain["causes"],
        "sites": plain["sites"][:SITES],
        "why": found.why,
        "experiment": found.experiment,
    }


def _ends_with_its_input() -> None:
    while os.read(0, 1):
        pass
    os._exit(0)


def main() -> None:
    """Entry point."""
    threading.Thread(target=_ends_with_its_input, daemon=True).start()
    os.nice(NICE)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    try:
        Analyst(Job(Path(sys.argv[1])), Path(sys.argv[2])).go()
    except SamiiRigError as error:
        print(f"samii-rig: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
