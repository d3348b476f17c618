"""One run in a process of its own.

It holds the job's lock, which whoever started it had, and from now on alone. It shares no pipe that
it needs, no terminal and no session with the service, so that it goes on when the service is
killed; how it stands is in the job's folder and in the live data. A signal ends it at zero.
"""

from __future__ import annotations

import math
import os
import sys
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from samii_rig.errors import GateError, SamiiRigError
from samii_rig.index.remarks import add_note, set_diagnosis
from samii_rig.progress import reporting
from samii_rig.record.reader import read_events
from samii_rig.rig.schema import Rig
from samii_rig.run.campaign import carry_out
from samii_rig.run.client import Client
from samii_rig.run.order import PlannedRun, RunOrder
from samii_rig.run.outcome import Outcome
from samii_rig.run.outputs import plan_limits
from samii_rig.run.plan import Plan
from samii_rig.run.progress import Progress
from samii_rig.serve.following import following
from samii_rig.serve.job import DIAGNOSIS, ESTIMATE, LOG, LOST_AFTER, Job, JobState
from samii_rig.serve.live import LiveWriter, live_folder
from samii_rig.serve.loaded import Descriptor
from samii_rig.serve.planned import averages, planned
from samii_rig.serve.sofar import SoFar
from samii_rig.types import SampleBlock, StopRecord

NO_SIGN = f"the service gave no sign for {LOST_AFTER:g} s"


