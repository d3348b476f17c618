"""A run that was asked for, as a folder: what was asked, how it stands, who works on it.

The folder is all that service and runner share on the disk. Whoever runs holds its lock, so that
a service that was started anew knows who is still alive without trusting a number of a process.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import secrets
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from samii_rig.errors import GateError, RecordingError
from samii_rig.serve.shared import get, made, put

NAME = re.compile(r"[^/\0]+\.mcap")  # of a recording, in the folder of all
ID = re.compile(r"\d{8}T\d{12}-[0-9a-f]{6}")
REQUEST, STATE, RIG, EXPERIMENT, LOCK, LOG, STOPS, RESPONSES, SO_FAR, ESTIMATE, DIAGNOSIS, DOING = (
    "request.json",
    "state.json",
    "rig.toml",
    "experiment.toml",
    "lock",
    "log.txt",
    "stops.jsonl",
    "responses.json",
    "diagnosis_so_far.json",  # the analyst's
    "estimate.json",  # the runner's last word, of all that was recorded
    "diagnosis.json",  # its last word, of a whole run
    "doing.json",  # what the analyst's diagnosis tries
)

# s without a sign of the service after which it counts as gone: it gives one every half second.
LOST_AFTER = 5.0
MOST_STOPS = 20  # that are written down
# s from the first stop until another one sends its signal once more: a run that obeys is at zero
# long before, and one that hangs in its device is cut off by the second.
INSIST_AFTER = 1.0
LOOKED = 0.002  # s; who only looks whether a job is run has its lock for microseconds
JOBS = "jobs"  # folder of all of them
ASKED = "stop_asked.json"  # in it: word of a stop to the service, which holds its queue

Phase = Literal[
    "queued", "starting", "running", "analysing", "done", "refused", "cancelled", "died"
]
OVER: tuple[Phase, ...] = ("done", "refused", "cancelled", "died")


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for. setup : which run of an experiment of several. recording : its name
    below the folder. settings : of the device, over those of the rig file. stop_when_certain : end
    once the diagnosis is (see `analysis`). pose : as it was asked for, "" for the rig file's; the
    job's rig file stands in it."""

    experiment: str
    recording: str
    operator: str = ""
    setup: int = 0
    instruction: str = ""
    diagnosis: bool = True
    duration_s: float = 0.0
    stop_when_certain: bool = False
    settings: dict[str, Any] = field(default_factory=dict)
    pose: str = ""


@dataclass(frozen=True, slots=True)
class JobState:
    """How it stands. status, reason : of the stop record. error : why there is none.
    live : path of the live data. early : why it ended before its plan did, in good order.
    at_zero : whether the last sample showed the output at zero; None where none was seen.
    ended : when, UTC, ISO 8601. doing : what the diagnosis tries, with the time left."""

    phase: Phase = "queued"
    pid: int = 0
    live: str = ""
    status: str = ""
    reason: str = ""
    error: str = ""
    trouble: str = ""
    verdict: str = ""
    early: str = ""
    at_zero: bool | None = None
    ended: str = ""
    time: str = ""
    doing: str = ""


