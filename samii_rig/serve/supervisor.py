"""The queue, and the process that runs its first.

Everything that matters is in the folders of the jobs, so that a service that was killed finds the
run and the queue again when it is started anew.
"""

from __future__ import annotations

import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from samii_rig.errors import GateError, InputError, RecordingError, SamiiRigError
from samii_rig.index.entry import identity
from samii_rig.index.store import PRIVATE, Index
from samii_rig.record.recover import recover
from samii_rig.record.writer import PARTIAL
from samii_rig.rig.schema import Rig
from samii_rig.run.experiments import recording_stem
from samii_rig.serve.job import (
    DIAGNOSIS,
    ESTIMATE,
    ID,
    JOBS,
    OVER,
    RESPONSES,
    SO_FAR,
    Job,
    JobState,
    Request,
    asked_to_stop,
)
from samii_rig.serve.live import LiveReader
from samii_rig.serve.loaded import Descriptor, independent

RUNNER = "samii_rig.serve.runner"  # what a run's process does
MOST_QUEUED = 50
KEPT = 200  # jobs that are over


@dataclass(frozen=True, slots=True)
class Order:
    """An experiment that somebody wants to be run.

    runs : of each, as it was predicted, its `setup`, `instruction` and `duration_s`. rig_toml : the
    rig file in the pose of these runs, "" as it is. pose : as it was asked for, for those who look.
    """

    experiment: str
    experiment_toml: str
    runs: list[dict[str, Any]]
    operator: str
    diagnosis: bool
    seed: int | None
    stop_when_certain: bool = False
    rig_toml: str = ""
    pose: str = ""