class Runner:
    """One run. recordings : the folder in which its recording will lie."""

    def __init__(self, job: Job, recordings: Path) -> None:
        self.job, self.request = job, job.order()
        self.path = recordings / self.request.recording
        self.state = JobState()
        self.live: LiveWriter | None = None
        self.stop = Event()
        self.lost = False
        self._shown: dict[str, float] = {}  # each output, by the newest sample that says it
        self._enough_in = 0  # the segment in which the service asked for no more

    def go(self) -> None:
        """From the files of the job to the recording and its diagnosis."""
        live = live_folder() / f"{self.job.id}.live"
        self._set(phase="starting", pid=os.getpid(), live=str(live))
        try:
            run = planned(self.job)
            outcome = self._carry_out(run, live)
            self._set(trouble=outcome.trouble)
            self._note()
            self._estimated(run, outcome)
            verdict = self._diagnosed(run, outcome)
            self._set(phase="done", verdict=verdict, doing="")
        except SamiiRigError as error:
            self._failed(str(error))
            raise
        except BaseException as error:
            self._failed(f"{type(error).__name__}: {error}")
            raise
        finally:
            if self.live is not None:
                self.live.close()

    def _set(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)
        self.job.set(self.state)

    def _failed(self, error: str) -> None:
        # A run whose recording could not be closed did not go through, however it had ended.
        self._set(phase="refused", status="failed" if self.state.status else "", error=error)

    def _carry_out(self, run: PlannedRun, live: Path) -> Outcome:
        order = run.predict(self.request.settings, self.request.operator)
        if self.job.stops():
            raise GateError("stopped before anything moved")
        self._set(phase="running")
        return carry_out(
            order,
            self.path,
            Client(
                progress=lambda now: self._progress(order.plan, now),
                stop=self.stop,
                alive=lambda: self._alive(order.rig),
            ),
            watch=lambda block: self._watch(order.plan, live, block),
            at_rest=lambda ended: self._at_rest(order, ended),
            why=self._reason,
        )

    def _watch(self, plan: Plan, live: Path, block: SampleBlock) -> None:
        self._note_outputs(block, plan)
        # A display that fails is none of the run's business.
        with suppress(Exception):
            if self.live is None:
                self.live = LiveWriter(live, block.channels, plan.rate_hz)
            self.live.samples(block)

    def _progress(self, plan: Plan, now: Progress) -> None:
        if self.live is not None:
            done, of = averages(plan, now.segment)
            # JSON says neither "not a number" nor "infinite".
            about = {"duration": plan.duration, "broadband": math.isinf(now.frequency)}
            about |= {"averages": done, "of_averages": of}
            self.live.progress({**_numbers(asdict(now)), **about})
            self._end_at_rest(now)

    def _alive(self, rig: Rig) -> bool:
        """Always: who drives is the service's to know. One that is gone may end the run."""
        gone = self.live is not None and self.live.silence() > LOST_AFTER
        if gone and rig.service.when_lost == "stop":
            self.lost = True
            self.stop.set()
        return True

    def _at_rest(self, order: RunOrder, ended: StopRecord) -> None:
        """Whoever asked for the stop waits for this, not for the estimate."""
        plan = order.plan
        slack = {x.output.channel: x.output.slack / 2 for x in plan_limits(plan, order.rig)}
        at_zero = all(abs(self._shown.get(name, math.nan)) <= x for name, x in slack.items())
        known = self._shown.keys() >= slack.keys()
        # A disk that is full for this word may still take the recording's end.
        with suppress(OSError):
            self._set(
                phase="analysing",
                status=ended.status,
                reason=ended.reason,
                at_zero=at_zero if known else None,
                ended=datetime.now(UTC).isoformat(timespec="seconds"),
            )

    def _note_outputs(self, block: SampleBlock, plan: Plan) -> None:
        """What a sample last said of each output."""
        names = [c.name for c in block.channels]
        for output in plan.outputs:
            v = block.values[:, names.index(output.actuator)]
            known = v[np.isfinite(v)]
            if len(known):
                self._shown[output.actuator] = float(known[-1])

    def _end_at_rest(self, now: Progress) -> None:
        """Once the service asks for no more: end after the segment that goes on, at rest."""
        assert self.live is not None
        if self.live.enough and not self._enough_in:
            self._enough_in = now.segment
        # Its reference has come down by itself then, and nothing of the next has begun.
        if 0 < self._enough_in < now.segment and math.isnan(now.frequency):
            # Written down later: the loop waits for no disk.
            early = f"its diagnosis was certain after segment {now.segment - 1}"
            self.state = replace(self.state, early=early)
            self.stop.set()

    def _reason(self, ended: StopRecord) -> str:
        """Why it ended; who asked for it says more than the signal by which that came."""
        stops = self.job.stops()
        if ended.status != "stopped":
            return ended.reason
        if stops:
            return f"stop asked by {stops[0]['by']}"
        return self.state.early or (NO_SIGN if self.lost else ended.reason)

    def _note(self) -> None:
        """Who stopped it, beside the recording."""
        said = [f"ended early: {self.state.early}"] if self.state.early else []
        said += [f"stop asked by {s['by']} at {s['time']}" for s in self.job.stops()]
        if self.lost:
            said.append(f"stopped, as {NO_SIGN}")
        if said:
            add_note(self.path, "service", "; ".join(said)[:2000])

    def _estimated(self, run: PlannedRun, outcome: Outcome) -> None:
        """The last word on the responses: of a run that was cut off, of its last segment too."""
        from samii_rig.serve.drawn import Drawn

        found, done = [(r, False) for r in outcome.responses], len(outcome.recording.segments)
        trouble = outcome.trouble
        # A display that fails is none of the run's business.
        with suppress(Exception):
            if outcome.stop.status != "completed":
                so_far = SoFar(run.plan)
                (start,) = (
                    int(e.payload["start"]) for e in read_events(self.path) if e.name == "plan"
                )
                so_far.take(outcome.recording, start)
                found, trouble = so_far.responses(), so_far.trouble
            told = Drawn(run.setup.rig, run.plan).told(found, done, trouble=trouble, final=True)
            self.job.tell(ESTIMATE, told)

    def _diagnosed(self, run: PlannedRun, outcome: Outcome) -> str:
        """The verdict; "" where there is nothing to tell it from."""
        if not self.request.diagnosis or not outcome.responses:
            return ""
        whole = outcome.stop.status == "completed" or self.job.early(self.state)
        if not whole or outcome.interrupted:
            return ""
        from samii_rig.diagnose.diagnose import diagnose
        from samii_rig.serve.analyst import said

        with suppress(SamiiRigError):
            found = diagnose(
                outcome.responses,
                run.setup.rig,
                runs=[outcome.recording],
                progress=reporting(lambda words: self._set(doing=words)),
            )
            set_diagnosis(self.path, {**found.plain(), "lines": list(found.lines())})
            following_toml = following(found.experiment, run.experiment_toml)
            told = {"next_toml": following_toml, "final": True}
            self.job.tell(DIAGNOSIS, {**said(found), **told})
            return found.verdict
        return ""


def _numbers(data: dict[str, Any]) -> dict[str, Any]:
    """What is no number as null, which JSON can say."""
    return {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in data.items()
    }


def begin(folder: Path, recordings: Path, lock: Descriptor) -> None:
    """What the process does, from its first line on. folder : of the job. lock : the job's."""
    os.setsid()
    with (folder / LOG).open("ab") as log, Path(os.devnull).open("rb") as nothing:
        for number, file in enumerate((nothing, log, log)):
            os.dup2(file.fileno(), number)
    os.set_inheritable(lock.number, False)
    # Who stops us finds our number here where our state cannot be read.
    os.ftruncate(lock.number, 0)
    os.write(lock.number, str(os.getpid()).encode())
    try:
        Runner(Job(folder), recordings).go()
    except SamiiRigError as error:
        print(f"samii-rig: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