class Job:
    """One of them. `id` sorts by the time at which it was asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.id = folder.name

    @classmethod
    def make(cls, jobs: Path, request: Request, rig_toml: str, experiment_toml: str) -> Job:
        """A new job, queued; RecordingError if the folder cannot be written."""
        name = f"{datetime.now(UTC):%Y%m%dT%H%M%S%f}-{secrets.token_hex(3)}"
        folder = jobs / name
        try:
            folder.mkdir(parents=True)
            (folder / RIG).write_text(rig_toml, encoding="utf-8")
            (folder / EXPERIMENT).write_text(experiment_toml, encoding="utf-8")
            job = cls(folder)
            job.set(JobState())
            # Last: a folder without it is not a job.
            put(folder / REQUEST, asdict(request), durable=True)
        except OSError as error:
            raise RecordingError(f"{folder} cannot be written: {error.strerror}") from error
        return job

    @staticmethod
    def all(jobs: Path) -> list[Job]:
        """All jobs, oldest first."""
        if not jobs.is_dir():
            return []
        found = (f for f in jobs.iterdir() if ID.fullmatch(f.name) and (f / REQUEST).is_file())
        return [Job(f) for f in sorted(found, key=lambda f: f.name)]

    def order(self) -> Request:
        """What was asked for; RecordingError where that cannot be read: it is not to be run."""
        found = made(Request, self.folder / REQUEST)
        if found.setup < 0 or not NAME.fullmatch(found.recording):
            raise RecordingError(f"{self.folder / REQUEST} is not what this version writes")
        return found

    @cached_property
    def request(self) -> Request:
        """What was asked for, for those who show it."""
        with suppress(RecordingError):
            return self.order()
        return Request("unreadable", f"{self.id}.mcap", diagnosis=False)

    @property
    def written(self) -> JobState:
        """How it stands, as was written last. One that cannot be read may still drive the rig."""
        try:
            return made(JobState, self.folder / STATE)
        except RecordingError as error:
            return JobState("running", error=str(error))

    def _holder(self) -> int:
        """The number of the process that runs it, as that wrote it into the lock; 0 for none."""
        with suppress(OSError, ValueError):
            return max(0, int((self.folder / LOCK).read_bytes()[:20]))
        return 0

    @property
    def state(self) -> JobState:
        """How it stands; `died` if whoever ran it is gone without a word."""
        state = self.written
        if state.phase in ("starting", "running", "analysing") and not self.alive():
            # It may have ended between the two looks.
            state = self.written
            if state.phase not in OVER:
                return JobState(**{**asdict(state), "phase": "died"})
        return state

    def set(self, state: JobState) -> None:
        """Write how it stands, whole or not at all."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        put(self.folder / STATE, {**asdict(state), "time": now}, durable=True)

    def tell(self, name: str, data: dict[str, Any]) -> None:
        """Write what is known so far into the file `name`, whole or not at all."""
        put(self.folder / name, data, durable=False)

    def alive(self) -> bool:
        """Whether somebody runs it now."""
        try:
            with (self.folder / LOCK).open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except BlockingIOError:
            return True
        return False

    @contextmanager
    def held(self) -> Iterator[int]:
        """This process runs it, and so does one that inherits the descriptor that this gives.

        GateError if another does already.
        """
        with (self.folder / LOCK).open("ab") as file:
            for last in (False, False, True):
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError as error:
                    if last:
                        raise GateError(f"{self.id} is run by another process") from error
                    time.sleep(LOOKED)
            yield file.fileno()

    def stop(self, by: str) -> bool:
        """Have the runner end at zero output; False if there is none. by : recorded.

        Any number may ask at once, from any process. A runner that has not even said its number
        yet finds the stop written, before anything moves.
        """
        if not self.alive():
            return False
        if self._first_to_stop(by) or (self.moving and self._insists()):
            pid = self._holder() or self.written.pid
            # Below 2 it would mean many processes, or the first of all.
            if pid > 1:
                with suppress(OSError, OverflowError):
                    os.kill(pid, signal.SIGTERM)
        return True

    def _first_to_stop(self, by: str) -> bool:
        """Write the stop down; whether it is the first, or could not be written."""
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = (json.dumps({"time": now, "by": by}) + "\n").encode()
        path, how = self.folder / STOPS, os.O_WRONLY | os.O_CREAT | os.O_APPEND
        first = True
        with suppress(OSError):  # a full disk keeps nobody from stopping
            try:
                file = os.open(path, how | os.O_EXCL, 0o644)
            except FileExistsError:
                before = self.stops()
                # What stands there and cannot be read has stopped nobody.
                first = not before and path.stat().st_size > 0
                if len(before) >= MOST_STOPS:
                    return False
                file = os.open(path, how)
            try:
                os.write(file, line)
            finally:
                os.close(file)
        return first

    def _insists(self) -> bool:
        """Whether the first stop has had its time."""
        stops = self.stops()
        if not stops:
            return True
        first = datetime.fromisoformat(stops[0]["time"])
        # Of a clock that was set back nothing is known.
        return not 0.0 <= (datetime.now(UTC) - first).total_seconds() < INSIST_AFTER

    @property
    def moving(self) -> bool:
        """Whether it may drive the rig now, or soon."""
        return self.written.phase in ("starting", "running") and self.alive()

    def early(self, state: JobState) -> bool:
        """Whether it ended by its own order, and by nothing else that came on the way there."""
        return bool(state.early) and state.status == "stopped" and not self.stops()

    def stops(self) -> list[dict[str, str]]:
        """Who asked for a stop, and when."""
        try:
            lines = (self.folder / STOPS).read_text("utf-8", "replace").splitlines()
        except OSError:
            return []
        # Of a full disk the last one may be half.
        found = []
        for line in lines:
            with suppress(ValueError, TypeError, KeyError, RecursionError):
                stop = json.loads(line)
                by, time = str(stop["by"]), datetime.fromisoformat(stop["time"])
                if time.tzinfo is not None:
                    by = by.encode("utf-8", "replace").decode()
                    found.append({"time": stop["time"], "by": by})
        return found


def ask_all_to_stop(jobs: Path, by: str) -> bool:
    """Stop whatever runs, and leave word for the service; whether anything ran."""
    # The newest first, each at once: what runs is among the last that were asked for.
    stopped = [job.stop(by) for job in reversed(Job.all(jobs))]
    with suppress(OSError):
        put(jobs / ASKED, {"by": by}, durable=False)
    return any(stopped)


def moving(jobs: Path) -> bool:
    """Whether any of them may drive the rig now."""
    return any(job.moving for job in Job.all(jobs) if job.alive())


def asked_to_stop(jobs: Path) -> str:
    """Who left word of a stop since this was asked last; "" for nobody."""
    path = jobs / ASKED
    found: dict[str, Any] = {}
    if path.exists():
        with suppress(RecordingError):
            found = get(path)
        path.unlink(missing_ok=True)
    return str(found.get("by", ""))