class Supervisor:
    """Runs one job after the other.

    current : what runs. last : what ended last, as data.
    held : why the queue waits, "" while it does not. A run that did not go through holds it, and
        so does a start of the service with jobs in the queue: a person looks first.
    """

    def __init__(self, rig: Rig, rig_toml: str, index: Index, pace: float) -> None:
        self._rig, self._rig_toml, self._index, self._pace = rig, rig_toml, index, pace
        self._jobs = index.folder / PRIVATE / JOBS
        self._children: list[BaseProcess] = []
        self._open: list[Job] = []
        self._readers: dict[str, LiveReader] = {}
        # One thing after the other, beside the service's loop, which must be free for a stop.
        self._later = ThreadPoolExecutor(1, thread_name_prefix="filing")
        self.current: Job | None = None
        self.last: dict[str, Any] | None = None
        self.held = ""
        self._forget()
        for job in Job.all(self._jobs):
            phase = job.written.phase
            if phase not in OVER:
                self._open.append(job)
            else:
                self.last = self.plain(job)
            if phase == "queued":
                self.held = "the service was started anew"
        self.turn()

    @property
    def simulated(self) -> bool:
        """The rig hurts nobody."""
        return self._rig.device.simulated

    def add(self, order: Order) -> list[Job]:
        """Queue the runs of an order, one job each; InputError if that cannot be, GateError while
        the queue is held."""
        self._refuse(order)
        simulated = self.simulated
        settings: dict[str, Any] = {"pace": self._pace} if simulated and self._pace > 0 else {}
        stem = recording_stem(self._rig, order.experiment)
        made = []
        for i, run in enumerate(order.runs):
            own = f"{stem}_{run['setup']}" if run["setup"] else stem
            with_seed = {} if order.seed is None or not simulated else {"seed": order.seed + i}
            request = Request(
                experiment=order.experiment,
                recording=self._free(own),
                operator=order.operator,
                setup=i,
                instruction=run["instruction"],
                diagnosis=order.diagnosis and len(order.runs) == 1,
                duration_s=run["duration_s"],
                stop_when_certain=order.stop_when_certain,
                settings={**settings, **with_seed},
                pose=order.pose,
            )
            rig_toml = order.rig_toml or self._rig_toml
            made.append(Job.make(self._jobs, request, rig_toml, order.experiment_toml))
            self._open.append(made[-1])
        # Who starts anew, with nothing left to wait for, has looked.
        self.held = ""
        self.turn()
        return made

    def _refuse(self, order: Order) -> None:
        """GateError or InputError for an order that cannot be queued now."""
        waiting = self.queue()
        if self.held and waiting:
            raise GateError(f"the queue is held: {self.held}; expected POST /api/queue/resume")
        if len(waiting) + len(order.runs) > MOST_QUEUED:
            raise InputError("queue", "", len(order.runs), f"at most {MOST_QUEUED} jobs in it")
        if len(order.runs) > 1 and not self.simulated:
            expected = "one run; between several a person changes the rig: use samii-rig run"
            raise InputError(
                "experiment", "", f"{order.experiment}, {len(order.runs)} runs", expected
            )
        if order.stop_when_certain and not order.diagnosis:
            expected = "false, or diagnosis: without one nothing becomes certain"
            raise InputError("order", "stop_when_certain", True, expected)
        if order.stop_when_certain and len(order.runs) > 1:
            expected = "false: the runs of an experiment of several are diagnosed together, later"
            raise InputError("order", "stop_when_certain", True, expected)

    def _forget(self) -> None:
        """Jobs that are over for long are taken away; their recordings stay."""
        for job in Job.all(self._jobs)[:-KEPT]:
            if job.written.phase in OVER:
                shutil.rmtree(job.folder, ignore_errors=True)

    def _free(self, stem: str) -> str:
        """A name that no recording has, nor one that is asked for."""
        taken = {job.request.recording for job in self._open}
        n, name = 1, f"{stem}.mcap"
        while name in taken or any(
            (self._index.folder / f"{name}{end}").exists() for end in ("", PARTIAL)
        ):
            n, name = n + 1, f"{stem}_{n + 1}.mcap"
        return name

    def queue(self) -> list[Job]:
        """What waits, first first."""
        return [j for j in self._open if j.written.phase == "queued"]

    def cancel(self, id_: str) -> None:
        """Take a job out of the queue; InputError if it is not in it."""
        for job in self.queue():
            if job.id == id_:
                job.set(JobState(phase="cancelled"))
                self._open.remove(job)
                return
        raise InputError("queue", "", id_, "a job that waits in it")

    def resume(self) -> None:
        """Let the queue go on."""
        self.held = ""
        self.turn()

    def stop(self, by: str) -> bool:
        """The run ends at zero output, and nothing follows by itself; False if none runs."""
        stopped = self.current is not None and self.current.stop(by)
        if stopped or self._open:
            self.held = f"stop asked by {by}"
        return stopped

    @property
    def moving(self) -> bool:
        """Whether a run may drive the rig now."""
        return self.current is not None and self.current.moving

    def turn(self) -> None:
        """Look after the jobs: take note of what ended and was asked, start what is next."""
        for child in [c for c in self._children if c.exitcode is not None]:
            self._children.remove(child)
        running = None
        for job in list(self._open):
            state = job.state
            if state.phase in OVER:
                self._ended(job, state)
            elif state.phase != "queued":
                running = job
        self.current = running
        if by := asked_to_stop(self._jobs):
            self._heed(by)
        waiting = self.queue()
        if running is None and waiting and not self.held:
            self._start(waiting[0])

    def _heed(self, by: str) -> None:
        """A stop came beside us (see `stopper`): nothing follows by itself."""
        if self.current is not None and not self.current.stops():
            # It began just then.
            self.current.stop(by)
        if self._open:
            self.held = f"stop asked by {by}"

    def _start(self, job: Job) -> None:
        with ExitStack() as stack:
            lock = stack.enter_context(job.held())
            job.set(JobState(phase="starting"))
            held = stack.pop_all()
        # In a thread: our loop must not wait until there is a process to be copied (see `loaded`).
        starting = threading.Thread(target=self._begin, args=(job, lock, held))
        starting.start()
        self.current = job

    def _begin(self, job: Job, lock: int, held: ExitStack) -> None:
        # The lock goes over to the child: from now on somebody holds it until the run is over.
        # Where the service ends before there is one, the job is found to have died.
        with held, suppress(EOFError):
            runner = (RUNNER, job.folder, self._index.folder, Descriptor(lock))
            self._children.append(independent(*runner))

    def _ended(self, job: Job, state: JobState) -> None:
        self._open.remove(job)
        self._readers.pop(job.id, None)
        recording = job.request.recording
        partial = self._index.folder / f"{recording}{PARTIAL}"
        if state.phase == "died" and state.status and not partial.exists():
            # The run itself was over and its recording whole.
            state = replace(state, phase="done", error="the diagnosis was given up")
            job.set(state)
        elif state.phase == "died":
            moved = partial.exists() or not job.stops()
            reason = "its process ended without a word" if moved else "stopped before it moved"
            state = replace(state, phase="died", status="failed", reason=reason, error="")
            job.set(state)
        if state.phase != "cancelled" and state.status != "completed" and not job.early(state):
            self.held = f"{recording}: {state.status or 'refused'}, {state.reason or state.error}"
        if Path(state.live).name == f"{job.id}.live":
            Path(state.live).unlink(missing_ok=True)
        self._later.submit(self._filed, job, state)

    def _filed(self, job: Job, state: JobState) -> None:
        """Its recording is whole and in the index before the job is told as the last one."""
        partial = self._index.folder / f"{job.request.recording}{PARTIAL}"
        with suppress(SamiiRigError):
            if state.phase == "died" and partial.exists():
                recover(partial)
        with suppress(SamiiRigError):
            self._index.refresh()
        self.last = self.plain(job)

    def reader(self) -> LiveReader | None:
        """The live data of the run, once there are any."""
        job = self.current
        if job is None:
            return None
        if job.id not in self._readers:
            with suppress(RecordingError):
                self._readers = {job.id: LiveReader(Path(job.state.live))}
        return self._readers.get(job.id)

    def job(self, id_: str) -> dict[str, Any] | None:
        """A job by its id, among all that are kept; None if there is none."""
        job = Job(self._jobs / id_) if ID.fullmatch(id_) else None
        return self.plain(job) if job is not None and job.folder.is_dir() else None

    def told(self, id_: str, name: str) -> Path | None:
        """A file of what is known of a job so far; None if there is none."""
        path = self._jobs / id_ / name
        return path if ID.fullmatch(id_) and path.is_file() else None

    def plain(self, job: Job) -> dict[str, Any]:
        """A job as data. estimated, diagnosed : whether there is one to be asked for.
        recording_id : of a run that is over, in the list of recordings; "" where it has none."""
        request, state = asdict(job.request), asdict(job.state)
        for private in ("pid", "live"):
            state.pop(private)
        request.pop("settings")
        known = {
            "estimated": any((job.folder / name).exists() for name in (ESTIMATE, RESPONSES)),
            "diagnosed": any((job.folder / name).exists() for name in (DIAGNOSIS, SO_FAR)),
            "recording_id": self._listed(job) if state["phase"] in OVER else "",
        }
        return {"id": job.id, **request, **state, **known}

    def _listed(self, job: Job) -> str:
        with suppress(SamiiRigError):
            entry = self._index.get(identity(job.request.recording))
            return entry.id if entry is not None else ""
        return ""

    def state(self) -> dict[str, Any]:
        """All that a display of the queue and the run shows.

        time_left_s : of the whole queue, as far as it is predicted.
        """
        queue = [self.plain(j) for j in self.queue()]
        left = float(sum(job["duration_s"] for job in queue))
        running = None
        if self.current is not None:
            running = self.plain(self.current)
            reader = self.reader()
            running["progress"] = reader.progress() if reader else {}
            left += running["progress"].get("time_left") or (
                running["duration_s"] if running["phase"] == "starting" else 0.0
            )
        return {"running": running, "queue": queue, "held": self.held, "time_left_s": left}

    def beat(self) -> None:
        """A sign of life to the run."""
        reader = self.reader()
        if reader is not None:
            reader.beat()
